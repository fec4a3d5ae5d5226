"""The visible part of a mesh: its outer surface, even samples of it, visibility from a camera, images of normals."""

from __future__ import annotations

from dataclasses import dataclass

import mitsuba as mi
import numpy as np

from sira_mi.portrait.camera import Camera
from sira_mi.training.collection.outer import is_seen_from_afar
from sira_mi.training.collection.render import is_blocked_towards
from sira_mi.training.collection.triangles import vertex_normals
from studies.portraits.surface_distance import face_normals

_CLEARANCE = 2e-3  # scene units between a surface and the start of a ray that leaves it
# Places on a triangle, barycentric; it belongs to the outer surface when one of them does.
_PLACES = np.array([[1, 1, 1], [4, 1, 1], [1, 4, 1], [1, 1, 4]]) / np.array([[3], [6], [6], [6]])


@dataclass(frozen=True, eq=False)
class OuterSurface:
    """The part of a mesh that can be seen from outside (`collection.outer`): what lies under hair or cloth, inside the
    mouth, behind the eyes or inside a solid is no part of it. Coordinates in scene units."""

    scene: mi.Scene  # the whole mesh
    vertices: np.ndarray  # [N, 3]
    faces: np.ndarray  # [F, 3] the outer ones
    face_index: np.ndarray  # [F] which of the mesh's faces they are
    normals: np.ndarray  # [F, 3] unit, by the winding
    points: np.ndarray  # [P, 3] samples spread evenly by area
    point_face: np.ndarray  # [P] index into `faces`


def outer_surface(vertices: np.ndarray, faces: np.ndarray, samples: int, lowest: float, seed: int = 0) -> OuterSurface:
    """The outer surface of vertices [N, 3] and faces [T, 3]. Of `samples` places on the outer faces that reach above
    y = `lowest` (scene units), those become its points that can be seen from outside themselves."""
    vertices, faces = np.asarray(vertices, np.float64), np.asarray(faces, np.int64)
    scene = ray_scene(vertices, faces)
    normals = face_normals(vertices, faces)
    corners = vertices[faces]
    outer = np.zeros(len(faces), bool)
    for place in _PLACES:
        rest = np.flatnonzero(~outer)
        outer[rest] = _seen_on_a_side(scene, np.einsum("k,nkd->nd", place, corners[rest]), normals[rest])
    index = np.flatnonzero(outer)
    high = index[corners[index, :, 1].max(axis=1) > lowest]
    chosen, points = even_samples(corners[high], samples, seed)
    seen = _seen_on_a_side(scene, points, normals[high[chosen]])
    point_face = np.searchsorted(index, high[chosen[seen]])
    return OuterSurface(scene, vertices, faces[index], index, normals[index], points[seen], point_face)


def even_samples(corners: np.ndarray, count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """`count` places spread evenly by area over triangles [T, 3, 3]: triangle indices [count], points [count, 3]."""
    rng = np.random.default_rng([seed, 21])
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    if not len(area) or area.sum() == 0:
        return np.zeros(0, np.int64), np.zeros((0, 3))
    share = np.cumsum(area) / area.sum()
    chosen = np.searchsorted(share, (np.arange(count) + rng.random(count)) / count).clip(0, len(area) - 1)
    a, b = np.sqrt(rng.random(count)), rng.random(count)
    weights = np.stack([1 - a, a * (1 - b), a * b], axis=1)
    return chosen, np.einsum("nk,nkd->nd", weights, corners[chosen])


def ray_scene(vertices: np.ndarray, faces: np.ndarray) -> mi.Scene:
    """A mesh, vertices [N, 3] and faces [T, 3], for casting rays."""
    mesh = mi.Mesh("mesh", len(vertices), len(faces))
    params = mi.traverse(mesh)
    params["vertex_positions"] = np.asarray(vertices, np.float32).ravel()
    params["faces"] = np.asarray(faces, np.uint32).ravel()
    params.update()
    return mi.load_dict({"type": "scene", "mesh": mesh})


def is_seen_by_camera(scene: mi.Scene, camera: Camera, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Whether points [N, 3] on a surface with normals [N, 3] of either sign are in the camera's frame and nothing of
    the scene lies in between, bool [N]."""
    pixel = camera.project(points)
    inside = (pixel >= 0).all(axis=1) & (pixel < (camera.width, camera.height)).all(axis=1)
    towards = np.sign(((camera.centre - points) * normals).sum(axis=1, keepdims=True))
    result = np.zeros(len(points), bool)
    index = np.flatnonzero(inside)
    if len(index):
        result[index] = ~is_blocked_towards(scene, (points + _CLEARANCE * towards * normals)[index], camera.centre)
    return result


@dataclass(frozen=True, eq=False)
class MeshImages:
    """A mesh at a camera's pixel centres."""

    mask: np.ndarray  # [H, W] bool
    position: np.ndarray  # [H, W, 3] world, NaN where the mesh is not hit
    normal: np.ndarray  # [H, W, 3] unit, world, interpolated between the vertices; 0 where the mesh is not hit


def mesh_images(vertices: np.ndarray, faces: np.ndarray, camera: Camera, scene: mi.Scene | None = None) -> MeshImages:
    """Mask, positions and normals of a mesh (`scene`: its `ray_scene`). Normals are on the camera's side."""
    vertices, faces = np.asarray(vertices, np.float64), np.asarray(faces, np.int64)
    scene = scene or ray_scene(vertices, faces)
    size = camera.height, camera.width
    row, column = (a.ravel() + 0.5 for a in np.indices(size))
    way = np.linalg.solve(camera.K, np.stack([column, row, np.ones_like(row)])).T @ camera.world_to_camera[:3, :3]
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    origin = mi.Point3f(*(mi.Float(np.full(len(way), c, np.float32)) for c in camera.centre))
    hit = scene.ray_intersect_preliminary(mi.Ray3f(origin, mi.Vector3f(np.ascontiguousarray(way.T, np.float32))))
    pixel = np.flatnonzero(np.array(hit.is_valid()))
    face = np.array(hit.prim_index)[pixel].astype(np.int64)
    u, v = (np.array(c)[pixel].astype(np.float64) for c in (hit.prim_uv.x, hit.prim_uv.y))
    weights = np.stack([1 - u - v, u, v], axis=1)
    normals = np.einsum("nk,nkd->nd", weights, vertex_normals(vertices, faces)[faces[face]])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    away = (face_normals(vertices, faces)[face] * way[pixel]).sum(axis=1) > 0
    normals[away] *= -1
    images = {"mask": np.zeros(len(way), bool), "position": np.full((len(way), 3), np.nan), "normal": 0 * way}
    images["mask"][pixel] = True
    images["position"][pixel] = np.einsum("nk,nkd->nd", weights, vertices[faces[face]])
    images["normal"][pixel] = normals
    return MeshImages(**{name: image.reshape(*size, *image.shape[1:]) for name, image in images.items()})


def _seen_on_a_side(scene, points, normals):
    """Whether points on a surface can be seen from afar, from one side of it or the other."""
    seen = is_seen_from_afar(scene, points, normals)
    rest = np.flatnonzero(~seen)
    seen[rest] = is_seen_from_afar(scene, points[rest], -normals[rest])
    return seen
