"""The 468 face landmarks on any head of the pack: fixed barycentric coordinates on the constant topology."""

from functools import cache
from importlib import resources

import numpy as np

from sira_mi.conventions import LANDMARKS


@cache
def landmark_barycentrics() -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Vertex indices [468, 3] on `surface.head_surface`, barycentric weights [468, 3] and validity [468]."""
    path = resources.files("sira_mi.training.collection") / "data" / "landmark_barycentrics.npz"
    if not path.is_file():
        return None
    with path.open("rb") as file, np.load(file) as data:
        return data["vertices"].astype(int), data["weights"].astype(float), data["valid"].astype(bool)


def mesh_landmarks(head: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Landmarks [468, 3] and validity [468] on head vertices [M, 3]."""
    stored = landmark_barycentrics()
    if stored is None:
        return np.zeros((LANDMARKS, 3)), np.zeros(LANDMARKS, bool)
    vertices, weights, valid = stored
    return np.einsum("nk,nkd->nd", weights, head[vertices]), valid
