"""Files of a portrait's truth read back as written, and errors name what is wrong with one."""

import dataclasses

import numpy as np
import pytest
from egg import SIZE, head_like, truth_of

from sira_mi.errors import InputError
from studies.portraits.truth import Truth, load_truth


@pytest.fixture(scope="module")
def truth() -> Truth:
    return truth_of(*head_like())


def write(path, truth: Truth, **changes):
    arrays = {field.name: getattr(truth, field.name) for field in dataclasses.fields(truth) if field.name != "camera"}
    arrays |= {"K": truth.camera.K, "world_to_camera": truth.camera.world_to_camera}
    arrays["landmarks_valid"] = np.isfinite(truth.landmarks).all(axis=1)
    arrays["landmarks"] = np.nan_to_num(truth.landmarks).astype(np.float32)
    arrays["faces"] = truth.faces.astype(np.int32)
    arrays |= changes
    np.savez(path, **{name: value for name, value in arrays.items() if value is not None})
    return path


def test_a_truth_is_read_as_it_was_written(truth, tmp_path):
    read = load_truth(write(tmp_path / "truth.npz", truth))
    for field in dataclasses.fields(truth):
        if field.name != "camera":
            np.testing.assert_allclose(getattr(read, field.name), getattr(truth, field.name), rtol=1e-6)
    np.testing.assert_array_equal(read.camera.world_to_camera, truth.camera.world_to_camera)
    assert (read.camera.width, read.camera.height) == (SIZE, SIZE)
    assert np.isnan(read.landmarks).any(axis=1).sum() == 462


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"shadow": None}, "shadow"),
        ({"shading": np.zeros((3, 3))}, r"shading must be numbers \[64, 64\]"),
        ({"mask": np.zeros(4)}, "mask must be an image"),
        ({"mask": np.full((SIZE, SIZE), 2.0)}, "mask must be within 0 and 1"),
        ({"image": np.full((SIZE, SIZE, 3), np.inf)}, "image contains NaN or infinity"),
        ({"faces": np.array([[0, 1, -1]]), "face_region": np.zeros(1, np.uint8)}, "do not exist"),
        ({"face_region": np.zeros(7, np.uint8)}, "face_region must be numbers"),
        ({"world_to_camera": 2 * np.eye(4)}, "last row of world_to_camera"),
        ({"landmarks": np.full((468, 3), np.nan)}, "a valid landmark is not finite"),
    ],
)
def test_a_broken_truth_is_named(truth, tmp_path, changes, message):
    with pytest.raises(InputError, match=message):
        load_truth(write(tmp_path / "truth.npz", truth, **changes))


def test_a_file_that_is_no_truth_is_refused(tmp_path):
    (tmp_path / "truth.npz").write_bytes(b"no archive")
    for path in (tmp_path / "truth.npz", tmp_path / "missing.npz"):
        with pytest.raises(InputError, match="not the truth of a portrait"):
            load_truth(path)
