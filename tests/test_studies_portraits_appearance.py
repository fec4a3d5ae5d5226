"""Scores of appearance: pictures with known errors, light baked into the albedo, values that are not numbers."""

import dataclasses

import numpy as np
import pytest
from egg import CLOTH, SIZE, head_like, truth_of
from scipy.ndimage import binary_erosion

from sira_mi.colour import linear_to_srgb, srgb_to_linear
from sira_mi.errors import InputError
from studies.portraits.appearance_scores import (
    PredictedAppearance,
    measure_ita,
    score_appearance,
    score_tone,
)
from studies.portraits.truth import Truth


@pytest.fixture(scope="module")
def truth() -> Truth:
    return truth_of(*head_like())


def appearance_of(truth: Truth, **changes) -> PredictedAppearance:
    whole = {"final": truth.image, "shaded": truth.image, "mask": truth.mask}
    whole |= {name: getattr(truth, name) for name in ("diffuse_albedo", "specular_albedo")}
    return PredictedAppearance(**(whole | changes))


def test_the_truth_itself_has_no_error(truth):
    scores = score_appearance(appearance_of(truth), truth)
    for name in ("final", "shaded", "diffuse", "diffuse_scaled", "specular", "specular_scaled"):
        assert scores[f"{name}_psnr"] > 100 and scores[f"{name}_ssim"] == pytest.approx(1, abs=1e-6)
    assert scores["skin_ciede2000_mean"] < 1e-3 and scores["leakage_shading"] == scores["leakage_shadow"] == 0
    inner = sum(truth.mask[1 + i : SIZE - 1 + i, 1 + j : SIZE - 1 + j] for i in (-1, 0, 1) for j in (-1, 0, 1)) > 8.5
    assert scores["pixels"] == scores["skin_pixels"] == inner.sum()
    assert scores["lost_pixels"] == 0 and scores["final_nonfinite"] == 0


@pytest.mark.filterwarnings("ignore:.*Matplotlib")
def test_errors_of_known_size_have_their_psnr(truth):
    """sRGB values 0.5 and 0.6 are 20 dB apart, as specular strengths too; outside the mask nothing counts. CIEDE2000 is
    that of another implementation."""
    import colour

    def linear(value):
        return ((value + 0.055) / 1.055) ** 2.4

    grey = {name: np.full((SIZE, SIZE, 3), linear(0.5), np.float32) for name in ("image", "diffuse_albedo")}
    flat = dataclasses.replace(truth, **grey, specular_albedo=np.full((SIZE, SIZE), 0.08 * linear(0.5)))
    lighter = np.where(truth.mask[..., None] > 0, linear(0.6), [7.0, 7, 7])
    scores = score_appearance(
        appearance_of(
            flat, final=lighter, shaded=lighter, diffuse_albedo=lighter, specular_albedo=0.08 * lighter[..., 0]
        ),
        flat,
    )
    for name in ("final", "shaded", "diffuse", "specular"):
        assert scores[f"{name}_psnr"] == pytest.approx(20, abs=1e-3) and scores[f"{name}_ssim"] < 1
    assert scores["diffuse_scaled_psnr"] > 100 and scores["specular_scaled_ssim"] == pytest.approx(1, abs=1e-6)
    lab = [colour.XYZ_to_Lab(colour.sRGB_to_XYZ([v] * 3)) for v in (0.6, 0.5)]
    expected = colour.delta_E(*lab, method="CIE 2000")
    assert scores["skin_ciede2000_mean"] == pytest.approx(expected, abs=0.02)
    assert scores["skin_ciede2000_median"] == pytest.approx(expected, abs=0.02)
    assert scores["skin_scaled_ciede2000_mean"] < 1e-3


def test_structure_is_seen_by_ssim(truth):
    """Pixels in another order have the same histogram and no similar structure."""
    inside = truth.mask > 0
    shuffled = truth.image.copy()
    shuffled[inside] = np.random.default_rng(0).permutation(truth.image[inside])
    scores = score_appearance(appearance_of(truth, final=shuffled), truth)
    assert scores["final_ssim"] < 0.3


def test_leakage_is_one_of_baked_light_and_none_of_other_errors(truth):
    """An albedo that took over half of the log shading, one that took shadows, and one with an error of its own."""
    half = truth.diffuse_albedo * np.sqrt(np.maximum(truth.shading, 1e-6))[..., None]
    scores = score_appearance(appearance_of(truth, diffuse_albedo=half), truth)
    assert scores["leakage_shading"] == pytest.approx(1, abs=1e-5)
    assert scores["leakage_slope"] == pytest.approx(0.5, abs=1e-4)
    brighter = score_appearance(appearance_of(truth, diffuse_albedo=truth.diffuse_albedo**2 / (half + 1e-9)), truth)
    assert brighter["leakage_shading_signed"] == pytest.approx(-1, abs=1e-5) and brighter["leakage_shading"] > 0.99
    dark = truth.diffuse_albedo * np.exp(0.5 * truth.shadow)[..., None]
    cast = score_appearance(appearance_of(truth, diffuse_albedo=dark), truth)
    assert cast["leakage_shadow"] == pytest.approx(1, abs=1e-5) and cast["leakage_shading"] < 0.1
    noise = np.exp(0.3 * np.random.default_rng(1).standard_normal((SIZE, SIZE, 1)))
    other = score_appearance(appearance_of(truth, diffuse_albedo=truth.diffuse_albedo * noise), truth)
    assert other["leakage_shading"] < 0.1 and other["leakage_shadow"] < 0.1


def test_values_that_are_no_numbers_are_counted_and_cost(truth):
    """NaN counts as black: it lowers the score."""
    row, column = SIZE // 2, SIZE // 2
    broken = truth.image.copy()
    broken[row, column, :2] = np.nan, np.inf
    scores = score_appearance(appearance_of(truth, final=broken), truth)
    assert scores["final_nonfinite"] == 2 and scores["diffuse_nonfinite"] == 0
    assert np.isfinite(scores["final_psnr"]) and scores["final_psnr"] < 60


def test_pixels_that_the_prediction_lacks_are_counted(truth):
    mask = truth.mask.copy()
    mask[: SIZE // 2] = 0
    scores = score_appearance(appearance_of(truth, mask=mask), truth)
    assert scores["lost_pixels"] == truth.mask[: SIZE // 2].sum()
    assert 0 < scores["pixels"] < 0.6 * truth.mask.sum()
    nothing = score_appearance(appearance_of(truth, mask=0 * mask), truth)
    assert nothing["pixels"] == 0 and np.isnan([nothing["final_psnr"], nothing["final_ssim"]]).all()
    assert np.isnan([nothing["leakage_shading"], nothing["leakage_slope"], nothing["skin_ciede2000_mean"]]).all()


def test_hair_and_cloth_are_not_skin(truth):
    region = truth.region.copy()
    region[:, : SIZE // 2][truth.mask[:, : SIZE // 2] > 0] = CLOTH
    other = truth.diffuse_albedo.copy()
    other[:, : SIZE // 2] *= 0.2
    scores = score_appearance(appearance_of(truth, diffuse_albedo=other), dataclasses.replace(truth, region=region))
    assert scores["skin_ciede2000_mean"] < 1e-3 and scores["diffuse_psnr"] < 30
    assert scores["skin_pixels"] < 0.6 * scores["pixels"]


def test_images_of_another_size_are_refused(truth):
    with pytest.raises(InputError, match="specular_albedo must be numbers"):
        score_appearance(appearance_of(truth, specular_albedo=truth.image), truth)


@pytest.mark.filterwarnings("ignore:.*Matplotlib")
def test_an_albedo_one_stop_too_light_has_a_bias_of_one_stop(truth):
    """And its typology angle moves as another implementation of CIELAB says; other skin than the face's does not
    count."""
    import colour

    tone = np.array([0.2, 0.12, 0.08])
    inside = truth.mask > 0
    face = inside & (np.arange(SIZE)[:, None] < SIZE // 2)
    texture = np.random.default_rng(5).uniform(0.8, 1.2, (SIZE, SIZE, 1))
    skin = dataclasses.replace(truth, diffuse_albedo=np.where(inside[..., None], tone * texture, 0))
    lighter = np.where(face[..., None], 2 * skin.diffuse_albedo, 0.1)
    scores = score_tone(appearance_of(skin, diffuse_albedo=lighter), skin, face)
    assert scores["tone_bias"] == pytest.approx(1)

    def ita(albedo):
        lightness, _, yellow = colour.XYZ_to_Lab(colour.RGB_to_XYZ(albedo, "sRGB"))
        return np.degrees(np.arctan2(lightness - 50, yellow))

    mean = skin.diffuse_albedo[face].mean(axis=0)
    assert scores["tone_ita"] == pytest.approx(ita(mean), abs=0.3)
    assert scores["tone_ita_error"] == pytest.approx(ita(2 * mean) - ita(mean), abs=0.3) and ita(2 * mean) > ita(mean)
    assert score_tone(appearance_of(skin), skin, face)["tone_ita_error"] == 0
    assert np.isnan(list(score_tone(appearance_of(skin), skin, ~inside).values())).all()
    assert measure_ita(np.array([0.65, 0.5, 0.4])) > 41 > 10 > measure_ita(np.array([0.09, 0.045, 0.03]))


def test_specular_gain_is_over_the_best_single_grey(truth):
    """The mean of the true strengths as sRGB shows them gains nothing; half its error gains 6 dB."""
    inside = truth.mask > 0
    shown = linear_to_srgb(truth.specular_albedo / 0.08)
    eroded = binary_erosion(inside, np.ones((3, 3), bool), border_value=1)
    mean = shown[eroded].mean()
    for between, gain in ((0.0, 0.0), (0.5, 20 * np.log10(2))):
        guess = 0.08 * srgb_to_linear(np.where(inside, mean + between * (shown - mean), 0))
        scores = score_appearance(appearance_of(truth, specular_albedo=guess), truth)
        assert scores["specular_gain"] == pytest.approx(gain, abs=1e-3)
