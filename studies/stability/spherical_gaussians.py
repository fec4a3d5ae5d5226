"""Spherical Gaussians and the closed form in single precision: exact operations against NumPy in float64,
approximations against the same formula in float64.

Lobes have sharpnesses of 0 and 1e-6 to 1e7 and amplitudes of 0 and 1e-3 to 1e6; axes are parallel, opposite, nearly
opposite, orthogonal and random. A tenth of the cases lies at each end of a range. Inputs are single-precision numbers,
and the reference takes the same numbers."""

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.special import i0e

from sira_mi.sg import brdf, integrals, lobes, shading
from studies.stability import cases
from studies.stability.double import in_double, single
from studies.stability.rows import (
    FLOOR,
    Row,
    are_gradients_finite,
    count_non_finite,
    peak_error,
    relative_error,
)

# The worst relative error of an operation that is exact.
EXACT = 1e-3
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(300)


def _count(quick: bool) -> int:
    return 30_000 if quick else 1_000_000


def _half_gap(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """1 − a·b of unit vectors, without cancellation; for vectors that are rounded ones."""
    return 0.5 * ((cases.normalise(a) - cases.normalise(b)) ** 2).sum(axis=0)


def exact_sphere_integral(sharpness: np.ndarray) -> np.ndarray:
    """∫ exp(λ(ω·ξ − 1)) dω in float64, 4π at λ = 0."""
    safe = np.where(sharpness > 0.0, sharpness, 1.0)
    return np.where(sharpness > 0.0, -2.0 * np.pi * np.expm1(-2.0 * safe) / safe, 4.0 * np.pi)


def _value_of_packed(packed, direction):
    index = dr.arange(mi.UInt32, dr.width(direction))
    return lobes.evaluate_lobe(direction, *lobes.unpack_lobe(packed, index))


def measure_lobe_value(quick: bool) -> Row:
    """`unpack_lobe` and `evaluate_lobe` against float64. The bound is that of all exact operations."""
    rng, count = np.random.default_rng(1), _count(quick)
    axis, sharpness, amplitude = (
        cases.draw_directions(rng, count),
        cases.draw_sharpnesses(rng, count),
        cases.draw_amplitudes(rng, count),
    )
    direction = cases.draw_near(rng, axis, sharpness)
    packed = mi.Float(np.concatenate([axis, sharpness[None], amplitude]).T.ravel().astype(np.float32))
    result = _value_of_packed(packed, mi.Vector3f(direction)).numpy()
    exact = amplitude * np.exp(-sharpness * _half_gap(axis, direction))
    return Row(
        "value of a lobe",
        "relative",
        count,
        relative_error(result, exact, amplitude),
        EXACT,
        count_non_finite(result),
        are_gradients_finite(_value_of_packed, packed, mi.Vector3f(direction)),
    )


def _pairs(rng: np.random.Generator, count: int, highest: float):
    """Two sets of lobes and the exact joint lobe: axes, sharpness, log amplitude."""
    sharpness_a, sharpness_b = (cases.draw_sharpnesses(rng, count, highest) for _ in range(2))
    same = rng.random(count) < 0.1
    sharpness_b[same] = sharpness_a[same]
    axis_a = cases.draw_directions(rng, count)
    axis_b = cases.draw_second_axes(rng, axis_a, np.minimum(sharpness_a, sharpness_b))
    total = sharpness_a + sharpness_b
    vector = sharpness_a * cases.normalise(axis_a) + sharpness_b * cases.normalise(axis_b)
    joint = np.linalg.norm(vector, axis=0)
    log_amplitude = -2.0 * sharpness_a * sharpness_b * _half_gap(axis_a, axis_b) / np.where(total, joint + total, 1.0)
    axis = np.where(joint > 1e-9 * total, vector / np.where(joint > 0.0, joint, 1.0), axis_a)
    return (axis_a, sharpness_a, axis_b, sharpness_b), (axis, joint, log_amplitude)


def _arrays(axis_a, sharpness_a, axis_b, sharpness_b):
    return mi.Vector3f(axis_a), mi.Float(sharpness_a), mi.Vector3f(axis_b), mi.Float(sharpness_b)


def _product_at(direction, axis_a, sharpness_a, axis_b, sharpness_b):
    axis, sharpness, log_amplitude = integrals.product(axis_a, sharpness_a, axis_b, sharpness_b)
    return lobes.evaluate_lobe(direction, axis, sharpness, mi.Color3f(1.0)).x * dr.exp(log_amplitude)


def _measure_product(quick: bool, name: str, highest: float, bound: float) -> Row:
    rng, count = np.random.default_rng(2), _count(quick)
    pair, (axis, joint, log_amplitude) = _pairs(rng, count, highest)
    axis_a, sharpness_a, axis_b, sharpness_b = pair
    direction = cases.draw_near(rng, axis, joint)
    inputs = mi.Vector3f(direction), *_arrays(*pair)
    result = _product_at(*inputs).numpy()
    exact = np.exp(-sharpness_a * _half_gap(axis_a, direction) - sharpness_b * _half_gap(axis_b, direction))
    # Values near the smallest single-precision numbers have lost their digits; what has faded to 1e-30 is left out.
    peak = np.maximum(np.exp(log_amplitude), 1e-30 / FLOOR)
    finite = are_gradients_finite(_product_at, *inputs)
    return Row(name, "relative", count, relative_error(result, exact, peak), bound, count_non_finite(result), finite)


def measure_product(quick: bool) -> Row:
    """`product`, evaluated near the joint axis, against the product of the two values in float64."""
    return _measure_product(quick, "product of two lobes, joint sharpness to 1e7", 5e6, EXACT)


def measure_product_of_sharpest(quick: bool) -> Row:
    """The same for two lobes of sharpness to 1e7. Bound: an axis in single precision may be off by 5e-8 (half a digit
    in each coordinate), which at 1e-6 of the peak changes the value by 1.2e-3 at a sharpness of 2e7."""
    return _measure_product(quick, "product of two lobes, joint sharpness to 2e7", 1e7, 1.2e-3)


def inner_product(axis_a, sharpness_a, axis_b, sharpness_b):
    """∫ of the product of two lobes of amplitude 1 over the sphere, steradians."""
    _, sharpness, log_amplitude = integrals.product(axis_a, sharpness_a, axis_b, sharpness_b)
    return dr.exp(log_amplitude) * integrals.sphere_integral(sharpness)


def measure_inner_product(quick: bool) -> Row:
    """`inner_product` against float64, where above 1e-6 of that of parallel lobes."""
    rng, count = np.random.default_rng(3), _count(quick)
    pair, (_, joint, log_amplitude) = _pairs(rng, count, cases.SHARPNESS[1])
    inputs = _arrays(*pair)
    result = inner_product(*inputs).numpy()
    exact = np.exp(log_amplitude) * exact_sphere_integral(joint)
    return Row(
        "integral of a product over the sphere",
        "relative",
        count,
        relative_error(result, exact, exact_sphere_integral(pair[1] + pair[3])),
        EXACT,
        count_non_finite(result),
        are_gradients_finite(inner_product, *inputs),
    )


def measure_sphere_integral(quick: bool) -> Row:
    """`sphere_integral` against expm1 in float64, at every sharpness."""
    count = _count(quick)
    sharpness = cases.draw_sharpnesses(np.random.default_rng(4), count)
    result = integrals.sphere_integral(mi.Float(sharpness)).numpy()
    return Row(
        "integral of a lobe over the sphere",
        "relative",
        count,
        relative_error(result, exact_sphere_integral(sharpness), 0.0),
        EXACT,
        count_non_finite(result),
        are_gradients_finite(integrals.sphere_integral, mi.Float(sharpness)),
    )


def measure_mean_direction(quick: bool) -> Row:
    """`mean_over_sharpness`, A(λ)/λ, against coth in float64 (its series below 0.01)."""
    count = _count(quick)
    sharpness = cases.draw_sharpnesses(np.random.default_rng(5), count)
    result = integrals.mean_over_sharpness(mi.Float(sharpness)).numpy()
    small = sharpness < 1e-2
    safe = np.where(small, 1.0, sharpness)
    exact = np.where(small, 1 / 3 - sharpness**2 / 45, (1.0 / np.tanh(safe) - 1.0 / safe) / safe)
    return Row(
        "length of a lobe's mean direction",
        "relative",
        count,
        relative_error(result, exact, 0.0),
        EXACT,
        count_non_finite(result),
        are_gradients_finite(integrals.mean_over_sharpness, mi.Float(sharpness)),
    )


def _measure_clamped(quick: bool, seed: int, function, name: str) -> Row:
    """A function of the cosine ξ·n and the sharpness, an approximation, against itself in float64 where above 1e-6 of
    its value at ξ = n. A negative value counts as an infinite error. The bound is that of exact operations: rounding
    adds nothing to the approximation's own error."""
    rng, count = np.random.default_rng(seed), _count(quick)
    sharpness = cases.draw_sharpnesses(rng, count)
    near = rng.uniform(-7.0, 7.0, count) / np.sqrt(sharpness + 1.0)
    cosine = single(np.where(rng.random(count) < 0.6, np.clip(near, -1.0, 1.0), rng.uniform(-1.0, 1.0, count)))
    inputs = mi.Float(cosine), mi.Float(sharpness)
    result = function(*inputs).numpy()
    with in_double() as double:
        exact = function(double.Float(cosine), double.Float(sharpness)).numpy()
        peak = function(double.Float(1.0), double.Float(sharpness)).numpy()
    below = int((result < 0.0).sum())
    error = relative_error(result, exact, peak) if not below else np.inf
    return Row(name, "relative", count, error, EXACT, count_non_finite(result), are_gradients_finite(function, *inputs))


def measure_cosine_integral(quick: bool) -> Row:
    """`cosine_integral`, from above the surface to below the horizon."""
    return _measure_clamped(quick, 6, integrals.cosine_integral, "irradiance of a lobe, to below the horizon")


def measure_hemisphere_integral(quick: bool) -> Row:
    """`hemisphere_integral`, from above the surface to below the horizon."""
    return _measure_clamped(quick, 7, integrals.hemisphere_integral, "integral of a lobe over a hemisphere")


def _irradiance_quadrature(sharpness: float, cosine: np.ndarray) -> np.ndarray:
    """∫ exp(λ(ω·ξ − 1)) (ω·n)₊ dω in float64 for cosines ξ·n: Gauss-Legendre over the elevation within 14 widths of
    the axis, a Bessel function for the azimuth."""
    centre, width = np.arcsin(cosine)[:, None], 14.0 / np.sqrt(max(sharpness, 1e-3))
    low = np.clip(centre - width, 0.0, np.pi / 2)
    high = np.clip(np.maximum(centre, 0.0) + width, low, np.pi / 2)
    elevation = 0.5 * (high - low) * _NODES + 0.5 * (high + low)
    z, rim, sine = np.sin(elevation), np.cos(elevation), np.sqrt(1.0 - cosine**2)[:, None]
    density = np.exp(sharpness * (np.cos(elevation - centre) - 1.0)) * i0e(sharpness * sine * rim)
    return (0.5 * (high - low) * _WEIGHTS * z * rim * 2.0 * np.pi * density).sum(axis=1)


def measure_cosine_integral_against_quadrature(quick: bool) -> Row:
    """How much single precision adds to the largest error of `cosine_integral` against quadrature, as a share of the
    value at ξ = n. The bound is twenty roundings."""
    sharpness = single(np.geomspace(1e-6, 1e7, 14 if quick else 53))
    cosine = single(np.linspace(-1.0, 1.0, 41 if quick else 201))
    truth = np.stack([_irradiance_quadrature(x, cosine) for x in sharpness])
    peak = truth.max(axis=1, keepdims=True)
    c, s = (x.ravel() for x in np.meshgrid(cosine, sharpness))
    result = integrals.cosine_integral(mi.Float(c), mi.Float(s)).numpy()
    with in_double() as double:
        exact = integrals.cosine_integral(double.Float(c), double.Float(s)).numpy()
    errors = [peak_error(x.reshape(truth.shape), truth, peak) for x in (result, exact)]
    return Row(
        "irradiance against quadrature, float32 over float64",
        "of the peak",
        truth.size,
        max(errors[0] - errors[1], 0.0),
        1e-6,
        count_non_finite(result),
    )


def _brdf_points(rng: np.random.Generator, count: int):
    """Normals, views, lights near the mirror direction or anywhere above, roughness."""
    normal, roughness = cases.draw_directions(rng, count), cases.draw_roughnesses(rng, count)
    view = cases.draw_views(rng, normal)
    half = cases.draw_near(rng, normal, 2.0 / roughness**4)
    mirrored = 2.0 * (view * half).sum(axis=0) * half - view
    light = np.where(rng.random(count) < 0.7, mirrored, cases.draw_views(rng, normal))
    return normal, view, single(cases.normalise(light)), roughness


def measure_reflectance(quick: bool) -> Row:
    """`specular_brdf` against float64, where above 1e-6 of its value at the mirror direction, for lights and views
    above the surface by 1e-6. Bound: at roughness 0.02 the distribution has a sharpness of 1.25e7, and the half vector,
    rounded twice, may be off by 8e-8; that is 1.5e-3 of the value at 1e-6 of the peak."""
    rng, count = np.random.default_rng(8), _count(quick)
    normal, view, light, roughness = _brdf_points(rng, count)
    albedo = single(rng.integers(0, 3, count) / 2.0)
    inputs = mi.Vector3f(normal), mi.Vector3f(view), mi.Vector3f(light), mi.Float(albedo), mi.Float(roughness)
    result = brdf.specular_brdf(*inputs).numpy()
    n = cases.normalise(normal)
    cos_view, cos_light = (n * view).sum(axis=0), (n * light).sum(axis=0)
    half = cases.normalise(view + light)
    sharpness, k = 2.0 / roughness**4, (roughness + 1.0) ** 2 / 8.0
    density = sharpness / (2.0 * np.pi) * np.exp(-0.5 * sharpness * ((half - n) ** 2).sum(axis=0))
    # v·h of unit vectors; the rounding of their lengths, which v·h itself divides by |v + l|, hardly enters.
    cosine = 0.5 * np.linalg.norm(view + light, axis=0)
    fresnel = albedo + (1.0 - albedo) * 2.0 ** (-(5.55473 * cosine + 6.8316) * cosine)
    masking = (cos_view * (1.0 - k) + k) * (cos_light * (1.0 - k) + k)
    exact = 0.25 * density * fresnel / masking
    peak = 0.25 * sharpness / (2.0 * np.pi) * fresnel / masking
    above = (cos_view > 1e-6) & (cos_light > 1e-6)
    return Row(
        "specular reflectance, roughness 0.02 to 1, n·v to 1e-6, albedo 0, 0.5 and 1",
        "relative",
        count,
        relative_error(result[above], exact[above], peak[above]),
        1.5e-3,
        count_non_finite(result),
        are_gradients_finite(brdf.specular_brdf, *inputs),
    )


def _specular(types, point: tuple[np.ndarray, ...], axis, sharpness):
    """`specular_radiance` at points (normal, view, albedo, roughness) in the precision of `types`."""
    normal, view, albedo, roughness = point
    return shading.specular_radiance(
        types.Vector3f(normal),
        types.Vector3f(view),
        types.Float(albedo),
        types.Float(roughness),
        types.Vector3f(axis),
        types.Float(sharpness),
        types.Color3f(1.0),
    ).x


def measure_glossy_lobe(quick: bool) -> Row:
    """`specular_radiance`, an approximation, against itself in float64; share of the largest value over the lights at
    the same point. Bound: the mirror direction, the glossy lobe's axis and the joint axis are rounded one after the
    other, and each costs as much as in the product of the sharpest lobes. It is a third of the closed form's own error,
    1%."""
    rng = np.random.default_rng(9)
    points, lights = (200, 75) if quick else (4000, 125)
    count = points * lights
    normal, roughness = cases.draw_directions(rng, points), cases.draw_roughnesses(rng, points)
    view = cases.draw_views(rng, normal, 1e-4)
    albedo, sharpness = single(rng.integers(0, 2, points)), cases.draw_sharpnesses(rng, points)
    mirror = 2.0 * (normal * view).sum(axis=0) * normal - view
    point = tuple(np.repeat(x, lights, axis=-1) for x in (normal, view, albedo, roughness))
    width = np.repeat(roughness**2 + 1.0 / np.sqrt(sharpness + 1.0), lights)
    every_sharpness = np.repeat(sharpness, lights)
    best, results, exacts = mirror, [], []
    # Lights around the mirror direction and anywhere, then more around the one that gives most.
    for reach in (4.0, 1.5):
        angle = np.minimum(reach * width * rng.random(count), np.pi)
        axis = cases.tilt(rng, np.repeat(best, lights, axis=-1), angle)
        anywhere = rng.random(count) < 0.3
        axis[:, anywhere] = cases.draw_directions(rng, int(anywhere.sum()))
        results.append(_specular(mi, point, axis, every_sharpness).numpy().reshape(points, lights))
        with in_double() as double:
            exacts.append(_specular(double, point, axis, every_sharpness).numpy().reshape(points, lights))
        best = axis.reshape(3, points, lights)[:, np.arange(points), exacts[-1].argmax(axis=1)]
    result, exact = np.concatenate(results, axis=1), np.concatenate(exacts, axis=1)
    peak = exact.max(axis=1, keepdims=True)
    # What has faded to 1e-30 is below the numbers of single precision.
    met = peak[:, 0] > 1e-30
    finite = are_gradients_finite(
        shading.specular_radiance,
        *(mi.Vector3f(x) for x in point[:2]),
        *(mi.Float(x) for x in point[2:]),
        mi.Vector3f(axis),
        mi.Float(every_sharpness),
        mi.Color3f(np.ones((3, count))),
    )
    return Row(
        "glossy closed form, roughness 0.02 to 1, n·v to 1e-4, albedo 0 and 1",
        "of the peak",
        2 * int(met.sum()) * lights,
        peak_error(result[met], exact[met], peak[met]),
        3e-3,
        count_non_finite(result),
        finite,
    )


def measure_shading(quick: bool) -> Row:
    """Irradiance and specular radiance of `shade` against the sum over the lobes in float64; share of the largest value
    over the points."""
    rng = np.random.default_rng(10)
    points, error, bad, finite, cases_total = 32 if quick else 256, 0.0, 0, True, 0
    for count in (1, 1024) if quick else (1, 2, 16, 128, 1024):
        lights = cases.draw_lobes(rng, count)
        normal, roughness = cases.draw_directions(rng, points), 0.5
        view = cases.draw_views(rng, normal, 1e-3)
        albedo = single(rng.integers(0, 2, points))
        tensor = mi.TensorXf(lights.astype(np.float32))
        inputs = mi.Vector3f(normal), mi.Vector3f(view), mi.Float(albedo), mi.Float(roughness), tensor
        irradiance, specular = (x.numpy() for x in shading.shade(*inputs))
        every_normal, *others = (np.repeat(x, count, axis=-1) for x in (normal, view, albedo))
        point = (every_normal, *others, np.full(points * count, roughness))
        axis, sharpness, amplitude = (np.tile(x, (1, points)) for x in (lights[:, :3].T, lights[:, 3], lights[:, 4:].T))
        with in_double() as double:
            exact_irradiance = integrals.cosine_integral(
                double.Float((every_normal * axis).sum(axis=0)), double.Float(sharpness.ravel())
            ).numpy()
            exact_specular = _specular(double, point, axis, sharpness.ravel()).numpy()
        for result, exact in ((irradiance, exact_irradiance), (specular, exact_specular)):
            sums = (amplitude * exact).reshape(3, points, count).sum(axis=2)
            error = max(error, peak_error(result, sums, sums.max(axis=1, keepdims=True)))
        bad += count_non_finite(irradiance, specular)
        if count == 1024:
            finite = are_gradients_finite(shading.shade, *inputs)
        cases_total += points * count
    return Row(
        "shading under 1, 2, 16, 128 and 1024 lobes, amplitudes 0 to 1e6",
        "of the peak",
        cases_total,
        error,
        EXACT,
        bad,
        finite,
    )


MEASURES = (
    measure_lobe_value,
    measure_product,
    measure_product_of_sharpest,
    measure_inner_product,
    measure_sphere_integral,
    measure_mean_direction,
    measure_cosine_integral,
    measure_hemisphere_integral,
    measure_cosine_integral_against_quadrature,
    measure_reflectance,
    measure_glossy_lobe,
    measure_shading,
)
