"""Faces in a photo: detection at several scales and 468 landmarks each, with the networks in `models/`.

The detector is BlazeFace (Bazarevsky et al. 2019, short range) and the landmark network is Face Mesh (Kartynnik et
al. 2019); `models/NOTICE` names their origin. Images here are sRGB-coded uint8 `[H, W, 3]`, pixel positions have x to
the right, y down, and pixel centres at half-integers.
"""

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np

from sira_mi.conventions import LANDMARKS
from sira_mi.errors import InputError
from sira_mi.portrait.landmarks import EYE_CORNERS

_SMALL_FACE = 64  # pixels; below this height landmarks get coarse
_SMALLEST_FACE = 16  # pixels; anything smaller cannot be told from texture

_MODELS = Path(__file__).parent / "models"
_DETECTOR_SIDE, _LANDMARK_SIDE = 128, 192
_DETECTOR_SCORE = 0.5
_PRESENCE = 0.5
_SURE = 0.95  # a face of less presence may be upside down: the turned crop is tried, and taken above this
_SEARCH_SIDE = 2048  # pixels; longest side of the image that the detector searches
_LANDMARK_MARGIN = 1.5  # side of the landmark crop over the size of the face
_MARGIN_TURN = ((1.5, 0.0), (1.4, -6.0), (1.6, 6.0), (1.4, 6.0), (1.6, -6.0))  # last pass: crop margin, degrees


@dataclass(frozen=True)
class Face:
    landmarks: np.ndarray  # [468, 2] float64, pixels
    depth: np.ndarray  # [468] float64, relative depth in pixels, smaller is nearer to the camera
    presence: float  # the landmark network's confidence that this is a face, 0 to 1

    @property
    def box(self) -> tuple[float, float, float, float]:
        """Left, top, right, bottom of the landmarks, pixels."""
        return (*self.landmarks.min(axis=0), *self.landmarks.max(axis=0))

    @property
    def size(self) -> float:
        """The longer side of `box`, pixels: near the distance from forehead to chin, however the head is rolled."""
        left, top, right, bottom = self.box
        return float(max(right - left, bottom - top))

    @property
    def roll(self) -> float:
        """Degrees by which the line between the eyes is turned clockwise, -180 to 180; 0 of an upright face."""
        return _roll(self.landmarks[list(EYE_CORNERS)])


@lru_cache(maxsize=4)
def load_network(name: str) -> cv2.dnn.Net:
    """A network of `models/`. OpenCV's classic engine: the new one of OpenCV 5 drops all outputs but one."""
    path = _MODELS / f"{name}.tflite"
    if not path.is_file():
        raise InputError(f"{path} is missing: install the package again")
    return cv2.dnn.readNetFromTFLite(str(path), cv2.dnn.ENGINE_CLASSIC)


def find_faces(image: np.ndarray) -> list[Face]:
    """All faces that both the detector and the landmark network accept, the largest first."""
    scale = min(1.0, _SEARCH_SIDE / max(image.shape[:2]))
    size = (max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale)))
    small = image if scale == 1 else cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    faces: list[Face] = []
    for windows in _search_windows(small.shape[1], small.shape[0]):
        candidates = [c for window in windows for c in _detect(small, *window)]
        candidates.sort(key=lambda c: -c[0])
        for _, keypoints, box_size in _drop_repeats(candidates):
            face = _fit_landmarks(image, keypoints / scale, box_size / scale)
            is_face = face.presence >= _PRESENCE and face.size >= _SMALLEST_FACE
            if is_face and not any(_same_face(face, other) for other in faces):
                faces.append(face)
        if faces:
            break
    return sorted(faces, key=lambda face: -face.size)


def select_face(faces: list[Face], index: int | None) -> tuple[Face, tuple[str, ...]]:
    """The face with that index (0 is the largest, also when None), and notes for the user.

    Raises `InputError` when there is no face or no such index.
    """
    if not faces:
        raise InputError("no face found: use a photo that shows the face from the front, upright and sharp")
    if index is not None and not 0 <= index < len(faces):
        known = "only face 0" if len(faces) == 1 else f"faces 0 to {len(faces) - 1}"
        raise InputError(f"--face {index}: there is no such face, {known} (numbered by size, largest first)")
    face = faces[index or 0]
    notes = []
    if len(faces) > 1 and index is None:
        notes.append(f"{len(faces)} faces found, using the largest: --face N selects another (0 is the largest)")
    if face.size < _SMALL_FACE:
        notes.append(f"the face is only {face.size:.0f} pixels tall: expect little detail")
    return face, tuple(notes)


def refine_landmarks(image: np.ndarray, face: Face) -> Face:
    """Landmarks of a known face, found again in crops around it."""
    corners = face.landmarks[list(EYE_CORNERS)]
    return _refine(image, face.landmarks.min(axis=0), face.landmarks.max(axis=0), corners)


def _search_windows(width: int, height: int) -> list[list[tuple[float, float, float]]]:
    """Square windows (left, top, side) in two batches: whole frame, with a margin, and tiles to a quarter of it; then,
    for faces too small for those, finer tiles. The detector is trained on faces that fill a good part of the frame."""
    longest = max(width, height)
    whole = [(width / 2 - side / 2, height / 2 - side / 2, side) for side in (longest, 2.0 * longest)]
    coarse = [w for divisor in (1.5, 3.0) for w in _tiles(width, height, longest / divisor)]
    fine = [w for divisor in (6.0, 10.0) if longest / divisor >= 32 for w in _tiles(width, height, longest / divisor)]
    return [whole + coarse, fine]


def _tiles(width: int, height: int, side: float) -> list[tuple[float, float, float]]:
    """Square tiles that overlap by half or more and cover the image."""

    def starts(length: int) -> np.ndarray:
        if length <= side:
            return np.array([(length - side) / 2])
        return np.linspace(0, length - side, int(np.ceil((length - side) / (side / 2))) + 1)

    return [(float(x), float(y), side) for y in starts(height) for x in starts(width)]


def sample_square(image: np.ndarray, centre: np.ndarray, side: float, degrees: float, size: int) -> np.ndarray:
    """A `[size, size, 3]` view of the square with that centre and side (pixels), its axes turned by `degrees`; black
    outside the image. Averages where it shrinks, cubic where it enlarges."""
    shrink = side / size
    reach = side * 0.75 + 2
    x0, y0 = (max(0, int(np.floor(c - reach))) for c in centre)
    x1, y1 = (min(n, int(np.ceil(c + reach))) for c, n in zip(centre, image.shape[1::-1], strict=True))
    if x1 <= x0 or y1 <= y0:
        return np.zeros((size, size, 3), np.uint8)
    part = image[y0:y1, x0:x1]
    scale_x = scale_y = 1.0
    if shrink > 1.5:
        target = (max(1, round((x1 - x0) / shrink)), max(1, round((y1 - y0) / shrink)))
        part = cv2.resize(part, target, interpolation=cv2.INTER_AREA)
        scale_x, scale_y = target[0] / (x1 - x0), target[1] / (y1 - y0)
    cos, sin = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    to_image = np.array([[cos, -sin], [sin, cos]]) * shrink
    offset = np.asarray(centre) - to_image @ np.full(2, size / 2)
    to_part = np.diag([scale_x, scale_y])
    linear = to_part @ to_image
    shift = to_part @ (offset - [x0, y0]) + linear @ np.full(2, 0.5) - 0.5
    flags = cv2.WARP_INVERSE_MAP | (cv2.INTER_CUBIC if shrink < 1 else cv2.INTER_LINEAR)
    return cv2.warpAffine(part, np.column_stack([linear, shift]), (size, size), flags=flags)


@lru_cache(maxsize=1)
def _anchors() -> np.ndarray:
    """Anchor centres `[896, 2]` in [0, 1]: a 16x16 grid with two anchors a cell, then 8x8 with six."""
    grids = []
    for cells, repeats in ((16, 2), (8, 6)):
        y, x = np.mgrid[:cells, :cells]
        grids.append(np.repeat((np.stack([x, y], -1).reshape(-1, 2) + 0.5) / cells, repeats, axis=0))
    return np.concatenate(grids)


def _detect(image: np.ndarray, left: float, top: float, side: float) -> list[tuple[float, np.ndarray, float]]:
    """Detections in one square window: score, eye positions `[2, 2]` and box centre as `[3, 2]` pixels, box side."""
    view = sample_square(image, np.array([left + side / 2, top + side / 2]), side, 0.0, _DETECTOR_SIDE)
    network = load_network("face_detection_short_range")
    network.setInput(cv2.dnn.blobFromImage(view, 1 / 127.5, mean=(127.5, 127.5, 127.5)))
    boxes, scores = network.forward(["regressors", "classificators"])
    scores = 1 / (1 + np.exp(-np.clip(scores.reshape(-1), -100, 100).astype(np.float64)))
    found = []
    for i in np.flatnonzero(scores >= _DETECTOR_SCORE):
        values = boxes[0, i].astype(np.float64).reshape(-1, 2) / _DETECTOR_SIDE
        points = np.stack([values[2], values[3], values[0]]) + _anchors()[i]
        found.append((float(scores[i]), points * side + [left, top], float(values[1].max() * side)))
    return found


def _drop_repeats(candidates: list[tuple[float, np.ndarray, float]]) -> list[tuple[float, np.ndarray, float]]:
    """Drops detections whose centre lies within half a face of a better one of similar size."""
    kept: list[tuple[float, np.ndarray, float]] = []
    for candidate in candidates:
        _, points, size = candidate
        if not any(
            np.linalg.norm(points[2] - other[2]) < 0.5 * max(size, other_size) and 0.6 < size / other_size < 1.7
            for _, other, other_size in kept
        ):
            kept.append(candidate)
    return kept


def _same_face(face: Face, other: Face) -> bool:
    distance = np.linalg.norm(face.landmarks.mean(axis=0) - other.landmarks.mean(axis=0))
    return bool(distance < 0.5 * max(face.size, other.size))


def _fit_landmarks(image: np.ndarray, keypoints: np.ndarray, box_size: float) -> Face:
    """Landmarks from a detection (eyes and box centre `[3, 2]`, box side). The detector takes a face that is upside
    down for an upright one, so a doubtful face is tried the other way up as well."""
    lower, upper = keypoints[2] - box_size / 2, keypoints[2] + box_size / 2
    face = _settle(image, lower, upper, keypoints[:2])
    if face.presence < _SURE:
        turned = _settle(image, lower, upper, keypoints[1::-1])
        face = turned if turned.presence >= _SURE else face
    return face


def _settle(image: np.ndarray, lower: np.ndarray, upper: np.ndarray, eyes: np.ndarray) -> Face:
    """Landmarks found three times, each in crops around the last result; once where there is hardly a face."""
    face = _refine(image, lower, upper, eyes, passes=1)
    return refine_landmarks(image, refine_landmarks(image, face)) if face.presence >= _PRESENCE / 4 else face


def _refine(
    image: np.ndarray, lower: np.ndarray, upper: np.ndarray, eyes: np.ndarray, passes: int | None = None
) -> Face:
    """The mean over slightly different crops: single crops differ by about a hundredth of the face's height."""
    centre, side = (lower + upper) / 2, float((upper - lower).max())
    roll = _roll(eyes)
    results = [_run_landmarks(image, centre, side * m, roll + turn) for m, turn in _MARGIN_TURN[:passes]]
    points = np.mean([r[0] for r in results], axis=0)
    return Face(points[:, :2], points[:, 2], float(np.mean([r[1] for r in results])))


def _roll(eyes: np.ndarray) -> float:
    """Degrees, clockwise, of the line from the subject's right eye to the left one, `[2, 2]` pixels."""
    across = eyes[1] - eyes[0]
    return float(np.degrees(np.arctan2(across[1], across[0])))


def _run_landmarks(image: np.ndarray, centre: np.ndarray, side: float, roll: float) -> tuple[np.ndarray, float]:
    """One run of the landmark network: `[468, 3]` in pixels and the presence score."""
    view = sample_square(image, centre, side, roll, _LANDMARK_SIDE)
    network = load_network("face_landmark")
    network.setInput(cv2.dnn.blobFromImage(view, 1 / 255))
    raw, flag = network.forward(["conv2d_21", "conv2d_31"])
    points = raw.reshape(LANDMARKS, 3).astype(np.float64)
    cos, sin = np.cos(np.radians(roll)), np.sin(np.radians(roll))
    turned = (points[:, :2] - _LANDMARK_SIDE / 2) @ np.array([[cos, -sin], [sin, cos]]).T
    scale = side / _LANDMARK_SIDE
    result = np.column_stack([turned * scale + centre, points[:, 2] * scale])
    return result, float(1 / (1 + np.exp(-np.clip(flag.item(), -50, 50))))
