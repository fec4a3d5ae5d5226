"""Networks: parameters, both modes of evaluation, gradients and appearance decoders equal float64 and differences."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from conftest import SMALL
from doubles import encoded_in_double, head_field, in_double, points_near_surface

from sira_mi.avatar import decoders
from sira_mi.fields import mlp, sdf
from sira_mi.fields.encoding import encoded_size


def test_flat_parameters_are_all_used_and_counted():
    architecture = mlp.Architecture(inputs=15, outputs=4, width=8, depth=2, latent=3)
    assert architecture.parameters == (15 * 8 + 8 + 3 * 8) + (8 * 8 + 8 + 3 * 8) + (8 * 4 + 4)
    for parameters in (
        mlp.initial_parameters(architecture, np.random.default_rng(0)),
        sdf.sphere_parameters(architecture, np.random.default_rng(0), 1.0),
    ):
        assert parameters.shape == (architecture.parameters,) and parameters.dtype == np.float32
    flat = mi.Float(np.arange(architecture.parameters, dtype=np.float32))
    layers = mlp.layers(architecture, flat)
    assert [(w.shape, b.shape) for w, b in layers] == [((8, 15), (8, 1)), ((8, 8), (8, 1)), ((4, 8), (4, 1))]
    assert layers[1][0].numpy()[0, 0] == 15 * 8 + 8 + 3 * 8


def test_sizes_that_no_network_has_are_refused():
    for sizes in ((0, 1, 8, 2), (3, 1, 8, 0), (3, 1, 4096, 40), (3, 1, 8, 2, -1)):
        with pytest.raises(ValueError, match="unusable"):
            mlp.Architecture(*sizes)


def test_geometric_initialisation_is_a_coarse_sphere():
    architecture = mlp.Architecture(encoded_size(6), 1, 256, 4)
    parameters = sdf.sphere_parameters(architecture, np.random.default_rng(5), 1.4)
    x = points_near_surface(300)
    x /= np.linalg.norm(x, axis=0)
    f = [in_double(architecture, parameters, None, encoded_in_double(r * x, 6))[0] for r in (0.3, 1.4, 2.6)]
    assert f[0].max() < 0 < f[2].min()
    assert abs(f[1].mean()) < 0.4


@pytest.mark.parametrize("name", ["deformation", "diffuse_albedo", "albedo_refinement"])
def test_both_modes_and_float64_agree_in_value_and_gradient(avatar, name):
    """Every decoder that exists in both modes is a composition of these and of the encoding, tested below."""
    architecture = SMALL.networks[name]
    latent = avatar.tensors.get({"deformation": "z_sdf", "diffuse_albedo": "z_a"}.get(name))
    h = np.random.default_rng(1).uniform(-1, 1, (architecture.inputs, 500)).astype(np.float32)
    weight = mi.TensorXf(np.random.default_rng(2).standard_normal((architecture.outputs, 500)).astype(np.float32))

    def run(cooperative: bool):
        parameters = mi.Float(avatar.tensors[name])
        z = None if latent is None else mi.TensorXf(latent[:, None])
        dr.enable_grad(parameters)
        if z is not None:
            dr.enable_grad(z)
        network = mlp.layers(architecture, parameters, z)
        if cooperative:
            outputs = mlp.evaluate_cooperative(mlp.pack(network), [mi.Float(row) for row in h])
            outputs = dr.concat([mi.TensorXf(mi.Float(o), (1, 500)) for o in outputs], axis=0)
        else:
            outputs = mlp.evaluate(network, mi.TensorXf(h))
        dr.backward(dr.sum(outputs * weight, axis=None))
        return outputs.numpy(), dr.grad(parameters).numpy(), dr.grad(z).numpy() if z is not None else np.zeros(1)

    tensor, symbolic = run(False), run(True)
    exact = in_double(architecture, avatar.tensors[name], latent, h.astype(np.float64))
    for mine, other in zip(tensor, symbolic, strict=True):
        assert np.abs(mine - other).max() < 1e-5 * max(1, np.abs(mine).max())
    assert np.abs(tensor[0] - exact).max() < 1e-5 * max(1, np.abs(exact).max())
    assert np.abs(tensor[1]).max() > 0


@pytest.mark.slow
def test_appearance_decoders_agree_in_both_modes(avatar):
    networks, t = SMALL.networks, avatar.tensors
    x = points_near_surface(400)

    def layers(name, latent=None):
        z = None if latent is None else mi.TensorXf(t[latent][:, None])
        return mlp.layers(networks[name], mi.Float(t[name]), z)

    field = head_field(avatar)
    x_ref, gamma = sdf.deform(field, mi.TensorXf(x))
    point, features = sdf.deform_cooperative(mlp.pack(field.deformation), 2, [mi.Float(c) for c in x])
    a, s, r = layers("diffuse_albedo", "z_a"), layers("specular_albedo", "z_s"), layers("albedo_refinement")
    pairs = [
        (x_ref, point),
        (gamma, features),
        (
            decoders.diffuse_albedo(a, 2, x_ref, gamma),
            decoders.diffuse_albedo_cooperative(mlp.pack(a), 2, point, features),
        ),
        (decoders.specular_albedo(s, 1, x_ref), decoders.specular_albedo_cooperative(mlp.pack(s), 1, point)),
        (
            decoders.albedo_refinement(r, 3, x_ref, gamma),
            decoders.albedo_refinement_cooperative(mlp.pack(r), 3, point, features),
        ),
    ]
    for tensor, rows in pairs:
        assert np.abs(tensor.numpy() - np.stack([row.numpy() for row in rows])).max() < 1e-5


def test_illumination_decoder_gives_unit_axes_and_bounded_lobes(avatar):
    """Even far from where it was trained."""
    network = mlp.layers(SMALL.networks["illumination"], mi.Float(avatar.tensors["illumination"] * 30))
    z = np.random.default_rng(0).standard_normal((SMALL.illumination_latent, 5)).astype(np.float32) * 20
    lobes = decoders.illumination(network, mi.TensorXf(z)).numpy()
    assert lobes.shape == (SMALL.lobes, 7, 5) and np.isfinite(lobes).all()
    assert np.abs(np.linalg.norm(lobes[:, :3], axis=1) - 1).max() < 1e-3
    for rows, (low, high) in ((lobes[:, 3], decoders.LOG_SHARPNESS), (lobes[:, 4:], decoders.LOG_AMPLITUDE)):
        assert np.exp(low) * 0.999 <= rows.min() and rows.max() <= np.exp(high) * 1.001
    single = decoders.illumination(network, mi.TensorXf(z[:, 2:3].copy())).numpy()
    np.testing.assert_allclose(lobes[:, :, 2], single[:, :, 0], rtol=1e-4)


def test_refined_albedo_is_equation_11_within_its_range():
    base, fine = mi.TensorXf([[0.2, 0.9, 0.1]]), mi.TensorXf([[0.5, 0.5, -0.5]])
    np.testing.assert_allclose(decoders.refine_albedo(base, fine, 0.4).numpy(), [[0.4, 1.0, 0.0]], atol=1e-6)


def test_several_latents_at_once_equal_single_evaluations(avatar):
    architecture = SMALL.networks["deformation"]
    rng = np.random.default_rng(4)
    latents = rng.standard_normal((SMALL.sdf_latent, 3)).astype(np.float32)
    h = rng.uniform(-1, 1, (architecture.inputs, 3 * 40)).astype(np.float32)
    parameters = mi.Float(avatar.tensors["deformation"])
    z = mi.TensorXf(latents)
    dr.enable_grad(parameters, z)
    together = mlp.evaluate(mlp.layers(architecture, parameters, z), mi.TensorXf(h))
    dr.backward(dr.sum(together * together, axis=None))
    gradient = dr.grad(parameters).numpy()
    summed = np.zeros_like(gradient)
    for k in range(3):
        mine = slice(40 * k, 40 * (k + 1))
        dr.disable_grad(parameters)
        dr.enable_grad(parameters)
        column = mi.TensorXf(latents[:, k : k + 1].copy())
        dr.enable_grad(column)
        alone = mlp.evaluate(mlp.layers(architecture, parameters, column), mi.TensorXf(h[:, mine].copy()))
        dr.backward(dr.sum(alone * alone, axis=None))
        np.testing.assert_allclose(together.numpy()[:, mine], alone.numpy(), atol=1e-5)
        np.testing.assert_allclose(dr.grad(z).numpy()[:, k], dr.grad(column).numpy()[:, 0], rtol=1e-3, atol=1e-4)
        summed += dr.grad(parameters).numpy()
    assert np.abs(gradient - summed).max() < 1e-5 * np.abs(summed).max()


@pytest.mark.parametrize("latents", [1, 4])
def test_fused_layers_equal_plain_operations_in_value_and_both_passes(latents):
    """`evaluate_with_tangents` has its derivatives written out: they are those that Dr.Jit finds for the same in plain
    operations, in the reverse pass for every input and in the forward pass along a random direction."""
    network, rng = mlp.Architecture(5, 3, 8, 3, 4), np.random.default_rng(0)
    arrays = [mlp.initial_parameters(network, rng) / 5, rng.standard_normal((4, latents)) * 0.1]
    arrays += [rng.standard_normal((5, 6 * latents)) * 0.05 for _ in range(3)]
    kinds = (mi.Float, *[mi.TensorXf] * 4)

    def loss(function, inputs):
        parameters, latent, x, *tangents = inputs
        value, slopes = function(mlp.layers(network, parameters, latent), x, tangents)
        return dr.sum(value * value, axis=None) + dr.sum(slopes[0] * slopes[1] * slopes[1], axis=None)

    def fresh():
        inputs = [kind(a.astype(np.float32)) for kind, a in zip(kinds, arrays, strict=True)]
        dr.enable_grad(*inputs)
        return inputs

    results = {}
    for function in (mlp.evaluate_reference, mlp.evaluate_with_tangents):
        inputs = fresh()
        total = loss(function, inputs)
        dr.backward(total)
        reverse = [dr.grad(i).numpy() for i in inputs]
        inputs = fresh()
        for k, (i, kind, a) in enumerate(zip(inputs, kinds, arrays, strict=True)):
            dr.set_grad(i, kind(np.random.default_rng(k).standard_normal(a.shape).astype(np.float32)))
        forward = dr.forward_to(loss(function, inputs))
        results[function] = [total.numpy(), *reverse, forward.numpy()]
    for plain, fused in zip(*results.values(), strict=True):
        assert np.abs(plain).max() > 0
        np.testing.assert_allclose(fused, plain, atol=2e-5 * np.abs(plain).max())


@pytest.mark.slow
def test_gradients_repeat_bit_for_bit(avatar):
    """With latents, tangents and many points; atomic additions would differ from run to run."""
    x = mi.TensorXf(points_near_surface(20000))

    def gradient():
        values = {k: mi.Float(avatar.tensors[k]) for k in ("deformation", "reference", "z_sdf")}
        dr.enable_grad(values)
        f, slope, x_ref, gamma = sdf.surface(head_field(avatar, **values), x)
        total = f * f + dr.sum(slope * x_ref, axis=0) + dr.sum(gamma * gamma, axis=0)
        dr.backward(dr.mean(total, axis=None))
        return [dr.grad(v).numpy() for v in values.values()]

    first = gradient()
    for _ in range(4):
        assert all((a == b).all() for a, b in zip(first, gradient(), strict=True))
