"""Where a head of the prior has its landmarks."""

import numpy as np

from sira_mi.avatar.file import Avatar
from sira_mi.avatar.landmark_model import LandmarkModel, place_landmarks, reference_landmarks
from sira_mi.fields.sdf import SdfField


def landmarks_of(prior: Avatar, field: SdfField) -> np.ndarray:
    """The landmarks [468, 3] of a head of the prior, given its field without motion; NaN where unknown."""
    known, x_ref = reference_landmarks(prior)
    start = np.ascontiguousarray(prior.tensors["landmarks"][known].T)
    landmarks = np.full((len(known), 3), np.nan, np.float32)
    landmarks[known] = LandmarkModel(prior)(place_landmarks(field, x_ref, start)).numpy().T
    return landmarks
