"""Measures of numbers and images against the truth: statistics, SSIM, FLIP, scaling, leakage, each independent of any
model; and the definitions of face, head and specular strength that all studies share. PSNR is
`relight.pictures.psnr`."""

from collections.abc import Sequence

import numpy as np
from skimage.metrics import structural_similarity

from sira_mi.colour import linear_to_srgb
from sira_mi.conventions import LUMINANCE
from sira_mi.errors import InputError

FACE_RADIUS = 95.0  # mm around the nose tip
SHOULDERS = -1.3  # y above which a point belongs to the head, scene units
F0_OF_STRENGTH = 0.08  # reflectance at normal incidence of specular strength 1
_SMALLEST_SQUARE = 1e-12


def statistics(values: np.ndarray) -> dict[str, float]:
    """Mean, median and 90th percentile; NaN of nothing."""
    if not len(values):
        return dict.fromkeys(("mean", "median", "p90"), float("nan"))
    return {
        "mean": float(values.mean()),
        "median": float(np.median(values)),
        "p90": float(np.percentile(values, 90)),
    }


def average(rows: Sequence[dict], *path: str) -> float:
    """The mean over rows of the number at a path of keys, NaN left out; NaN when none is left."""
    found = []
    for row in rows:
        value = row
        for key in path:
            value = value[key]
        found.append(value)
    values = np.array(found, float)
    return float(np.nanmean(values)) if np.isfinite(values).any() else float("nan")


def spread_indices(count: int, limit: int) -> list[int]:
    """At most `limit` indices, evenly spread over range(count)."""
    return np.unique(np.linspace(0, count - 1, min(limit, count)).round().astype(int)).tolist()


def scale_channels(values: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """`values` [N, C] times the factor of each channel that brings them closest to `truth` in least squares."""
    return values * ((values * truth).sum(axis=0) / np.maximum((values * values).sum(axis=0), _SMALLEST_SQUARE))


def ssim_inside(image: np.ndarray, truth: np.ndarray, mask: np.ndarray) -> float:
    """Mean of `map_ssim` over the pixels of `mask` [H, W]; NaN for an empty mask."""
    return float(map_ssim(image, truth, mask)[mask].mean()) if mask.any() else float("nan")


def map_ssim(image: np.ndarray, truth: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Structural similarity [H, W] of two images [H, W] or [H, W, 3] of values in [0, 1], both black outside `mask`
    [H, W]. Data range 1, uniform windows of 7 x 7 pixels, channels averaged."""
    inside = mask if image.ndim == 2 else mask[..., None]
    axis = None if image.ndim == 2 else 2
    first, second = (np.where(inside, a, 0).astype(np.float64) for a in (image, truth))
    similarity = structural_similarity(first, second, data_range=1.0, channel_axis=axis, full=True)[1]
    return similarity if image.ndim == 2 else similarity.mean(axis=2)


def require_flip():
    """The package that computes FLIP. InputError when it is not installed."""
    try:
        import flip_evaluator
    except ImportError as error:
        raise InputError("FLIP needs an optional package; install it with: pip install 'sira-mi[plots]'") from error
    return flip_evaluator


def flip(image: np.ndarray, reference: np.ndarray, mask: np.ndarray) -> float:
    """Mean LDR-FLIP (Andersson et al. 2020; 67 pixels a degree) over `mask` of two pictures [H, W, 3] of linear
    radiance, shown in sRGB. InputError when the package for it is missing."""
    shown = (np.ascontiguousarray(linear_to_srgb(np.clip(a, 0, 1)), np.float32) for a in (reference, image))
    errors = require_flip().evaluate(*shown, "LDR", applyMagma=False, computeMeanError=False)[0]
    return float(np.asarray(errors).reshape(mask.shape)[mask].mean())


def luminance(values: np.ndarray) -> np.ndarray:
    """Luminance [...] of linear RGB [..., 3], at least 1e-4, so that it has a logarithm."""
    return np.maximum(values @ np.array(LUMINANCE), 1e-4)


def correlation(a: np.ndarray, b: np.ndarray) -> float:
    """Pearson's correlation of two arrays [N]; 0 when one of them is constant, NaN of nothing."""
    if not len(a):
        return float("nan")
    if min(a.std(), b.std()) < 1e-9:
        return 0.0
    return float(np.corrcoef(a, b)[0, 1])


def leakage(albedo: np.ndarray, truth: np.ndarray, irradiance: np.ndarray) -> float:
    """Correlation over points of the error of log albedo luminance with the log luminance of the irradiance, all
    [N, 3]: positive where shading has gone into the albedo, 0 where none has."""
    error = np.log(luminance(albedo)) - np.log(luminance(truth))
    return correlation(error, np.log(luminance(irradiance)))
