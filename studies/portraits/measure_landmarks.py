"""Errors of detected landmarks on portraits of training heads, and the correction of `sira_mi.portrait.head_landmarks`
by least squares."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from tqdm import tqdm

from sira_mi.errors import InputError
from sira_mi.portrait.face import Face, find_faces
from sira_mi.portrait.head_landmarks import (
    TERMS,
    LandmarkCorrection,
    correct_landmarks,
    evaluate_polynomial,
    find_rotation,
    find_upright_axes,
    find_view_direction,
)
from sira_mi.portrait.load import DEFAULT_MAX_PIXELS, load_photo
from sira_mi.portrait.portrait import make_display_image
from studies.portraits.benchmark import photo_of, read_benchmark, truth_of
from studies.portraits.truth import load_truth

_ALIGNMENTS = 5  # passes of the mean face
_ELSEWHERE = 0.25  # face sizes: a face further off than this is somewhere else
_FOLDS = 8
_LEAST_HEADS = 2 * _FOLDS


@dataclass(frozen=True, eq=False)
class Observation:
    """The landmarks of one portrait."""

    head: str
    face: Face
    true: np.ndarray  # [468, 2] pixels of the photo, NaN where unknown

    @property
    def offset(self) -> np.ndarray:
        """From found to true [468, 2], in face sizes along the axes of the upright face."""
        return (self.true - self.face.landmarks) @ find_upright_axes(self.face).T / self.face.size


def observe(benchmark: Path) -> tuple[list[Observation], list[str]]:
    """The landmarks of the portraits of training heads in a folder, and the names of portraits without a detected face.
    Raises InputError for portraits of test heads."""
    found, blind = [], []
    for entry in tqdm(read_benchmark(benchmark, "train"), unit="portrait", dynamic_ncols=True):
        name = entry["name"]
        truth = load_truth(truth_of(benchmark, name) / "truth.npz")
        known = np.isfinite(truth.landmarks).all(axis=1)
        true = np.full((len(truth.landmarks), 2), np.nan)
        true[known] = truth.camera.project(truth.landmarks[known])
        faces = find_faces(make_display_image(load_photo(photo_of(benchmark, name), DEFAULT_MAX_PIXELS).image))
        observations = [Observation(entry["identity"], face, true) for face in faces]
        near = [o for o in observations if np.nanmean(np.abs(o.offset)) < _ELSEWHERE]
        if near:
            found.append(near[0])
        else:
            blind.append(name)
    return found, blind


def fit_correction(observations: list[Observation]) -> LandmarkCorrection:
    """Least-squares fit of the offsets by the polynomial of the viewing direction. Unknown landmarks of a head count as
    the mean of the other heads'."""
    mean = _mean_face(observations)
    directions = np.stack([find_view_direction(o.face, mean) for o in observations])
    offsets = np.stack([o.offset for o in observations])
    with np.errstate(invalid="ignore"):
        usual = np.nanmean(offsets, axis=0)
    offsets = np.nan_to_num(np.where(np.isfinite(offsets), offsets, usual)).reshape(len(observations), -1)
    coefficients = np.linalg.lstsq(evaluate_polynomial(directions), offsets, rcond=None)[0]
    return LandmarkCorrection(mean, np.abs(directions).max(axis=0), coefficients.reshape(TERMS, -1, 2))


def _mean_face(observations: list[Observation]) -> np.ndarray:
    """The mean [468, 3] of the detected faces, aligned with it iteratively. The first is the most frontal one by its
    depths."""
    skew = [abs(np.corrcoef(o.face.depth, o.face.landmarks[:, 0])[0, 1]) for o in observations]
    first = observations[int(np.argmin(skew))].face
    mean = np.column_stack([first.landmarks, first.depth]) / first.size
    for _ in range(_ALIGNMENTS):
        mean = np.mean([align_face(o.face, mean) for o in observations], axis=0)
    return mean


def measure_held_out_errors(observations: list[Observation]) -> tuple[float, float]:
    """Mean distance of detected and of corrected landmarks to the true ones, in face sizes, cross-validated over heads.
    Raises InputError for too few heads."""
    heads = sorted({o.head for o in observations})
    if len(heads) < _LEAST_HEADS:
        raise InputError(f"{len(heads)} heads whose face is found: {_LEAST_HEADS} are needed")
    fold = {head: k % _FOLDS for k, head in enumerate(heads)}
    found, corrected = [], []
    for k in range(_FOLDS):
        correction = fit_correction([o for o in observations if fold[o.head] != k])
        for o in observations:
            if fold[o.head] == k:
                found.append(_distance(o, o.face.landmarks))
                corrected.append(_distance(o, correct_landmarks(o.face, correction)))
    return float(np.mean(found)), float(np.mean(corrected))


def _distance(observation: Observation, landmarks: np.ndarray) -> float:
    return float(np.nanmean(np.linalg.norm(landmarks - observation.true, axis=1)) / observation.face.size)


def align_face(face: Face, mean: np.ndarray) -> np.ndarray:
    """The network's landmarks with their depth [468, 3], in face sizes about their centre, turned to the `mean` face
    [468, 3]."""
    points = np.column_stack([face.landmarks, face.depth]) / face.size
    return (points - points.mean(axis=0)) @ find_rotation(face, mean).T
