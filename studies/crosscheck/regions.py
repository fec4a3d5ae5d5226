"""The regions of a head that errors are told for; every pixel of the head lies in exactly one."""

import numpy as np
from scipy.ndimage import minimum_filter

# In the order in which they take their pixels.
SILHOUETTE, SHADOW, GRAZING, LIT = "silhouette", "shadow", "grazing", "lit"
REGIONS = (LIT, GRAZING, SHADOW, SILHOUETTE)
HEAD = "head"
SHADOW_SHARE = 0.75
GRAZING_COSINE = 0.5


def regions(coverage: np.ndarray, cosine: np.ndarray, share: np.ndarray) -> dict[str, np.ndarray]:
    """Masks [H, W] by region, and `head`, all of them together.

    From the share of a pixel that the head covers, the mean cosine of normal and view, and the share of the direct
    light that arrives past what blocks it, all [H, W]. Beyond the picture the head is taken to go on."""
    head = coverage > 0
    silhouette = head & (minimum_filter(coverage, size=3, mode="nearest") < 0.999)
    shadow = head & ~silhouette & (share < SHADOW_SHARE)
    grazing = head & ~silhouette & ~shadow & (cosine < GRAZING_COSINE)
    lit = head & ~silhouette & ~shadow & ~grazing
    return {LIT: lit, GRAZING: grazing, SHADOW: shadow, SILHOUETTE: silhouette, HEAD: head}
