"""Ray hits with the field, their derivatives, and the closest approach of misses equal bisection and differences."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from conftest import slopes
from doubles import field_in_double, find_hits_by_bisection, head_field

from sira_mi.conventions import DOMAIN_LOWER
from sira_mi.fields import columns, extraction, sdf, tracing


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
    return find_hits_by_bisection(field, mi.TensorXf(origin), mi.TensorXf(direction), outside, inside)


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
        head = avatar.with_tensors(**{name: value})
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


def test_chunks_come_in_few_sizes_and_fill_columns_change_nothing(avatar):
    """Kernels depend on sizes: pictures with other numbers of hits must find theirs compiled."""
    field = head_field(avatar)
    sizes = {columns._padded_size(n) for n in range(1, columns.CHUNK + 1)}
    assert len(sizes) <= 33 and max(sizes) == columns.CHUNK
    assert all(n <= columns._padded_size(n) <= max(2, 1.5 * n) for n in (1, 2, 3, 5, 700, 1025, 40_000))
    x = np.random.default_rng(3).uniform(-1, 1, (3, 700)).astype(np.float32)
    value = lambda p: sdf.signed_distance(field, p)  # noqa: E731
    (found,), expected = columns.evaluate_in_chunks(value, x), value(mi.TensorXf(x)).numpy()
    assert found.shape == (1, 700)
    np.testing.assert_allclose(found, expected, atol=1e-6)


@pytest.mark.slow
def test_closest_approach_finds_the_smallest_distance_along_a_ray(avatar):
    field = head_field(avatar)
    evaluate = lambda x: columns.evaluate_in_chunks(lambda p: sdf.signed_distance(field, p), x)[0][0]  # noqa: E731
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
