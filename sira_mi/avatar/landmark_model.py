"""Landmarks of the SA-SM's heads.

A landmark has about the same place in reference space on every head, because the deformation is trained with a loss on
landmarks. Mapping that place back into space gives a first estimate. A linear model, fitted to the training's heads in
the principal directions of these estimates, corrects it.
"""

import drjit as dr
import mitsuba as mi
import numpy as np

from sira_mi.avatar.file import Avatar
from sira_mi.avatar.shape import HeadShape, with_zero_latents
from sira_mi.fields.columns import evaluate_in_chunks, to_array
from sira_mi.fields.sdf import SdfField, deform

# Fixed-point steps that find a landmark's place from its place in reference space.
_STEPS = 4


def reference_landmarks(prior: Avatar) -> tuple[np.ndarray, np.ndarray]:
    """Which landmarks the mean head has, [468] bool, and where these L lie in reference space, [3, L]."""
    mean = prior.tensors["landmarks"]
    known = np.isfinite(mean).all(axis=1)
    field = HeadShape(prior.architecture).field(with_zero_latents(prior.tensors))
    return known, evaluate_in_chunks(lambda p: deform(field, p)[0], mean[known].T)[0]


def place_landmarks(field: SdfField, x_ref, start):
    """The points, a tensor [3, L], that the field maps to x_ref [3, L] in reference space, by fixed-point steps from
    `start` [3, L]. Without gradients."""
    with dr.suspend_grad():
        x, x_ref = mi.TensorXf(start), mi.TensorXf(x_ref)
        for _ in range(_STEPS):
            x = x - 0.8 * (deform(field, x)[0] - x_ref)
            dr.eval(x)
        return x


class LandmarkModel:
    """Corrects the landmarks that `place_landmarks` finds: mean + (placed − mean placed) · directionsᵀ · offsets, with
    the tensors `landmarks` [468, 3], `landmark_placed` [468, 3], `landmark_directions` [K, 468, 3] and
    `landmark_offsets` [K, 468, 3] of a prior. Without the last three it changes nothing."""

    def __init__(self, prior: Avatar):
        tensors = prior.tensors
        self.known = np.isfinite(tensors["landmarks"]).all(axis=1)
        self.linear = "landmark_directions" in tensors
        if self.linear:
            self.mean, self.placed = self._rows(tensors["landmarks"]), self._rows(tensors["landmark_placed"])
            self.across = to_array(self._rows(tensors["landmark_directions"]).numpy().T)
            self.offsets = self._rows(tensors["landmark_offsets"])

    def _rows(self, values: np.ndarray):
        """Tensor [..., 3 L] of [..., 468, 3], all x first."""
        values = np.moveaxis(values[..., self.known, :], -1, -2)
        return to_array(values.reshape(-1, 3 * int(self.known.sum())))

    def __call__(self, placed):
        """Tensor [3, L] of tensor [3, L]."""
        if not self.linear:
            return placed
        row: mi.TensorXf = dr.reshape(placed, (1, 3 * placed.shape[1]))
        w = (row - self.placed) @ self.across
        return dr.reshape(self.mean + w @ self.offsets, placed.shape)
