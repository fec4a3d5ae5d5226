"""Alignment of a predicted head with the true one: by six landmarks, by robust ICP with scale, or by the camera.

All maps are similarities from the prediction's world to the truth's.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from sira_mi.errors import InputError
from sira_mi.portrait.camera import Camera
from sira_mi.portrait.landmarks import INNER_EYE_CORNERS, MOUTH_CORNERS, NOSE_BASE, NOSE_TIP
from sira_mi.training.collection.similarity import Similarity, fit_similarity
from studies.portraits.surface_distance import TriangleTree

# The landmarks of H3DS among the 468: inner corners of the right and the left eye, tip and base of the nose, right and
# left corner of the mouth. The base is the foot of the columella, as the point below it is hidden on some scans.
SIX_LANDMARKS = (*INNER_EYE_CORNERS, NOSE_TIP, NOSE_BASE, *MOUTH_CORNERS)
_FEWEST_LANDMARKS = 4


@dataclass(frozen=True)
class Icp:
    """Settings of `icp`."""

    iterations: int = 30
    kept: float = 0.9  # share of the points that count, the closest to the surface
    damping: float = 1e-3  # weight of each point's squared motion beside its squared distance to the tangent plane


def select_shared_landmarks(predicted: np.ndarray, truth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The six landmarks that both sides know, from arrays [468, 3] with NaN where unknown: [n, 3] of each.

    Raises InputError for fewer than four."""
    six = np.array(SIX_LANDMARKS)
    known = six[np.isfinite(predicted[six]).all(axis=1) & np.isfinite(truth[six]).all(axis=1)]
    if len(known) < _FEWEST_LANDMARKS:
        raise InputError(
            f"only {len(known)} of the landmarks {', '.join(map(str, SIX_LANDMARKS))} are known on both the prediction "
            f"and the truth: {_FEWEST_LANDMARKS} are needed"
        )
    return np.asarray(predicted[known], np.float64), np.asarray(truth[known], np.float64)


def landmark_alignment(predicted: np.ndarray, truth: np.ndarray) -> Similarity:
    """Procrustes analysis of landmarks [n, 3] (Umeyama 1991)."""
    return fit_similarity(predicted, truth)


def inverse(map: Similarity) -> Similarity:
    """The map from the target back to the source."""
    return Similarity(1 / map.scale, map.rotation.T, -(map.shift @ map.rotation) / map.scale)


def distances_from(points: np.ndarray, tree: TriangleTree, map: Similarity) -> np.ndarray:
    """Distances [P], in the target's units, from points [P, 3] to the mesh of `tree` after it is mapped by `map`."""
    return map.scale * tree.nearest(inverse(map)(points))[0]


def icp(points: np.ndarray, tree: TriangleTree, start: Similarity, settings: Icp | None = None) -> Similarity:
    """The similarity that brings the mesh of `tree` closest to points [P, 3] of the truth, from `start` on: damped
    Gauss-Newton steps of rotation, shift and scale on the distances of points to the tangent planes at their closest
    points on the mesh (Chen and Medioni 1992), the farthest points left out (trimmed ICP, Chetverikov et al. 2002)."""
    settings = settings or Icp()
    current = start
    for _ in range(settings.iterations):
        distance, found, face = tree.nearest(inverse(current)(points))
        kept = distance <= np.quantile(distance, settings.kept)
        on = current(found[kept])
        current = _step(on, tree.normals[face[kept]] @ current.rotation.T, points[kept], settings.damping).after(
            current
        )
    return current


def _step(points, normals, goals, damping):
    """The small similarity that moves points [P, 3] onto the planes through `goals` with their own normals."""
    centre = points.mean(axis=0)
    arm = points - centre

    def rows(direction):
        return np.column_stack([np.cross(arm, direction), direction, (arm * direction).sum(axis=1)])

    plane = rows(normals)
    matrix = plane.T @ plane
    for axis in np.eye(3):
        motion = rows(np.broadcast_to(axis, arm.shape))
        matrix += damping * motion.T @ motion
    turn_shift_scale = np.linalg.solve(matrix, plane.T @ ((goals - points) * normals).sum(axis=1))
    rotation = Rotation.from_rotvec(turn_shift_scale[:3]).as_matrix()
    scale = float(np.exp(turn_shift_scale[6]))
    return Similarity(scale, rotation, centre + turn_shift_scale[3:6] - scale * rotation @ centre)


def camera_scale(predicted: np.ndarray, truth: np.ndarray, predicted_camera: Camera, truth_camera: Camera) -> float:
    """The scale about the camera's centre that fits the prediction's landmarks [n, 3] to the truth's in least squares,
    each in its own camera's coordinates. A single photo does not determine it: size and distance are ambiguous."""
    p, t = _local(predicted, predicted_camera), _local(truth, truth_camera)
    return float((p * t).sum() / (p * p).sum())


def camera_alignment(predicted: Camera, truth: Camera, scale: float = 1.0) -> Similarity:
    """The map from one camera to the other, with the prediction scaled about its camera's centre."""
    back = truth.world_to_camera[:3, :3].T
    shift = scale * predicted.world_to_camera[:3, 3] - truth.world_to_camera[:3, 3]
    return Similarity(scale, back @ predicted.world_to_camera[:3, :3], back @ shift)


def _local(points, camera):
    return points @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
