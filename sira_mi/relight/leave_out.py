"""What a relit picture leaves out, decided from the head, its light and its cameras before anything is rendered."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from sira_mi.decisions import Decision, Plan
from sira_mi.export.scene import orbit
from sira_mi.relight.render import RelightSettings, head_window
from sira_mi.relight.subject import Light, Subject
from sira_mi.relight.surface import (
    Surface,
    baking_error,
    bounced_radiance,
    find_visible,
    sample_surface,
    shadow_error,
    sharing_error,
)
from sira_mi.sg.fit_environment import pixel_directions, sphere_integral
from sira_mi.sg.multisampling import REACH
from sira_mi.sg.shading import shade_tensor
from sira_mi.sg.weak_lobes import radiance_bounds, select_lobes, white_radiance

# Largest error of each decision: a thousandth of the radiance of a white diffuse surface that faces the light best, a
# ninth of the step of an 8-bit sRGB picture near white and three steps at black.
TOLERANCE = 1e-3
# For what lies between the points at which an estimate was made.
_MARGIN = 2.0
# Of the closed form that the largest specular reflectance is taken from.
_CLOSED_FORM_ERROR = 1.05
# Turned views that the decisions look at, spread over all.
_VIEWS = 8
# Directions of the integrator's shadow rays.
_DIRECTIONS = 64
# Rows and sharpness of the lobes that stand for an image in these estimates.
_IMAGE_ROWS, _IMAGE_SHARPNESS = 8, 64.0
_PICTURE = "picture"


def plan_relight(
    subject: Subject,
    light: Light,
    shape,
    settings: RelightSettings,
    yaws: list[float],
    tolerance: float = TOLERANCE,
    exact: bool = False,
) -> Plan:
    """The decisions about pictures of `shape` (of `load_head`) at some `yaws`, degrees, with errors up to `tolerance`
    each. `settings` are those that leave nothing out, which `Plan.apply` changes. Baked albedos, the default of path
    tracing, are a decision whatever their error, unless `exact` ones are asked for."""
    avatar, path = subject.avatar, settings.integrator == "path"
    points = sample_surface(shape)
    lobes = image_lobes(light.image) if light.lobes is None else light.lobes
    white = max(white_radiance(lobes), 1e-30)
    reflectance = largest_reflectance(float(points.specular.max()), avatar.roughness)
    k_s, limit = avatar.k_s, tolerance * white
    again = bounced_radiance(points, None, avatar.roughness, k_s, reflectance)
    total = 1 + float(sum(part.max() for part in again)) if path else 1.0

    views = [yaws[k] for k in np.unique(np.linspace(0, len(yaws) - 1, min(_VIEWS, len(yaws))).round().astype(int))]
    decisions = [_specular_term(lobes, avatar, reflectance, white, total, limit)]
    if light.image is None:
        decisions.append(_weak_lobes(lobes, avatar, reflectance, float(points.albedo.max()), white, total, tolerance))
    decisions.append(Decision("refinement", _PICTURE, avatar.k_r == 0, f"k_r is {avatar.k_r:g}", built_in=True))
    if path:
        decisions += [
            _bounces(shape, points, subject, lobes, reflectance, white, limit, views),
            _networks(shape, lobes, avatar, white, total, exact),
        ]
    else:
        decisions += [
            _visibility(shape, points, subject, lobes, white, limit, views),
            _shadings(shape, subject, lobes, white, limit, settings, views),
            Decision(
                "extra channels", _PICTURE, True, "only the radiance is written", changes={"extra_channels": False}
            ),
        ]
    return Plan((*decisions, _outside(subject, shape, settings, yaws)))


def image_lobes(image: np.ndarray) -> np.ndarray:
    """Lobes [128, 7] of the light of an environment `image` [H, W, 3], one a cell of a coarse grid: near enough for
    estimates."""
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
    amplitude = flux / sphere_integral(np.array(_IMAGE_SHARPNESS))
    return np.column_stack([axis, np.full(len(axis), _IMAGE_SHARPNESS), amplitude]).astype(np.float32)


def largest_reflectance(specular_albedo: float, roughness: float) -> float:
    """The largest share of a light from everywhere that the specular term of `sg.brdf` sends in one direction."""
    cosine = np.linspace(0.005, 1, 64)
    view = np.stack([np.sqrt(1 - cosine**2), 0 * cosine, cosine]).astype(np.float32)
    normal = np.repeat(np.array([[0], [0], [1]], np.float32), 64, axis=1)
    everywhere = np.array([[0, 0, 1, 1e-3, 1, 1, 1]], np.float32)
    arrays = [mi.TensorXf(a) for a in (normal, view)]
    _, specular = shade_tensor(*arrays, mi.Float(specular_albedo), mi.Float(roughness), mi.TensorXf(everywhere))
    return _CLOSED_FORM_ERROR * float(specular.numpy().max())


def _specular_term(lobes, avatar, reflectance, white, total, limit):
    most = float(radiance_bounds(lobes, avatar.roughness, avatar.k_s, 0.0, reflectance).sum()) * total
    few = most <= limit
    reason = "k_s is 0" if avatar.k_s == 0 else f"they may add {most / white:.1e} of white"
    return Decision("specular term", _PICTURE, few, reason, most / white, changes={"specular": False})


def _weak_lobes(lobes, avatar, reflectance, albedo, white, total, tolerance):
    bounds = total * radiance_bounds(lobes, avatar.roughness, avatar.k_s, albedo, reflectance)
    kept = select_lobes(bounds, tolerance * white)
    weak = np.setdiff1d(np.arange(len(lobes)), kept)
    reason = f"{len(weak)} of {len(lobes)} are too weak to matter together"
    changes = {"kept_lobes": tuple(int(k) for k in kept)}
    return Decision("weak lobes", _PICTURE, len(weak) > 0, reason, float(bounds[weak].sum()) / white, changes=changes)


def _lobes_at(lobes: np.ndarray, yaw: float) -> np.ndarray:
    """The light as the head sees it that is turned by `yaw` degrees."""
    angle = np.radians(-yaw)
    back = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    turned = lobes.copy()
    turned[:, :3] = lobes[:, :3] @ back.T
    return turned


def _bounces(shape, points: Surface, subject, lobes, reflectance, white, limit, views):
    avatar = subject.avatar
    tails = []
    for yaw in views:
        seen = find_visible(shape, points, orbit(subject.camera, yaw).centre)
        parts = bounced_radiance(points, _lobes_at(lobes, yaw), avatar.roughness, avatar.k_s, reflectance)
        largest = [float(part[seen].max()) if len(seen) else 0.0 for part in parts]
        tails.append(_MARGIN * np.cumsum(largest[::-1])[::-1])
    tail = np.max(tails, axis=0)  # tail[n]: of light that was reflected more than n times before
    enough = np.flatnonzero(tail[:-1] <= limit)
    if not len(enough):
        return Decision("late bounces", _PICTURE, False, f"{len(tail) - 1} of them still add {tail[-1] / white:.1e}")
    # Camera, surface and light are a path of depth 2.
    count = int(enough[0])
    reason = f"what was reflected more than {count} times before it reaches a seen point"
    bound = float(tail[count]) / white
    return Decision("late bounces", _PICTURE, True, reason, bound, changes={"max_depth": count + 2})


def _networks(shape, lobes, avatar, white, total, exact):
    if exact:
        return Decision("networks at every hit", _PICTURE, False, "asked for by --exact")
    diffuse, specular = baking_error(shape)
    glossy = radiance_bounds(lobes, avatar.roughness, avatar.k_s, 0.0, 1.0).sum() / white
    reason = f"albedos between vertices are up to {diffuse:.1e} off; --exact evaluates them"
    bound = total * float(diffuse + specular * glossy)
    return Decision("networks at every hit", _PICTURE, True, reason, bound, changes={"exact": False})


def _visibility(shape, points, subject, lobes, white, limit, views):
    avatar, worst = subject.avatar, 0.0
    for yaw in views:
        centre = orbit(subject.camera, yaw).centre
        seen = points.at(find_visible(shape, points, centre))
        error = shadow_error(shape, seen, centre, _lobes_at(lobes, yaw), avatar.roughness, avatar.k_s, _DIRECTIONS)
        worst = max(worst, _MARGIN * error)
        if worst > limit:
            break
    reason = f"the head's own shadows change seen points by {worst / white:.1e} of white"
    changes = {"visibility": False}
    return Decision("visibility", _PICTURE, worst <= limit, reason, worst / white, changes=changes)


def _shadings(shape, subject, lobes, white, limit, settings, views):
    name = "a shading for every sample"
    if settings.shared:
        return Decision(name, _PICTURE, True, "asked for by --draft", built_in=True)
    if settings.samples == 1:
        return Decision(name, _PICTURE, False, "there is one sample a pixel")
    avatar, worst = subject.avatar, 0.0
    for yaw in views:
        camera = orbit(subject.camera, yaw)
        footprint = np.linalg.norm(camera.centre - shape.vertices().mean(axis=1)) / camera.K[0, 0]
        reach = min(REACH, 2 * footprint)
        error = sharing_error(
            shape, camera.centre, _lobes_at(lobes, yaw), avatar.roughness, avatar.k_s, _DIRECTIONS, reach
        )
        worst = max(worst, error)
        if worst > limit:
            break
    reason = f"radiance within a pixel differs by up to {worst / white:.1e} of white"
    return Decision(name, _PICTURE, worst <= limit, reason, worst / white, changes={"shared": True})


def _outside(subject, shape, settings, yaws):
    if settings.background:
        return Decision("pixels beside the head", _PICTURE, False, "asked for by --background")
    shares = []
    for yaw in yaws:
        _, _, width, height = head_window(shape, orbit(subject.camera, yaw))
        shares.append(width * height / (subject.camera.width * subject.camera.height))
    reason = f"the head's rectangle is {100 * float(np.mean(shares)):.0f} % of the picture"
    return Decision("pixels beside the head", _PICTURE, True, reason, changes={"crop": True})
