"""Fits the linear model that carries the SA-SM's landmarks to true ones (`sira_mi.avatar.landmark_model`)."""

import numpy as np

from sira_mi.avatar.file import Avatar

DIRECTIONS = 24  # K
_RIDGE = 1.0  # weight of the squared coefficients beside a sum over heads, scene units squared


def landmark_tensors(prior: Avatar, placed: np.ndarray, landmarks: np.ndarray) -> dict[str, np.ndarray]:
    """The tensors of `LandmarkModel`, by ridge regression over S heads of the prior. `placed` [S, 468, 3] are their
    landmarks by `landmarks_of` without a model, `landmarks` [S, 468, 3] the true ones; those that a head lacks count as
    the mean head's."""
    known = np.isfinite(prior.tensors["landmarks"]).all(axis=1)
    mean = prior.tensors["landmarks"][known]
    true = landmarks[:, known] - mean
    true = np.where(np.isfinite(true), true, 0).reshape(len(true), -1)
    placed = placed[:, known]
    middle = placed.mean(axis=0)
    rest = (placed - middle).reshape(len(placed), -1)
    directions = np.linalg.svd(rest, full_matrices=False)[2][:DIRECTIONS]
    w = rest @ directions.T
    coefficients = np.linalg.solve(w.T @ w + _RIDGE * np.eye(len(directions)), w.T @ true)
    count = len(directions)
    tensors = {
        "landmark_placed": np.zeros((len(known), 3), np.float32),
        "landmark_directions": np.zeros((count, len(known), 3), np.float32),
        "landmark_offsets": np.zeros((count, len(known), 3), np.float32),
    }
    tensors["landmark_placed"][known] = middle
    tensors["landmark_directions"][:, known] = directions.reshape(count, -1, 3)
    tensors["landmark_offsets"][:, known] = coefficients.reshape(count, -1, 3)
    return tensors
