"""Files of a portrait's truth read back as written, and errors name what is wrong with one."""

import dataclasses
import json

import numpy as np
import pytest
from egg import SIZE, head_like, truth_of

from sira_mi.errors import InputError
from studies.portraits.relit_lights import exposure_of
from studies.portraits.truth import VIEWS, Truth, load_truth, load_views


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


def write_views(folder, **changes):
    """The views of a portrait whose head is a square; an array is left out for None."""
    mask = np.zeros((4, 6), np.uint8)
    mask[1:3, 2:5] = 255
    one = {
        "image": np.repeat(mask[..., None] / 510, 3, axis=2).astype(np.float16),
        "mask": mask,
        "region": np.where(mask > 0, 0, 255).astype(np.uint8),
        "face": mask > 0,
    }
    arrays = {f"{view}_{name}": array for view in VIEWS for name, array in one.items()} | changes
    folder.mkdir(exist_ok=True)
    np.savez(folder / "views.npz", **{name: array for name, array in arrays.items() if array is not None})
    (folder / "portrait.json").write_text(json.dumps({"key": "", "entry": {"relights": ["noon", "lamp"]}}))
    return folder


def test_views_are_read_with_their_light_and_turn(tmp_path):
    views = load_views(write_views(tmp_path))
    assert {name: (view.light, view.yaw) for name, view in views.items()} == {
        "relit_1": ("noon", 0),
        "relit_2": ("lamp", 0),
        "turned_left": ("noon", 30),
        "turned_right": ("noon", -30),
    }
    view = views["relit_2"]
    assert view.image.shape == (4, 6, 3) and view.image.dtype == view.mask.dtype == np.float32
    assert view.mask.max() == 1 and view.image[1, 2, 0] == 0.5 and view.face.sum() == 6


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"turned_left_face": None}, "holds no views of a portrait: .*turned_left_face"),
        ({"relit_1_mask": np.zeros(4, np.uint8)}, "relit_1_mask must be an image"),
        ({"relit_2_region": np.zeros((6, 4), np.uint8)}, r"relit_2_region must be numbers \[4, 6\]"),
        ({"turned_right_image": np.full((4, 6, 3), np.nan)}, "turned_right_image contains NaN"),
        ({"relit_1_image": np.full((4, 6, 3), -1.0)}, "relit_1_image must not be negative"),
        ({"relit_1_mask": np.ones((4, 6))}, "relit_1_mask must be of type u1, not float64"),
    ],
)
def test_broken_views_are_named(tmp_path, changes, message):
    with pytest.raises(InputError, match=message):
        load_views(write_views(tmp_path, **changes))


def test_a_folder_without_views_is_refused(tmp_path):
    with pytest.raises(InputError, match="holds no views"):
        load_views(tmp_path)


def test_exposure_shows_an_even_light_at_one_level():
    """A white ball in an even light has the light's radiance, which is shown at 0.8; rows near the poles of a map count
    as little as they cover of the sphere."""
    even = np.full((8, 16, 3), 2.5)
    assert exposure_of(even) == pytest.approx(0.8 / 2.5)
    even[0] = 25
    assert 0.8 / 2.5 > exposure_of(even) > 0.8 / (2.5 + 0.125 * 22.5)
    with pytest.raises(InputError, match="mean luminance is 0"):
        exposure_of(0 * even)
