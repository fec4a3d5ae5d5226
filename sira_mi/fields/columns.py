"""Tensors `[rows, N]`, one column a point: the form that networks take. Conversions from and to Dr.Jit's vectors (one
array a coordinate), evaluation in chunks, small helpers; all differentiable unless they say otherwise."""

import drjit as dr
import mitsuba as mi
import numpy as np

# Points evaluated at once where no gradient is recorded; bounds the memory of dense evaluations.
CHUNK = 1 << 16


def to_array(value):
    """A NumPy array as a Float if it is one-dimensional, else as a tensor; Dr.Jit arrays as they are."""
    if not isinstance(value, np.ndarray):
        return value
    value = np.ascontiguousarray(value, dtype=np.float32)
    return mi.Float(value) if value.ndim == 1 else mi.TensorXf(value)


def to_columns(vector):
    """A vector or point of N lanes -> tensor [3, N]; a Float -> tensor [1, N]."""
    if dr.depth_v(vector) == 1:
        return mi.TensorXf(vector, (1, dr.width(vector)))
    width = dr.width(vector)
    return dr.concat([mi.TensorXf(mi.Float(c) + dr.zeros(mi.Float, width), (1, width)) for c in vector], axis=0)


def gather_columns(vector, index):
    """`to_columns` of some lanes of a vector, point or Float."""
    return to_columns(dr.gather(type(vector), vector, index))


def from_columns(tensor, kind):
    """Tensor [rows, N] -> `kind`, a vector type of that many coordinates, or Float for one row."""
    rows, width = tensor.shape
    flat = tensor.array
    if rows == 1:
        return kind(flat)
    return kind(*(dr.gather(mi.Float, flat, dr.arange(mi.UInt32, width) + k * width) for k in range(rows)))


def scatter_columns(tensor, index, width: int, kind):
    """Tensor [rows, n] -> `kind` of `width` lanes: column j goes to lane index[j], the other lanes are zero."""
    result = dr.zeros(kind, width)
    dr.scatter(result, from_columns(tensor, kind), index)
    return result


def in_three(row, axis: int = 0):
    """A row repeated three times along `axis`. The adjoint of Dr.Jit's own broadcast is an atomic scatter, whose last
    bits vary with the order of threads; that of a concatenation is not."""
    return dr.concat([row, row, row], axis=axis)


def normalise(v):
    """Columns of v [3, N] scaled to unit length; columns shorter than 1e-6 stay finite."""
    square = v * v
    length = dr.sqrt(square[0:1, :] + square[1:2, :] + square[2:3, :] + 1e-12)
    return v / in_three(length)


def unit_columns(v: np.ndarray) -> np.ndarray:
    """`normalise` of a NumPy array [3, N]; columns shorter than 1e-6 stay shorter than 1."""
    return v / np.maximum(np.linalg.norm(v, axis=0), 1e-6)


def _padded_size(count: int) -> int:
    """The smallest of 2ᵏ and 3·2ᵏ⁻¹ that is not below `count`."""
    power = 1 << max(count - 1, 1).bit_length()
    return 3 * power // 4 if count <= 3 * power // 4 else power


def evaluate_in_chunks(function, *arrays: np.ndarray) -> list[np.ndarray]:
    """Applies `function` (tensors [rows, n] -> tensor or tuple of tensors) to the columns of `arrays` [rows, N],
    `CHUNK` at a time and without gradients; returns NumPy arrays [rows, N]. Chunks are padded with their last column to
    one of a few sizes, because every new size compiles its own kernels."""
    n = arrays[0].shape[1]
    parts = []
    with dr.suspend_grad():
        for start in range(0, n, CHUNK):
            piece = [np.asarray(a[:, start : start + CHUNK], dtype=np.float32) for a in arrays]
            count = piece[0].shape[1]
            piece = [np.pad(p, ((0, 0), (0, _padded_size(count) - count)), mode="edge") for p in piece]
            result = function(*(to_array(p) for p in piece))
            result = result if isinstance(result, tuple) else (result,)
            dr.eval(*result)
            parts.append([r.numpy()[:, :count] for r in result])
    return [np.concatenate(column, axis=1) for column in zip(*parts, strict=True)]
