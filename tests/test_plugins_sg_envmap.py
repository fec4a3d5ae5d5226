"""The emitter `sg_envmap` and its files: sampling, derivatives, agreement with Mitsuba's `envmap`, bad input."""

import sira_mi  # noqa: F401, I001  (first: Dr.Jit must find LLVM)

import drjit as dr
import mitsuba as mi
import numpy as np
import OpenEXR
import pytest

mi.set_variant("llvm_ad_rgb")

from mitsuba.chi2 import ChiSquareTest, SphericalDomain  # noqa: E402

from sira_mi.errors import InputError  # noqa: E402
from sira_mi.fields.directions import fibonacci_directions  # noqa: E402
from sira_mi.files import write_exr  # noqa: E402
from sira_mi.sg import lights_io  # noqa: E402
from sira_mi.sg.fit_environment import (  # noqa: E402
    EnvironmentFit,
    fit_environment,
    pixel_directions,
    render_environment,
    total_light,
)
from sira_mi.sg.lobes import evaluate_lobes  # noqa: E402

LOBES = np.array(
    [[0.0, 1.0, 0.0, 1.5, 0.5, 0.6, 0.8], [0.6, 0.5, 0.6, 60.0, 5.0, 4.0, 3.0], [-1.0, 0.1, 0.8, 8.0, 0.3, 0.5, 0.9]],
    np.float32,
)


@pytest.fixture(autouse=True)
def scratch_folder(tmp_path_factory, monkeypatch):
    """A failing chi-squared test writes its histogram into the working folder."""
    monkeypatch.chdir(tmp_path_factory.mktemp("chi2"))


def emitter(lobes=LOBES, **extra):
    return mi.load_dict({"type": "sg_envmap", "lobes": mi.TensorXf(lobes), **extra})


def radiance(light, directions):
    si = dr.zeros(mi.SurfaceInteraction3f, len(directions))
    si.wi = -mi.Vector3f(directions.T)
    return light.eval(si).numpy().T


@pytest.mark.parametrize(
    "lobes",
    [
        LOBES,
        [[0, 1, 0, 1e-3, 1, 1, 1]],
        [[0.6, 0.1, 0.3, 500, 1, 2, 3]],
        [[0, -1, 1, 10, 1, 1, 1], [0, 1, 1, 0.5, 0, 0, 0]],
    ],
    ids=["mixture", "flat", "sharp", "with black"],
)
def test_sampling_has_the_density_it_claims(lobes):
    light = emitter(np.array(lobes, np.float32))

    def sample(u):
        return light.sample_direction(dr.zeros(mi.Interaction3f), u)[0].d

    def density(d):
        ds = dr.zeros(mi.DirectionSample3f)
        ds.d = d
        return light.pdf_direction(dr.zeros(mi.Interaction3f), ds)

    test = ChiSquareTest(SphericalDomain(), sample, density, sample_dim=2, sample_count=200_000, ires=24, seed=3)
    assert test.run(), test.messages


@pytest.mark.parametrize("sharpness", [1e-3, 0.019, 0.021, 1.0, 1e5])
def test_sampled_cosines_have_the_exact_mean(sharpness):
    """The mean cosine of a von Mises-Fisher density is coth λ − 1/λ, at every sharpness and across the series' end."""
    light = emitter([[0.3, -0.5, 0.8, sharpness, 1, 1, 1]])
    grid = (np.stack(np.meshgrid(np.arange(512), np.arange(512))).reshape(2, -1) + 0.5) / 512
    sample = light.sample_direction(dr.zeros(mi.Interaction3f), mi.Point2f(grid))[0]
    axis = np.array([0.3, -0.5, 0.8]) / np.linalg.norm([0.3, -0.5, 0.8])
    gap = 0.5 * ((sample.d.numpy().T.astype(np.float64) - axis) ** 2).sum(axis=1).mean()
    exact = 1 / np.tanh(sharpness) - 1 / sharpness if sharpness > 0.01 else sharpness / 3
    assert gap == pytest.approx(1 - exact, rel=2e-3)


def test_samples_weights_and_evaluations_agree():
    light = emitter(scale=2.0)
    sample = mi.Point2f(np.random.default_rng(0).random((2, 1000)))
    it = dr.zeros(mi.Interaction3f, 1000)
    it.p = mi.Point3f(0.1, 0.2, 0.3)
    ds, weight = light.sample_direction(it, sample)
    np.testing.assert_allclose(light.pdf_direction(it, ds).numpy(), ds.pdf.numpy(), rtol=1e-4)
    np.testing.assert_allclose((weight * ds.pdf).numpy(), light.eval_direction(it, ds).numpy(), rtol=1e-4)
    expected = 2 * evaluate_lobes(LOBES.astype(np.float64), ds.d.numpy().T)
    np.testing.assert_allclose(light.eval_direction(it, ds).numpy().T, expected, rtol=2e-4, atol=1e-6)
    np.testing.assert_allclose((it.p + ds.d * ds.dist).numpy(), ds.p.numpy(), rtol=1e-4, atol=0.1)


def test_agrees_with_mitsubas_envmap():
    """The same directions see the same light through `lights.exr` in Mitsuba's `envmap`; also rotated."""
    directions = fibonacci_directions(2000)
    rotation = mi.ScalarTransform4f().rotate([0, 1, 0], 70)
    image = mi.Bitmap(np.ascontiguousarray(render_environment(LOBES, 512)))
    for extra in ({}, {"to_world": rotation}):
        reference = mi.load_dict({"type": "envmap", "bitmap": image, **extra})
        expected = radiance(reference, directions)
        assert np.abs(radiance(emitter(**extra), directions) - expected).max() < 0.01 * expected.max()


@pytest.mark.parametrize("height, width", [(3, 6), (5, 10), (16, 32), (33, 60)])
def test_pixels_lie_where_mitsubas_envmap_has_them(height, width):
    """Every pixel has its direction, and every row its light, the poles included."""
    columns = width * np.arange(1, height + 1)[:, None] + np.arange(width)
    image = np.repeat(columns[..., None], 3, axis=-1).astype(np.float32)
    directions, solid_angle = pixel_directions(height, width)
    light = mi.load_dict({"type": "envmap", "bitmap": mi.Bitmap(image)})
    seen = radiance(light, directions[1:-1].reshape(-1, 3))[:, 0]
    np.testing.assert_allclose(seen, image[1:-1, :, 0].ravel(), rtol=2e-4)
    assert np.allclose(directions[[0, -1]], np.array([0, 1, 0]) * [[[1]], [[-1]]], atol=1e-12)
    assert solid_angle.sum() * width == pytest.approx(4 * np.pi, rel=1e-12)
    everywhere = fibonacci_directions(1 << 17)
    for row in {0, 1, height // 2, height - 1}:
        image = np.zeros((height, width, 3), np.float32)
        image[row] = 3
        light = mi.load_dict({"type": "envmap", "bitmap": mi.Bitmap(image)})
        expected = 4 * np.pi * radiance(light, everywhere).mean(axis=0, dtype=np.float64)
        np.testing.assert_allclose(total_light(image), expected, rtol=2e-3)


@pytest.mark.parametrize("row", [0, 1, 14])
def test_lobes_of_an_image_lit_near_a_pole_carry_its_light(row):
    image = np.zeros((16, 32, 3), np.float32)
    image[row] = 100
    directions = fibonacci_directions(1 << 16)
    lobes = mi.TensorXf(fit_environment(image, EnvironmentFit(lobes=16)))
    lights = {"type": "envmap", "bitmap": mi.Bitmap(image)}, {"type": "sg_envmap", "lobes": lobes}
    traced, fitted = (radiance(mi.load_dict(light), directions).mean(axis=0, dtype=np.float64) for light in lights)
    np.testing.assert_allclose(fitted, traced, rtol=0.01)


@pytest.mark.slow
def test_path_traced_ball_agrees_with_mitsubas_envmap(tmp_path):
    """Emitter sampling, BSDF sampling and misses under `path`, against the written EXR."""
    write_exr(tmp_path / "lights.exr", render_environment(LOBES, 256))
    images = []
    for light in (
        {"type": "sg_envmap", "lobes": mi.TensorXf(LOBES)},
        {"type": "envmap", "filename": str(tmp_path / "lights.exr")},
    ):
        images.append(mi.render(ball(light, "path"), spp=256, seed=1).numpy())
    assert np.abs(images[0].mean(axis=(0, 1)) / images[1].mean(axis=(0, 1)) - 1).max() < 0.01


def ball(light, integrator):
    return mi.load_dict(
        {
            "type": "scene",
            "ball": {"type": "sphere", "bsdf": {"type": "diffuse"}},
            "light": light,
            "integrator": {"type": integrator, "max_depth": 3},
            "sensor": {
                "type": "perspective",
                "fov": 35,
                "to_world": mi.ScalarTransform4f().look_at([0, 0, 6], [0, 0, 0], [0, 1, 0]),
                "film": {"type": "hdrfilm", "width": 24, "height": 24, "rfilter": {"type": "box"}},
            },
        }
    )


@pytest.mark.slow
@pytest.mark.parametrize("integrator", ["prb", "path"])
def test_gradients_of_lobes_match_differences(integrator):
    """AD against central differences along a direction in all 21 numbers, and in the scale, within 1e-2."""
    scene = ball({"type": "sg_envmap", "lobes": mi.TensorXf(LOBES)}, integrator)
    params = mi.traverse(scene)
    params.keep(["light.lobes", "light.scale"])
    tangents = {"light.lobes": np.random.default_rng(2).standard_normal(LOBES.shape), "light.scale": np.ones(1)}
    for key, tangent in tangents.items():
        start = type(params[key])(params[key])
        dr.enable_grad(params[key])
        params.update()
        dr.backward(dr.mean(mi.render(scene, params, spp=256, seed=3), axis=None))
        derivative = (dr.grad(params[key]).numpy() * tangent).sum()
        dr.disable_grad(params[key])
        values = []
        for sign in (1, -1):
            params[key] = start + sign * 0.01 * type(start)(tangent.astype(np.float32))
            params.update()
            values.append(float(dr.mean(mi.render(scene, spp=1024, seed=4), axis=None).array[0]))
        params[key] = start
        params.update()
        assert derivative == pytest.approx((values[0] - values[1]) / 0.02, rel=1e-2)


@pytest.mark.slow
def test_derivatives_under_prb_have_no_bias():
    """The mean over 32 seeds equals that of central differences within 4 standard errors, for every lobe. One seed may
    be off by a fifth by noise alone, where few samples meet a sharp lobe. Axes are stored with unit length: differences
    belong at the stored lobes."""
    scene = ball({"type": "sg_envmap", "lobes": mi.TensorXf(LOBES)}, "prb")
    params = mi.traverse(scene)
    params.keep(["light.lobes"])
    start = params["light.lobes"].numpy().copy()  # `numpy` may share memory that an update frees
    np.testing.assert_allclose(np.linalg.norm(start[:, :3], axis=1), 1.0, rtol=1e-6)
    seeds, steps = range(32), np.array([0.05, 0.05, 0.05, 0.05, 0.3, 0.3, 0.3]) * np.maximum(1.0, start[:, 3:4] / 10)
    steps[:, :3] = 0.05
    gradients = []
    for seed in seeds:
        params["light.lobes"] = mi.TensorXf(start)
        dr.enable_grad(params["light.lobes"])
        params.update()
        dr.backward(dr.mean(mi.render(scene, params, spp=16, seed=100 + seed), axis=None))
        gradients.append(dr.grad(params["light.lobes"]).numpy().copy())
    # Each lobe changes so that the terms of its derivative do not cancel.
    tangents = steps * np.sign(np.mean(gradients, axis=0))
    derivatives = (np.array(gradients) * tangents).sum(axis=2)
    for k in range(len(start)):
        change = np.zeros_like(start)
        change[k] = tangents[k]
        differences = []
        for seed in seeds:
            values = []
            for sign in (1, -1):
                params["light.lobes"] = mi.TensorXf((start + 0.5 * sign * change).astype(np.float32))
                params.update()
                values.append(mi.render(scene, spp=32, seed=500 + seed).numpy().mean(dtype=np.float64))
            differences.append(values[0] - values[1])
        samples = derivatives[:, k], np.array(differences)
        error = np.sqrt(sum(x.var(ddof=1) for x in samples) / len(seeds))
        assert abs(samples[0].mean() - samples[1].mean()) < 4 * error, k
        assert error < 0.1 * abs(samples[1].mean()), k


def test_lobes_can_be_replaced_through_traverse():
    """Another number of lobes: evaluation and sampling follow."""
    light = emitter()
    params = mi.traverse(light)
    params["lobes"] = mi.TensorXf([[0.0, 0.0, 1.0, 40.0, 1.0, 1.0, 1.0]])
    params.update()
    np.testing.assert_allclose(radiance(light, np.array([[0.0, 0.0, 1.0]])), 1.0, rtol=1e-5)
    sample = mi.Point2f(np.random.default_rng(0).random((2, 100)))
    assert (light.sample_direction(dr.zeros(mi.Interaction3f, 100), sample)[0].d.z.numpy() > 0.5).all()
    assert light.lobes.shape == (1, 7)


def test_default_light_is_dim_and_nearly_constant():
    light = mi.load_dict({"type": "sg_envmap"})
    np.testing.assert_allclose(radiance(light, fibonacci_directions(50)), 0.2, rtol=0.01)


def test_files_round_trip(tmp_path):
    """JSON keeps every bit; an EXR keeps its pixels, and its fit keeps the light."""
    path = tmp_path / "Lichter ü.json"
    lights_io.write_lights(path, LOBES)
    written = lights_io.read_lights(path)
    lights_io.write_lights(path, written)
    np.testing.assert_array_equal(lights_io.read_lights(path), written)
    np.testing.assert_allclose(written[:, 3:], LOBES[:, 3:])
    np.testing.assert_allclose(np.linalg.norm(written[:, :3], axis=1), 1, rtol=1e-6)
    light = mi.load_dict({"type": "sg_envmap", "filename": str(path)})
    np.testing.assert_array_equal(light.lobes.numpy(), written)

    image = render_environment(LOBES, 32)
    write_exr(tmp_path / "lights.exr", image)
    np.testing.assert_array_equal(lights_io.read_environment(tmp_path / "lights.exr"), image)
    light = mi.load_dict({"type": "sg_envmap", "filename": str(tmp_path / "lights.exr"), "lobe_count": 12})
    assert light.lobes.shape == (12, 7)
    np.testing.assert_allclose(total_light(render_environment(light.lobes.numpy(), 64)), total_light(image), rtol=1e-3)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["Lichter ü.json", "lights.exr"]


GOOD = '{"axis": [0, 1, 0], "sharpness": 5, "amplitude": [1, 1, 1]}'


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("", "empty file"),
        ("[" * 100_000, "not JSON"),
        ("[]", 'list "lobes"'),
        ('{"lobes": []}', "0 lobes"),
        ('{"lobes": [' + ",".join([GOOD] * 4097) + "]}", "4097 lobes"),
        (f'{{"lobes": [{GOOD}, 7]}}', "lobe 1"),
        (f'{{"lobes": [{GOOD}, {GOOD.replace("5", "0")}]}}', "lobe 1 has a sharpness"),
        (f'{{"lobes": [{GOOD}, {GOOD.replace("5", "1e-60")}]}}', "lobe 1 has a sharpness"),
        (f'{{"lobes": [{GOOD.replace("5", "NaN")}]}}', "NaN or infinity (NaN)"),
        (f'{{"lobes": [{GOOD.replace("5", "1e60")}]}}', "lobe 0 has a value that is not finite"),
        (f'{{"lobes": [{GOOD.replace("5", "true")}]}}', '"sharpness" must hold numbers'),
        (f'{{"lobes": [{GOOD.replace("[1, 1, 1]", "[1, -1, 1]")}]}}', "negative amplitude"),
        (f'{{"lobes": [{GOOD.replace("[0, 1, 0]", "[0, 0, 0]")}]}}', "axis of zero length"),
        (f'{{"lobes": [{GOOD.replace("[0, 1, 0]", "[0, 1]")}]}}', '"axis" must be 3 numbers'),
    ],
)
def test_bad_light_files_are_named(tmp_path, text, fault):
    path = tmp_path / "lights.json"
    path.write_text(text)
    with pytest.raises(InputError) as error:
        lights_io.read_lights(path)
    assert fault in str(error.value) and str(path) in str(error.value) and "\n" not in str(error.value)


def test_bad_environment_files_are_named(tmp_path):
    path = tmp_path / "lights.exr"

    def expect(fault):
        with pytest.raises(InputError, match=fault):
            lights_io.read_environment(path)

    expect("no such light file")
    path.write_bytes(b"not an image")
    expect("not a readable OpenEXR")
    write_exr(path, np.ones((16, 32, 3)))
    path.write_bytes(path.read_bytes()[:-60])
    expect("not a readable OpenEXR")
    write_exr(path, np.ones((16, 16, 3)))
    expect("latitude-longitude")
    image = np.ones((16, 32, 3), np.float32)
    image[3, 4, 1] = np.nan
    write_exr(path, image)
    expect("not finite")
    image[3, 4, 1] = -np.inf
    write_exr(path, image)
    expect("not finite")
    image[3, 4, 1] = 1e30
    write_exr(path, image)
    expect("more than 1e.28")
    image[3] = -2
    write_exr(path, image)
    expect("negative radiance")
    with OpenEXR.File({"type": OpenEXR.scanlineimage}, {"Z": np.ones((16, 32), np.float32)}) as file:
        file.write(str(path))
    expect("no channels")


def test_environments_are_read_as_their_files_say(tmp_path):
    """Overshoot below zero becomes black; a part of the sphere stays in its place, the rest is black; so is a picture
    that reaches beyond the display window cut to it."""
    path, rng = tmp_path / "lights.exr", np.random.default_rng(0)
    image = rng.random((16, 32, 3)).astype(np.float32)
    image[5, 6] = -12  # 5% of the light, as in published maps
    write_exr(path, image)
    np.testing.assert_array_equal(lights_io.read_environment(path), np.maximum(image, 0))
    whole = np.zeros((64, 128, 3), np.float32)
    whole[16:48, 64:] = rng.random((32, 64, 3))
    cases = {(64, 16, 127, 47): whole[16:48, 64:], (-2, -1, 129, 64): np.pad(whole, ((1, 1), (2, 2), (0, 0)), "edge")}
    for (left, top, right, bottom), stored in cases.items():
        corners = [np.array(c, np.int32) for c in ((left, top), (right, bottom), (0, 0), (127, 63))]
        header = {"dataWindow": tuple(corners[:2]), "displayWindow": tuple(corners[2:])}
        OpenEXR.File(header, {"RGB": np.ascontiguousarray(stored)}).write(str(path))
        np.testing.assert_array_equal(lights_io.read_environment(path), whole)


def test_unwritable_output_leaves_nothing(tmp_path):
    for write, value in ((lights_io.write_lights, LOBES), (write_exr, np.ones((4, 8, 3)))):
        with pytest.raises(InputError, match="cannot write"):
            write(tmp_path / "missing" / "lights.x", value)
    with pytest.raises(InputError, match="lobe 0"):
        lights_io.write_lights(tmp_path / "lights.json", np.zeros((1, 7)))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "extra", [{"lobes": mi.TensorXf(LOBES), "filename": "a.json"}, {"filename": "a.png"}, {"filename": "missing.json"}]
)
def test_bad_emitter_parameters_are_errors(extra):
    with pytest.raises(Exception, match=r"either lobes or filename|reads .json and .exr|no such light file"):
        mi.load_dict({"type": "sg_envmap", **extra})
