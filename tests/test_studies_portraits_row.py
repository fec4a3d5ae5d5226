"""The scores of a portrait's row are those of its pictures at the photo's pixels, of its head and of its appearance;
what a failed fit does not deliver counts."""

import json

import numpy as np
import pytest
import trimesh
from conftest import camera
from egg import SIZE, head_like, landmarks_on, truth_of, write_truth, write_views

from sira_mi.avatar.file import save_avatar
from sira_mi.errors import InputError
from sira_mi.files import write_exr, write_png
from sira_mi.portrait.portrait import area_resample
from studies.portraits.photo_frame import PhotoFrame
from studies.portraits.score_row import score_portrait
from studies.portraits.truth import VIEWS, Truth

EXPOSURES = {"noon": 1.0, "lamp": 2.0}


@pytest.fixture(scope="module")
def truth() -> Truth:
    return truth_of(*head_like())


@pytest.fixture(scope="module")
def truth_folder(truth, tmp_path_factory):
    folder = write_views(tmp_path_factory.mktemp("truth"), truth)
    write_truth(folder / "truth.npz", truth)
    return folder


def test_pictures_are_scored_at_the_exposure_of_their_light(truth, truth_folder, tmp_path):
    """One that is not there has no scores; the same error weighs more where the exposure is higher."""
    for name in ("relit_1", "relit_2"):
        write_exr(tmp_path / f"{name}.exr", 0.4 * truth.image)
    scores = score_portrait(truth_folder, tmp_path, EXPOSURES)
    assert scores["relit_2_psnr"] < scores["relit_1_psnr"] < 30
    assert scores["relit_1_scaled_psnr"] > 60 and scores["relit_1_scale"] == pytest.approx(1.25, rel=1e-3)
    assert not any(name.startswith(("turned", "h3ds", "final")) for name in scores)


@pytest.mark.parametrize("file", ["row.json", "pictures.json"])
def test_a_failed_fit_is_a_black_picture(truth_folder, tmp_path, file):
    (tmp_path / "row.json").write_text(json.dumps({"cpu_seconds": 1.0}))
    (tmp_path / file).write_text(json.dumps({"key": "", "result": {"error": "no face found"}}))
    scores = score_portrait(truth_folder, tmp_path, EXPOSURES)
    assert {scores[f"{name}_missed"] for name in VIEWS} == {1}
    assert scores["turned_left_psnr"] < 20 and "h3ds_face_mean" not in scores


def test_a_picture_of_another_size_is_refused(truth_folder, tmp_path):
    write_exr(tmp_path / "turned_left.exr", np.zeros((SIZE, SIZE + 1, 3)))
    with pytest.raises(InputError, match=r"relit picture must be numbers \[64, 64, 3\]"):
        score_portrait(truth_folder, tmp_path, EXPOSURES)


@pytest.mark.slow
def test_a_head_alone_has_scores_of_geometry(truth, truth_folder, tmp_path):
    arrays = {name: getattr(truth, name) for name in ("vertices", "faces", "landmarks")}
    camera = {"K": truth.camera.K, "world_to_camera": truth.camera.world_to_camera}
    np.savez(tmp_path / "head.npz", **arrays, **camera)
    scores = score_portrait(truth_folder, tmp_path, EXPOSURES)
    assert scores["h3ds_face_mean"] < 0.05 and scores["silhouette_iou"] == 1 and "final_psnr" not in scores


def test_a_part_of_a_photo_is_placed_where_it_was():
    photo = np.random.default_rng(1).uniform(0, 1, (20, 30, 3)).astype(np.float32)
    window = (4.0, 2.0, 24.0, 18.0)
    part = area_resample(photo, (4, 2), (3, 3), (60, 48))
    placed = PhotoFrame(camera(focal=40), window).lay_on_photo(part, 30, 20)
    np.testing.assert_allclose(placed[2:18, 4:24], photo[2:18, 4:24], atol=1e-5)
    assert not placed[:2].any() and not placed[18:].any() and not placed[:, :4].any() and not placed[:, 24:].any()
    np.testing.assert_array_equal(PhotoFrame(camera(focal=40), (0, 0, 30, 20)).lay_on_photo(photo, 30, 20), photo)


@pytest.mark.slow
def test_a_fit_to_a_part_of_the_photo_is_scored_on_the_whole(truth, truth_folder, avatar, tmp_path):
    """The truth as a fit writes it that saw the photo cropped and at twice the size."""
    x0, y0, side = 4, 2, 60
    row = tmp_path / "avatar"
    (row / "renders").mkdir(parents=True)

    def crop(image):
        return area_resample(image, (x0, y0), (2, 2), (2 * side, 2 * side))

    for name in ("normal", "diffuse_albedo", "specular_albedo"):
        write_exr(row / "renders" / f"{name}.exr", crop(getattr(truth, name)))
    for name, share in (("final", 1.0), ("diffuse", 0.5), ("specular", 0.5)):
        write_exr(row / "renders" / f"{name}.exr", crop(share * truth.image))
    write_png(row / "renders" / "mask.png", crop(truth.mask))
    trimesh.Trimesh(truth.vertices / 10, truth.faces, process=False).export(row / "mesh.ply")
    save_avatar(row / "avatar.safetensors", avatar.with_tensors(landmarks=landmarks_on(truth.vertices)))
    camera = truth.camera.crop(x0, y0, side, side).scale(2, 2)
    report = {"camera": camera.to_dict(), "window": [x0, y0, x0 + side, y0 + side]}
    (row / "avatar.json").write_text(json.dumps(report))
    scores = score_portrait(truth_folder, tmp_path, EXPOSURES, row / "avatar.safetensors")
    assert scores["silhouette_iou"] == 1 and scores["lost_pixels"] == 0 and scores["normals_mean"] < 0.1
    assert scores["final_psnr"] > 60 and scores["shaded_psnr"] > 60 and scores["diffuse_psnr"] > 60
    assert scores["tone_bias"] == pytest.approx(0, abs=1e-3) and scores["specular_gain"] > 20
    assert scores["camera_raw_face_mean"] < 0.1 and scores["landmarks_used"] == 6
    (row / "renders" / "mask.png").unlink()
    with pytest.raises(InputError, match="not the folder of a complete fit"):
        score_portrait(truth_folder, tmp_path, EXPOSURES, row / "avatar.safetensors")
