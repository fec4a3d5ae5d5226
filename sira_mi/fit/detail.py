"""The detail of the albedo, in closed form from the photo at its full resolution.

Eq. 8 is linear in the diffuse albedo: the albedo of a pixel is the photo's radiance less the specular term, over the
irradiance. Irradiance and specular term come from the fit, with its refinement of the light. They are smooth, so that
they are evaluated at the working size. Eyes, brows, lips, hair and cloth are not smooth, and no network holds them.
"""

from __future__ import annotations

import cv2
import mitsuba as mi
import numpy as np
from scipy.ndimage import distance_transform_edt
from scipy.optimize import brentq
from scipy.special import logit

from sira_mi.avatar.decoders import albedo_refinement, light_refinement, refine_albedo
from sira_mi.avatar.file import Avatar
from sira_mi.conventions import LUMINANCE
from sira_mi.fields.columns import CHUNK
from sira_mi.fit.appearance import PhotoSurface, share_surface
from sira_mi.fit.shaded import PhotoPoints, base_albedo, decoder, shade_points
from sira_mi.fit.skin import find_near_landmarks
from sira_mi.fit.stage import FitTask
from sira_mi.fit.state import FitState
from sira_mi.portrait.landmarks import BARE_SKIN

# The highest albedo, and the least irradiance over π as a share of its mean over the photo's points.
_HIGHEST_ALBEDO, _LEAST_IRRADIANCE = 0.95, 0.03
# Cosines to the view between which a surface is too oblique for its pixel to say anything of it.
_OBLIQUE = (0.1, 0.3)
# Stops, either way, by which the light's level may be wrong.
_MOST_STOPS = 3.0
# Pixels of the working image: from the outline of the head to where the detail begins and to where it is whole, as
# pixels on the outline show the background too; and by which the layers go on beyond it, for lookups between pixels.
_OUTLINE, _MARGIN = (1.0, 3.0), 2


def find_detail(task: FitTask, state: FitState, k_s: float, k_r: float) -> tuple[dict[str, np.ndarray], float]:
    """For the avatar at `state`, with the weights k_s and k_r of eqs 8 and 11: the tensors of `sira_mi.avatar.detail`,
    and the network `diffuse_albedo` at the same level; and the factor of the light with which they are found."""
    surface = share_surface(task, state)
    points, portrait = surface.points, surface.portrait
    camera, size = portrait.camera, portrait.mask.shape
    place = np.concatenate([points.origin + points.t * points.view, np.ones_like(points.t)])
    cosine = -(points.normal * points.view).sum(axis=0, keepdims=True)
    within = distance_transform_edt(_spread(np.ones_like(points.t), points, size, margin=0)[..., 0])
    weight = _rise(cosine, _OBLIQUE) * _rise(within[points.row, points.column], _OUTLINE)
    irradiance, specular = _shade_photo(task.prior, state, surface, k_s)
    factor = find_level(surface, irradiance, specular)
    irradiance, specular = factor * irradiance, factor * specular
    seen = np.clip((surface.radiance - specular) / irradiance, 0, _HIGHEST_ALBEDO)
    network = shift_network(task.prior, state, points, seen, k_r)
    layers = _spread(np.concatenate([irradiance, specular, weight]), points, size)
    depth = _spread((camera.world_to_camera[:3] @ place)[2:], points, size)[..., 0]

    photo = portrait.image if portrait.sharp is None else portrait.sharp
    height, width = photo.shape[:2]
    layers = cv2.resize(layers, (width, height), interpolation=cv2.INTER_LINEAR)
    albedo = np.clip((photo - layers[..., 3:6]) / np.maximum(layers[..., :3], 1e-6), 0, _HIGHEST_ALBEDO)
    to_unit = np.diag([1 / camera.width, 1 / camera.height, 1.0])
    return {
        "detail": np.concatenate([albedo, layers[..., 6:]], axis=-1).astype(np.float32),
        "detail_depth": depth,
        "detail_camera": (to_unit @ camera.K @ camera.world_to_camera[:3]).astype(np.float32),
        "diffuse_albedo": network,
    }, factor


def shift_network(avatar: Avatar, state: FitState, points: PhotoPoints, seen: np.ndarray, k_r: float) -> np.ndarray:
    """The parameters of the diffuse albedo's network, their last biases shifted so that in the median over the photo's
    points its refined albedo is the one `seen` [3, N]: what the photo does not show goes on at the same level."""
    parameters = {name: mi.Float(value) for name, value in state.avatar.items()}
    octaves = avatar.architecture.refinement_octaves
    chosen = np.flatnonzero(-(points.normal * points.view).sum(axis=0) > _OBLIQUE[1])[:: max(1, len(points.row) // CHUNK)]
    at = points[chosen]
    fine = albedo_refinement(
        decoder(avatar, "albedo_refinement", parameters), octaves, mi.TensorXf(at.x_ref), mi.TensorXf(at.gamma)
    )
    albedo = refine_albedo(base_albedo(avatar, parameters, at), fine, k_r).numpy()
    odds = [logit(np.clip(a, 1e-3, _HIGHEST_ALBEDO)) for a in (seen[:, chosen], albedo)]
    network = state.avatar["diffuse_albedo"].copy()
    if len(chosen):
        network[-3:] += np.median(odds[0] - odds[1], axis=1).astype(np.float32)
    return network


def find_level(surface: PhotoSurface, irradiance: np.ndarray, specular: np.ndarray) -> float:
    """The factor of the light, of irradiance over π and specular radiance [3, N] at the photo's points, with which the
    albedo of bare skin has the luminance that the photo's cues say; 1 where no skin is seen."""
    if surface.skin is None:
        return 1.0
    near = np.zeros(surface.portrait.mask.shape, bool)
    near[find_near_landmarks(surface.portrait.landmarks, BARE_SKIN, surface.portrait.mask > 0.5)] = True
    chosen = near[surface.points.row, surface.points.column]
    radiance, diffuse, specular = (a[:, chosen] for a in (surface.radiance, irradiance, specular))

    def excess(stops: float) -> float:
        light = 2.0**stops
        albedo = np.maximum(radiance - light * specular, 0) / (light * diffuse)
        return float(np.median(np.array(LUMINANCE) @ albedo)) - surface.skin.luminance

    if not excess(-_MOST_STOPS) > 0 > excess(_MOST_STOPS):
        return 1.0
    return float(2.0 ** brentq(excess, -_MOST_STOPS, _MOST_STOPS, xtol=1e-3))


def _shade_photo(avatar: Avatar, state: FitState, surface: PhotoSurface, k_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Irradiance over π and specular radiance [3, N] at the photo's points, in the photo's light."""
    parameters = {name: mi.Float(value) for name, value in state.avatar.items()}
    count = surface.radiance.shape[1]
    pieces = np.array_split(np.arange(count), max(1, -(-count // CHUNK)))
    found = [_shade(avatar, parameters, surface.points[index], k_s) for index in pieces]
    irradiance, specular = (np.concatenate(parts, axis=1) for parts in zip(*found, strict=True))
    return np.maximum(irradiance, _LEAST_IRRADIANCE * irradiance.mean()), specular


def _shade(avatar: Avatar, parameters: dict, points: PhotoPoints, k_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Irradiance over π and specular radiance [3, n] at some points."""
    white = mi.TensorXf(np.ones((3, len(points.row)), np.float32))
    shading = shade_points(avatar, parameters, k_s, points, white)
    octaves = avatar.architecture.refinement_octaves
    network = decoder(avatar, "light_refinement", parameters)
    factor = np.exp(light_refinement(network, octaves, mi.TensorXf(points.x_ref), mi.TensorXf(points.gamma)).numpy())
    return factor * shading.diffuse.numpy(), factor * shading.specular.numpy()


def _rise(values: np.ndarray, limits: tuple[float, float]) -> np.ndarray:
    """From 0 at the first of the limits, linearly, to 1 at the second."""
    return np.clip((values - limits[0]) / (limits[1] - limits[0]), 0, 1)


def _spread(values: np.ndarray, points: PhotoPoints, size: tuple[int, int], margin: int = _MARGIN) -> np.ndarray:
    """Values [C, N] at the photo's points as a picture [H, W, C], 0 where no point is within `margin` pixels."""
    picture = np.zeros((*size, len(values)), np.float32)
    known = np.zeros(size, bool)
    picture[points.row, points.column], known[points.row, points.column] = values.T, True
    away, (row, column) = distance_transform_edt(~known, return_indices=True)
    near = away <= margin
    picture[near] = picture[row[near], column[near]]
    return picture
