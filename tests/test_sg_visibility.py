"""Visibility of lobes: quadrature under a known occluder, path tracing, limits, derivatives, repeatability."""

import sira_mi  # noqa: F401, I001  (first: Dr.Jit must find LLVM)

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from conftest import camera

from sira_mi.export import scene as scenes
from sira_mi.errors import InputError
from sira_mi.sg import visibility
from sira_mi.fields.directions import fibonacci_directions
from sira_mi.sg.lobes import evaluate_lobes

# Soft, and with a small bright one.
SOFT = np.array([[-0.5, 0.4, 0.76, 6, 2.0, 1.8, 1.5], [0.6, 0.6, 0.3, 20, 1, 2, 3], [0, 1, 0, 0.5, 0.3, 0.35, 0.4]])
SUN = np.array([[0.3, 0.2, 0.93, 1000, 300, 280, 250], [0, 1, 0, 0.5, 0.3, 0.35, 0.4]])
ROUGHNESS, RADIUS, HEIGHT = 0.5, 0.5, 1.0


def tensor(array):
    return mi.TensorXf(np.ascontiguousarray(array, np.float32))


def unit(array):
    return array / np.linalg.norm(array, axis=0)


def points(count=60, seed=0):
    """Points of the plane z = 0 under a ball at (0, 0, `HEIGHT`), normals about +z, and directions to a camera."""
    rng = np.random.default_rng(seed)
    x = np.concatenate([rng.uniform(-1.2, 1.2, (2, count)), np.zeros((1, count))])
    normal = unit(np.array([[0], [0], [1.0]]) + 0.2 * rng.standard_normal((3, count)))
    outgoing = unit(normal + 0.7 * rng.standard_normal((3, count)))
    outgoing *= np.sign((normal * outgoing).sum(axis=0))
    return x, normal, outgoing, rng.uniform(0.02, 0.1, (1, count))


def ball():
    return mi.load_dict({"type": "scene", "ball": {"type": "sphere", "center": [0, 0, HEIGHT], "radius": RADIUS}})


def unoccluded_by_the_ball(x, directions):
    """Bool [K, N]: the ball covers a cap of known width around its centre's direction."""
    offset = np.array([[0], [0], [HEIGHT]]) - x
    distance = np.linalg.norm(offset, axis=0)
    return directions @ (offset / distance) < np.sqrt(1 - (RADIUS / distance) ** 2)


def reference(x, normal, outgoing, specular, lobes, count=6000):
    """Shares of irradiance and specular radiance [3, N] by brute force in float64, no code of the package's."""
    lobes = np.asarray(lobes, float)
    axis = unit(lobes[:, :3].T).T
    place, chosen = np.arange(count) // len(lobes), np.arange(count) % len(lobes)
    share = (place + 0.5) / (count // len(lobes))
    gap = -np.log(1 - share * -np.expm1(-2 * lobes[chosen, 3])) / lobes[chosen, 3]
    first = unit(np.cross(axis, [0.31, -0.52, 0.8]).T).T
    second = np.cross(axis, first)
    around = np.cos(2.4 * place)[:, None] * first[chosen] + np.sin(2.4 * place)[:, None] * second[chosen]
    drawn = (1 - gap)[:, None] * axis[chosen] + np.sqrt(gap * (2 - gap))[:, None] * around
    direction = np.concatenate([fibonacci_directions(count), drawn])
    peak = lobes[:, 3] / (-2 * np.pi * np.expm1(-2 * lobes[:, 3])) / len(lobes)
    density = 1 / (4 * np.pi) + np.exp(lobes[:, 3] * (direction @ axis.T - 1)) @ peak
    light = (evaluate_lobes(lobes, direction) / density[:, None]).T
    cosine = np.maximum(direction @ normal, 0)
    half = np.sqrt(np.maximum(2 + 2 * direction @ outgoing, 1e-9))
    view = (normal * outgoing).sum(axis=0)
    k = (ROUGHNESS + 1) ** 2 / 8
    fresnel = specular + (1 - specular) * 2 ** ((-5.55473 * half / 2 - 6.8316) * half / 2)
    glossy = np.exp(2 / ROUGHNESS**4 * np.minimum((cosine + view) / half - 1, 0)) * fresnel * cosine
    glossy /= cosine * (1 - k) + k
    unoccluded = unoccluded_by_the_ball(x, direction)
    return tuple((light @ (f * unoccluded)) / (light @ f) for f in (cosine, glossy))


def visible(inputs, lobes, directions, unoccluded):
    normal, outgoing, specular = map(tensor, inputs)
    light = tensor(lobes)
    return visibility.light_visibility(normal, -outgoing, specular, ROUGHNESS, light, directions, tensor(unoccluded))


def test_traced_directions_are_those_beside_the_ball():
    x, normal, _, _ = points()
    directions = fibonacci_directions(500)
    found = visibility.trace_unoccluded(ball(), x, normal, directions, 1e-3)
    expected = unoccluded_by_the_ball(x, directions) | (directions @ normal <= 0)
    assert found.shape == (500, 60) and (found != expected).mean() < 2e-3 and (~found).mean() > 0.02


@pytest.mark.parametrize("sharpness", [1e-3, 1.0, 30.0, 1e3, 1e7])
def test_directions_drawn_from_a_light_integrate_it(sharpness):
    """Σ w l is the light's energy, whatever its lobes; the even half alone misses sharp ones."""
    lobes = np.array([[0.2, -0.5, 0.8, sharpness, 1, 2, 3], [1, 0, 0, 1.0, 0.1, 0.1, 0.1]])
    directions = visibility.light_directions(lobes, 128)
    np.testing.assert_allclose(np.linalg.norm(directions.axis, axis=1), 1, atol=1e-9)
    energy = (lobes[:, 4:] * (-2 * np.pi * np.expm1(-2 * lobes[:, 3:4]) / lobes[:, 3:4])).sum(axis=0)
    found = visibility.light_radiance(tensor(lobes), directions).numpy().sum(axis=1)
    np.testing.assert_allclose(found, energy, rtol=0.03)


def test_even_directions_keep_the_energy_of_lobes_that_they_do_not_resolve():
    lobes = np.array([[0.2, -0.5, 0.8, 3000.0, 1e3, 2e3, 3e3]])
    found = visibility.light_radiance(tensor(lobes), visibility.even_directions(128)).numpy().sum(axis=1)
    np.testing.assert_allclose(found, lobes[0, 4:] * 2 * np.pi / 3000, rtol=0.05)


@pytest.mark.slow
@pytest.mark.parametrize(
    "lobes, kind, count, tolerance",
    [
        (SOFT, "light", 64, 0.035),
        (SOFT, "light", 256, 0.012),
        (SOFT, "even", 256, 0.015),
        (SUN, "light", 128, 0.03),
    ],
)
def test_shares_against_quadrature(lobes, kind, count, tolerance):
    x, *inputs = points()
    make = visibility.even_directions if kind == "even" else lambda n: visibility.light_directions(lobes, n)
    directions = make(count)
    found = visible(inputs, lobes, directions, visibility.trace_unoccluded(ball(), x, inputs[0], directions.axis, 1e-3))
    expected = reference(x, *inputs, lobes)
    for share, truth, slack in zip((found.diffuse, found.specular), expected, (1, 2.5), strict=True):
        error = np.sqrt(((share.numpy() - truth) ** 2).mean())
        assert error < slack * tolerance, error
        assert np.sqrt(((1 - truth) ** 2).mean()) > 2 * slack * tolerance, "shadows that are worth the effort"


@pytest.mark.parametrize("lobes", [SOFT, SUN, 0 * SOFT + [0, 0, 1, 5, 0, 0, 0], np.array([[0, 0, -1, 1e5, 1, 1, 1.0]])])
def test_limits(lobes):
    """Nothing blocked: all of the light and no bounce. All blocked: no light. Black lights and lights below the
    horizon stay finite."""
    _, *inputs = points()
    directions = visibility.light_directions(lobes, 64)
    clear = visible(inputs, lobes, directions, np.ones((64, 60)))
    shut = visible(inputs, lobes, directions, np.zeros((64, 60)))
    for share in (clear.diffuse, clear.specular):
        np.testing.assert_allclose(share.numpy(), 1, atol=1e-5)
    bounced = [a.numpy() for a in (clear.bounce_diffuse, clear.bounce_specular)]
    assert all((a == 0).all() for a in bounced)
    for name in ("diffuse", "specular", "bounce_diffuse", "bounce_specular"):
        values = getattr(shut, name).numpy()
        assert np.isfinite(values).all() and (values >= 0).all() and values.shape == (3, 60)
    if lobes is SOFT:
        assert shut.diffuse.numpy().max() < 2e-3 and shut.bounce_diffuse.numpy().min() > 0


def test_bounced_light_against_the_sum_over_pairs_of_directions():
    """Each blocked direction is a surface facing back that receives each direction's light by the clamped cosine. The
    expansion to first order, cut at 0, is rounder: up to 1.6 times as much here, at the same places."""
    x, *inputs = points()
    directions = visibility.even_directions(256)
    unoccluded = unoccluded_by_the_ball(x, directions.axis)
    found = visible(inputs, SOFT, directions, unoccluded).bounce_diffuse.numpy()
    axis, weight, normal = directions.axis, directions.weight[:, None], inputs[0]
    blocked = weight * np.maximum(axis @ normal, 0) * ~unoccluded
    received = np.maximum(-axis @ axis.T, 0) @ blocked * np.minimum(1 + axis @ normal, 1)
    expected = (evaluate_lobes(SOFT, axis) * weight).T @ received / np.pi
    assert 1.0 < found.sum() / expected.sum() < 1.6
    assert np.corrcoef(found.ravel(), expected.ravel())[0, 1] > 0.97


def weighted(found):
    rng = np.random.default_rng(7)
    parts = (found.diffuse, found.specular, found.bounce_diffuse, found.bounce_specular)
    return sum((dr.sum(part * tensor(rng.uniform(0, 1, (3, 60))), axis=None) for part in parts), mi.TensorXf(0.0))


@pytest.mark.parametrize("which", ["normal", "specular", "roughness", "lobes"])
def test_derivatives_against_differences(which):
    x, normal, outgoing, specular = points()
    directions = visibility.even_directions(128)
    unoccluded = tensor(unoccluded_by_the_ball(x, directions.axis))
    start = {"normal": normal, "specular": specular, "roughness": np.array([0.6]), "lobes": SOFT}

    def loss(values):
        rough = mi.Float(values["roughness"].array)
        arguments = values["normal"], tensor(-outgoing), values["specular"], rough, values["lobes"]
        return weighted(visibility.light_visibility(*arguments, directions, unoccluded))

    values = {name: tensor(value) for name, value in start.items()}
    dr.enable_grad(values[which])
    dr.backward(loss(values))
    gradient = dr.grad(values[which]).numpy().astype(float)
    along = np.random.default_rng(1).standard_normal(start[which].shape)
    step = along * gradient / np.abs(gradient).max() * 3e-3 + along * 1e-3
    ends = [loss({**values, which: tensor(start[which] + sign * step)}).numpy().item() for sign in (1, -1)]
    assert (gradient * step).sum() == pytest.approx((ends[0] - ends[1]) / 2, rel=0.02, abs=2e-4)


def test_derivatives_repeat_bit_for_bit():
    x, *inputs = points()
    directions = visibility.even_directions(128)
    unoccluded = unoccluded_by_the_ball(x, directions.axis)

    def run():
        values = [*map(tensor, inputs), tensor(SOFT)]
        dr.enable_grad(values)
        normal, outgoing, specular, lobes = values
        found = visibility.light_visibility(normal, -outgoing, specular, 0.5, lobes, directions, tensor(unoccluded))
        dr.backward(weighted(found))
        return [dr.grad(value).numpy() for value in values]

    first = run()
    for _ in range(4):
        for a, b in zip(first, run(), strict=True):
            np.testing.assert_array_equal(a, b)


@pytest.fixture(scope="module")
def shadowed(avatar_path):
    """Pictures [4, 4, 3 blocks] of the head beside a ball that hides it from the key light: by path tracing, and by
    the closed form with and without visibility."""
    lobes = np.array([[0.7, 0.4, 0.6, 40, 20, 18, 15], [0, 0.6, 0.8, 1, 0.3, 0.35, 0.4]], np.float32)
    lobes[:, :3] = unit(lobes[:, :3].T).T
    head = scenes.head(avatar_path, voxel=0.1, baked=True)
    description = {
        "type": "scene",
        "head": mi.load_dict(head),
        "ball": {
            "type": "sphere",
            "center": list((2.8 * lobes[0, :3]).astype(float)),
            "radius": 0.7,
            "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.3}},
        },
        "light": {"type": "sg_envmap", "lobes": mi.TensorXf(lobes)},
        "sensor": scenes.sensor(camera(50.0, 24)),
    }
    integrators = {
        "path": ({"type": "path", "max_depth": 4}, 512),
        "with": ({"type": "sira_sg", "aovs": True, "visibility_directions": 128}, 8),
        "without": ({"type": "sira_sg", "visibility": False}, 8),
    }
    pictures = {}
    for name, (integrator, samples) in integrators.items():
        scene = mi.load_dict({**description, "integrator": {**integrator, "hide_emitters": True}})
        pictures[name] = mi.render(scene, spp=samples, seed=2).numpy()
    mask = pictures["with"][..., 18] > 0.99
    return {name: picture[mask][:, :3] for name, picture in pictures.items()}


@pytest.mark.slow
def test_shadows_agree_with_path_tracing(shadowed):
    """With visibility the closed form is within 5% of path tracing where it is off by over 25% without."""
    mean = shadowed["path"].mean()
    errors = {n: np.sqrt(((shadowed[n] - shadowed["path"]) ** 2).mean()) / mean for n in ("with", "without")}
    print(errors)
    assert errors["with"] < 0.05 and errors["without"] > 0.25
    assert abs(shadowed["with"].mean() / mean - 1) < 0.02


@pytest.mark.parametrize("count", [0, 15, 5000])
def test_a_bad_number_of_directions_is_said(count):
    with pytest.raises((InputError, RuntimeError), match="visibility_directions is"):
        mi.load_dict({"type": "sira_sg", "visibility_directions": count})
