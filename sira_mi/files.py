"""Writes files whole or not at all; reads and writes the image formats of the project."""

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import OpenEXR
from PIL import Image

from sira_mi.colour import REC_709, convert_to_rec709
from sira_mi.errors import InputError

MAX_EXR_PIXELS = 1 << 29  # of all parts together


def write_through(path: str | Path, write: Callable[[Path], object]) -> None:
    """Calls `write` with a temporary path beside `path` that has the same suffix, then renames the file.

    Raises InputError when the folder cannot be written or the disk is full; the temporary file is removed."""
    path = Path(path)
    temporary = path.with_name(f".{os.getpid()}.{path.name}")
    try:
        write(temporary)
        os.replace(temporary, path)
    except OSError as error:
        raise InputError(
            f"cannot write {path}: {error.strerror or error}; choose another place or free some"
        ) from error
    finally:
        temporary.unlink(missing_ok=True)


def write_text(path: str | Path, text: str) -> None:
    """A text file in UTF-8. Raises InputError as `write_through` does."""
    write_through(path, lambda file: file.write_text(text, encoding="utf-8"))


def read_exr(
    path: str | Path, check_size: Callable[[int, int], None] | None = None, max_pixels: int = MAX_EXR_PIXELS
) -> tuple[np.ndarray, np.ndarray | None]:
    """The image [H, W, 3], float32 linear Rec.709, of an OpenEXR file, and its alpha [H, W] if it has one.

    The picture is that of the first part with channels R, G and B, or else Y; it fills the display window, black where
    the file stores nothing. Other primaries are converted. `check_size` gets width and height before pixels are
    decoded. Raises InputError for any other file, more than `max_pixels` in all parts together, subsampled channels,
    pixels that are not square, and colours that are not finite."""
    try:
        headers = [part.header for part in OpenEXR.File(str(path), header_only=True).parts]
        names = [{channel.name for channel in header["channels"]} for header in headers]
    except Exception:  # OpenEXR raises bare RuntimeError and others
        raise InputError(f"{path}: not a readable OpenEXR image; export it again") from None
    part, colours = _choose_part(path, names)
    header = headers[part]
    size = _check_exr(path, headers, header, max_pixels)
    if check_size is not None:
        check_size(*size)
    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            planes = {name: channel.pixels for name, channel in file.channels(part).items() if name in (*colours, "A")}
    except Exception:
        raise InputError(f"{path}: not a readable OpenEXR image; export it again") from None
    image = np.stack([np.asarray(planes[name], np.float32) for name in colours], axis=-1)
    if not np.isfinite(image).all():
        raise InputError(f"{path}: holds values that are not finite (NaN or infinite)")
    try:
        matrix = convert_to_rec709(header.get("chromaticities", REC_709)) if colours == "RGB" else None
    except ValueError:
        raise InputError(f"{path}: its chromaticities are those of no RGB space; export it as Rec.709") from None
    if matrix is not None:
        image = image @ matrix.T.astype(np.float32)
    alpha = planes.get("A")
    return _place(image, header), None if alpha is None else _place(np.asarray(alpha, np.float32), header)


def _choose_part(path: str | Path, names: list[set[str]]) -> tuple[int, str]:
    for colours in ("RGB", "YYY"):
        for part, channels in enumerate(names):
            if channels.issuperset(colours) and not (colours == "YYY" and "RY" in channels):
                return part, colours
    found = ", ".join(sorted(set().union(*names)))
    where = "no part has" if len(names) > 1 else "no"
    raise InputError(f"{path}: {where} channels R, G, B or Y, only {found}; export it as RGB")


def _check_exr(path: str | Path, headers: list[dict], header: dict, max_pixels: int) -> tuple[int, int]:
    """Width and height of the display window. Raises InputError for what the reader cannot take."""
    if header["type"] in (OpenEXR.deepscanline, OpenEXR.deeptile):
        raise InputError(f"{path}: holds deep pixels; flatten it")
    if any((channel.xSampling, channel.ySampling) != (1, 1) for channel in header["channels"]):
        raise InputError(f"{path}: subsampled channels; export it as full RGB")
    aspect = header.get("pixelAspectRatio", 1.0)
    if not abs(aspect - 1) < 0.01:
        raise InputError(f"{path}: its pixels are not square (aspect {aspect:g}); resample it to square pixels")
    stored = sum(width * height for width, height in (_window_size(each["dataWindow"]) for each in headers))
    width, height = _window_size(header["displayWindow"])
    stored = max(stored, width * height)
    if stored > max_pixels:
        raise InputError(f"{path}: {stored / 1e6:.0f} megapixels, more than {max_pixels / 1e6:.0f}; downscale it")
    return width, height


def _window_size(window: tuple[np.ndarray, np.ndarray]) -> tuple[int, int]:
    width, height = (int(high) - int(low) + 1 for low, high in zip(*window, strict=True))
    return width, height


def _place(pixels: np.ndarray, header: dict) -> np.ndarray:
    """Pixels `[H, W, ...]` of the data window in the display window, zero around them."""
    (left, top), _ = data = header["dataWindow"]
    (display_left, display_top), _ = display = header["displayWindow"]
    x, y = int(left) - int(display_left), int(top) - int(display_top)
    width, height = _window_size(display)
    if (x, y) == (0, 0) and _window_size(data) == (width, height):
        return pixels
    placed = np.zeros((height, width, *pixels.shape[2:]), pixels.dtype)
    inside = pixels[max(0, -y) : max(0, height - y), max(0, -x) : max(0, width - x)]
    placed[max(0, y) :, max(0, x) :][: inside.shape[0], : inside.shape[1]] = inside
    return placed


def write_exr(path: str | Path, image: np.ndarray) -> None:
    """Writes a 32-bit OpenEXR file of an image [H, W, 3] (channels RGB) or [H, W] (channel Y)."""
    pixels = np.ascontiguousarray(image, np.float32)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}

    def write(file: Path) -> None:
        try:
            with OpenEXR.File(header, {"RGB" if pixels.ndim == 3 else "Y": pixels}) as output:
                output.write(str(file))
        except RuntimeError as error:
            raise OSError(f"OpenEXR: {error}") from error

    write_through(path, write)


def write_png(path: str | Path, values: np.ndarray) -> None:
    """Writes a PNG file of display values in [0, 1], [H, W, 3] or [H, W]."""
    picture = Image.fromarray((np.clip(values, 0, 1) * 255 + 0.5).astype(np.uint8))
    write_through(path, lambda file: picture.save(file, format="PNG"))
