"""The reflectance of eq. 8, f = a/π + k_s f^s, as functions of cosines: PhySG's simplified Disney BRDF.

f^s = D F G / (4 (n·l)(n·v)) with D = exp(2/r⁴ (h·n − 1)) / (πr⁴), F = s + (1 − s) 2^{−(5.55473 v·h + 6.8316) v·h} and
Schlick-Smith's G = g(n·l) g(n·v), g(c) = c / (c(1 − k) + k), k = (r + 1)²/8. The cosines of G cancel those of the
denominator, so f^s is finite at grazing angles. r is the roughness, s the monochrome specular albedo.
"""

import math

import drjit as dr
import mitsuba as mi

from sira_mi.sg.arrays import Float, Point2f, Vector3f

MINIMUM_ROUGHNESS = 0.02
MAXIMUM_ROUGHNESS = 1.0


def distribution_sharpness(roughness: Float) -> Float:
    """λ = 2/r⁴ of the normal distribution."""
    return 2.0 / dr.square(dr.square(roughness))


def distribution(one_minus_cosine: Float, roughness: Float) -> Float:
    """D(h) per steradian as a function of 1 − h·n, which callers compute without cancellation as ½|h − n|²."""
    sharpness = distribution_sharpness(roughness)
    return sharpness * (0.5 / math.pi) * dr.exp(-sharpness * one_minus_cosine)


def log_fresnel_weight(cosine: Float) -> Float:
    """Natural log of P(v·h)."""
    return -math.log(2.0) * (5.55473 * cosine + 6.8316) * cosine


def fresnel_weight(cosine: Float) -> Float:
    """P(v·h) of F = s + (1 − s) P: the spherical-Gaussian fit of Schlick's (1 − v·h)⁵."""
    return dr.exp(log_fresnel_weight(cosine))


def fresnel(specular_albedo: Float, cosine: Float) -> Float:
    """F = s + (1 − s) P(v·h)."""
    return dr.lerp(fresnel_weight(cosine), 1.0, specular_albedo)


def masking(cosine: Float, roughness: Float) -> Float:
    """g(c)/c = 1 / (c(1 − k) + k) with k = (r + 1)²/8: the masking of one direction over its cosine."""
    k = dr.square(roughness + 1.0) / 8.0
    return dr.rcp(dr.fma(cosine, 1.0 - k, k))


def specular_brdf(
    normal: Vector3f,
    view: Vector3f,
    light: Vector3f,
    specular_albedo: Float,
    roughness: Float,
) -> Float:
    """f^s per steradian for unit vectors, 0 unless `view` and `light` are both above the surface.

    v·h is computed as ½|v + l|, which is the same in both directions: v·h and l·h themselves differ by the rounding of
    the vectors' lengths, and at grazing angles Fresnel by 3e-4."""
    cos_view, cos_light = dr.dot(normal, view), dr.dot(normal, light)
    above = (cos_view > 0.0) & (cos_light > 0.0)
    both_directions = dr.select(above, view + light, normal)
    half = dr.normalize(both_directions)
    density = distribution(0.5 * dr.squared_norm(half - normal), roughness)
    both = masking(dr.maximum(cos_view, 0.0), roughness) * masking(dr.maximum(cos_light, 0.0), roughness)
    value = 0.25 * density * both * fresnel(specular_albedo, 0.5 * dr.norm(both_directions))
    return dr.select(above, value, 0.0)


def sample_distribution(sample: Point2f, roughness: Float) -> Vector3f:
    """A half vector around +z with the density D(h) over the sphere, from two uniform numbers."""
    sharpness = distribution_sharpness(roughness)
    # D is normalised up to exp(−2λ) <= e⁻⁴; the cosine's distribution is truncated to the sphere exactly.
    gap = -dr.log(dr.fma(sample.x, dr.exp(-2.0 * sharpness), 1.0 - sample.x)) / sharpness
    sine = dr.safe_sqrt(gap * (2.0 - gap))
    sin_phi, cos_phi = dr.sincos(2.0 * math.pi * sample.y)
    return mi.Vector3f(sine * cos_phi, sine * sin_phi, 1.0 - gap)


def reflection_density(normal: Vector3f, view: Vector3f, light: Vector3f, roughness: Float) -> Float:
    """Density per steradian of `view` reflected about a half vector of `sample_distribution`.

    h and −h reflect alike, so both count; the Jacobian is 1/(4 |v·h|)."""
    half = dr.normalize(view + light)
    sharpness = distribution_sharpness(roughness)
    both = distribution(0.5 * dr.squared_norm(half - normal), roughness)
    both += distribution(0.5 * dr.squared_norm(half + normal), roughness)
    return both / ((1.0 - dr.exp(-2.0 * sharpness)) * 4.0 * dr.maximum(dr.dot(view, half), 1e-6))
