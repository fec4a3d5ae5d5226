"""Renders a turned head under a fixed light, in closed form or by path tracing, in bounded memory."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, cast

import mitsuba as mi
import numpy as np

from sira_mi.colour import linear_to_srgb
from sira_mi.errors import InputError
from sira_mi.export.scene import head, head_scene, orbit, sensor
from sira_mi.fields.extraction import EmptySurfaceError
from sira_mi.files import write_png
from sira_mi.portrait.camera import Camera, yaw_rotation
from sira_mi.relight.subject import Light, Subject

if TYPE_CHECKING:
    from sira_mi.plugins.neural_sdf import NeuralSDF

# Mitsuba's plugin for each name of the command line.
INTEGRATORS = {"sg": "sira_sg", "path": "path"}
# Rays of one pass; a pass has at least one sample a pixel.
_PASS_RAYS = 1 << 20


@dataclass(frozen=True)
class RelightSettings:
    """How a picture is rendered."""

    integrator: str = "path"  # a key of INTEGRATORS
    samples: int = 64  # a pixel
    seed: int = 0
    exact: bool = False  # path tracing evaluates the albedo networks at every hit instead of once a vertex
    background: bool = False  # show the environment behind the head
    voxel: float = 0.03  # of the mesh that is traced, scene units
    specular: bool = True  # k_s r^s
    max_depth: int = -1  # path: edges from the camera to the light; -1 for any number
    visibility: bool = True  # sg: shadows and one bounce
    shared: bool = False  # sg: samples of a pixel that see almost the same place share one shading
    on_mesh: bool = False  # sg: hits, normals and albedos of the mesh instead of the field's
    extra_channels: bool = True  # sg: the channels of `sira_sg` besides the radiance
    kept_lobes: tuple[int, ...] | None = None  # numbers of the lobes that light the head; None for all
    crop: bool = False  # trace only the rectangle of the film that the head is in

    def pass_samples(self, width: int, height: int) -> list[int]:
        """Samples a pixel of every pass over a picture of that size."""
        most = max(1, _PASS_RAYS // (width * height))
        return [min(most, self.samples - start) for start in range(0, self.samples, most)]


def load_head(subject: Subject, settings: RelightSettings) -> NeuralSDF:
    """The subject's head as a Mitsuba shape; one serves any number of scenes.

    Raises InputError when the avatar's field has no surface."""
    baked = settings.on_mesh if settings.integrator == "sg" else not settings.exact
    description = head(subject.path.absolute(), settings.voxel, baked)
    bsdf = description["bsdf"]
    bsdf["roughness"] = subject.avatar.roughness
    bsdf["k_s"] = subject.avatar.k_s if settings.specular else 0.0
    if settings.integrator == "path" and not settings.specular:
        description["bsdf"] = {"type": "diffuse", "reflectance": bsdf["diffuse_albedo"]}
    try:
        return cast("NeuralSDF", mi.load_dict(description))
    except RuntimeError as error:  # Mitsuba's, with the plugin's own as its text
        if EmptySurfaceError.__name__ not in str(error):
            raise
        raise InputError(f"{subject.path}: the field has no surface inside the domain; fit the photo again") from error


def load_scene(
    shape: NeuralSDF, camera: Camera, light: Light, yaw_degrees: float, settings: RelightSettings
) -> mi.Scene:
    """The head turned by `yaw_degrees` to its left about the world's y axis, before a fixed camera and under a fixed
    light. Camera and light are turned about the head instead, which gives the same picture with the same mesh."""
    integrator: dict[str, object] = {
        "type": INTEGRATORS[settings.integrator],
        "hide_emitters": not settings.background,
    }
    if settings.integrator == "path":
        integrator["max_depth"] = settings.max_depth
        light = light.select(settings.kept_lobes)
    else:
        integrator |= {
            "visibility": settings.visibility,
            "aovs": settings.extra_channels,
            "shared": settings.shared,
            "exact": not settings.on_mesh,
        }
        if settings.kept_lobes is not None:
            integrator["shaded_lobes"] = mi.TensorXf(np.array(settings.kept_lobes, np.float32))
    view = orbit(camera, yaw_degrees)
    # Closed forms are smooth; evenly spread samples are best for their outlines.
    eye = sensor(view, {"type": "independent" if settings.integrator == "path" else "multijitter"})
    if settings.crop:
        names = ("crop_offset_x", "crop_offset_y", "crop_width", "crop_height")
        eye["film"] |= dict(zip(names, head_window(shape, view), strict=True))
    emitter = light.emitter(yaw_rotation(-yaw_degrees))
    return cast(mi.Scene, mi.load_dict(head_scene(integrator, eye, shape, emitter)))


def head_window(shape: NeuralSDF, camera: Camera) -> tuple[int, int, int, int]:
    """The rectangle (x, y, width, height) of the film, in pixels, outside of which no ray meets the mesh of a
    `neural_sdf`. It is the whole film if a vertex lies beside or behind the camera."""
    vertices = shape.vertices()
    place = camera.K @ (camera.world_to_camera[:3, :3] @ vertices + camera.world_to_camera[:3, 3:])
    if place[2].min() <= 1e-3:
        return 0, 0, camera.width, camera.height
    pixels = place[:2] / place[2]
    size = np.array([camera.width, camera.height])
    low = np.clip(np.floor(pixels.min(axis=1)) - 1, 0, size - 1).astype(int)
    high = np.clip(np.ceil(pixels.max(axis=1)) + 1, low + 1, size).astype(int)
    return int(low[0]), int(low[1]), int(high[0] - low[0]), int(high[1] - low[1])


def render_passes(
    scene: mi.Scene, settings: RelightSettings, done: Callable[[int], object] | None = None
) -> np.ndarray:
    """The film's channels [H, W, channels] (float32), averaged over passes that bound the memory; 0 outside the crop
    window. After each pass `done` is called with its samples a pixel. The same seed gives the same picture."""
    film = scene.sensors()[0].film()
    (width, height), (x, y) = film.crop_size(), film.crop_offset()
    total: np.ndarray = np.zeros((1, 1, 1))
    for k, samples in enumerate(settings.pass_samples(int(width), int(height))):
        seed = mi.UInt32(int(np.random.SeedSequence([settings.seed, k]).generate_state(1)[0]))
        total = total + samples * mi.render(scene, spp=samples, seed=seed).numpy().astype(np.float64)
        if done is not None:
            done(samples)
    columns, rows = film.size()
    picture = np.zeros((int(rows), int(columns), total.shape[2]), np.float32)
    picture[int(y) : int(y + height), int(x) : int(x + width)] = total / settings.samples
    return picture


def head_pixels(picture: np.ndarray, shape: NeuralSDF, camera: Camera) -> np.ndarray:
    """The pixels [N, channels] of a picture [H, W, channels] that vertices of the head are projected to."""
    position = np.floor(camera.project(shape.vertices().T))
    inside = ((position >= 0) & (position < (camera.width, camera.height))).all(axis=1)
    column, row = np.unique(position[inside].astype(int), axis=0).T
    return picture[row, column]


def with_ending(stem: Path, ending: str) -> Path:
    """The path of an image file whose name without its ending is that of `stem`."""
    return stem.with_name(stem.name + ending)


def write_preview(stem: Path, radiance: np.ndarray, exposure: float) -> None:
    """`stem`.png in sRGB of linear radiance [H, W, 3], 2**exposure times as bright."""
    write_png(with_ending(stem, ".png"), linear_to_srgb(np.clip(radiance * 2.0**exposure, 0, 1)))
