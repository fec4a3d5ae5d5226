"""The detail of the albedo: what eq. 8 and the refinements leave of the photo, pixel by pixel, in closed form.

Eq. 8 is linear in the diffuse albedo, so the factor that makes a pixel right is the photo's radiance less the specular
term over the diffuse one. The networks of the refinements are smooth; eyes, brows, lips, hair and cloth are not.
"""

from __future__ import annotations

from dataclasses import replace

import mitsuba as mi
import numpy as np
from scipy.ndimage import distance_transform_edt

from sira_mi.avatar.decoders import albedo_refinement, light_refinement, refine_albedo
from sira_mi.avatar.file import Avatar
from sira_mi.fields.columns import CHUNK
from sira_mi.fit.appearance import PhotoSurface, share_surface
from sira_mi.fit.shaded import PhotoPoints, base_albedo, decoder, shade_points
from sira_mi.fit.stage import FitTask
from sira_mi.fit.state import FitState
from sira_mi.portrait.camera import Camera

# Added to radiances before their logarithm: darker pixels are noise.
_DARK = 0.004
# Range of the logarithm of the factor, and the highest albedo.
_LARGEST, _HIGHEST_ALBEDO = 2.5, 0.95
# Cosines to the view between which a surface is too oblique for its pixel to say anything of it.
_OBLIQUE = (0.1, 0.3)
# Pixels by which the detail goes on beyond the mask, for lookups between pixels.
_MARGIN = 3


def find_detail(task: FitTask, state: FitState, k_s: float, k_r: float) -> dict[str, np.ndarray]:
    """The tensors of `sira_mi.avatar.detail` for the avatar at `state`, with the weights k_s and k_r of eqs 8 and 11."""
    surface = share_surface(task, state)
    points, camera = surface.points, surface.portrait.camera
    depth = (camera.world_to_camera[:3] @ _homogeneous(points.origin + points.t * points.view))[2]
    logarithm = _log_factor(task.prior, state, surface, k_s, k_r)
    oblique = np.clip((-(points.normal * points.view).sum(axis=0) - _OBLIQUE[0]) / np.ptp(_OBLIQUE), 0, 1)
    return draw_detail(camera, points.row, points.column, logarithm * oblique, depth)


def _homogeneous(points: np.ndarray) -> np.ndarray:
    return np.concatenate([points, np.ones((1, points.shape[1]))])


def _log_factor(avatar: Avatar, state: FitState, surface: PhotoSurface, k_s: float, k_r: float) -> np.ndarray:
    """The logarithm [3, N] of the photo's radiance over that of eq. 8, its refinements included, as a factor of the
    diffuse albedo."""
    parameters = {name: mi.Float(value) for name, value in state.avatar.items()}
    count = surface.radiance.shape[1]
    pieces = np.array_split(np.arange(count), max(1, -(-count // CHUNK)))
    found = [_shade(avatar, parameters, surface.points[index], k_s, k_r) for index in pieces]
    albedo, diffuse, specular = (np.concatenate(parts, axis=1) for parts in zip(*found, strict=True))
    wanted = np.maximum(surface.radiance - specular, 0)
    highest = np.log(_HIGHEST_ALBEDO / np.maximum(albedo, 1e-3))
    logarithm = np.log((wanted + _DARK) / (diffuse + _DARK))
    return np.clip(logarithm, -_LARGEST, np.minimum(_LARGEST, highest))


def _shade(avatar: Avatar, parameters: dict, points: PhotoPoints, k_s: float, k_r: float) -> tuple[np.ndarray, ...]:
    """Diffuse albedo, diffuse and specular radiance [3, n] in the light of the photo, its refinement included."""
    octaves = avatar.architecture.refinement_octaves
    x_ref, gamma = mi.TensorXf(points.x_ref), mi.TensorXf(points.gamma)
    fine = albedo_refinement(decoder(avatar, "albedo_refinement", parameters), octaves, x_ref, gamma)
    albedo = refine_albedo(base_albedo(avatar, parameters, points), fine, k_r)
    shading = shade_points(avatar, parameters, k_s, points, albedo)
    factor = np.float32(1)
    if "light_refinement" in parameters:
        light = light_refinement(decoder(avatar, "light_refinement", parameters), octaves, x_ref, gamma)
        factor = np.exp(light.numpy())
    return albedo.numpy(), factor * shading.diffuse.numpy(), factor * shading.specular.numpy()


def draw_detail(
    camera: Camera, row: np.ndarray, column: np.ndarray, logarithm: np.ndarray, depth: np.ndarray
) -> dict[str, np.ndarray]:
    """The tensors of `sira_mi.avatar.detail` of a `camera` in the field's coordinates, whose pixels at `row` and
    `column` [N] have the `logarithm` [3, N] of the factor and the `depth` [N]."""
    size = camera.height, camera.width
    values = np.zeros((*size, 3), np.float32)
    depths = np.zeros(size, np.float32)
    values[row, column], depths[row, column] = logarithm.T, depth
    away, nearest = distance_transform_edt(depths == 0, return_indices=True)
    near = away <= _MARGIN
    values[near], depths[near] = (a[nearest[0][near], nearest[1][near]] for a in (values, depths))
    return {
        "detail": values,
        "detail_depth": depths,
        "detail_camera": (camera.K @ camera.world_to_camera[:3]).astype(np.float32),
    }
