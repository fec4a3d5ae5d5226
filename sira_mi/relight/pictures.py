"""Pictures of a head: previews of the layers of `sira_sg`, and how near two pictures are."""

import numpy as np

from sira_mi.colour import linear_to_srgb

# The specular albedo that previews show as white: reflectance at normal incidence of a material of index 1.8.
_BRIGHTEST_SPECULAR = 0.08
# Of the values of a head's brightest channel, this percentile is shown at this share of white.
EXPOSURE_PERCENTILE, EXPOSURE_LEVEL = 98.0, 0.8
_PEAK_NOISE = 1e-12  # least mean squared error that counts


def preview(name: str, image: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Display values in [0, 1] of a layer: sRGB for radiance and albedo, colours for normals, near-is-bright for
    depth."""
    if name == "normal":
        return np.where(mask[..., None] > 0, 0.5 + 0.5 * image, 0)
    if name == "mask":
        return image
    if name == "specular_albedo":
        return linear_to_srgb(image / _BRIGHTEST_SPECULAR)
    if name == "depth":
        covered = mask > 0.99
        if not covered.any():
            return np.zeros_like(image)
        near, far = image[covered].min(), image[covered].max()
        return np.where(covered, 1 - 0.85 * (image - near) / max(far - near, 1e-6), 0)
    return linear_to_srgb(image)


def meter_exposure(pixels: np.ndarray) -> float:
    """The exposure, in stops, that brings `EXPOSURE_PERCENTILE` of the brightest channel of a head's pixels [N, 3],
    linear radiance, to `EXPOSURE_LEVEL`; 0 for a head without light."""
    level = float(np.percentile(pixels.max(axis=1), EXPOSURE_PERCENTILE)) if len(pixels) else 0.0
    return float(np.log2(EXPOSURE_LEVEL / level)) if level > 0 else 0.0


def psnr(values: np.ndarray, truth: np.ndarray) -> float:
    """PSNR in dB with peak 1 of arrays of one shape, at most 120 dB; NaN when they are empty."""
    if not truth.size:
        return float("nan")
    return float(-10 * np.log10(max(np.mean((np.asarray(values, np.float64) - truth) ** 2), _PEAK_NOISE)))


def psnr_inside(image: np.ndarray, reference: np.ndarray, mask: np.ndarray) -> float:
    """PSNR in dB of two linear images [H, W, 3], measured on sRGB values inside mask > 0.5."""
    first, second = (linear_to_srgb(np.clip(picture, 0, 1))[mask > 0.5] for picture in (image, reference))
    return psnr(first, second)
