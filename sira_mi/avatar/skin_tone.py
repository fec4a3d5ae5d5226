"""Measured human skin as a prior on the albedo of a face. It settles the level and the colour of the light, which a
photo alone cannot tell from the albedo's."""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite

import drjit as dr
import mitsuba as mi
import numpy as np

from sira_mi.conventions import LUMINANCE
from sira_mi.fields.columns import in_three, to_array
from sira_mi.optimisation import losses

# Deviation from the expected tone beyond which the loss grows linearly, standard deviations.
_OUTLIER = 2.0


@dataclass(frozen=True)
class SkinPrior:
    """What a prior was trained to expect of a face's skin; stored with it. Colours are log linear RGB.

    The patches "light skin" and "dark skin" of the ColorChecker, made after measured skin (McCamy et al. 1976), sRGB
    (194, 150, 130) and (115, 82, 68), give the mean tone and the axis in which skin tone varies. Across that axis skin
    varies as within one population (Yun et al. 2010, a* ± 2.65 and b* ± 2.39)."""

    radiance: float  # luminance of average skin in the training's photos
    deviations: tuple[float, float]  # standard deviations of a face's skin along and across the axis
    mean: tuple[float, float, float] = (-1.190, -1.830, -2.175)
    axis: tuple[float, float, float] = (0.524, 0.587, 0.617)

    def __post_init__(self):
        numbers = (self.radiance, *self.deviations, *self.mean, *self.axis)
        sizes = (len(self.deviations), len(self.mean), len(self.axis))
        if sizes != (2, 3, 3) or not all(map(isfinite, numbers)) or min(self.radiance, *self.deviations) <= 0:
            raise ValueError("unusable constants of the skin prior")

    @property
    def luminance(self) -> float:
        """Luminance of the mean tone."""
        return float(np.exp(self.mean) @ np.array(LUMINANCE))

    def tone_of_luminance(self, luminance: np.ndarray) -> np.ndarray:
        """The tone [3, S] of skin of a luminance [S]; the mean where the luminance is NaN."""
        slope = float((np.exp(self.mean) * np.array(LUMINANCE)) @ np.array(self.axis) / self.luminance)
        shift = np.nan_to_num(np.log(luminance / self.luminance)) / slope
        return np.array(self.mean)[:, None] + self._unit_axis()[:, None] * shift

    def tone_in_photo(self, radiance: np.ndarray) -> np.ndarray:
        """The tone [3, S] that is expected of skin of luminance `radiance` [S] in photos, NaN where it is not seen.
        Photos are taken to be exposed for the light: skin that is brighter in them than usual is lighter by as much."""
        return self.tone_of_luminance(self.luminance * radiance / self.radiance)

    def loss(self, albedo, weight, expected: np.ndarray):
        """Mean over scenes of the squared deviation x² of the log of a scene's mean skin albedo from the `expected`
        tone [3, S], in standard deviations. Far out it grows with |x| only (pseudo-Huber), so that painted faces are
        possible. `albedo` [3, S·L] at skin landmarks, `weight` [1, S·L] their shares, all 0 in scenes that do not
        count."""
        scenes = expected.shape[1]
        mean: mi.TensorXf = dr.sum(dr.reshape(albedo * in_three(weight), (3, scenes, -1)), axis=2)
        known: mi.TensorXf = dr.sum(dr.reshape(weight, (1, scenes, -1)), axis=2)
        centre = to_array(expected)
        deviation = dr.log(mean + in_three(1.0 - known) * dr.exp(centre)) - centre
        along = mi.TensorXf(self._unit_axis()[None, :].astype(np.float32)) @ deviation
        along = dr.sum(along * along, axis=0)
        across = dr.sum(deviation * deviation, axis=0) - along
        wide, narrow = self.deviations
        square = along * (1 / wide**2) + across * (1 / narrow**2)
        bend = 2.0 * _OUTLIER**2
        return losses.mean(bend * (dr.sqrt(1.0 + square * (1 / _OUTLIER**2)) - 1.0))

    def _unit_axis(self) -> np.ndarray:
        return np.array(self.axis) / np.linalg.norm(self.axis)
