"""One training scene (paper, section 3.1): posed views, oriented outer-surface points with their visible colours,
signed distances, landmarks and true albedos; see `LAYOUT` for the arrays.

Only the outer, visible surface counts: a point belongs to it when at least one of `DIRECTIONS` far directions sees
it, and the inside is whatever none of them reaches, so hair, head and body form one solid.
"""

import json
import os
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from sira_mi.collection.landmarks import mesh_landmarks
from sira_mi.collection.lighting import sample_light
from sira_mi.collection.person import make_person
from sira_mi.collection.render import (
    Part,
    RenderSettings,
    build_scene,
    camera_position,
    exposure,
    occluded,
    project,
    render_views,
    sample_cameras,
)
from sira_mi.collection.skin import CLOTH
from sira_mi.conventions import DOMAIN_LOWER, DOMAIN_UPPER, LUMINANCE

LICENCE = "CC0-1.0 (MakeHuman base mesh, targets and hair; procedural appearance)"
DIRECTIONS = 64
FACE_RADIUS = 0.95  # scene units around the nose tip
NOSE_TIP = 1  # landmark index

LAYOUT = {
    "points": "[P, 3] f4, outer visible surface, scene units",
    "normals": "[P, 3] f4, unit, outward",
    "region": "[P] u1, 0 skin, 1 hair, 2 eye, 3 cloth",
    "K": "[V, 3, 3] f4, pixels",
    "world_to_camera": "[V, 4, 4] f4, OpenCV",
    "images": "[V, H, W, 3] f2, linear radiance",
    "masks": "[V, H, W] u1, 1 where the person covers at least half of the pixel",
    "visible": "[P, V] bool",
    "colors": "[P, V, 3] f2, linear radiance where visible, else 0",
    "volume": "[Q, 3] f4, half uniform in the domain, half near the surface",
    "volume_distance": "[Q] f4, signed distance to the outer surface, positive outside, scene units",
    "landmarks": "[468, 3] f4, scene units",
    "landmarks_valid": "[468] bool",
    "albedo": "[P, 3] f2, true linear diffuse albedo (for evaluation only)",
    "specular": "[P] f2, true specular strength, reflectance at normal incidence / 0.08 (for evaluation only)",
    "info": "JSON text: seed, identity, look, hair, light, licence",
}


@dataclass(frozen=True)
class SceneSettings:
    points: int = 20_000  # surface points
    volume: int = 20_000  # volume points
    face_share: float = 0.4  # share of the surface points within `FACE_RADIUS` of the nose tip
    near_deviation: float = 0.15  # scene units, of volume points near the surface
    margin: float = 0.01  # scene units between surface points and the domain's sides
    render: RenderSettings = field(default_factory=RenderSettings)


@dataclass(frozen=True)
class Samples:
    """Points on the parts' surfaces with what is interpolated at them."""

    points: np.ndarray  # [N, 3]
    normals: np.ndarray  # [N, 3]
    region: np.ndarray  # [N]
    albedo: np.ndarray  # [N, 3]
    specular: np.ndarray  # [N]
    corners: np.ndarray  # [N, 3, 3] of the triangle that the point lies on

    def take(self, index: np.ndarray) -> "Samples":
        return Samples(*(getattr(self, name)[index] for name in self.__dataclass_fields__))


def far_directions(count: int = DIRECTIONS) -> np.ndarray:
    """Unit directions [count, 3] spread evenly over the sphere (a Fibonacci lattice)."""
    index = np.arange(count) + 0.5
    height = 1 - 2 * index / count
    turn = np.pi * (1 + 5**0.5) * index
    radius = np.sqrt(1 - height**2)
    return np.stack([radius * np.cos(turn), height, radius * np.sin(turn)], axis=1)


def sample_parts(parts: list[Part], count: int, centre: np.ndarray, random: np.random.Generator, settings) -> Samples:
    """About `count` points on the parts inside the domain, half of them within `FACE_RADIUS` of `centre`."""
    lower, upper = np.array(DOMAIN_LOWER) + settings.margin, np.array(DOMAIN_UPPER) - settings.margin
    areas, middles = [], []
    for part in parts:
        corners = part.vertices[part.triangles]
        areas.append(
            0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        )
        middles.append(corners.mean(1))
    area, middle = np.concatenate(areas), np.concatenate(middles)
    area = area * ((middle > lower - 0.1) & (middle < upper + 0.1)).all(1)
    face = np.linalg.norm(middle - centre, axis=1) < FACE_RADIUS
    weight = area * np.where(face, 0.5 / max(area[face].sum(), 1e-9), 0.5 / max(area[~face].sum(), 1e-9))
    chosen = random.choice(len(weight), count, p=weight / weight.sum())
    bounds = np.cumsum([0] + [len(a) for a in areas])
    a, b = random.random((2, count))
    a, b = np.where(a + b > 1, 1 - a, a), np.where(a + b > 1, 1 - b, b)
    bary = np.stack([1 - a - b, a, b], axis=1)
    pieces = []
    for number, part in enumerate(parts):
        mine = (chosen >= bounds[number]) & (chosen < bounds[number + 1])
        triangle = chosen[mine] - bounds[number]
        corner = part.triangles[triangle]

        def at(values, corner=corner, bary=bary[mine]):
            return np.einsum("nk,nk...->n...", bary, values[corner])

        normals = at(part.normals)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
        corners = part.vertices[corner]
        pieces.append((at(part.vertices), normals, part.region[triangle], at(part.albedo), at(part.specular), corners))
    samples = Samples(*(np.concatenate(column) for column in zip(*pieces, strict=True)))
    return samples.take(((samples.points > lower) & (samples.points < upper)).all(1))


def seen_from_afar(scene, points: np.ndarray, normals: np.ndarray | None) -> np.ndarray:
    """Whether any far direction reaches a point, bool [N]; points on a surface are only asked in front of it."""
    seen = np.zeros(len(points), bool)
    for direction in far_directions():
        ask = ~seen if normals is None else ~seen & (normals @ direction > 0.02)
        index = np.flatnonzero(ask)
        if len(index):
            origin = points[index] if normals is None else points[index] + 2e-3 * normals[index]
            seen[index] = ~occluded(scene, origin, None, direction)
    return seen


def smooth_hair_normals(samples: Samples) -> np.ndarray:
    """Normals [N, 3] with those of hair averaged over their neighbours, so that hair is a soft volume."""
    normals = samples.normals.copy()
    hair = np.flatnonzero(samples.region == 1)
    if len(hair) > 8:
        _, near = cKDTree(samples.points[hair]).query(samples.points[hair], k=8)
        mean = samples.normals[hair][near].mean(1)
        normals[hair] = mean / np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-9)
    return normals


def visible_colors(scene, samples: Samples, cameras, images: np.ndarray, coverage: np.ndarray):
    """Visibility [P, V] and bilinear colours [P, V, 3]; pixels that the silhouette crosses are left out."""
    intrinsics, poses = cameras
    count, views = len(samples.points), len(poses)
    visible = np.zeros((count, views), bool)
    colors = np.zeros((count, views, 3), np.float32)
    height, width = images.shape[1:3]
    for view in range(views):
        eye = camera_position(poses[view].astype(np.float64))
        pixel, _ = project(samples.points, intrinsics[view].astype(np.float64), poses[view].astype(np.float64))
        way = eye - samples.points
        facing = (way * samples.normals).sum(1) > 0.1 * np.linalg.norm(way, axis=1)
        corner = np.floor(pixel - 0.5).astype(int)
        inside = (corner >= 0).all(1) & (corner[:, 0] < width - 1) & (corner[:, 1] < height - 1)
        index = np.flatnonzero(facing & inside)
        blocked = occluded(
            scene, samples.points[index] + 3e-3 * samples.normals[index], np.broadcast_to(eye, (len(index), 3))
        )
        index = index[~blocked]
        x, y = corner[index].T
        fx, fy = (pixel[index] - 0.5 - corner[index]).T
        taps = (
            (y, x, (1 - fx) * (1 - fy)),
            (y, x + 1, fx * (1 - fy)),
            (y + 1, x, (1 - fx) * fy),
            (y + 1, x + 1, fx * fy),
        )
        solid = np.min([coverage[view][row, column] for row, column, _ in taps], axis=0) > 0.999
        color = sum(weight[:, None] * images[view][row, column] for row, column, weight in taps)
        visible[index[solid], view] = True
        colors[index[solid], view] = color[solid]
    return visible, colors


def point_triangle_distance(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Distances [...] from points [..., 3] to triangles [..., 3, 3] (Ericson 2005, section 5.1.5)."""
    a, b, c = corners[..., 0, :], corners[..., 1, :], corners[..., 2, :]
    dot = lambda u, v: (u * v).sum(-1)  # noqa: E731
    ab, ac, ap = b - a, c - a, points - a
    bp, cp = points - b, points - c
    d1, d2, d3, d4, d5, d6 = dot(ab, ap), dot(ac, ap), dot(ab, bp), dot(ac, bp), dot(ab, cp), dot(ac, cp)
    va, vb, vc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2
    tiny = 1e-20
    inner = np.maximum(va + vb + vc, tiny)
    v, w = vb / inner, vc / inner
    on_bc = (va <= 0) & (d4 - d3 >= 0) & (d5 - d6 >= 0)
    t = (d4 - d3) / np.maximum(d4 - d3 + d5 - d6, tiny)
    v, w = np.where(on_bc, 1 - t, v), np.where(on_bc, t, w)
    on_ac = (vb <= 0) & (d2 >= 0) & (d6 <= 0)
    v, w = np.where(on_ac, 0, v), np.where(on_ac, d2 / np.maximum(d2 - d6, tiny), w)
    on_ab = (vc <= 0) & (d1 >= 0) & (d3 <= 0)
    v, w = np.where(on_ab, d1 / np.maximum(d1 - d3, tiny), v), np.where(on_ab, 0, w)
    for at, vv, ww in (
        ((d1 <= 0) & (d2 <= 0), 0, 0),
        ((d3 >= 0) & (d4 <= d3), 1, 0),
        ((d6 >= 0) & (d5 <= d6), 0, 1),
    ):
        v, w = np.where(at, vv, v), np.where(at, ww, w)
    closest = a + v[..., None] * ab + w[..., None] * ac
    return np.linalg.norm(points - closest, axis=-1)


def distance_to_surface(points: np.ndarray, outer: Samples, candidates: int = 8) -> np.ndarray:
    """Distances [Q] from points [Q, 3] to the triangles of the nearest samples of the outer surface."""
    _, near = cKDTree(outer.points).query(points, k=candidates)
    return point_triangle_distance(points[:, None], outer.corners[near]).min(1)


def make_scene(seed: int, hair: Path | None, hdri: list[Path], settings: SceneSettings | None = None) -> dict:
    """The arrays of `LAYOUT` for one person under one light."""
    settings = settings or SceneSettings()
    random = np.random.default_rng([seed, 2])
    person = make_person(seed, hair)
    light, light_info = sample_light(random, hdri)
    landmarks, landmarks_valid = mesh_landmarks(person.head)
    nose = landmarks[NOSE_TIP] if landmarks_valid[NOSE_TIP] else person.head[np.argmax(person.head[:, 2])]
    scene = build_scene(person.parts, light, settings.render)

    cameras = sample_cameras(random, settings.render.size)
    images, coverage = render_views(scene, *cameras, settings.render, seed)
    wide = sample_parts(person.parts, 6 * settings.points, nose, random, settings)
    wide = wide.take(np.flatnonzero(seen_from_afar(scene, wide.points, wide.normals)))
    samples = choose_points(wide, nose, random, settings)
    target = random.uniform(*settings.render.frontal_luminance) * metering(samples)
    scale = exposure(images[0], _head_weight(coverage[0], cameras), target)
    images = images * scale
    light_info["scale"] = scale
    visible, colors = visible_colors(scene, samples, cameras, images, coverage)

    half = settings.volume // 2
    uniform = random.uniform(DOMAIN_LOWER, DOMAIN_UPPER, (settings.volume - half, 3))
    near = samples.points[random.integers(len(samples.points), size=half)]
    near = near + settings.near_deviation * random.standard_normal((half, 3))
    volume = np.concatenate([uniform, np.clip(near, DOMAIN_LOWER, DOMAIN_UPPER)])
    distance = distance_to_surface(volume, wide)
    distance = np.where(seen_from_afar(scene, volume, None), distance, -distance)

    info = {
        "seed": seed,
        "person": person.description(),
        "light": light_info,
        "licence": LICENCE,
        "frontal_luminance": target,
    }
    return {
        "points": samples.points.astype(np.float32),
        "normals": smooth_hair_normals(samples).astype(np.float32),
        "region": samples.region.astype(np.uint8),
        "K": cameras[0],
        "world_to_camera": cameras[1],
        "images": np.minimum(images, 60000).astype(np.float16),
        "masks": (coverage >= 0.5).astype(np.uint8),
        "visible": visible,
        "colors": np.minimum(colors, 60000).astype(np.float16),
        "volume": volume.astype(np.float32),
        "volume_distance": distance.astype(np.float32),
        "landmarks": landmarks.astype(np.float32),
        "landmarks_valid": landmarks_valid & _landmarks_uncovered(scene, landmarks),
        "albedo": samples.albedo.astype(np.float16),
        "specular": samples.specular.astype(np.float16),
        "info": np.array(json.dumps(info)),
    }


def metering(samples: Samples) -> float:
    """Factor of a head's brightness in its photos: the square root of its albedo over a light skin's, half way between
    a camera that evens out every head and one that exposes for the light."""
    head = samples.region != CLOTH
    return float(np.sqrt((samples.albedo[head] @ np.array(LUMINANCE)).mean() / 0.3))


def _head_weight(coverage, cameras):
    """Coverage [H, W] of the first view above the height of the chin."""
    _, size = coverage.shape
    chin, _ = project(np.array([[0.0, -1.0, 0.8]]), cameras[0][0], cameras[1][0])
    weight = coverage.copy()
    weight[int(np.clip(chin[0, 1], 1, size)) :] = 0
    return weight


def _landmarks_uncovered(scene, landmarks):
    """Landmarks that nothing hides from the front or from either side of the front."""
    origin = landmarks + np.array([0, 0, 0.06])
    seen = np.zeros(len(landmarks), bool)
    for direction in ([0.0, 0, 1], [0.5, 0, 0.866], [-0.5, 0, 0.866], [0.9, 0, 0.44], [-0.9, 0, 0.44]):
        seen |= ~occluded(scene, origin, None, np.array(direction))
    return seen


def choose_points(wide: Samples, nose: np.ndarray, random: np.random.Generator, settings: SceneSettings) -> Samples:
    """`settings.points` of the outer samples, `settings.face_share` of them within `FACE_RADIUS` of the nose tip."""
    face = np.linalg.norm(wide.points - nose, axis=1) < FACE_RADIUS
    inside, outside = np.flatnonzero(face), np.flatnonzero(~face)
    wanted = round(settings.face_share * settings.points)
    wanted = int(np.clip(wanted, settings.points - len(outside), len(inside)))
    if settings.points - wanted > len(outside) or wanted < 0:
        raise ValueError(f"only {len(wide.points)} visible surface points")
    chosen = np.concatenate(
        [random.choice(inside, wanted, replace=False), random.choice(outside, settings.points - wanted, replace=False)]
    )
    return wide.take(random.permutation(chosen))


def save_scene(path: Path, arrays: dict) -> None:
    """Writes the arrays under a temporary name, then renames."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    with temporary.open("wb") as file:
        np.savez_compressed(file, **arrays)
    temporary.replace(path)
