"""Checks and reads a user's files; writes files whole or not at all; the image formats of the project."""

import contextlib
import io
import json
import math
import os
import stat
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
from filelock import FileLock, Timeout
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from sira_mi.colour import REC_709, convert_to_rec709
from sira_mi.errors import InputError

MAX_EXR_PIXELS = 1 << 29  # of all parts together
# Of a JSON file, unless its reader says otherwise.
_MAXIMUM_JSON_BYTES = 4 << 20
# How the names of temporary files begin; the number of the process follows.
_TEMPORARY = ".sira_mi."
_LOCK = ".lock"
# What pictures name as the software that wrote them, in the first bytes of their files.
_SOFTWARE = "sira_mi relightable heads"
_HEADER_BYTES = 4096


def write_through(path: str | Path, write: Callable[[Path], object]) -> None:
    """Calls `write` with a temporary path beside `path` that has the same suffix, then renames the file.

    Raises InputError when the folder cannot be written or the disk is full; the temporary file is removed, and so are
    those of processes that have been killed."""
    path = Path(path)
    temporary = path.with_name(f"{_TEMPORARY}{os.getpid()}.{threading.get_ident()}{path.suffix}")
    try:
        _remove_leftovers(path.parent)
        write(temporary)
        os.replace(temporary, path)
    except OSError as error:
        raise InputError(
            f"cannot write {path}: {error.strerror or error}; choose another place or free some"
        ) from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink()


def _remove_leftovers(folder: Path) -> None:
    """Removes the temporary files of processes that run no more."""
    for file in folder.glob(f"{_TEMPORARY}*"):
        process = file.name.removeprefix(_TEMPORARY).split(".")[0]
        if process.isdecimal() and not _is_running(int(process)):
            with contextlib.suppress(OSError):  # open in another process, on Windows, or not of this user
                file.unlink()


def _is_running(process: int) -> bool:
    """On Windows, which does not remove open files, always False except for this process."""
    if os.name == "nt" or process == os.getpid():
        return process == os.getpid()
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):
        return True
    return True


@contextlib.contextmanager
def hold_folder(folder: Path) -> Iterator[None]:
    """Makes `folder` and holds it until the block or the process ends, however that ends. At the end it removes the
    folders that it has made, and that are still empty.

    Raises InputError when another run holds it, or when it cannot be made or written."""
    made = [place for place in (folder, *folder.parents) if not os.path.lexists(place)]
    lock = FileLock(folder / _LOCK)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock.acquire(timeout=0)
    except Timeout:
        raise InputError(f"another run is writing to {folder}; wait for its end, or choose another --out") from None
    except NotImplementedError:
        print(f"note: the disk of {folder} knows no locks; start no second run there", file=sys.stderr)
    except OSError as error:
        raise InputError(f"cannot write to {folder}: {error.strerror}; choose another --out") from error
    try:
        yield
    finally:
        lock.release()
        with contextlib.suppress(OSError):
            (folder / _LOCK).unlink()
            for place in made:
                place.rmdir()


def check_outputs(outputs: Iterable[Path], inputs: Iterable[Path | None]) -> None:
    """Raises InputError when a file of `outputs` is one of `inputs`, a folder, or has a name that no file can have."""
    read = [path for path in inputs if path is not None and path.exists()]
    for output in outputs:
        try:
            output.lstat()
        except FileNotFoundError:
            continue
        except OSError as error:
            raise InputError(f"cannot write {output}: {error.strerror}; choose another --out") from error
        if output.is_dir():
            raise InputError(f"{output} is a folder, and a file is to be written there; choose another --out")
        if any(output.samefile(path) for path in read if output.exists()):
            raise InputError(f"{output} is an input, and would be overwritten; choose another --out")


def check_own(pictures: Iterable[Path]) -> None:
    """Raises InputError when a file of `pictures` is there and was not written by `write_png` or `write_exr`: it may be
    the user's photo or environment."""
    for path in pictures:
        try:
            with path.open("rb") as file:
                own = _SOFTWARE.encode() in file.read(_HEADER_BYTES)
        except FileNotFoundError:
            continue
        except OSError as error:
            raise InputError(f"cannot replace {path}: {error.strerror}; choose another --out") from error
        if not own:
            raise InputError(f"{path} is no picture of this program, and would be overwritten; choose another --out")


def write_text(path: str | Path, text: str) -> None:
    """A text file in UTF-8. Raises InputError as `write_through` does."""
    write_through(path, lambda file: file.write_text(text, encoding="utf-8"))


def check_file(path: str | Path, what: str, largest: int | None = None) -> Path:
    """The path of a user's file, which messages call `what`; `largest` is the most bytes that it may have.

    Raises InputError unless it is a regular file, neither empty nor too large, that can be read. Pipes and devices are
    never opened."""
    path = Path(path)
    try:
        os.fspath(path).encode()
        status = path.stat()
        if stat.S_ISDIR(status.st_mode):
            raise InputError(f"{path} is a folder: the {what} must be a file")
        if not stat.S_ISREG(status.st_mode):
            raise InputError(f"{path} is a pipe or a device: the {what} must be a file")
        with path.open("rb"):
            pass
    except (FileNotFoundError, NotADirectoryError):
        raise InputError(f"{path}: no such {what} file") from None
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}") from None
    except ValueError:  # a null byte, or bytes that are not UTF-8
        raise InputError(f"{str(path)!r} is no file name in UTF-8: rename the {what} file") from None
    if status.st_size == 0:
        raise InputError(f"{path} is an empty file, no {what}")
    if largest is not None and status.st_size > largest:
        raise InputError(f"{path} has {status.st_size / 2**20:.1f} MB: larger than any {what} ({largest >> 20} MB)")
    return path


def read_json(path: str | Path, what: str, largest: int = _MAXIMUM_JSON_BYTES) -> Any:
    """The contents of a user's JSON file. Raises InputError as `check_file` and `parse_json` do."""
    path = check_file(path, what, largest)
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}") from None
    return parse_json(data, str(path))


def parse_json(text: str | bytes, source: str) -> Any:
    """JSON text as Python objects; bytes are UTF-8, UTF-16 or UTF-32, with or without a byte order mark.

    Raises InputError that names `source` for anything else, and for numbers that are not finite in float64."""

    def check(number: str) -> str:
        if not math.isfinite(float(number)):
            shown = number if len(number) < 20 else f"{number[:16]}..."
            raise InputError(f"{source} contains NaN or infinity ({shown})")
        return number

    try:
        return json.loads(
            text,
            parse_int=lambda number: int(check(number)),
            parse_float=lambda number: float(check(number)),
            parse_constant=check,
        )
    except (ValueError, RecursionError) as error:
        raise InputError(f"{source} is not JSON: {error}") from None


_READING_EXR = threading.Lock()


@contextlib.contextmanager
def _silence_openexr() -> Iterator[None]:
    """OpenEXR writes its complaints to file descriptor 2 from C, and to Python's standard output; both belong to the
    whole process, so that only one thread at a time reads an OpenEXR file."""
    with _READING_EXR, contextlib.ExitStack() as stack:
        nowhere = os.open(os.devnull, os.O_WRONLY)
        stack.callback(os.close, nowhere)
        try:
            terminal = os.dup(2)
        except OSError:  # the program runs without a standard error
            terminal = os.dup(nowhere)
        stack.callback(os.close, terminal)
        stack.callback(os.dup2, terminal, 2)
        os.dup2(nowhere, 2)
        stack.enter_context(contextlib.redirect_stdout(io.StringIO()))
        yield


def read_exr(
    path: str | Path, check_size: Callable[[int, int], None] | None = None, max_pixels: int = MAX_EXR_PIXELS
) -> tuple[np.ndarray, np.ndarray | None]:
    """The image [H, W, 3], float32 linear Rec.709, of an OpenEXR file, and its alpha [H, W] if it has one.

    The picture is that of the first part with channels R, G and B, or else Y; it fills the display window, black where
    the file stores nothing. Other primaries are converted. `check_size` gets width and height before pixels are
    decoded. Raises InputError for any other file, more than `max_pixels` in all parts together, subsampled channels,
    pixels that are not square, and colours that are not finite."""
    try:
        with _silence_openexr():
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
        with _silence_openexr(), OpenEXR.File(str(path), separate_channels=True) as file:
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
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, "software": _SOFTWARE}

    def write(file: Path) -> None:
        content = io.BytesIO()  # OpenEXR opens no paths that are not UTF-8
        with OpenEXR.File(header, {"RGB" if pixels.ndim == 3 else "Y": pixels}) as output:
            output.write(content)
        file.write_bytes(content.getvalue())

    write_through(path, write)


def write_png(path: str | Path, values: np.ndarray) -> None:
    """Writes a PNG file of display values in [0, 1], [H, W, 3] or [H, W]."""
    picture = Image.fromarray((np.clip(values, 0, 1) * 255 + 0.5).astype(np.uint8))
    header = PngInfo()
    header.add_text("Software", _SOFTWARE)
    write_through(path, lambda file: picture.save(file, format="PNG", pnginfo=header))
