"""Relighting: baked albedos agree with the networks, the closed form with path tracing, the head turns, and the command
writes its images."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import OpenEXR
import pytest
from conftest import camera, small_avatar
from PIL import Image

from sira_mi.avatar.file import save_avatar
from sira_mi.colour import linear_to_srgb
from sira_mi.errors import InputError
from sira_mi.export.scene import head, sensor
from sira_mi.fields.columns import evaluate_in_chunks
from sira_mi.fields.sdf import deform
from sira_mi.files import read_exr, write_exr
from sira_mi.portrait.camera import Camera
from sira_mi.relight import render as render_module
from sira_mi.relight.__main__ import main
from sira_mi.relight.compare import compare
from sira_mi.relight.pictures import EXPOSURE_LEVEL, EXPOSURE_PERCENTILE, meter_exposure
from sira_mi.relight.render import RelightSettings, load_head, load_scene, render_passes
from sira_mi.relight.subject import Light, Subject, read_light, read_subject
from sira_mi.sg.fit_environment import render_environment
from sira_mi.sg.lights_io import write_lights

# A key from the front left and a dim dome: smooth, so that few samples suffice.
LOBES = np.array([[-0.5, 0.4, 0.76, 6, 2.0, 1.8, 1.5], [0, 1, 0, 0.5, 0.3, 0.35, 0.4]], np.float32)
VIEW = camera(50.0)


@pytest.fixture(scope="module")
def subject(avatar, avatar_path):
    return Subject(read_subject(Path(avatar_path)).path, avatar, VIEW)


@pytest.fixture
def lights(tmp_path):
    path = tmp_path / "lights.json"
    write_lights(path, LOBES)
    return str(path)


def baked_scene(avatar_path, voxel=0.1):
    description = head(avatar_path, voxel, baked=True)
    return mi.load_dict({"type": "scene", "head": description, "sensor": sensor(VIEW)})


def albedos(scene):
    """(baked, exact) diffuse and specular albedos [4, N] where the camera's rays meet the mesh."""
    shape = scene.shapes()[0]
    u = np.stack(np.meshgrid(*[(np.arange(32) + 0.5) / 32] * 2)).reshape(2, -1).astype(np.float32)
    ray, _ = scene.sensors()[0].sample_ray(0.0, 0.0, mi.Point2f(u), mi.Point2f(0.5))
    si = scene.ray_intersect(ray)
    hit = si.is_valid()
    bsdf, field = shape.bsdf(), shape.field()
    baked = np.vstack([bsdf.diffuse_albedo.eval(si, hit).numpy(), bsdf.specular_albedo.eval_1(si, hit).numpy()[None]])

    def networks(x):
        x_ref, gamma = deform(field, x)
        return tuple(t.evaluate_networks(x_ref, gamma) for t in (bsdf.diffuse_albedo, bsdf.specular_albedo))

    mask = hit.numpy().astype(bool)
    local = shape.to_local @ si.p
    return baked[:, mask], np.vstack(evaluate_in_chunks(networks, local.numpy()[:, mask]))


@pytest.mark.slow
def test_baked_albedos_tend_to_the_networks_with_the_mesh(avatar_path):
    coarse, fine = (np.abs(np.subtract(*albedos(baked_scene(avatar_path, voxel)))) for voxel in (0.2, 0.05))
    assert fine.max() < 0.01
    assert fine.mean() < 0.25 * coarse.mean(), "linear interpolation errs by the square of the spacing"


@pytest.mark.slow
def test_baked_albedos_follow_every_parameter(avatar, avatar_path, tmp_path):
    scene = baked_scene(avatar_path)
    params = mi.traverse(scene)
    other = small_avatar(2).tensors
    before = albedos(scene)[0]
    params["head.bsdf.diffuse_albedo.weights"] = mi.Float(other["diffuse_albedo"])
    params["head.bsdf.specular_albedo.latent"] = mi.Float(other["z_s"])
    params.update()
    path = tmp_path / "changed.safetensors"
    save_avatar(path, avatar.with_tensors(diffuse_albedo=other["diffuse_albedo"], z_s=other["z_s"]))
    np.testing.assert_array_equal(albedos(scene)[0], albedos(baked_scene(path))[0])
    assert np.abs(albedos(scene)[0] - before).max() > 0.05

    shape = scene.shapes()[0]
    vertices = shape.vertex_count()
    params["head.deformation"] = mi.Float(other["deformation"])
    params.update()
    assert shape.vertex_count() != vertices, "this test needs a mesh of another size"
    baked, exact = albedos(scene)
    assert np.abs(baked - exact).max() < 0.04


def test_baked_albedos_have_no_gradients_and_no_place_outside_of_a_head(avatar_path):
    scene = baked_scene(avatar_path)
    params = mi.traverse(scene)
    dr.enable_grad(params["head.bsdf.diffuse_albedo.weights"])
    params.update()
    with pytest.raises(RuntimeError, match="no gradients"):
        albedos(scene)
    texture = mi.load_dict({"type": "neural_albedo", "avatar": avatar_path, "baked": True})
    with pytest.raises(RuntimeError, match="inside a neural_sdf only"):
        texture.eval(dr.zeros(mi.SurfaceInteraction3f, 1))


@pytest.mark.slow
@pytest.mark.parametrize("integrator, kind", [("sg", "lobes"), ("path", "lobes"), ("path", "image")])
def test_the_head_turns_under_a_fixed_light(subject, integrator, kind):
    """`load_scene` moves camera and light; `to_world` of the shape turns the head itself."""
    settings = RelightSettings(integrator=integrator, samples=16 if integrator == "sg" else 64, voxel=0.1)
    light = Light(LOBES) if kind == "lobes" else Light(None, render_environment(LOBES, 32))
    scene = load_scene(load_head(subject, settings), VIEW, light, 40.0, settings)
    description = head(subject.path, 0.1, to_world=mi.ScalarTransform4f().rotate([0, 1, 0], 40.0))
    for texture in ("diffuse_albedo", "specular_albedo"):
        description["bsdf"][texture]["baked"] = integrator == "path"
    expected = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "sira_sg" if integrator == "sg" else "path", "hide_emitters": True},
            "sensor": sensor(VIEW, {"type": "multijitter" if integrator == "sg" else "independent"}),
            "head": description,
            "light": light.emitter(np.eye(3)),
        }
    )
    first, second = (render_passes(s, settings)[..., :3] for s in (scene, expected))
    if integrator == "sg":
        np.testing.assert_allclose(first, second, atol=2e-3 * second.max())
    else:
        first, second = (image.reshape(8, 4, 8, 4, 3).mean(axis=(1, 3)) for image in (first, second))
        assert np.abs(first - second).mean() < 0.012 * second.mean(), "noise of 1024 samples a block"


@pytest.mark.slow
def test_closed_form_agrees_with_path_tracing_on_a_convex_head(subject):
    """Nothing on a convex body is shadowed and no light is reflected twice, so that the closed form is only as far
    from path tracing as its integrals are approximate."""
    settings = RelightSettings(samples=256, voxel=0.1)
    result = compare(load_head(subject, settings), VIEW, Light(LOBES), 0.0, settings)
    assert abs(result.bias) < 0.006
    assert result.relative_error < 0.04, "mostly the noise of 256 samples"
    assert result.psnr > 35


@pytest.mark.slow
def test_passes_add_up_and_repeat(subject, monkeypatch):
    settings = RelightSettings(samples=10, voxel=0.2)
    scene = load_scene(load_head(subject, settings), VIEW, Light(LOBES), 0.0, settings)
    monkeypatch.setattr(render_module, "_PASS_RAYS", 4 * 32 * 32)
    counts = []
    image = render_passes(scene, settings, counts.append)
    assert counts == [4, 4, 2]
    np.testing.assert_array_equal(image, render_passes(scene, settings))
    assert (image != render_passes(scene, RelightSettings(samples=10, voxel=0.2, seed=1))).any()
    total = sum(
        n * mi.render(scene, spp=n, seed=int(np.random.SeedSequence([0, k]).generate_state(1)[0])).numpy()
        for k, n in enumerate(counts)
    )
    np.testing.assert_allclose(image, total / 10, atol=1e-6)


def test_the_camera_is_that_of_the_fit_beside_the_avatar(avatar, tmp_path):
    save_avatar(tmp_path / "avatar.safetensors", avatar)
    assert read_subject(tmp_path).camera.width == 512
    (tmp_path / "avatar.json").write_text(json.dumps({"camera": camera(50.0, 40).to_dict()}))
    assert read_subject(tmp_path).camera.width == 40
    small = read_subject(tmp_path / "avatar.safetensors", 20).camera
    assert (small.width, small.height, small.K[0, 0]) == (20, 20, 25)


def test_lights_are_the_photos_own_by_default(avatar):
    own = read_light(None, avatar, lobes=True)
    np.testing.assert_allclose(own.lobes, avatar.tensors["lobes"], atol=1e-6)


def test_exr_lights_are_exact_for_path_and_fitted_for_sg(avatar, tmp_path):
    path = tmp_path / "environment.EXR"
    image = render_environment(LOBES, 16)
    write_exr(path, image)
    np.testing.assert_array_equal(read_light(path, avatar, lobes=False).image, image)
    fitted = read_light(path, avatar, lobes=True, count=6)
    assert fitted.image is None and fitted.lobes.shape == (6, 7)


@pytest.fixture
def voxel(monkeypatch):
    """Coarse meshes, for the tests of the command that do not look at the picture."""
    default = RelightSettings.__init__
    monkeypatch.setattr(RelightSettings, "__init__", lambda self, **options: default(self, **{"voxel": 0.2, **options}))


def test_the_command_writes_both_images(avatar_path, lights, tmp_path, voxel):
    out = tmp_path / "Bild ä 1.png"
    assert main([avatar_path, "--lights", lights, "--spp", "2", "--size", "24", "--yaw", "30", "--out", str(out)]) == 0
    with OpenEXR.File(str(tmp_path / "Bild ä 1.exr")) as file:
        radiance = file.channels()["RGB"].pixels
    png = np.asarray(Image.open(out))
    assert radiance.shape == png.shape == (24, 24, 3) and radiance.max() > 0.1 and (radiance[0, 0] == 0).all()
    gain = EXPOSURE_LEVEL / np.percentile(radiance.max(axis=2)[radiance.max(axis=2) > 0], EXPOSURE_PERCENTILE)
    np.testing.assert_allclose(png / 255, linear_to_srgb(np.clip(gain * radiance, 0, 1)), atol=0.04)
    assert {p.name for p in tmp_path.iterdir()} == {"lights.json", "Bild ä 1.png", "Bild ä 1.exr"}


@pytest.mark.slow
def test_the_exposure_is_metered_or_given_and_the_exr_has_none(avatar_path, tmp_path, voxel, capsys):
    """Lights a thousand times apart give the same PNG, and their EXR files keep the factor."""
    common = ["--integrator", "sg", "--spp", "1", "--size", "24", "--keep-all"]
    for name, scale in (("dim", 0.03), ("bright", 30.0)):
        write_lights(tmp_path / f"{name}.json", LOBES * ([1] * 4 + [scale] * 3))
        assert main([avatar_path, *common, "--lights", f"{tmp_path / name}.json", "--out", str(tmp_path / name)]) == 0
    dim, bright = (np.asarray(Image.open(tmp_path / f"{name}.png")).astype(int) for name in ("dim", "bright"))
    assert np.abs(dim - bright).max() <= 1 and dim.max() > 200
    dim, bright = (read_exr(tmp_path / f"{name}.exr")[0] for name in ("dim", "bright"))
    np.testing.assert_allclose(1000 * dim, bright, rtol=1e-3, atol=1e-4)
    lights = ["--lights", f"{tmp_path / 'bright'}.json"]
    capsys.readouterr()
    assert main([avatar_path, *common, *lights, "--exposure", "-5", "--out", str(tmp_path / "given")]) == 0
    assert "--exposure -5.00" in capsys.readouterr().out
    given = np.asarray(Image.open(tmp_path / "given.png"))
    np.testing.assert_allclose(given / 255, linear_to_srgb(np.clip(bright / 32, 0, 1)), atol=0.6 / 255)


def test_exposure_brings_a_percentile_to_its_level():
    pixels = np.zeros((1000, 3))
    pixels[:, 1] = np.linspace(0, 4, 1000)
    assert np.isclose(2 ** meter_exposure(pixels), EXPOSURE_LEVEL / np.percentile(pixels[:, 1], EXPOSURE_PERCENTILE))
    assert meter_exposure(np.zeros((5, 3))) == meter_exposure(np.zeros((0, 3))) == 0


def test_the_head_is_framed_from_the_place_of_the_photos_camera(avatar, tmp_path):
    """A head that is small in a corner of a wide photo fills the frame; seen from the same place."""
    save_avatar(tmp_path / "avatar.safetensors", avatar)
    wide = Camera(np.array([[50.0, 0, 90], [0, 50, 20], [0, 0, 1]]), VIEW.world_to_camera, 96, 64)
    (tmp_path / "avatar.json").write_text(json.dumps({"camera": wide.to_dict()}))
    photo = read_subject(tmp_path)
    framed = photo.frame_head().camera
    assert (framed.width, framed.height) == (96, 96)
    np.testing.assert_array_equal(framed.world_to_camera, wide.world_to_camera)
    np.testing.assert_allclose(framed.project(np.array([0, -0.2, 0])), [48, 48])
    top = framed.project(np.array([[0, 2.0, 0], [0, -2.4, 0]]))
    np.testing.assert_allclose(top[:, 1], [0, 96], atol=1e-6)
    inside = replace(photo, camera=Camera(wide.K, np.eye(4), 96, 64))
    with pytest.raises(InputError, match="--view photo"):
        inside.frame_head()


@pytest.mark.slow
def test_a_turntable_is_a_full_turn(avatar_path, lights, tmp_path, voxel, capsys):
    common = ["--lights", lights, "--integrator", "sg", "--spp", "1", "--size", "24", "--exposure", "0"]
    assert main([avatar_path, *common, "--turntable", "2", "--out", str(tmp_path / "turn.v2")]) == 0
    assert "ffmpeg" in capsys.readouterr().out
    assert main([avatar_path, *common, "--yaw", "180", "--out", str(tmp_path / "back.exr")]) == 0
    names = {f"{stem}.{kind}" for stem in ("turn.v2_000", "turn.v2_001", "back") for kind in ("png", "exr")}
    assert names < {p.name for p in tmp_path.iterdir()}
    images = [np.asarray(Image.open(tmp_path / f"{stem}.png")) for stem in ("turn.v2_000", "turn.v2_001", "back")]
    assert (images[1] == images[2]).all() and (images[0] != images[1]).any()


@pytest.mark.slow
def test_a_draft_is_close_to_the_closed_form(avatar_path, lights, tmp_path, voxel):
    """The mesh shaded once a pixel, of a smooth blob: not the same picture, and near to it."""
    common = ["--lights", lights, "--integrator", "sg", "--spp", "4", "--size", "96"]
    for name, options in (("full", []), ("draft", ["--draft"])):
        assert main([avatar_path, *common, *options, "--out", str(tmp_path / name)]) == 0
    full, draft = (mi.TensorXf(mi.Bitmap(str(tmp_path / f"{name}.exr"))).numpy() for name in ("full", "draft"))
    difference = np.abs(full - draft)[full.max(axis=2) > 0]
    assert 0 < difference.mean() < 0.03 * full[full > 0].mean()


@pytest.mark.slow
def test_the_comparison_prints_its_figures(avatar_path, lights, tmp_path, voxel, capsys):
    assert (
        main([avatar_path, "--lights", lights, "--compare", "--spp", "8", "--size", "24", "--out", str(tmp_path / "c")])
        == 0
    )
    assert "PSNR" in capsys.readouterr().out
    assert {p.name for p in tmp_path.glob("c_*")} == {"c_sg.png", "c_sg.exr", "c_path.png", "c_path.exr"}


@pytest.mark.parametrize(
    "change, message",
    [
        ({"avatar": "missing"}, "no such avatar file"),
        ({"avatar": "empty folder"}, "holds no avatar.safetensors"),
        ({"avatar": "damaged"}, "damaged or not a safetensors file"),
        ({"avatar": "nan"}, "not finite"),
        ({"avatar": "no surface"}, "no surface"),
        ({"avatar": "bad report"}, "not JSON"),
        ({"--lights": "missing.json"}, "no such light file"),
        ({"--lights": "missing.exr"}, "no such light file"),
        ({"--lights": "damaged"}, r"lights are \.json"),
        ({"--lights": "damaged.json"}, "not JSON"),
        ({"--lights": "damaged.exr"}, "not a readable OpenEXR"),
        ({"--spp": "0"}, "--spp is 0"),
        ({"--spp": "many"}, "invalid int value"),
        ({"--size": "-4"}, "--size is -4"),
        ({"--size": "100000"}, "--size is 100000"),
        ({"--yaw": "nan"}, "--yaw is nan"),
        ({"--seed": "-1"}, "--seed is -1"),
        ({"--turntable": "0"}, "--turntable is 0"),
        ({"--integrator": "magic"}, "invalid choice"),
        ({"--draft": None}, "belongs to --integrator sg"),
        ({"--variant": "magic"}, "no variant magic"),
        ({"--out": "no such folder/x"}, "cannot write to"),
        ({"--out": "x.jpg"}, r"ends in \.jpg"),
    ],
    ids=lambda value: "-".join(map(str, *value.items())) if isinstance(value, dict) else "",
)
def test_bad_input_is_said_and_writes_nothing(change, message, avatar, avatar_path, lights, tmp_path):
    bad = tmp_path / "bad"
    (bad / "empty folder").mkdir(parents=True)
    for name in ("damaged", "damaged.json", "damaged.exr"):
        (bad / name).write_bytes(b"\x80 this is none of these")
    save_avatar(bad / "nan", avatar.with_tensors(z_sdf=np.full_like(avatar.tensors["z_sdf"], np.nan)))
    reference = avatar.tensors["reference"].copy()
    reference[-1] += 100.0
    save_avatar(bad / "no surface", avatar.with_tensors(reference=reference))
    (bad / "bad report").mkdir()
    save_avatar(bad / "bad report" / "avatar.safetensors", avatar)
    (bad / "bad report" / "avatar.json").write_text("{")
    options = {"avatar": avatar_path, "--lights": lights, "--spp": "1", "--size": "8", "--out": "x"}
    for key, value in change.items():
        options[key] = str(bad / value) if key in ("avatar", "--lights") else value
    out = tmp_path / "out"
    out.mkdir()
    options["--out"] = str(out / options["--out"])
    arguments = [options.pop("avatar"), *(text for pair in options.items() for text in pair if text is not None)]
    with pytest.raises(InputError, match=message) as error:
        main(arguments)
    assert "\n" not in str(error.value)
    assert not any(out.iterdir())


@pytest.mark.slow
def test_the_process_ends_with_one_line_and_code_2(tmp_path):
    command = [sys.executable, "-m", "sira_mi.relight", str(tmp_path / "nobody"), "--out", str(tmp_path / "x")]
    result = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert result.returncode == 2 and result.stdout == ""
    assert result.stderr.startswith("error: ") and result.stderr.count("\n") == 1
