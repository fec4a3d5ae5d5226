"""Opens photo files: the formats that are photos, the page that is the picture, EXIF data, strips of its pixels."""

import contextlib
import threading
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from sira_mi.errors import InputError
from sira_mi.portrait.encoding import Encoding

Strips = Callable[[int, int, int, int], tuple[np.ndarray, np.ndarray | None]]  # left, top, right, bottom to pixels

FORMATS = ("JPEG", "PNG", "TIFF", "WEBP", "AVIF", "JPEG2000", "BMP", "GIF", "PPM")
TIFF_WIDTH, TIFF_HEIGHT = 256, 257

_MODES = (
    "1",
    "L",
    "LA",
    "La",
    "P",
    "PA",
    "RGB",
    "RGBX",
    "RGBA",
    "RGBa",
    "CMYK",
    "YCbCr",
    "I;16",
    "I;16B",
    "I;16L",
    "I",
)
_SUBFILE_TYPE, _BITS, _PHOTOMETRIC, _PLANAR, _WHITE_IS_ZERO = 254, 258, 262, 284, 0
_ORIENTATION, _EXIF_IFD, _FOCAL_35MM, _EXIF_WIDTH, _EXIF_HEIGHT = 0x0112, 0x8769, 0xA405, 0xA002, 0xA003
_SAME_ASPECT = 0.02  # of the longer side over the shorter: rounding while a photo is scaled
_PILLOW = threading.Lock()


@dataclass(frozen=True)
class Exif:
    """What the EXIF data says that still fits the pixels."""

    orientation: int = 1  # 1 to 8
    focal_35mm: float | None = None  # mm


@contextlib.contextmanager
def _quiet_pillow() -> Iterator[None]:
    """Without Pillow's warnings and its limit on pixels. Both belong to the whole process: one thread at a time."""
    with _PILLOW, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        limit, Image.MAX_IMAGE_PIXELS = Image.MAX_IMAGE_PIXELS, None
        try:
            yield
        finally:
            Image.MAX_IMAGE_PIXELS = limit


def open_picture(path: Path, head: bytes, notes: list[str]) -> Image.Image:
    """Opens a file in one of the formats without decoding it, by its first 16 bytes `head`. Notes which of several
    pictures is read, and pixels that are not square. Raises `InputError` for any other file."""
    formats: tuple[str, ...] = FORMATS
    if head[:2] == b"II" and head[8:10] == b"CR":
        raise InputError(f"{path} is a camera's raw file: develop it and save it as TIFF or JPEG")
    if head[4:8] == b"ftyp" and head[8:11] != b"avi":
        import pi_heif  # deferred: few photos need it

        pi_heif.register_heif_opener()
        formats = ("HEIF",)
    with _quiet_pillow():
        try:
            picture = Image.open(path, formats=formats)
            page = _seek_full_size(path, picture) if picture.format == "TIFF" else 1
            count = _count_pictures(path, picture)
        except InputError:
            raise
        except Exception:  # Pillow's format readers have no common error for files that are not theirs
            raise InputError(
                f"{path} is not an image that can be read: save it as PNG, JPEG, or TIFF of RGB colours"
            ) from None
    if count > 1:
        notes.append(f"{path.name} holds {count} pictures: number {page} is read")
    across, down = map(float, picture.info.get("aspect") or picture.info.get("dpi") or (1, 1))
    if across > 0 and down > 0 and abs(across / down - 1) > 0.01:
        notes.append(f"{path.name} says that its pixels are not square ({across:g} by {down:g}): taken as square")
    return picture


def _seek_full_size(path: Path, picture: Any) -> int:
    """Goes to the first page of a TIFF that is no thumbnail; returns its number, from 1."""
    page = 0
    while picture.tag_v2.get(_SUBFILE_TYPE, 0) & 1:
        page += 1
        try:
            picture.seek(page)
        except EOFError:
            raise InputError(
                f"{path} holds a thumbnail and a camera's raw data: develop it and save it as TIFF or JPEG"
            ) from None
    return page + 1


def _count_pictures(path: Path, picture: Any) -> int:
    """1 for the pictures that belong to one photo, as a phone's depth map does, and where later pages are damaged."""
    if picture.format in ("MPO", "HEIF"):
        return 1
    try:
        with Image.open(path, formats=(picture.format,)) as again:
            return getattr(again, "n_frames", 1)
    except Exception:
        return 1


def is_deep(path: Path, picture: Any) -> bool:
    """Whether the samples have more than 8 bits, of which Pillow keeps 8; asked before the picture is decoded."""
    if picture.format == "TIFF":
        return max(picture.tag_v2.get(_BITS, (1,))) > 8
    if picture.format in ("PPM", "JPEG2000"):
        import OpenImageIO as oiio  # deferred: few photos need it

        file = oiio.ImageInput.open(str(path))
        if file is None:
            oiio.geterror()  # otherwise printed when the program ends
        return file is not None and str(file.spec().format) != "uint8"
    return picture.format == "PNG" and ";16" in str(picture.tile)


def check_mode(path: Path, picture: Any, deep: bool) -> None:
    """Raises `InputError` for pixels that cannot be read as what they are."""
    if picture.mode == "F" or (picture.mode == "I" and not (picture.format == "PPM" and deep)):
        raise InputError(f"{path} has 32-bit pixels: save it as 8- or 16-bit PNG, or as EXR")
    tags = getattr(picture, "tag_v2", {})
    is_separate_cmyk = deep and picture.mode == "CMYK" and tags.get(_PLANAR) == 2
    if picture.mode not in _MODES or is_separate_cmyk:
        raise InputError(f"{path} has {picture.mode} colours of a kind that is not read: save it as RGB")


def read_exif(path: Path, picture: Image.Image, stored: tuple[int, int], notes: list[str]) -> Exif:
    """Orientation and focal length; what is damaged, or no longer fits the pixels, is left out with a note."""
    try:
        with _quiet_pillow():
            exif = picture.getexif()
            lens = exif.get_ifd(_EXIF_IFD)
        orientation = exif.get(_ORIENTATION, 1)
        focal = float(lens.get(_FOCAL_35MM) or 0)
        size = int(lens.get(_EXIF_WIDTH) or 0), int(lens.get(_EXIF_HEIGHT) or 0)
    except Exception:  # Pillow's EXIF parser fails in as many ways as there are damaged files
        notes.append("damaged EXIF data: ignored")
        return Exif()
    if orientation not in range(1, 9):
        orientation = 1
    known_focal = focal if 5 <= focal <= 2000 else None
    if min(size) > 0 and size not in (stored, stored[::-1]):
        written = f"{path.name} has EXIF data of {size[0]}x{size[1]} pixels and is {stored[0]}x{stored[1]}"
        if abs(max(size) / min(size) * min(stored) / max(stored) - 1) > _SAME_ASPECT:
            notes.append(f"{written}: it was cropped, so that its focal length is not used")
            known_focal = None
        elif known_focal is not None:
            notes.append(f"{written}: its focal length is used as that of a photo that was scaled, not cropped")
    turned = size[0] != size[1] and size == stored[::-1]
    if orientation >= 5 and turned and picture.format == "JPEG":
        notes.append(f"{path.name} may be turned already: its EXIF orientation {orientation} does not fit its size")
    return Exif(int(orientation), known_focal)


def read_strips(
    path: Path, picture: Image.Image, encoding: Encoding, deep: bool
) -> tuple[tuple[int, int], bool, Strips]:
    """Width and height, whether the decoder has oriented the pixels, and the reader of strips: coded colours
    `[h, w, 1 or 3]` and alpha `[h, w]`, uint8 or uint16; colours are not premultiplied."""
    if deep and encoding.profile is None and picture.mode != "CMYK":
        if picture.format == "PNG":
            _verify_checksums(path)
        size, strip = _read_strips_at_16_bits(path, picture)
        return size, False, strip
    return picture.size, picture.format == "TIFF", _read_strips_at_8_bits(picture, encoding)


def _verify_checksums(path: Path) -> None:
    """Raises `InputError` for a damaged PNG, of which libpng would write to the terminal."""
    try:
        with _quiet_pillow(), Image.open(path, formats=("PNG",)) as picture:
            picture.verify()
    except Exception:  # as for any damaged file
        raise InputError(f"{path} is damaged: export it again") from None


def _read_strips_at_8_bits(picture: Image.Image, encoding: Encoding) -> Strips:
    is_premultiplied = picture.mode in ("La", "RGBa")
    has_alpha = picture.mode in ("LA", "PA", "RGBA") or is_premultiplied or "transparency" in picture.info

    def strip(left: int, top: int, right: int, bottom: int) -> tuple[np.ndarray, np.ndarray | None]:
        part = picture.crop((left, top, right, bottom))
        if part.mode.startswith("I;16"):
            part = Image.fromarray((np.asarray(part, np.uint16) >> 8).astype(np.uint8))
        if is_premultiplied:
            part = part.convert("RGBA" if part.mode == "RGBa" else "LA")
        alpha = np.asarray(part.convert("RGBA"))[..., 3] if has_alpha else None
        part = part.convert("RGB") if encoding.profile is None else encoding.profile(part)
        return np.asarray(part), alpha

    return strip


def _read_strips_at_16_bits(path: Path, picture: Any) -> tuple[tuple[int, int], Strips]:
    import OpenImageIO as oiio  # deferred: few photos need it

    options = oiio.ImageSpec()
    options.attribute("oiio:UnassociatedAlpha", 1)
    damaged = InputError(f"{path} is damaged or truncated: export it again")
    file = oiio.ImageInput.open(str(path), options)
    page = picture.tell() if picture.format == "TIFF" else 0
    if file is None or not file.seek_subimage(page, 0):
        oiio.geterror()  # otherwise printed when the program ends
        raise damaged
    spec = file.spec()
    pixels = file.read_image(page, 0, 0, spec.nchannels, oiio.UINT16)
    if pixels is None:
        file.geterror()
        raise damaged
    pixels = np.asarray(pixels).reshape(spec.height, spec.width, spec.nchannels)
    colours = pixels[..., : 3 if spec.nchannels >= 3 else 1]
    if getattr(picture, "tag_v2", {}).get(_PHOTOMETRIC) == _WHITE_IS_ZERO:
        colours = 65535 - colours
    alpha = pixels[..., spec.alpha_channel] if spec.alpha_channel >= 0 else None
    is_premultiplied = picture.format == "TIFF" and not spec.get_int_attribute("oiio:UnassociatedAlpha", 0)

    def strip(left: int, top: int, right: int, bottom: int) -> tuple[np.ndarray, np.ndarray | None]:
        part = colours[top:bottom, left:right]
        if alpha is None:
            return part, None
        opacity = alpha[top:bottom, left:right]
        if is_premultiplied:
            divisor = np.maximum(opacity, 1)[..., None].astype(np.float32) / 65535
            part = np.minimum(part / divisor + 0.5, 65535).astype(np.uint16)
        return part, opacity

    return (spec.width, spec.height), strip
