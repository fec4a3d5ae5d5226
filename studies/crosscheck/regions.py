"""Regions of a head by which errors are reported; every pixel of the head lies in exactly one."""

import numpy as np
from scipy.ndimage import minimum_filter

# A pixel belongs to the first of these that fits.
SILHOUETTE, SHADOW, GRAZING, LIT = "silhouette", "shadow", "grazing", "lit"
REGIONS = (LIT, GRAZING, SHADOW, SILHOUETTE)
HEAD = "head"
SHADOW_SHARE = 0.75
GRAZING_COSINE = 0.5


def regions(coverage: np.ndarray, cosine: np.ndarray, share: np.ndarray) -> dict[str, np.ndarray]:
    """Masks [H, W] by region, and `head`, all of them together.

    `coverage` is the share of a pixel that the head covers, `cosine` the mean cosine of normal and view, `share` the
    unoccluded share of direct light, all [H, W]. The head is assumed to continue beyond the picture."""
    head = coverage > 0
    silhouette = head & (minimum_filter(coverage, size=3, mode="nearest") < 0.999)
    shadow = head & ~silhouette & (share < SHADOW_SHARE)
    grazing = head & ~silhouette & ~shadow & (cosine < GRAZING_COSINE)
    lit = head & ~silhouette & ~shadow & ~grazing
    return {LIT: lit, GRAZING: grazing, SHADOW: shadow, SILHOUETTE: silhouette, HEAD: head}
