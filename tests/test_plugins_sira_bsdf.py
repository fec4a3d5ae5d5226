"""The BSDF `sira_bsdf`: sampling, reciprocity, energy, derivatives, and agreement with the closed form."""

import sira_mi  # noqa: F401, I001  (first: Dr.Jit must find LLVM)

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

mi.set_variant("llvm_ad_rgb")

from mitsuba.chi2 import BSDFAdapter, ChiSquareTest, SphericalDomain  # noqa: E402

from sira_mi.fields.directions import fibonacci_directions  # noqa: E402
from sira_mi.sg import shading  # noqa: E402


@pytest.fixture(autouse=True)
def scratch_folder(tmp_path_factory, monkeypatch):
    """A failing chi-squared test writes its histogram into the working folder."""
    monkeypatch.chdir(tmp_path_factory.mktemp("chi2"))


def direction(angle, azimuth=0.0):
    angle, azimuth = np.radians(angle), np.radians(azimuth)
    x, y, z = np.sin(angle) * np.cos(azimuth), np.sin(angle) * np.sin(azimuth), np.cos(angle)
    return mi.Vector3f(float(x), float(y), float(z))


def interaction(angle, width=1):
    si = dr.zeros(mi.SurfaceInteraction3f, width)
    si.wi = direction(angle)
    si.sh_frame = mi.Frame3f(mi.Vector3f(0, 0, 1))
    si.n = mi.Normal3f(0, 0, 1)
    return si


def bsdf(**parameters):
    return mi.load_dict({"type": "sira_bsdf", **parameters})


@pytest.mark.parametrize("roughness", [0.2, 0.5, 1.0])
@pytest.mark.parametrize("angle", [0, 40, 75])
def test_sampling_has_the_density_it_claims(roughness, angle):
    xml = f'<float name="roughness" value="{roughness}"/><float name="specular_albedo" value="0.4"/>'
    functions = BSDFAdapter("sira_bsdf", xml, wi=direction(angle))
    ires = 24 if roughness < 0.3 else 8
    test = ChiSquareTest(SphericalDomain(), *functions, sample_dim=3, sample_count=200_000, ires=ires, seed=2)
    assert test.run(), test.messages


@pytest.mark.slow
@pytest.mark.parametrize("k_s", [0.0, 50.0, 1e6])
@pytest.mark.parametrize(("roughness", "diffuse"), [(0.5, 0.5), (0.5, 0.0), (0.2, 0.5), (0.2, 0.0), (0.1, 0.0)])
def test_the_density_holds_for_every_weight_of_the_specular_term(roughness, diffuse, k_s):
    """Samples whose value is 0 count: `BSDFAdapter` drops them, though their density is positive. Without a diffuse
    term these are the cosine lobe's samples where the normal distribution is below the numbers of single precision."""
    plugin, ctx = bsdf(roughness=roughness, diffuse_albedo=diffuse, k_s=k_s), mi.BSDFContext()

    def sample(u):
        bs, _ = plugin.sample(ctx, interaction(40), u.x, mi.Point2f(u.y, u.z))
        return bs.wo, dr.select(bs.pdf > 0.0, 1.0, 0.0)

    def density(wo):
        return plugin.pdf(ctx, interaction(40), wo)

    test = ChiSquareTest(SphericalDomain(), sample, density, sample_dim=3, sample_count=100_000, ires=24, seed=2)
    assert test.run(), test.messages


@pytest.mark.parametrize("component", [0, 1])
def test_single_components_are_sampled_with_their_density(component):
    """Only the glossy or only the diffuse component of a context."""
    ctx = mi.BSDFContext()
    ctx.component = component
    functions = BSDFAdapter("sira_bsdf", "", wi=direction(50), ctx=ctx)
    test = ChiSquareTest(SphericalDomain(), *functions, sample_dim=3, sample_count=200_000, ires=8, seed=2)
    assert test.run(), test.messages


@pytest.mark.parametrize("angle", [0, 30, 60, 85])
def test_density_and_distribution_integrate_to_one(angle):
    """Density over the upper hemisphere plus the share of samples below it, which are rejected."""
    for roughness in (0.3, 0.6, 1.0):
        plugin, si = bsdf(roughness=roughness), interaction(angle, 1 << 20)
        light, weight = hemisphere(1024)
        ctx = mi.BSDFContext()
        total = dr.sum(plugin.pdf(ctx, si, light) * weight)[0]
        random = np.random.default_rng(1).random((3, 1 << 20))
        samples, _ = plugin.sample(ctx, si, mi.Float(random[0]), mi.Point2f(random[1:]))
        kept = (samples.pdf.numpy() > 0).mean()
        assert total == pytest.approx(kept, abs=3e-3)


def hemisphere(size):
    """Directions and solid angles of a midpoint rule in (√(1 − z), φ), finest where reflections at grazing are not."""
    t, phi = np.meshgrid((np.arange(size) + 0.5) / size, (np.arange(size) + 0.5) / size * 2 * np.pi)
    t, phi = t.ravel(), phi.ravel()
    z = t**2
    rim = np.sqrt(1 - z**2)
    weight = 2 * t / size * 2 * np.pi / size
    return mi.Vector3f(np.stack([rim * np.cos(phi), rim * np.sin(phi), z])), mi.Float(weight)


@pytest.mark.parametrize("angle", [10, 50, 80])
def test_sample_eval_and_pdf_agree(angle):
    plugin, si, ctx = bsdf(roughness=0.4, k_s=0.7), interaction(angle, 2000), mi.BSDFContext()
    random = np.random.default_rng(0).random((3, 2000))
    samples, weight = plugin.sample(ctx, si, mi.Float(random[0]), mi.Point2f(random[1:]))
    value, pdf = plugin.eval(ctx, si, samples.wo), plugin.pdf(ctx, si, samples.wo)
    both = plugin.eval_pdf(ctx, si, samples.wo)
    np.testing.assert_allclose(samples.pdf.numpy(), pdf.numpy(), rtol=1e-5)
    np.testing.assert_allclose((weight * samples.pdf).numpy(), value.numpy(), rtol=1e-5, atol=1e-7)
    np.testing.assert_array_equal(both[0].numpy(), value.numpy())
    np.testing.assert_array_equal(both[1].numpy(), pdf.numpy())
    assert np.isfinite(weight.numpy()).all() and weight.numpy().max() < 20


def pairs_of_directions(roughness, count=20_000):
    """Views and lights [3, count] above the surface, in single precision: a third of the lights anywhere, the others
    reflections about half vectors that follow the normal distribution; views to 0.1 degrees above the horizon."""
    generator = np.random.default_rng(3)
    upper = generator.standard_normal((2, 3, count))
    upper[:, 2] = np.abs(upper[:, 2]) * generator.uniform(0, 1, (2, count)) ** 3 + 2e-3
    view, other = upper / np.linalg.norm(upper, axis=1, keepdims=True)
    half = np.stack([*(roughness**2 / np.sqrt(2) * generator.standard_normal((2, count))), np.ones(count)])
    half /= np.linalg.norm(half, axis=0)
    light = np.where(generator.random(count) < 1 / 3, other, 2 * (half * view).sum(axis=0) * half - view)
    return view.astype(np.float32), (light / np.linalg.norm(light, axis=0)).astype(np.float32)


@pytest.mark.parametrize("roughness", [0.02, 0.1, 0.35, 1.0])
@pytest.mark.parametrize("k_s", [1.0, 1000.0])
def test_is_reciprocal(roughness, k_s):
    """To a few roundings, at grazing angles too."""
    plugin, ctx = bsdf(roughness=roughness, k_s=k_s, specular_albedo=0.04), mi.BSDFContext()
    view, light = pairs_of_directions(roughness)
    values = []
    for incoming, outgoing in ((view, light), (light, view)):
        si = interaction(0, view.shape[1])
        si.wi = mi.Vector3f(incoming)
        values.append(plugin.eval(ctx, si, mi.Vector3f(outgoing)).x.numpy() / outgoing[2])
    assert (values[0] > 0.1 * k_s).sum() > 500
    above = light[2] > 0
    np.testing.assert_allclose(values[0][above], values[1][above], rtol=1e-6, atol=1e-30)


def test_is_black_below():
    plugin, ctx = bsdf(roughness=0.35), mi.BSDFContext()
    assert not plugin.eval(ctx, interaction(30), direction(120)).numpy().any()
    assert not plugin.eval(ctx, interaction(120), direction(30)).numpy().any()


def model_albedo(angle, roughness, diffuse, specular):
    """Directional albedo of the model in float64, cosines not cancelled."""
    nodes, weights = np.polynomial.legendre.leggauss(128)
    z, phi = 0.5 * (nodes + 1), 2 * np.pi * (np.arange(1024) + 0.5) / 1024
    rim = np.sqrt(1 - z**2)[:, None]
    light = np.stack([rim * np.cos(phi), rim * np.sin(phi), z[:, None] + 0 * phi], axis=-1)
    view = np.array([np.sin(np.radians(angle)), 0.0, np.cos(np.radians(angle))])
    half = light + view
    half /= np.linalg.norm(half, axis=-1, keepdims=True)
    cosine, k = half @ view, (roughness + 1) ** 2 / 8
    density = np.exp(2 / roughness**4 * (half[..., 2] - 1)) / (np.pi * roughness**4)
    fresnel = specular + (1 - specular) * 2.0 ** (-(5.55473 * cosine + 6.8316) * cosine)
    masking = light[..., 2] / (light[..., 2] * (1 - k) + k) * view[2] / (view[2] * (1 - k) + k)
    value = diffuse / np.pi + density * fresnel * masking / (4 * light[..., 2] * view[2])
    return (value * light[..., 2] * (0.5 * weights[:, None] * 2 * np.pi / 1024)).sum()


@pytest.mark.slow
def test_white_furnace_is_the_models_own():
    """Sampled albedo never exceeds the model's by more than noise; the model's own excess is printed."""
    print("\nwhite furnace, largest albedo over view angles")
    for diffuse, specular in ((0.0, 1.0), (1.0, 0.04), (0.5, 0.5)):
        for roughness in (0.25, 0.5):
            plugin, ctx = bsdf(diffuse_albedo=diffuse, specular_albedo=specular, roughness=roughness), mi.BSDFContext()
            pairs = []
            for angle in (1, 30, 60, 75, 85):
                si = interaction(angle, 1 << 16)
                random = np.random.default_rng(angle).random((3, 1 << 16))
                weight = plugin.sample(ctx, si, mi.Float(random[0]), mi.Point2f(random[1:]))[1].x.numpy()
                exact = model_albedo(angle, roughness, diffuse, specular)
                pairs.append((weight.mean(), exact))
                assert abs(weight.mean() - exact) < 5 * weight.std() / 256 + 1e-3
            largest = np.max(pairs, axis=0)
            print(f"  a={diffuse} s={specular} r={roughness}: sampled {largest[0]:.4f}, model {largest[1]:.4f}")


@pytest.mark.slow
def test_closed_form_agrees_with_monte_carlo():
    """`shade` against this plugin under `sg_envmap` with the same lobes, by view angle; the errors are printed."""
    generator = np.random.default_rng(4)
    lights = np.concatenate([fibonacci_directions(48), generator.uniform(3, 50, (48, 1))], axis=1)
    lights = mi.TensorXf(np.concatenate([lights, generator.uniform(0.2, 2, (48, 3))], axis=1).astype(np.float32))
    light = mi.load_dict({"type": "sg_envmap", "lobes": lights})
    specular_albedo, count, ctx = 0.375, 1 << 19, mi.BSDFContext()
    print("\nclosed form against Monte Carlo, relative error (diffuse, specular)")
    for roughness in (0.35, 0.5, 0.7):
        diffuse_only = bsdf(diffuse_albedo=1.0, k_s=0.0)
        specular_only = bsdf(diffuse_albedo=0.0, specular_albedo=specular_albedo, roughness=roughness)
        for angle in (0, 30, 60, 75, 82):
            si = interaction(angle, count)
            ds, weight = light.sample_direction(si, mi.Point2f(generator.random((2, count))))
            exact = [
                (weight * plugin.eval(ctx, si, ds.d)).numpy().mean(axis=1) for plugin in (diffuse_only, specular_only)
            ]
            value = shading.shade(
                mi.Vector3f(0, 0, 1), direction(angle), mi.Float(specular_albedo), mi.Float(roughness), lights
            )
            errors = [
                np.abs(v.numpy()[:, 0] / e - 1).max() for v, e in zip((value[0] / np.pi, value[1]), exact, strict=True)
            ]
            print(f"  r={roughness} view {angle:2d}°: {errors[0]:.4f} {errors[1]:.4f}")
            assert errors[0] < 0.01 and errors[1] < (0.05 if angle <= 60 else 0.12)


@pytest.mark.parametrize("key", ["roughness", "k_s", "diffuse_albedo.value", "specular_albedo.value"])
def test_gradients_match_differences(key):
    plugin, ctx = bsdf(roughness=0.45, k_s=0.8, specular_albedo=0.3, diffuse_albedo=0.4), mi.BSDFContext()
    params, si, wo = mi.traverse(plugin), interaction(50, 64), direction(40, 150)
    wo = dr.normalize(wo + 0.3 * mi.Vector3f(np.random.default_rng(0).standard_normal((3, 64))))

    def total():
        return dr.sum(plugin.eval(ctx, si, wo).x)

    start = type(params[key])(params[key])
    dr.enable_grad(params[key])
    params.update()
    dr.backward(total())
    derivative = float(dr.grad(params[key]).numpy().sum())
    values = []
    for sign in (1, -1):
        params[key] = start + sign * 2e-3
        params.update()
        values.append(float(total()[0]))
    assert derivative == pytest.approx((values[0] - values[1]) / 4e-3, rel=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("integrator", ["path", "prb"])
def test_renders_two_sided_with_textures_and_gradients(integrator):
    """Nested in `twosided`, with bitmap textures, under a stock integrator: light arrives, gradients are finite."""
    texture = {"type": "bitmap", "raw": True, "data": mi.TensorXf(np.full((4, 4, 3), 0.4, np.float32))}
    grey = {"type": "bitmap", "raw": True, "data": mi.TensorXf(np.full((4, 4, 1), 0.3, np.float32))}
    nested = {"type": "sira_bsdf", "diffuse_albedo": texture, "specular_albedo": grey}
    scene = mi.load_dict(
        {
            "type": "scene",
            "shape": {"type": "sphere", "bsdf": {"type": "twosided", "nested": nested}},
            "light": {"type": "sg_envmap"},
            "integrator": {"type": integrator, "max_depth": 3},
            "sensor": {
                "type": "perspective",
                "to_world": mi.ScalarTransform4f().look_at([0, 0, 5], [0, 0, 0], [0, 1, 0]),
                "film": {"type": "hdrfilm", "width": 16, "height": 16},
            },
        }
    )
    params = mi.traverse(scene)
    keys = [key for key in params.keys() if key.endswith(("albedo.data", "roughness", "k_s"))]  # noqa: SIM118
    assert len(keys) == 4
    for key in keys:
        dr.enable_grad(params[key])
    params.update()
    image = mi.render(scene, params, spp=16)
    dr.backward(dr.mean(image, axis=None))
    for key in keys:
        gradient = dr.grad(params[key]).numpy()
        assert np.isfinite(gradient).all() and np.abs(gradient).max() > 0


def test_attributes_and_diffuse_reflectance_for_integrators():
    plugin = bsdf(diffuse_albedo={"type": "rgb", "value": [0.6, 0.4, 0.2]}, specular_albedo=0.3)
    si = interaction(20)
    np.testing.assert_allclose(plugin.eval_diffuse_reflectance(si).numpy()[:, 0], [0.6, 0.4, 0.2], rtol=1e-5)
    assert plugin.specular_albedo.eval_1(si).numpy() == pytest.approx(0.3)
    assert plugin.roughness.numpy() == 0.5 and plugin.k_s.numpy() == 1.0


@pytest.mark.parametrize("parameters", [{"roughness": 0.0}, {"roughness": 1.5}, {"k_s": -1.0}])
def test_bad_parameters_are_errors(parameters):
    with pytest.raises(Exception, match="it must be"):
        bsdf(**parameters)
