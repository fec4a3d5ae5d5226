"""Photo files to linear Rec.709 images: size limits, reduction, orientation, alpha."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from sira_mi.errors import InputError
from sira_mi.files import check_file, read_exr
from sira_mi.portrait.encoding import Encoding, read_encoding
from sira_mi.portrait.formats import (
    TIFF_HEIGHT,
    TIFF_WIDTH,
    Strips,
    check_mode,
    is_deep,
    open_picture,
    read_exif,
    read_strips,
)

MIN_SIDE = 32  # pixels; anything smaller holds no face that could be fitted
MAX_FILE_PIXELS = 400_000_000
MAX_EXR_PIXELS = 100_000_000  # of all parts: 1.6 GB of R, G, B and alpha
DEFAULT_MAX_PIXELS = 26_000_000

_EXR_MAGIC = b"\x76\x2f\x31\x01"
_FLIPS_X, _FLIPS_Y = (2, 3, 7, 8), (3, 4, 6, 7)  # orientations that reverse the stored x or y axis
_STRIP_PIXELS = 4_000_000
_LEAST_ALPHA = 1 / 255  # premultiplied colours of less say nothing


@dataclass(frozen=True)
class Photo:
    """A decoded photo. `image` shows the oriented photo reduced by the integer factor `reduction`; up to
    `reduction - 1` columns and rows at its right and lower edge are cut off."""

    image: np.ndarray  # [H, W, 3] float32, linear Rec.709
    alpha: np.ndarray | None  # [H, W] float32 in [0, 1]
    focal_35mm: float | None  # focal length on 35 mm film with the same diagonal, mm
    orientation: int  # EXIF orientation of the file, 1 to 8; already applied to `image`
    stored_size: tuple[int, int]  # width and height in the file, pixels
    full_size: tuple[int, int]  # width and height after orientation, pixels
    reduction: int  # file pixels per image pixel along each axis
    notes: tuple[str, ...]
    is_radiance: bool = False  # in a unit of the file's own, other than colours coded for a display


def orient(image: np.ndarray, orientation: int) -> np.ndarray:
    """Applies an EXIF orientation (1 to 8) to an image as stored, `[H, W, ...]`."""
    if orientation >= 5:
        image = image.swapaxes(0, 1)
    flip_x, flip_y = orientation in _FLIPS_X, orientation in _FLIPS_Y
    if orientation >= 5:
        flip_x, flip_y = flip_y, flip_x
    return np.ascontiguousarray(image[:: -1 if flip_y else 1, :: -1 if flip_x else 1])


def load_photo(path: str | Path, max_pixels: int = DEFAULT_MAX_PIXELS) -> Photo:
    """Reads a photo: JPEG, PNG, TIFF, WebP, HEIC, AVIF, JPEG 2000, BMP, GIF or PPM with 8 or 16 bits, or an EXR.

    The colours that the file declares (ICC profile, gAMA and cHRM, CICP, chromaticities) are converted to Rec.709;
    without a declaration they are sRGB, and linear Rec.709 in an EXR. What a file says and is not obeyed is in `notes`.

    A photo of more than `max_pixels` is reduced by a power of two, averaging in linear light.
    Raises `InputError` for any other file.
    """
    path = check_file(path, "photo")
    photo = _load(path, max_pixels)
    height, width = photo.image.shape[:2]
    if photo.reduction > 1:
        note = f"{path.name} is {photo.full_size[0]}x{photo.full_size[1]}: downscaled on load to {width}x{height}"
        photo = replace(photo, notes=(*photo.notes, note))
    return photo


def load_stored(path: str | Path, max_pixels: int) -> Photo:
    """Reads a mask image like a photo, by its stored values: no transfer function, no colour profile.

    Raises `InputError` as `load_photo` does."""
    return _load(check_file(path, "mask"), max_pixels, Encoding(_as_stored))


def _as_stored(values: np.ndarray) -> np.ndarray:
    return values


def _load(path: Path, max_pixels: int, encoding: Encoding | None = None) -> Photo:
    """A photo by the given encoding, or by the one that its file declares."""
    with path.open("rb") as file:
        head = file.read(16)
    if head[:4] == _EXR_MAGIC:
        return _load_exr(path, max_pixels)
    notes: list[str] = []
    with open_picture(path, head, notes) as picture:
        return _decode(path, picture, max_pixels, encoding, notes)


def _check_size(path: Path, width: int, height: int) -> None:
    if width * height > MAX_FILE_PIXELS:
        raise InputError(
            f"{path} has {width * height / 1e6:.0f} megapixels, more than {MAX_FILE_PIXELS // 1_000_000}: downscale it"
        )
    if min(width, height) < MIN_SIDE:
        raise InputError(f"{path} is {width}x{height} pixels: at least {MIN_SIDE} on each side are needed")


def _reduction(width: int, height: int, max_pixels: int) -> int:
    factor = 1
    while width * height > max_pixels * factor * factor:
        factor *= 2
    return factor


def _decode(path: Path, picture: Any, max_pixels: int, encoding: Encoding | None, notes: list[str]) -> Photo:
    deep = is_deep(path, picture)
    tags = getattr(picture, "tag_v2", {})
    stored = (int(tags.get(TIFF_WIDTH, picture.size[0])), int(tags.get(TIFF_HEIGHT, picture.size[1])))
    _check_size(path, *stored)
    exif = read_exif(path, picture, stored, notes)
    try:
        picture.load()
    except Exception as error:  # every decoder has its own way to fail on a damaged file
        raise InputError(f"{path} is damaged or truncated ({_one_line(error)}): export it again") from None
    check_mode(path, picture, deep)
    encoding = encoding or read_encoding(path, picture, deep, notes)
    size, is_oriented, strip = read_strips(path, picture, encoding, deep)
    pending = 1 if is_oriented else exif.orientation
    image, alpha, factor = _reduce(size, pending, max_pixels, strip, encoding)
    full = stored[::-1] if exif.orientation >= 5 else stored
    return Photo(image, alpha, exif.focal_35mm, exif.orientation, stored, full, factor, tuple(notes))


def _reduce(
    size: tuple[int, int], orientation: int, max_pixels: int, strip: Strips, encoding: Encoding
) -> tuple[np.ndarray, np.ndarray | None, int]:
    """Decodes strip by strip, averages blocks and orients. Rows and columns that fill no block are cut right and
    below."""
    factor = _reduction(*size, max_pixels)
    width, height = size[0] // factor, size[1] // factor
    left = size[0] % factor if orientation in _FLIPS_X else 0
    top = size[1] % factor if orientation in _FLIPS_Y else 0
    image = np.empty((height, width, 3), np.float32)
    alpha = None
    table = None
    rows = max(1, _STRIP_PIXELS // (size[0] * factor))
    for y in range(0, height, rows):
        stop = min(y + rows, height)
        rgb, opacity = strip(left, top + y * factor, left + width * factor, top + stop * factor)
        largest = np.iinfo(rgb.dtype).max
        if table is None:
            table = encoding.curve(np.arange(largest + 1, dtype=np.float32) / largest).astype(np.float32)
        image[y:stop] = _block_mean(_look_up(table, rgb), factor)
        if opacity is not None:
            alpha = np.empty((height, width), np.float32) if alpha is None else alpha
            alpha[y:stop] = _block_mean(opacity.astype(np.float32)[..., None] / largest, factor)[..., 0]
    if encoding.matrix is not None:
        image = np.maximum(image @ encoding.matrix.T.astype(np.float32), 0)
    return orient(image, orientation), None if alpha is None else orient(alpha, orientation), factor


def _look_up(table: np.ndarray, levels: np.ndarray) -> np.ndarray:
    """Values `[h, w, 3]` of `table`, `[N]` or `[N, 3]`, at `levels` `[h, w, 1 or 3]`."""
    if table.ndim == 1:
        values = table[levels]
    else:
        values = np.take_along_axis(table, levels.reshape(-1, levels.shape[2]), 0).reshape(*levels.shape[:2], 3)
    return values if values.shape[2] == 3 else np.repeat(values, 3, axis=2)


def _block_mean(pixels: np.ndarray, factor: int) -> np.ndarray:
    """Averages blocks of `factor` by `factor` pixels of `[H, W, C]`, which the sides must be multiples of."""
    if factor == 1:
        return pixels
    height, width, channels = pixels.shape
    means = cv2.resize(pixels, (width // factor, height // factor), interpolation=cv2.INTER_AREA)
    return means.reshape(height // factor, width // factor, channels)


def _load_exr(path: Path, max_pixels: int) -> Photo:
    image, alpha = read_exr(path, lambda width, height: _check_size(path, width, height), MAX_EXR_PIXELS)
    height, width = image.shape[:2]
    if alpha is not None:
        alpha = np.clip(np.nan_to_num(alpha), 0, 1)
        image = image / np.where(alpha > _LEAST_ALPHA, alpha, 1)[..., None]  # OpenEXR's colours are premultiplied
    factor = _reduction(width, height, max_pixels)
    rows, columns = height // factor * factor, width // factor * factor
    image = _block_mean(image[:rows, :columns], factor)
    if alpha is not None:
        alpha = _block_mean(alpha[:rows, :columns, None], factor)[..., 0]
    size = (width, height)
    return Photo(np.maximum(image, 0), alpha, None, 1, size, size, factor, (), is_radiance=True)


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())[:120] or type(error).__name__
