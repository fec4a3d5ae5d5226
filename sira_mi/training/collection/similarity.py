"""Similarities between point sets: rotation, scale and shift in least squares (Umeyama 1991), also a robust fit."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sira_mi.training.collection.render import Part


@dataclass(frozen=True)
class Similarity:
    """x → scale · rotation x + shift."""

    scale: float
    rotation: np.ndarray  # [3, 3]
    shift: np.ndarray  # [3] units of the target

    def __call__(self, points: np.ndarray) -> np.ndarray:
        return self.scale * points @ self.rotation.T + self.shift

    def after(self, first: Similarity) -> Similarity:
        """The map that applies `first`, then this one."""
        return Similarity(self.scale * first.scale, self.rotation @ first.rotation, self(first.shift))

    def move(self, parts: list[Part]) -> list[Part]:
        """The parts in the target frame."""
        return [replace(p, vertices=self(p.vertices), normals=p.normals @ self.rotation.T) for p in parts]


def fit_similarity(
    source: np.ndarray, target: np.ndarray, weights: np.ndarray | None = None, scaled: bool = True
) -> Similarity:
    """The proper similarity (rigid motion unless `scaled`) that takes points [N, 3] closest to their partners [N, 3],
    weighted by `weights` [N]."""
    weights = np.ones(len(source)) if weights is None else weights
    share = weights / weights.sum()
    centre, goal = share @ source, share @ target
    a, b = source - centre, target - goal
    u, singular, vt = np.linalg.svd((share[:, None] * b).T @ a)
    flip = np.array([1, 1, np.sign(np.linalg.det(u @ vt))])
    rotation = (u * flip) @ vt
    scale = float((singular * flip).sum() / max((share[:, None] * a * a).sum(), 1e-30)) if scaled else 1.0
    return Similarity(scale, rotation, goal - scale * rotation @ centre)


def fit_robustly(source: np.ndarray, target: np.ndarray, scaled: bool) -> Similarity:
    """`fit_similarity`, reweighted five times so that partners that do not fit count less."""
    weights = np.ones(len(source))
    for _ in range(6):
        found = fit_similarity(source, target, weights, scaled)
        distance = np.linalg.norm(found(source) - target, axis=1)
        weights = 1 / (1 + (distance / max(np.median(distance), 1e-9)) ** 2)
    return found
