"""Scores of a head's picture under another light against the true one.

Pictures are linear radiance under the environment as it is. They are compared as sRGB-coded values, clipped to [0, 1],
at one fixed exposure a light (`relit_lights.exposure_of`), inside the true mask (coverage above 0.5); for SSIM and FLIP
both are black outside. A missing pixel is black, and counts.
"""

import numpy as np

from sira_mi.colour import linear_to_srgb
from sira_mi.relight.pictures import psnr
from sira_mi.training.collection.skin import CLOTH, EYE, HAIR, SKIN
from studies.measures import flip, map_ssim
from studies.portraits.truth import TrueView, check_array

PARTS = ("face", "hair", "cloth")  # scored by themselves
SHARES = ("face", "skin", "hair", "cloth", "eyes", "edge", "missed")  # of the squared error


def score_view(
    radiance: np.ndarray, view: TrueView, exposure: float, coverage: np.ndarray | None = None
) -> dict[str, float]:
    """All scores of a picture `radiance` [H, W, 3]. It is absent where `coverage` [H, W] is at most 0.5; by default,
    where all channels are 0.

    `psnr` (dB), `ssim`, `flip`; `scaled_psnr` after one factor on linear radiance, `scale`, the best in least squares
    inside the mask; `PART_psnr` and `PART_ssim` of `PARTS`. `share_NAME` of `SHARES` part the squared error: eyes, the
    face's skin, other skin, hair, cloth, mask pixels whose centre shows nothing of the person (edge), each where the
    picture is present, and what it misses; they add up to 1. `missed`, the share of the mask where the picture is
    absent; `spill`, the squared error outside the mask over that of all pixels, which no other score has in it. NaN
    where a region is empty or there is no error to share. Raises InputError for images of another size and values that
    are not finite."""
    height, width = view.mask.shape
    check_array("the relit picture", radiance, (height, width, 3))
    if coverage is not None:
        check_array("the relit picture's coverage", coverage, (height, width))
    inside = view.mask > 0.5
    present = np.any(radiance != 0, axis=2) if coverage is None else coverage > 0.5
    picture, truth = exposure * radiance.astype(np.float64), exposure * view.image.astype(np.float64)
    shown, true = linear_to_srgb(picture), linear_to_srgb(truth)
    scale = _find_scale(picture[inside], truth[inside])
    similarity = map_ssim(shown, true, inside)
    scores = {
        "psnr": psnr(shown[inside], true[inside]),
        "ssim": _average(similarity, inside),
        "flip": flip(np.where(inside[..., None], picture, 0), np.where(inside[..., None], truth, 0), inside),
        "scaled_psnr": psnr(linear_to_srgb(scale * picture[inside]), true[inside]),
        "scale": scale,
    }
    parts = {name: inside & where for name, where in _part_pixels(view).items()}
    for name in PARTS:
        where = inside & view.face if name == "face" else parts[name]
        scores[f"{name}_psnr"] = psnr(shown[where], true[where])
        scores[f"{name}_ssim"] = _average(similarity, where)
    error = np.square(shown.astype(np.float64) - true).sum(axis=2)
    total = error[inside].sum()
    shared = {**{name: where & present for name, where in parts.items()}, "missed": inside & ~present}
    for name, where in shared.items():
        scores[f"share_{name}"] = float(error[where].sum() / total) if total else float("nan")
    scores["missed"] = _average(~present, inside)
    scores["spill"] = float(error[~inside].sum() / error.sum()) if error.sum() else float("nan")
    return scores


def _part_pixels(view: TrueView) -> dict[str, np.ndarray]:
    """Pixels [H, W] of each of `SHARES` but the last; every pixel is in one of them."""
    skin = view.region == SKIN
    named = {
        "face": skin & view.face,
        "skin": skin & ~view.face,
        "hair": view.region == HAIR,
        "cloth": view.region == CLOTH,
        "eyes": view.region == EYE,
    }
    return {**named, "edge": ~np.any(list(named.values()), axis=0)}


def _find_scale(values: np.ndarray, truth: np.ndarray) -> float:
    """The factor that brings `values` [N, 3] closest to `truth` in least squares; 1 for black ones."""
    square = float((values * values).sum())
    return float((values * truth).sum()) / square if square > 0 else 1.0


def _average(values: np.ndarray, where: np.ndarray) -> float:
    return float(values[where].mean()) if where.any() else float("nan")
