"""The 468 face landmarks on any head of the pack: fixed barycentric coordinates on the constant topology."""

from functools import cache
from pathlib import Path

import numpy as np

# Written by `python -m studies.numerics.annotate_landmarks`.
BARYCENTRICS = Path(__file__).with_name("landmark_barycentrics.npz")


@cache
def landmark_barycentrics() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertex indices [468, 3] on `surface.head_surface`, barycentric weights [468, 3] and validity [468]."""
    with np.load(BARYCENTRICS) as data:
        return data["vertices"].astype(int), data["weights"].astype(float), data["valid"].astype(bool)


def mesh_landmarks(head: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Landmarks [468, 3] and validity [468] on head vertices [M, 3]."""
    vertices, weights, valid = landmark_barycentrics()
    return np.einsum("nk,nkd->nd", weights, head[vertices]), valid
