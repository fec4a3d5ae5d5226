"""Measured human skin as a prior on a face's albedo: it settles level and colour of the light against the albedo's."""

import drjit as dr
import mitsuba as mi
import numpy as np

from sira_mi.conventions import LUMINANCE
from sira_mi.fields.sdf import in_three
from sira_mi.models import losses
from sira_mi.models.scenes import TrainingScene

# Landmarks on bare facial skin: upper cheeks, bridge of the nose, forehead between the brows.
SKIN_LANDMARKS = (50, 280, 101, 330, 117, 346, 118, 347, 6, 197, 9, 151)
# Measured facial skin in log linear RGB. The patches "light skin" and "dark skin" of the ColorChecker, made after
# measured skin (McCamy et al. 1976), sRGB (194, 150, 130) and (115, 82, 68), give its mean and the axis of skin tone;
# across that axis skin varies as within one population (Yun et al. 2010, a* ± 2.65 and b* ± 2.39).
SKIN_TONE_MEAN = np.array([-1.190, -1.830, -2.175])
SKIN_TONE_AXIS = np.array([0.524, 0.587, 0.617])
_SKIN_LUMINANCE = np.array(LUMINANCE) * np.exp(SKIN_TONE_MEAN)
# Change of log luminance along the axis.
_SKIN_TONE_SLOPE = float(_SKIN_LUMINANCE @ SKIN_TONE_AXIS / _SKIN_LUMINANCE.sum())
# Observations within this distance of a landmark tell how bright the skin is in the photos, scene units.
_SKIN_RADIUS = 0.06
# Deviation from measured skin from which on the loss grows linearly, standard deviations.
_SKIN_OUTLIER = 2.0


def skin_radiance(scene: TrainingScene, landmarks: np.ndarray) -> float:
    """Geometric mean of the luminance of the observations near `landmarks` [L, 3]; NaN when there are none."""
    from scipy.spatial import cKDTree

    if not len(landmarks):
        return float("nan")
    near = cKDTree(landmarks).query(scene.points, distance_upper_bound=_SKIN_RADIUS)[0] < _SKIN_RADIUS
    luminance = scene.sample_color[near[scene.sample_point]] @ np.array(LUMINANCE)
    return float(np.exp(np.mean(np.log(np.maximum(luminance, 1e-3))))) if len(luminance) else float("nan")


def skin_tone_loss(albedo, weight, radiance: np.ndarray, usual_radiance: float, deviations: tuple[float, float]):
    """Mean over scenes of the squared deviation x² of the log of a scene's mean skin albedo from measured skin, in
    standard `deviations` along and across the axis of skin tone; far out it grows with |x| only (pseudo-Huber), so that
    painted faces are possible. `albedo` [3, S·L] at skin landmarks, `weight` [1, S·L] their shares, all 0 in scenes
    that do not count, `radiance` [S] of `skin_radiance`.

    Photos are taken to be exposed for the light: along the axis, skin that is brighter in its photos than
    `usual_radiance` is expected to be lighter by as much."""
    scenes = len(radiance)
    mean = dr.sum(dr.reshape(albedo * in_three(weight), (3, scenes, -1)), axis=2)
    known = dr.sum(dr.reshape(weight, (1, scenes, -1)), axis=2)
    axis = SKIN_TONE_AXIS / np.linalg.norm(SKIN_TONE_AXIS)
    shift = np.nan_to_num(np.log(radiance / usual_radiance)) / _SKIN_TONE_SLOPE
    centre = mi.TensorXf((SKIN_TONE_MEAN[:, None] + axis[:, None] * shift).astype(np.float32))
    deviation = dr.log(mean + in_three(1.0 - known) * dr.exp(centre)) - centre
    along = mi.TensorXf(axis[None, :].astype(np.float32)) @ deviation
    along = dr.sum(along * along, axis=0)
    across = dr.sum(deviation * deviation, axis=0) - along
    wide, narrow = deviations
    square = along * (1 / wide**2) + across * (1 / narrow**2)
    bend = 2.0 * _SKIN_OUTLIER**2
    return losses.mean(bend * (dr.sqrt(1.0 + square * (1 / _SKIN_OUTLIER**2)) - 1.0))
