"""Files of a portrait's truth read back as written, and errors name what is wrong with one."""

import dataclasses

import numpy as np
import pytest
from egg import SIZE, head_like, truth_of, write_truth, write_views

from sira_mi.errors import InputError
from studies.portraits.relit_lights import exposure_of
from studies.portraits.truth import Truth, load_truth, load_views


@pytest.fixture(scope="module")
def truth() -> Truth:
    return truth_of(*head_like())


def test_a_truth_is_read_as_it_was_written(truth, tmp_path):
    read = load_truth(write_truth(tmp_path / "truth.npz", truth))
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
        load_truth(write_truth(tmp_path / "truth.npz", truth, **changes))


def test_a_file_that_is_no_truth_is_refused(tmp_path):
    (tmp_path / "truth.npz").write_bytes(b"no archive")
    for path in (tmp_path / "truth.npz", tmp_path / "missing.npz"):
        with pytest.raises(InputError, match="not the truth of a portrait"):
            load_truth(path)


def test_views_are_read_with_their_light_and_turn(truth, tmp_path):
    views = load_views(write_views(tmp_path, truth))
    assert {name: (view.light, view.yaw) for name, view in views.items()} == {
        "relit_1": ("noon", 0),
        "relit_2": ("lamp", 0),
        "turned_left": ("noon", 30),
        "turned_right": ("noon", -30),
    }
    view = views["relit_2"]
    assert view.image.shape == (SIZE, SIZE, 3) and view.image.dtype == view.mask.dtype == np.float32
    np.testing.assert_allclose(view.image, 0.5 * truth.image, rtol=1e-3, atol=1e-6)
    np.testing.assert_array_equal(view.mask, truth.mask)
    np.testing.assert_array_equal(view.face, truth.region == 0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"turned_left_face": None}, "holds no views of a portrait: .*turned_left_face"),
        ({"relit_1_mask": np.zeros(4, np.uint8)}, "relit_1_mask must be an image"),
        ({"relit_2_region": np.zeros((6, 4), np.uint8)}, r"relit_2_region must be numbers \[64, 64\]"),
        ({"turned_right_image": np.full((SIZE, SIZE, 3), np.nan)}, "turned_right_image contains NaN"),
        ({"relit_1_image": np.full((SIZE, SIZE, 3), -1.0)}, "relit_1_image must not be negative"),
        ({"relit_1_mask": np.ones((SIZE, SIZE))}, "relit_1_mask must be of type u1, not float64"),
    ],
)
def test_broken_views_are_named(truth, tmp_path, changes, message):
    with pytest.raises(InputError, match=message):
        load_views(write_views(tmp_path, truth, **changes))


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
