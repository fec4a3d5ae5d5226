"""The input of relighting: an avatar, the camera of its photo, and a light."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path

import mitsuba as mi
import numpy as np

from sira_mi.avatar.file import Avatar, load_avatar
from sira_mi.errors import InputError
from sira_mi.files import read_json
from sira_mi.portrait.camera import Camera
from sira_mi.sg.fit_environment import EnvironmentFit, fit_environment
from sira_mi.sg.lights_io import check_lobes, read_environment, read_lights

# Head and shoulders from the front, 1.2 m away: the camera of an avatar without a report.
PORTRAIT_CAMERA = Camera(
    K=np.array([[1317.0, 0.0, 256.0], [0.0, 1317.0, 256.0], [0.0, 0.0, 1.0]]),
    world_to_camera=np.array([[1.0, 0, 0, 0], [0, -1, 0, -0.4], [0, 0, -1, 12], [0, 0, 0, 1]]),
    width=512,
    height=512,
)
# The frame of a picture of the head: a square around this point of the world, which reaches the top of the domain.
_HEAD_CENTRE, _HEAD_HALF_SIDE = np.array([0.0, -0.2, 0.0]), 2.2
_MAXIMUM_REPORT_BYTES = 16 << 20


@dataclass(frozen=True, eq=False)
class Subject:
    """An avatar file and a camera."""

    path: Path
    avatar: Avatar
    camera: Camera

    def resize(self, size: int) -> Subject:
        """The same in a picture whose longer side has `size` pixels."""
        longer = max(self.camera.width, self.camera.height)
        width, height = (max(1, round(side * size / longer)) for side in (self.camera.width, self.camera.height))
        return replace(
            self,
            camera=self.camera.scale(width / self.camera.width, height / self.camera.height, width, height),
        )

    def frame_head(self) -> Subject:
        """The same with a square frame around the head, as large as the longer side of the photo's; the camera keeps
        its place and direction.

        Raises InputError when the camera is too close to the head for that."""
        camera = self.camera
        size = max(camera.width, camera.height)
        depth = float(camera.world_to_camera[2, :3] @ _HEAD_CENTRE + camera.world_to_camera[2, 3])
        if depth <= _HEAD_HALF_SIDE:
            raise InputError(f"{self.path}: the camera of its photo is not before the head; give --view photo")
        side = 2 * _HEAD_HALF_SIDE * camera.K[0, 0] / depth
        x, y = camera.project(_HEAD_CENTRE) - side / 2
        window = camera.crop(x, y, size, size)
        return replace(self, camera=window.scale(size / side, size / side, size, size))


@dataclass(frozen=True, eq=False)
class Light:
    """An environment: `lobes` [N_l, 7], an `image` [H, W, 3] of linear radiance, or an image and the lobes fitted to
    it."""

    lobes: np.ndarray | None
    image: np.ndarray | None = None

    def select(self, numbers: tuple[int, ...] | None) -> Light:
        """The light of the lobes with these numbers; None for all."""
        return self if numbers is None or self.lobes is None else Light(self.lobes[list(numbers)], self.image)

    def emitter(self, rotation: np.ndarray) -> dict:
        """The emitter for `mi.load_dict`, turned by `rotation` [3, 3]: `envmap` of the image if there is one, else
        `sg_envmap`."""
        if self.image is not None:
            to_world = np.eye(4)
            to_world[:3, :3] = rotation
            transform = mi.ScalarTransform4f(to_world.tolist())
            return {"type": "envmap", "bitmap": mi.Bitmap(self.image), "to_world": transform}
        if self.lobes is None:
            raise ValueError("a light has lobes or an image")
        lobes = self.lobes.copy()
        lobes[:, :3] = lobes[:, :3] @ rotation.T
        return {"type": "sg_envmap", "lobes": mi.TensorXf(lobes)}


def read_subject(path: Path, size: int | None = None) -> Subject:
    """The avatar of a fit's output folder or of an `avatar.safetensors`, and the camera in the `avatar.json` beside it,
    or else `PORTRAIT_CAMERA`; scaled so that its longer side has `size` pixels.

    Raises InputError for a file that is missing, damaged or of another kind."""
    file = path
    if os.path.isdir(path):  # other than Path.is_dir, False for a name that is too long
        file = path / "avatar.safetensors"
        if not file.exists():
            raise InputError(f"{path} holds no avatar.safetensors; give the output folder of a fit")
    avatar = load_avatar(file)
    report = file.with_name("avatar.json")
    subject = Subject(file, avatar, _read_camera(report) if report.exists() else PORTRAIT_CAMERA)
    return subject if size is None else subject.resize(size)


def _read_camera(report: Path) -> Camera:
    data = read_json(report, "report of a fit", _MAXIMUM_REPORT_BYTES)
    if not isinstance(data, dict) or "camera" not in data:
        raise InputError(f"{report} holds no camera; without that file, a portrait camera is used")
    return Camera.from_dict(data["camera"], f"the camera in {report}")


def read_light(path: Path | None, avatar: Avatar, lobes: bool, count: int = EnvironmentFit.lobes) -> Light:
    """The light of a `.json` or `.exr` file; without one the avatar's own, which was fitted to the photo. With `lobes`,
    an `.exr` is replaced by `count` lobes that are fitted to it.

    Raises InputError for a file that is missing, damaged or of another kind."""
    if path is None:
        return Light(check_lobes(avatar.tensors["lobes"], "the light of the avatar"))
    suffix = path.suffix.lower()
    if suffix == ".json":
        return Light(read_lights(path))
    if suffix != ".exr":
        raise InputError(f"{path}: lights are .json (lobes) or .exr (latitude-longitude environment) files")
    image = read_environment(path)
    return Light(fit_environment(image, EnvironmentFit(lobes=count))) if lobes else Light(None, image)
