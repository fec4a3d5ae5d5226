"""What a photo file says about its colours: ICC profiles, the colour chunks of PNG, and the code points of CICP."""

import io
import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageCms

from sira_mi.colour import D50, REC_709, convert_to_rec709, srgb_to_linear, xyz_to_rec709
from sira_mi.errors import InputError

Curve = Callable[[np.ndarray], np.ndarray]  # coded values [N] in [0, 1] to linear ones, [N] or [N, 3]

_GREYS = ("1", "L", "LA", "La", "I;16", "I;16B", "I;16L", "I;16N")
_SRGB_TOLERANCE = 2  # levels of 255 between a profile's colours and sRGB's, from rounding in tables
_SRGB_GAMMA = (0.43, 0.48)  # gAMA values that stand for sRGB in PNG files without an sRGB chunk


@dataclass(frozen=True)
class Encoding:
    """How coded pixels become linear Rec.709: `profile` (to sRGB, of 8-bit strips), `curve`, and `matrix` in turn."""

    curve: Curve = srgb_to_linear
    matrix: np.ndarray | None = None  # [3, 3]
    profile: Callable[[Image.Image], Image.Image] | None = None


def read_encoding(path: Path, picture: Image.Image, is_deep: bool, notes: list[str]) -> Encoding:
    """The encoding that the file declares, sRGB if it declares none; what cannot be obeyed is noted.

    Raises `InputError` for HDR and video signals, which no photo to be fitted has."""
    if picture.format == "PNG":
        cicp = _find_after(path, b"cICP", "BBBB")
        if cicp is not None:
            primaries, transfer, matrix, is_full = cicp
            if matrix != 0 or is_full != 1:
                raise InputError(f"{path} holds a video signal (cICP {cicp}): save it as sRGB")
            return _read_cicp(path, primaries, transfer)
    icc = picture.info.get("icc_profile")
    if icc:
        return _read_profile(path, icc, picture.mode, is_deep, notes)
    if picture.mode == "CMYK":
        notes.append("CMYK without a colour profile: colours converted by the plain formula")
    if picture.format == "PNG":
        return _read_png_gamma(path, picture, notes)
    if picture.format == "HEIF" and picture.info.get("nclx_profile"):
        nclx = picture.info["nclx_profile"]
        return _read_cicp(path, int(nclx["color_primaries"]), int(nclx["transfer_characteristics"]))
    if picture.format == "AVIF":
        nclx = _find_after(path, b"colrnclx", ">HH")
        return Encoding() if nclx is None else _read_cicp(path, *nclx)
    return Encoding()


def _find_after(path: Path, name: bytes, layout: str) -> tuple[int, ...] | None:
    """The numbers after the first `name` in the file's header, where both formats keep their colour data."""
    with path.open("rb") as file:
        head = file.read(1 << 20).partition(b"IDAT")[0]
    found = head.find(name)
    data = head[found + len(name) :][: struct.calcsize(layout)] if found >= 0 else b""
    return struct.unpack(layout, data) if len(data) == struct.calcsize(layout) else None


def _read_png_gamma(path: Path, picture: Image.Image, notes: list[str]) -> Encoding:
    gamma, chromaticities = picture.info.get("gamma"), picture.info.get("chromaticity")
    if "srgb" in picture.info or (gamma is None and chromaticities is None):
        return Encoding()
    curve: Curve = srgb_to_linear
    if gamma is not None and not _SRGB_GAMMA[0] <= gamma <= _SRGB_GAMMA[1]:
        if not 0.1 <= gamma <= 2:
            notes.append(f"{path.name} has a gAMA chunk of {gamma:g}, which is no photo's: read as sRGB")
        else:
            curve = _power(1 / gamma)
    matrix = None
    if chromaticities is not None and picture.mode not in _GREYS:
        try:
            matrix = convert_to_rec709((*chromaticities[2:], *chromaticities[:2]))
        except ValueError:
            notes.append(f"{path.name} has a cHRM chunk that spans no RGB space: read as Rec.709")
    return Encoding(curve, matrix)


def _power(exponent: float) -> Curve:
    return lambda values: np.asarray(values, np.float32) ** np.float32(exponent)


def _rec709_to_linear(values: np.ndarray) -> np.ndarray:
    """The inverse of BT.709's opto-electronic transfer function."""
    values = np.asarray(values, np.float32)
    return np.where(values < 0.081, values / 4.5, ((np.maximum(values, 0) + 0.099) / 1.099) ** (1 / 0.45))


# Code points of ITU-T H.273, tables 2 and 3; 2 is "unspecified".
_D65 = REC_709[6:]
_PRIMARIES = {
    1: REC_709,
    2: REC_709,
    4: (0.67, 0.33, 0.21, 0.71, 0.14, 0.08, 0.310, 0.316),
    5: (0.64, 0.33, 0.29, 0.60, 0.15, 0.06, *_D65),
    6: (0.630, 0.340, 0.310, 0.595, 0.155, 0.070, *_D65),
    7: (0.630, 0.340, 0.310, 0.595, 0.155, 0.070, *_D65),
    9: (0.708, 0.292, 0.170, 0.797, 0.131, 0.046, *_D65),
    11: (0.680, 0.320, 0.265, 0.690, 0.150, 0.060, 0.314, 0.351),
    12: (0.680, 0.320, 0.265, 0.690, 0.150, 0.060, *_D65),
}
_TRANSFERS: dict[int, Curve] = {
    **dict.fromkeys((1, 6, 14, 15), _rec709_to_linear),
    **dict.fromkeys((2, 13), srgb_to_linear),
    4: _power(2.2),
    5: _power(2.8),
    8: _power(1.0),
}


def _read_cicp(path: Path, primaries: int, transfer: int) -> Encoding:
    if transfer in (16, 18):
        raise InputError(f"{path} is HDR ({'PQ' if transfer == 16 else 'HLG'}): save it as sRGB, or as linear EXR")
    if primaries not in _PRIMARIES or transfer not in _TRANSFERS:
        raise InputError(f"{path} has an unusual colour space (CICP {primaries}, {transfer}): save it as sRGB")
    return Encoding(_TRANSFERS[transfer], convert_to_rec709(_PRIMARIES[primaries]))


def _read_profile(path: Path, icc: bytes, mode: str, is_deep: bool, notes: list[str]) -> Encoding:
    """An embedded ICC profile: by Pillow's colour management at 8 bits, by the profile's curves and primaries, if it
    consists of these, at 16."""
    try:
        profile = ImageCms.ImageCmsProfile(io.BytesIO(icc))
        space = profile.profile.xcolor_space.strip()
        source_mode = {"RGB": "RGB", "GRAY": "L", "CMYK": "CMYK"}[space]
        if (source_mode == "CMYK") != (mode == "CMYK") or (source_mode == "L" and mode not in _GREYS):
            raise ValueError(f"a profile for {space} with pixels of mode {mode}")
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
        return Encoding()
    if source_mode == "RGB" and _is_srgb(transform):
        return Encoding()
    if is_deep:
        try:
            return _read_curves(icc, profile.profile, source_mode)
        except (KeyError, ValueError, struct.error):
            notes.append(f"{path.name} has 16 bits and a colour profile of tables: converted to sRGB at 8 bits")
    return Encoding(profile=lambda part: _apply(part.convert(source_mode), transform))


def _apply(part: Image.Image, transform: ImageCms.ImageCmsTransform) -> Image.Image:
    converted = ImageCms.applyTransform(part, transform)
    assert converted is not None  # applyTransform returns None only when it works in place
    return converted


def _is_srgb(transform: ImageCms.ImageCmsTransform) -> bool:
    """Whether the transform to sRGB leaves colours as they are: greys, primaries, and pairs of these, all levels."""
    levels = np.arange(256, dtype=np.uint8)
    mixtures = np.array([[(i >> c) & 1 for c in range(3)] for i in range(1, 8)], np.uint8)
    chart = levels[:, None, None] * mixtures
    shown = np.asarray(_apply(Image.fromarray(chart), transform))
    return bool(np.abs(shown.astype(int) - chart).max() <= _SRGB_TOLERANCE)


def _read_curves(icc: bytes, profile: Any, source_mode: str) -> Encoding:
    """The curves, and for RGB the primaries, of a profile that has no tables. Raises KeyError, ValueError or
    struct.error for any other."""
    tags = {name: icc[start : start + size] for name, start, size in struct.iter_unpack(">4sII", _tag_table(icc))}
    if b"A2B0" in tags or b"A2B1" in tags or source_mode == "CMYK":
        raise ValueError("a profile of tables")
    if source_mode == "L":
        return Encoding(_read_curve(tags[b"kTRC"]))
    curves = [_read_curve(tags[name]) for name in (b"rTRC", b"gTRC", b"bTRC")]
    colorants = (profile.red_colorant, profile.green_colorant, profile.blue_colorant)
    to_xyz = np.array([colorant[0] for colorant in colorants]).T
    return Encoding(lambda values: np.stack([curve(values) for curve in curves], -1), xyz_to_rec709(to_xyz, D50))


def _tag_table(icc: bytes) -> bytes:
    (count,) = struct.unpack_from(">I", icc, 128)
    return icc[132 : 132 + 12 * count]


def _read_curve(tag: bytes) -> Curve:
    """A curve of type `curv` or `para` (ICC.1:2022, sections 10.6 and 10.18)."""
    if tag[:4] == b"curv":
        (count,) = struct.unpack_from(">I", tag, 8)
        entries = np.frombuffer(tag, ">u2", count, 12).astype(np.float64)
        if count < 2:
            return _power(entries[0] / 256 if count else 1.0)
        return lambda values: np.interp(values, np.linspace(0, 1, count), entries / 65535)
    if tag[:4] != b"para":
        raise ValueError("an unknown type of curve")
    (kind,) = struct.unpack_from(">H", tag, 8)
    count = (1, 3, 4, 5, 7)[kind]
    given = [number / 65536 for number in struct.unpack_from(f">{count}i", tag, 12)]
    g, a, b, c, d, e, f = given + [0.0] * (7 - count)
    if kind == 0:
        return _power(g)
    if kind in (1, 2):
        c, d, e, f = 0.0, -b / a, c, c

    def curve(values: np.ndarray) -> np.ndarray:
        values = np.asarray(values, np.float64)
        return np.where(values >= d, np.maximum(a * values + b, 0) ** g + e, c * values + f)

    return curve
