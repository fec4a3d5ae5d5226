"""The bare facial skin of a photo. It gives the photo's exposure, and separates the brightness of the light from that
of the albedo.

Two cues separate them: how bright the skin is in the photo, as exposure makes up for the light only in part; and the
contrast between skin and the white of the eyes, which differs little between people and is lit like the skin below it.
Some eyes mislead, more often the darker one of the two: they lie in the shadow of the brow, or catch a light that the
cheek does not. So each eye is modelled as a measurement that is an outlier with some probability."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import mitsuba as mi
import numpy as np
from scipy.spatial import cKDTree
from scipy.special import expit, softmax
from skimage.draw import polygon2mask

from sira_mi.avatar.file import Avatar
from sira_mi.conventions import LUMINANCE
from sira_mi.fit.shaded import SurfacePoints, base_albedo
from sira_mi.portrait.landmarks import BARE_SKIN, BELOW_EYES, EYES
from sira_mi.portrait.portrait import Portrait

# Radius around a landmark of bare skin in which pixels count as skin, share of the face's height.
_RADIUS = 0.04
# Least luminance.
_DARKEST = 1e-3
# Range of the exposure.
_EXPOSURES = (0.5, 16.0)
# Percentile of an eye's opening that is its white.
_WHITE = 90
# Luminances between which skin lies, L* 30 to 73.
_SKIN = (0.06, 0.45)
# Range of contrasts; larger ones are clipped, outliers are uniform in it.
_CONTRASTS = (-1.9, 0.05)
# Values of y at which its distribution is evaluated.
_LEVELS = 161


@dataclass(frozen=True)
class Eye:
    """The cue of one eye."""

    contrast: float  # log of the skin's luminance over that of the eye's white
    white: float  # log luminance of the white


@dataclass(frozen=True)
class SkinCues:
    """The cues of a photo."""

    radiance: float  # luminance of the skin, geometric mean
    eyes: tuple[Eye, ...]  # the visible ones


@dataclass(frozen=True)
class SkinLevel:
    """The distribution of y, the log luminance of the skin's albedo, and of the cues given y. y is normal about usual +
    by_radiance · log radiance; the contrast of an eye is normal about y − white, or an outlier, with odds of
    exp(misleading + darker · log of the brighter eye's white over its own). The values are fitted on portraits of
    training heads by `python -m studies.portraits skin`."""

    usual: float = -1.38
    by_radiance: float = 0.25
    spread: float = 0.61
    white: float = -1.02
    deviation: float = 0.17
    misleading: float = -2.29
    darker: float = 1.98

    def log_luminance(self, radiance: np.ndarray, contrast: np.ndarray, white: np.ndarray) -> np.ndarray:
        """The mean of y [N] given the log radiance of skin [N] and of two eyes their contrasts and log luminances
        [N, 2], NaN where an eye is not seen."""
        darkest, lightest = np.log(_SKIN)
        y = np.linspace(darkest, lightest, _LEVELS)
        expected = self.usual + self.by_radiance * radiance[:, None]
        log_odds = -(((y - expected) / self.spread) ** 2) / 2
        brighter = np.fmax(white[:, 0], white[:, 1])
        for eye in range(2):
            reading = np.clip(contrast[:, eye : eye + 1], *_CONTRASTS)
            shift = (reading - (y - self.white)) / self.deviation
            inlier = np.exp(-(shift**2) / 2) / (self.deviation * np.sqrt(2 * np.pi))
            outliers = expit(self.misleading + self.darker * (brighter - white[:, eye]))[:, None]
            seen = np.isfinite(reading)
            density = (1 - outliers) * inlier + outliers / np.ptp(_CONTRASTS)
            log_odds = log_odds + np.log(density, where=seen, out=np.zeros_like(density))
        weights = softmax(log_odds, axis=1)
        return weights @ y


def find_skin_cues(portrait: Portrait) -> SkinCues | None:
    """The cues of a photo; None where no skin is visible."""
    luminance = _luminance_near(portrait, BARE_SKIN)
    return SkinCues(float(np.exp(np.log(luminance).mean())), _eyes(portrait)) if len(luminance) else None


def find_near_landmarks(
    landmarks: np.ndarray, chosen: tuple[int, ...], mask: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of the pixels of a `mask` [H, W] within `landmark_radius` of the `chosen` ones of landmarks
    [468, 2], pixels, NaN where unknown."""
    row, column = np.nonzero(mask)
    wanted = landmarks[list(chosen)]
    wanted = wanted[np.isfinite(wanted).all(axis=1)]
    if not len(wanted) or not len(row):
        return row[:0], column[:0]
    found = cKDTree(np.stack([column, row], axis=1) + 0.5).query_ball_point(wanted, landmark_radius(landmarks))
    near = np.unique(np.concatenate(found).astype(int))
    return row[near], column[near]


def landmark_radius(landmarks: np.ndarray) -> float:
    """Radius, pixels, around each of landmarks [468, 2] in which skin looks as it does there."""
    known = landmarks[np.isfinite(landmarks[:, 1]), 1]
    return _RADIUS * float(np.ptp(known)) if len(known) else 0.0


def _luminance_near(portrait: Portrait, chosen: tuple[int, ...]) -> np.ndarray:
    row, column = find_near_landmarks(portrait.landmarks, chosen, portrait.mask > 0.5)
    return np.maximum(portrait.image[row, column] @ np.array(LUMINANCE), _DARKEST)


def _eyes(portrait: Portrait) -> tuple[Eye, ...]:
    """The eyes of which white and skin below are visible."""
    seen = []
    for opening, below in zip(EYES, BELOW_EYES, strict=True):
        outline, skin = portrait.landmarks[list(opening)], _luminance_near(portrait, below)
        if not np.isfinite(outline).all() or not len(skin):
            continue
        inside = polygon2mask(portrait.mask.shape, outline[:, ::-1] - 0.5) & (portrait.mask > 0.5)
        if inside.any():
            white = np.percentile(portrait.image[inside] @ np.array(LUMINANCE), _WHITE)
            white = np.log(max(white, _DARKEST))
            seen.append(Eye(float(np.log(np.median(skin)) - white), float(white)))
    return tuple(seen)


def face_exposure(portrait: Portrait, prior: Avatar) -> float:
    """The factor that brings the skin of a photo to the luminance that skin has in the photos of the prior's training;
    1 where no skin is visible."""
    cues = find_skin_cues(portrait)
    return 1.0 if cues is None else float(np.clip(prior.skin_prior().radiance / cues.radiance, *_EXPOSURES))


def skin_luminance(cues: SkinCues) -> float:
    """Luminance of the albedo of skin in a photo with these cues."""
    return float(np.exp(SkinLevel().log_luminance(*cue_arrays([cues])))[0])


def cue_arrays(cues: Sequence[SkinCues]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The arguments of `SkinLevel.log_luminance`, of N photos."""
    missing = Eye(np.nan, np.nan)
    eyes = [(*one.eyes, missing, missing)[:2] for one in cues]
    contrast, white = (np.array([[getattr(e, name) for e in pair] for pair in eyes]) for name in ("contrast", "white"))
    return np.log([one.radiance for one in cues]), contrast, white


@dataclass(frozen=True)
class SkinPatches:
    """Points of bare facial skin, one for each landmark, and the luminance of the albedo that is expected there."""

    points: SurfacePoints
    luminance: float

    def loss(self, avatar: Avatar, tensors: dict) -> Any:
        """`SkinPrior.loss` of the base diffuse albedo by the decoders at `tensors` (Floats)."""
        count = len(self.points.row)
        albedo = base_albedo(avatar, tensors, self.points)
        weight = mi.TensorXf(np.full((1, count), 1 / count, np.float32))
        skin = avatar.skin_prior()
        return skin.loss(albedo, weight, skin.tone_of_luminance(np.array([self.luminance])))


def find_skin_patches(portrait: Portrait, points: SurfacePoints) -> SkinPatches | None:
    """The points nearest to the photo's landmarks of bare skin; None without a face or where none is visible."""
    cues = find_skin_cues(portrait)
    if cues is None or not len(points.row):
        return None
    landmarks = portrait.landmarks[list(BARE_SKIN)]
    tree = cKDTree(np.stack([points.column, points.row], axis=1) + 0.5)
    distance, nearest = tree.query(landmarks[np.isfinite(landmarks).all(axis=1)])
    close = distance < landmark_radius(portrait.landmarks)
    return SkinPatches(points[nearest[close]], skin_luminance(cues)) if close.any() else None
