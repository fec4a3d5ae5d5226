"""What a picture leaves out, decided from the head, its light and its cameras before anything is rendered."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import mitsuba as mi
import numpy as np

from sira_mi.avatar.file import Avatar
from sira_mi.decisions import Decision, Plan
from sira_mi.export.scene import orbit
from sira_mi.portrait.camera import yaw_rotation
from sira_mi.relight.render import RelightSettings, head_window
from sira_mi.relight.subject import Light, Subject
from sira_mi.relight.surface import (
    Surface,
    baking_error,
    find_visible,
    reflect_bounces,
    sample_surface,
    shadow_error,
    sharing_error,
)
from sira_mi.sg.fit_environment import pixel_directions
from sira_mi.sg.lobes import lobe_integral
from sira_mi.sg.multisampling import REACH
from sira_mi.sg.shading import shade_tensor
from sira_mi.sg.weak_lobes import radiance_bounds, select_lobes, white_radiance

if TYPE_CHECKING:
    from sira_mi.plugins.neural_sdf import NeuralSDF

# The largest error of each decision: a thousandth of the radiance of a white diffuse surface that faces the light best.
# That is a ninth of the step of an 8-bit sRGB picture near white, and three steps at black.
TOLERANCE = 1e-3
# Factor on estimates at random points, for what lies between the points.
_MARGIN = 2.0
# Factor on the largest specular reflectance, for the error of the closed form that computes it.
_CLOSED_FORM_ERROR = 1.05
# The decisions look at this many of the turned views, evenly spread.
_VIEWS = 8
# Rows and sharpness of the lobes that approximate an image.
_IMAGE_ROWS, _IMAGE_SHARPNESS = 8, 64.0
_PICTURE = "picture"


@dataclass(frozen=True, eq=False)
class _Estimates:
    """What the decisions are made from."""

    subject: Subject
    shape: NeuralSDF
    points: Surface
    lobes: np.ndarray  # [N_l, 7]
    white: float  # radiance of a white diffuse surface that faces the light best
    limit: float  # the largest error, radiance
    reflectance: float  # largest directional reflectance of the specular term
    bounces: float  # factor on radiance from all bounces; 1 in closed form
    yaws: Sequence[float]  # of the views that are looked at, degrees

    @property
    def avatar(self) -> Avatar:
        return self.subject.avatar

    def lobes_at(self, yaw: float) -> np.ndarray:
        """The light in the coordinates of the head that is turned by `yaw` degrees."""
        turned = self.lobes.copy()
        turned[:, :3] = self.lobes[:, :3] @ yaw_rotation(-yaw).T
        return turned


def plan_relight(
    subject: Subject,
    light: Light,
    shape: NeuralSDF,
    settings: RelightSettings,
    yaws: Sequence[float],
    tolerance: float = TOLERANCE,
    exact: bool = False,
) -> Plan:
    """The decisions about pictures of `shape` (of `load_head`) at `yaws`, degrees, each with an error up to
    `tolerance`. `settings` leave nothing out; `Plan.apply` changes them. Path tracing takes its albedos from the
    vertices whatever the error, unless `exact` asks for the networks. Where an option has settled a question there is
    no decision."""
    avatar, path = subject.avatar, settings.integrator == "path"
    points, lobes = sample_surface(shape), approximate_lobes(light)
    white = max(white_radiance(lobes), 1e-30)
    reflectance = largest_reflectance(float(points.specular.max()), avatar.roughness)
    again = reflect_bounces(points, None, avatar.roughness, avatar.k_s, reflectance) if path else []
    views = np.unique(np.linspace(0, len(yaws) - 1, min(_VIEWS, len(yaws))).round().astype(int))
    scene = _Estimates(
        subject,
        shape,
        points,
        lobes,
        white,
        limit=tolerance * white,
        reflectance=reflectance,
        bounces=1 + float(sum(part.max() for part in again)),
        yaws=[yaws[k] for k in views],
    )
    decisions = [_specular_term(scene)]
    if light.image is None:
        decisions.append(_weak_lobes(scene))
    if path:
        decisions.append(_late_bounces(scene))
        if not exact:
            decisions.append(_networks(scene))
    else:
        decisions.append(_visibility(scene))
        if settings.samples > 1 and not settings.shared:
            decisions.append(_shadings(scene))
    if not settings.background:
        decisions.append(_crop(subject, shape, yaws))
    return Plan(tuple(decisions))


def approximate_lobes(light: Light) -> np.ndarray:
    """The lobes [N_l, 7] of a light; for an image [H, W, 3] alone 128 lobes, one per cell of a coarse grid, which are
    good enough for estimates."""
    if light.lobes is not None:
        return light.lobes
    if light.image is None:
        raise ValueError("a light has lobes or an image")
    image = light.image
    height, width = image.shape[:2]
    directions, solid_angle = pixel_directions(height, width)
    row, column = np.arange(height) * _IMAGE_ROWS // height, np.arange(width) * 2 * _IMAGE_ROWS // width
    cell = (row[:, None] * 2 * _IMAGE_ROWS + column).ravel()
    count = 2 * _IMAGE_ROWS**2
    weight = np.repeat(solid_angle, width)
    axis = np.stack([np.bincount(cell, weight * d, count) for d in directions.reshape(-1, 3).T], axis=1)
    flux = np.stack([np.bincount(cell, weight * c, count) for c in image.reshape(-1, 3).T], axis=1)
    filled = np.linalg.norm(axis, axis=1) > 0
    axis, flux = axis[filled], flux[filled]
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    amplitude = flux / lobe_integral(np.array(_IMAGE_SHARPNESS))
    return np.column_stack([axis, np.full(len(axis), _IMAGE_SHARPNESS), amplitude]).astype(np.float32)


def largest_reflectance(specular_albedo: float, roughness: float) -> float:
    """The largest share of uniform light that the specular term of `sg.brdf` reflects in one direction."""
    cosine = np.linspace(0.005, 1, 64)
    view = np.stack([np.sqrt(1 - cosine**2), 0 * cosine, cosine]).astype(np.float32)
    normal = np.repeat(np.array([[0], [0], [1]], np.float32), 64, axis=1)
    uniform = mi.TensorXf(np.array([[0, 0, 1, 1e-3, 1, 1, 1]], np.float32))
    _, specular = shade_tensor(
        mi.TensorXf(normal), mi.TensorXf(view), mi.Float(specular_albedo), mi.Float(roughness), uniform
    )
    return _CLOSED_FORM_ERROR * float(specular.numpy().max())


def _specular_term(scene: _Estimates) -> Decision:
    avatar = scene.avatar
    bounds = radiance_bounds(scene.lobes, avatar.roughness, avatar.k_s, 0.0, scene.reflectance)
    most = float(bounds.sum()) * scene.bounces
    reason = "k_s is 0" if avatar.k_s == 0 else f"it may add {most / scene.white:.1e} of white"
    return Decision(
        "specular term", _PICTURE, most <= scene.limit, reason, most / scene.white, changes={"specular": False}
    )


def _weak_lobes(scene: _Estimates) -> Decision:
    avatar, albedo = scene.avatar, float(scene.points.albedo.max())
    bounds = scene.bounces * radiance_bounds(scene.lobes, avatar.roughness, avatar.k_s, albedo, scene.reflectance)
    kept = select_lobes(bounds, scene.limit)
    weak = np.setdiff1d(np.arange(len(bounds)), kept)
    reason = f"{len(weak)} of {len(bounds)} are too weak to matter together"
    changes = {"kept_lobes": tuple(int(k) for k in kept)}
    bound = float(bounds[weak].sum()) / scene.white
    return Decision("weak lobes", _PICTURE, len(weak) > 0, reason, bound, changes=changes)


def _late_bounces(scene: _Estimates) -> Decision:
    avatar, points = scene.avatar, scene.points
    tails = []
    for yaw in scene.yaws:
        seen = find_visible(scene.shape, points, orbit(scene.subject.camera, yaw).centre)
        parts = reflect_bounces(points, scene.lobes_at(yaw), avatar.roughness, avatar.k_s, scene.reflectance)
        largest = [float(part[seen].max()) if len(seen) else 0.0 for part in parts]
        tails.append(_MARGIN * np.cumsum(largest[::-1])[::-1])
    tail = np.max(tails, axis=0)  # tail[n]: of light that was reflected more than n times before
    enough = np.flatnonzero(tail[:-1] <= scene.limit)
    if not len(enough):
        reason = f"{len(tail) - 1} of them still add {tail[-1] / scene.white:.1e} of white"
        return Decision("late bounces", _PICTURE, False, reason)
    count = int(enough[0])
    reason = f"light that is reflected more than {count} times before it reaches a visible point"
    # Mitsuba counts the path from the camera to a surface to the light as depth 2.
    changes = {"max_depth": count + 2}
    return Decision("late bounces", _PICTURE, True, reason, float(tail[count]) / scene.white, changes=changes)


def _networks(scene: _Estimates) -> Decision:
    avatar = scene.avatar
    diffuse, specular = baking_error(scene.shape)
    glossy = radiance_bounds(scene.lobes, avatar.roughness, avatar.k_s, 0.0, 1.0).sum() / scene.white
    reason = f"albedos between vertices are up to {diffuse:.1e} off; --exact evaluates them"
    bound = scene.bounces * float(diffuse + specular * glossy)
    return Decision("networks at every hit", _PICTURE, True, reason, bound, changes={"exact": False})


def _visibility(scene: _Estimates) -> Decision:
    avatar, worst = scene.avatar, 0.0
    for yaw in scene.yaws:
        centre = orbit(scene.subject.camera, yaw).centre
        seen = scene.points.at(find_visible(scene.shape, scene.points, centre))
        error = shadow_error(scene.shape, seen, centre, scene.lobes_at(yaw), avatar.roughness, avatar.k_s)
        worst = max(worst, _MARGIN * error)
        if worst > scene.limit:
            break
    reason = f"the head's own shadows change visible points by {worst / scene.white:.1e} of white"
    changes = {"visibility": False}
    return Decision("visibility", _PICTURE, worst <= scene.limit, reason, worst / scene.white, changes=changes)


def _shadings(scene: _Estimates) -> Decision:
    avatar, worst = scene.avatar, 0.0
    for yaw in scene.yaws:
        camera = orbit(scene.subject.camera, yaw)
        footprint = np.linalg.norm(camera.centre - scene.shape.vertices().mean(axis=1)) / camera.K[0, 0]
        reach = min(REACH, 2 * footprint)
        error = sharing_error(scene.shape, camera.centre, scene.lobes_at(yaw), avatar.roughness, avatar.k_s, reach)
        worst = max(worst, error)
        if worst > scene.limit:
            break
    reason = f"radiance within a pixel differs by up to {worst / scene.white:.1e} of white"
    changes = {"shared": True}
    return Decision(
        "a shading for every sample", _PICTURE, worst <= scene.limit, reason, worst / scene.white, changes=changes
    )


def _crop(subject: Subject, shape: NeuralSDF, yaws: Sequence[float]) -> Decision:
    shares = []
    for yaw in yaws:
        _, _, width, height = head_window(shape, orbit(subject.camera, yaw))
        shares.append(width * height / (subject.camera.width * subject.camera.height))
    reason = f"the head's rectangle is {100 * float(np.mean(shares)):.0f} % of the picture"
    return Decision("pixels beside the head", _PICTURE, True, reason, changes={"crop": True})
