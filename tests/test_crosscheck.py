"""`python -m sira_mi.crosscheck`: its figures on a blob, its page, and its errors for bad input."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from conftest import camera
from PIL import Image

from sira_mi.avatar.file import save_avatar
from sira_mi.crosscheck.__main__ import main
from sira_mi.crosscheck.page import colour_difference, cross_check, page
from sira_mi.errors import InputError
from sira_mi.relight.render import RelightSettings
from sira_mi.relight.subject import Light, Subject
from sira_mi.sg.lights_io import write_lights

LOBES = np.array([[-0.5, 0.4, 0.76, 6, 2.0, 1.8, 1.5], [0, 1, 0, 0.5, 0.3, 0.35, 0.4]], np.float32)
FIGURES = {
    "avatar": "anna",
    "light": None,
    "width": 64,
    "height": 48,
    "pixels": 1200,
    "yaw_degrees": 30.0,
    "seed": 7,
    "closed_form": {"samples": 8, "seconds": 1.25},
    "path": {"samples": 64, "seconds": 3.5},
    "psnr_db": 38.21,
    "error": 0.0312,
    "noise": 0.0101,
    "bias": -0.004,
}


@pytest.fixture(autouse=True)
def voxel(monkeypatch):
    """Coarse meshes."""
    default = RelightSettings.__init__
    monkeypatch.setattr(RelightSettings, "__init__", lambda self, **options: default(self, **{"voxel": 0.2, **options}))


@pytest.mark.slow
def test_the_noise_of_path_tracing_is_taken_out(avatar, avatar_path):
    """On a convex blob the closed form is almost exact: its error stays below the noise, which halves with four times
    the samples."""
    subject, found = Subject(Path(avatar_path), avatar, camera(50.0)), {}
    for samples in (32, 128):
        found[samples], picture = cross_check(subject, Light(LOBES), ("blob", None), 20.0, samples, 0)
    assert found[128]["noise"] == pytest.approx(0.5 * found[32]["noise"], rel=0.15)
    for figures in found.values():
        assert figures["error"] < 0.7 * figures["noise"]
        assert abs(figures["bias"]) < 0.03 and figures["psnr_db"] > 20
    assert picture.shape == (32, 96, 3) and picture.min() >= 0 and picture.max() <= 1


def test_the_page_is_its_figures_and_nothing_else():
    text = page(FIGURES)
    for words in ("`anna`", "that of the photo", "64 × 48", "38.2 dB", "3.12%", "1.01%", "-0.40%", "3.5 s"):
        assert words in text
    assert page({**FIGURES, "light": "studio.exr"}).startswith(text.split("Light")[0]) and "{" not in text
    assert page(json.loads(json.dumps(FIGURES))) == text


def test_colours_of_a_difference_say_its_sign():
    zero, more, less = colour_difference(np.array([[0.0, 2.0, -0.5]]))[0]
    assert (zero == 1).all() and more[0] > more[2] and less[2] > less[0] > 0.5


def test_the_command_writes_page_picture_and_figures(avatar_path, tmp_path):
    write_lights(tmp_path / "lights.json", LOBES)
    common = ["--lights", str(tmp_path / "lights.json"), "--size", "24", "--spp", "4"]
    assert main([avatar_path, *common, "--out", str(tmp_path)]) == 0
    names = {"lights.json", "crosscheck.md", "crosscheck.json", "crosscheck.png"}
    assert {p.name for p in tmp_path.iterdir()} == names
    figures = json.loads((tmp_path / "crosscheck.json").read_text())
    assert (tmp_path / "crosscheck.md").read_text(encoding="utf-8") == page(figures)
    assert figures["light"] == "lights.json" and Image.open(tmp_path / "crosscheck.png").size == (72, 24)


@pytest.mark.parametrize(
    "change, message",
    [
        ({"avatar": "missing"}, "no such avatar file"),
        ({"avatar": "damaged"}, "damaged or not a safetensors file"),
        ({"avatar": "no surface"}, "no surface"),
        ({"--lights": "missing.json"}, "no such light file"),
        ({"--size": "4"}, "--size is 4"),
        ({"--spp": "1"}, "--spp is 1"),
        ({"--spp": "many"}, "invalid int value"),
        ({"--yaw": "inf"}, "--yaw is inf"),
        ({"--seed": "-1"}, "--seed is -1"),
        ({"--variant": "magic"}, "no variant magic"),
        ({"--out": "nowhere"}, "is not a folder"),
    ],
    ids=lambda value: "-".join(value) if isinstance(value, dict) else "",
)
def test_bad_input_is_said_and_writes_nothing(change, message, avatar, avatar_path, tmp_path):
    bad, out = tmp_path / "bad", tmp_path / "out"
    bad.mkdir(), out.mkdir()
    (bad / "damaged").write_bytes(b"\x80 this is none of these")
    reference = avatar.tensors["reference"].copy()
    reference[-1] += 100.0
    save_avatar(bad / "no surface", avatar.with_tensors(reference=reference))
    options = {"avatar": avatar_path, "--spp": "2", "--size": "8", "--out": str(out)}
    for key, value in change.items():
        options[key] = str(bad / value) if key in ("avatar", "--lights", "--out") else value
    arguments = [options.pop("avatar"), *(text for pair in options.items() for text in pair)]
    with pytest.raises(InputError, match=message) as error:
        main(arguments)
    assert "\n" not in str(error.value)
    assert not any(out.iterdir())


@pytest.mark.slow
def test_the_process_ends_with_one_line_and_code_2(tmp_path):
    command = [sys.executable, "-m", "sira_mi.crosscheck", str(tmp_path / "nobody"), "--out", str(tmp_path)]
    result = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert result.returncode == 2 and result.stdout == ""
    assert result.stderr.startswith("error: ") and result.stderr.count("\n") == 1
