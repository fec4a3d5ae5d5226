"""Scores of relit pictures: pictures with known errors get the decibels that the errors have, on the regions where they
are, and nothing outside the person counts."""

import dataclasses

import numpy as np
import pytest

from sira_mi.errors import InputError
from studies.portraits.relit_scores import SHARES, score_view
from studies.portraits.truth import TrueView

SIZE = 64
EXPOSURE = 0.5
SKIN, HAIR, EYE, CLOTH, NOTHING = 0, 1, 2, 3, 255


@pytest.fixture(scope="module")
def view() -> TrueView:
    """A person without symmetry: hair above a face with two eyes and a neck, cloth below."""
    y, x = np.mgrid[:SIZE, :SIZE]
    region = np.full((SIZE, SIZE), NOTHING, np.uint8)
    region[np.hypot(x - 30, y - 24) < 18] = SKIN
    region[(region == SKIN) & (y < 15 + 0.1 * x)] = HAIR
    region[(np.abs(x - 30) < 7) & (y >= 40) & (y < 50)] = SKIN
    region[(y >= 50) & (np.abs(x - 34) < 24)] = CLOTH
    region[23:26, 22:26] = region[22:25, 36:40] = EYE
    level = np.select([region == SKIN, region == HAIR, region == EYE, region == CLOTH], [0.5, 0.1, 0.9, 0.3])
    light = 1 + 0.6 * np.sin(x / 9 + y / 17)
    texture = np.random.default_rng(1).uniform(0.8, 1.2, (SIZE, SIZE, 3))
    image = (level * light)[..., None] * texture * [1.0, 0.8, 0.6]
    return TrueView(
        image=image.astype(np.float32),
        mask=(region != NOTHING).astype(np.float32),
        region=region,
        face=np.isin(region, (SKIN, EYE)) & (y < 40),
        light="even",
        yaw=0.0,
    )


def from_srgb(values):
    """Linear radiance of sRGB-coded values above 0.04 at the exposure of these tests."""
    return ((np.asarray(values) + 0.055) / 1.055) ** 2.4 / EXPOSURE


def grey(view: TrueView, value: float = 0.5) -> TrueView:
    """The view with one sRGB-coded value everywhere on the person."""
    image = np.where(view.mask[..., None] > 0, np.full(3, from_srgb(value)), 0)
    return dataclasses.replace(view, image=image.astype(np.float32))


def shares(scores: dict) -> dict[str, float]:
    return {name: scores[f"share_{name}"] for name in SHARES}


def test_the_truth_itself_has_no_error(view):
    scores = score_view(view.image, view, EXPOSURE)
    assert scores["psnr"] > 110 and scores["scaled_psnr"] > 110 and scores["scale"] == pytest.approx(1)
    for name in ("ssim", "face_ssim", "hair_ssim", "cloth_ssim"):
        assert scores[name] == pytest.approx(1)
    assert scores["flip"] < 1e-6 and scores["missed"] == 0
    assert np.isnan([scores["spill"], *shares(scores).values()]).all()


def test_the_truth_within_the_noise_of_its_rendering(view):
    """Noise of a hundredth of full scale is 40 dB, wherever it is."""
    rng = np.random.default_rng(2)
    true = grey(view)
    noisy = from_srgb(0.5 + 0.01 * rng.standard_normal(true.image.shape)) * true.mask[..., None]
    scores = score_view(noisy, true, EXPOSURE)
    for name in ("psnr", "face_psnr", "hair_psnr", "cloth_psnr", "scaled_psnr"):
        assert scores[name] == pytest.approx(40, abs=0.5)
    for name, where in (("hair", view.region == HAIR), ("cloth", view.region == CLOTH), ("eyes", view.region == EYE)):
        assert scores[f"share_{name}"] == pytest.approx(where.sum() / true.mask.sum(), rel=0.25)


def test_a_scaled_copy_falls_by_the_computable_amount_and_is_perfect_after_the_scale(view):
    """sRGB-coded values 0.5 and 0.6 are 20 dB apart."""
    true = grey(view)
    scores = score_view(grey(view, 0.6).image, true, EXPOSURE)
    for name in ("psnr", "face_psnr", "hair_psnr", "cloth_psnr"):
        assert scores[name] == pytest.approx(20, abs=1e-3)
    assert scores["scaled_psnr"] > 110 and scores["scale"] == pytest.approx(from_srgb(0.5) / from_srgb(0.6))
    half = score_view(0.5 * view.image, view, EXPOSURE)
    assert half["psnr"] < 25 and half["scaled_psnr"] > 110 and half["scale"] == pytest.approx(2)


def test_values_above_white_are_equal(view):
    """What a photo of that exposure clips does not count; the exposure decides it, not the picture."""
    bright = grey(view, 1.5)
    assert score_view(grey(view, 2.0).image, bright, EXPOSURE)["psnr"] > 110
    assert score_view(grey(view, 2.0).image, bright, EXPOSURE / 100)["psnr"] < 60


def test_a_shifted_copy_is_worse_the_farther_it_is(view):
    """A smooth picture, shifted: what PSNR forgives, SSIM and FLIP see."""
    found = [score_view(np.roll(view.image, shift, axis=1), view, EXPOSURE) for shift in (0, 1, 3)]
    for name, sign in (("psnr", 1), ("ssim", 1), ("face_ssim", 1), ("flip", -1)):
        values = [sign * scores[name] for scores in found]
        assert values[0] > values[1] > values[2], name
    assert found[1]["missed"] > 0 and found[1]["spill"] > 0


def test_a_mirrored_head_is_another_head(view):
    scores = score_view(view.image[:, ::-1], view, EXPOSURE)
    assert scores["face_psnr"] < 20 and scores["face_ssim"] < 0.7 and scores["flip"] > 0.1
    assert scores["share_missed"] > 0.1 and scores["spill"] > 0.05


def test_shares_are_of_the_regions_where_the_errors_are(view):
    """An error in one region is all of that region; equal errors everywhere are shared by area. They add up to 1."""
    true = grey(view)
    wrong = grey(view, 0.6).image
    for name, where in (
        ("hair", view.region == HAIR),
        ("cloth", view.region == CLOTH),
        ("eyes", view.region == EYE),
        ("face", view.face & (view.region == SKIN)),
        ("skin", ~view.face & (view.region == SKIN)),
    ):
        scores = score_view(np.where(where[..., None], wrong, true.image), true, EXPOSURE)
        assert shares(scores) == pytest.approx({**dict.fromkeys(SHARES, 0), name: 1})
    everywhere = score_view(wrong, true, EXPOSURE)
    assert everywhere["share_cloth"] == pytest.approx((view.region == CLOTH).sum() / view.mask.sum())
    random = np.random.default_rng(3).uniform(0, 1, view.image.shape)
    assert sum(shares(score_view(random, view, EXPOSURE)).values()) == pytest.approx(1)


def test_a_hole_is_missed_outline_and_counts_as_black(view):
    true = grey(view)
    hole = true.image.copy()
    hole[view.region == HAIR] = 0
    scores = score_view(hole, true, EXPOSURE)
    assert shares(scores) == pytest.approx({**dict.fromkeys(SHARES, 0), "missed": 1})
    assert scores["missed"] == pytest.approx((view.region == HAIR).sum() / view.mask.sum())
    assert scores["hair_psnr"] == pytest.approx(-20 * np.log10(0.5), abs=1e-3) and scores["face_psnr"] > 110
    nothing = score_view(0 * hole, true, EXPOSURE)
    assert nothing["missed"] == nothing["share_missed"] == 1 and nothing["scale"] == 1
    seen = score_view(true.image, true, EXPOSURE, np.where(view.region == HAIR, 0.2, 1.0))
    assert seen["missed"] == scores["missed"] and seen["psnr"] > 110


def test_what_lies_outside_the_person_is_spill_alone(view):
    true = grey(view)
    outside = view.mask == 0
    spilt = np.where(outside[..., None], 7.0, true.image)
    clean, scores = (score_view(image, true, EXPOSURE) for image in (true.image, spilt))
    assert scores["spill"] == 1
    for name in ("psnr", "ssim", "flip", "scaled_psnr", "face_ssim", "missed"):
        assert scores[name] == pytest.approx(clean[name])
    left = outside & (np.arange(SIZE) == 0)
    half = np.where(left[..., None], 7.0, grey(view, 0.6).image)
    error = 1.0 * left.sum()
    share = error / (error + 0.01 * view.mask.sum())
    assert score_view(half, true, EXPOSURE)["spill"] == pytest.approx(share, rel=1e-4)


def test_a_region_that_is_not_there_has_no_score(view):
    bald = dataclasses.replace(view, region=np.where(view.region == HAIR, SKIN, view.region).astype(np.uint8))
    scores = score_view(0.9 * view.image, bald, EXPOSURE)
    assert np.isnan([scores["hair_psnr"], scores["hair_ssim"]]).all() and scores["share_hair"] == 0


@pytest.mark.parametrize(
    ("picture", "message"),
    [(np.zeros((SIZE, SIZE)), "relit picture must be numbers"), (np.full((SIZE, SIZE, 3), np.nan), "contains NaN")],
)
def test_a_picture_that_cannot_be_scored_is_refused(view, picture, message):
    with pytest.raises(InputError, match=message):
        score_view(picture, view, EXPOSURE)
