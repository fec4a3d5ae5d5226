"""Rays against signed distance fields: the hits against dense bisection of the same field in float64.

Heads are traced as the integrators trace them: the mesh's hit, then Newton steps on the field. Gradients are those of
the hit by the reference network and the latent. Thin features are fields made by hand and traced from a start beside
them, as the mesh shows only what its grid (`voxel`, 5 mm) meets."""

from __future__ import annotations

import dataclasses
import functools
import tempfile
from pathlib import Path
from unittest import mock

import drjit as dr
import mitsuba as mi
import numpy as np

from sira_mi.avatar.file import load_avatar, save_avatar
from sira_mi.conventions import DOMAIN_LOWER, DOMAIN_UPPER, MILLIMETRES_PER_UNIT
from sira_mi.fields import tracing
from sira_mi.fields.columns import to_array
from sira_mi.fields.extraction import EmptySurfaceError
from sira_mi.fields.mlp import SOFTPLUS_SHARPNESS
from sira_mi.fields.sdf import SdfField
from studies.stability import cases
from studies.stability.double import single
from studies.stability.fields64 import Field64, box_interval
from studies.stability.rows import Row, count_non_finite, largest

# mm: how far a hit may lie from the surface.
HIT = 0.01
# Rays at a smaller cosine to the normal graze the surface: their crossings say little about how far off it a hit is.
_TANGENT = 0.1
# Crossings near a hit are searched this far to either side (scene units), in as many samples.
_WINDOW, _WINDOW_SAMPLES = 0.02, 30
_NOWHERE = 1e9
_HALF_THICKNESS = 0.004  # scene units, of sheets and threads: 0.8 mm in all


# Heads


def _change(avatar, scale: float = 1.0, offset: float = 0.0, sigma: float = 0.0, seed: int = 0):
    """An avatar whose field is `scale` times the given one's plus `offset`, at `sigma` deviations of the latent."""
    tensors = {name: value.copy() for name, value in avatar.tensors.items()}
    last = avatar.architecture.networks["reference"].width + 1
    tensors["reference"][-last:] *= scale
    tensors["reference"][-1] += offset
    if sigma:
        noise = np.random.default_rng(seed).standard_normal(tensors["z_sdf"].shape)
        tensors["z_sdf"] = (sigma * noise).astype(np.float32)
    return dataclasses.replace(avatar, tensors=tensors)


def _load_head(avatar, voxel: float):
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "avatar.safetensors"
        save_avatar(path, avatar)
        head = {"type": "neural_sdf", "avatar": str(path), "voxel": voxel, "bsdf": {"type": "diffuse"}}
        return mi.load_dict({"type": "scene", "head": head})


@functools.cache
def _scene(quick: bool, **change):
    """A scene of the shipped prior's head, changed; extracted on a coarse grid for the quick version."""
    return _load_head(_change(load_avatar(), **change), 0.2 if quick else 0.05)


def _head(scene):
    from sira_mi.plugins.neural_sdf import find_head

    return find_head(scene, "stability")


# Rays: origins and directions [3, n], as single precision holds them


def _round_rays(origin: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return single(origin), single(cases.normalise(direction))


def draw_camera_rays(rng: np.random.Generator, count: int, distance: float, degrees: float):
    """From all around at `distance` (scene units) from the origin, through a square lens of `degrees`."""
    back = cases.draw_directions(rng, count)
    right = cases.draw_perpendicular(rng, back)
    up = np.cross(back.T, right.T).T
    x, y = np.tan(np.radians(degrees) / 2.0) * rng.uniform(-1.0, 1.0, (2, count))
    return _round_rays(distance * back, -back + x * right + y * up)


def draw_inner_rays(rng: np.random.Generator, count: int):
    """From points inside the head."""
    return _round_rays(rng.uniform(-0.4, 0.4, (3, count)), cases.draw_directions(rng, count))


def draw_tangent_rays(rng: np.random.Generator, count: int, scene):
    """Past points of the surface, at right angles to the normal, up to 0.1 mm inside or outside."""
    field = Field64.of(_head(scene).field())
    vertices = _head(scene).vertices().astype(np.float64)
    on_surface = vertices[:, np.abs(field.value(vertices)) < 1e-4]
    x = on_surface[:, rng.integers(0, on_surface.shape[1], count)]
    normal = cases.normalise(field.gradient(x))
    along = cases.draw_perpendicular(rng, normal)
    return _round_rays(x + rng.uniform(-1e-3, 1e-3, count) * normal - 6.0 * along, along)


# Measures


def measure_hit_errors(field: Field64, origin, direction, t) -> np.ndarray:
    """Distance in mm of hits t [N] from the surface: from the plane that touches it at the ray's nearest crossing, or,
    for rays that graze it or touch it without a crossing between samples, |f| / |∇f|."""
    samples = t + np.linspace(-_WINDOW, _WINDOW, 2 * _WINDOW_SAMPLES + 1)[:, None]
    ray, crossing = field.crossings(origin, direction, samples)
    nearest = np.full(t.size, np.inf)
    np.minimum.at(nearest, ray, np.abs(crossing - t[ray]))
    x = origin + t * direction
    gradient = field.gradient(x)
    length = np.linalg.norm(gradient, axis=0)
    cosine = np.abs((gradient * direction).sum(axis=0)) / length
    off_surface = np.abs(field.value(x)) / length
    along = (cosine >= _TANGENT) & (nearest < np.inf)
    return MILLIMETRES_PER_UNIT * np.where(along, cosine * nearest, off_surface)


@dataclasses.dataclass(frozen=True)
class Traced:
    """What tracing rays against a head gave."""

    hits: int
    error: float  # mm, of the worst hit
    non_finite: int
    gradients_finite: bool


def _trace_head(scene, origin, direction) -> tuple[np.ndarray, np.ndarray]:
    """Ray parameters [N] and whether there is a hit [N], as the integrators have them."""
    from sira_mi.plugins.neural_sdf import trace_head

    ray = mi.Ray3f(mi.Point3f(origin), mi.Vector3f(direction))
    t, hit = (value.numpy() for value in trace_head(scene, _head(scene), ray, mi.Bool(True)))
    return t.astype(np.float64), hit


def _trace_and_score(scene, origin, direction) -> Traced:
    t, hit = _trace_head(scene, origin, direction)
    arguments = origin[:, hit], direction[:, hit], t[hit]
    errors = measure_hit_errors(Field64.of(_head(scene).field()), *arguments)
    finite = _are_hit_gradients_finite(_head(scene), *arguments)
    return Traced(int(hit.sum()), largest(errors), count_non_finite(t[hit]), finite)


def count_wrong_hits(scene, origin, direction, step: float) -> int:
    """Rays that have a hit more than 2 mm from the field's first crossing, a hit where there is no crossing, or no hit
    where there is one. Rays that enter the box within the solid are left out. Samples are `step` apart."""
    t, hit = _trace_head(scene, origin, direction)
    field = Field64.of(_head(scene).field())
    near, far = box_interval(origin, direction)
    length = np.linalg.norm(np.array(DOMAIN_UPPER) - DOMAIN_LOWER)
    ray, crossing = field.crossings(
        origin, direction, near + np.linspace(0.0, 1.0, int(length / step))[:, None] * (far - near)
    )
    first = np.full(t.size, _NOWHERE)
    np.minimum.at(first, ray, crossing)
    differs = np.abs(np.where(hit, t, _NOWHERE) - first) > 2.0 / MILLIMETRES_PER_UNIT
    return int((differs & (field.value(origin + near * direction) > 0.0)).sum())


def _are_hit_gradients_finite(head, origin, direction, t) -> bool:
    """Whether the derivatives of the hits by the reference network and the latent are finite."""
    before, keys = dict(head.parameters), ("reference", "z_sdf")
    for key in keys:
        head.parameters[key] = mi.Float(before[key])
        dr.enable_grad(head.parameters[key])
    columns = [to_array(a) for a in (origin, direction, t[None])]
    dr.backward(dr.sum(tracing.differentiable_hit(head.field(), *columns), axis=None))
    finite = all(count_non_finite(dr.grad(head.parameters[key]).numpy()) == 0 for key in keys)
    head.parameters |= before
    return finite


def _count(quick: bool) -> int:
    return 60 if quick else 1500


def _measure_hits(name: str, scene, rays: tuple[np.ndarray, np.ndarray]) -> Row:
    """Distance of every hit from the surface of the same field in float64, as `measure_hit_errors`."""
    traced = _trace_and_score(scene, *rays)
    return Row(name, "mm", traced.hits, traced.error, HIT, traced.non_finite, traced.gradients_finite)


def _measure_portrait(quick: bool, name: str, **change) -> Row:
    """Rays of a portrait lens, 0.6 m away, against a changed head."""
    rays = draw_camera_rays(np.random.default_rng(31), _count(quick), 6.0, 40.0)
    return _measure_hits(name, _scene(quick, **change), rays)


def measure_plain_head(quick: bool) -> Row:
    return _measure_portrait(quick, "the prior's mean head, from 0.6 m")


def measure_steep_field(quick: bool) -> Row:
    """A gradient of length 10 instead of 1."""
    return _measure_portrait(quick, "the field times 10", scale=10.0)


def measure_flat_field(quick: bool) -> Row:
    """A gradient of length 0.1 instead of 1."""
    return _measure_portrait(quick, "the field times 0.1", scale=0.1)


def measure_extreme_latent(quick: bool) -> Row:
    """A normal sample, five times as long: no longer a head, but a field."""
    return _measure_portrait(quick, "latent at 5σ", sigma=5.0, seed=1)


def measure_tangent_rays(quick: bool) -> Row:
    """Lines up to 0.1 mm above or below points of the surface."""
    scene = _scene(quick)
    return _measure_hits("tangent rays", scene, draw_tangent_rays(np.random.default_rng(32), _count(quick), scene))


def measure_inner_rays(quick: bool) -> Row:
    rays = draw_inner_rays(np.random.default_rng(33), _count(quick))
    return _measure_hits("camera inside the head", _scene(quick), rays)


def measure_far_camera(quick: bool) -> Row:
    """Ray parameters are 0.006 mm apart there in single precision."""
    rays = draw_camera_rays(np.random.default_rng(34), _count(quick), 1000.0, 1.0 / 4.0)
    return _measure_hits("camera at 100 m, within a 1° lens", _scene(quick), rays)


def measure_wide_lens(quick: bool) -> Row:
    rays = draw_camera_rays(np.random.default_rng(35), 2 * _count(quick), 2.6, 120.0)
    return _measure_hits("120° lens, 0.26 m from the centre", _scene(quick), rays)


def measure_wrong_surfaces(quick: bool) -> Row:
    """Rays whose hit is not within 2 mm of the field's first crossing in float64, that have a hit where there is no
    crossing, or the reverse. The mesh decides where a ray first meets the field, and at the outline it is off by a
    chord's height: the bound is 0.5% on the 5 mm grid, 2% on the 20 mm grid of the quick version."""
    scene, rng, count = _scene(quick), np.random.default_rng(36), _count(quick)
    rays = [draw_camera_rays(rng, count, *lens) for lens in ((6.0, 40.0), (1000.0, 0.25))]
    step = 0.1 if quick else 0.04
    wrong = sum(count_wrong_hits(scene, origin, direction, step) for origin, direction in rays)
    return Row(
        "rays that hit another surface, or none",
        "of the rays",
        2 * count,
        wrong / (2 * count),
        0.02 if quick else 0.005,
        0,
    )


# Fields made by hand


def _softplus(x: float) -> float:
    return float(np.logaddexp(0.0, SOFTPLUS_SHARPNESS * x) / SOFTPLUS_SHARPNESS)


def _field(weights: list, biases: list, outer: list, offset: float) -> SdfField:
    """f = Σ outer · softplus(weights x + biases) + offset, without deformation or encoding."""
    tensor = lambda values: mi.TensorXf(np.array(values, np.float32))  # noqa: E731
    column = lambda values: tensor(values).numpy().reshape(-1, 1)  # noqa: E731
    nothing = [(tensor(np.zeros((4, 3))), tensor(np.zeros((4, 1))))]
    layers = [(tensor(weights), mi.TensorXf(column(biases))), (tensor([outer]), tensor([[offset]]))]
    return SdfField(nothing, layers, 0)


def _sheet() -> SdfField:
    """A plane sheet, 0.8 mm thick, normal to (0.6, 0, 0.8); its gradient is 0 in the middle and 0.2 on its faces."""
    normal = np.array([0.6, 0.0, 0.8])
    rim = _softplus(_HALF_THICKNESS) + _softplus(-_HALF_THICKNESS)
    return _field([normal, -normal], [0.0, 0.0], [1.0, 1.0], -rim)


def _thread() -> SdfField:
    """A thread along y, about 0.8 mm thick."""
    rim = _softplus(_HALF_THICKNESS) + _softplus(-_HALF_THICKNESS) + 2.0 * _softplus(0.0)
    return _field([[1, 0, 0], [-1, 0, 0], [0, 0, 1], [0, 0, -1]], [0.0] * 4, [1.0] * 4, -rim)


def _plateau() -> SdfField:
    """0.1 outside of x = 0, where the gradient is exactly zero, and falling behind it: the surface lies at x = −0.1."""
    return _field([[-1.0, 0.0, 0.0]], [0.0], [-1.0], _softplus(0.1))


def _measure_hand_made(name: str, field: SdfField, origin, direction, start, found: float) -> Row:
    """Rays that all meet the field, traced from `start` [n]; finding less than a share of `found` is an infinite
    error."""
    columns = [np.ascontiguousarray(a, np.float32) for a in (origin, direction, start[None])]
    t, f = tracing.refine_hits(field, *columns)
    hit = np.abs(f[0]) < tracing.HIT_TOLERANCE
    reference = Field64.of(field)
    o, d = (c.astype(np.float64)[:, hit] for c in columns[:2])
    errors = measure_hit_errors(reference, o, d, t[0, hit].astype(np.float64))
    dr.enable_grad(field.reference[0][0], field.reference[1][0])
    hits = [to_array(c[:, hit]) for c in (*columns[:2], t)]
    dr.backward(dr.sum(tracing.differentiable_hit(field, *hits), axis=None))
    finite = all(count_non_finite(dr.grad(layer[0]).numpy()) == 0 for layer in field.reference)
    share = float(hit.mean())
    error = largest(errors) if share >= found else np.inf
    note = f"found by {100 * share:.1f}% of the rays"
    return Row(name, "mm", hit.size, error, HIT, count_non_finite(t[:, hit], f), finite, note)


def _measure_thin(quick: bool, name: str, field: SdfField, normal: np.ndarray, found: float) -> Row:
    """Traced from starts up to 5 mm in front of the feature."""
    rng, count = np.random.default_rng(37), 300 if quick else 5000
    target = rng.uniform(-1.0, 1.0, (3, count))
    target -= normal * (normal * target).sum(axis=0)
    if field.reference[0][0].shape[0] == 4:
        target *= np.array([[0.0], [1.0], [0.0]])
    origin = 6.0 * cases.draw_directions(rng, count)
    direction = target - origin
    steep = np.abs((cases.normalise(direction) * normal).sum(axis=0)) > 0.2
    origin, direction = _round_rays(origin[:, steep], direction[:, steep])
    start = np.linalg.norm(target[:, steep] - origin, axis=0) - rng.uniform(0.0, 0.05, int(steep.sum()))
    return _measure_hand_made(name, field, origin, direction, start, found)


def measure_thin_sheet(quick: bool) -> Row:
    """Gradients of length 0.2 on the faces, 0 in the middle."""
    return _measure_thin(quick, "a sheet 0.8 mm thick", _sheet(), np.array([[0.6], [0.0], [0.8]]), 0.9)


def measure_thin_thread(quick: bool) -> Row:
    """Rays towards its axis."""
    return _measure_thin(quick, "a thread 0.8 mm thick", _thread(), np.array([[0.0], [0.0], [1.0]]), 0.9)


def measure_zero_gradient(quick: bool) -> Row:
    """The field is constant where the rays start: Newton steps have no slope to follow."""
    rng, count = np.random.default_rng(38), 300 if quick else 5000
    target = np.concatenate([np.full((1, count), -0.1), rng.uniform(-1.0, 1.0, (2, count))])
    direction = cases.normalise(np.stack([np.full(count, -1.0), *rng.uniform(-1.0, 1.0, (2, count))]))
    distance = (0.1 + rng.uniform(0.02, 0.2, count)) / -direction[0]
    origin, direction = _round_rays(target - 6.0 * direction, direction)
    return _measure_hand_made("starts of zero gradient", _plateau(), origin, direction, 6.0 - distance, 0.99)


def count_evaluations(quick: bool) -> Row:
    """Mean over the rays of an empty field (5 everywhere), the sheet, the thread or the plateau, whichever is largest.
    The longest way of a ray: Newton steps, the whole search, Newton steps again; all rays step together."""
    count = 1024  # a size that chunks are not filled up to
    rng = np.random.default_rng(39)
    origin, direction = rng.standard_normal((3, count)), cases.draw_directions(rng, count)
    columns = origin.astype(np.float32), direction.astype(np.float32), np.ones((1, count), np.float32)
    calls, bad = 0.0, 0
    for field in (_field([[0.0] * 3], [0.0], [0.0], 5.0), _sheet(), _thread(), _plateau()):
        with (
            mock.patch.object(tracing, "signed_distance", wraps=tracing.signed_distance) as value,
            mock.patch.object(tracing, "signed_distance_and_slope", wraps=tracing.signed_distance_and_slope) as slope,
        ):
            t, f = tracing.refine_hits(field, *columns)
        columns_evaluated = sum(call.args[1].shape[1] for spy in (value, slope) for call in spy.call_args_list)
        calls = max(calls, columns_evaluated / count)
        bad += count_non_finite(t, f)
    return Row(
        "evaluations of the field for one ray",
        "evaluations",
        4 * count,
        calls,
        tracing.MAXIMUM_EVALUATIONS,
        bad,
    )


def count_hits_of_empty_sets(quick: bool) -> Row:
    """Heads without a surface that are not refused by name, and rays that hit a field of 5 everywhere."""
    refused, offsets = 0, (20.0, 1e3, 1e6)
    for offset in offsets:
        try:
            _load_head(_change(load_avatar(), offset=offset), 0.2)
        except Exception as error:
            refused += EmptySurfaceError.__name__ in repr(error) or "no surface" in str(error)
    field = _field([[0.0] * 3], [0.0], [0.0], 5.0)
    rng, count = np.random.default_rng(40), 1000
    origin, direction = draw_camera_rays(rng, count, 6.0, 40.0)
    columns = origin.astype(np.float32), direction.astype(np.float32), np.full((1, count), 6.0, np.float32)
    t, f = tracing.refine_hits(field, *columns)
    return Row(
        "empty zero sets",
        "heads and rays",
        len(offsets) + count,
        len(offsets) - refused + int((np.abs(f) < tracing.HIT_TOLERANCE).sum()),
        0.0,
        count_non_finite(t, f),
    )


MEASURES = (
    measure_plain_head,
    measure_steep_field,
    measure_flat_field,
    measure_extreme_latent,
    measure_tangent_rays,
    measure_inner_rays,
    measure_far_camera,
    measure_wide_lens,
    measure_wrong_surfaces,
    measure_thin_sheet,
    measure_thin_thread,
    measure_zero_gradient,
    count_evaluations,
    count_hits_of_empty_sets,
)
