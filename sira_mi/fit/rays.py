"""The pixels of a geometry step: an evenly spaced grid over a window of the photo, shifted at random."""

from dataclasses import dataclass

import numpy as np

from sira_mi.conventions import DOMAIN_LOWER, DOMAIN_UPPER
from sira_mi.portrait.camera import Camera


@dataclass(frozen=True)
class Window:
    """A square of `size` × `size` pixels, `stride` photo pixels apart, from (left, top) in the photo."""

    left: int
    top: int
    stride: int
    size: int


def window_around(x0: float, y0: float, x1: float, y1: float, size: int) -> Window:
    """The window whose grid covers the rectangle, centred on it."""
    stride = max(1, int(np.ceil(max(x1 - x0, y1 - y0) / size)))
    side = stride * size
    return Window(round((x0 + x1 - side) / 2), round((y0 + y1 - side) / 2), stride, size)


def window_pixels(window: Window, shift: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Photo columns and rows [size, size] of the window's pixels, `shift` pixels into each stride; they may lie outside
    the photo."""
    steps = np.arange(window.size) * window.stride
    columns, rows = np.meshgrid(window.left + shift[0] + steps, window.top + shift[1] + steps)
    return columns, rows


def pixel_rays(camera: Camera, columns: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Ray origins and unit directions [..., 3] through pixel centres."""
    pixel = np.stack([columns + 0.5, rows + 0.5, np.ones(np.shape(columns))], axis=-1)
    rotation = camera.world_to_camera[:3, :3]
    direction = pixel @ np.linalg.inv(camera.K).T @ rotation
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    return np.broadcast_to(camera.centre, direction.shape), direction


def find_modelled_pixels(camera: Camera) -> np.ndarray:
    """[H, W] bool: pixels whose ray crosses the domain box and does not leave it through its floor, below which a
    photo may show a body that the model does not have."""
    columns, rows = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    origin, direction = pixel_rays(camera, columns, rows)
    with np.errstate(divide="ignore"):
        a, b = (np.array(DOMAIN_LOWER) - origin) / direction, (np.array(DOMAIN_UPPER) - origin) / direction
    near, far = np.minimum(a, b).max(axis=-1), np.maximum(a, b)
    through_floor = (far.argmin(axis=-1) == 1) & (direction[..., 1] < 0)
    return (far.min(axis=-1) > np.maximum(near, 0)) & ~through_floor
