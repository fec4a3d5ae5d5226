"""The sRGB transfer function, and RGB colour spaces by the chromaticities of their primaries and white point."""

from collections.abc import Sequence

import numpy as np

REC_709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)  # x and y of red, green, blue and white
D50 = np.array([0.9642, 1.0, 0.8249])  # XYZ of the white that ICC profiles refer to

_BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])


def srgb_to_linear(values: np.ndarray) -> np.ndarray:
    """sRGB-coded values `[...]` in [0, 1] to linear ones (IEC 61966-2-1)."""
    values = np.asarray(values, np.float32)
    return np.where(values <= 0.04045, values / 12.92, ((np.maximum(values, 0) + 0.055) / 1.055) ** 2.4)


def linear_to_srgb(values: np.ndarray) -> np.ndarray:
    """Linear values `[...]`, clipped to [0, 1], to sRGB-coded ones (IEC 61966-2-1)."""
    values = np.clip(np.asarray(values, np.float32), 0, 1)
    return np.where(values <= 0.0031308, values * 12.92, 1.055 * values ** (1 / 2.4) - 0.055)


def convert_to_rec709(chromaticities: Sequence[float]) -> np.ndarray | None:
    """The matrix `[3, 3]` from linear RGB of the given primaries and white (x, y of red, green, blue and white) to
    linear Rec.709, white to white (Bradford); None where the spaces are the same. Raises `ValueError` where the
    primaries span no RGB space."""
    if len(chromaticities) != 8 or not np.isfinite(chromaticities).all():
        raise ValueError("eight finite chromaticities are needed")
    if np.abs(np.subtract(chromaticities, REC_709)).max() < 1e-3:
        return None
    return xyz_to_rec709(*_to_xyz(chromaticities))


def xyz_to_rec709(to_xyz: np.ndarray, white: np.ndarray) -> np.ndarray:
    """The matrix `[3, 3]` from an RGB space to linear Rec.709, by that space's matrix to XYZ `[3, 3]` and its white's
    XYZ `[3]`."""
    rec709, d65 = _to_xyz(REC_709)
    gains = (_BRADFORD @ d65) / (_BRADFORD @ white)
    return np.linalg.solve(_BRADFORD @ rec709, gains[:, None] * (_BRADFORD @ to_xyz))


def _to_xyz(chromaticities: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
    x, y = np.asarray(chromaticities, np.float64).reshape(4, 2).T
    columns = np.stack([x, y, 1 - x - y])
    if abs(np.linalg.det(columns[:, :3])) < 1e-6 or y[3] <= 0:
        raise ValueError("the primaries span no RGB space")
    white = columns[:, 3] / y[3]
    return columns[:, :3] * np.linalg.solve(columns[:, :3], white), white
