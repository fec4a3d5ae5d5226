"""Path-traced views of a head: cameras, materials with colours at vertices, one environment light, and ray casting."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, cast

import drjit as dr
import mitsuba as mi
import numpy as np

from sira_mi.conventions import LUMINANCE

ROUGHNESS = 0.5


@dataclass(frozen=True)
class RenderSettings:
    size: int = 160  # pixels, width and height of a view
    samples: int = 20  # paths a pixel
    depth: int = 4  # path length, bounces
    frontal_luminance: tuple[float, float] = (0.22, 0.4)  # mean linear luminance of the head in the frontal view


@dataclass(frozen=True)
class Part:
    """A closed surface with material values at its vertices."""

    vertices: np.ndarray  # [N, 3] scene units
    triangles: np.ndarray  # [T, 3] vertex indices, counter-clockwise seen from outside
    normals: np.ndarray  # [N, 3] unit, outward
    albedo: np.ndarray  # [N, 3] linear diffuse albedo
    specular: np.ndarray  # [N] specular strength, 0 to 1; the reflectance at normal incidence is 0.08 of it
    region: np.ndarray  # [T] region code of each triangle


def sample_cameras(random: np.random.Generator, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Intrinsics [14, 3, 3] and OpenCV world-to-camera matrices [14, 4, 4]: a near-frontal view, seven around the front
    half, and six from aside, behind and above."""
    front = [(random.uniform(-4, 4), random.uniform(-4, 4))]
    for step in np.linspace(-75, 75, 7):
        front.append((step + random.uniform(-14, 14), random.uniform(-25, 25)))
    back = [(100, 10), (-100, 10), (140, -5), (-140, 20), (180, 5), (random.uniform(-60, 60), 52)]
    angles = front + [(y + random.uniform(-15, 15), p + random.uniform(-8, 8)) for y, p in back]
    intrinsics, poses = [], []
    for yaw, pitch in angles:
        fov, distance = random.uniform(21, 27), random.uniform(12, 13)
        target = np.array([0.0, -0.45, 0.1]) + random.uniform(-0.15, 0.15, 3)
        intrinsics.append(intrinsic_matrix(fov, size))
        poses.append(look_at(target + distance * point_towards(np.radians(yaw), np.radians(pitch)), target))
    return np.array(intrinsics, np.float32), np.array(poses, np.float32)


def point_towards(yaw: float, pitch: float) -> np.ndarray:
    """The unit direction [3] that is `yaw` from +z towards +x and `pitch` above the horizon, radians."""
    return np.array([np.sin(yaw) * np.cos(pitch), np.sin(pitch), np.cos(yaw) * np.cos(pitch)])


def intrinsic_matrix(fov: float, size: int) -> np.ndarray:
    """K [3, 3] of a square view with `fov` degrees across `size` pixels; pixel centres at half-integers."""
    focal = 0.5 * size / np.tan(np.radians(fov) / 2)
    return np.array([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]])


def look_at(position: np.ndarray, target: np.ndarray) -> np.ndarray:
    """World-to-camera [4, 4] of an OpenCV camera (x right, y down, z forward) with +y up in the world."""
    forward = (target - position) / np.linalg.norm(target - position)
    right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = -rotation @ position
    return pose


def project(points: np.ndarray, intrinsic: np.ndarray, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixel coordinates [P, 2] and depths [P] of points [P, 3]."""
    local = points @ pose[:3, :3].T + pose[:3, 3]
    pixel = local @ intrinsic.T
    return pixel[:, :2] / pixel[:, 2:], local[:, 2]


def camera_position(pose: np.ndarray) -> np.ndarray:
    return -pose[:3, :3].T @ pose[:3, 3]


def make_mesh(name: str, part: Part) -> mi.Mesh:
    """A Mitsuba mesh of a part; diffuse and specular values are mesh attributes."""

    def disney(specular):
        colour = {"type": "mesh_attribute", "name": "vertex_albedo"}
        return {"type": "principled", "base_color": colour, "roughness": ROUGHNESS, "specular": specular}

    props = mi.Properties()
    bsdf = {
        "type": "blendbsdf",
        "weight": {"type": "mesh_attribute", "name": "vertex_specular"},
        "none": disney(0.0),
        "full": disney(1.0),
    }
    props["bsdf"] = mi.load_dict({"type": "twosided", "inner": bsdf})
    return build_mesh(name, part, props)


def build_mesh(name: str, part: Part, props: mi.Properties) -> mi.Mesh:
    """A Mitsuba mesh of a part's surface with the attributes `vertex_albedo` and `vertex_specular`; `props` holds its
    BSDF."""
    mesh = mi.Mesh(name, len(part.vertices), len(part.triangles), has_vertex_normals=True, props=props)
    for attribute, width, values in (("vertex_albedo", 3, part.albedo), ("vertex_specular", 1, part.specular)):
        mesh.add_attribute(attribute, width, cast(Any, values.astype(np.float32).ravel()))  # the stubs ask for a list
    params = mi.traverse(mesh)
    params["vertex_positions"] = part.vertices.astype(np.float32).ravel()
    params["vertex_normals"] = part.normals.astype(np.float32).ravel()
    params["faces"] = part.triangles.astype(np.uint32).ravel()
    params.update()
    return mesh


def build_scene(parts: list[Part], light: np.ndarray, settings: RenderSettings) -> mi.Scene:
    """A Mitsuba scene of parts under a radiance map [H, 2H, 3]."""
    scene: dict[str, Any] = {f"part{i}": make_mesh(f"part{i}", part) for i, part in enumerate(parts)}
    scene["light"] = {"type": "envmap", "bitmap": mi.Bitmap(light.astype(np.float32)), "mis_compensation": False}
    scene["integrator"] = {"type": "path", "max_depth": settings.depth, "hide_emitters": True}
    return mi.load_dict({"type": "scene", **scene})


def render_views(
    scene: mi.Scene, intrinsics: np.ndarray, poses: np.ndarray, settings: RenderSettings, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Linear images [V, H, W, 3] and coverage [V, H, W] in 0..1, all views in one launch. Pixels are box-filtered by
    sums in a fixed order, so that results repeat whatever the number of threads."""
    views, size, samples = len(poses), settings.size, settings.samples
    sampler = mi.load_dict({"type": "independent", "sample_count": samples})
    count = views * size * size * samples
    sampler.seed(seed, count)
    pixel = dr.arange(mi.UInt32, count) // samples
    view = pixel // (size * size)
    jitter = sampler.next_2d()
    x = mi.Float(pixel % size) + jitter.x
    y = mi.Float(pixel // size % size) + jitter.y
    ray = mi.RayDifferential3f(_camera_ray(intrinsics, poses, view, x, y))
    integrator: Any = scene.integrator()  # the stubs know no `sample`
    radiance, valid, _ = integrator.sample(scene, sampler, ray)
    # A rare sample of `principled` at grazing angles is not a number; it counts as black.
    radiance = [dr.select(dr.isfinite(channel), channel, 0.0) for channel in radiance]
    channels = [*radiance, dr.select(valid, mi.Float(1), mi.Float(0))]
    dr.eval(channels)
    channels = [dr.block_sum(channel, samples) / samples for channel in channels]
    image = np.stack([np.array(c) for c in channels], axis=-1).reshape(views, size, size, 4)
    return image[..., :3], np.clip(image[..., 3], 0, 1)


def render_albedo(
    scene: mi.Scene, intrinsics: np.ndarray, poses: np.ndarray, settings: RenderSettings, grid: int = 3
) -> tuple[np.ndarray, np.ndarray]:
    """Diffuse albedo [V, H, W, 3] and specular strength [V, H, W] of what the cameras see, the mean of `grid`² places
    of each pixel; 0 where they see nothing."""
    views, size = len(poses), settings.size
    index = dr.arange(mi.UInt32, views * size * size * grid * grid)
    sub, pixel = index % (grid * grid), index // (grid * grid)
    x = mi.Float(pixel % size) + (mi.Float(sub % grid) + 0.5) / grid
    y = mi.Float(pixel // size % size) + (mi.Float(sub // grid) + 0.5) / grid
    hit = scene.ray_intersect(_camera_ray(intrinsics, poses, pixel // (size * size), x, y))
    albedo = hit.shape.eval_attribute_3("vertex_albedo", hit, hit.is_valid())
    specular = hit.shape.eval_attribute_1("vertex_specular", hit, hit.is_valid())
    channels = [dr.select(hit.is_valid(), c, 0) for c in (*albedo, specular)]
    dr.eval(channels)
    means = [np.array(dr.block_sum(c, grid * grid)) / grid**2 for c in channels]
    image = np.stack(means, axis=-1).reshape(views, size, size, 4)
    return image[..., :3], image[..., 3]


def _camera_ray(intrinsics, poses, view, x, y):
    """World-space rays through pixel positions (x, y) of OpenCV cameras chosen by `view`."""
    to_world = np.linalg.inv(poses.astype(np.float64))
    directions = to_world[:, :3, :3] @ np.linalg.inv(intrinsics.astype(np.float64))

    def entry(values):
        return dr.gather(mi.Float, mi.Float(np.ascontiguousarray(values, dtype=np.float32)), view)

    way = [
        entry(directions[:, k, 0]) * x + entry(directions[:, k, 1]) * y + entry(directions[:, k, 2]) for k in range(3)
    ]
    origin = [entry(to_world[:, k, 3]) for k in range(3)]
    return mi.Ray3f(mi.Point3f(*origin), dr.normalize(mi.Vector3f(*way)))


def is_blocked_towards(scene: mi.Scene, origins: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Whether something lies between origins [N, 3] and a target [3], bool [N]."""
    way = target - origins
    distance = np.linalg.norm(way, axis=1)
    return _is_blocked(scene, origins, way / distance[:, None], distance)


def is_blocked_along(scene: mi.Scene, origins: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Whether something lies in a direction [3], however far, of origins [N, 3]; bool [N]."""
    return _is_blocked(scene, origins, np.broadcast_to(direction, origins.shape), np.full(len(origins), 1e4))


def _is_blocked(scene, origins, directions, distances):
    ray = mi.Ray3f(_columns(origins), mi.Vector3f(_columns(directions)))
    ray.maxt = distances.astype(np.float32)
    return np.array(scene.ray_test(ray)).astype(bool)


def _columns(rows):
    return mi.Point3f(np.ascontiguousarray(rows.T.astype(np.float32)))


def find_exposure(image: np.ndarray, weight: np.ndarray, target: float) -> float:
    """The factor that brings the weighted mean luminance of an image [H, W, 3] to `target`."""
    luminance = image @ np.array(LUMINANCE)
    return float(target * weight.sum() / max((luminance * weight).sum(), 1e-9))
