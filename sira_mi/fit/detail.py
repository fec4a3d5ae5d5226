"""The detail stage: the diffuse albedo of all that the photo shows, in closed form, at the photo's full resolution.

Eq. 8 is linear in the diffuse albedo: the albedo of a pixel is the photo's radiance less the specular term, over the
irradiance. Both come from the fit and are smooth, so that they are evaluated at the working size. Eyes, brows, lips,
hair and cloth are not smooth, and no network holds them. The paper has no such stage.

Level and colour of light and albedo together are ambiguous: first the light is scaled so that bare skin has the
luminance that the photo's cues say (`sira_mi.fit.skin`), in the colour that skin of that luminance has."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import mitsuba as mi
import numpy as np
from scipy.ndimage import distance_transform_edt
from scipy.optimize import brentq
from scipy.special import logit

from sira_mi.avatar.decoders import albedo_refinement, refine_albedo
from sira_mi.fields.columns import CHUNK
from sira_mi.fit.appearance import PhotoSurface, scale_light, share_surface
from sira_mi.fit.shaded import Arrays, PhotoPoints, base_albedo, decoder, shade_points
from sira_mi.fit.skin import find_near_landmarks
from sira_mi.fit.stage import FitTask, Problem, Stage
from sira_mi.fit.state import FitState
from sira_mi.portrait.landmarks import BARE_SKIN

# The highest albedo, and the least irradiance over π as a share of its mean over the photo's points.
_HIGHEST_ALBEDO, _LEAST_IRRADIANCE = 0.95, 0.03
# Cosines to the view between which a surface is too oblique for its pixel to say anything of it.
_OBLIQUE = (0.1, 0.3)
# Stops by which the light's level may be wrong, and how often it is scaled, as a scaled light is about as asked for.
_MOST_STOPS, _SCALINGS = 3.0, 3
# Pixels of the working image: from the outline of the head to where the detail begins and to where it is whole, as
# pixels on the outline show the background too; and by which the layers go on beyond it, for lookups between pixels.
_OUTLINE, _MARGIN = (1.0, 3.0), 2


@dataclass(frozen=True)
class DetailStage(Stage):
    """The last stage; it takes no steps."""

    k_s: tuple[float, float] = (1.0, 1.0)
    k_r: float = 1.0

    def problem(self, task: FitTask, state: FitState) -> Problem:
        return DetailProblem(self, task, share_surface(task, state))


class DetailProblem:
    """What the detail stage sets."""

    def __init__(self, stage: DetailStage, task: FitTask, surface: PhotoSurface):
        self.stage, self.avatar, self.surface = stage, task.prior, surface

    def start(self, state: FitState) -> FitState:
        """Scales the light, adds the tensors of `sira_mi.avatar.detail`, and shifts the network of the diffuse albedo
        to their level."""
        state = self._scale_light(state)
        points = self.surface.points
        irradiance, specular = self._shade(state, points)
        irradiance = np.maximum(irradiance, _LEAST_IRRADIANCE * irradiance.mean())
        seen = np.clip((self.surface.radiance - specular) / irradiance, 0, _HIGHEST_ALBEDO)
        network = self._shift_network(state, points, seen)
        return state.with_parameters({"diffuse_albedo": network, **draw_detail(self.surface, irradiance, specular)})

    def refresh(self, state: FitState) -> None:
        pass

    def losses(self, parameters: Arrays, step: int, rng: np.random.Generator) -> Arrays:
        raise ValueError("the detail stage takes no steps")

    def _scale_light(self, state: FitState) -> FitState:
        surface = self.surface
        if surface.skin is None:
            return state
        near = np.zeros(surface.portrait.mask.shape, bool)
        near[find_near_landmarks(surface.portrait.landmarks, BARE_SKIN, surface.portrait.mask > 0.5)] = True
        chosen = np.flatnonzero(near[surface.points.row, surface.points.column])
        points, radiance = surface.points[chosen], surface.radiance[:, chosen]
        tone = np.exp(self.avatar.skin_prior().tone_of_luminance(np.array([surface.skin.luminance])))[:, 0]
        for _ in range(_SCALINGS):
            factor = find_light_factors(radiance, *self._shade(state, points), tone)
            light = scale_light(self.avatar, state.avatar["illumination"], factor)
            state = state.with_parameters({"illumination": light})
        return state

    def _shade(self, state: FitState, points: PhotoPoints) -> tuple[np.ndarray, np.ndarray]:
        """Irradiance over π and specular radiance [3, n] at points of the photo."""
        parameters = state.floats()
        pieces = np.array_split(np.arange(len(points.row)), max(1, -(-len(points.row) // CHUNK)))
        found = []
        for index in pieces:
            white = mi.TensorXf(np.ones((3, len(index)), np.float32))
            shading = shade_points(self.avatar, parameters, self.stage.k_s[1], points[index], white)
            found.append((shading.diffuse.numpy(), shading.specular.numpy()))
        irradiance, specular = (np.concatenate(parts, axis=1) for parts in zip(*found, strict=True))
        return irradiance, specular

    def _shift_network(self, state: FitState, points: PhotoPoints, seen: np.ndarray) -> np.ndarray:
        """The parameters of the diffuse albedo's network, their last biases shifted so that in the median over the
        photo's points its refined albedo is the one `seen` [3, N]: what the photo does not show has the same level."""
        facing = np.flatnonzero(_facing(points) > _OBLIQUE[1])
        chosen = facing[:: max(1, -(-len(facing) // CHUNK))]
        network = state.avatar["diffuse_albedo"].copy()
        if len(chosen):
            at, parameters, octaves = points[chosen], state.floats(), self.avatar.architecture.refinement_octaves
            refinement = decoder(self.avatar, "albedo_refinement", parameters)
            fine = albedo_refinement(refinement, octaves, mi.TensorXf(at.x_ref), mi.TensorXf(at.gamma))
            albedo = refine_albedo(base_albedo(self.avatar, parameters, at), fine, self.stage.k_r).numpy()
            wanted, known = (logit(np.clip(a, 1e-3, _HIGHEST_ALBEDO)) for a in (seen[:, chosen], albedo))
            network[-3:] += np.median(wanted - known, axis=1).astype(np.float32)
        return network


def find_light_factors(radiance: np.ndarray, diffuse: np.ndarray, specular: np.ndarray, tone: np.ndarray) -> np.ndarray:
    """The factors [3] of a light, with `diffuse` irradiance over π and specular radiance [3, n], at which skin of that
    radiance [3, n] has the albedo `tone` [3] in the median; 1 without skin, or where no factor within 3 stops does."""

    def excess(stops: float, channel: int) -> float:
        light = 2.0**stops
        reflected = np.maximum(radiance[channel] - light * specular[channel], 0)
        return float(np.median(reflected / (light * np.maximum(diffuse[channel], 1e-6)))) - tone[channel]

    factors = np.ones(3)
    for channel in range(3 if radiance.size else 0):
        if excess(-_MOST_STOPS, channel) > 0 > excess(_MOST_STOPS, channel):
            factors[channel] = 2.0 ** brentq(excess, -_MOST_STOPS, _MOST_STOPS, (channel,), xtol=1e-3)
    return factors


def draw_detail(surface: PhotoSurface, irradiance: np.ndarray, specular: np.ndarray) -> dict[str, np.ndarray]:
    """The tensors of `sira_mi.avatar.detail` for a photo with this irradiance over π and specular radiance [3, N] at
    the points of its surface."""
    points, portrait, camera = surface.points, surface.portrait, surface.portrait.camera
    size = portrait.mask.shape
    within = distance_transform_edt(_spread(np.ones_like(points.t), points, size, margin=0)[..., 0])
    weight = _rise(_facing(points), _OBLIQUE) * _rise(within[points.row, points.column], _OUTLINE)
    layers = _spread(np.concatenate([irradiance, specular, weight[None]]), points, size)
    place = np.concatenate([points.origin + points.t * points.view, np.ones_like(points.t)])
    depth = _spread((camera.world_to_camera[:3] @ place)[2:], points, size)[..., 0]

    photo = portrait.image if portrait.sharp is None else portrait.sharp
    layers = cv2.resize(layers, photo.shape[1::-1], interpolation=cv2.INTER_LINEAR)
    albedo = np.clip((photo - layers[..., 3:6]) / np.maximum(layers[..., :3], 1e-6), 0, _HIGHEST_ALBEDO)
    to_unit = np.diag([1 / camera.width, 1 / camera.height, 1.0])
    return {
        "detail": np.concatenate([albedo, layers[..., 6:]], axis=-1).astype(np.float32),
        "detail_depth": depth,
        "detail_camera": (to_unit @ camera.K @ camera.world_to_camera[:3]).astype(np.float32),
    }


def _facing(points: PhotoPoints) -> np.ndarray:
    """Cosines [N] between normals and the directions to the camera."""
    return -(points.normal * points.view).sum(axis=0)


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
