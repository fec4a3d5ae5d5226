"""The composed signed distance field, eqs 1-3: a deformation into reference space, then a reference SDF.

All functions work on tensors `[rows, N]`, one column a point, coordinates in scene units.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from sira_mi.fields.encoding import encode, encode_cooperative, encode_with_tangents
from sira_mi.fields.mlp import Architecture, evaluate, evaluate_cooperative, evaluate_with_tangents


@dataclass(frozen=True)
class SdfField:
    """The unpacked layers of both networks, the deformation's conditioned on the latents of the shape."""

    deformation: list[tuple]
    reference: list[tuple]
    octaves: int  # of the positional encoding of x and of x_ref
    motion: mi.TensorXf | None = None  # [3, 4] rigid, of points before they enter the networks; None for none


def sphere_parameters(architecture: Architecture, rng: np.random.Generator, radius: float) -> np.ndarray:
    """Geometric initialisation (Atzmon & Lipman 2020, as in IDR): flat parameters of a network whose value is close
    to |x| − radius; `radius` in scene units."""
    pieces = []
    for k, (weight, bias, latent) in enumerate(architecture.shapes()):
        if k < architecture.depth:
            matrix = rng.standard_normal(weight) * np.sqrt(2 / weight[0])
            if k == 0:
                matrix[:, 3:] = 0
            offset = np.zeros(bias)
        else:
            matrix = np.sqrt(np.pi / weight[1]) + 1e-4 * rng.standard_normal(weight)
            offset = np.full(bias, -radius)
        pieces += [matrix.ravel(), offset.ravel(), np.zeros(latent).ravel()]
    return np.concatenate(pieces).astype(np.float32)


def rigid_motion(pose):
    """[3, 4] matrix (R | t) of a pose [6, 1]: the rotation's vector in radians (exact to third order, a rotation for
    any), and t in scene units."""
    half = 0.5 * pose[0:3, :]
    w = 1 / dr.sqrt(1 + dr.sum(half * half, axis=0))
    w = dr.reshape(w, (1, 1))
    x, y, z = (w * half[k : k + 1, :] for k in range(3))
    one = w * 0 + 1
    rows = (
        (one - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), one - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), one - 2 * (x * x + y * y)),
    )
    return dr.concat([dr.concat([*row, pose[3 + k : 4 + k, :]], axis=1) for k, row in enumerate(rows)], axis=0)


def _move(field: SdfField, x):
    """Points [3, N] as the networks see them. One product: a broadcast's adjoint would be summed by atomics."""
    if field.motion is None:
        return x
    return field.motion @ dr.concat([x, dr.full(mi.TensorXf, 1.0, (1, x.shape[1]))], axis=0)


def deform(field: SdfField, x):
    """Eqs 1 and 2a: x [3, N] -> (x_ref = x + δ [3, N], γ [N_γ, N])."""
    x = _move(field, x)
    h = evaluate(field.deformation, encode(x, field.octaves))
    return x + h[:3, :], h[3:, :]


def deform_cooperative(packed, octaves: int, x: list) -> tuple[list, list]:
    """Eqs 1 and 2a in symbolic code: three Floats -> (x_ref as three Floats, γ as N_γ Floats)."""
    h = [mi.Float(a) for a in evaluate_cooperative(packed, encode_cooperative(x, octaves))]
    return [a + d for a, d in zip(x, h[:3], strict=True)], h[3:]


def signed_distance(field: SdfField, x):
    """Eqs 2b and 3: x [3, N] -> signed distance [1, N], negative inside."""
    x_ref, _ = deform(field, x)
    return evaluate(field.reference, encode(x_ref, field.octaves))


def _with_tangents(field: SdfField, x, tangents: list):
    x = _move(field, x)
    if field.motion is not None:
        tangents = [field.motion[:, 0:3] @ t for t in tangents]
    h, t = evaluate_with_tangents(field.deformation, *encode_with_tangents(x, tangents, field.octaves))
    x_ref, gamma = x + h[:3, :], h[3:, :]
    tangents = [a + b[:3, :] for a, b in zip(tangents, t, strict=True)]
    h, t = encode_with_tangents(x_ref, tangents, field.octaves)
    value, slopes = evaluate_with_tangents(field.reference, h, t)
    return value, slopes, x_ref, gamma


def signed_distance_and_slope(field: SdfField, x, direction):
    """Signed distance [1, N] and its derivative [1, N] along `direction` [3, N]."""
    value, (slope,), _, _ = _with_tangents(field, x, [direction])
    return value, slope


def surface(field: SdfField, x):
    """x [3, N] -> (signed distance [1, N], ∇f [3, N], x_ref [3, N], γ [N_γ, N]); ∇f is primal code, so that losses
    on it (eikonal, normals, shading) can be differentiated."""
    basis = np.eye(3, dtype=np.float32)
    n = x.shape[1]
    axes = [mi.TensorXf(np.repeat(basis[:, k : k + 1], n, axis=1)) for k in range(3)]
    value, slopes, x_ref, gamma = _with_tangents(field, x, axes)
    return value, dr.concat(slopes, axis=0), x_ref, gamma
