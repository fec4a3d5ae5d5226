"""Mitsuba scene descriptions: a camera, a head and its light, as dictionaries for `mi.load_dict`."""

from pathlib import Path
from typing import NamedTuple

import mitsuba as mi
import numpy as np

from sira_mi.fields.columns import to_array
from sira_mi.portrait.camera import Camera, yaw_rotation

# OpenCV's camera looks along +z with x right and y down; Mitsuba's looks along +z with x left and y up.
_OPENCV_TO_MITSUBA = np.diag([-1.0, -1.0, 1.0, 1.0])


class Parameter(NamedTuple):
    """A value that a scene file leaves open, with its default: `mi.load_file(path, NAME=value)`."""

    name: str
    default: bool | int | float | str


def film(width: int | Parameter, height: int | Parameter) -> dict:
    """An RGBA film of float32 with a box filter, so that every sample belongs to one pixel."""
    return {
        "type": "hdrfilm",
        "width": width,
        "height": height,
        "pixel_format": "rgba",
        "component_format": "float32",
        "rfilter": {"type": "box"},
    }


def sensor(camera: Camera, sampler: dict | None = None) -> dict:
    """A perspective sensor that is the OpenCV `camera`; its pixels are square."""
    to_world = np.linalg.inv(camera.world_to_camera) @ _OPENCV_TO_MITSUBA
    return {
        "type": "perspective",
        "fov_axis": "x",
        "fov": float(np.degrees(2 * np.arctan(camera.width / (2 * camera.K[0, 0])))),
        "principal_point_offset_x": float(0.5 - camera.K[0, 2] / camera.width),
        "principal_point_offset_y": float(0.5 - camera.K[1, 2] / camera.height),
        "near_clip": 0.001,
        "far_clip": 1000.0,
        "to_world": mi.ScalarTransform4f(to_world),
        "film": film(camera.width, camera.height),
        "sampler": sampler or {"type": "independent"},
    }


def head(
    avatar: str | Path | Parameter, voxel: float | Parameter = 0.05, baked: bool | Parameter = False, **options
) -> dict:
    """A `neural_sdf` with the neural albedos and the BRDF of an avatar file (empty path: the shipped prior), the
    albedos `baked` at the vertices or evaluated as networks."""
    path = str(avatar) if isinstance(avatar, Path) else avatar
    albedos = {
        f"{kind}_albedo": {"type": "neural_albedo", "avatar": path, "kind": kind, "baked": baked}
        for kind in ("diffuse", "specular")
    }
    return {"type": "neural_sdf", "avatar": path, "voxel": voxel, **options, "bsdf": {"type": "sira_bsdf", **albedos}}


def sg_light(lobes: np.ndarray) -> dict:
    """The light of lobes [N_l, 7]."""
    return {"type": "sg_envmap", "lobes": to_array(lobes)}


def head_scene(integrator: dict, sensor: dict, head: dict | mi.Object, light: dict) -> dict:
    """A scene of one head; their parameters are known as `head.…` and `light.…`."""
    return {"type": "scene", "integrator": integrator, "sensor": sensor, "head": head, "light": light}


def orbit(camera: Camera, yaw_degrees: float) -> Camera:
    """The camera moved about the world's y axis so that the head appears turned by `yaw_degrees` to its left."""
    turn = np.eye(4)
    turn[:3, :3] = yaw_rotation(yaw_degrees)
    return Camera(camera.K, camera.world_to_camera @ turn, camera.width, camera.height)
