"""Renders of a turned head under a fixed light, by the closed form or by path tracing, in bounded memory."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import mitsuba as mi
import numpy as np

from sira_mi.errors import InputError
from sira_mi.fields.extraction import EmptySurfaceError
from sira_mi.portrait.camera import Camera
from sira_mi.relight.subject import Light, Subject
from sira_mi.scene import head, orbited, sensor

# Integrators by the name that the command knows them by.
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

    def pass_samples(self, width: int, height: int) -> list[int]:
        """Samples a pixel of every pass over a picture of that size."""
        most = max(1, _PASS_RAYS // (width * height))
        return [min(most, self.samples - start) for start in range(0, self.samples, most)]


def load_head(subject: Subject, settings: RelightSettings) -> mi.Shape:
    """The subject's head as a Mitsuba shape; one serves any number of scenes.

    Raises InputError when the avatar's field has no surface."""
    description = head(subject.path.absolute(), settings.voxel)
    bsdf = description["bsdf"]
    bsdf["roughness"] = subject.avatar.roughness
    bsdf["k_s"] = subject.avatar.k_s
    if settings.integrator == "path" and not settings.exact:
        for texture in ("diffuse_albedo", "specular_albedo"):
            bsdf[texture]["baked"] = True
    try:
        return mi.load_dict(description)
    except RuntimeError as error:  # Mitsuba's, with the plugin's own as its text
        if EmptySurfaceError.__name__ not in str(error):
            raise
        raise InputError(f"{subject.path}: the field has no surface inside the domain; fit the photo again") from error


def turned_scene(
    shape: mi.Shape, camera: Camera, light: Light, yaw_degrees: float, settings: RelightSettings
) -> mi.Scene:
    """The head turned by `yaw_degrees` to its left about the world's y axis, before a fixed camera, under a fixed
    light. Camera and light are moved about the head instead, which gives the same picture of the same mesh."""
    angle = np.radians(-yaw_degrees)
    back = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": INTEGRATORS[settings.integrator], "hide_emitters": not settings.background},
            "sensor": sensor(orbited(camera, yaw_degrees)),
            "head": shape,
            "light": light.turned(back),
        }
    )


def render_passes(
    scene: mi.Scene, settings: RelightSettings, done: Callable[[int], object] | None = None
) -> np.ndarray:
    """The film's channels [H, W, channels] (float32), averaged over passes that bound the memory. After each pass
    `done` is called with its samples a pixel. The same seed gives the same picture."""
    width, height = scene.sensors()[0].film().size()
    total = 0.0
    for k, samples in enumerate(settings.pass_samples(int(width), int(height))):
        seed = int(np.random.SeedSequence([settings.seed, k]).generate_state(1)[0])
        total = total + samples * mi.render(scene, spp=samples, seed=seed).numpy().astype(np.float64)
        if done is not None:
            done(samples)
    return (total / settings.samples).astype(np.float32)
