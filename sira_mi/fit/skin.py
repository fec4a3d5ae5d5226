"""The bare facial skin of a photo: it tells how the photo is exposed, and settles the level of the light against the
albedo's."""

from __future__ import annotations

from dataclasses import dataclass

import mitsuba as mi
import numpy as np
from scipy.spatial import cKDTree

from sira_mi.conventions import LUMINANCE
from sira_mi.fit.shaded import SeenPoints, base_albedo
from sira_mi.models.af_sm import AppearanceTraining
from sira_mi.models.avatar import Avatar
from sira_mi.models.skin_tone import SKIN_LANDMARKS, skin_tone_loss
from sira_mi.portrait.portrait import Portrait

# Pixels this near to a landmark of bare skin tell how bright the skin is in the photo, shares of the face's height.
_REACH = 0.04
# Luminance below this counts as this.
_DARKEST = 1e-3
# Photos are scaled by no less and no more than this for the learned radiance.
_EXPOSURES = (0.5, 16.0)


def skin_landmarks(portrait: Portrait) -> tuple[np.ndarray, float]:
    """Pixels [L, 2] of the landmarks of bare facial skin that a photo has, and how near to them its skin is sure."""
    landmarks = portrait.landmarks[list(SKIN_LANDMARKS)]
    known = portrait.landmarks[np.isfinite(portrait.landmarks[:, 1]), 1]
    reach = _REACH * float(np.ptp(known)) if len(known) else 0.0
    return landmarks[np.isfinite(landmarks).all(axis=1)], reach


def skin_radiance(portrait: Portrait) -> float | None:
    """Luminance of the bare facial skin in a photo, geometric mean; None where none is seen."""
    landmarks, reach = skin_landmarks(portrait)
    row, column = np.nonzero(portrait.mask > 0.5)
    if not len(landmarks) or not len(row):
        return None
    found = cKDTree(np.stack([column, row], axis=1) + 0.5).query_ball_point(landmarks, reach)
    near = np.unique(np.concatenate(found).astype(int))
    if not len(near):
        return None
    luminance = portrait.image[row[near], column[near]] @ np.array(LUMINANCE)
    return float(np.exp(np.log(np.maximum(luminance, _DARKEST)).mean()))


def face_exposure(portrait: Portrait) -> float:
    """The factor that brings the skin of a photo to the luminance that skin has in the photos of the training; 1 where
    no skin is seen."""
    radiance = skin_radiance(portrait)
    return 1.0 if radiance is None else float(np.clip(AppearanceTraining().skin_radiance / radiance, *_EXPOSURES))


@dataclass(frozen=True)
class SkinPatches:
    """Points of bare facial skin, one a landmark, and the luminance of the skin in the photo."""

    points: SeenPoints
    radiance: float

    def loss(self, avatar: Avatar, tensors: dict, share: float):
        """`skin_tone_loss` of the base diffuse albedo by the decoders at `tensors` (Floats); `share` is the part of the
        log luminance by which the photo's skin is darker than usual that is put down to the skin, not to the light."""
        settings, count = AppearanceTraining(), len(self.points.row)
        albedo = base_albedo(avatar, tensors, self.points)
        weight = mi.TensorXf(np.full((1, count), 1 / count, np.float32))
        usual = settings.skin_radiance
        expected = np.array([max(self.radiance, usual * (self.radiance / usual) ** share)])
        return skin_tone_loss(albedo, weight, expected, usual, settings.skin_deviations)


def skin_patches(portrait: Portrait, points: SeenPoints) -> SkinPatches | None:
    """The points nearest to the photo's landmarks of bare skin; None without a face or where none is seen."""
    landmarks, reach = skin_landmarks(portrait)
    radiance = skin_radiance(portrait)
    if radiance is None or not len(points.row):
        return None
    tree = cKDTree(np.stack([points.column, points.row], axis=1) + 0.5)
    distance, nearest = tree.query(landmarks)
    if not (distance < reach).any():
        return None
    return SkinPatches(points[nearest[distance < reach]], radiance)
