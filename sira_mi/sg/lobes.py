"""Spherical-Gaussian lobes: the tensor convention and evaluation.

A lobe is G(d) = μ exp(λ(d·ξ − 1)) with unit axis ξ, sharpness λ > 0 and linear RGB amplitude μ ≥ 0 (radiance). A set of
lobes is one tensor `lobes` `[N_l, 7]`: axis (3, normalised whenever it is used), sharpness, amplitude (3).
"""

from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from sira_mi.sg.arrays import Color3f, Float, TensorXf, UInt32, Vector3f


def lobe_count(lobes: TensorXf) -> int:
    """N_l of a tensor `[N_l, 7]`; ValueError for any other shape or for no lobe at all."""
    shape = tuple(lobes.shape)
    if len(shape) != 2 or shape[1] != 7 or shape[0] == 0:
        raise ValueError(f"lobes must have the shape [N_l, 7] with N_l > 0, not {list(shape)}")
    return shape[0]


def unpack_raw(packed: Float, index: UInt32) -> tuple[Vector3f, Float, Color3f]:
    """Axis as stored, sharpness and amplitude of lobe `index` of the flat array behind `lobes` (`lobes.array`)."""
    offset = mi.UInt32(index) * 7
    value = [dr.gather(mi.Float, packed, offset + k) for k in range(7)]
    return mi.Vector3f(*value[:3]), value[3], mi.Color3f(*value[4:])


def unpack_lobe(packed: Float, index: UInt32) -> tuple[Vector3f, Float, Color3f]:
    """Unit axis, sharpness and amplitude of lobe `index` of the flat array behind `lobes`."""
    axis, sharpness, amplitude = unpack_raw(packed, index)
    return dr.normalize(axis), sharpness, amplitude


def interleave(columns: Sequence[Float]) -> Float:
    """The flat array of n records of columns that are n wide, the layout behind `lobes`."""
    array: Any = mi.ArrayXf  # the stubs call it an object
    return dr.ravel(array(list(columns)))


def evaluate_lobe(direction: Vector3f, axis: Vector3f, sharpness: Float, amplitude: Color3f) -> Color3f:
    """G(d) = μ exp(λ(d·ξ − 1)) for unit `direction` and `axis`; d·ξ − 1 = −½|d − ξ|² keeps sharp lobes exact."""
    return amplitude * dr.exp(-0.5 * sharpness * dr.squared_norm(direction - axis))


def evaluate_lobes(lobes: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Radiance `[..., 3]` of lobes `[N_l, 7]` in unit directions `[..., 3]`; NumPy, in the precision of its input."""
    axis = lobes[:, :3] / np.linalg.norm(lobes[:, :3], axis=1, keepdims=True)
    cosine = np.clip(directions @ axis.T, -1.0, 1.0)
    return np.exp(lobes[:, 3] * (cosine - 1.0)) @ lobes[:, 4:]


def scale_lobes(lobes: np.ndarray, factor: float) -> np.ndarray:
    """Lobes `[N_l, 7]` that are `factor` times as bright, in the precision of their own."""
    scaled = lobes.copy()
    scaled[:, 4:] *= factor
    return scaled


def lobe_integral(sharpness: np.ndarray) -> np.ndarray:
    """∫ exp(λ(ω·ξ − 1)) dω over the sphere, steradians; NumPy, for sharpness > 0."""
    return -2.0 * np.pi * np.expm1(-2.0 * sharpness) / sharpness
