"""Rays against a signed distance field: exact hits by Newton steps, closest approaches, implicit differentiation.

Rays start from a proxy (a mesh hit or a distance grid), so that the field itself is evaluated only a few times a ray.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from sira_mi.conventions import DOMAIN_LOWER
from sira_mi.fields.columns import CHUNK, evaluate_in_chunks, in_three
from sira_mi.fields.sdf import SdfField, signed_distance, signed_distance_and_slope

# A hit counts as exact when |f| is below this many scene units: within 0.01 mm of the surface where the gradient has a
# fifth of its typical length or more.
HIT_TOLERANCE = 1.5e-5
_MAXIMUM_STEP = 0.15
_MINIMUM_SLOPE = 0.02
# The search of `first_crossings`, in scene units along the ray from the proxy's hit.
_SEARCH_START, _SEARCH_STEP, _SEARCH_SAMPLES = -0.24, 0.03, 64
# Rays whose samples are evaluated at once.
_SEARCH_RAYS = CHUNK // _SEARCH_SAMPLES
_NO_CROSSING = 1e9
# Where rays without a crossing are evaluated, scene units.
_FAR = 1e4
_ITERATIONS = 4
# Evaluations of the field that a ray takes in `refine_hits`; three of them carry the slope along.
MAXIMUM_EVALUATIONS = 3 * (1 + _ITERATIONS) + _SEARCH_SAMPLES


def on_ray(origin, direction, t):
    """Points o + t v [3, N] of rays at t [1, N]. In Dr.Jit 1.5 a plain product with an unevaluated tensor [1, 1] widens
    that tensor itself, which a single ray would meet."""
    return origin + in_three(t) * direction


def newton_hits(field: SdfField, origin, direction, t, iterations: int = _ITERATIONS):
    """Moves ray parameters t [1, N] onto the field's surface by Newton steps along the ray. The slope ∇f·v is evaluated
    once, at the start; secants improve it after that. `origin` and `direction` are [3, N].

    Returns (t [1, N], f at t [1, N]); rays whose |f| stays above `HIT_TOLERANCE` have no hit near their start.
    Without gradients."""
    with dr.suspend_grad():
        f, slope = signed_distance_and_slope(field, on_ray(origin, direction, t), direction)
        for _ in range(iterations):
            safe = dr.select(dr.abs(slope) < _MINIMUM_SLOPE, dr.copysign(_MINIMUM_SLOPE, slope), slope)
            step = dr.minimum(dr.maximum(-f / safe, -_MAXIMUM_STEP), _MAXIMUM_STEP)
            step = dr.select(dr.abs(f) < 0.5 * HIT_TOLERANCE, 0.0, step)
            t_new = t + step
            f_new = signed_distance(field, on_ray(origin, direction, t_new))
            secant = (f_new - f) / dr.select(step == 0.0, 1.0, step)
            slope = dr.select((step == 0.0) | (dr.abs(secant) < _MINIMUM_SLOPE), slope, secant)
            t, f = t_new, f_new
            dr.eval(t, f, slope)
        return t, f


def first_crossings(field: SdfField, origin: np.ndarray, direction: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Where rays [3, N] first go from outside to inside near t [1, N]: ray parameters [1, N], interpolated linearly
    between even samples that start a little before t and end well behind it; `_NO_CROSSING` where they do not."""
    at = t.T + np.float32(_SEARCH_START) + np.float32(_SEARCH_STEP) * np.arange(_SEARCH_SAMPLES, dtype=np.float32)
    f = np.empty_like(at)
    for first in range(0, len(at), _SEARCH_RAYS):
        some = slice(first, first + _SEARCH_RAYS)
        points = origin[:, some, None] + at[some] * direction[:, some, None]
        (found,) = evaluate_in_chunks(lambda x: signed_distance(field, x), points.reshape(3, -1))
        f[some] = found.reshape(-1, _SEARCH_SAMPLES)
    enters = (f[:, :-1] > 0) & (f[:, 1:] <= 0)
    ray, sample = np.arange(len(at)), enters.argmax(axis=1)
    before, after = f[ray, sample], f[ray, sample + 1]
    with np.errstate(divide="ignore", invalid="ignore"):
        crossing = at[ray, sample] + np.float32(_SEARCH_STEP) * before / (before - after)
    return np.where(enters.any(axis=1), crossing, np.float32(_NO_CROSSING))[None]


def with_unit_gradient(field: SdfField, length: float) -> SdfField:
    """The field divided by `length`, its gradient's typical length at the surface: |f| becomes a distance."""
    weight, bias = field.reference[-1]
    return replace(field, reference=[*field.reference[:-1], (weight / length, bias / length)])


def refine_hits(field: SdfField, origin: np.ndarray, direction: np.ndarray, t: np.ndarray) -> list[np.ndarray]:
    """`newton_hits` of rays [3, N] from parameters t [1, N], with two more tries. Rays that miss take as many steps
    again from where they are, which helps at thin features. Those that still miss start anew at their first crossing
    near t. A ray evaluates the field at most `MAXIMUM_EVALUATIONS` times."""

    def newton(*columns):
        return evaluate_in_chunks(lambda o, d, t: newton_hits(field, o, d, t), *columns)

    result = newton(origin, direction, t)
    for search in (False, True):
        stray = np.flatnonzero(~(np.abs(result[1][0]) < HIT_TOLERANCE))
        if not len(stray):
            break
        o, d, start = (c[:, stray] for c in (origin, direction, t if search else result[0]))
        if search:
            start = first_crossings(field, o, d, start)
        for whole, part in zip(result, newton(o, d, np.minimum(start, _FAR)), strict=True):
            whole[:, stray] = part
    return result


def differentiable_hit(field: SdfField, origin, direction, t):
    """The exact hit [3, N] at ray parameters t [1, N], with its derivative in the field's parameters θ: o + t(θ) v,
    t(θ) = t₀ − (f(x₀; θ) − f(x₀; θ₀)) / (∇f·v) (IDR, Yariv et al. 2020)."""
    x = on_ray(origin, direction, t)
    f, slope = signed_distance_and_slope(field, x, direction)
    slope = dr.detach(slope)
    safe = dr.select(dr.abs(slope) < _MINIMUM_SLOPE, dr.copysign(_MINIMUM_SLOPE, slope), slope)
    return x - direction * in_three((f - dr.detach(f)) / safe)


@dataclass(frozen=True)
class DistanceGrid:
    """Signed distances on a grid that starts at the domain's lower corner, interpolated trilinearly."""

    values: mi.Float
    shape: tuple[int, int, int]
    spacing: float  # scene units

    @staticmethod
    def of(grid: np.ndarray, spacing: float) -> DistanceGrid:
        """From an array [nx, ny, nz]."""
        return DistanceGrid(mi.Float(np.ascontiguousarray(grid, np.float32).ravel()), grid.shape, spacing)

    def __call__(self, p, active):
        """Signed distance at points p (Point3f); outside the grid, that of the nearest point on its border."""
        q = (p - mi.Point3f(*DOMAIN_LOWER)) / self.spacing
        cell, fraction = [], []
        for c, n in zip(q, self.shape, strict=True):
            c = dr.clip(c, 0.0, n - 1.0)
            i = dr.minimum(mi.UInt32(c), n - 2)
            cell.append(i)
            fraction.append(c - mi.Float(i))
        _, ny, nz = self.shape
        result = mi.Float(0)
        for dx in (0, 1):
            for dy in (0, 1):
                for dz in (0, 1):
                    index = ((cell[0] + dx) * ny + cell[1] + dy) * nz + cell[2] + dz
                    weight = 1.0
                    for f, d in zip(fraction, (dx, dy, dz), strict=True):
                        weight = weight * (f if d else 1.0 - f)
                    result += weight * dr.gather(mi.Float, self.values, index, active)
        return result


def closest_approach(grid: DistanceGrid, origin, direction, t_near, t_far, active, samples: int = 64):
    """The ray parameter (Float) between `t_near` and `t_far` at which the grid's signed distance is smallest:
    `samples` even samples, then as many within the best interval on both sides."""

    def smallest(t_near, t_far):
        step = (t_far - t_near) / (samples - 1)

        def body(i, best, t_best):
            t = t_near + step * mi.Float(i)
            f = grid(origin + direction * t, active)
            better = f < best
            return i + 1, dr.select(better, f, best), dr.select(better, t, t_best)

        state = (mi.UInt32(0), mi.Float(dr.inf), mi.Float(t_near))
        _, _, t = dr.while_loop(state, lambda i, best, t_best: i < samples, body, mode="symbolic")
        return t, step

    t, step = smallest(t_near, t_far)
    t, _ = smallest(dr.maximum(t - step, t_near), dr.minimum(t + step, t_far))
    return t


def refine_approach(field: SdfField, origin, direction, t, step: float):
    """Ray parameters [1, N] of closest approaches near t: the vertices of parabolas through the field at t and `step`
    (scene units) to either side, moved by no more than that. Rays are [3, N]. Without gradients."""
    with dr.suspend_grad():
        behind, middle, ahead = (signed_distance(field, on_ray(origin, direction, t + k * step)) for k in (-1, 0, 1))
        curvature = dr.maximum(behind - 2.0 * middle + ahead, 1e-6)
        shift = 0.5 * step * (behind - ahead) / curvature
        return t + dr.minimum(dr.maximum(shift, -step), step)
