"""Positional encoding: x -> (x, sin(2ᵏ x), cos(2ᵏ x)) for k = 0 … octaves − 1 (IDR's, with x kept).

Feature order: the three coordinates, then all sines (octave by octave, x y z within one), then all cosines.
"""

import drjit as dr
import mitsuba as mi
import numpy as np


def encoded_size(octaves: int) -> int:
    """Number of features of an encoded 3D point."""
    return 3 + 6 * octaves


def _frequencies(octaves: int) -> np.ndarray:
    """[3·octaves, 3]: row 3k + i is 2ᵏ times the i-th unit vector."""
    return np.concatenate([2.0**k * np.eye(3) for k in range(octaves)]).astype(np.float32)


def encode(x, octaves: int):
    """Tensor mode: x [3, N] -> features [3 + 6·octaves, N]."""
    if octaves == 0:
        return x
    phase = mi.TensorXf(_frequencies(octaves)) @ x
    return dr.concat([x, dr.sin(phase), dr.cos(phase)], axis=0)


def encode_with_tangents(x, tangents: list, octaves: int):
    """`encode` of x [3, N] and of directional derivatives of x: (features, derivatives of the features)."""
    if octaves == 0:
        return x, tangents
    frequencies = mi.TensorXf(_frequencies(octaves))
    phase = frequencies @ x
    sine, cosine = dr.sin(phase), dr.cos(phase)
    features = dr.concat([x, sine, cosine], axis=0)
    slopes = [frequencies @ t for t in tangents]
    return features, [dr.concat([t, cosine * s, -sine * s], axis=0) for t, s in zip(tangents, slopes, strict=True)]


def encode_cooperative(x: list, octaves: int) -> list:
    """Symbolic mode: three Floats -> a list of 3 + 6·octaves Floats in the same order."""
    phases = [c * 2.0**k for k in range(octaves) for c in x]
    return [*x, *(dr.sin(p) for p in phases), *(dr.cos(p) for p in phases)]
