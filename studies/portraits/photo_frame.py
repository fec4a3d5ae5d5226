"""Where the pictures of a fit lie in its photo, of which a fit may see a reduced part."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sira_mi.errors import InputError
from sira_mi.files import read_json
from sira_mi.portrait.camera import Camera
from sira_mi.portrait.portrait import area_resample

_LARGEST_REPORT = 16 << 20  # bytes


@dataclass(frozen=True, eq=False)
class PhotoFrame:
    """The image that a fit saw."""

    camera: Camera  # of that image
    window: tuple[float, ...]  # x0, y0, x1, y1: where it lies in the photo, the photo's pixels

    @property
    def longer_side(self) -> int:
        """Of the image at the photo's resolution, pixels."""
        x0, y0, x1, y1 = self.window
        return round(max(x1 - x0, y1 - y0))

    def camera_of_photo(self, width: int, height: int) -> Camera:
        """The camera of the whole photo."""
        x0, y0, x1, y1 = self.window
        camera = self.camera.scale((x1 - x0) / self.camera.width, (y1 - y0) / self.camera.height)
        return camera.crop(-x0, -y0, width, height)

    def lay_on_photo(self, picture: np.ndarray, width: int, height: int) -> np.ndarray:
        """A picture [h, w, ...] of the image's frame at the pixels of the photo [height, width, ...], by the areas that
        they share; 0 outside of it."""
        x0, y0, x1, y1 = self.window
        scale = (x1 - x0) / picture.shape[1], (y1 - y0) / picture.shape[0]
        placed = area_resample(picture, (-x0 / scale[0], -y0 / scale[1]), scale, (width, height))
        row, column = np.arange(height) + 0.5, np.arange(width) + 0.5
        outside = ((row < y0) | (row > y1))[:, None] | ((column < x0) | (column > x1))
        placed[outside] = 0
        return placed


def read_frame(avatar: Path) -> PhotoFrame:
    """The frame of a fit by its `avatar.json`. Raises InputError when that does not say it."""
    path = avatar / "avatar.json"
    report = read_json(path, "report of a fit", _LARGEST_REPORT)
    try:
        x0, y0, x1, y1 = (float(edge) for edge in report["window"])
        camera = Camera.from_dict(report["camera"], f"the camera in {path}")
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{path} does not say where its picture lies in the photo ({error}); fit the photo again"
        ) from error
    return PhotoFrame(camera, (x0, y0, x1, y1))
