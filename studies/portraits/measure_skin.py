"""How well a photo predicts the level of its skin's albedo: least squares over portraits of training heads, which gives
the values of `sira_mi.fit.skin.SkinLevel`."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.optimize import minimize
from tqdm import tqdm

from sira_mi.avatar.file import PRIOR, load_avatar
from sira_mi.conventions import LUMINANCE
from sira_mi.errors import InputError
from sira_mi.fit.settings import QUALITIES
from sira_mi.fit.skin import SkinCues, SkinLevel, cue_arrays, find_near_landmarks, find_skin_cues
from sira_mi.portrait.landmarks import BARE_SKIN
from sira_mi.portrait.portrait import PortraitSettings, make_portrait
from sira_mi.training.collection.skin import SKIN
from studies.portraits.benchmark import photo_of, read_benchmark, truth_of
from studies.portraits.truth import Truth, load_truth

# Fewer portraits than this with eyes, or fewer heads, determine nothing.
_LEAST_PORTRAITS, _LEAST_HEADS = 12, 4
_FOLDS = 8
# Where the search begins: usual, by_radiance, log spread, white, log deviation, misleading, darker; how far from there
# each may be expected, and how much that counts beside the mean square error.
_START = np.array([-1.35, 0.2, np.log(0.45), -0.9, np.log(0.15), -1.0, 1.0])
_START_WIDTH = np.array([0.5, 0.2, 0.5, 0.3, 0.7, 1.0, 1.0])
_PULL, _EVALUATIONS = 2e-3, 1200


@dataclass(frozen=True)
class Observation:
    """The skin of one portrait."""

    head: str
    cues: SkinCues
    luminance: float  # of the true diffuse albedo of the skin


@dataclass(frozen=True)
class Estimate:
    """The best predictor of the albedo's level."""

    level: SkinLevel
    error: float  # root mean square of the log luminance, cross-validated over heads
    error_by_skin: float  # the same by the skin's radiance alone, least squares


def observe(benchmark: Path) -> tuple[list[Observation], list[str]]:
    """The skin of the portraits of training heads in a folder, and the names of portraits without face or visible skin.
    Raises InputError for portraits of test heads."""
    landmarks = load_avatar(PRIOR).tensors["landmarks"]
    settings = PortraitSettings(working_size=QUALITIES["draft"].working_size)
    found, blind = [], []
    for entry in tqdm(read_benchmark(benchmark, "train"), unit="portrait", dynamic_ncols=True):
        name = entry["name"]
        luminance = true_luminance(load_truth(truth_of(benchmark, name) / "truth.npz"))
        try:
            cues = find_skin_cues(make_portrait(photo_of(benchmark, name), settings, landmarks))
        except InputError:
            cues = None
        if cues is None or luminance is None:
            blind.append(name)
        else:
            found.append(Observation(entry["identity"], cues, luminance))
    return found, blind


def true_luminance(truth: Truth) -> float | None:
    """Mean luminance of the diffuse albedo at the landmarks of bare facial skin; None where none is seen."""
    pixels = np.full((len(truth.landmarks), 2), np.nan)
    known = np.isfinite(truth.landmarks).all(axis=1)
    pixels[known] = truth.camera.project(truth.landmarks[known])
    row, column = find_near_landmarks(pixels, BARE_SKIN, (truth.mask > 0.5) & (truth.region == SKIN))
    return float((truth.diffuse_albedo[row, column] @ np.array(LUMINANCE)).mean()) if len(row) else None


def estimate(observations: list[Observation]) -> Estimate:
    """Least squares of the log luminance. Raises InputError for too few portraits that show eyes."""
    eyes = [o.head for o in observations if o.cues.eyes]
    if len(eyes) < _LEAST_PORTRAITS or len(set(eyes)) < _LEAST_HEADS:
        raise InputError(
            f"{len(eyes)} portraits of {len(set(eyes))} heads show skin and eyes: "
            f"{_LEAST_PORTRAITS} of {_LEAST_HEADS} are needed"
        )
    target = np.log([o.luminance for o in observations])
    heads = sorted({o.head for o in observations})
    fold = np.array([heads.index(o.head) % _FOLDS for o in observations])
    errors, by_skin = np.zeros(len(target)), np.zeros(len(target))
    for k in range(_FOLDS):
        other = [o for o, own in zip(observations, fold, strict=True) if own != k]
        left_out = [o for o, own in zip(observations, fold, strict=True) if own == k]
        if not left_out:
            continue
        errors[fold == k] = _predict(_fit_level(other), left_out) - target[fold == k]
        line = np.polynomial.Polynomial.fit(*_by_radiance(other), 1)
        by_skin[fold == k] = line(_by_radiance(left_out)[0]) - target[fold == k]
    error, error_by_skin = (float(np.sqrt((e**2).mean())) for e in (errors, by_skin))
    return Estimate(_fit_level(observations), error, error_by_skin)


def _by_radiance(observations: list[Observation]) -> tuple[np.ndarray, np.ndarray]:
    return np.log([o.cues.radiance for o in observations]), np.log([o.luminance for o in observations])


def _predict(level: SkinLevel, observations: list[Observation]) -> np.ndarray:
    return level.log_luminance(*cue_arrays([o.cues for o in observations]))


def _fit_level(observations: list[Observation]) -> SkinLevel:
    """Least squares with a weak pull to the start, since few eyes mislead; widths by their logarithms."""
    cues, target = cue_arrays([o.cues for o in observations]), np.log([o.luminance for o in observations])

    def level(x: np.ndarray) -> SkinLevel:
        usual, by_radiance, spread, white, deviation, misleading, darker = x
        return SkinLevel(usual, by_radiance, np.exp(spread), white, np.exp(deviation), misleading, darker)

    def loss(x: np.ndarray) -> float:
        pull = (((x - _START) / _START_WIDTH) ** 2).mean()
        return float(((level(x).log_luminance(*cues) - target) ** 2).mean()) + _PULL * pull

    return level(minimize(loss, _START, method="Nelder-Mead", options={"maxfev": _EVALUATIONS}).x)
