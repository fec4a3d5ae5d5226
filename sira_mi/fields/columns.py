"""Between Dr.Jit's vectors (one array a coordinate) and the tensors `[rows, N]` that networks take; differentiable."""

import drjit as dr
import mitsuba as mi


def to_columns(vector):
    """A vector or point of N lanes -> tensor [3, N]; a Float -> tensor [1, N]."""
    if dr.depth_v(vector) == 1:
        return mi.TensorXf(vector, (1, dr.width(vector)))
    width = dr.width(vector)
    return dr.concat([mi.TensorXf(mi.Float(c) + dr.zeros(mi.Float, width), (1, width)) for c in vector], axis=0)


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
