"""Photo files to linear Rec.709 images: colour, orientation, alpha, size limits and EXIF data of the lens."""

import contextlib
import io
import os
import threading
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from PIL import Image, ImageCms

from sira_mi.errors import InputError
from sira_mi.files import check_file, read_exr

MIN_SIDE = 32  # pixels; anything smaller holds no face that could be fitted
MAX_FILE_PIXELS = 400_000_000
MAX_EXR_PIXELS = 100_000_000  # of all parts: 1.6 GB of R, G, B and alpha
DEFAULT_MAX_PIXELS = 26_000_000

_EXR_MAGIC = b"\x76\x2f\x31\x01"
_ORIENTATION, _EXIF_IFD, _FOCAL_35MM, _TIFF_WIDTH, _TIFF_HEIGHT = 0x0112, 0x8769, 0xA405, 256, 257
_FLIPS_X, _FLIPS_Y = (2, 3, 7, 8), (3, 4, 6, 7)  # orientations that reverse the stored x or y axis
_DECODING = threading.Lock()
_STRIP_PIXELS = 4_000_000
_LEAST_ALPHA = 1 / 255  # premultiplied colours of less say nothing
_GREYS = ("1", "L", "LA", "La", "I;16", "I;16B", "I;16L", "I;16N")


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


def srgb_to_linear(values: np.ndarray) -> np.ndarray:
    """sRGB-coded values `[...]` in [0, 1] to linear ones (IEC 61966-2-1)."""
    values = np.asarray(values, np.float32)
    return np.where(values <= 0.04045, values / 12.92, ((np.maximum(values, 0) + 0.055) / 1.055) ** 2.4)


def linear_to_srgb(values: np.ndarray) -> np.ndarray:
    """Linear values `[...]`, clipped to [0, 1], to sRGB-coded ones (IEC 61966-2-1)."""
    values = np.clip(np.asarray(values, np.float32), 0, 1)
    return np.where(values <= 0.0031308, values * 12.92, 1.055 * values ** (1 / 2.4) - 0.055)


def orient(image: np.ndarray, orientation: int) -> np.ndarray:
    """Applies an EXIF orientation (1 to 8) to an image as stored, `[H, W, ...]`."""
    if orientation >= 5:
        image = image.swapaxes(0, 1)
    flip_x, flip_y = orientation in _FLIPS_X, orientation in _FLIPS_Y
    if orientation >= 5:
        flip_x, flip_y = flip_y, flip_x
    return np.ascontiguousarray(image[:: -1 if flip_y else 1, :: -1 if flip_x else 1])


def load_photo(path: str | Path, max_pixels: int = DEFAULT_MAX_PIXELS) -> Photo:
    """Reads a photo: a format that Pillow reads (JPEG, PNG, TIFF, ...) with 8 or 16 bits, or a linear EXR.

    A photo of more than `max_pixels` is reduced by a power of two, averaging in linear light.
    Raises `InputError` for any other file.
    """
    path = check_file(path, "photo")
    photo = _load(path, max_pixels, srgb_to_linear)
    height, width = photo.image.shape[:2]
    if photo.reduction > 1:
        note = f"{path.name} is {photo.full_size[0]}x{photo.full_size[1]}: downscaled on load to {width}x{height}"
        photo = replace(photo, notes=(*photo.notes, note))
    return photo


def load_stored(path: str | Path, max_pixels: int) -> Photo:
    """Reads a mask image like a photo, by its stored values: no transfer function, no colour profile.

    Raises `InputError` as `load_photo` does."""
    return _load(check_file(path, "mask"), max_pixels, _as_stored)


def _as_stored(values: np.ndarray) -> np.ndarray:
    return values


def _load(path: Path, max_pixels: int, decode: Callable) -> Photo:
    with _DECODING, _quiet_decoders():
        is_exr = _head(path) == _EXR_MAGIC
        return _load_exr(path, max_pixels) if is_exr else _load_coded(path, max_pixels, decode)


def _head(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(4)


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


@contextlib.contextmanager
def _quiet_decoders() -> Iterator[None]:
    """Silences the decoders: Python's warnings, the prints of OpenEXR, and what libtiff and OpenEXR write from C to
    file descriptor 2. Also lifts Pillow's size limit, which `_check_size` replaces. All this is the process's: one
    thread at a time."""
    limit, Image.MAX_IMAGE_PIXELS = Image.MAX_IMAGE_PIXELS, None
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        terminal = os.dup(2)
    except OSError:  # the program runs without a standard error
        terminal = os.dup(nowhere)
    os.dup2(nowhere, 2)
    try:
        with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
            warnings.simplefilter("ignore")
            yield
    finally:
        os.dup2(terminal, 2)
        os.close(terminal)
        os.close(nowhere)
        Image.MAX_IMAGE_PIXELS = limit


def _load_coded(path: Path, max_pixels: int, decode: Callable) -> Photo:
    try:
        picture = Image.open(path)
    except Exception:  # Pillow's format readers have no common error for files that are not theirs
        raise InputError(f"{path} is not an image that can be read: save it as PNG, JPEG or TIFF") from None
    with picture:
        return _decode(path, picture, max_pixels, decode)


def _decode(path: Path, picture: Image.Image, max_pixels: int, decode: Callable) -> Photo:
    notes: list[str] = []
    tags = getattr(picture, "tag_v2", {})
    stored = (int(tags.get(_TIFF_WIDTH, picture.size[0])), int(tags.get(_TIFF_HEIGHT, picture.size[1])))
    _check_size(path, *stored)
    orientation, focal = _exif(picture, notes)
    is_deep = ";16" in str(getattr(picture, "tile", "")) and picture.format in ("PNG", "TIFF")
    try:
        picture.load()
    except Exception as error:  # every decoder has its own way to fail on a damaged file
        raise InputError(f"{path} is damaged or truncated ({_one_line(error)}): export it again") from None
    if picture.mode in ("I", "F"):
        raise InputError(f"{path} has 32-bit pixels: save it as 8- or 16-bit PNG, or as EXR")
    pending, _ = _exif(picture, [])  # 1 where the decoder has oriented the pixels, as for TIFF
    colour = None if decode is not srgb_to_linear else _colour_transform(picture, notes)
    if is_deep and colour is None:
        strip = _deep_strips(path, picture)
    else:
        strip = _pillow_strips(picture, colour)
        if is_deep:
            notes.append(f"{path.name} has 16 bits and a colour profile: converted to sRGB at 8 bits")
    image, alpha, factor = _reduce(picture.size, pending, max_pixels, strip, decode)
    full = stored[::-1] if orientation >= 5 else stored
    return Photo(image, alpha, focal, orientation, stored, full, factor, tuple(notes))


def _reduce(
    size: tuple[int, int], orientation: int, max_pixels: int, strip: Callable, decode: Callable
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
            table = decode(np.arange(largest + 1, dtype=np.float32) / largest).astype(np.float32)
        image[y:stop] = _block_mean(table[rgb], factor)
        if opacity is not None:
            alpha = np.empty((height, width), np.float32) if alpha is None else alpha
            alpha[y:stop] = _block_mean(opacity.astype(np.float32)[..., None] / largest, factor)[..., 0]
    return orient(image, orientation), None if alpha is None else orient(alpha, orientation), factor


def _block_mean(pixels: np.ndarray, factor: int) -> np.ndarray:
    """Averages blocks of `factor` by `factor` pixels of `[H, W, C]`, which the sides must be multiples of."""
    if factor == 1:
        return pixels
    height, width, channels = pixels.shape
    means = cv2.resize(pixels, (width // factor, height // factor), interpolation=cv2.INTER_AREA)
    return means.reshape(height // factor, width // factor, channels)


def _pillow_strips(picture: Image.Image, colour: Callable | None) -> Callable:
    has_alpha = picture.mode in ("LA", "PA", "La", "RGBA", "RGBa") or "transparency" in picture.info
    depth_16 = picture.mode.startswith("I;16")

    def strip(left: int, top: int, right: int, bottom: int) -> tuple[np.ndarray, np.ndarray | None]:
        part = picture.crop((left, top, right, bottom))
        if depth_16 and colour is None:
            return np.repeat(np.asarray(part, np.uint16)[..., None], 3, axis=2), None
        if depth_16:
            part = Image.fromarray((np.asarray(part, np.uint16) >> 8).astype(np.uint8))
        alpha = np.asarray(part.convert("RGBA"))[..., 3] if has_alpha else None
        part = colour(part) if colour is not None else part.convert("RGB")
        return np.asarray(part), alpha

    return strip


def _deep_strips(path: Path, picture: Image.Image) -> Callable:
    """Strips of a PNG or TIFF with 16 bits; Pillow keeps only 8 of them when there are several channels."""
    pixels = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_UNCHANGED)
    if pixels is None or pixels.dtype != np.uint16 or pixels.shape[1::-1] != picture.size:
        return _pillow_strips(picture, None)
    pixels = pixels[..., None] if pixels.ndim == 2 else pixels
    order = {1: [0, 0, 0], 2: [0, 0, 0], 3: [2, 1, 0], 4: [2, 1, 0]}[pixels.shape[2]]

    def strip(left: int, top: int, right: int, bottom: int) -> tuple[np.ndarray, np.ndarray | None]:
        part = pixels[top:bottom, left:right]
        return part[..., order], part[..., -1] if pixels.shape[2] in (2, 4) else None

    return strip


def _colour_transform(picture: Image.Image, notes: list[str]) -> Callable | None:
    """The conversion to sRGB that the embedded ICC profile asks for, or None when plain conversion is right."""
    icc = picture.info.get("icc_profile")
    if not icc:
        if picture.mode == "CMYK":
            notes.append("CMYK without a colour profile: colours converted by the plain formula")
        return None
    try:
        profile = ImageCms.ImageCmsProfile(io.BytesIO(icc))
        space = profile.profile.xcolor_space.strip()
        source_mode = {"RGB": "RGB", "GRAY": "L", "CMYK": "CMYK"}[space]
        if (source_mode == "CMYK") != (picture.mode == "CMYK") or (source_mode == "L" and picture.mode not in _GREYS):
            raise ValueError(f"a profile for {space} with pixels of mode {picture.mode}")
        if source_mode == "RGB" and "srgb" in ImageCms.getProfileDescription(profile).lower():
            return None
        transform = ImageCms.buildTransform(
            profile,
            ImageCms.createProfile("sRGB"),
            source_mode,
            "RGB",
            renderingIntent=ImageCms.Intent.RELATIVE_COLORIMETRIC,
            flags=ImageCms.Flags.BLACKPOINTCOMPENSATION,
        )
    except (ImageCms.PyCMSError, OSError, ValueError, TypeError, KeyError):
        notes.append("the embedded colour profile is broken or does not fit: read as sRGB")
        return None
    return lambda part: ImageCms.applyTransform(part.convert(source_mode), transform)


def _exif(picture: Image.Image, notes: list[str]) -> tuple[int, float | None]:
    """Orientation (1 to 8) and 35 mm focal length (mm, or None); damaged EXIF counts as none, with a note."""
    try:
        exif = picture.getexif()
        orientation = exif.get(_ORIENTATION, 1)
        focal = exif.get_ifd(_EXIF_IFD).get(_FOCAL_35MM)
        focal = float(focal) if focal else None
    except Exception:  # Pillow's EXIF parser fails in as many ways as there are damaged files
        notes.append("damaged EXIF data: ignored")
        return 1, None
    if orientation not in range(1, 9):
        orientation = 1
    return int(orientation), focal if focal is not None and 5 <= focal <= 2000 else None


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
    return Photo(np.maximum(image, 0), alpha, None, 1, size, size, factor, ())


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())[:120] or type(error).__name__
