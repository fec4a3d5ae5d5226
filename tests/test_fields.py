"""Networks in both modes, derivatives of the field, extraction and tracing: against differences and slow references."""

import dataclasses

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import trimesh
from conftest import SMALL, slopes
from scipy.spatial.transform import Rotation

from sira_mi.conventions import DOMAIN_LOWER, DOMAIN_UPPER
from sira_mi.fields import appearance, extraction, mlp, sdf, tracing
from sira_mi.fields.encoding import encode, encode_cooperative, encode_with_tangents, encoded_size

RADIUS = 1.2


def head_field(avatar, **replaced) -> sdf.SdfField:
    """The avatar's field, with some of `deformation`, `reference` and `z_sdf` replaced by Floats."""
    values = {k: mi.Float(avatar.tensors[k]) for k in ("deformation", "reference", "z_sdf")} | replaced
    networks = avatar.architecture.networks
    latent = mi.TensorXf(values["z_sdf"], (len(values["z_sdf"]), 1))
    return sdf.SdfField(
        mlp.layers(networks["deformation"], values["deformation"], latent),
        mlp.layers(networks["reference"], values["reference"]),
        avatar.architecture.sdf_octaves,
    )


def points_near_surface(count: int, seed: int = 3) -> np.ndarray:
    """[3, count] float32 points of a shell about the head's surface."""
    rng = np.random.default_rng(seed)
    x = rng.standard_normal((3, count))
    return (x / np.linalg.norm(x, axis=0) * rng.uniform(0.9, 1.9, count)).astype(np.float32)


def in_double(architecture, parameters: np.ndarray, latent: np.ndarray | None, h: np.ndarray) -> np.ndarray:
    """The network in NumPy and float64, written from its definition."""
    offset = 0
    for k, (weight, bias, shift) in enumerate(architecture.shapes()):
        sizes = [a * b for a, b in (weight, bias, shift)]
        w, b, z = np.split(parameters[offset : offset + sum(sizes)].astype(np.float64), np.cumsum(sizes)[:2])
        offset += sum(sizes)
        h = w.reshape(weight) @ h + b[:, None]
        if shift[1] and latent is not None:
            h = h + z.reshape(shift) @ latent.astype(np.float64)[:, None]
        if k < architecture.depth:
            h = np.logaddexp(0, 100 * h) / 100
    assert offset == len(parameters)
    return h


def encoded_in_double(x: np.ndarray, octaves: int) -> np.ndarray:
    phases = [2.0**k * c for k in range(octaves) for c in x]
    return np.stack([*x, *np.sin(phases), *np.cos(phases)]) if octaves else x


def field_in_double(avatar, x: np.ndarray) -> np.ndarray:
    """Signed distances [N] in float64."""
    networks, t, octaves = avatar.architecture.networks, avatar.tensors, avatar.architecture.sdf_octaves
    delta = in_double(networks["deformation"], t["deformation"], t["z_sdf"], encoded_in_double(x, octaves))[:3]
    return in_double(networks["reference"], t["reference"], None, encoded_in_double(x + delta, octaves))[0]


# Networks


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


def test_appearance_decoders_agree_in_both_modes(avatar):
    networks, t = SMALL.networks, avatar.tensors
    x = points_near_surface(400)

    def layers(name, latent=None):
        z = None if latent is None else mi.TensorXf(t[latent][:, None])
        return mlp.layers(networks[name], mi.Float(t[name]), z)

    field = head_field(avatar)
    x_ref, gamma = sdf.deform(field, mi.TensorXf(x))
    point, features = appearance.deform_cooperative(mlp.pack(field.deformation), 2, [mi.Float(c) for c in x])
    a, s, r = layers("diffuse_albedo", "z_a"), layers("specular_albedo", "z_s"), layers("albedo_refinement")
    pairs = [
        (x_ref, point),
        (gamma, features),
        (
            appearance.diffuse_albedo(a, 2, x_ref, gamma),
            appearance.diffuse_albedo_cooperative(mlp.pack(a), 2, point, features),
        ),
        (appearance.specular_albedo(s, 1, x_ref), appearance.specular_albedo_cooperative(mlp.pack(s), 1, point)),
        (
            appearance.albedo_refinement(r, 3, x_ref, gamma),
            appearance.albedo_refinement_cooperative(mlp.pack(r), 3, point, features),
        ),
    ]
    for tensor, rows in pairs:
        assert np.abs(tensor.numpy() - np.stack([row.numpy() for row in rows])).max() < 1e-5


def test_illumination_decoder_gives_unit_axes_and_bounded_lobes(avatar):
    """Even far from where it was trained."""
    network = mlp.layers(SMALL.networks["illumination"], mi.Float(avatar.tensors["illumination"] * 30))
    z = np.random.default_rng(0).standard_normal((SMALL.illumination_latent, 5)).astype(np.float32) * 20
    lobes = appearance.illumination(network, mi.TensorXf(z)).numpy()
    assert lobes.shape == (SMALL.lobes, 7, 5) and np.isfinite(lobes).all()
    assert np.abs(np.linalg.norm(lobes[:, :3], axis=1) - 1).max() < 1e-3
    for rows, (low, high) in ((lobes[:, 3], appearance.LOG_SHARPNESS), (lobes[:, 4:], appearance.LOG_AMPLITUDE)):
        assert np.exp(low) * 0.999 <= rows.min() and rows.max() <= np.exp(high) * 1.001
    single = appearance.illumination(network, mi.TensorXf(z[:, 2:3].copy())).numpy()
    np.testing.assert_allclose(lobes[:, :, 2], single[:, :, 0], rtol=1e-4)


def test_refined_albedo_is_equation_11_within_its_range():
    base, fine = mi.TensorXf([[0.2, 0.9, 0.1]]), mi.TensorXf([[0.5, 0.5, -0.5]])
    np.testing.assert_allclose(appearance.refined_albedo(base, fine, 0.4).numpy(), [[0.4, 1.0, 0.0]], atol=1e-6)


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


# Derivatives


@pytest.mark.parametrize("octaves", [0, 3])
def test_encoding_and_its_tangents(octaves):
    x = points_near_surface(50)
    tangent = np.random.default_rng(1).standard_normal(x.shape).astype(np.float32)
    features, (slope,) = encode_with_tangents(mi.TensorXf(x), [mi.TensorXf(tangent)], octaves)
    assert features.shape[0] == encoded_size(octaves)
    h = 1e-6
    forward, back = (encoded_in_double(x.astype(np.float64) + s * h * tangent, octaves) for s in (1, -1))
    np.testing.assert_allclose(features.numpy(), encoded_in_double(x.astype(np.float64), octaves), atol=2e-6)
    np.testing.assert_allclose(slope.numpy(), (forward - back) / (2 * h), atol=1e-4)
    np.testing.assert_array_equal(encode(mi.TensorXf(x), octaves).numpy(), features.numpy())
    rows = encode_cooperative([mi.Float(c) for c in x], octaves)
    np.testing.assert_allclose(np.stack([r.numpy() for r in rows]), features.numpy(), atol=2e-6)


def test_gradient_of_the_field_equals_differences_in_float64(avatar):
    x = points_near_surface(300)
    f, gradient, x_ref, gamma = (a.numpy() for a in sdf.surface(head_field(avatar), mi.TensorXf(x)))
    exact, h = x.astype(np.float64), 1e-5
    np.testing.assert_allclose(f[0], field_in_double(avatar, exact), atol=1e-5)
    steps = h * np.eye(3)[:, :, None]
    difference = [(field_in_double(avatar, exact + s) - field_in_double(avatar, exact - s)) / (2 * h) for s in steps]
    np.testing.assert_allclose(gradient, difference, atol=1e-4)
    direction = np.random.default_rng(0).standard_normal(x.shape).astype(np.float32)
    value, slope = sdf.signed_distance_and_slope(head_field(avatar), mi.TensorXf(x), mi.TensorXf(direction))
    np.testing.assert_allclose(slope.numpy()[0], (gradient * direction).sum(axis=0), atol=1e-5)
    np.testing.assert_allclose(value.numpy(), f, atol=1e-6)
    again = sdf.deform(head_field(avatar), mi.TensorXf(x))
    np.testing.assert_allclose(again[0].numpy(), x_ref, atol=1e-6)
    np.testing.assert_allclose(again[1].numpy(), gamma, atol=1e-6)


def test_a_rigid_motion_is_one_and_carries_the_field_along(avatar):
    """(R | t) is a rotation for any vector, by that vector's angle for small ones; value and gradient of the moved
    field are those of the field at the moved point."""
    vector = np.array([0.3, -0.2, 0.1, 0.05, -0.1, 0.2], np.float32)
    motion = sdf.rigid_motion(mi.TensorXf(vector.reshape(6, 1)))
    matrix = motion.numpy()
    assert np.allclose(matrix[:, :3] @ matrix[:, :3].T, np.eye(3), atol=1e-6)
    assert np.linalg.det(matrix[:, :3]) == pytest.approx(1, abs=1e-6)
    expected = Rotation.from_rotvec(vector[:3]).as_matrix()
    assert np.allclose(matrix[:, :3], expected, atol=np.linalg.norm(vector[:3]) ** 3 / 10)
    still = head_field(avatar)
    moved = dataclasses.replace(still, motion=motion)
    x = points_near_surface(40)
    there = mi.TensorXf(np.ascontiguousarray(matrix[:, :3] @ x + matrix[:, 3:]))
    f, gradient, x_ref, gamma = (v.numpy() for v in sdf.surface(moved, mi.TensorXf(x)))
    g, slope, y_ref, delta = (v.numpy() for v in sdf.surface(still, there))
    for a, b in ((f, g), (gradient, matrix[:, :3].T @ slope), (x_ref, y_ref), (gamma, delta)):
        assert np.allclose(a, b, atol=1e-5)


def test_derivative_by_the_pose_equals_differences(avatar):
    """What the fit's pose is found by."""
    still, x = head_field(avatar), mi.TensorXf(points_near_surface(40))
    weight = mi.TensorXf(np.random.default_rng(1).standard_normal((1, 40)).astype(np.float32))

    def loss(pose):
        field = dataclasses.replace(still, motion=sdf.rigid_motion(mi.TensorXf(mi.Float(pose), (6, 1))))
        return dr.sum(sdf.surface(field, x)[0] * weight, axis=None)

    pose = np.array([0.1, -0.05, 0.2, 0.03, 0.01, -0.02], np.float32)
    attached = mi.Float(pose)
    dr.enable_grad(attached)
    dr.backward(loss(attached))
    analytic, difference = slopes(lambda p: loss(p).numpy().item(), pose, attached.grad.numpy(), 0.05)
    assert analytic == pytest.approx(difference, rel=5e-3)


@pytest.mark.parametrize("name", ["deformation", "reference", "z_sdf"])
def test_derivative_of_the_eikonal_loss_equals_differences(avatar, name):
    """The gradient of the field is primal code, so AD of a loss on it is first order."""
    x = mi.TensorXf(points_near_surface(400))

    def loss(value, attached=False):
        value = mi.Float(value)
        if attached:
            dr.enable_grad(value)
        gradient = sdf.surface(head_field(avatar, **{name: value}), x)[1]
        deviation = dr.sum(gradient * gradient, axis=0) - 1
        result = dr.mean(deviation * deviation, axis=None)
        if not attached:
            return float(result.numpy().item())
        dr.backward(result)
        return dr.grad(value).numpy()

    start = avatar.tensors[name]
    ad, difference = slopes(loss, start, loss(start, attached=True), 5e-3)
    assert ad == pytest.approx(difference, rel=1e-3)


# Extraction


def sphere(points: np.ndarray) -> np.ndarray:
    return (np.linalg.norm(points, axis=0) - RADIUS).astype(np.float32)


def watertight(surface) -> trimesh.Trimesh:
    mesh = trimesh.Trimesh(surface.vertices, surface.faces, process=False)
    assert mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0
    return mesh


def test_extracted_sphere_has_the_volume_and_area_of_a_sphere():
    mesh = watertight(extraction.extract(sphere, 0.05))
    assert mesh.volume == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=2e-3)
    assert mesh.area == pytest.approx(4 * np.pi * RADIUS**2, rel=2e-3)
    outward = (mesh.face_normals * mesh.triangles_center).sum(axis=1)
    assert (outward[mesh.area_faces > 1e-7] > 0).all()


def test_coarse_to_fine_extraction_equals_the_dense_one(avatar):
    field = head_field(avatar)
    evaluate = lambda x: sdf.evaluate_in_chunks(lambda p: sdf.signed_distance(field, p), x)[0][0]  # noqa: E731
    for function, voxel in ((evaluate, 0.1), (sphere, 0.07)):
        fast, slow = extraction.extract(function, voxel), extraction.extract_reference(function, voxel)
        np.testing.assert_array_equal(fast.faces, slow.faces)
        np.testing.assert_allclose(fast.vertices, slow.vertices, atol=1e-5)
        assert fast.grid.shape == slow.grid.shape and fast.spacing == pytest.approx(slow.spacing)
        watertight(fast)


def test_a_solid_that_leaves_the_box_is_closed_along_it():
    """Half a space below y = 0.5: a box with its lid on the field's surface."""
    surface = extraction.extract(lambda x: x[1] - 0.5, 0.1)
    mesh = watertight(surface)
    lower, upper = mesh.bounds
    assert lower == pytest.approx(DOMAIN_LOWER, abs=1e-3)
    assert upper == pytest.approx((DOMAIN_UPPER[0], 0.5, DOMAIN_UPPER[2]), abs=1e-3)
    on_lid = np.abs(surface.vertices[:, 1] - 0.5) < 1e-5
    inside = np.abs(surface.vertices[:, 0]) < 2.4
    assert not surface.on_box[on_lid & inside & (np.abs(surface.vertices[:, 2]) < 1.8)].any()
    assert surface.on_box[surface.vertices[:, 1] < 0.4].all()


@pytest.mark.parametrize("value", [1.0, -1.0])
def test_a_field_without_a_surface_is_named_so(value):
    if value < 0:
        mesh = watertight(extraction.extract(lambda x: np.full(x.shape[1], value, np.float32), 0.2))
        assert mesh.volume > 0  # solid everywhere: the box itself
    else:
        with pytest.raises(extraction.EmptySurfaceError):
            extraction.extract(lambda x: np.full(x.shape[1], value, np.float32), 0.2)


# Tracing


def rays_at_head(count: int, seed: int = 2) -> tuple[np.ndarray, np.ndarray]:
    """Origins and unit directions [3, count] of rays that all meet the head, none of them grazing."""
    rng = np.random.default_rng(seed)
    origin = rng.standard_normal((3, count))
    origin *= 4 / np.linalg.norm(origin, axis=0)
    direction = rng.uniform(-0.4, 0.4, (3, count)) - origin
    return origin.astype(np.float32), (direction / np.linalg.norm(direction, axis=0)).astype(np.float32)


def exact_hits(field, origin, direction):
    outside, inside = (
        mi.TensorXf(np.full((1, origin.shape[1]), 1.8, np.float32)),
        mi.TensorXf(np.full((1, origin.shape[1]), 4.0, np.float32)),
    )
    return tracing.bisection_hits_reference(field, mi.TensorXf(origin), mi.TensorXf(direction), outside, inside)


@pytest.mark.parametrize("offset", [0.02, -0.02])
def test_newton_steps_reach_the_bisected_hit_from_two_millimetres_off(avatar, offset):
    field = head_field(avatar)
    origin, direction = rays_at_head(500)
    exact = exact_hits(field, origin, direction).numpy()
    start = mi.TensorXf(exact + np.float32(offset))
    t, f = tracing.newton_hits(field, mi.TensorXf(origin), mi.TensorXf(direction), start)
    assert np.abs(t.numpy() - exact).max() < 1e-4
    assert np.abs(f.numpy()).max() < tracing.HIT_TOLERANCE


def test_sampled_crossings_lie_at_the_bisected_hits(avatar):
    """From starts too far off for Newton steps; a ray that passes by has none."""
    field = head_field(avatar)
    origin, direction = rays_at_head(200)
    exact = exact_hits(field, origin, direction).numpy()
    early = np.random.default_rng(0).uniform(0.05, 0.15, exact.shape).astype(np.float32)
    found = tracing.first_crossings(field, origin, direction, exact - early)
    assert np.abs(found - exact).max() < 5e-3
    away = tracing.first_crossings(field, origin, -direction, exact)
    assert not (np.abs(away - exact) < 5).any()


def test_a_ray_that_misses_is_not_a_hit(avatar):
    origin, direction = np.array([[3.0], [0], [5]], np.float32), np.array([[0.0], [0], [-1]], np.float32)
    t = mi.TensorXf(np.array([[5.0]], np.float32))
    _, f = tracing.newton_hits(head_field(avatar), mi.TensorXf(origin), mi.TensorXf(direction), t)
    assert f.shape == (1, 1) and abs(f.numpy().item()) > tracing.HIT_TOLERANCE


def test_a_single_ray_is_traced_as_one_of_many(avatar):
    """Dr.Jit 1.5 widens an unevaluated [1, 1] tensor in place when it is multiplied by a [3, 1] one."""
    field = head_field(avatar)
    origin, direction = rays_at_head(5)
    start = exact_hits(field, origin, direction).numpy() + np.float32(0.03)
    t, _ = tracing.newton_hits(field, *(mi.TensorXf(a) for a in (origin, direction, start)))
    alone = [mi.TensorXf(np.ascontiguousarray(a[:, 2:3])) for a in (origin, direction, start)]
    single, _ = tracing.newton_hits(field, *alone)
    assert single.numpy().item() == pytest.approx(t.numpy()[0, 2], abs=1e-6)
    x = tracing.differentiable_hit(field, alone[0], alone[1], single + 0)
    assert x.shape == (3, 1) and np.isfinite(x.numpy()).all()


@pytest.mark.parametrize("name", ["deformation", "reference", "z_sdf"])
def test_differentiable_hit_moves_as_the_traced_hit_does(avatar, name):
    origin, direction = rays_at_head(200)
    start = avatar.tensors[name]
    weight = np.random.default_rng(1).uniform(0, 1, 200)

    def loss(value):
        """Mean weighted hit by bisection in float64."""
        head = avatar.replaced(**{name: value})
        near, far = np.full(200, 1.8), np.full(200, 4.0)
        for _ in range(45):
            middle = 0.5 * (near + far)
            outside = field_in_double(head, origin + middle * direction.astype(np.float64)) > 0
            near, far = np.where(outside, middle, near), np.where(outside, far, middle)
        return float((near * weight).mean())

    value = mi.Float(start)
    dr.enable_grad(value)
    field = head_field(avatar, **{name: value})
    o, d = mi.TensorXf(origin), mi.TensorXf(direction)
    with dr.suspend_grad():
        t = exact_hits(field, origin, direction)
    x = tracing.differentiable_hit(field, o, d, t)
    np.testing.assert_allclose(x.numpy(), origin + t.numpy() * direction, atol=1e-6)
    along = dr.sum((x - o) * d, axis=0)
    dr.backward(dr.mean(along * mi.TensorXf(weight.astype(np.float32)), axis=None))
    ad, difference = slopes(loss, start, dr.grad(value).numpy(), 2e-4)
    assert ad == pytest.approx(difference, rel=1e-3)


def test_a_surface_through_grid_points_has_no_slivers():
    """A sphere whose radius is a multiple of the spacing passes within rounding of many grid points; barycentric
    coordinates of triangles with edges of 1e-6 voxels are not a number."""
    voxel = 0.25
    mesh = extraction.extract(lambda x: np.linalg.norm(x, axis=0) - np.float32(1.25), voxel)
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    edges = np.concatenate([np.linalg.norm(d, axis=1) for d in (a - b, b - c, c - a)])
    assert edges.min() > 5e-4 * voxel
    watertight(mesh)


def test_chunks_come_in_few_sizes_and_fill_columns_change_nothing(avatar):
    """Kernels depend on sizes: pictures with other numbers of hits must find theirs compiled."""
    field = head_field(avatar)
    sizes = {sdf._padded_size(n) for n in range(1, sdf.CHUNK + 1)}
    assert len(sizes) <= 33 and max(sizes) == sdf.CHUNK
    assert all(n <= sdf._padded_size(n) <= max(2, 1.5 * n) for n in (1, 2, 3, 5, 700, 1025, 40_000))
    x = np.random.default_rng(3).uniform(-1, 1, (3, 700)).astype(np.float32)
    value = lambda p: sdf.signed_distance(field, p)  # noqa: E731
    (found,), expected = sdf.evaluate_in_chunks(value, x), value(mi.TensorXf(x)).numpy()
    assert found.shape == (1, 700)
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_closest_approach_finds_the_smallest_distance_along_a_ray(avatar):
    field = head_field(avatar)
    evaluate = lambda x: sdf.evaluate_in_chunks(lambda p: sdf.signed_distance(field, p), x)[0][0]  # noqa: E731
    surface = extraction.extract(evaluate, 0.05)
    grid = tracing.DistanceGrid.of(surface.grid, surface.spacing)
    origin, direction = rays_at_head(200)
    side = np.cross(direction.T, [0.3, 0.9, 0.1]).T
    side /= np.linalg.norm(side, axis=0)
    origin = (origin + side * np.linspace(1.0, 1.7, 200)).astype(np.float32)  # grazing, through, and past the head
    near, far = mi.Float(2.2), mi.Float(5.5)
    t = tracing.closest_approach(grid, mi.Point3f(origin), mi.Vector3f(direction), near, far, mi.Bool(True)).numpy()
    found = evaluate(origin + t * direction)
    dense = np.linspace(2.2, 5.5, 400, dtype=np.float32)
    along = (origin[:, :, None] + dense * direction[:, :, None]).reshape(3, -1)
    best = evaluate(along).reshape(200, 400).min(axis=1)
    relevant = np.abs(best) < 0.1  # where the mask is decided; away from the surface the grid only interpolates
    assert relevant.sum() > 30
    assert (found - best)[relevant].max() < 1e-3


def test_distance_grid_is_exact_on_a_linear_field_and_constant_outside():
    axes = [lower + 0.5 * np.arange(n) for lower, n in zip(DOMAIN_LOWER, (5, 6, 7), strict=True)]
    plane = lambda x, y, z: 0.3 * x - 0.7 * y + 0.2 * z + 0.1  # noqa: E731
    grid = tracing.DistanceGrid.of(plane(*np.meshgrid(*axes, indexing="ij")), 0.5)
    low, high = np.array([a[0] for a in axes]), np.array([a[-1] for a in axes])
    p = np.random.default_rng(0).uniform(low - 0.5, high + 0.5, (100, 3)).T
    values = grid(mi.Point3f(p.astype(np.float32)), mi.Bool(True)).numpy()
    np.testing.assert_allclose(values, plane(*np.clip(p.T, low, high).T), atol=1e-5)
