"""The specular reflectance at a shading point as lobes of light directions, and its integral against a light lobe.

PhySG warps the normal distribution around the mirror direction and takes Fresnel and masking there; for rough surfaces
seen at an angle the true integrand lies elsewhere and is wider. Here a lobe times the light's cosine has the integral
over the hemisphere (within about 1%) and the mean direction of reflectance times cosine, from a table by view cosine
and roughness. One lobe is too round for a light sharper than itself; the reflectance relative to the lobe, at the
centre of the product with the light, corrects it in proportion to w = (λ_light / (λ_light + λ_lobe))². Broad lights
keep their energy, and for sharp ones the result tends to reflectance × irradiance.
"""

import math
from typing import NamedTuple

import drjit as dr
import mitsuba as mi

from sira_mi.sg import brdf, specular_table
from sira_mi.sg.integrals import cosine_integral, product

# Range of the roughness in the tables.
_MINIMUM_ROUGHNESS = 0.2
_MAXIMUM_ROUGHNESS = 1.0
# A view below this cosine is shaded as if at it.
_MINIMUM_VIEW_COSINE = 1e-3
# Bound of the log of the reflectance relative to its lobe; reached far out in the tails only.
_MAXIMUM_CORRECTION = 6.0
_TABLES = {
    "white": (specular_table.WHITE_ENERGY, specular_table.WHITE_TURN, specular_table.WHITE_SHARPNESS),
    "grazing": (specular_table.GRAZING_ENERGY, specular_table.GRAZING_TURN, specular_table.GRAZING_SHARPNESS),
}


class SpecularLobes(NamedTuple):
    """What the integral against a light lobe needs of a shading point; F = s + (1 − s) P weights the two parts.

    A ratio is the log of the reflectance's constant factors relative to the lobe's amplitude."""

    normal: "mi.Vector3f"
    view: "mi.Vector3f"
    roughness: "mi.Float"
    white_axis: "mi.Vector3f"
    white_sharpness: "mi.Float"
    white_amplitude: "mi.Float"
    white_ratio: "mi.Float"
    grazing_axis: "mi.Vector3f"
    grazing_sharpness: "mi.Float"
    grazing_amplitude: "mi.Float"
    grazing_ratio: "mi.Float"


def _chebyshev(x, count):
    values = [1.0, x]
    while len(values) < count:
        values.append(2.0 * x * values[-1] - values[-2])
    return values


def _evaluate_table(table, cosine_terms, roughness_terms):
    rows = [sum(a * t for a, t in zip(row, roughness_terms, strict=True)) for row in table]
    return sum(row * t for row, t in zip(rows, cosine_terms, strict=True))


def specular_lobes(normal: "mi.Vector3f", view: "mi.Vector3f", roughness: "mi.Float") -> SpecularLobes:
    """The two lobes at a shading point with unit `normal` and `view`; amplitude 0 where the view is below."""
    cosine = dr.dot(normal, view)
    above = cosine > 0.0
    cosine = dr.clip(cosine, _MINIMUM_VIEW_COSINE, 1.0)
    tabulated = dr.clip(roughness, _MINIMUM_ROUGHNESS, _MAXIMUM_ROUGHNESS)
    cosine_terms = _chebyshev(2.0 * cosine - 1.0, 8)
    roughness_terms = _chebyshev((tabulated - 0.6) / 0.4, 6)
    mirror = 2.0 * cosine * normal - view
    base = brdf.distribution_sharpness(roughness) / (2.0 + 2.0 * dr.square(cosine))
    factor = brdf.distribution_sharpness(roughness) * (0.125 / math.pi) * brdf.visibility(cosine, roughness)
    lobes = []
    for tables in _TABLES.values():
        energy, turn, sharpness = (_evaluate_table(table, cosine_terms, roughness_terms) for table in tables)
        axis = dr.normalize(mirror + turn * (cosine * mirror - normal))
        sharpness = base * dr.exp(sharpness)
        amplitude = dr.exp(energy) / cosine_integral(dr.dot(normal, axis), sharpness)
        lobes += [axis, sharpness, dr.select(above, amplitude, 0.0), dr.log(factor / amplitude)]
    return SpecularLobes(normal, view, mi.Float(roughness), *lobes)


def specular_integrals(
    lobes: SpecularLobes, axis: "mi.Vector3f", sharpness: "mi.Float"
) -> tuple["mi.Float", "mi.Float"]:
    """∫ exp(λ(ω·ξ − 1)) f^s (ω·n)₊ dω of one light lobe, for F = 1 and for F = P."""
    white = _integral(lobes, "white", axis, sharpness)
    return white, _integral(lobes, "grazing", axis, sharpness)


def _integral(lobes, part, axis, sharpness):
    lobe_axis, lobe_sharpness, amplitude, ratio = (
        getattr(lobes, f"{part}_{name}") for name in ("axis", "sharpness", "amplitude", "ratio")
    )
    joint_axis, joint_sharpness, log_amplitude = product(lobe_axis, lobe_sharpness, axis, sharpness)
    cosine = dr.dot(lobes.normal, joint_axis)
    half = joint_axis + lobes.view
    half *= dr.rsqrt(dr.squared_norm(half) + 1e-12)
    ratio = ratio + dr.log(brdf.visibility(dr.maximum(cosine, 0.0), lobes.roughness))
    ratio += 0.5 * lobe_sharpness * dr.squared_norm(joint_axis - lobe_axis)
    ratio -= 0.5 * brdf.distribution_sharpness(lobes.roughness) * dr.squared_norm(half - lobes.normal)
    if part == "grazing":
        ratio += brdf.log_fresnel_weight(dr.dot(lobes.view, half))
    weight = dr.square(sharpness / (sharpness + lobe_sharpness))
    correction = weight * dr.clip(ratio, -_MAXIMUM_CORRECTION, _MAXIMUM_CORRECTION)
    return amplitude * dr.exp(log_amplitude + correction) * cosine_integral(cosine, joint_sharpness)
