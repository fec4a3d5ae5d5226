"""The texture `neural_albedo`: derivatives, channels, and use inside stock BSDFs."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from conftest import camera, slopes
from doubles import head_field

from sira_mi.export import scene as scenes
from sira_mi.fields.sdf import deform
from sira_mi.plugins.neural_albedo import NeuralAlbedo

DIFFUSE = ("weights", "latent", "refinement", "k_r")


def texture(path, **options) -> NeuralAlbedo:
    return mi.load_dict({"type": "neural_albedo", "avatar": path, **options})


def interaction(count: int = 200):
    si = dr.zeros(mi.SurfaceInteraction3f, count)
    si.p = mi.Point3f(np.random.default_rng(0).uniform(-1.3, 1.3, (3, count)).astype(np.float32))
    return si


def in_reference_space(avatar, p):
    """x_ref and γ of points under the avatar's own deformation."""
    return deform(head_field(avatar), mi.TensorXf(np.array(p)))


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["diffuse", "specular"])
def test_both_modes_agree(avatar, avatar_path, kind):
    albedo, si = texture(avatar_path, kind=kind), interaction()
    x_ref, gamma = in_reference_space(avatar, si.p)
    columns = albedo.evaluate_networks(x_ref, gamma).numpy()
    values = np.array(albedo.eval(si))
    assert columns.shape[0] == (3 if kind == "diffuse" else 1)
    np.testing.assert_allclose(values, np.broadcast_to(columns, values.shape), atol=1e-5)
    assert columns.min() >= 0 and columns.max() <= 1 and np.ptp(columns) > 0.02
    one = albedo.eval_1(si).numpy()
    expected = columns[0] if kind == "specular" else np.array([0.212671, 0.715160, 0.072169]) @ columns
    np.testing.assert_allclose(one, expected, atol=1e-5)
    np.testing.assert_array_equal(np.array(albedo.eval_3(si)), values)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "key"), [*(("diffuse", k) for k in DIFFUSE), ("specular", "weights"), ("specular", "latent")]
)
def test_derivatives_without_noise(avatar_path, kind, key):
    albedo, si = texture(avatar_path, kind=kind), interaction()
    params = mi.traverse(albedo)
    params["k_r" if kind == "diffuse" else key] = mi.Float(0.5) if kind == "diffuse" else params[key]
    params.update()
    weight = mi.Color3f(np.random.default_rng(1).uniform(0, 1, (3, 200)).astype(np.float32))
    start = params[key].numpy().copy()
    value = mi.Float(start)
    dr.enable_grad(value)
    params[key] = value
    params.update()
    dr.backward(dr.sum(dr.sum(albedo.eval(si) * weight)))

    def loss(flat):
        params[key] = mi.Float(flat)
        params.update()
        return float((np.array(albedo.eval(si), np.float64) * np.array(weight)).sum())

    ad, difference = slopes(loss, start, dr.grad(value).numpy(), 1e-3)
    assert ad == pytest.approx(difference, rel=1e-3)


def lit(path, bsdf, integrator):
    """A ball with the texture under a constant sky."""
    return mi.load_dict(
        {
            "type": "scene",
            "ball": {"type": "sphere", "bsdf": bsdf},
            "sensor": scenes.sensor(camera(36, 16)),
            "light": {"type": "constant"},
            "integrator": integrator,
        }
    )


@pytest.mark.slow
def test_derivatives_under_prb(avatar, avatar_path):
    """All of a texture's parameters at once, inside a symbolic loop."""
    albedo = {"type": "neural_albedo", "avatar": avatar_path}
    scene = lit(avatar_path, {"type": "diffuse", "reflectance": albedo}, {"type": "prb", "max_depth": 2})
    params = mi.traverse(scene)
    keys = {key: f"ball.bsdf.reflectance.{key}" for key in DIFFUSE}
    starts = {key: params[name].numpy().copy() for key, name in keys.items()}
    values = {key: mi.Float(start) for key, start in starts.items()}
    dr.enable_grad(values)
    for key, name in keys.items():
        params[name] = values[key]
    params.update()
    dr.backward(dr.mean(mi.render(scene, params, spp=16, seed=1, seed_grad=2)[:, :, :3], axis=None))
    for key, name in keys.items():

        def loss(flat, name=name):
            params[name] = mi.Float(flat)
            params.update()
            return float(mi.render(scene, spp=16, seed=2).numpy()[:, :, :3].mean(dtype=np.float64))

        ad, difference = slopes(loss, starts[key], dr.grad(values[key]).numpy(), 5e-4)
        params[name] = mi.Float(starts[key])
        params.update()
        assert ad == pytest.approx(difference, rel=1e-2), key


@pytest.mark.slow
@pytest.mark.parametrize(
    "bsdf",
    [
        lambda t: {"type": "diffuse", "reflectance": t()},
        lambda t: {"type": "principled", "base_color": t(), "roughness": t(kind="specular")},
        lambda t: {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": t()}},
    ],
)
def test_it_works_inside_stock_bsdfs(avatar_path, bsdf):
    """The picture is brighter with a brighter texture, and finite."""
    make = lambda **options: {"type": "neural_albedo", "avatar": avatar_path, **options}  # noqa: E731
    scene = lit(avatar_path, bsdf(make), {"type": "direct", "bsdf_samples": 0})
    image = mi.render(scene, spp=4).numpy()
    assert np.isfinite(image).all()
    params = mi.traverse(scene)
    key = next(k for k in params.keys() if k.endswith(("base_color.weights", "reflectance.weights")))  # noqa: SIM118
    weights = params[key].numpy().copy()
    weights[-3:] += 2  # the biases of the last layer
    params[key] = mi.Float(weights)
    params.update()
    assert mi.render(scene, spp=4).numpy()[4:12, 4:12, :3].mean() > 1.02 * image[4:12, 4:12, :3].mean()


def test_gradients_enabled_without_an_update_are_refused(avatar_path):
    """They would be lost silently: the packed networks are those of the last update."""
    albedo = texture(avatar_path)
    params = mi.traverse(albedo)
    dr.enable_grad(params["weights"])
    with pytest.raises(RuntimeError, match=r"params\.update"):
        albedo.eval(interaction())


@pytest.mark.slow
def test_a_refinement_that_is_switched_off_is_not_evaluated(avatar, avatar_path):
    """k_r = 0 gives the base albedo; enabling its gradient brings the refinement back."""
    albedo, si = texture(avatar_path), interaction()
    params = mi.traverse(albedo)
    full = np.array(albedo.eval(si))
    params["k_r"] = mi.Float(0.0)
    params.update()
    base = np.array(albedo.eval(si))
    assert np.abs(full - base).max() > 1e-3
    value = mi.Float(0.0)
    dr.enable_grad(value)
    params["k_r"] = value
    params.update()
    attached = albedo.eval(si)
    np.testing.assert_allclose(np.array(dr.detach(attached)), base, atol=1e-6)
    dr.backward(dr.sum(dr.sum(attached)))
    assert dr.grad(value).numpy().item() != 0


def test_another_kind_is_refused(avatar_path):
    with pytest.raises(Exception, match="diffuse"):
        texture(avatar_path, kind="shiny")


@pytest.mark.slow
def test_textures_of_one_head_are_evaluated_together(avatar_path):
    """`sira_bsdf` asks both albedos of a head at once: the same values and derivatives as one by one. Textures of
    other heads, without a head or baked do not go together."""
    head = mi.load_dict(scenes.head(avatar_path, voxel=0.2))
    diffuse, specular = head.bsdf().diffuse_albedo, head.bsdf().specular_albedo
    assert diffuse.shares_space(specular)
    results = []
    for together in (True, False):
        params = mi.traverse(head)
        latents = [mi.Float(params[f"bsdf.{name}.latent"]) for name in ("diffuse_albedo", "specular_albedo")]
        for name, latent in zip(("diffuse_albedo", "specular_albedo"), latents, strict=True):
            dr.enable_grad(latent)
            params[f"bsdf.{name}.latent"] = latent
        params.update()
        si = interaction()
        pair = diffuse.eval_with(specular, si) if together else (diffuse.eval(si), specular.eval_1(si))
        dr.backward(dr.sum(dr.sum(pair[0])) + dr.sum(pair[1]))
        results.append([np.array(dr.detach(v)) for v in pair] + [dr.grad(v).numpy() for v in latents])
    for first, second in zip(*results, strict=True):
        np.testing.assert_allclose(first, second, rtol=1e-5, atol=1e-6)
        assert np.ptp(first) > 1e-3

    other = mi.load_dict(scenes.head(avatar_path, voxel=0.2)).bsdf().specular_albedo
    alone = texture(avatar_path, kind="specular")
    baked = texture(avatar_path, kind="specular", baked=True)
    assert not any(diffuse.shares_space(one) for one in (other, alone, baked, None))
