"""Sampling of lights and of the reflectance: densities against float64, Mitsuba's chi-squared test, the energy of the
samples, and the largest weight of a sample: a firefly is a weight that the model does not explain."""

import contextlib
import io
from unittest import mock

import drjit as dr
import mitsuba as mi
import numpy as np
from mitsuba.chi2 import BSDFAdapter, ChiSquareTest, PlanarDomain, SphericalDomain

from sira_mi.conventions import LUMINANCE
from sira_mi.sg import brdf
from sira_mi.sg.sampling import LobeMixture, sample_lobe
from studies.stability import cases
from studies.stability.double import single
from studies.stability.rows import Row, count_non_finite, largest, relative_error
from studies.stability.spherical_gaussians import EXACT, exact_sphere_integral

# Needle-sharp and nearly uniform lobes.
_SHARPNESS = (0.0, 1e-6, 1e-3, 0.019, 0.021, 1.0, 100.0, 1e5, 1e7)
# Error probability of a section's chi-squared tests together.
_SIGNIFICANCE = 0.01
_GRAZING = (0.0, 60.0, 85.0, 89.0, 89.9)


def _samples(quick: bool) -> int:
    return 30_000 if quick else 1_000_000


def measure_density(quick: bool) -> Row:
    """`LobeMixture.evaluate` against float64, where above 1e-6 of the mixture's highest lobe."""
    rng, points = np.random.default_rng(21), 300 if quick else 4000
    error, bad, total = 0.0, 0, 0
    for count in (1, 16, 1024):
        lights = cases.draw_lobes(rng, count)
        # Half of the directions lie in the reach of a lobe, which random ones never are for sharp lobes.
        chosen = rng.integers(0, count, points)
        direction = cases.draw_near(rng, lights[chosen, :3].T, lights[chosen, 3])
        direction[:, ::2] = cases.draw_directions(rng, points)[:, ::2]
        radiance, density = LobeMixture(mi.TensorXf(lights.astype(np.float32))).evaluate(mi.Vector3f(direction))
        sharpness, amplitude = lights[:, 3], lights[:, 4:]
        axis, unit = cases.normalise(lights[:, :3].T), cases.normalise(direction)
        gap = 0.5 * sum((unit[k][:, None] - axis[k]) ** 2 for k in range(3))
        value = np.exp(-sharpness * gap)
        integral = exact_sphere_integral(sharpness)
        energy = integral * (amplitude @ LUMINANCE)
        scaled = energy / energy.sum() / integral
        error = max(
            error,
            relative_error(density.numpy(), value @ scaled, scaled.max()),
            relative_error(radiance.numpy(), (value @ amplitude).T, amplitude.max()),
        )
        bad += count_non_finite(radiance.numpy(), density.numpy())
        total += points
    return Row(
        "radiance and density of mixtures of 1, 16 and 1024 lobes",
        "relative",
        total,
        error,
        EXACT,
        bad,
    )


def measure_sampled_angles(quick: bool) -> Row:
    """`sample_lobe` against the inverse of the distribution in float64, in widths of the lobe (1/√λ, at most one
    radian). Bound: uniform numbers have 24 bits, so that the first angle off the axis is 3.5e-4 widths from it."""
    rng, count = np.random.default_rng(22), _samples(quick)
    sharpness, axis = cases.draw_sharpnesses(rng, count), cases.draw_directions(rng, count)
    u = single(rng.random((2, count)))
    direction = sample_lobe(mi.Vector3f(axis), mi.Float(sharpness), mi.Point2f(u)).numpy().astype(np.float64)
    safe = np.where(sharpness > 0.0, sharpness, 1.0)
    gap = np.where(sharpness > 1e-5, -np.log1p(u[0] * np.expm1(-2.0 * safe)) / safe, 2.0 * u[0])
    angle = 2.0 * np.arcsin(np.sqrt(np.clip(0.5 * gap, 0.0, 1.0)))
    chord = np.linalg.norm(cases.normalise(direction) - cases.normalise(axis), axis=0)
    difference = np.abs(2.0 * np.arcsin(np.clip(0.5 * chord, 0.0, 1.0)) - angle)
    return Row(
        "angle of a sample from its lobe's axis",
        "lobe widths",
        count,
        largest(difference * np.sqrt(np.maximum(sharpness, 1.0))),
        1e-3,
        count_non_finite(direction),
    )


def _run_tests(tests: list[ChiSquareTest]) -> tuple[float, float]:
    """One minus the smallest p-value of the tests, and its bound for the section's error probability."""
    for test in tests:
        # A test talks, and writes its histogram into the working folder when it fails.
        with contextlib.redirect_stdout(io.StringIO()), mock.patch.object(test, "_dump_tables"):
            test.run(_SIGNIFICANCE, len(tests))
    # `run` sets `p_value`.
    smallest = min(getattr(test, "p_value", None) or 0.0 for test in tests)
    return 1.0 - smallest, (1.0 - _SIGNIFICANCE) ** (1.0 / len(tests))


def _lobe_test(sharpness: float, count: int) -> ChiSquareTest:
    """Chi-squared test of an `sg_envmap` of one lobe, in 1 − cos θ (in units of 1/λ) and azimuth about its axis."""
    axis = cases.normalise(np.array([[0.3], [-0.5], [0.8]]))[:, 0]
    scale = max(sharpness, 1.0)
    lights = np.array([[*axis, sharpness, 1.0, 1.0, 1.0]], np.float32)
    mixture, frame = LobeMixture(mi.TensorXf(lights)), mi.Frame3f(mi.Vector3f(*axis.tolist()))

    def sample(u):
        local = frame.to_local(mixture.sample(u) - mi.Vector3f(*axis.tolist()))
        return mi.Point2f(0.5 * scale * dr.squared_norm(local), dr.atan2(local.y, local.x))

    def density(p):
        gap = p.x / scale
        sine = dr.safe_sqrt(gap * (2.0 - gap))
        local = mi.Vector3f(sine * dr.cos(p.y), sine * dr.sin(p.y), 1.0 - gap)
        return mixture.evaluate(frame.to_world(local))[1] / scale

    reach = min(2.0 * scale, 17.0)
    bounds = mi.ScalarBoundingBox2f(mi.ScalarPoint2f(0.0, -np.pi), mi.ScalarPoint2f(reach, np.pi))
    return ChiSquareTest(
        PlanarDomain(bounds), sample, density, sample_dim=2, sample_count=count, res=51, ires=8, seed=3
    )


def measure_lobe_p_value(quick: bool) -> Row:
    """Samples of single lobes of `_SHARPNESS` against their density, in coordinates about the axis. The bound lets all
    tests together fail a correct sampler once in a hundred."""
    sharpness = (0.0, 1.0, 1e7) if quick else _SHARPNESS
    count = 100_000 if quick else 1_000_000
    error, bound = _run_tests([_lobe_test(x, count) for x in sharpness])
    return Row(
        "chi-squared: needle-sharp and nearly uniform lobes",
        "1 − p",
        count * len(sharpness),
        error,
        bound,
        0,
    )


def measure_light_weights(quick: bool) -> Row:
    """Radiance over density of `sg_envmap`'s samples. Lobes are chosen by the luminance of their energy, so that every
    weight has the luminance of the whole light: the relative difference from that."""
    rng, points = np.random.default_rng(23), 3000 if quick else 100_000
    error, bad, total = 0.0, 0, 0
    for count in (1, 16, 1024):
        lights = cases.draw_lobes(rng, count)
        lights[:, 3] = np.maximum(lights[:, 3], cases.SHARPNESS[0])  # a file's lobes are not constant
        light = mi.load_dict({"type": "sg_envmap", "lobes": mi.TensorXf(lights.astype(np.float32))})
        energy = exact_sphere_integral(single(lights[:, 3])) @ (lights[:, 4:] @ LUMINANCE)
        it = dr.zeros(mi.Interaction3f, points)
        ds, weight = light.sample_direction(it, mi.Point2f(rng.random((2, points))))
        luminance = np.array(LUMINANCE) @ weight.numpy()
        error = max(error, largest(np.abs(luminance / energy - 1.0)))
        bad += count_non_finite(weight.numpy(), ds.pdf.numpy())
        total += points
    return Row(
        "fireflies: weights of light samples",
        "relative",
        total,
        error,
        EXACT,
        bad,
    )


def _interaction(angle: float, width: int = 1):
    si = dr.zeros(mi.SurfaceInteraction3f, width)
    si.wi = mi.Vector3f(float(np.sin(np.radians(angle))), 0.0, float(np.cos(np.radians(angle))))
    si.sh_frame = mi.Frame3f(mi.Vector3f(0, 0, 1))
    si.n = mi.Normal3f(0, 0, 1)
    return si


def _bsdf(diffuse: float, specular: float, roughness: float):
    return mi.load_dict(
        {"type": "sira_bsdf", "diffuse_albedo": diffuse, "specular_albedo": specular, "roughness": roughness}
    )


def _settings(quick: bool):
    """(angle, roughness, diffuse albedo, specular albedo)."""
    angles = (60.0, 89.9) if quick else _GRAZING
    roughnesses = (brdf.MINIMUM_ROUGHNESS, 1.0) if quick else (brdf.MINIMUM_ROUGHNESS, 0.05, 0.2, 0.5, 1.0)
    return [(a, r, *albedos) for a in angles for r in roughnesses for albedos in ((0.0, 1.0), (0.8, 0.0), (0.5, 0.5))]


def measure_reflectance_weights(quick: bool) -> Row:
    """Value times cosine over density of `sira_bsdf`'s samples, as a share of what the model allows. With p the
    probability of the specular lobe, the diffuse part's weight is at most a/(1 − p), the specular part's at most 1/(p
    (n·v (1 − k) + k)), k = (r + 1)²/8, and the mixture's at most the larger of the two."""
    rng, count = np.random.default_rng(24), 3000 if quick else 100_000
    error, bad, ratio, settings = 0.0, 0, 0.0, _settings(quick)
    for angle, roughness, diffuse, specular in settings:
        plugin, si = _bsdf(diffuse, specular, roughness), _interaction(angle, count)
        u = rng.random((3, count))
        samples, weight = plugin.sample(mi.BSDFContext(), si, mi.Float(u[0]), mi.Point2f(u[1:]))
        cosine, k = np.cos(np.radians(angle)), (roughness + 1.0) ** 2 / 8.0
        estimate = specular + (1.0 - specular) * 2.0 ** (-(5.55473 * cosine + 6.8316) * cosine)
        share = np.clip(estimate / max(estimate + diffuse, 1e-6), 0.1, 0.9)
        bound = max(diffuse / (1.0 - share), 1.0 / (share * (cosine * (1.0 - k) + k)))
        weight = weight.numpy()
        error = max(error, largest(weight) / bound)
        ratio = max(ratio, largest(weight) / max(float(weight.mean()), 1e-9))
        bad += count_non_finite(weight, samples.pdf.numpy(), samples.wo.numpy())
    return Row(
        "fireflies: weights of BSDF samples",
        "of the limit",
        count * len(settings),
        error,
        1.0 + EXACT,
        bad,
        note=f"the largest is {ratio:.1f} times the mean",
    )


def _albedo(angle: float, roughness: float, diffuse: float, specular: float, size: int) -> float:
    """Directional albedo of the model in float64, the specular part as a sum over half vectors."""
    cosine = np.cos(np.radians(angle))
    view = np.array([np.sin(np.radians(angle)), 0.0, cosine])
    sharpness, k = 2.0 / roughness**4, (roughness + 1.0) ** 2 / 8.0
    u = (np.arange(size) + 0.5) / size
    gap = -np.log1p(u * np.expm1(-2.0 * sharpness)) / sharpness
    phi = 2.0 * np.pi * u[:, None]
    sine = np.sqrt(gap * (2.0 - gap))
    cos_half = np.abs(sine * np.cos(phi) * view[0] + (1.0 - gap) * cosine)
    signed = sine * np.cos(phi) * view[0] + (1.0 - gap) * cosine
    cos_light = 2.0 * signed * (1.0 - gap) - cosine
    above = (cos_light > 0.0) & (signed > 0.0)
    fresnel = specular + (1.0 - specular) * 2.0 ** (-(5.55473 * cos_half + 6.8316) * cos_half)
    masking = 1.0 / ((np.maximum(cos_light, 0.0) * (1.0 - k) + k) * (cosine * (1.0 - k) + k))
    weight = (1.0 - np.exp(-2.0 * sharpness)) * fresnel * masking * np.maximum(cos_light, 0.0) * cos_half
    return diffuse + float(np.where(above, weight, 0.0).mean())


def measure_reflectance_energy(quick: bool) -> Row:
    """Mean weight of `sira_bsdf`'s samples against the model's directional albedo, summed over half vectors in float64:
    what chi-squared on the sphere cannot resolve for sharp lobes. In standard errors plus 0.1% of the albedo; a normal
    variable exceeds 4.5 once in 150,000."""
    rng, side = np.random.default_rng(25), 128 if quick else 512
    grid = (np.stack(np.meshgrid(np.arange(side), np.arange(side))).reshape(2, -1) + 0.5) / side
    error, bad, settings = 0.0, 0, _settings(quick)
    for angle, roughness, diffuse, specular in settings:
        si = _interaction(angle, side * side)
        u = rng.permutation((np.arange(side * side) + 0.5) / (side * side))
        plugin = _bsdf(diffuse, specular, roughness)
        weight = plugin.sample(mi.BSDFContext(), si, mi.Float(u), mi.Point2f(grid))[1].x.numpy().astype(np.float64)
        exact = _albedo(angle, roughness, diffuse, specular, 500 if quick else 1000)
        error = max(error, abs(weight.mean() - exact) / (weight.std() / side + 1e-3 * exact))
        bad += count_non_finite(weight)
    return Row(
        "energy of BSDF samples from head-on to 89.9°",
        "standard errors",
        side * side * len(settings),
        error,
        4.5,
        bad,
    )


def measure_reflectance_p_value(quick: bool) -> Row:
    """`sira_bsdf` at grazing angles, as `measure_lobe_p_value`. For sharper lobes or lower angles the density has peaks
    at the horizon that the test's own quadrature does not resolve."""
    settings = [(75.0, 0.2), (85.0, 0.2), (85.0, 0.5), (89.0, 0.5), (89.0, 1.0), (89.9, 1.0)]
    settings = settings[3:4] if quick else settings
    count, tests = 100_000 if quick else 400_000, []
    for angle, roughness in settings:
        xml = f'<float name="roughness" value="{roughness}"/><float name="specular_albedo" value="0.4"/>'
        sample, density = BSDFAdapter("sira_bsdf", xml, wi=_interaction(angle).wi)
        test = ChiSquareTest(SphericalDomain(), sample, density, sample_dim=3, sample_count=count, ires=32, seed=2)
        tests.append(test)
    error, bound = _run_tests(tests)
    return Row(
        "chi-squared: BSDF at grazing angles",
        "1 − p",
        count * len(settings),
        error,
        bound,
        0,
    )


MEASURES = (
    measure_density,
    measure_sampled_angles,
    measure_lobe_p_value,
    measure_light_weights,
    measure_reflectance_weights,
    measure_reflectance_energy,
    measure_reflectance_p_value,
)
