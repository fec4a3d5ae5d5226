"""Samples of a pixel that see almost the same place share a shading: coverage by sample, shading by pixel."""

import numpy as np

# Samples share a shading when all of their pixel hit, none farther than this from the one in their middle, scene units,
REACH = 0.04
# and with normals whose cosine with that one's is at least this (15 degrees).
COSINE = 0.966


def representative_samples(position: np.ndarray, normal: np.ndarray, hit: np.ndarray, samples: int) -> np.ndarray:
    """Index [N] of the sample whose shading each sample takes: its own, or the middle sample of its pixel. `samples`
    consecutive columns of positions and unit normals [3, N] are a pixel; `hit` [N] is bool."""
    own = np.arange(hit.size)
    shape = hit.size // samples, samples
    p, n = position.reshape(3, *shape), normal.reshape(3, *shape)
    middle = ((p - p.mean(axis=2, keepdims=True)) ** 2).sum(axis=0).argmin(axis=1)[:, None]
    at_middle = np.broadcast_to(middle, (3, *middle.shape))
    p_middle, n_middle = (np.take_along_axis(v, at_middle, axis=2) for v in (p, n))
    near = ((p - p_middle) ** 2).sum(axis=0) <= REACH**2
    alike = (n * n_middle).sum(axis=0) >= COSINE
    together = (hit.reshape(shape) & near & alike).all(axis=1, keepdims=True)
    return np.where(together, own.reshape(shape)[:, :1] + middle, own.reshape(shape)).ravel()
