"""How the residual of a photo is shared between albedo and light: the part that eq. 8 with the base albedo does not
explain. The paper gives all of it to the albedo (eq. 11).

As logarithms, the residual at a point is the sum of two deviations: of the person's albedo from the prior's, and of the
incident light from eq. 8's. If the deviations are independent and normal, the most probable parts are in proportion to
their variances; this gives each its share.

The variance of the light is computed: how much eq. 8 changes when normals tilt as much as fitted normals err, and
shadows shift as far as fitted surfaces err. It is small in soft light, and large where hard light grazes the surface or
a shadow ends. The variance of the albedo is what the priors leave unexplained on unseen heads, larger at eyes, brows
and lips. It is raised where residuals exceed what both explain, as on hair and clothes that no training head has.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import drjit as dr
import numpy as np
from scipy.spatial import cKDTree
from skimage.draw import polygon2mask

from sira_mi.fields.columns import in_three, to_array
from sira_mi.fit.shaded import PhotoPoints
from sira_mi.fit.skin import find_near_landmarks
from sira_mi.optimisation import losses
from sira_mi.portrait.landmarks import BROWS, EYES, LIPS, MOUTH
from sira_mi.portrait.portrait import Portrait

# Added to radiances and albedos before their logarithm.
_DARK_RADIANCE, _DARK_ALBEDO = 0.01, 0.02
# Deviations of the log albedo from the prior's, grey and colour: of skin, hair and cloth; near brows, lips and eyes; in
# the openings of eyes and mouth.
_COMMON, _FEATURES, _OPENINGS = (0.1, 0.06), (0.15, 0.1), (0.4, 0.15)
# Error of a fit's surface: normals, degrees (root mean square), and positions, scene units.
_TILT, _SHIFT = 15.0, 0.08
# Perturbed surfaces on which the light is computed.
_TRIALS = 6
# Least deviation of the log light, grey and colour.
_LEAST_LIGHT = (0.03, 0.02)
# Neighbouring points over which variances of the light are averaged.
_NEIGHBOURS = 8
# Median over mean of the square of a normal deviation in one dimension, grey, and in two, colour.
_MEDIAN = np.array([0.4549, np.log(2)])


def log_residual(radiance: np.ndarray, expected: np.ndarray) -> np.ndarray:
    """Logarithm [3, N] of a radiance over the expected one, both [3, N]; an offset keeps dark points small."""
    return np.log((np.maximum(radiance, 0) + _DARK_RADIANCE) / (expected + _DARK_RADIANCE))


def squares(residual: np.ndarray) -> np.ndarray:
    """Squares [2, N] of the grey and of the colour of residuals [3, N]: of the mean over channels, and of the length of
    the rest."""
    grey = residual.mean(axis=0)
    return np.stack([np.square(grey), np.square(residual - grey).sum(axis=0)])


def light_variances(
    radiance: Callable[[PhotoPoints], np.ndarray], points: PhotoPoints, chosen: np.ndarray, seed: int
) -> np.ndarray:
    """Variances [2, N] (grey, colour) of the log light at all `points`, from its changes at the `chosen` ones when
    normals tilt and shadows shift. `radiance` evaluates eq. 8 [3, n] at the chosen points with other normals and
    visibility."""
    rng = np.random.default_rng(seed)
    place = (points.origin + points.t * points.view).T
    everywhere = cKDTree(place)
    at = points[chosen]
    expected = radiance(at)
    total = np.zeros((2, len(chosen)))
    for _ in range(_TRIALS):
        shifted = place[chosen] + _SHIFT / np.sqrt(3) * rng.standard_normal((len(chosen), 3))
        _, other = everywhere.query(shifted)
        unoccluded = np.ascontiguousarray(points.unoccluded[:, other])
        wrong = replace(at, normal=_tilted(at.normal, rng), unoccluded=unoccluded)
        total += squares(log_residual(radiance(wrong), expected))
    _, near = cKDTree(place[chosen]).query(place, k=min(_NEIGHBOURS, len(chosen)))
    mean = (total / _TRIALS)[:, near.reshape(len(place), -1)].mean(axis=2)
    return mean + np.square(_LEAST_LIGHT)[:, None]


def _tilted(normal: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Unit normals [3, N], each tilted by a random angle."""
    aside = rng.standard_normal(normal.shape)
    aside -= normal * (aside * normal).sum(axis=0)
    tilted = normal + np.tan(np.radians(_TILT)) / np.sqrt(2) * aside
    return (tilted / np.linalg.norm(tilted, axis=0)).astype(np.float32)


def albedo_variances(portrait: Portrait, row: np.ndarray, column: np.ndarray) -> np.ndarray:
    """Variances [2, N] (grey, colour) of the log albedo about the prior's that are expected at pixels of a photo."""
    shape = portrait.mask.shape
    deviations = np.empty((*shape, 2))
    deviations[:] = _COMMON
    everywhere = np.ones(shape, bool)
    for group in (BROWS, MOUTH, *EYES):
        deviations[find_near_landmarks(portrait.landmarks, group, everywhere)] = _FEATURES
    for opening in (*EYES, LIPS):
        outline = portrait.landmarks[list(opening)]
        if np.isfinite(outline).all():
            deviations[polygon2mask(shape, outline[:, ::-1] - 0.5)] = _OPENINGS
    return np.square(deviations[row, column].T)


def albedo_shares(residual: np.ndarray, chosen: np.ndarray, albedo: np.ndarray, light: np.ndarray) -> np.ndarray:
    """Shares [2, N] (grey, colour), 0 to 1, of a residual that are the albedo's: by the variances of `albedo` and
    `light` [2, N], the former raised to what the `residual` [3, n] at the points `chosen` has beyond the latter.
    The size of residuals is their median, so that clothes in a colour that the prior does not expect do not raise the
    albedo's share all over the photo."""
    whole = np.median(squares(residual), axis=1) / _MEDIAN
    beyond = np.maximum(whole - np.median(light[:, chosen], axis=1), 0)
    albedo = np.maximum(albedo, beyond[:, None])
    return (albedo / (albedo + light)).astype(np.float32)


def share_loss(base, albedo, light_refinement, shares: np.ndarray):
    """Mean distance of the albedo's and the light's parts of a residual from their `shares` [2, N]: `albedo` over
    `base` [3, N], and the light's refinement [3, N], a logarithm."""
    part = dr.log((albedo + _DARK_ALBEDO) / (base + _DARK_ALBEDO))
    return losses.mean(dr.abs(_scaled(part, 1 - shares) - _scaled(light_refinement, shares)))


def _scaled(residual, shares: np.ndarray):
    """A residual [3, N] with its grey and its colour times their `shares` [2, N]."""
    of_grey, of_colour = (to_array(row[None]) for row in shares)
    grey: Any = dr.reshape(dr.mean(residual, axis=0), (1, -1))
    return in_three(grey * (of_grey - of_colour)) + residual * in_three(of_colour)
