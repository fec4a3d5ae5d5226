"""Derivatives of the field: encodings, gradients, motions and the eikonal loss equal differences in float64."""

import dataclasses

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from conftest import slopes
from doubles import encoded_in_double, field_in_double, head_field, points_near_surface
from scipy.spatial.transform import Rotation

from sira_mi.avatar.shape import HeadShape, head_of, with_zero_latents
from sira_mi.fields import sdf
from sira_mi.fields.encoding import encode, encode_cooperative, encode_with_tangents, encoded_size


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


def test_a_shape_takes_its_parameters_in_every_form(avatar):
    """NumPy or Dr.Jit arrays, one head or several, whose points follow each other; what else a mapping holds is left
    alone, and a pose moves the head."""
    shape, tensors = HeadShape(avatar.architecture), avatar.tensors
    x = points_near_surface(20)
    expected = field_in_double(avatar, x.astype(np.float64))

    def distances(parameters, x=x):
        return sdf.signed_distance(shape.field(parameters), mi.TensorXf(x)).numpy()[0]

    mean = with_zero_latents(tensors)
    two = {**tensors, "z_sdf": np.stack([mean["z_sdf"], tensors["z_sdf"]], axis=1)}
    floats = {name: mi.Float(value) for name, value in tensors.items() if value.ndim == 1}
    for parameters in (tensors, floats, head_of(two, 1)):
        np.testing.assert_allclose(distances(parameters), expected, atol=1e-5)
    both = distances(two, np.concatenate([x, x], axis=1))
    np.testing.assert_allclose(both, np.concatenate([distances(mean), expected]), atol=1e-5)
    assert np.abs(both[:20] - both[20:]).max() > 1e-3
    shift = np.array([0.1, -0.2, 0.3], np.float32)
    pose = np.concatenate([np.zeros(3, np.float32), shift])
    moved = distances({**tensors, "pose": pose}, x - shift[:, None])
    np.testing.assert_allclose(moved, expected, atol=1e-5)


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
