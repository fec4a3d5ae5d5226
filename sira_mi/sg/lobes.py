"""Spherical-Gaussian lobes: the tensor convention, evaluation, initial directions and unconstrained parameters.

A lobe is G(d) = μ exp(λ(d·ξ − 1)) with unit axis ξ, sharpness λ > 0 and linear RGB amplitude μ ≥ 0 (radiance). A set of
lobes is one tensor `lobes` `[N_l, 7]`: axis (3, normalised whenever it is used), sharpness, amplitude (3).
"""

import drjit as dr
import mitsuba as mi
import numpy as np

from sira_mi.fields.directions import fibonacci_directions


def lobe_count(lobes: "mi.TensorXf") -> int:
    """N_l of a tensor `[N_l, 7]`; ValueError for any other shape or for no lobe at all."""
    shape = tuple(lobes.shape)
    if len(shape) != 2 or shape[1] != 7 or shape[0] == 0:
        raise ValueError(f"lobes must have the shape [N_l, 7] with N_l > 0, not {list(shape)}")
    return shape[0]


def unpack_raw(packed: "mi.Float", index: "mi.UInt32 | int") -> tuple["mi.Vector3f", "mi.Float", "mi.Color3f"]:
    """Axis as stored, sharpness and amplitude of lobe `index` of the flat array behind `lobes` (`lobes.array`)."""
    offset = mi.UInt32(index) * 7
    value = [dr.gather(mi.Float, packed, offset + k) for k in range(7)]
    return mi.Vector3f(*value[:3]), value[3], mi.Color3f(*value[4:])


def unpack_lobe(packed: "mi.Float", index: "mi.UInt32 | int") -> tuple["mi.Vector3f", "mi.Float", "mi.Color3f"]:
    """Unit axis, sharpness and amplitude of lobe `index` of the flat array behind `lobes`."""
    axis, sharpness, amplitude = unpack_raw(packed, index)
    return dr.normalize(axis), sharpness, amplitude


def pack_lobes(axis: "mi.Vector3f", sharpness: "mi.Float", amplitude: "mi.Color3f") -> "mi.TensorXf":
    """The tensor `[N_l, 7]` of N_l-wide arrays; differentiable, and the axes are stored normalised."""
    axis = dr.normalize(axis)
    columns = mi.ArrayXf([axis.x, axis.y, axis.z, sharpness, amplitude.x, amplitude.y, amplitude.z])
    count = dr.width(columns)
    return mi.TensorXf(dr.ravel(columns), shape=(count, 7))


def evaluate_lobe(
    direction: "mi.Vector3f", axis: "mi.Vector3f", sharpness: "mi.Float", amplitude: "mi.Color3f"
) -> "mi.Color3f":
    """G(d) = μ exp(λ(d·ξ − 1)) for unit `direction` and `axis`; d·ξ − 1 = −½|d − ξ|² keeps sharp lobes exact."""
    return amplitude * dr.exp(-0.5 * sharpness * dr.squared_norm(direction - axis))


def evaluate_lobes(lobes: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Radiance `[..., 3]` of lobes `[N_l, 7]` in unit directions `[..., 3]`; NumPy, in the precision of its input."""
    axis = lobes[:, :3] / np.linalg.norm(lobes[:, :3], axis=1, keepdims=True)
    cosine = np.clip(directions @ axis.T, -1.0, 1.0)
    return np.exp(lobes[:, 3] * (cosine - 1.0)) @ lobes[:, 4:]


def initial_lobes(count: int, energy: float = 2.0 * np.pi, seed: int = 0) -> np.ndarray:
    """PhySG's start `[count, 7]` (float32): Fibonacci axes, sharpness 20 + |100·N(0, 1)|, grey, `energy` in all.

    `energy` is the total ∫ l dω of each channel, radiance times steradians, shared equally by the lobes."""
    sharpness = 20.0 + np.abs(100.0 * np.random.default_rng(seed).standard_normal(count))
    amplitude = energy / count * sharpness / (-2.0 * np.pi * np.expm1(-2.0 * sharpness))
    columns = [fibonacci_directions(count), sharpness[:, None], np.repeat(amplitude[:, None], 3, axis=1)]
    return np.concatenate(columns, axis=1).astype(np.float32)


def softplus(x: "mi.Float") -> "mi.Float":
    """log(1 + exp(x)), positive and free of overflow; also for tensors."""
    return dr.maximum(x, 0) + dr.log(1 + dr.exp(-dr.abs(x)))


def constrain(raw: "mi.TensorXf") -> "mi.TensorXf":
    """Lobes `[N_l, 7]` of unconstrained parameters of that shape: axis as it is (scale is free), sharpness
    exp(x), amplitude softplus(x). Differentiable; the inverse is `unconstrain`."""
    count = lobe_count(raw)
    value = mi.TensorXf(raw)
    axis, sharpness, amplitude = value[:, :3], dr.exp(value[:, 3:4]), softplus(value[:, 4:])
    parts = [dr.reshape(mi.TensorXf, part, (count, -1)) for part in (axis, sharpness, amplitude)]
    return dr.concat(parts, axis=1)


def unconstrain(lobes: np.ndarray, floor: float = 1e-6) -> np.ndarray:
    """The parameters `[N_l, 7]` (float32) that `constrain` maps to `lobes`; amplitudes below `floor` become it."""
    lobes = np.asarray(lobes, np.float64)
    amplitude = np.maximum(lobes[:, 4:], floor)
    inverse = amplitude + np.log(-np.expm1(-amplitude))
    return np.concatenate([lobes[:, :3], np.log(lobes[:, 3:4]), inverse], axis=1).astype(np.float32)
