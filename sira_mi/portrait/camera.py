"""Pinhole cameras in OpenCV's convention, their JSON form, and pose and focal length from facial landmarks."""

import json
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from scipy.optimize import least_squares

from sira_mi.conventions import LANDMARKS, LEAST_LANDMARKS, MILLIMETRES_PER_UNIT
from sira_mi.errors import InputError
from sira_mi.files import parse_json
from sira_mi.portrait.landmarks import BROWS, JAW, MOUTH, OVAL, RIGID

_FILM_DIAGONAL = 43.2666  # mm, of the 36 mm x 24 mm frame that EXIF's 35 mm focal length refers to

# Prior on the distance from the camera to the head's origin when the focal length is unknown: a log-normal.
_MEDIAN_DISTANCE = 1200.0 / MILLIMETRES_PER_UNIT
_SPREAD_DISTANCE = 0.5  # standard deviation of the logarithm

# The landmarks of the mean head differ from this person's by one or two hundredths of the face's height. Neighbours
# have similar errors, so all landmarks together count as this many independent ones.
_LANDMARK_ERROR = 0.015  # of the face's height
_INDEPENDENT_LANDMARKS = 30.0


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera without lens distortion: x right, y down, z forward; world units as in
    `sira_mi.conventions`; pixel centres at half-integers."""

    K: np.ndarray  # [3, 3] float64, pixels
    world_to_camera: np.ndarray  # [4, 4] float64, rigid
    width: int  # pixels
    height: int  # pixels

    def project(self, points: np.ndarray) -> np.ndarray:
        """World points `[..., 3]` to pixel positions `[..., 2]`; points behind the camera give NaN."""
        local = np.asarray(points, np.float64) @ self.world_to_camera[:3, :3].T + self.world_to_camera[:3, 3]
        image = local @ self.K.T
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(local[..., 2:] > 0, image[..., :2] / image[..., 2:], np.nan)

    @property
    def centre(self) -> np.ndarray:
        """Position of the camera, `[3]` in world units."""
        return -self.world_to_camera[:3, :3].T @ self.world_to_camera[:3, 3]

    def scale(self, sx: float, sy: float, width: int | None = None, height: int | None = None) -> "Camera":
        """The camera of the image resampled by `sx` and `sy`; its size is rounded unless it is given."""
        return Camera(
            np.diag([sx, sy, 1.0]) @ self.K,
            self.world_to_camera,
            max(1, round(self.width * sx)) if width is None else width,
            max(1, round(self.height * sy)) if height is None else height,
        )

    def crop(self, x0: float, y0: float, width: int, height: int) -> "Camera":
        """The camera of the window that starts at pixel position (x0, y0)."""
        shift = np.array([[1.0, 0.0, -x0], [0.0, 1.0, -y0], [0.0, 0.0, 1.0]])
        return Camera(shift @ self.K, self.world_to_camera, width, height)

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers and lists under the keys `K`, `world_to_camera`, `width` and `height`."""
        return {
            "K": self.K.tolist(),
            "world_to_camera": self.world_to_camera.tolist(),
            "width": self.width,
            "height": self.height,
        }

    def to_json(self) -> str:
        """The text of a camera file, which `from_json` reads back to the same bits."""
        return json.dumps(self.to_dict(), indent=2)

    @staticmethod
    def from_json(text: str, source: str = "camera", size: tuple[int, int] | None = None) -> "Camera":
        """Reads a camera file's text. `source` names it in messages; `size` is the photo's (width, height).

        Raises `InputError` that names the first defect found.
        """
        return Camera.from_dict(parse_json(text, source), source, size)

    @staticmethod
    def from_dict(data: Any, source: str = "camera", size: tuple[int, int] | None = None) -> "Camera":
        """Checks what `to_dict` gives. Raises `InputError` that names the first defect found."""
        if not isinstance(data, dict):
            raise InputError(f"{source}: expected an object with K, world_to_camera, width and height")
        K = _matrix(data, "K", 3, source)
        pose = _matrix(data, "world_to_camera", 4, source)
        width, height = (_positive_integer(data, key, source) for key in ("width", "height"))
        if not (K[0, 0] > 0 and K[1, 1] > 0):
            raise InputError(f"{source}: focal lengths K[0][0] and K[1][1] must be positive")
        if not np.allclose(K[2], (0, 0, 1)) or K[1, 0] != 0:
            raise InputError(f"{source}: K must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]")
        if abs(K[0, 1]) > 1e-6 * K[0, 0]:
            raise InputError(f"{source}: K has skew (K[0][1] is not 0), which is not supported")
        rotation = pose[:3, :3]
        if not np.allclose(pose[3], (0, 0, 0, 1)):
            raise InputError(f"{source}: the last row of world_to_camera must be [0, 0, 0, 1]")
        if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-3:
            raise InputError(f"{source}: the rotation in world_to_camera is not orthonormal (no scale, no shear)")
        if np.linalg.det(rotation) < 0:
            raise InputError(f"{source}: the rotation in world_to_camera mirrors (its determinant is -1)")
        if size is not None and (width, height) != tuple(size):
            raise InputError(
                f"{source} is for {width}x{height} pixels but the photo is {size[0]}x{size[1]} (as seen upright)"
            )
        return Camera(K, pose, width, height)


def convert_exif_focal(focal_35mm: float, width: int, height: int) -> float:
    """A focal length on 35 mm film (mm, equal diagonals) in pixels of an image of that size."""
    return focal_35mm * float(np.hypot(width, height)) / _FILM_DIAGONAL


def weigh_landmarks(count: int) -> np.ndarray:
    """Weights `[count]` of the landmarks for the pose: high on rigid parts, low where expressions move the face.

    A number of landmarks other than `LANDMARKS` is weighted evenly."""
    weights = np.ones(count)
    if count == LANDMARKS:
        weights[:] = 0.3
        for group, weight in ((BROWS, 0.6), (OVAL, 0.25), (JAW, 0.08), (MOUTH, 0.08), (RIGID, 3.0)):
            weights[list(group)] = weight
    return weights


def estimate_camera(
    landmarks: np.ndarray,
    head_landmarks: np.ndarray,
    width: int,
    height: int,
    focal_35mm: float | None = None,
) -> Camera:
    """Pose, and the focal length unless EXIF gives it, that bring a head's landmarks `[L, 3]` (world units) onto
    `landmarks` `[L, 2]` (pixels). Rows with NaN on either side are left out.

    Square pixels, principal point in the image's middle. Robust Levenberg-Marquardt-type least squares (soft L1)
    from an EPnP start; one face determines focal length and distance together only weakly, so an unknown focal
    length comes with a log-normal prior on the distance. Raises `ValueError` for fewer usable landmarks than
    `LEAST_LANDMARKS`.
    """
    landmarks, head_landmarks = np.asarray(landmarks, np.float64), np.asarray(head_landmarks, np.float64)
    usable = np.isfinite(landmarks).all(axis=1) & np.isfinite(head_landmarks).all(axis=1)
    if usable.sum() < LEAST_LANDMARKS:
        raise ValueError(f"{usable.sum()} landmarks are known on both sides: {LEAST_LANDMARKS} are needed")
    weights = weigh_landmarks(len(landmarks))[usable]
    points, pixels = head_landmarks[usable], landmarks[usable]
    known_focal = None if focal_35mm is None else convert_exif_focal(focal_35mm, width, height)
    focal = known_focal or _focal_at_distance(points, pixels, _MEDIAN_DISTANCE)
    rotation, translation = _initial_pose(points, pixels, focal, width, height)

    face_height = float(np.ptp(pixels, axis=0).max())
    sigma = _LANDMARK_ERROR * face_height
    scale = np.sqrt(_INDEPENDENT_LANDMARKS * weights / weights.sum())[:, None] / sigma
    middle = np.array([width / 2, height / 2])

    def residuals(x: np.ndarray) -> np.ndarray:
        local = points @ cv2.Rodrigues(x[:3])[0].T + x[3:6]
        f = known_focal or np.exp(x[6])
        errors = ((f * local[:, :2] / np.maximum(local[:, 2:], 1e-3) + middle - pixels) * scale).ravel()
        if known_focal:
            return errors
        distance = np.linalg.norm(x[3:6])
        return np.append(errors, np.log(distance / _MEDIAN_DISTANCE) / _SPREAD_DISTANCE)

    start = np.concatenate([rotation, translation] if known_focal else [rotation, translation, [np.log(focal)]])
    fit = least_squares(residuals, start, loss="soft_l1", x_scale="jac", xtol=1e-12, ftol=1e-12, gtol=1e-12)
    f = known_focal or float(np.exp(fit.x[6]))
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(fit.x[:3])[0], fit.x[3:6]
    return Camera(np.array([[f, 0, width / 2], [0, f, height / 2], [0, 0, 1.0]]), pose, width, height)


def measure_reprojection_error(camera: Camera, landmarks: np.ndarray, head_landmarks: np.ndarray) -> float:
    """Weighted root mean square distance, in pixels, between `landmarks` `[L, 2]` and the projected `head_landmarks`
    `[L, 3]`; infinite when some lie behind the camera, NaN when no landmark is known on both sides."""
    usable = np.isfinite(landmarks).all(axis=1) & np.isfinite(head_landmarks).all(axis=1)
    if not usable.any():
        return float("nan")
    squared = ((camera.project(head_landmarks[usable]) - landmarks[usable]) ** 2).sum(axis=1)
    weights = weigh_landmarks(len(landmarks))[usable]
    return float("inf") if np.isnan(squared).any() else float(np.sqrt((weights * squared).sum() / weights.sum()))


def _focal_at_distance(points: np.ndarray, pixels: np.ndarray, distance: float) -> float:
    """The focal length that shows the head at its size in the photo from that distance."""
    spread = np.sqrt(((points - points.mean(axis=0)) ** 2).sum(axis=1).mean() * 2 / 3)
    return distance * float(np.sqrt(((pixels - pixels.mean(axis=0)) ** 2).sum(axis=1).mean()) / spread)


def _initial_pose(
    points: np.ndarray, pixels: np.ndarray, focal: float, width: int, height: int
) -> tuple[np.ndarray, np.ndarray]:
    """Rotation vector and translation, each `[3]`, of the best of several solvers with the head before the camera."""
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
    best, best_error = None, float("inf")
    for method in (cv2.SOLVEPNP_SQPNP, cv2.SOLVEPNP_EPNP):
        found, rotation, translation = cv2.solvePnP(points, pixels, K, None, flags=method)
        if not found or not np.isfinite(translation).all():
            continue
        depth = (points @ cv2.Rodrigues(rotation)[0].T + translation.ravel())[:, 2]
        error = float(np.linalg.norm(cv2.projectPoints(points, rotation, translation, K, None)[0][:, 0] - pixels))
        if depth.min() > 0 and error < best_error:
            best, best_error = (rotation.ravel(), translation.ravel()), error
    if best is not None:
        return best
    frontal = np.diag([1.0, -1.0, -1.0])
    offset = (pixels.mean(axis=0) - [width / 2, height / 2]) / focal * _MEDIAN_DISTANCE
    return cv2.Rodrigues(frontal)[0].ravel(), np.array([*offset, _MEDIAN_DISTANCE])


def yaw_rotation(degrees: float) -> np.ndarray:
    """Rotation [3, 3] about the world's y axis; a positive one turns a face along +z towards +x."""
    angle = np.radians(degrees)
    return np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])


def _matrix(data: dict, key: str, side: int, source: str) -> np.ndarray:
    try:
        matrix = np.array(data[key], np.float64)
    except KeyError:
        raise InputError(f"{source}: {key} is missing") from None
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"{source}: {key} must be {side}x{side} numbers") from None
    if matrix.shape != (side, side):
        raise InputError(f"{source}: {key} must be {side}x{side} numbers")
    if not np.isfinite(matrix).all():
        raise InputError(f"{source}: {key} contains NaN or infinity")
    return matrix


def _positive_integer(data: dict, key: str, source: str) -> int:
    value = data.get(key)
    if isinstance(value, bool) or not isinstance(value, int | float) or value != value // 1 or value < 1:
        raise InputError(f"{source}: {key} must be a positive whole number of pixels")
    return int(value)
