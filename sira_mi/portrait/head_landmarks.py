"""Corrects the landmarks of the network to the positions of the head's landmarks in the photo, hidden ones included.

The network places the far side of a turned face too near, and its landmarks are not exactly the points that the prior's
heads use. This error depends on the viewing direction, so the correction is a polynomial of that direction. The
coefficients come from portraits of heads with known landmarks (`python -m studies.portraits landmarks`). Coordinates of
the face's shape explain a little more of the error on those heads (`docs/notebook/portraits.md`), but rendered heads do
not smile, and the correction of a smile was wrong."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load_file, save

from sira_mi.conventions import LANDMARKS
from sira_mi.errors import InputError
from sira_mi.files import write_through
from sira_mi.portrait.face import Face
from sira_mi.portrait.landmarks import RIGID

CORRECTION = Path(__file__).parent / "models" / "head_landmarks.safetensors"
TERMS = 7  # of the polynomial


@dataclass(frozen=True, eq=False)
class LandmarkCorrection:
    """The offset of a face's landmarks by viewing direction."""

    mean: np.ndarray  # [468, 3] the network's mean face, seen from the front
    reach: np.ndarray  # [2] largest measured yaw and pitch, radians; beyond them the offset is constant
    offsets: np.ndarray  # [7, 468, 2] by `evaluate_polynomial`, in face sizes, along the axes of the upright face

    def save(self, path: Path) -> None:
        """Raises InputError when the file cannot be written."""
        arrays = {name: np.ascontiguousarray(values, np.float32) for name, values in vars(self).items()}
        write_through(path, lambda file: file.write_bytes(save(arrays)))

    @staticmethod
    def load(path: Path) -> LandmarkCorrection:
        """Raises InputError for a file that is missing or damaged."""
        shapes = {"mean": (LANDMARKS, 3), "reach": (2,), "offsets": (TERMS, LANDMARKS, 2)}
        try:
            arrays = load_file(path)
            for name, shape in shapes.items():
                if arrays[name].shape != shape or not np.isfinite(arrays[name]).all():
                    raise ValueError(f"{name} is not finite numbers {list(shape)}")
            return LandmarkCorrection(**{name: arrays[name].astype(np.float64) for name in shapes})
        except (OSError, KeyError, ValueError, TypeError, SafetensorError) as error:
            raise InputError(f"{path} is missing or damaged ({error}): install the package again") from error


@lru_cache(maxsize=1)
def load_shipped_correction() -> LandmarkCorrection:
    """Raises InputError when the package's file is missing or damaged."""
    return LandmarkCorrection.load(CORRECTION)


def correct_landmarks(face: Face, correction: LandmarkCorrection | None = None) -> np.ndarray:
    """Positions of the head's landmarks [468, 2], in the pixels of `face`; by the shipped correction unless another is
    given."""
    correction = correction or load_shipped_correction()
    terms = evaluate_polynomial(
        np.clip(find_view_direction(face, correction.mean), -correction.reach, correction.reach)
    )
    offset = np.tensordot(terms, correction.offsets, axes=1)
    return face.landmarks + face.size * offset @ find_upright_axes(face)


def evaluate_polynomial(direction: np.ndarray) -> np.ndarray:
    """The terms [..., 7] of yaw and pitch [..., 2]: second order, and yaw |yaw| for the hidden far side of a face."""
    yaw, pitch = direction[..., 0], direction[..., 1]
    return np.stack([np.ones_like(yaw), yaw, pitch, yaw**2, yaw * pitch, pitch**2, yaw * np.abs(yaw)], axis=-1)


def find_view_direction(face: Face, mean: np.ndarray) -> np.ndarray:
    """Yaw and pitch [2] of the viewing direction in the frame of the `mean` face [468, 3], radians, from the rigid
    parts of the face. They do not depend on the roll of the photo."""
    x, y, z = find_rotation(face, mean)[:, 2]
    return np.array([np.arctan2(x, z), np.arcsin(np.clip(y, -1, 1))])


def find_upright_axes(face: Face) -> np.ndarray:
    """The directions in the photo [2, 2] of the upright face's x axis, along its eyes, and y axis, as rows."""
    cosine, sine = np.cos(np.radians(face.roll)), np.sin(np.radians(face.roll))
    return np.array([[cosine, sine], [-sine, cosine]])


def find_rotation(face: Face, mean: np.ndarray) -> np.ndarray:
    """[3, 3] from the photo's axes to those of the mean face: least squares over the rigid parts."""
    rigid = list(RIGID)
    points = np.column_stack([face.landmarks, face.depth])[rigid]
    target = mean[rigid]
    u, _, v = np.linalg.svd((target - target.mean(axis=0)).T @ (points - points.mean(axis=0)))
    return u * np.array([1.0, 1.0, np.sign(np.linalg.det(u @ v))]) @ v
