"""From one portrait photo to the input of a fit: linear image, foreground mask, landmarks and camera."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.sparse import csr_matrix

from sira_mi.colour import linear_to_srgb
from sira_mi.conventions import LANDMARKS, LUMINANCE, MILLIMETRES_PER_UNIT
from sira_mi.errors import InputError
from sira_mi.files import read_json
from sira_mi.portrait.camera import Camera, estimate_camera, measure_reprojection_error
from sira_mi.portrait.face import Face, find_faces, select_face
from sira_mi.portrait.head_landmarks import correct_landmarks
from sira_mi.portrait.load import DEFAULT_MAX_PIXELS, Photo, load_photo
from sira_mi.portrait.mask import check_mask, clean_mask, is_cutout, load_mask, segment_person

_MIN_FACE_SHARE = 0.2  # of the working size; below it the photo is cropped to the head first
_WINDOW = 4.5  # side of that crop, in face sizes
_FACE_POSITION = 0.42  # height of the face's centre in that crop, from its top
_LARGEST_ROLL = 60.0  # degrees; the mask's network knows people who stand or sit
_BRIGHT = 0.8  # linear; a well exposed photo has few pixels that are brighter
_CAMERA_MISMATCH = 0.25  # in face sizes; a given camera that is further off earns a note


@dataclass(frozen=True)
class PortraitSettings:
    working_size: int = 512  # longest side of the working image, pixels; photos are never enlarged
    sharp_size: int = 1024  # the same of `Portrait.sharp`, which is at least as large as the working image
    max_pixels: int = DEFAULT_MAX_PIXELS  # larger photos are reduced while loading, pixels


@dataclass(frozen=True, eq=False)
class Portrait:
    image: np.ndarray  # [H, W, 3] float32, linear Rec.709, `exposure` times the photo's
    mask: np.ndarray  # [H, W] float32 in [0, 1], 1 is the person
    landmarks: np.ndarray  # [468, 2] float64, pixels of `image`, as the network finds them; NaN without a face
    head_landmarks: np.ndarray  # [468, 2] likewise, corrected to those of the head, hidden ones included
    camera: Camera  # of `image`, with square pixels
    notes: tuple[str, ...]  # messages for the user, one line each
    exposure: float = 1.0  # other than 1 only for photos that store radiance, whose unit is arbitrary
    window: tuple[float, ...] | None = None  # x0, y0, x1, y1: where `image` lies in the photo, the photo's pixels
    sharp: np.ndarray | None = None  # [sH, sW, 3] float32, `image` with more pixels, where the photo has them


@dataclass(frozen=True)
class _Window:
    """The part of a photo that becomes the working image: start (pixels of the photo), scales and size."""

    x0: float
    y0: float
    scale_x: float
    scale_y: float
    width: int
    height: int

    @property
    def edges(self) -> tuple[float, float, float, float]:
        """x0, y0, x1, y1 in pixels of the photo."""
        return self.x0, self.y0, self.x0 + self.width / self.scale_x, self.y0 + self.height / self.scale_y

    def to_working(self, points: np.ndarray) -> np.ndarray:
        return (points - [self.x0, self.y0]) * [self.scale_x, self.scale_y]

    def enlarge(self, longest: int) -> "_Window":
        """The same part of the photo with a longest side of at most `longest` pixels, not enlarged."""
        factor = min(longest / max(self.width, self.height), 1 / max(self.scale_x, self.scale_y))
        width, height = (max(1, round(side * max(factor, 1.0))) for side in (self.width, self.height))
        scale_x, scale_y = self.scale_x * width / self.width, self.scale_y * height / self.height
        return _Window(self.x0, self.y0, scale_x, scale_y, width, height)

    def resample(self, image: np.ndarray) -> np.ndarray:
        return area_resample(image, (self.x0, self.y0), (self.scale_x, self.scale_y), (self.width, self.height))


def make_portrait(
    path: str | Path,
    settings: PortraitSettings,
    mean_landmarks: np.ndarray,
    mask_path: str | Path | None = None,
    camera_path: str | Path | None = None,
    face: int | None = None,
) -> Portrait:
    """Loads a photo; finds its face, mask and camera, or reads the latter two from files.

    `mean_landmarks` `[468, 3]` are the mean head's, in world units, NaN where unknown. `face` counts from 0 by size,
    largest first. With both `mask_path` and `camera_path` the photo need not show a face.
    Raises `InputError` for bad files and photos.
    """
    photo = load_photo(path, settings.max_pixels)
    notes = list(photo.notes)
    exposure = 1.0
    if photo.is_radiance:
        exposure = _find_exposure(photo.image)
        photo = replace(photo, image=photo.image * np.float32(exposure))
        notes.append(f"the photo stores radiance: fitted at {exposure:.3g} times its values, written in its own unit")
    given_camera = None if camera_path is None else _read_camera(camera_path, photo)
    given_mask = None if mask_path is None else load_mask(mask_path, photo, settings.max_pixels)

    shown = make_display_image(photo.image)
    faces = find_faces(shown)
    found = None
    if faces or face is not None or given_camera is None or given_mask is None:
        found, face_notes = select_face(faces, face)
        notes.extend(face_notes)
    else:
        notes.append("no face found: using the given camera and mask alone")

    in_photo = None if found is None else correct_landmarks(found)
    camera = given_camera
    if camera is None:
        assert found is not None and in_photo is not None  # select_face raises otherwise
        camera = _fit_camera(photo, in_photo, found.size, mean_landmarks, notes)
    if given_mask is not None and mask_path is not None:
        points = camera.project(mean_landmarks) if found is None else found.landmarks
        check_mask(given_mask, points, mask_path)
        if (given_mask > 0.5).all():
            notes.append("the mask covers the whole photo: all of it counts as the person")
    window = _choose_window(photo, found, camera, settings.working_size, notes)
    image = np.maximum(window.resample(photo.image), 0)
    sharp = np.maximum(window.enlarge(settings.sharp_size).resample(photo.image), 0)
    height, width = image.shape[:2]
    camera = camera.crop(window.x0, window.y0, 0, 0).scale(window.scale_x, window.scale_y, width, height)

    landmarks = of_head = np.full((LANDMARKS, 2), np.nan)
    working_face = None
    if found is not None and in_photo is not None:
        landmarks, of_head = window.to_working(found.landmarks), window.to_working(in_photo)
        working_face = Face(landmarks, found.depth * window.scale_x, found.presence)
    mask = _make_mask(photo, given_mask, window, image, working_face, notes)
    if given_camera is not None and working_face is not None:
        error = measure_reprojection_error(camera, of_head, np.asarray(mean_landmarks, np.float64))
        if error > _CAMERA_MISMATCH * working_face.size:
            notes.append(f"the given camera shows the head {error:.0f} pixels away from the face in the photo")
    image, sharp, mask = (a.astype(np.float32) for a in (image, sharp, mask))
    edges = tuple(edge * photo.reduction for edge in window.edges)
    return Portrait(image, mask, landmarks, of_head, camera, tuple(notes), exposure, edges, sharp)


def make_display_image(image: np.ndarray) -> np.ndarray:
    """A linear image `[H, W, 3]` as sRGB uint8 for the networks; a far too dark or bright one is exposed anew."""
    bright = _measure_brightness(image)
    exposure = _BRIGHT / bright if bright > 0 and not 0.1 <= bright <= 1.0 else 1.0
    return np.concatenate(
        [(linear_to_srgb(rows * exposure) * 255 + 0.5).astype(np.uint8) for rows in np.array_split(image, 8)]
    )


def _measure_brightness(image: np.ndarray) -> float:
    """A luminance that few of the image's pixels exceed."""
    return float(np.percentile(image[::4, ::4] @ np.array(LUMINANCE, np.float32), 99))


def _find_exposure(image: np.ndarray) -> float:
    """The factor of a linear image `[H, W, 3]` that makes it as bright as photos are; 1 for a black one."""
    bright = _measure_brightness(image)
    return _BRIGHT / bright if bright > 0 else 1.0


def halve(portrait: Portrait) -> Portrait:
    """The portrait at half its size. The mask keeps the pixels that the person covers fully."""
    width, height = (max(1, size // 2) for size in (portrait.camera.width, portrait.camera.height))
    scale = width / portrait.camera.width, height / portrait.camera.height
    image, mask = (area_resample(a, (0, 0), scale, (width, height)) for a in (portrait.image, portrait.mask))
    return replace(
        portrait,
        image=image.astype(np.float32),
        mask=(mask > 0.99).astype(np.float32),
        landmarks=portrait.landmarks * scale,
        head_landmarks=portrait.head_landmarks * scale,
        camera=portrait.camera.scale(*scale, width, height),
    )


def area_resample(
    image: np.ndarray, start: tuple[float, float], scale: tuple[float, float], size: tuple[int, int]
) -> np.ndarray:
    """Averages an image `[H, W, ...]` over the exact area of each new pixel: new pixel (i, j) covers the old positions
    start + (i, j) / scale to start + (i + 1, j + 1) / scale (x, y). What lies outside the image does not count."""
    rows = _area_weights(image.shape[0], start[1], scale[1], size[1])
    columns = _area_weights(image.shape[1], start[0], scale[0], size[0])
    tall = (rows @ image.reshape(image.shape[0], -1)).reshape(size[1], *image.shape[1:])
    wide = columns @ np.moveaxis(tall, 1, 0).reshape(image.shape[1], -1)
    wide = wide.reshape(size[0], size[1], *image.shape[2:])
    return np.ascontiguousarray(np.moveaxis(wide, 0, 1))


def _area_weights(old: int, start: float, scale: float, new: int) -> csr_matrix:
    """Sparse `[new, old]` matrix of each new pixel's share of the old ones; rows sum to 1."""
    edges = start + np.arange(new + 1) / scale
    lower = np.clip(edges[:-1], 0, old - 1e-6)
    upper = np.clip(np.maximum(edges[1:], lower + 1e-6), 1e-6, old)
    first, last = np.floor(lower).astype(int), np.minimum(np.ceil(upper).astype(int), old)
    counts = np.maximum(last - first, 1)
    row = np.repeat(np.arange(new), counts)
    column = first[row] + np.arange(len(row)) - np.repeat(np.cumsum(counts) - counts, counts)
    overlap = np.minimum(upper[row], column + 1) - np.maximum(lower[row], column)
    total = np.bincount(row, overlap, new)
    return csr_matrix(((overlap / total[row]).astype(np.float32), (row, column)), shape=(new, old))


def _read_camera(path: str | Path, photo: Photo) -> Camera:
    """A camera file for the photo's full resolution, as the camera of `photo.image`."""
    camera = Camera.from_dict(read_json(path, "camera"), str(path), photo.full_size)
    height, width = photo.image.shape[:2]
    return camera.scale(1 / photo.reduction, 1 / photo.reduction, width, height)


def _fit_camera(
    photo: Photo, landmarks: np.ndarray, face_size: float, mean_landmarks: np.ndarray, notes: list[str]
) -> Camera:
    height, width = photo.image.shape[:2]
    camera = estimate_camera(landmarks, mean_landmarks, width, height, photo.focal_35mm)
    error = measure_reprojection_error(camera, landmarks, np.asarray(mean_landmarks, np.float64))
    source = "the photo's EXIF data" if photo.focal_35mm is not None else "the face and a usual distance"
    distance = np.linalg.norm(camera.centre) * MILLIMETRES_PER_UNIT / 1000
    notes.append(
        f"camera from landmarks: {distance:.2f} m away, focal length from {source}, "
        f"{error:.1f} pixels off on average ({100 * error / face_size:.1f}% of the face)"
    )
    return camera


def _choose_window(photo: Photo, face: Face | None, camera: Camera, working_size: int, notes: list[str]) -> _Window:
    """The whole photo, or the head and shoulders where the face would get too small; square pixels, never enlarged."""
    height, width = photo.image.shape[:2]
    focal = min(camera.K[0, 0], camera.K[1, 1])
    square_x, square_y = focal / camera.K[0, 0], focal / camera.K[1, 1]
    scale = min(1.0, working_size / max(width * square_x, height * square_y))
    x0, y0, x1, y1 = 0.0, 0.0, float(width), float(height)
    if face is not None and scale < 1 and face.size * scale < _MIN_FACE_SHARE * working_size:
        left, top, right, bottom = face.box
        side = _WINDOW * face.size
        x0, y0 = np.floor((left + right - side) / 2), np.floor((top + bottom) / 2 - _FACE_POSITION * side)
        x1, y1 = min(width, np.ceil(x0 + side)), min(height, np.ceil(y0 + side))
        x0, y0 = max(0.0, x0), max(0.0, y0)
        scale = min(1.0, working_size / max((x1 - x0) * square_x, (y1 - y0) * square_y))
        notes.append("the face is small in the photo: cropped to head and shoulders")
    scale_x, scale_y = scale * square_x, scale * square_y
    size = (max(1, round((x1 - x0) * scale_x)), max(1, round((y1 - y0) * scale_y)))
    return _Window(float(x0), float(y0), scale_x, scale_y, *size)


def _make_mask(
    photo: Photo,
    given: np.ndarray | None,
    window: _Window,
    image: np.ndarray,
    face: Face | None,
    notes: list[str],
) -> np.ndarray:
    if given is not None:
        mask = np.clip(window.resample(given), 0, 1)
    elif photo.alpha is not None and is_cutout(photo.alpha):
        mask = clean_mask(np.clip(window.resample(photo.alpha), 0, 1), face)
        notes.append("the photo's alpha channel is used as the mask")
    else:
        assert face is not None  # select_face raises otherwise
        if abs(face.roll) > _LARGEST_ROLL:
            how = "upside down" if abs(face.roll) > 135 else "on its side"
            raise InputError(f"the face is {how}: turn the photo upright, or give --mask")
        mask = segment_person(make_display_image(image), face)
    if not (mask > 0.5).any():
        raise InputError("the mask is empty where the face is: give another with --mask, or select --face N")
    return mask
