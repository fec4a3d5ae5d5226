"""A user's files: what is no file is refused before it is opened, and JSON is read as other programs write it."""

import json
import os

import numpy as np
import pytest
from conftest import one_line
from PIL import Image

from sira_mi.avatar.file import PRIOR, load_avatar, load_prior
from sira_mi.errors import InputError
from sira_mi.files import check_file, parse_json, read_json
from sira_mi.portrait.load import load_photo
from sira_mi.portrait.mask import load_mask
from sira_mi.portrait.portrait import _read_camera
from sira_mi.relight.subject import read_light, read_subject
from sira_mi.sg.lights_io import read_environment, read_lights

LIGHTS = {"lobes": [{"axis": [0, 0, 1], "sharpness": 2, "amplitude": [1, 1, 1]}]}
CAMERA = {
    "K": [[300, 0, 32], [0, 300, 32], [0, 0, 1]],
    "world_to_camera": np.eye(4).tolist(),
    "width": 64,
    "height": 64,
}


@pytest.fixture
def photo(tmp_path):
    Image.new("RGB", (64, 64)).save(tmp_path / "photo.png")
    return load_photo(tmp_path / "photo.png")


def make_folder(path):
    path.mkdir()


def make_pipe(path):
    os.mkfifo(path)


def make_device(path):
    path.symlink_to("/dev/zero")


def make_loop(path):
    path.symlink_to(path)


def make_empty(path):
    path.touch()


def make_below_a_file(path):
    path.parent.touch()


NO_FILES = {
    "missing": (lambda path: None, "x"),
    "folder": (make_folder, "x"),
    "pipe": (make_pipe, "x"),
    "device": (make_device, "x"),
    "loop of links": (make_loop, "x"),
    "empty": (make_empty, "x"),
    "below a file": (make_below_a_file, "file/x"),
    "name too long": (lambda path: None, "x" * 300),
    "path too long": (lambda path: None, "/".join(["x" * 200] * 30)),
    "name with a null byte": (lambda path: None, "a\0b"),
    "name not in UTF-8": (lambda path: None, os.fsdecode(b"\xff\xfe")),
}
READERS = {
    "avatar": load_avatar,
    "prior": load_prior,
    "subject": read_subject,
    "photo": load_photo,
    "mask": lambda path: load_mask(path, None, 1000),
    "camera": lambda path: _read_camera(path, None),
    "lights": read_lights,
    "environment": read_environment,
    "light.exr": lambda path: read_light(path.with_name(path.name + ".exr"), None, lobes=False),
    "JSON": lambda path: read_json(path, "settings"),
}


@pytest.mark.parametrize("kind", NO_FILES)
@pytest.mark.parametrize("reader", READERS)
def test_paths_that_are_no_files_are_refused(tmp_path, reader, kind):
    """By one line that says what is wrong, by every reader; none hangs at a pipe or reads a device to its end."""
    make, name = NO_FILES[kind]
    path = tmp_path / name
    make(path.with_name(path.name + ".exr") if reader == "light.exr" and kind in ("folder", "pipe", "device") else path)
    with pytest.raises(InputError) as error:
        READERS[reader](path)
    message = str(error.value)
    assert "\n" not in message and "\0" not in message
    message.encode()


def test_sizes_are_checked_before_reading(tmp_path):
    """A file of a terabyte, most of it a hole."""
    path = tmp_path / "large"
    with path.open("wb") as file:
        file.truncate(1 << 40)
    for reader in ("avatar", "camera", "lights", "JSON"):
        with pytest.raises(InputError) as error:
            READERS[reader](path)
        one_line(error, "larger than any")
    assert check_file(PRIOR, "prior", 64 << 20) == PRIOR


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be", "utf-32"])
@pytest.mark.parametrize("line_end", ["\n", "\r\n", "\r"])
def test_json_is_read_in_every_unicode_encoding(tmp_path, photo, encoding, line_end):
    """With or without a byte order mark, as programs on other systems write it."""
    for data, read in ((LIGHTS, read_lights), (CAMERA, lambda path: _read_camera(path, photo).to_dict())):
        path = tmp_path / "file.json"
        path.write_text(json.dumps(data, indent=1), encoding="utf-8")
        expected = read(path)
        path.write_bytes(json.dumps(data, indent=1).replace("\n", line_end).encode(encoding))
        np.testing.assert_equal(read(path), expected)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (" ", "not JSON"),
        ("{", "not JSON"),
        ("[1, 2,]", "not JSON"),
        ("[" * 100_000, "not JSON"),
        ('{"a":' * 100_000, "not JSON"),
        (b"\xff\xfe\x00", "not JSON"),
        (b"\x89PNG\r\n\x1a\n", "not JSON"),
        ("[NaN]", "(NaN)"),
        ("[-Infinity]", "(-Infinity)"),
        ("[1e400]", "(1e400)"),
        ("[-1" + "0" * 400 + "]", "(-100000000000000...)"),
        ("[1" + "0" * 5000 + "]", "NaN or infinity"),
        ("[1" + "0" * 5000 + ".5]", "NaN or infinity"),
    ],
)
def test_bad_json_is_named(tmp_path, text, words):
    path = tmp_path / "bad.json"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    for read in (lambda: read_json(path, "settings"), lambda: read_lights(path), lambda: _read_camera(path, None)):
        with pytest.raises(InputError) as error:
            read()
        one_line(error, str(path), words)


def test_a_million_entries_are_refused(tmp_path, photo):
    """Files under the size limit that hold far more than they may; whole numbers of many digits stay exact."""
    path = tmp_path / "many.json"
    path.write_text('{"lobes": [' + ",".join(["0"] * 1_000_000) + "]}")
    with pytest.raises(InputError) as error:
        read_lights(path)
    one_line(error, "1000000 lobes")
    path.write_text(json.dumps({**CAMERA, "K": [0] * 1_000_000}))
    with pytest.raises(InputError) as error:
        _read_camera(path, photo)
    one_line(error, "K must be 3x3")
    assert parse_json("[" + "9" * 300 + "]", "text") == [int("9" * 300)]
    assert parse_json("[0.1, -0, 1e-400]", "text") == [0.1, 0, 0.0]
