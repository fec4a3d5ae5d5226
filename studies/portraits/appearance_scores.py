"""Errors of a predicted appearance at the photo's pixels.

All images are linear. They are compared inside both masks (coverage above 0.5), one pixel away from their common edge.
PSNR and SSIM are of sRGB-coded values with peak 1; SSIM is the mean over those pixels of the map with uniform windows
of 7 x 7 pixels, both images black outside. Specular albedo, reflectance at normal incidence, is compared as strength,
that is divided by 0.08. `scaled` is after one factor per channel, the best in least squares over the pixels compared:
it removes the ambiguity of scale between light and albedo.
"""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import binary_erosion
from skimage.color import deltaE_ciede2000, rgb2lab

from sira_mi.colour import linear_to_srgb
from sira_mi.relight.pictures import psnr
from sira_mi.training.collection.skin import SKIN
from studies.measures import F0_OF_STRENGTH, correlation, luminance, scale_channels, ssim_inside
from studies.portraits.truth import Truth, check_array

_EDGE = np.ones((3, 3), bool)  # structuring element of the erosion
_DARKEST = 1e-4  # shading below this counts as this, so that it has a logarithm


@dataclass(frozen=True, eq=False)
class PredictedAppearance:
    """A method's estimate of a portrait's appearance, linear, at the photo's pixels."""

    final: np.ndarray  # [H, W, 3] radiance, exposed as in the photo
    diffuse_albedo: np.ndarray  # [H, W, 3]
    specular_albedo: np.ndarray  # [H, W] reflectance at normal incidence
    mask: np.ndarray  # [H, W] coverage, 0 to 1
    shaded: np.ndarray  # [H, W, 3] radiance of eq. 8: `final` without the refinement of the light


def score_appearance(prediction: PredictedAppearance, truth: Truth) -> dict[str, float]:
    """All appearance scores of a prediction.

    `final_`, `shaded_`, `diffuse_`, `diffuse_scaled_`, `specular_` and `specular_scaled_` `psnr` (dB) and `ssim`;
    `skin_ciede2000_mean`, `_median`, and after the scale of the skin's own pixels `skin_scaled_ciede2000_mean`,
    `_median`; `specular_gain`, the specular PSNR over that of the best constant, dB; the scores of `leakage_scores`.
    Counts: `pixels` compared and `skin_pixels` of them; `lost_pixels`, that
    only the truth covers; `final_`, `shaded_`, `diffuse_` and `specular_nonfinite`, predicted values among those
    compared that are NaN or infinite: they count as black. Without pixels the scores are NaN. Raises InputError for
    images that are not of the photo's size."""
    height, width = truth.mask.shape
    for name, channels in (("final", 3), ("shaded", 3), ("diffuse_albedo", 3), ("specular_albedo", 1)):
        shape = (height, width, 3)[: 2 + (channels > 1)]
        check_array(f"the prediction's {name}", getattr(prediction, name), shape, finite=False)
    check_array("the prediction's mask", prediction.mask, (height, width))

    covered = truth.mask > 0.5
    inside = binary_erosion(covered & (prediction.mask > 0.5), _EDGE, border_value=1)
    skin = inside & (truth.region == SKIN)
    scores = {
        "pixels": float(inside.sum()),
        "skin_pixels": float(skin.sum()),
        "lost_pixels": float((covered & (prediction.mask <= 0.5)).sum()),
    }
    pairs = {
        "final": (prediction.final, truth.image),
        "shaded": (prediction.shaded, truth.image),
        "diffuse": (prediction.diffuse_albedo, truth.diffuse_albedo),
        "specular": (prediction.specular_albedo / F0_OF_STRENGTH, truth.specular_albedo / F0_OF_STRENGTH),
    }
    for name, (values, true) in pairs.items():
        finite = np.isfinite(values)
        scores[f"{name}_nonfinite"] = float((~finite)[inside].sum())
        values = np.where(finite, values, 0).astype(np.float64)
        scores |= image_scores(f"{name}_", values, true, inside)
        if name in ("diffuse", "specular"):
            scores |= image_scores(f"{name}_scaled_", _scale_inside(values, true, inside), true, inside)
        if name == "diffuse":
            albedo = values[skin]
    scores["specular_gain"] = scores["specular_psnr"] - _constant_psnr(pairs["specular"][1][inside])
    true = truth.diffuse_albedo[skin].astype(np.float64)
    scores |= colour_scores("skin_", albedo, true)
    scores |= colour_scores("skin_scaled_", scale_channels(albedo, true), true)
    scores |= leakage_scores(albedo, true, truth.shading[skin], truth.shadow[skin])
    return scores


def image_scores(prefix: str, values: np.ndarray, truth: np.ndarray, inside: np.ndarray) -> dict[str, float]:
    """`psnr` and `ssim` of linear images [H, W, 3] or [H, W] inside a mask [H, W] bool."""
    first, second = linear_to_srgb(values), linear_to_srgb(truth)
    return {
        f"{prefix}psnr": psnr(first[inside], second[inside]),
        f"{prefix}ssim": ssim_inside(first, second, inside),
    }


def colour_scores(prefix: str, albedo: np.ndarray, truth: np.ndarray) -> dict[str, float]:
    """Mean and median CIEDE2000 difference of linear colours [N, 3], clipped to sRGB's gamut; NaN of nothing."""
    if not len(truth):
        return dict.fromkeys((f"{prefix}ciede2000_mean", f"{prefix}ciede2000_median"), float("nan"))
    difference = deltaE_ciede2000(*(rgb2lab(linear_to_srgb(colour)) for colour in (albedo, truth)))
    return {
        f"{prefix}ciede2000_mean": float(difference.mean()),
        f"{prefix}ciede2000_median": float(np.median(difference)),
    }


def score_tone(prediction: PredictedAppearance, truth: Truth, face: np.ndarray) -> dict[str, float]:
    """Level and colour of the skin's albedo over the skin pixels of `face` [H, W] bool inside both masks, of the mean
    linear albedos there: `tone_bias`, stops of luminance by which the prediction is too light; `tone_ita`, the true
    individual typology angle (Chardon et al. 1991: `measure_ita`), and `tone_ita_error`, degrees by which the
    prediction's is larger. NaN when there are no such pixels, and for a black albedo."""
    where = face & (truth.region == SKIN) & (truth.mask > 0.5) & (prediction.mask > 0.5)
    values = prediction.diffuse_albedo[where].astype(np.float64)
    names = ("tone_bias", "tone_ita", "tone_ita_error")
    if not where.any() or not np.isfinite(values).all() or values.max() <= 0:
        return dict.fromkeys(names, float("nan"))
    mean, true = values.mean(axis=0), truth.diffuse_albedo[where].astype(np.float64).mean(axis=0)
    ita, true_ita = measure_ita(mean), measure_ita(true)
    bias = float(np.log2(luminance(mean) / luminance(true)))
    return dict(zip(names, (bias, true_ita, ita - true_ita), strict=True))


def measure_ita(albedo: np.ndarray) -> float:
    """Individual typology angle atan2(L* - 50, b*) in degrees of a linear colour [3], clipped to sRGB's gamut, in
    CIELAB under D65: above 55 very light, 41 light, 28 intermediate, 10 tan, -30 brown, below dark skin."""
    lightness, _, yellow = rgb2lab(linear_to_srgb(albedo))
    return float(np.degrees(np.arctan2(lightness - 50, yellow)))


def leakage_scores(albedo: np.ndarray, truth: np.ndarray, shading: np.ndarray, shadow: np.ndarray) -> dict[str, float]:
    """Light that leaked into the albedo, over pixels of albedos [N, 3]: Pearson's correlation of the error of the
    log albedo's luminance with the log of `shading` [N], `leakage_shading`, and with `shadow` [N], `leakage_shadow`,
    both absolute, and with their signs `leakage_shading_signed` and `leakage_shadow_signed` (positive: the albedo is
    too dark where there is little light); `leakage_slope`, the share of log shading in the albedo, by linear
    regression: 0 none, 1 all of it. An error or a light that is constant leaks nothing: 0."""
    error = np.log(luminance(albedo)) - np.log(luminance(truth))
    light = np.log(np.maximum(shading.astype(np.float64), _DARKEST))
    by_shading, by_shadow = correlation(error, light), correlation(error, shadow.astype(np.float64))
    slope = by_shading * error.std() / max(light.std(), 1e-9) if len(error) else float("nan")
    return {
        "leakage_shading": abs(by_shading),
        "leakage_shading_signed": by_shading,
        "leakage_shadow": abs(by_shadow),
        "leakage_shadow_signed": by_shadow,
        "leakage_slope": float(slope),
    }


def _constant_psnr(values):
    """PSNR of the constant that is closest to linear values [N], as sRGB-coded values."""
    shown = linear_to_srgb(values)
    return psnr(np.full(shown.shape, shown.mean() if len(shown) else 0.0), shown)


def _scale_inside(values, truth, inside):
    """An image times the factor of each channel that is best inside the mask, black outside."""
    image = np.zeros(values.shape)
    flat = (a[inside].reshape(inside.sum(), values[0, 0].size) for a in (values, truth))
    image[inside] = scale_channels(*flat).reshape(values[inside].shape)
    return image
