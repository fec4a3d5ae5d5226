"""Sheets of photos without truth: every picture is in its place, fits are used again, failures are named."""

import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from sira_mi.errors import InputError
from sira_mi.files import write_png
from studies.portraits import __main__ as portraits
from studies.portraits import real

LAYERS = {"input": 0.1, "renders/mask": 0.2, "renders/final": 0.3, "renders/normal": 0.4, "renders/diffuse_albedo": 0.5}


@pytest.fixture
def commands(monkeypatch):
    """Stands in for all commands: a fit writes grey pictures, `relight` others; "faceless.jpg" has no face."""
    ran: list[list[str]] = []

    def run(arguments, log):
        ran.append([str(argument) for argument in arguments[1:]])
        out = Path(arguments[arguments.index("--out") + 1])
        if "faceless.jpg" in ran[-1]:
            return {"error": "no face found"}
        if arguments[1] == "sira_mi.fit":
            (out / "renders").mkdir(parents=True)
            for name, grey in LAYERS.items():
                write_png(out / f"{name}.png", np.full((40, 30), grey))
            (out / "avatar.json").write_text("{}")
        else:
            write_png(out, np.full((32, 32, 3), 0.6 + 0.05 * len([c for c in ran if c[0] == "sira_mi.relight"])))
        return {}

    monkeypatch.setattr(real, "run_measured", run)
    return ran


def test_a_sheet_has_the_layers_and_the_head_turned_and_relit(commands, tmp_path, monkeypatch, capsys):
    arguments = ["portraits", "real", "faceless.jpg", "me.jpg", "--out", str(tmp_path), "--lights", "a.exr", "b.json"]
    monkeypatch.setattr(sys, "argv", arguments)
    portraits.main()
    printed = capsys.readouterr().out.splitlines()
    assert printed == [
        f"{tmp_path / 'example.png'} written",
        "failed: faceless: no face found",
        f"{tmp_path / 'me.png'} written",
    ]
    assert commands[0][:2] == ["sira_mi.fit", "--example"] and commands[0][-4:-2] == ["--quality", "draft"]
    turns = [(c[c.index("--lights") + 1], c[c.index("--yaw") + 1]) for c in commands[1:5]]
    assert turns == [("a.exr", "30"), ("a.exr", "-30"), ("a.exr", "0"), ("b.json", "0")]
    sheet = np.asarray(Image.open(tmp_path / "example.png").convert("L")) / 255
    side = sheet.shape[0] // 2
    assert sheet.shape == (2 * side, 5 * side)
    centres = sheet[side // 2 :: side, side // 2 :: side]
    np.testing.assert_allclose(centres, [[0.1, 0.2, 0.3, 0.4, 0.5], [0.65, 0.7, 0.75, 0.8, 0]], atol=0.01)
    commands.clear()
    portraits.main()
    assert [command[0] for command in commands].count("sira_mi.fit") == 1  # of the photo that failed


def test_photos_of_one_name_are_refused(monkeypatch, tmp_path):
    for photos in (["a/me.jpg", "b/me.png"], ["example.jpg"]):
        monkeypatch.setattr(sys, "argv", ["portraits", "real", *photos, "--out", str(tmp_path)])
        with pytest.raises(InputError, match="have one name"):
            portraits.main()
