"""The specular reflectance at a shading point as lobes of light directions, and its integral against a light lobe.

PhySG warps the normal distribution to one round lobe around the mirror direction. The reflectance times the light's
cosine, however, is elongated, cut off at the horizon and, for rough surfaces seen at an angle, displaced. Here it is
split into two parts (F = s + (1 − s) P: F = 1 and F = P), each a lobe that is narrower across the plane of incidence,

    L(ω) = μ exp(ν (ω·a − 1) − κ (ω·b)²) (ω·n)₊,   b = n × v,

with the part's exact integral over the hemisphere. The axis a, ν and κ are tabulated by view cosine and roughness. The
round factor times a light lobe is again a lobe. For a direction drawn from it, ω·b and ω·n have known means; taking
them as normally distributed gives the integral of the other two factors.

Lights sharper than the reflectance resolve its true shape, so the result is multiplied by (f^s / L)^w, with f^s and L
at the mean direction of the integrand and w = (λ / (λ + τ))², τ tabulated too. Broad lights keep their energy; for
sharp ones the result tends to f^s × irradiance.
"""

import math
from typing import NamedTuple

import drjit as dr
import mitsuba as mi

from sira_mi.sg import brdf, specular_table
from sira_mi.sg.arrays import Float, Vector3f
from sira_mi.sg.integrals import clamped_mean, mean_over_sharpness, product, sphere_integral

# Range of the roughness in the tables; below it they scale with the width of the normal distribution.
MINIMUM_ROUGHNESS = 0.1
MAXIMUM_ROUGHNESS = 1.0
# A view below this cosine is shaded as if at it.
_MINIMUM_VIEW_COSINE = 1e-3
# x in the measures of how far a view of cosine c is from grazing: c (1 + x r²) / (c + x r²) in the tables, √(c² + x r⁴)
# for the mean cosine of view and half vectors.
_TABLE_GRAZING, _MEAN_GRAZING = 2.0, 0.2
# Share of the variance along a lobe's axis that is subtracted; some must remain for its root to be differentiable.
_AXIAL = 0.99
# Bound of the log of the reflectance relative to its lobe; reached far out in the tails only.
_MAXIMUM_CORRECTION = 6.0
# Log amplitude of no light.
_DARK = -1e4


class LobeShape(NamedTuple):
    """The tabulated quantities of a shading point; see `specular_table.py`."""

    white_energy: Float
    white_turn: Float
    white_sharpness: Float
    grazing_energy: Float
    grazing_turn: Float
    grazing_sharpness: Float
    across: Float
    half_point: Float


class SpecularLobes(NamedTuple):
    """A shading point as the integral against a light lobe needs it: the round factors of the lobes for F = 1 (white)
    and F = P (grazing), and their common sharpness κ across the plane of incidence and half point τ."""

    normal: Vector3f
    view: Vector3f
    roughness: Float
    across: Float
    half_point: Float
    white_axis: Vector3f
    white_sharpness: Float
    white_log_amplitude: Float
    grazing_axis: Vector3f
    grazing_sharpness: Float
    grazing_log_amplitude: Float


def _chebyshev(x, count):
    values = [1.0, x]
    while len(values) < count:
        values.append(2.0 * x * values[-1] - values[-2])
    return values


def table_variables(cosine: Float, roughness: Float) -> tuple[Float, Float]:
    """The variables of the tables, each from −1 to 1, at a view cosine and a roughness."""
    scale = _TABLE_GRAZING * dr.square(roughness)
    within = dr.clip(roughness, MINIMUM_ROUGHNESS, MAXIMUM_ROUGHNESS)
    middle, half_span = 0.5 * (MAXIMUM_ROUGHNESS + MINIMUM_ROUGHNESS), 0.5 * (MAXIMUM_ROUGHNESS - MINIMUM_ROUGHNESS)
    grazing = 2.0 * cosine * (1.0 + scale) / (cosine + scale) - 1.0
    return grazing, (within - middle) * (1.0 / half_span)


def shape_from_tables(cosine: Float, roughness: Float) -> LobeShape:
    """The tables at a view cosine in (0, 1] and a roughness."""
    variables = table_variables(cosine, roughness)
    cosine_terms, roughness_terms = (
        _chebyshev(x, count) for x, count in zip(variables, specular_table.TERMS, strict=True)
    )
    values = []
    for name in LobeShape._fields:
        table = getattr(specular_table, name.upper())
        rows = [sum(a * t for a, t in zip(row, roughness_terms, strict=True)) for row in table]
        values.append(sum(row * t for row, t in zip(rows, cosine_terms, strict=True)))
    return LobeShape(*values)


def mean_half_cosine(cosine: Float, roughness: Float) -> Float:
    """About the mean cosine of view and half vectors, which stays away from 0 at grazing views."""
    return dr.sqrt(dr.square(cosine) + _MEAN_GRAZING * dr.square(dr.square(roughness)))


def log_energy(cosine: Float, roughness: Float) -> tuple[Float, Float]:
    """Log of about ∫ f^s (ω·n)₊ dω over the hemisphere for F = 1 and F = P, the limit for small roughness."""
    half = mean_half_cosine(cosine, roughness)
    white = 2.0 * dr.log(half * brdf.masking(half, roughness))
    return white, white + brdf.log_fresnel_weight(half)


def lobes_of_shape(
    normal: Vector3f, view: Vector3f, roughness: Float, shape: LobeShape, cosine: Float
) -> SpecularLobes:
    """The lobes of a given shape, for a view of that `cosine` above the surface."""
    sharpness = 0.25 * brdf.distribution_sharpness(roughness)
    mirror = 2.0 * cosine * normal - view
    across = 0.5 * sharpness * dr.exp(shape.across) / dr.square(mean_half_cosine(cosine, roughness))
    sine_square = dr.squared_norm(dr.cross(normal, view))
    lobes = []
    for part, energy in zip(("white", "grazing"), log_energy(cosine, roughness), strict=True):
        energy, turn, scale = (
            base + getattr(shape, f"{part}_{name}")
            for base, name in ((energy, "energy"), (0.0, "turn"), (0.0, "sharpness"))
        )
        axis = dr.normalize(mirror + dr.square(roughness) * turn * (cosine * mirror - normal))
        lobe_sharpness = sharpness * dr.exp(scale)
        mean, deviation, ratio = _moments(dr.dot(normal, axis), lobe_sharpness)
        unit = sphere_integral(lobe_sharpness) * deviation * clamped_mean(mean / deviation)
        narrowing = 1.0 + 2.0 * across * ratio * sine_square
        lobes += [axis, lobe_sharpness, energy - dr.log(unit) + 0.5 * dr.log(narrowing)]
    return SpecularLobes(normal, view, mi.Float(roughness), across, sharpness * dr.exp(shape.half_point), *lobes)


def specular_lobes(normal: Vector3f, view: Vector3f, roughness: Float) -> SpecularLobes:
    """The two lobes at a shading point with unit `normal` and `view`; dark where the view is below the surface."""
    cosine = dr.dot(normal, view)
    clipped = dr.clip(cosine, _MINIMUM_VIEW_COSINE, 1.0)
    roughness = mi.Float(roughness)
    lobes = lobes_of_shape(normal, view, roughness, shape_from_tables(clipped, roughness), clipped)
    white, grazing = (
        dr.select(cosine > 0.0, amplitude, _DARK)
        for amplitude in (lobes.white_log_amplitude, lobes.grazing_log_amplitude)
    )
    return lobes._replace(white_log_amplitude=white, grazing_log_amplitude=grazing)


def specular_integrals(lobes: SpecularLobes, axis: Vector3f, sharpness: Float) -> tuple[Float, Float]:
    """∫ exp(λ(ω·ξ − 1)) f^s (ω·n)₊ dω of one light lobe, for F = 1 and for F = P."""
    white = _integral(lobes, "white", axis, sharpness)
    return white, _integral(lobes, "grazing", axis, sharpness)


def _moments(cosine, sharpness):
    """Mean and deviation of ω·n for a direction drawn from a lobe with ξ·n = `cosine`, and the mean over ξ·n λ.

    The variance along the axis, exactly 1 − A² − 2A/λ, is that across it, A/λ, times about (λ + 4) / (λ² + λ + 4)."""
    ratio = mean_over_sharpness(sharpness)
    square = dr.square(sharpness)
    along = _AXIAL * square / (square + sharpness + 4.0)
    return ratio * sharpness * cosine, dr.sqrt(ratio * (1.0 - along * dr.square(cosine))), ratio


def _integral(lobes, part, axis, sharpness):
    lobe_axis, lobe_sharpness, lobe_amplitude = (
        getattr(lobes, f"{part}_{name}") for name in ("axis", "sharpness", "log_amplitude")
    )
    normal, view, roughness = lobes.normal, lobes.view, lobes.roughness
    joint_axis, joint_sharpness, exponent = product(lobe_axis, lobe_sharpness, axis, sharpness)
    mean, deviation, ratio = _moments(dr.dot(normal, joint_axis), joint_sharpness)
    across = dr.cross(normal, view)
    offset = ratio * joint_sharpness * dr.dot(across, joint_axis)
    narrowing = 1.0 + 2.0 * lobes.across * ratio * dr.squared_norm(across)
    pull = lobes.across * offset / narrowing
    # The mean of a normally distributed cosine that is weighed by its positive part, ½ (m + √(m² + 2π s²)).
    spread = math.pi * dr.square(deviation)
    cosine = dr.maximum(mean, 0.0) + spread / (dr.sqrt(dr.square(mean) + 2.0 * spread) + dr.abs(mean))
    centre = ratio * joint_sharpness * joint_axis - 2.0 * ratio * pull * across + (cosine - mean) * normal
    centre *= dr.rsqrt(dr.squared_norm(centre) + 1e-12)
    half = centre + view
    half *= dr.rsqrt(dr.squared_norm(half) + 1e-12)
    distribution = brdf.distribution_sharpness(roughness)
    masking = brdf.masking(dr.maximum(dr.dot(normal, view), 0.0), roughness)
    masking *= brdf.masking(dr.maximum(dr.dot(normal, centre), 0.0), roughness)
    reflectance = dr.log(distribution * (0.125 / math.pi) * masking)
    reflectance -= 0.5 * distribution * dr.squared_norm(half - normal)
    if part == "grazing":
        reflectance += brdf.log_fresnel_weight(dr.dot(view, half))
    lobe = lobe_amplitude - 0.5 * lobe_sharpness * dr.squared_norm(centre - lobe_axis)
    lobe -= lobes.across * dr.square(dr.dot(across, centre))
    weight = dr.square(sharpness / (sharpness + lobes.half_point))
    correction = weight * dr.clip(reflectance - lobe, -_MAXIMUM_CORRECTION, _MAXIMUM_CORRECTION)
    flux = sphere_integral(joint_sharpness) * deviation * clamped_mean(mean / deviation) * dr.rsqrt(narrowing)
    return flux * dr.exp(lobe_amplitude + exponent - pull * offset + correction)
