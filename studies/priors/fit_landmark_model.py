"""Fits where a prior's heads carry their landmarks, from scans of training heads: the tensors of
`sira_mi.avatar.landmark_model`."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sira_mi.avatar.file import LANDMARK_MODEL, Avatar
from sira_mi.avatar.landmark_model import LandmarkModel
from sira_mi.conventions import MILLIMETRES_PER_UNIT
from sira_mi.errors import InputError
from sira_mi.fields.columns import to_array
from sira_mi.training.scenes import TrainingScene
from sira_mi.training.shape_model import ShapeModel
from studies.head_landmarks import landmarks_of
from studies.priors.landmark_regression import landmark_tensors
from studies.priors.shape_measures import ShapeFit, fit_shape

_FOLDS = 8


@dataclass(frozen=True, eq=False)
class Places:
    """The landmarks of some heads, in scene units."""

    placed: np.ndarray  # [S, 468, 3] where the prior's field has them, NaN where the mean head has none
    true: np.ndarray  # [S, 468, 3], NaN where unknown


def without_landmark_model(prior: Avatar) -> Avatar:
    """The prior without a model of landmarks."""
    kept = {name: values for name, values in prior.tensors.items() if name not in LANDMARK_MODEL}
    return replace(prior, tensors=kept)


def place_landmarks(prior: Avatar, scenes: Sequence[TrainingScene], fit: ShapeFit | None = None) -> Places:
    """The landmarks of scanned heads and of the prior's heads that are fitted to the scans."""
    model, prior = ShapeModel.of_prior(prior), without_landmark_model(prior)
    w = fit_shape(model, scenes, fit)
    placed = [landmarks_of(prior, model.field(model.latent("z_sdf", w[:, k]))) for k in range(len(scenes))]
    return Places(np.stack(placed), np.stack([scene.landmarks for scene in scenes]))


def add_landmark_model(prior: Avatar, found: Places) -> Avatar:
    return prior.with_tensors(**landmark_tensors(prior, found.placed, found.true))


def measure_held_out_errors(prior: Avatar, found: Places) -> tuple[float, float]:
    """Mean distance in mm to the true landmarks, of placed and of modelled ones, cross-validated over heads. Raises
    InputError for too few heads."""
    count = len(found.placed)
    if count < 2 * _FOLDS:
        raise InputError(f"{count} training heads: {2 * _FOLDS} are needed")
    known = np.isfinite(prior.tensors["landmarks"]).all(axis=1)
    fold = np.arange(count) % _FOLDS
    modelled = np.full_like(found.placed, np.nan)
    for k in range(_FOLDS):
        others = Places(found.placed[fold != k], found.true[fold != k])
        model = LandmarkModel(add_landmark_model(prior, others))
        for head in np.flatnonzero(fold == k):
            placed = to_array(found.placed[head, known].T)
            modelled[head, known] = model(placed).numpy().T
    before, after = (np.linalg.norm(landmarks - found.true, axis=2) for landmarks in (found.placed, modelled))
    return float(np.nanmean(before)) * MILLIMETRES_PER_UNIT, float(np.nanmean(after)) * MILLIMETRES_PER_UNIT
