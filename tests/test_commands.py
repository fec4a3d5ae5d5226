"""Nothing of a user's is overwritten, one run at a time writes to a folder, and what a killed run left is removed."""

import os
import shlex
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from PIL import Image

from sira_mi.crosscheck.__main__ import main as cross_check
from sira_mi.errors import InputError
from sira_mi.files import check_outputs, check_own, hold_folder, write_exr, write_png, write_through
from sira_mi.fit.fit import FitRequest, check_folder, describe_start
from sira_mi.portrait.load import load_photo
from sira_mi.relight.__main__ import _parser, check_pictures, output_stem, picture_stems, video_command


def relight(avatar, *arguments):
    """What the command checks before it renders."""
    options = _parser().parse_args([str(avatar), *map(str, arguments)])
    check_pictures(picture_stems(output_stem(options.out), options), options)


@pytest.mark.parametrize(
    "name, out, more",
    [
        ("sunset.exr", "sunset", []),
        ("sunset.exr", "sunset.png", []),
        ("turn_001.exr", "turn", ["--turntable", "2"]),
        ("a_path.exr", "a", ["--compare"]),
    ],
)
def test_relighting_never_overwrites_its_light(name, out, more, avatar_path, tmp_path):
    """By any of its pictures, by another spelling of the path, and by a link to the light."""
    write_exr(tmp_path / name, np.ones((4, 8, 3)))
    os.symlink(tmp_path / name, tmp_path / "link.exr")
    for light in (tmp_path / name, tmp_path / ".." / tmp_path.name / name, tmp_path / "link.exr"):
        with pytest.raises(InputError, match="is an input"):
            relight(avatar_path, "--lights", light, "--out", tmp_path / out, *more)


def test_a_cross_check_never_overwrites_its_light(tmp_path, avatar_path):
    light = tmp_path / "crosscheck.json"
    light.write_text("{}")
    with pytest.raises(InputError, match="is an input"):
        cross_check([avatar_path, "--lights", str(light), "--out", str(tmp_path)])


def test_relighting_replaces_its_own_pictures_alone(avatar_path, tmp_path):
    """A photo or an environment of the same name is the user's, although the command does not read it."""
    write_exr(tmp_path / "me.exr", np.ones((4, 8, 3)))
    write_png(tmp_path / "me.png", np.ones((4, 8)))
    relight(avatar_path, "--out", tmp_path / "me")
    Image.new("RGB", (8, 8)).save(tmp_path / "me.png")
    with pytest.raises(InputError, match=r"me\.png is no picture of this program"):
        relight(avatar_path, "--out", tmp_path / "me")
    (tmp_path / "you.exr").write_bytes(b"")
    with pytest.raises(InputError, match=r"you\.exr"):
        check_own([tmp_path / "you.exr"])


@pytest.mark.parametrize("out", ["pictures/", "pictures", "new/", ".", "..", "n" * 252])
def test_a_picture_has_a_name_that_files_can_have(out, avatar_path, tmp_path, monkeypatch):
    """It is refused before rendering where it is a folder's, or too long with its ending."""
    (tmp_path / "pictures").mkdir()
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match="--out"):
        relight(avatar_path, "--out", out)
    relight(avatar_path, "--out", "n" * 248)
    write_png(tmp_path / f"{'n' * 251}.png", np.ones((4, 4)))


@pytest.mark.parametrize(
    "option, name",
    [
        ("photo", "input.png"),
        ("mask", "renders/mask.png"),
        ("camera", "avatar.json"),
        ("prior", "avatar.safetensors"),
    ],
)
def test_a_fit_never_overwrites_its_input(option, name, tmp_path):
    (tmp_path / ".fit").mkdir()
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_bytes(b"the user's")
    (tmp_path / "me.jpg").write_bytes(b"a photo may lie in the folder")
    request = FitRequest(**{"photo": tmp_path / "me.jpg", "out": tmp_path, option: tmp_path / name})
    with pytest.raises(InputError, match="is an input"):
        check_folder(request)


@pytest.mark.parametrize("name", ["input.png", "lights.exr", "renders", "scene.xml", "mesh.ply"])
def test_a_fit_writes_over_files_of_a_fit_alone(name, tmp_path):
    request = FitRequest(photo=None, example=True, out=tmp_path)
    check_folder(request)
    (tmp_path / name).mkdir() if name == "renders" else (tmp_path / name).write_bytes(b"the user's")
    with pytest.raises(InputError, match=name):
        check_folder(request)
    (tmp_path / "avatar.json").write_text("{}")
    check_folder(request)


def test_outputs_are_files_or_nothing(tmp_path):
    check_outputs([tmp_path / "new"], [None, tmp_path / "missing"])
    with pytest.raises(InputError, match="is a folder"):
        check_outputs([tmp_path], [])


def test_where_a_fit_starts_is_said(tmp_path):
    """With --resume where there is nothing to resume from, and without it where there is."""
    assert describe_start(tmp_path, resume=False) is None
    assert "no checkpoint to resume from" in describe_start(tmp_path, resume=True)
    (tmp_path / ".fit").mkdir()
    assert "no checkpoint to resume from" in describe_start(tmp_path, resume=True)
    (tmp_path / ".fit" / "checkpoint.safetensors").touch()
    assert describe_start(tmp_path, resume=True) is None
    assert "unfinished fit" in describe_start(tmp_path, resume=False)


HOLDER = """
import sys, time
from pathlib import Path
from sira_mi.files import hold_folder, write_through
with hold_folder(Path(sys.argv[1])):
    def write(file):
        file.write_bytes(b"half")
        print("held", flush=True)
        time.sleep(60)
    write_through(Path(sys.argv[1]) / "a.png", write)
"""


def test_a_folder_is_one_runs_until_it_ends_or_is_killed(tmp_path):
    """The next run then removes the file that the killed one was writing, and none of a run that goes on."""
    folder = tmp_path / "new" / "a"
    process = subprocess.Popen([sys.executable, "-c", HOLDER, str(folder)], stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout.readline() == "held\n"
        with pytest.raises(InputError, match="another run"), hold_folder(folder):
            pass
        write_through(folder / "b.png", lambda file: file.write_bytes(b"whole"))
        assert len(list(folder.glob(".sira_mi.*"))) == 1
    finally:
        process.kill()
        process.communicate()
    with hold_folder(folder):
        write_through(folder / "b.png", lambda file: file.write_bytes(b"whole"))
    assert [path.name for path in folder.iterdir()] == ["b.png"]


def test_a_held_folder_that_stays_empty_is_removed(tmp_path):
    with pytest.raises(KeyError), hold_folder(tmp_path / "a" / "b"):
        raise KeyError
    with hold_folder(tmp_path):
        pass
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="--out"), hold_folder(tmp_path / "file"):
        pass


def test_the_video_command_holds_any_name(tmp_path):
    """Spaces, quotes, percent signs and a leading dash; odd sides are padded, and frames of an earlier run left out."""
    stem = tmp_path / "50% 'light'" / "-turn"
    words = shlex.split(video_command(stem, 2))
    pattern = words[words.index("-i") + 1]
    assert pattern % 1 == f"{stem}_001.png" and words[-1] == f"{stem}.mp4"
    assert words[words.index("-frames:v") + 1] == "2" and words[words.index("-vf") + 1].startswith("pad=")


def test_photos_are_loaded_by_many_threads(tmp_path, capfd):
    """Each silences its decoder; afterwards both streams are as before."""
    path = tmp_path / "p.png"
    write_png(path, np.random.default_rng(0).uniform(size=(300, 300, 3)))
    with ThreadPoolExecutor(4) as pool:
        list(pool.map(load_photo, [path] * 24))
    print("out", flush=True)
    os.write(2, b"err")
    assert capfd.readouterr() == ("out\n", "err")


COMMAND = """
import os, sys, time
from sira_mi.errors import InputError, run_command
from sira_mi.interrupts import check_interrupt, postpone_interrupts

def inside_a_library():
    try:
        time.sleep(20)
    except KeyboardInterrupt:
        raise RuntimeError("what Dr.Jit makes of it") from None

def in_steps():
    with postpone_interrupts():
        for step in range(400):
            time.sleep(0.05)
            check_interrupt()

def last_step():
    with postpone_interrupts():
        end = time.monotonic() + 2
        while time.monotonic() < end:
            time.sleep(0.1)

def stuck():
    with postpone_interrupts():
        time.sleep(20)

def main():
    print("ready", flush=True)
    globals()[sys.argv[1]]()

run_command(main)
"""


@pytest.mark.parametrize(
    "body, times", [("inside_a_library", 1), ("in_steps", 1), ("in_steps", 2), ("last_step", 1), ("stuck", 3)]
)
def test_an_interrupt_ends_a_command_in_one_line(body, times):
    """Once, twice at the same time as by a wrapper of the command, and again later, which ends it at once."""
    process = subprocess.Popen(
        [sys.executable, "-c", COMMAND, body], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout.readline() == "ready\n"
    time.sleep(0.2)
    for count in range(times):
        time.sleep(1.2 if count == 2 else 0)
        process.send_signal(signal.SIGINT)
    error = process.communicate(timeout=15)[1]
    assert process.returncode == 130
    assert error.splitlines()[-1] == "interrupted" and "Traceback" not in error


STREAMS = """
import os, sys
from sira_mi.errors import run_command
def main():
    print("head ä θ")
    print("note: ä", file=sys.stderr)
    file = open(sys.argv[1], "wb")
    os.write(2, b"what a library says")
run_command(main)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="descriptors are closed before the process starts")
@pytest.mark.parametrize("closed", [(), (2,), (1, 2), (0, 1, 2)])
def test_commands_run_without_streams_and_in_ascii(closed, tmp_path):
    """No file of the command gets the descriptor of a stream, into which libraries write."""
    file = tmp_path / "x"
    process = subprocess.run(
        [sys.executable, "-c", STREAMS, str(file)],
        env={**os.environ, "PYTHONIOENCODING": "ascii"},
        stdout=subprocess.PIPE,
        preexec_fn=lambda: [os.close(descriptor) for descriptor in closed],
        timeout=30,
    )
    assert process.returncode == 0 and file.read_bytes() == b""
    assert process.stdout == (b"" if 1 in closed else b"head \\xe4 \\u03b8\n")


def test_a_reader_that_goes_away_is_no_traceback():
    code = "from sira_mi.errors import run_command\nrun_command(lambda: print('x' * 100_000))"
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    process.stdout.close()
    assert process.stderr.read() == b"" and process.wait() == 1


@pytest.mark.parametrize("level", ["-O", "-OO"])
@pytest.mark.parametrize("command", ["fit", "relight", "crosscheck", "training", "training.collection"])
def test_commands_start_without_docstrings(command, level):
    process = subprocess.run(
        [sys.executable, level, "-m", f"sira_mi.{command}", "--help"], capture_output=True, text=True, timeout=60
    )
    assert process.returncode == 0 and "usage" in process.stdout
