"""Writes files whole or not at all; reads and writes the image formats of the project."""

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import OpenEXR
from PIL import Image

from sira_mi.errors import InputError


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


def read_exr(path: str | Path) -> tuple[np.ndarray, np.ndarray | None]:
    """The image [H, W, 3], float32, of an OpenEXR file (channels R, G and B, or Y), and its alpha [H, W] if it has one.

    Raises InputError for any other file, subsampled channels, and colours that are not finite."""
    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            channels = {name: channel.pixels for name, channel in file.channels().items()}
    except Exception:  # OpenEXR raises bare RuntimeError and others
        raise InputError(f"{path}: not a readable OpenEXR image; export it again") from None
    names = next((n for n in ("RGB", "YYY") if all(c in channels for c in n)), None)
    if names is None or (names == "YYY" and "RY" in channels):
        raise InputError(f"{path}: no channels R, G, B or Y, only {', '.join(sorted(channels))}; export it as RGB")
    planes = [np.asarray(channels[name], np.float32) for name in names]
    if any(plane.shape != planes[0].shape for plane in planes):
        raise InputError(f"{path}: subsampled channels; export it as full RGB")
    image = np.stack(planes, axis=-1)
    if not np.isfinite(image).all():
        raise InputError(f"{path}: holds values that are not finite (NaN or infinite)")
    return image, channels.get("A")


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
