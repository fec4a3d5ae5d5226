"""The fit as a user runs it: its output folder, resuming to the same result, interrupts, bad input."""

import json
import os
import signal
import subprocess
import sys
from dataclasses import fields, replace
from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest
import skimage.data
import trimesh
from conftest import tiny_fit
from PIL import Image

from sira_mi.avatar.file import DETAIL, PRIOR, load_avatar
from sira_mi.colour import linear_to_srgb, srgb_to_linear
from sira_mi.errors import InputError
from sira_mi.files import write_exr
from sira_mi.fit import settings as fit_settings
from sira_mi.fit.driver import Progress, load_progress, save_progress
from sira_mi.fit.memory import peak_memory
from sira_mi.fit.output import label_tile
from sira_mi.fit.rays import find_modelled_pixels, pixel_rays
from sira_mi.fit.state import FitState
from sira_mi.portrait.camera import Camera
from sira_mi.portrait.portrait import Portrait
from sira_mi.relight.pictures import psnr
from studies.portraits.shared_residual import SharedResidualStage

TINY = tiny_fit(steps=6)


@pytest.fixture(scope="module")
def fit():
    """`fit_photo` with the tiny settings as its draft quality."""
    from sira_mi.fit.fit import FitRequest, fit_photo

    def run(out, **options):
        patch = pytest.MonkeyPatch()
        patch.setitem(fit_settings.QUALITIES, "draft", TINY)
        try:
            return fit_photo(FitRequest(photo=options.pop("photo", None), out=out, quality="draft", **options))
        finally:
            patch.undo()

    return run


@pytest.fixture(scope="module")
def finished(fit, tmp_path_factory):
    """The folder of a finished tiny fit of the example."""
    out = tmp_path_factory.mktemp("fit") / "avatar with späce"
    assert fit(out, example=True) == 0
    return out


@pytest.mark.slow
def test_output_folder_is_complete_and_consistent(finished):
    """Every file that the README promises is there, at the photo's working resolution, and opens."""
    report = json.loads((finished / "avatar.json").read_text())
    assert report["complete"] and report["psnr_inside_mask_db"] > 8
    assert set(report["losses"]) == {stage.name for stage in TINY.stages if stage.steps}
    left_out = {(d["name"], d["where"]) for d in report["plan"] if d["left_out"]}
    assert {("specular term", "light"), ("base albedo at every step", "refinement")} < left_out
    assert set(report["seconds"]) >= {"portrait", "latents", "refinement", "output", "total"}
    size = (128, 128)
    assert Image.open(finished / "input.png").size == size
    names = ("final", "diffuse", "specular", "diffuse_albedo", "specular_albedo", "normal", "depth")
    for name in names:
        assert Image.open(finished / "renders" / f"{name}.png").size == size
        assert tuple(mi.Bitmap(str(finished / "renders" / f"{name}.exr")).size()) == size
    mask = np.asarray(Image.open(finished / "renders" / "mask.png"))
    assert 0.05 < (mask > 127).mean() < 0.9
    assert Image.open(finished / "contact.png").size[0] > 1000
    mesh = trimesh.load(finished / "mesh.ply", process=False)
    assert mesh.is_watertight and 0.2 < np.ptp(mesh.vertices[:, 1]) < 0.6
    assert not (finished / ".fit").exists()
    avatar = load_avatar(finished / "avatar.safetensors")
    stored = json.loads((finished / "lights.json").read_text())["lobes"]
    assert np.allclose([lobe["amplitude"] for lobe in stored], avatar.tensors["lobes"][:, 4:7], rtol=1e-5)
    assert avatar.k_s == 1 and avatar.k_r == 1 and set(avatar.tensors) >= DETAIL


def test_every_tile_of_the_contact_sheet_has_a_legible_label():
    """White on black in the lower left corner, whatever is behind it, and nothing beside it is changed."""
    for grey in (0.0, 0.5, 1.0):
        tile = label_tile(np.full((50, 50), grey), "diffuse albedo")
        text = np.argwhere(tile.max(axis=2) > 0.7) if grey < 0.9 else np.argwhere(tile.min(axis=2) < 0.1)
        assert tile.shape == (320, 320, 3) and len(text) > 100
        assert text[:, 0].min() > 290 and 60 < np.ptp(text[:, 1]) < 160
        assert np.abs(tile[:280] - grey).max() < 0.01


@pytest.mark.slow
def test_scene_file_shows_the_same_picture(finished, tmp_path):
    """`mi.load_file("scene.xml")` renders `renders/final.exr` to 35 dB, before black, and as a PNG file. It is the sum
    of `renders/diffuse.exr` and `renders/specular.exr`."""
    final, diffuse, specular = (
        np.array(mi.Bitmap(str(finished / "renders" / f"{name}.exr"))) for name in ("final", "diffuse", "specular")
    )
    mask = np.asarray(Image.open(finished / "renders" / "mask.png"))
    assert (mask == 255).any()
    image = mi.render(mi.load_file(str(finished / "scene.xml"), voxel=0.12)).numpy()[..., :3]
    assert psnr(linear_to_srgb(np.clip(image, 0, 1)), linear_to_srgb(np.clip(final, 0, 1))) > 35
    assert (image[mask == 0] == 0).mean() > 0.99
    mi.util.write_bitmap(str(tmp_path / "photo.png"), image, write_async=False)
    assert Image.open(tmp_path / "photo.png").size == (image.shape[1], image.shape[0])
    np.testing.assert_allclose(final, diffuse + specular, atol=1e-3)


@pytest.mark.slow
def test_only_what_each_stage_names_is_moved(finished):
    """The reference SDF is never optimised (section 3.2.1), nor is the base albedo network (section 3.2.2); the detail
    shifts its last biases."""
    prior, avatar = load_avatar(), load_avatar(finished / "avatar.safetensors")
    for name, kept in (("reference", None), ("diffuse_albedo", -3), ("specular_albedo", None)):
        assert np.array_equal(prior.tensors[name][:kept], avatar.tensors[name][:kept])
    for name in ("deformation", "rendering", "albedo_refinement", "z_sdf", "z_r", "z_a", "z_s", "z_l"):
        assert not np.array_equal(prior.tensors[name], avatar.tensors[name])


@pytest.mark.slow
def test_a_photo_in_another_unit_of_radiance_gives_the_same_head(fit, tmp_path):
    """Shape and albedo to the bit, the light and the renders in the photo's unit, the previews alike."""
    photo = srgb_to_linear(skimage.data.astronaut()[:256, 90:346] / 255)
    factor, outs = 1024, (tmp_path / "one", tmp_path / "other")
    for out, image in zip(outs, (photo, photo * np.float32(factor)), strict=True):
        write_exr(tmp_path / "photo.exr", image)
        assert fit(out, photo=tmp_path / "photo.exr") == 0
    one, other = (load_avatar(out / "avatar.safetensors").tensors for out in outs)
    lobes = {key: tensors.pop("lobes") for key, tensors in (("one", one), ("other", other))}
    assert all(np.array_equal(value, other[name]) for name, value in one.items())
    assert np.array_equal(lobes["one"][:, :4], lobes["other"][:, :4])
    np.testing.assert_allclose(lobes["one"][:, 4:] * factor, lobes["other"][:, 4:], rtol=1e-6)
    for name, expected in {"final": factor, "diffuse": factor, "specular": factor, "diffuse_albedo": 1}.items():
        images = [np.array(mi.Bitmap(str(out / "renders" / f"{name}.exr"))) for out in outs]
        np.testing.assert_allclose(images[1], images[0] * expected, rtol=1e-4, atol=1e-5 * expected)
    for name in ("input.png", "renders/final.png"):
        first, second = (np.asarray(Image.open(out / name)).astype(int) for out in outs)
        assert np.abs(first - second).max() <= 1
    reports = [json.loads((out / "avatar.json").read_text()) for out in outs]
    assert reports[0]["exposure"] == pytest.approx(reports[1]["exposure"] * factor)
    assert reports[0]["psnr_inside_mask_db"] == pytest.approx(reports[1]["psnr_inside_mask_db"], abs=0.02)


@pytest.mark.slow
def test_killed_fit_resumes_to_the_same_result(fit, finished, tmp_path, monkeypatch):
    """A fit stopped in its geometry and again in its appearance stages ends in the same bits as one that was not."""
    from sira_mi.fit import driver

    monkeypatch.setattr(driver, "_CHECKPOINT_SECONDS", 0.0)
    real, count = driver._step, 0

    def dies(*arguments):
        nonlocal count
        count += 1
        if count in (11, 24):
            raise RuntimeError("killed")
        return real(*arguments)

    monkeypatch.setattr(driver, "_step", dies)
    out = tmp_path / "resumed"
    for _ in range(2):
        with pytest.raises(RuntimeError, match="killed"):
            fit(out, example=True, resume=True)
        assert not (out / "avatar.safetensors").exists()
    assert fit(out, example=True, resume=True) == 0
    once, twice = load_avatar(finished / "avatar.safetensors"), load_avatar(out / "avatar.safetensors")
    for name, value in once.tensors.items():
        assert np.array_equal(value, twice.tensors[name], equal_nan=True), name


@pytest.mark.slow
def test_interrupt_writes_what_there_is(fit, tmp_path, monkeypatch):
    """Ctrl-C ends cleanly: exit code 130, a whole folder that says it is not complete, and a checkpoint."""
    from sira_mi.fit import driver

    real, count = driver._step, 0

    def interrupted(*arguments):
        nonlocal count
        count += 1
        if count == 8:
            signal.raise_signal(signal.SIGINT)
        return real(*arguments)

    monkeypatch.setattr(driver, "_step", interrupted)
    assert fit(tmp_path / "a", example=True) == 130
    assert json.loads((tmp_path / "a" / "avatar.json").read_text())["complete"] is False
    assert (tmp_path / "a" / "contact.png").exists()
    assert (tmp_path / "a" / ".fit" / "checkpoint.safetensors").exists()


def test_checkpoint_of_another_fit_is_refused(tmp_path):
    """A checkpoint goes on only with the photo, settings, seed and prior that it was made with."""
    path = tmp_path / "checkpoint.safetensors"
    state = FitState({"z_sdf": np.ones(3, np.float32)}, unpolished={"z_sdf": np.zeros(3, np.float32)})
    save_progress(path, Progress(state, step=5, seconds={}, losses={}), "this fit")
    loaded = load_progress(path, "this fit")
    assert loaded.step == 5 and loaded.optimizer is None
    for before, after in ((state, loaded.state), (state.before_polish(), loaded.state.before_polish())):
        assert np.array_equal(before.avatar["z_sdf"], after.avatar["z_sdf"]) and np.array_equal(before.pose, after.pose)
    with pytest.raises(InputError, match="another photo"):
        load_progress(path, "that fit")
    path.write_bytes(path.read_bytes()[:40])
    with pytest.raises(InputError, match="checkpoint"):
        load_progress(path, "this fit")


def test_a_fit_is_identified_by_all_that_it_depends_on(fit, tmp_path, monkeypatch):
    """Settings and types of stages, seed, photo, version of the package and variant of Mitsuba."""
    from sira_mi.fit.fit import identify
    from sira_mi.fit.stage import FitTask

    nothing = np.full((468, 2), np.nan)
    photo = Portrait(np.zeros((4, 4, 3), np.float32), np.ones((4, 4), np.float32), nothing, nothing, _camera(), ())
    task = FitTask(photo, load_avatar(), PRIOR, TINY, tmp_path, TINY.plan())
    brighter = replace(task, portrait=replace(photo, image=photo.image + 1))
    *others, refinement, detail = TINY.stages
    shared = SharedResidualStage(**{f.name: getattr(refinement, f.name) for f in fields(refinement)})
    tasks = (task, brighter, replace(task, settings=replace(TINY, stages=(*others, shared, detail))))
    identities = [identify(one, seed=0) for one in tasks] + [identify(task, seed=1)]
    monkeypatch.setattr("sira_mi.__version__", "0.0.0")
    identities.append(identify(task, seed=0))
    mi.set_variant("scalar_rgb")
    identities.append(identify(task, seed=0))
    mi.set_variant("llvm_ad_rgb")
    assert len(set(identities)) == len(identities) and identify(task, seed=0) == identities[4]


def test_peak_memory_is_known_without_posix(monkeypatch):
    """In bytes; on Windows, which has no `resource`, by psutil."""
    block = np.ones(1 << 25)
    assert block.nbytes < peak_memory() < 1 << 40
    process = SimpleNamespace(memory_info=lambda: SimpleNamespace(peak_wset=123))
    monkeypatch.setattr(sys, "platform", "win32")
    monkeypatch.setitem(sys.modules, "resource", None)
    monkeypatch.setitem(sys.modules, "psutil", SimpleNamespace(Process=lambda: process))
    assert peak_memory() == 123


def _camera() -> Camera:
    k = np.array([[300.0, 0, 70], [0, 300, 50], [0, 0, 1]])
    world_to_camera = np.diag([1.0, -1, -1, 1])
    world_to_camera[2, 3] = 12
    return Camera(k, world_to_camera, 128, 96)


def test_modelled_pixels_leave_out_what_lies_below_the_floor():
    """Rays that cross the domain box and leave it through its floor say nothing about the model."""
    valid = find_modelled_pixels(_camera())
    origin, direction = pixel_rays(_camera(), *np.meshgrid(np.arange(128), np.arange(96)))
    at_back = origin + direction * ((-2.2 - origin[..., 2:]) / direction[..., 2:])
    assert not valid[at_back[..., 1] < -3.0].any()
    assert valid[48, 70] and valid.mean() > 0.3


BAD_COMMANDS = {
    "no photo": ([], "give one photo"),
    "missing photo": (["nowhere.png"], "nowhere.png"),
    "not an image": (["text.png"], "text.png"),
    "no face": (["grey.png"], "face"),
    "damaged prior": (["face.png", "--prior", "text.png"], "text.png"),
    "foreign prior": (["face.png", "--prior", "foreign.safetensors"], "not an avatar"),
    "malformed camera": (["face.png", "--camera", "text.png"], "text.png"),
    "empty mask": (["face.png", "--mask", "black.png"], "mask"),
    "camera that looks away": (["face.png", "--camera", "away.json"], "does not see the head"),
    "output is a file": (["face.png", "--out", "text.png"], "text.png"),
    "unknown variant": (["face.png", "--variant", "scalar_rgb"], "scalar_rgb"),
    "negative seed": (["face.png", "--seed", "-1"], "--seed"),
}


@pytest.fixture(scope="module")
def workshop(tmp_path_factory):
    """A folder with good and bad inputs."""
    from safetensors.numpy import save_file

    folder = tmp_path_factory.mktemp("inputs")
    Image.fromarray(skimage.data.astronaut()[:256, 90:346]).save(folder / "face.png")
    Image.new("RGB", (200, 200), (128, 128, 128)).save(folder / "grey.png")
    Image.new("L", (256, 256)).save(folder / "black.png")
    (folder / "text.png").write_text("this is no image")
    save_file({"x": np.zeros(3, np.float32)}, folder / "foreign.safetensors")
    behind = [[1, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, -12], [0, 0, 0, 1]]
    k = [[400, 0, 128], [0, 400, 128], [0, 0, 1]]
    away = {"K": k, "world_to_camera": behind, "width": 256, "height": 256}
    (folder / "away.json").write_text(json.dumps(away))
    return folder


@pytest.mark.parametrize("case", BAD_COMMANDS)
def test_bad_input_is_one_clear_line(case, workshop, monkeypatch, capsys):
    """Bad input ends with one line on stderr and exit code 2; nothing is left behind."""
    from sira_mi.errors import run_command
    from sira_mi.fit.__main__ import main

    arguments, words = BAD_COMMANDS[case]
    monkeypatch.chdir(workshop)
    before = sorted(p.name for p in workshop.iterdir())
    monkeypatch.setattr(sys, "argv", ["fit", *(["--out", "new"] if "--out" not in arguments else []), *arguments])
    with pytest.raises(SystemExit) as end:
        run_command(main)
    error = capsys.readouterr().err.strip().splitlines()
    mi.set_variant("llvm_ad_rgb")
    assert end.value.code == 2
    assert error[-1].startswith("error: ") and words in error[-1]
    assert sum(line.startswith("error: ") for line in error) == 1
    assert sorted(p.name for p in workshop.iterdir()) == before


@pytest.mark.slow
def test_command_line_from_outside(workshop, tmp_path):
    """The command as a process: exit code 2 and no traceback."""
    command = [sys.executable, "-m", "sira_mi.fit", "nowhere.png"]
    result = subprocess.run(command, cwd=workshop, env=os.environ, capture_output=True, text=True, timeout=120)
    assert result.returncode == 2
    assert result.stderr.count("\n") == 1 and "Traceback" not in result.stderr
    assert PRIOR.stat().st_size < 5 << 20
