"""Networks and the field in NumPy and float64, written from their definitions: what the fast ones are compared with."""

import numpy as np

from sira_mi.avatar.shape import HeadShape
from sira_mi.fields.sdf import SdfField


def head_field(avatar, **replaced) -> SdfField:
    """The avatar's field, with some parameters of its shape replaced by Floats."""
    return HeadShape(avatar.architecture).field(avatar.tensors | replaced)


def points_near_surface(count: int, seed: int = 3) -> np.ndarray:
    """[3, count] float32 points of a shell about the head's surface."""
    rng = np.random.default_rng(seed)
    x = rng.standard_normal((3, count))
    return (x / np.linalg.norm(x, axis=0) * rng.uniform(0.9, 1.9, count)).astype(np.float32)


def in_double(architecture, parameters: np.ndarray, latent: np.ndarray | None, h: np.ndarray) -> np.ndarray:
    """The network in NumPy and float64, written from its definition."""
    offset = 0
    for k, (weight, bias, shift) in enumerate(architecture.shapes()):
        sizes = [a * b for a, b in (weight, bias, shift)]
        w, b, z = np.split(parameters[offset : offset + sum(sizes)].astype(np.float64), np.cumsum(sizes)[:2])
        offset += sum(sizes)
        h = w.reshape(weight) @ h + b[:, None]
        if shift[1] and latent is not None:
            h = h + z.reshape(shift) @ latent.astype(np.float64)[:, None]
        if k < architecture.depth:
            h = np.logaddexp(0, 100 * h) / 100
    assert offset == len(parameters)
    return h


def encoded_in_double(x: np.ndarray, octaves: int) -> np.ndarray:
    phases = [2.0**k * c for k in range(octaves) for c in x]
    return np.stack([*x, *np.sin(phases), *np.cos(phases)]) if octaves else x


def field_in_double(avatar, x: np.ndarray) -> np.ndarray:
    """Signed distances [N] in float64."""
    networks, t, octaves = avatar.architecture.networks, avatar.tensors, avatar.architecture.sdf_octaves
    delta = in_double(networks["deformation"], t["deformation"], t["z_sdf"], encoded_in_double(x, octaves))[:3]
    return in_double(networks["reference"], t["reference"], None, encoded_in_double(x + delta, octaves))[0]
