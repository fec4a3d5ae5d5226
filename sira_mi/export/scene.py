"""Mitsuba scene descriptions: a camera, a head and its light, as dictionaries for `mi.load_dict`."""

from pathlib import Path

import mitsuba as mi
import numpy as np

from sira_mi.portrait.camera import Camera, yaw_rotation

# OpenCV's camera looks along +z with x right and y down; Mitsuba's looks along +z with x left and y up.
_OPENCV_TO_MITSUBA = np.diag([-1.0, -1.0, 1.0, 1.0])


def film(width: int, height: int) -> dict:
    """An RGBA film of float32 with a box filter, so that every sample belongs to one pixel."""
    return {
        "type": "hdrfilm",
        "width": width,
        "height": height,
        "pixel_format": "rgba",
        "component_format": "float32",
        "rfilter": {"type": "box"},
    }


def principal_point_offset(camera: Camera) -> tuple[float, float]:
    """Mitsuba's offset of the film's centre from the principal point, in film sizes."""
    k = camera.K
    return float(0.5 - k[0, 2] / camera.width), float(0.5 - k[1, 2] / camera.height)


def sensor(camera: Camera, sampler: dict | None = None) -> dict:
    """A perspective sensor that is the OpenCV `camera`; its pixels are square."""
    to_world = np.linalg.inv(camera.world_to_camera) @ _OPENCV_TO_MITSUBA
    x, y = principal_point_offset(camera)
    return {
        "type": "perspective",
        "fov_axis": "x",
        "fov": float(np.degrees(2 * np.arctan(camera.width / (2 * camera.K[0, 0])))),
        "principal_point_offset_x": x,
        "principal_point_offset_y": y,
        "near_clip": 0.001,
        "far_clip": 1000.0,
        "to_world": mi.ScalarTransform4f(to_world),
        "film": film(camera.width, camera.height),
        "sampler": sampler or {"type": "independent"},
    }


def head(avatar: str | Path, voxel: float = 0.05, **options) -> dict:
    """A `neural_sdf` with the neural albedos and the BRDF of an avatar file (empty path: the shipped prior)."""
    path = str(avatar)
    return {
        "type": "neural_sdf",
        "avatar": path,
        "voxel": voxel,
        **options,
        "bsdf": {
            "type": "sira_bsdf",
            "diffuse_albedo": {"type": "neural_albedo", "avatar": path, "kind": "diffuse"},
            "specular_albedo": {"type": "neural_albedo", "avatar": path, "kind": "specular"},
        },
    }


def orbit(camera: Camera, yaw_degrees: float) -> Camera:
    """The camera moved about the world's y axis so that the head appears turned by `yaw_degrees` to its left."""
    turn = np.eye(4)
    turn[:3, :3] = yaw_rotation(yaw_degrees)
    return Camera(camera.K, camera.world_to_camera @ turn, camera.width, camera.height)
