"""One training scene (paper, section 3.1): posed views, oriented outer-surface points with their visible colours,
signed distances, landmarks and true albedos; see `LAYOUT` for the arrays.
"""

import json
import os
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from sira_mi.conventions import DOMAIN_LOWER, DOMAIN_UPPER, HELD_OUT_VIEWS, LUMINANCE
from sira_mi.portrait.landmarks import NOSE_UNDERSIDE
from sira_mi.training.collection.lighting import sample_light
from sira_mi.training.collection.outer import (
    Samples,
    choose_points,
    distance_to_surface,
    is_seen_from_afar,
    sample_parts,
    smooth_hair_normals,
)
from sira_mi.training.collection.render import (
    RenderSettings,
    build_scene,
    camera_position,
    find_exposure,
    is_blocked_along,
    is_blocked_towards,
    project,
    render_albedo,
    render_views,
    sample_cameras,
)
from sira_mi.training.collection.skin import CLOTH
from sira_mi.training.collection.subject import BrokenHead, Subject

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
    "albedo_images": "[2, H, W, 3] f2, true linear diffuse albedo of `HELD_OUT_VIEWS`, 0 outside (for evaluation only)",
    "specular_images": "[2, H, W] f2, true specular strength of `HELD_OUT_VIEWS`, 0 outside (for evaluation only)",
    "info": "JSON text: name, source, seed, group, person, light, licence",
}


@dataclass(frozen=True)
class SceneSettings:
    points: int = 20_000  # surface points
    volume: int = 20_000  # volume points
    face_share: float = 0.4  # share of the surface points within `outer.FACE_RADIUS` of the nose tip
    near_deviation: float = 0.15  # scene units, of volume points near the surface
    render: RenderSettings = field(default_factory=RenderSettings)


def sample_visible_colors(scene, samples: Samples, cameras, images: np.ndarray, coverage: np.ndarray):
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
        blocked = is_blocked_towards(scene, samples.points[index] + 3e-3 * samples.normals[index], eye)
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


def make_scene(subject: Subject, seed: int, hdri: list[Path], settings: SceneSettings | None = None) -> dict:
    """The arrays of `LAYOUT` for one subject under one light, which `seed` draws from lobes, sky and `hdri`.

    Raises BrokenHead when too little of the subject's surface can be seen."""
    settings = settings or SceneSettings()
    random = np.random.default_rng([seed, 2])
    light, light_info = sample_light(random, hdri)
    landmarks, landmarks_valid = subject.landmarks, subject.landmarks_valid
    if not landmarks_valid[NOSE_UNDERSIDE]:
        raise BrokenHead("the nose tip has no landmark")
    nose = landmarks[NOSE_UNDERSIDE]
    scene = build_scene(subject.parts, light, settings.render)

    cameras = sample_cameras(random, settings.render.size)
    images, coverage = render_views(scene, *cameras, settings.render, seed)
    wide = sample_parts(subject.parts, 4 * settings.points, nose, random)
    wide = wide.take(np.flatnonzero(is_seen_from_afar(scene, wide.points, wide.normals)))
    samples = choose_points(wide, nose, settings.points, settings.face_share, random)
    target = random.uniform(*settings.render.frontal_luminance) * find_metering(samples)
    scale = find_exposure(images[0], _head_weight(coverage[0], cameras), target)
    images = images * scale
    light_info["scale"] = scale
    visible, colors = sample_visible_colors(scene, samples, cameras, images, coverage)

    held_out = list(HELD_OUT_VIEWS)
    albedo_images, specular_images = render_albedo(scene, cameras[0][held_out], cameras[1][held_out], settings.render)

    half = settings.volume // 2
    uniform = random.uniform(DOMAIN_LOWER, DOMAIN_UPPER, (settings.volume - half, 3))
    near = samples.points[random.integers(len(samples.points), size=half)]
    near = near + settings.near_deviation * random.standard_normal((half, 3))
    volume = np.concatenate([uniform, np.clip(near, DOMAIN_LOWER, DOMAIN_UPPER)])
    distance = distance_to_surface(volume, wide)
    distance = np.where(is_seen_from_afar(scene, volume, None), distance, -distance)

    info = {
        "name": subject.name,
        "seed": seed,
        "group": subject.group,
        "person": subject.description,
        "light": light_info,
        "licence": subject.licence,
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
        "landmarks_valid": landmarks_valid & _are_landmarks_uncovered(scene, landmarks),
        "albedo": samples.albedo.astype(np.float16),
        "specular": samples.specular.astype(np.float16),
        "albedo_images": albedo_images.astype(np.float16),
        "specular_images": specular_images.astype(np.float16),
        "info": np.array(json.dumps(info)),
    }


def find_metering(samples: Samples) -> float:
    """Factor of a head's brightness in its photos: the square root of its albedo over light skin's. A camera that
    meters the head would give 1, one that meters the light the whole ratio."""
    head = samples.region != CLOTH
    return float(np.sqrt((samples.albedo[head] @ np.array(LUMINANCE)).mean() / 0.3))


def _head_weight(coverage, cameras):
    """Coverage [H, W] of the first view above the height of the chin."""
    _, size = coverage.shape
    chin, _ = project(np.array([[0.0, -1.0, 0.8]]), cameras[0][0], cameras[1][0])
    weight = coverage.copy()
    weight[int(np.clip(chin[0, 1], 1, size)) :] = 0
    return weight


def _are_landmarks_uncovered(scene, landmarks):
    """Whether landmarks [468] are visible from the front or from either side."""
    origin = landmarks + np.array([0, 0, 0.06])
    seen = np.zeros(len(landmarks), bool)
    for direction in ([0.0, 0, 1], [0.5, 0, 0.866], [-0.5, 0, 0.866], [0.9, 0, 0.44], [-0.9, 0, 0.44]):
        seen |= ~is_blocked_along(scene, origin, np.array(direction))
    return seen


def save_scene(path: Path, arrays: dict) -> None:
    """Writes the arrays under a temporary name, then renames."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    with temporary.open("wb") as file:
        np.savez_compressed(file, **arrays)
    temporary.replace(path)
