"""Visibility of a light of spherical Gaussians: the share of its diffuse and specular radiance that reaches a point.

Closed-form shading (`sg.shading`) knows no shadows. Here the light's radiance l is also summed over K fixed directions
ω_k that stand for w_k steradians each, with and without those in which the scene blocks the light (b_k = 0). The closed
form is multiplied by the ratio of the two sums,

    V = Σ_k w_k l(ω_k) f(ω_k) (n·ω_k)₊ b_k / Σ_k w_k l(ω_k) f(ω_k) (n·ω_k)₊,

a colour, with f = 1 (diffuse) or the specular reflectance: the ratio estimator of Heitz, Hill and McGuire, "Combining
Analytic Direct Illumination and Stochastic Shadows" (2018). All points share the directions, so the sums are matrix
products. In a blocked direction the point sees another surface. It is assumed to face the point and to reflect the
light diffusely; this one bounce is kept apart, to be multiplied by the albedo of that surface.

Which directions are unoccluded depends on the geometry alone: they are traced once and serve any light.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from sira_mi.conventions import LUMINANCE
from sira_mi.fields.columns import in_three, to_array, to_columns
from sira_mi.fields.directions import GOLDEN_ANGLE, fibonacci_directions
from sira_mi.sg import brdf
from sira_mi.sg.arrays import Bool, Float, TensorXf
from sira_mi.sg.integrals import sphere_integral
from sira_mi.sg.lobes import lobe_count, lobe_integral, unpack_lobe

# Directions in which `sira_sg` traces shadow rays, unless asked for others.
DEFAULT_DIRECTIONS = 64
# The sharpest lobe that K even directions over the sphere resolve, as a share of K.
_RESOLVED = 0.25
# Share of the light's energy that is added to both sums of a ratio, which is then 1 where there is no light.
_FLOOR = 1e-6
# Height above the surface at which shadow rays start, in spacings of the grid that the head's mesh is extracted on.
SHADOW_OFFSET = 0.2
# Rays of one launch.
_LAUNCH = 1 << 22


@dataclass(frozen=True, eq=False)
class Directions:
    """Directions of a quadrature over the sphere."""

    axis: np.ndarray  # [K, 3] unit
    weight: np.ndarray  # [K] steradians that each stands for
    even: int  # how many of them are spread evenly over the sphere
    resolved: float  # sharper lobes are summed as lobes of this sharpness and of the same energy


@dataclass(frozen=True, eq=False)
class Visibility:
    """How much of a light reaches some points, and what the surfaces that block the rest reflect onto them."""

    diffuse: TensorXf  # [3, N] unoccluded share of the irradiance
    specular: TensorXf | None  # [3, N] unoccluded share of the specular radiance; None without a specular term
    bounce_diffuse: TensorXf  # [3, N] irradiance from occluders, per unit of their albedo
    bounce_specular: TensorXf | None  # [3, N] specular radiance of their light, per unit of their albedo


def even_directions(count: int) -> Directions:
    """`count` directions that serve any light: a Fibonacci lattice. Shadows of lobes sharper than it resolves are
    blurred."""
    axis = fibonacci_directions(count)
    return Directions(axis, np.full(count, 4 * np.pi / count), count, _RESOLVED * count)


def light_directions(lobes: np.ndarray, count: int) -> Directions:
    """`count` directions for the light `lobes` [N_l, 7]: half of them even, half drawn from the lobes in proportion to
    their energy, without randomness. Every direction stands for the inverse of the joint density (balance heuristic),
    so that sharp lobes cast sharp shadows."""
    even = count // 2
    drawn, energy = _spread_over_lobes(np.asarray(lobes, np.float64), count - even)
    axis = np.concatenate([fibonacci_directions(even), drawn])
    density = even / (4 * np.pi) + (count - even) * _mixture_density(lobes.astype(np.float64), energy, axis)
    return Directions(axis, 1 / density, even, math.inf)


def _lobe_frames(lobes):
    """Unit axes [N_l, 3] and two unit vectors orthogonal to each."""
    axis = lobes[:, :3] / np.linalg.norm(lobes[:, :3], axis=1, keepdims=True)
    other = np.where(np.abs(axis[:, :1]) > 0.7, [[0.0, 1.0, 0.0]], [[1.0, 0.0, 0.0]])
    first = np.cross(axis, other)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return axis, first, np.cross(axis, first)


def _spread_over_lobes(lobes, count):
    """`count` directions [count, 3], spirals through equal shares of the lobes' energy; and the shares [N_l]."""
    sharpness = np.maximum(lobes[:, 3], 1e-6)
    energy = (lobes[:, 4:] @ LUMINANCE) * lobe_integral(sharpness)
    energy = np.full(len(lobes), 1 / len(lobes)) if energy.sum() <= 0 else energy / energy.sum()
    place = (np.arange(count) + 0.5) / count
    ends = np.cumsum(energy)
    lobe = np.minimum(np.searchsorted(ends, place, side="right"), len(lobes) - 1)
    share = np.clip((place - (ends - energy)[lobe]) / np.maximum(energy[lobe], 1e-12), 0, 1 - 1e-9)
    gap = np.clip(-np.log1p(share * np.expm1(-2 * sharpness[lobe])) / sharpness[lobe], 0, 2)
    sine, azimuth = np.sqrt(gap * (2 - gap)), GOLDEN_ANGLE * np.arange(count)
    axis, first, second = (frame[lobe] for frame in _lobe_frames(lobes))
    across = np.cos(azimuth)[:, None] * first + np.sin(azimuth)[:, None] * second
    return (1 - gap)[:, None] * axis + sine[:, None] * across, energy


def _mixture_density(lobes, energy, direction):
    """Density per steradian [K] of `direction` [K, 3] in the mixture of lobes with the shares `energy`."""
    sharpness = np.maximum(lobes[:, 3], 1e-6)
    cosine = direction @ _lobe_frames(lobes)[0].T
    return np.exp(sharpness * np.minimum(cosine - 1, 0)) @ (energy / lobe_integral(sharpness))


def trace_unoccluded(
    scene: mi.Scene, point: np.ndarray, normal: np.ndarray, directions: np.ndarray, offset: float
) -> np.ndarray:
    """Whether nothing of the scene lies in each of `directions` [K, 3] from points [3, N] with unit normals [3, N]:
    bool [K, N]. Directions below the surface count as unoccluded. Rays start `offset` scene units above the surface and
    advance as far again, so that a mesh close to the surface does not block its own points."""
    count, axis = point.shape[1], mi.Float(np.ascontiguousarray(directions, np.float32).ravel())
    start = [mi.Vector3f(np.ascontiguousarray(v, np.float32)) for v in (point + offset * normal, normal)]
    step = max(1, _LAUNCH // max(count, 1))
    parts = []
    coherent: Any = False  # the stubs want an array
    with dr.suspend_grad():
        for first in range(0, len(directions), step):
            rows = min(step, len(directions) - first)
            lane = dr.arange(mi.UInt32, rows * count)
            column, row = lane % count, first + lane // count
            direction = mi.Vector3f(*(dr.gather(mi.Float, axis, 3 * row + k) for k in range(3)))
            origin, up = (dr.gather(mi.Vector3f, v, column) for v in start)
            ray = mi.Ray3f(mi.Point3f(origin + offset * direction), direction)
            above: Bool = dr.dot(up, direction) > 0.0
            parts.append((~(above & scene.ray_test(ray, coherent, above))).numpy().reshape(rows, count))
    return np.concatenate(parts)


def light_radiance(lobes: TensorXf, directions: Directions) -> TensorXf:
    """Radiance [3, K] of `lobes` [N_l, 7] in the directions, lobes widened to what the directions resolve; multiplied
    by the steradians of each. Differentiable, without atomics."""
    count = lobe_count(lobes)
    axis, sharpness, amplitude = unpack_lobe(lobes.array, dr.arange(mi.UInt32, count))
    if math.isfinite(directions.resolved):
        wide = dr.minimum(sharpness, directions.resolved)
        amplitude = amplitude * (sphere_integral(sharpness) / sphere_integral(wide))
        sharpness = wide
    ones = dr.full(mi.TensorXf, 1.0, (1, len(directions.axis)))
    axes: Float = dr.ravel(axis)
    cosine = mi.TensorXf(axes, (count, 3)) @ to_array(directions.axis.T)
    exponent = (mi.TensorXf(sharpness, (count, 1)) @ ones) * dr.minimum(cosine - 1.0, 0.0)
    return (to_columns(amplitude) @ dr.exp(exponent)) * _in_rows(directions.weight, 3)


def light_visibility(
    normals: TensorXf,
    views: TensorXf,
    specular_albedo: TensorXf | None,
    roughness: Float,
    lobes: TensorXf,
    directions: Directions,
    unoccluded: TensorXf,
) -> Visibility:
    """Visibility of the light `lobes` [N_l, 7] at points with unit normals and unit views (from the camera to the
    point) [3, N] and specular albedo [1, N], None without a specular term; `unoccluded` [K, N], 0 or 1, says in which
    of the directions nothing blocks the light.

    Differentiable in all but `unoccluded`; gradients have the same bits on every run."""
    light, axis = light_radiance(lobes, directions), to_array(directions.axis)
    cosine = axis @ normals
    light_cosine = dr.maximum(cosine, 0.0)
    diffuse, bounce_diffuse = _sums(light, directions, cosine, light_cosine, unoccluded)
    if specular_albedo is None:
        return Visibility(diffuse, None, bounce_diffuse, None)

    outgoing, ones = -views, dr.full(mi.TensorXf, 1.0, (len(directions.axis), 1))
    view_cosine = dr.full(mi.TensorXf, 1.0, (1, 3)) @ (normals * outgoing)
    # Flat arrays, in which a roughness of one entry needs no broadcast of tensors, whose adjoint would be atomic.
    rough = dr.maximum(mi.Float(roughness), (2.0 / directions.even) ** 0.25)
    half = dr.sqrt(dr.maximum(2.0 + 2.0 * (axis @ outgoing).array, 1e-6))
    gap = dr.maximum(1.0 - (cosine + ones @ view_cosine).array / half, 0.0)
    reflectance = brdf.distribution(gap, rough) * brdf.fresnel((ones @ specular_albedo).array, 0.5 * half)
    reflectance *= brdf.masking(light_cosine.array, rough) * light_cosine.array
    weight = mi.TensorXf(reflectance, cosine.shape)
    specular, bounce_specular = _sums(light, directions, cosine, weight, unoccluded)
    masking = 0.25 * brdf.masking(dr.maximum(view_cosine.array, 0.0), rough)
    masking = mi.TensorXf(dr.select(view_cosine.array > 0.0, masking, 0.0), view_cosine.shape)
    return Visibility(diffuse, specular, bounce_diffuse, bounce_specular * in_three(masking))


def _sums(light, directions, cosine, weight, unoccluded):
    """Unoccluded share [3, N] of `light` [3, K] under weights [K, N], and the weighted sum [3, N] of what occluders
    reflect, per unit of their albedo.

    The surface seen in a blocked direction ω_k receives light from ω_l by (−ω_k·ω_l)₊, for which its expansion to first
    order, ¼ − ½ ω_k·ω_l, is summed over k first and then cut at 0. Light from below the point's own horizon mostly does
    not reach its neighbours either: it fades with 1 + n·ω_l."""
    floor = dr.detach(dr.sum(light, axis=None)) * _FLOOR + 1e-20
    open_weight = weight * unoccluded
    share = (light @ open_weight + floor) / (light @ weight + floor)
    moments = np.concatenate([0.25 * directions.weight[None], -0.5 * directions.weight * directions.axis.T])
    onto = np.concatenate([np.ones((1, len(directions.axis))), directions.axis.T])
    incident = dr.maximum(to_array(onto.T) @ (to_array(moments) @ (weight - open_weight)), 0.0)
    fading = dr.minimum(1.0 + cosine, 1.0)
    return share, (light @ (incident * fading)) * (1 / math.pi)


def _in_rows(array, rows):
    return to_array(np.repeat(array[None], rows, axis=0))
