"""Path-traced views of a head: cameras, materials with colours at vertices, one environment light, and ray casting."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from sira_mi.conventions import LUMINANCE

ROUGHNESS = 0.5


@dataclass(frozen=True)
class RenderSettings:
    size: int = 160  # pixels, width and height of a view
    samples: int = 48  # paths a pixel
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
        a, e = np.radians(yaw), np.radians(pitch)
        away = np.array([np.sin(a) * np.cos(e), np.sin(e), np.cos(a) * np.cos(e)])
        intrinsics.append(intrinsic_matrix(fov, size))
        poses.append(look_at(target + distance * away, target))
    return np.array(intrinsics, np.float32), np.array(poses, np.float32)


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


def mitsuba_mesh(name: str, part: Part) -> mi.Mesh:
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
    mesh = mi.Mesh(name, len(part.vertices), len(part.triangles), has_vertex_normals=True, props=props)
    mesh.add_attribute("vertex_albedo", 3, part.albedo.astype(np.float32).ravel())
    mesh.add_attribute("vertex_specular", 1, part.specular.astype(np.float32).ravel())
    params = mi.traverse(mesh)
    params["vertex_positions"] = part.vertices.astype(np.float32).ravel()
    params["vertex_normals"] = part.normals.astype(np.float32).ravel()
    params["faces"] = part.triangles.astype(np.uint32).ravel()
    params.update()
    return mesh


def build_scene(parts: list[Part], light: np.ndarray, settings: RenderSettings) -> mi.Scene:
    """A Mitsuba scene of parts under a radiance map [H, 2H, 3]."""
    scene = {f"part{i}": mitsuba_mesh(f"part{i}", part) for i, part in enumerate(parts)}
    scene["light"] = {"type": "envmap", "bitmap": mi.Bitmap(light.astype(np.float32)), "mis_compensation": False}
    scene["integrator"] = {"type": "path", "max_depth": settings.depth, "hide_emitters": True}
    return mi.load_dict({"type": "scene", **scene})


def render_views(
    scene: mi.Scene, intrinsics: np.ndarray, poses: np.ndarray, settings: RenderSettings, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Linear images [V, H, W, 3] and coverage [V, H, W] in 0..1, all views in one launch."""
    size = settings.size
    sensors = {}
    for index, (intrinsic, pose) in enumerate(zip(intrinsics, poses, strict=True)):
        to_world = np.linalg.inv(pose.astype(np.float64)) @ np.diag([-1.0, -1.0, 1.0, 1.0])
        sensors[f"view{index:03d}"] = {
            "type": "perspective",
            "fov": float(np.degrees(2 * np.arctan(0.5 * size / intrinsic[0, 0]))),
            "near_clip": 0.1,
            "far_clip": 100.0,
            "to_world": mi.ScalarTransform4f(to_world),
        }
    film = {
        "type": "hdrfilm",
        "width": size * len(poses),
        "height": size,
        "pixel_format": "rgba",
        "rfilter": {"type": "box"},
    }
    sampler = {"type": "independent", "sample_count": settings.samples}
    sensor = mi.load_dict({"type": "batch", "film": film, "sampler": sampler, **sensors})
    image = np.array(mi.render(scene, sensor=sensor, spp=settings.samples, seed=seed))
    views = image.reshape(size, len(poses), size, 4).transpose(1, 0, 2, 3)
    return views[..., :3], np.clip(views[..., 3], 0, 1)


def occluded(scene: mi.Scene, origins: np.ndarray, targets: np.ndarray | None, direction: np.ndarray | None = None):
    """Whether something lies between origins [N, 3] and targets [N, 3] or, without targets, along a far direction
    [3] or [N, 3]; bool [N]."""
    ray = mi.Ray3f(mi.Point3f(origins.T.astype(np.float32)), mi.Vector3f(0, 0, 1))
    if targets is None:
        way = np.broadcast_to(direction, origins.shape)
        ray.maxt = mi.Float(1e4)
    else:
        way = targets - origins
        distance = np.linalg.norm(way, axis=1)
        way = way / distance[:, None]
        ray.maxt = mi.Float(distance.astype(np.float32))
    ray.d = mi.Vector3f(np.ascontiguousarray(way.T).astype(np.float32))
    dr.make_opaque(ray)
    return np.array(scene.ray_test(ray)).astype(bool)


def exposure(image: np.ndarray, weight: np.ndarray, target: float) -> float:
    """The factor that brings the weighted mean luminance of an image [H, W, 3] to `target`."""
    luminance = image @ np.array(LUMINANCE)
    return float(target * weight.sum() / max((luminance * weight).sum(), 1e-9))
