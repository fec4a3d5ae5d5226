"""Estimates from a few thousand random points of a head's surface: bounces, shadows, how radiance and albedos vary.

They are made once before a picture, and tell what its pixels need not compute."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.spatial import cKDTree

from sira_mi.fields.columns import evaluate_in_chunks, from_columns, to_array, unit_columns
from sira_mi.fields.sdf import deform, surface
from sira_mi.sg.multisampling import COSINE
from sira_mi.sg.radiance import Material, closed_form_radiance
from sira_mi.sg.visibility import (
    DEFAULT_DIRECTIONS,
    SHADOW_OFFSET,
    Visibility,
    even_directions,
    light_directions,
    light_visibility,
    trace_unoccluded,
)

if TYPE_CHECKING:
    from sira_mi.plugins.neural_albedo import NeuralAlbedo
    from sira_mi.plugins.neural_sdf import NeuralSDF
    from sira_mi.plugins.sira_bsdf import SiraBSDF

_POINTS, _TRIANGLES = 4096, 4096
# Directions in which each point looks for its neighbours.
_DIRECTIONS = 64
# Bounces that are followed one by one; the rest is extrapolated.
_BOUNCES = 24


@dataclass(frozen=True, eq=False)
class Surface:
    """N random points of a head's mesh."""

    point: np.ndarray  # [3, N]
    normal: np.ndarray  # [3, N] unit, of the field
    albedo: np.ndarray  # [3, N] diffuse
    specular: np.ndarray  # [1, N] specular albedo
    neighbour: np.ndarray  # [K, N] the point nearest to what is visible in each even direction; −1 where nothing is

    def at(self, index: np.ndarray) -> Surface:
        """Some of the points; `neighbour` still counts among all."""
        columns = (self.point, self.normal, self.albedo, self.specular, self.neighbour)
        return Surface(*(values[:, index] for values in columns))


def albedo_textures(shape: NeuralSDF) -> tuple[NeuralAlbedo, NeuralAlbedo]:
    """The neural albedos of a head, diffuse and specular."""
    bsdf = cast("SiraBSDF", shape.bsdf())
    return cast("NeuralAlbedo", bsdf.diffuse_albedo), cast("NeuralAlbedo", bsdf.specular_albedo)


def evaluate_albedos(shape: NeuralSDF, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Diffuse [3, N] and specular albedo [1, N] by the networks at points [3, N] of the field."""
    field, textures = shape.field(), albedo_textures(shape)

    def columns(points):
        inputs = deform(field, points)
        return tuple(texture.evaluate_columns(points, *inputs) for texture in textures)

    diffuse, specular = evaluate_in_chunks(columns, x)
    return diffuse, specular


def _normals(shape: NeuralSDF, x: np.ndarray) -> np.ndarray:
    """Unit normals [3, N] of the field."""
    field = shape.field()
    (gradient,) = evaluate_in_chunks(lambda p: surface(field, p)[1], x)
    return unit_columns(gradient)


def sample_surface(shape: NeuralSDF) -> Surface:
    """Random vertices of a `neural_sdf` with neural albedos. The same mesh gives the same points."""
    vertices = shape.vertices()
    rng = np.random.default_rng(0)
    chosen = np.sort(rng.choice(vertices.shape[1], min(_POINTS, vertices.shape[1]), replace=False))
    x = vertices[:, chosen]
    normal = _normals(shape, x)
    return Surface(x, normal, *evaluate_albedos(shape, x), _neighbours(shape, x, normal))


def _neighbours(shape: NeuralSDF, x: np.ndarray, normal: np.ndarray) -> np.ndarray:
    axis = even_directions(_DIRECTIONS).axis
    offset = SHADOW_OFFSET * shape.voxel
    scene, count = _scene(shape), x.shape[1]
    direction = np.repeat(axis.T.astype(np.float32), count, axis=1)
    origin = np.tile(x + offset * normal, (1, _DIRECTIONS)) + offset * direction
    above = np.einsum("kc,cn->kn", axis, normal).ravel() > 0
    with dr.suspend_grad():
        origins, directions = (mi.Vector3f(np.ascontiguousarray(v, np.float32)) for v in (origin, direction))
        active: Any = mi.Bool(above)  # the stubs want a Bool of another module
        hit = scene.ray_intersect_preliminary(mi.Ray3f(mi.Point3f(origins), directions), active=active)
        blocked = np.flatnonzero(hit.is_valid().numpy().astype(bool) & above)
        place = origin[:, blocked] + hit.t.numpy()[blocked] * direction[:, blocked]
    neighbour = np.full(_DIRECTIONS * count, -1)
    if len(blocked):
        neighbour[blocked] = cKDTree(x.T).query(place.T)[1]
    return neighbour.reshape(_DIRECTIONS, count)


def _scene(shape: NeuralSDF) -> mi.Scene:
    return cast(mi.Scene, mi.load_dict({"type": "scene", "head": shape}))


def find_visible(shape: NeuralSDF, points: Surface, centre: np.ndarray) -> np.ndarray:
    """Indices of the points that are visible from a camera at `centre` [3]."""
    scene, offset = _scene(shape), SHADOW_OFFSET * shape.voxel
    towards = centre[:, None] - points.point
    towards /= np.linalg.norm(towards, axis=0)
    facing = np.flatnonzero((towards * points.normal).sum(axis=0) > 0)
    start = points.point[:, facing] + offset * (points.normal[:, facing] + towards[:, facing])
    columns = [to_array(v) for v in (start, towards[:, facing])]
    ray = mi.Ray3f(from_columns(columns[0], mi.Point3f), from_columns(columns[1], mi.Vector3f))
    return facing[~scene.ray_test(ray).numpy().astype(bool)]


def _radiance(points: Surface, view, roughness, k_s, lobes, visibility: Visibility | None = None) -> np.ndarray:
    material = Material(to_array(points.albedo), to_array(points.specular), roughness, k_s)
    radiance = closed_form_radiance(to_array(points.normal), to_array(view), material, to_array(lobes), visibility)
    return radiance.diffuse.numpy() + radiance.specular.numpy()


def reflect_bounces(
    points: Surface, lobes: np.ndarray | None, roughness: float, k_s: float, reflectance: float
) -> list[np.ndarray]:
    """Upper estimates of the radiance [N], strongest channel, that each point reflects of light that was reflected
    n = 1, 2, … times before; the last entry is the rest of the series.

    The light reaches the first surface unshadowed. The specular term reflects `reflectance` of the brightest neighbour.
    With `lobes` None every surface has a radiance of 1 to begin with."""
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
    shape: NeuralSDF, points: Surface, centre: np.ndarray, lobes: np.ndarray, roughness: float, k_s: float
) -> float:
    """The largest difference that visibility makes to the closed-form radiance at `points`, seen from `centre` [3]."""
    if points.point.shape[1] == 0:
        return 0.0
    view = _view(points, centre)
    visibility = _visibility(shape, points, view, lobes, roughness)
    with_shadows, without = (_radiance(points, view, roughness, k_s, lobes, v) for v in (visibility, None))
    return float(np.abs(with_shadows - without).max())


def _view(points: Surface, centre: np.ndarray) -> np.ndarray:
    """Unit vectors [3, N] from a camera at `centre` [3] to the points."""
    view = points.point - centre[:, None]
    return view / np.linalg.norm(view, axis=0)


def _visibility(shape: NeuralSDF, points: Surface, view: np.ndarray, lobes: np.ndarray, roughness: float) -> Visibility:
    chosen = light_directions(lobes, DEFAULT_DIRECTIONS)
    unoccluded = trace_unoccluded(_scene(shape), points.point, points.normal, chosen.axis, SHADOW_OFFSET * shape.voxel)
    normal, outgoing, specular = (to_array(v) for v in (points.normal, view, points.specular))
    return light_visibility(
        normal, outgoing, specular, mi.Float(roughness), to_array(lobes), chosen, to_array(unoccluded)
    )


def sharing_error(
    shape: NeuralSDF, centre: np.ndarray, lobes: np.ndarray, roughness: float, k_s: float, reach: float
) -> float:
    """The largest change of closed-form radiance, seen from `centre` [3], over `reach` scene units. It is extrapolated
    from the slopes between corners and centres of random triangles whose normals are similar enough to share a
    shading."""
    corners, centres = _random_triangles(shape)
    points = np.concatenate([centres, corners], axis=1)
    normal = _normals(shape, points)
    everything = Surface(points, normal, *evaluate_albedos(shape, points), np.empty((0, points.shape[1]), int))
    view, count = _view(everything, centre), centres.shape[1]
    middle, corner = np.repeat(np.arange(count), 3), count + np.arange(3 * count)
    used = (normal[:, middle] * normal[:, corner]).sum(axis=0) >= COSINE
    used &= (view * normal).sum(axis=0)[middle] < 0
    if not used.any():
        return 0.0
    visibility = _visibility(shape, everything, view, lobes, roughness)
    radiance = _radiance(everything, view, roughness, k_s, lobes, visibility)
    change = np.abs(radiance[:, corner] - radiance[:, middle]).max(axis=0)
    distance = np.linalg.norm(points[:, corner] - points[:, middle], axis=0)
    return reach * float((change / np.maximum(distance, 1e-6))[used].max())


def baking_error(shape: NeuralSDF) -> tuple[float, float]:
    """The largest differences of diffuse and of specular albedo between interpolation from the vertices and the
    networks, at the centres of random triangles."""
    corners, centres = _random_triangles(shape)
    diffuse, specular = (
        float(np.abs(at_corners.reshape(len(at_corners), -1, 3).mean(axis=2) - at_centres).max())
        for at_corners, at_centres in zip(
            evaluate_albedos(shape, corners), evaluate_albedos(shape, centres), strict=True
        )
    )
    return diffuse, specular


def _random_triangles(shape: NeuralSDF) -> tuple[np.ndarray, np.ndarray]:
    """Corners [3, 3 T], those of a triangle consecutive, and centres [3, T] of random triangles."""
    faces = shape.faces()
    rng = np.random.default_rng(1)
    faces = faces[rng.choice(len(faces), min(_TRIANGLES, len(faces)), replace=False)]
    corners = shape.vertices()[:, faces.ravel()]
    return corners, corners.reshape(3, -1, 3).mean(axis=2)
