"""Cameras: projection, files, and their estimate from landmarks."""

import json

import numpy as np
import pytest
from conftest import a_camera, one_line

from sira_mi.conventions import LANDMARKS
from sira_mi.errors import InputError
from sira_mi.portrait.camera import Camera, estimate_camera, measure_reprojection_error
from sira_mi.portrait.portrait import PortraitSettings

SETTINGS = PortraitSettings(working_size=512)
ORIENTATION = 0x0112


def test_camera_projects_scales_and_crops(head):
    camera = a_camera()
    local = camera.world_to_camera @ np.append(head[5], 1)
    expected = np.array([900 * local[0] / local[2] + 320, 900 * local[1] / local[2] + 400])
    np.testing.assert_allclose(camera.project(head)[5], expected, rtol=1e-12)
    np.testing.assert_allclose(camera.scale(0.5, 0.25).project(head), camera.project(head) * [0.5, 0.25])
    np.testing.assert_allclose(camera.crop(30, 40, 100, 90).project(head), camera.project(head) - [30, 40])
    assert camera.scale(0.5, 0.25).width == 320 and camera.crop(30, 40, 100, 90).height == 90
    assert np.isnan(camera.project(camera.centre + camera.world_to_camera[2, :3] * -1)).all()


def test_camera_json_round_trip_is_exact():
    camera = a_camera(focal=np.pi * 300)
    again = Camera.from_json(camera.to_json(), size=(640, 800))
    np.testing.assert_array_equal(again.K, camera.K)
    np.testing.assert_array_equal(again.world_to_camera, camera.world_to_camera)
    assert (again.width, again.height) == (640, 800)


def test_malformed_cameras_are_named():
    good = a_camera().to_dict()

    def changed(key, index, value):
        data = json.loads(json.dumps(good))
        data[key][index[0]][index[1]] = value
        return json.dumps(data)

    scaled = json.loads(json.dumps(good))
    scaled["world_to_camera"] = (np.diag([2, 2, 2, 1.0]) @ np.array(good["world_to_camera"])).tolist()
    mirrored = json.loads(json.dumps(good))
    mirrored["world_to_camera"] = (np.diag([-1, 1, 1, 1.0]) @ np.array(good["world_to_camera"])).tolist()
    cases = {
        "{": "not JSON",
        "[" * 100_000: "not JSON",
        "[1, 2]": "object",
        json.dumps({**good, "K": [[1, 2], [3, 4]]}): "K must be 3x3",
        json.dumps({**good, "K": [[1, 2, 3], [4, 5], [6]]}): "K must be 3x3",
        json.dumps({**good, "K": "focal"}): "K must be 3x3",
        json.dumps({k: v for k, v in good.items() if k != "world_to_camera"}): "world_to_camera is missing",
        json.dumps({**good, "width": 640.5}): "width",
        json.dumps({**good, "height": -800}): "height",
        json.dumps({**good, "height": None}): "height",
        json.dumps({**good, "width": 800}): "800x800",
        changed("K", (0, 0), float("nan")): "NaN",
        changed("world_to_camera", (2, 3), float("inf")): "NaN or infinity",
        changed("K", (1, 1), -900.0): "positive",
        changed("K", (0, 1), 3.0): "skew",
        changed("K", (2, 2), 2.0): "K must be [[fx",
        changed("world_to_camera", (3, 3), 2.0): "last row",
        changed("world_to_camera", (0, 0), 0.2): "orthonormal",
        json.dumps(scaled): "orthonormal",
        json.dumps(mirrored): "mirrors",
    }
    for text, words in cases.items():
        with pytest.raises(InputError) as error:
            Camera.from_json(text, "camera.json", (640, 800))
        one_line(error, "camera.json", words)


@pytest.mark.parametrize(
    "yaw, pitch, roll, distance", [(0, 0, 0, 5), (25, -10, 8, 9), (-40, 15, -20, 20), (10, 5, 80, 12)]
)
def test_known_focal_length_gives_pose_and_distance(head, yaw, pitch, roll, distance):
    camera = a_camera(yaw=yaw, pitch=pitch, roll=roll, distance=distance, focal=1500.0)
    pixels = camera.project(head) + np.random.default_rng(4).normal(0, 0.5, (LANDMARKS, 2))
    pixels[7] = np.nan
    found = estimate_camera(pixels, head, 640, 800, 1500.0 * 43.2666 / np.hypot(640, 800))
    assert found.K[0, 0] == pytest.approx(1500.0)
    turn = found.world_to_camera[:3, :3] @ camera.world_to_camera[:3, :3].T
    assert np.degrees(np.arccos((np.trace(turn) - 1) / 2)) < 0.5
    assert np.linalg.norm(found.centre) == pytest.approx(np.linalg.norm(camera.centre), rel=0.02)
    assert measure_reprojection_error(found, pixels, head) < 1.0


def test_unknown_focal_length_stays_near_the_prior_and_fits(head):
    """A head flatter or deeper than the mean imitates another distance: the prior must hold, yet a photo taken from
    near must come out nearer than one from afar."""
    found = {}
    for distance in (6.0, 12.0, 25.0):
        for depth in (0.7, 1.0, 1.4):
            camera = a_camera(yaw=5.0, distance=distance, focal=110.0 * distance)
            pixels = camera.project(head * [1, 1, depth])
            estimate = estimate_camera(pixels, head, 640, 800)
            assert measure_reprojection_error(estimate, pixels, head) < 1.0
            assert estimate.K[0, 0] == estimate.K[1, 1] and tuple(estimate.K[:2, 2]) == (320, 400)
            found[distance, depth] = np.linalg.norm(estimate.centre)
    assert all(8.5 < found[12.0, depth] < 15.0 for depth in (0.7, 1.0, 1.4))
    assert found[12.0, 1.0] == pytest.approx(12.0, rel=0.01)
    assert 5.5 < found[6.0, 1.0] < 8.5 and 12.5 < found[25.0, 1.0] < 26.0


def test_outliers_hardly_move_the_camera(head):
    camera = a_camera(focal=1500.0)
    pixels = camera.project(head)
    pixels[[61, 291, 13, 14, 152, 148]] += 40
    found = estimate_camera(pixels, head, 640, 800, 1500.0 * 43.2666 / np.hypot(640, 800))
    turn = found.world_to_camera[:3, :3] @ camera.world_to_camera[:3, :3].T
    assert np.degrees(np.arccos((np.trace(turn) - 1) / 2)) < 1.0
    with pytest.raises(ValueError, match="6 are needed"):
        estimate_camera(np.full((LANDMARKS, 2), np.nan), head, 640, 800)
