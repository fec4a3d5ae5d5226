"""The ladder: each rung puts the truth in place of one thing, and leaves the rest."""

from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
from egg import SIZE, SKIN, head_like, truth_of, write_views

from sira_mi.files import write_exr
from studies.portraits import ladder
from studies.portraits.ladder import Fitted, fill_outline, paint_vertices, replace_albedo, scale_tone
from studies.portraits.truth import VIEWS, load_views


@pytest.fixture
def fitted(avatar, tmp_path, monkeypatch) -> Fitted:
    """An egg whose fit has a fifth of the true albedo, and pictures that miss the left half of the frame."""
    truth = truth_of(*head_like())
    folder = write_views(tmp_path / "truth", truth)
    row = tmp_path / "row"
    row.mkdir()
    for name, view in load_views(folder).items():
        picture = 0.5 * view.image
        picture[:, : SIZE // 2] = 0
        write_exr(row / f"{name}.exr", picture)
    detail = np.concatenate([truth.diffuse_albedo / 5, np.ones((SIZE, SIZE, 1))], axis=2)
    own = avatar.with_tensors(detail=detail)
    monkeypatch.setattr(Fitted, "avatar", property(lambda self: own))
    monkeypatch.setattr(Fitted, "in_detail", lambda self, picture: picture)
    return Fitted(truth, folder, row, (), "llvm_ad_rgb")


def test_the_outline_fills_what_is_missed_and_nothing_else(fitted):
    pictures = fill_outline(fitted)
    assert set(pictures) == set(VIEWS)
    for name, view in load_views(fitted.truth_folder).items():
        covered = view.mask > 0.5
        missed = covered & (np.arange(SIZE) < SIZE // 2)
        np.testing.assert_allclose(pictures[name][missed], view.image[missed], rtol=1e-3)
        np.testing.assert_allclose(pictures[name][covered & ~missed], 0.5 * view.image[covered & ~missed], rtol=1e-3)


def test_the_tone_is_scaled_to_the_true_one(fitted):
    """Of the skin's mean luminance: here all of the albedo is right after it, and the networks rise by as much."""
    scaled = scale_tone(fitted)
    skin = (fitted.truth.region == SKIN) & (fitted.truth.mask > 0.5)
    np.testing.assert_allclose(scaled.tensors["detail"][skin, :3], fitted.truth.diffuse_albedo[skin], rtol=1e-4)
    before, after = (a.tensors["diffuse_albedo"][-3:] for a in (fitted.avatar, scaled))
    np.testing.assert_allclose(after - before, np.log(5), rtol=1e-4)


def test_the_true_shading_gives_the_true_luminance(fitted):
    """The egg's photo is its albedo times its shading."""
    found = ladder.divide_by_true_shading(fitted).tensors["detail"]
    skin = fitted.truth.mask > 0.5
    np.testing.assert_allclose(found[skin, :3], fitted.truth.diffuse_albedo[skin], rtol=2e-3)


def test_albedo_is_replaced_where_the_truth_has_one(fitted):
    true = np.where(np.arange(SIZE)[None, :, None] < 20, 0, fitted.truth.diffuse_albedo)
    found = replace_albedo(fitted.avatar, true, 0.0).tensors["detail"]
    known = true.any(axis=2)
    np.testing.assert_array_equal(found[known, :3], true[known])
    np.testing.assert_array_equal(found[~known], fitted.avatar.tensors["detail"][~known])


def test_vertices_take_the_pixels_that_show_them(fitted):
    """Seen vertices have the colour of their pixel, others the mean of those."""
    truth = replace(fitted.truth, face_region=np.zeros(len(fitted.truth.faces), np.uint8))
    left = np.arange(SIZE)[None, :, None] < SIZE // 2
    albedo = np.where(left, 0.2, 0.6) * np.ones((SIZE, SIZE, 3))
    seen = truth.vertices @ truth.camera.world_to_camera[2, :3] < 0
    colours = paint_vertices(truth, albedo, seen)
    pixel = truth.camera.project(truth.vertices)
    column, away = pixel[:, 0], np.abs(pixel - SIZE / 2)
    inside = seen & (away[:, 0] > 2) & (away.max(axis=1) < 0.2 * SIZE)
    np.testing.assert_allclose(colours[inside, 0], np.where(column[inside] < SIZE / 2, 0.2, 0.6), atol=1e-6)
    assert np.ptp(colours[~seen], axis=0).max() < 1e-6 and 0.2 < colours[~seen].mean() < 0.6


@pytest.mark.slow
def test_the_true_head_is_lit_as_it_should_be(variant, fitted, tmp_path):
    """A white egg under light of radiance 1 from everywhere: its diffuse albedo and what it reflects beside."""
    for name in ("a", "b"):
        write_exr(tmp_path / f"{name}.exr", np.ones((16, 32, 3), np.float32))
    lit = replace(fitted, lights=(tmp_path / "a.exr", tmp_path / "b.exr"))
    pictures = ladder.show_true_head(lit, np.full((SIZE, SIZE, 3), 0.5), samples=16)
    centre = pictures["relit_1"][28:36, 28:36]
    assert centre.mean() == pytest.approx(0.53, abs=0.03) and mi.variant() == "llvm_ad_rgb"
    assert not pictures["relit_1"][0].any()
