"""Measured human skin as a prior on a face's albedo: it settles level and colour of the light against the albedo's."""

import drjit as dr
import mitsuba as mi
import numpy as np

from sira_mi.conventions import LUMINANCE
from sira_mi.fields.columns import in_three
from sira_mi.optimisation import losses

# Measured facial skin in log linear RGB. The patches "light skin" and "dark skin" of the ColorChecker, made after
# measured skin (McCamy et al. 1976), sRGB (194, 150, 130) and (115, 82, 68), give its mean and the axis of skin tone;
# across that axis skin varies as within one population (Yun et al. 2010, a* ± 2.65 and b* ± 2.39).
SKIN_TONE_MEAN = np.array([-1.190, -1.830, -2.175])
SKIN_TONE_AXIS = np.array([0.524, 0.587, 0.617])
_AXIS = SKIN_TONE_AXIS / np.linalg.norm(SKIN_TONE_AXIS)
# Luminance of the mean, and change of its log along the axis.
SKIN_LUMINANCE = float(np.exp(SKIN_TONE_MEAN) @ np.array(LUMINANCE))
_SKIN_TONE_SLOPE = float((np.exp(SKIN_TONE_MEAN) * np.array(LUMINANCE)) @ SKIN_TONE_AXIS / SKIN_LUMINANCE)
# Deviation from measured skin from which on the loss grows linearly, standard deviations.
_SKIN_OUTLIER = 2.0


def tone_of_luminance(luminance: np.ndarray) -> np.ndarray:
    """The measured skin of luminance [S], log linear RGB [3, S]; the mean where the luminance is NaN."""
    shift = np.nan_to_num(np.log(luminance / SKIN_LUMINANCE)) / _SKIN_TONE_SLOPE
    return SKIN_TONE_MEAN[:, None] + _AXIS[:, None] * shift


def skin_tone_loss(albedo, weight, expected: np.ndarray, deviations: tuple[float, float]):
    """Mean over scenes of the squared deviation x² of the log of a scene's mean skin albedo from the `expected` tone,
    log RGB [3, S], in standard `deviations` along and across the axis of skin tone; far out it grows with |x| only
    (pseudo-Huber), so that painted faces are possible. `albedo` [3, S·L] at skin landmarks, `weight` [1, S·L] their
    shares, all 0 in scenes that do not count."""
    scenes = expected.shape[1]
    mean = dr.sum(dr.reshape(albedo * in_three(weight), (3, scenes, -1)), axis=2)
    known = dr.sum(dr.reshape(weight, (1, scenes, -1)), axis=2)
    centre = mi.TensorXf(np.ascontiguousarray(expected, dtype=np.float32))
    deviation = dr.log(mean + in_three(1.0 - known) * dr.exp(centre)) - centre
    along = mi.TensorXf(_AXIS[None, :].astype(np.float32)) @ deviation
    along = dr.sum(along * along, axis=0)
    across = dr.sum(deviation * deviation, axis=0) - along
    wide, narrow = deviations
    square = along * (1 / wide**2) + across * (1 / narrow**2)
    bend = 2.0 * _SKIN_OUTLIER**2
    return losses.mean(bend * (dr.sqrt(1.0 + square * (1 / _SKIN_OUTLIER**2)) - 1.0))
