"""What a head's surface shows of itself: points with their albedos, and what each sees in evenly spread directions.

A few thousand points and rays, traced once before a picture, tell what its pixels need not trace."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.spatial import cKDTree

from sira_mi.fields.columns import evaluate_in_chunks, from_columns
from sira_mi.fields.sdf import deform, surface
from sira_mi.sg.multisampling import COSINE
from sira_mi.sg.radiance import Material, reflected_radiance
from sira_mi.sg.visibility import (
    SHADOW_OFFSET,
    Visibility,
    even_directions,
    light_directions,
    light_visibility,
    trace_unoccluded,
)

_POINTS = 4096
_DIRECTIONS = 64
_TRIANGLES = 4096
# Bounces that are followed one by one; what remains is extrapolated.
_BOUNCES = 24


@dataclass(frozen=True, eq=False)
class Surface:
    """Random points of a head's mesh, N columns."""

    point: np.ndarray  # [3, N]
    normal: np.ndarray  # [3, N] unit, of the field
    albedo: np.ndarray  # [3, N] diffuse
    specular: np.ndarray  # [1, N]
    neighbour: np.ndarray  # [K, N] point next to what is seen in each even direction; −1 where it is open

    def at(self, index: np.ndarray) -> Surface:
        """Some of the points; their neighbours keep the numbers that they have among all."""
        return Surface(*(getattr(self, name)[:, index] for name in self.__dataclass_fields__))


def _albedos(shape, x: np.ndarray) -> list[np.ndarray]:
    """Diffuse [3, N] and specular albedo [1, N] by the networks."""
    field, bsdf = shape.field(), shape.bsdf()

    def columns(points):
        inputs = deform(field, points)
        return tuple(t.evaluate_columns(*inputs) for t in (bsdf.diffuse_albedo, bsdf.specular_albedo))

    return evaluate_in_chunks(columns, x)


def sample_surface(shape) -> Surface:
    """Points of a `neural_sdf` that carries neural albedos. The same mesh gives the same points."""
    vertices = shape.vertices()
    rng = np.random.default_rng(0)
    chosen = np.sort(rng.choice(vertices.shape[1], min(_POINTS, vertices.shape[1]), replace=False))
    x, field = vertices[:, chosen], shape.field()
    (gradient,) = evaluate_in_chunks(lambda p: surface(field, p)[1], x)
    normal = gradient / np.maximum(np.linalg.norm(gradient, axis=0), 1e-6)
    return Surface(x, normal, *_albedos(shape, x), _neighbours(shape, x, normal))


def _neighbours(shape, x, normal):
    axis = even_directions(_DIRECTIONS).axis
    offset = SHADOW_OFFSET * shape.voxel
    scene, count = mi.load_dict({"type": "scene", "head": shape}), x.shape[1]
    direction = np.repeat(axis.T.astype(np.float32), count, axis=1)
    origin = np.tile(x + offset * normal, (1, _DIRECTIONS)) + offset * direction
    above = np.einsum("kc,cn->kn", axis, normal).ravel() > 0
    with dr.suspend_grad():
        origins, directions = (mi.Vector3f(np.ascontiguousarray(v, np.float32)) for v in (origin, direction))
        hit = scene.ray_intersect_preliminary(mi.Ray3f(mi.Point3f(origins), directions), False, mi.Bool(above))
        blocked = np.flatnonzero(hit.is_valid().numpy().astype(bool) & above)
        place = origin[:, blocked] + hit.t.numpy()[blocked] * direction[:, blocked]
    neighbour = np.full(_DIRECTIONS * count, -1)
    if len(blocked):
        neighbour[blocked] = cKDTree(x.T).query(place.T)[1]
    return neighbour.reshape(_DIRECTIONS, count)


def find_visible(shape, points: Surface, centre: np.ndarray) -> np.ndarray:
    """Indices of the points that a camera at `centre` [3] sees."""
    scene, offset = mi.load_dict({"type": "scene", "head": shape}), SHADOW_OFFSET * shape.voxel
    towards = centre[:, None] - points.point
    towards /= np.linalg.norm(towards, axis=0)
    facing = np.flatnonzero((towards * points.normal).sum(axis=0) > 0)
    start = points.point[:, facing] + offset * (points.normal[:, facing] + towards[:, facing])
    columns = [mi.TensorXf(np.ascontiguousarray(v, np.float32)) for v in (start, towards[:, facing])]
    ray = mi.Ray3f(from_columns(columns[0], mi.Point3f), from_columns(columns[1], mi.Vector3f))
    return facing[~scene.ray_test(ray).numpy().astype(bool)]


def _tensor(array):
    return mi.TensorXf(np.ascontiguousarray(array, np.float32))


def _radiance(points: Surface, view, roughness, k_s, lobes, visibility: Visibility | None = None) -> np.ndarray:
    material = Material(_tensor(points.albedo), _tensor(points.specular), roughness, k_s)
    radiance = reflected_radiance(_tensor(points.normal), _tensor(view), material, _tensor(lobes), visibility)
    return radiance.diffuse.numpy() + radiance.specular.numpy()


def bounced_radiance(
    points: Surface, lobes: np.ndarray | None, roughness: float, k_s: float, reflectance: float
) -> list[np.ndarray]:
    """Radiance [N], strongest channel, that each point reflects of light which was reflected n = 1, 2, … times before,
    from above: nothing shadows the first surface, and `reflectance` of the brightest neighbour is reflected
    specularly. `lobes` None: every surface has a radiance of 1 at first. The last entry is all that remains."""
    blocked = points.neighbour >= 0
    directions = even_directions(_DIRECTIONS)
    weight = np.maximum(directions.axis @ points.normal, 0) * directions.weight[:, None] / np.pi
    row, column = np.nonzero(blocked)
    source = points.neighbour[row, column]
    incoming = np.ones((3, len(row)))
    if lobes is not None and len(row):
        incoming = _radiance(points.at(source), directions.axis[row].T, roughness, k_s, lobes)
    result = []
    for _ in range(_BOUNCES):
        diffuse, glossy = np.zeros_like(points.albedo, float), np.zeros_like(points.albedo, float)
        for channel in range(3):
            seen = np.zeros(blocked.shape)
            seen[row, column] = incoming[channel]
            diffuse[channel] = (weight * seen).sum(axis=0)
            glossy[channel] = seen.max(axis=0)
        reflected = points.albedo * diffuse + k_s * reflectance * glossy
        result.append(reflected.max(axis=0))
        incoming = reflected[:, source]
    last, before = (max(float(part.max()), 1e-30) for part in (result[-1], result[-2]))
    ratio = last / before
    result.append(result[-1] * (ratio / (1 - ratio) if ratio < 1 else np.inf) if last > 1e-20 else 0 * result[-1])
    return result


def shadow_error(
    shape, points: Surface, centre: np.ndarray, lobes: np.ndarray, roughness: float, k_s: float, directions: int
) -> float:
    """The most that closed-form radiance differs at `points`, seen from `centre` [3], without visibility."""
    if points.point.shape[1] == 0:
        return 0.0
    view = _view(points, centre)
    visibility = _visibility(shape, points, view, lobes, roughness, directions)
    with_shadows, without = (_radiance(points, view, roughness, k_s, lobes, v) for v in (visibility, None))
    return float(np.abs(with_shadows - without).max())


def _view(points: Surface, centre: np.ndarray) -> np.ndarray:
    """Unit vectors [3, N] from a camera at `centre` [3] to the points."""
    view = points.point - centre[:, None]
    return view / np.linalg.norm(view, axis=0)


def _visibility(shape, points: Surface, view, lobes, roughness, directions: int) -> Visibility:
    chosen = light_directions(lobes, directions)
    scene = mi.load_dict({"type": "scene", "head": shape})
    unoccluded = trace_unoccluded(scene, points.point, points.normal, chosen.axis, SHADOW_OFFSET * shape.voxel)
    inputs = [_tensor(v) for v in (points.normal, view, points.specular)]
    return light_visibility(*inputs, roughness, _tensor(lobes), chosen, _tensor(unoccluded))


def sharing_error(
    shape, centre: np.ndarray, lobes: np.ndarray, roughness: float, k_s: float, directions: int, reach: float
) -> float:
    """The most that closed-form radiance, seen from `centre` [3], changes over `reach` scene units, by its slopes
    between corners and centres of random triangles whose normals may share a shading."""
    corners, centres = _random_triangles(shape)
    field, points = shape.field(), np.concatenate([centres, corners], axis=1)
    (gradient,) = evaluate_in_chunks(lambda p: surface(field, p)[1], points)
    normal = gradient / np.maximum(np.linalg.norm(gradient, axis=0), 1e-6)
    everything = Surface(points, normal, *_albedos(shape, points), np.empty((0, points.shape[1]), int))
    view, count = _view(everything, centre), centres.shape[1]
    middle, corner = np.repeat(np.arange(count), 3), count + np.arange(3 * count)
    used = (normal[:, middle] * normal[:, corner]).sum(axis=0) >= COSINE
    used &= (view * normal).sum(axis=0)[middle] < 0
    if not used.any():
        return 0.0
    visibility = _visibility(shape, everything, view, lobes, roughness, directions)
    radiance = _radiance(everything, view, roughness, k_s, lobes, visibility)
    change = np.abs(radiance[:, corner] - radiance[:, middle]).max(axis=0)
    distance = np.linalg.norm(points[:, corner] - points[:, middle], axis=0)
    return reach * float((change / np.maximum(distance, 1e-6))[used].max())


def baking_error(shape) -> tuple[float, float]:
    """The most that diffuse and specular albedos interpolated between the vertices differ from the networks' at the
    centres of random triangles of a `neural_sdf`."""
    corners, centres = _random_triangles(shape)
    return tuple(
        float(np.abs(at_corners.reshape(len(at_corners), -1, 3).mean(axis=2) - at_centres).max())
        for at_corners, at_centres in zip(_albedos(shape, corners), _albedos(shape, centres), strict=True)
    )


def _random_triangles(shape) -> tuple[np.ndarray, np.ndarray]:
    """Corners [3, 3 T], those of a triangle consecutive, and centres [3, T] of random triangles of a `neural_sdf`."""
    faces = mi.traverse(shape)["faces"].numpy().reshape(-1, 3)
    rng = np.random.default_rng(1)
    faces = faces[rng.choice(len(faces), min(_TRIANGLES, len(faces)), replace=False)]
    corners = shape.vertices()[:, faces.ravel()]
    return corners, corners.reshape(3, -1, 3).mean(axis=2)
