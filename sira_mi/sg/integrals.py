"""Integrals of spherical Gaussians in closed form, stable in single precision for sharpness from 0 to 1e7.

The integral over the sphere, the product of two lobes (again a lobe) and their inner product are exact. The integrals
over a hemisphere, plain and cosine-weighted, have no elementary form. They are approximated by a normal distribution:
for a direction ω drawn from the lobe, ω·n has the known mean m = A(λ) ξ·n, and with a standard deviation s

    ∫ G (ω·n)₊ dω = (m Φ(m/s) + s φ(m/s)) ∫ G dω        (within 4e-4 of the value at ξ = n)
    ∫ G [ω·n > 0] dω = Φ(t) ∫ G dω                      (within 5e-4 of the whole)

The first form is positive for every s, and its difference between the two sides of a plane, m ∫ G dω, is exact.
s(λ, ξ·n) and t(λ, ξ·n) are the planar limits times small polynomials fitted to quadrature. The idea of a smooth,
normalised step between the exact ends is from Meder & Brüderlin, "Hemispherical Gaussians for Accurate Light
Integration" (2018); forms and coefficients are new. All functions are elementwise.
"""

import math

import drjit as dr

from sira_mi.sg.arrays import Float, Vector3f

# Even polynomials in the cosine (rows) with coefficients in y = λ/(λ + k) (columns, constant first), fitted to
# 600-point Gauss-Legendre quadrature over 1e-3 <= λ <= 1e5.
_COSINE_HALF_POINT = 3.0
_COSINE_DEVIATION = (
    (1.177285, 0.008160574, 0.01862944, -1.951569, 3.086255, -1.34067),
    (0.00642967, -0.3494981, 3.104476, -13.19916, 18.32441, -8.19174),
    (-0.006412073, 0.4047565, -4.360426, 16.97678, -28.53184, 16.70536),
)
_STEP_HALF_POINT = 4.0
_STEP_RATIO = (
    (0.9575716, 1.366147, -2.346319, -0.152178, 2.369921, -1.195792),
    (0.2418432, -3.896926, 20.79291, -44.55874, 43.24151, -15.80775),
    (-0.2743178, 3.582271, -14.78511, 26.18992, -21.4145, 6.65747),
    (0.06185335, 0.07184525, -6.019213, 26.24983, -36.93142, 17.14946),
)
# E max(N(0, 1) − t, 0) for t >= 0 over the normal density at t: y² Σ c_i y^i with y = 1/(1 + t _TAIL_SCALE), relative
# error 5e-7. The difference of the two terms of the definition loses all its digits in single precision.
_TAIL_SCALE = 0.35
_TAIL = (0.1224904, 0.2453933, 0.31606, 0.3646339, -0.0792073, 0.7903021, -1.513293, 0.9744817, -0.2208612)
# Below these sharpnesses the quotients are evaluated by their Taylor series.
_SERIES_INTEGRAL = 0.3
_SERIES_MEAN = 0.7
# Keeps the product of two constant lobes free of 0/0.
_SMALLEST_SHARPNESS = 1e-12


def _polynomial(x, coefficients):
    """Horner's rule, constant coefficient first."""
    value = coefficients[-1]
    for coefficient in reversed(coefficients[:-1]):
        value = dr.fma(value, x, coefficient)
    return value


def _even_polynomial(cosine, sharpness, half_point, rows):
    """Σ_j c^{2j} Σ_i rows[j][i] y^i with y = λ/(λ + half_point)."""
    y = sharpness / (sharpness + half_point)
    return _polynomial(dr.square(cosine), [_polynomial(y, row) for row in rows])


def _normal_density(x):
    return dr.exp(-0.5 * dr.square(x)) * (1.0 / math.sqrt(2.0 * math.pi))


def clamped_mean(x: Float) -> Float:
    """E max(x + N(0, 1), 0) = x Φ(x) + φ(x), to a relative error of 1e-6 for every x."""
    distance = dr.abs(x)
    y = dr.rcp(dr.fma(distance, _TAIL_SCALE, 1.0))
    return dr.maximum(x, 0.0) + _normal_density(distance) * dr.square(y) * _polynomial(y, _TAIL)


def _logistic_cumulative(x):
    """Φ(x) within 1.5e-4, without erf: the logistic function of 1.5976 x + 0.070566 x³."""
    return dr.rcp(1.0 + dr.exp(-x * dr.fma(0.070565992, dr.square(x), 1.5976)))


def sphere_integral(sharpness: Float) -> Float:
    """∫ exp(λ(ω·ξ − 1)) dω over the sphere, steradians: −2π expm1(−2λ)/λ, by its series for small λ."""
    x = 2.0 * sharpness
    series = _polynomial(x, [(-1.0) ** k / math.factorial(k + 1) for k in range(9)])
    quotient = (1.0 - dr.exp(-x)) / dr.select(sharpness < _SERIES_INTEGRAL, 1.0, x)
    return 4.0 * math.pi * dr.select(sharpness < _SERIES_INTEGRAL, series, quotient)


def mean_over_sharpness(sharpness: Float) -> Float:
    """A(λ)/λ with A = coth λ − 1/λ, the length of a lobe's mean direction; also the variance across its axis."""
    square = dr.square(sharpness)
    series = _polynomial(square, (1 / 3, -1 / 45, 2 / 945, -1 / 4725, 2 / 93555))
    safe = dr.select(sharpness < _SERIES_MEAN, 1.0, sharpness)
    decay = dr.exp(-2.0 * safe)
    quotient = ((1.0 + decay) / (1.0 - decay) - 1.0 / safe) / safe
    return dr.select(sharpness < _SERIES_MEAN, series, quotient)


def product(
    axis_a: Vector3f, sharpness_a: Float, axis_b: Vector3f, sharpness_b: Float
) -> tuple[Vector3f, Float, Float]:
    """The product of two lobes of amplitude 1: the lobe's unit axis, sharpness λ_m and log amplitude λ_m − λ_a − λ_b.

    λ_m = |λ_a ξ_a + λ_b ξ_b|, and the log is −λ_a λ_b |ξ_a − ξ_b|² / (λ_m + λ_a + λ_b): no cancellation."""
    total = sharpness_a + sharpness_b
    gap = dr.squared_norm(axis_a - axis_b)
    # The mean of the axes in two roundings, from the sharper lobe's: sharp products need all digits of their axis. Its
    # length λ_m / (λ_a + λ_b) vanishes only for equal, opposite lobes.
    a_is_sharper = sharpness_a >= sharpness_b
    sharper, other = dr.select(a_is_sharper, axis_a, axis_b), dr.select(a_is_sharper, axis_b, axis_a)
    share = dr.minimum(sharpness_a, sharpness_b) / dr.maximum(total, _SMALLEST_SHARPNESS)
    mean = dr.fma(other - sharper, share, sharper)
    length = dr.sqrt(dr.squared_norm(mean) + 1e-12)
    sharpness = total * length
    log_amplitude = -sharpness_a * sharpness_b * gap / dr.maximum(sharpness + total, _SMALLEST_SHARPNESS)
    # A length within 1e-6 of 1 is left as it is: its own derivative counts, its rounding would turn the axis.
    excess = (1.0 - length) / length
    excess -= dr.detach(dr.select(dr.abs(excess) < 1e-6, excess, 0.0))
    return dr.fma(mean, excess, mean), sharpness, log_amplitude


def hemisphere_integral(cosine: Float, sharpness: Float) -> Float:
    """∫ exp(λ(ω·ξ − 1)) dω over the hemisphere around n, steradians, for `cosine` = ξ·n in [−1, 1]."""
    ratio = _even_polynomial(cosine, sharpness, _STEP_HALF_POINT, _STEP_RATIO)
    # Slope at the equator for λ → 0, c λ/4 = φ(0) t, joined to the planar limit t = c √λ.
    slope = sharpness * math.sqrt(math.pi / 8) * dr.rsqrt(1.0 + sharpness * (math.pi / 8))
    return sphere_integral(sharpness) * _logistic_cumulative(cosine * slope * ratio)


def cosine_integral(cosine: Float, sharpness: Float) -> Float:
    """∫ exp(λ(ω·ξ − 1)) (ω·n)₊ dω, steradians, for `cosine` = ξ·n in [−1, 1]."""
    variance = mean_over_sharpness(sharpness)
    mean = variance * sharpness * cosine
    ratio = _even_polynomial(cosine, sharpness, _COSINE_HALF_POINT, _COSINE_DEVIATION)
    deviation = dr.sqrt(variance * ratio)
    return sphere_integral(sharpness) * deviation * clamped_mean(mean / deviation)
