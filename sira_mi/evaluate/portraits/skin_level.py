"""What a photo tells of the level of its skin's albedo: least squares over portraits whose albedo is known, which gives
the constants of `sira_mi.fit.skin`. Portraits of training heads serve, since a fit may know nothing of the others."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from tqdm import tqdm

from sira_mi.collection.skin import SKIN
from sira_mi.conventions import LUMINANCE
from sira_mi.errors import InputError
from sira_mi.evaluate.portraits.benchmark import read_benchmark
from sira_mi.evaluate.portraits.truth import Truth, load_truth
from sira_mi.fit.settings import QUALITIES
from sira_mi.fit.skin import SkinCues, near_landmarks, skin_cues
from sira_mi.models.avatar import PRIOR, load_avatar
from sira_mi.models.skin_tone import SKIN_LANDMARKS
from sira_mi.portrait.portrait import PortraitSettings, make_portrait

# Fewer portraits than this with eyes, or fewer heads, determine nothing.
_LEAST_PORTRAITS, _LEAST_HEADS = 12, 4


@dataclass(frozen=True)
class Observation:
    """The skin of one portrait."""

    head: str
    cues: SkinCues
    luminance: float  # of the true diffuse albedo of the skin


@dataclass(frozen=True)
class Estimate:
    """Least squares of the log luminance of the albedo by some cues."""

    coefficients: np.ndarray  # [1 + number of cues], the constant first
    error: float  # root mean square of the logs, each head by the others' coefficients


def observe(benchmark: Path) -> tuple[list[Observation], list[str]]:
    """The skin of the portraits of training heads in a folder, and the names of those without a face or visible skin.
    Raises InputError for portraits of test heads."""
    landmarks = load_avatar(PRIOR).tensors["landmarks"]
    settings = PortraitSettings(working_size=QUALITIES["draft"].working_size)
    found, blind = [], []
    for entry in tqdm(read_benchmark(benchmark, "train"), unit="portrait", dynamic_ncols=True):
        folder = benchmark / entry["name"]
        luminance = true_luminance(load_truth(folder / "truth.npz"))
        try:
            cues = skin_cues(make_portrait(folder / "photo.jpg", settings, landmarks))
        except InputError:
            cues = None
        if cues is None or luminance is None:
            blind.append(entry["name"])
        else:
            found.append(Observation(entry["identity"], cues, luminance))
    return found, blind


def true_luminance(truth: Truth) -> float | None:
    """Mean luminance of the diffuse albedo at the landmarks of bare facial skin; None where none is seen."""
    pixels = np.full((len(truth.landmarks), 2), np.nan)
    known = np.isfinite(truth.landmarks).all(axis=1)
    pixels[known] = truth.camera.project(truth.landmarks[known])
    row, column = near_landmarks(pixels, SKIN_LANDMARKS, (truth.mask > 0.5) & (truth.region == SKIN))
    return float((truth.diffuse_albedo[row, column] @ np.array(LUMINANCE)).mean()) if len(row) else None


def estimate(observations: list[Observation], eyes: bool) -> Estimate:
    """By the radiance of the skin and, with `eyes`, its ratio to their white, over the portraits that show eyes.
    Raises InputError for too few of them."""
    seen = [o for o in observations if o.cues.over_white is not None]
    heads = np.array([o.head for o in seen])
    if len(seen) < _LEAST_PORTRAITS or len(set(heads)) < _LEAST_HEADS:
        raise InputError(
            f"{len(seen)} portraits of {len(set(heads))} heads show skin and eyes: "
            f"{_LEAST_PORTRAITS} of {_LEAST_HEADS} are needed"
        )
    columns = [np.ones(len(seen)), np.log([o.cues.radiance for o in seen])]
    if eyes:
        columns.append(np.array([o.cues.over_white for o in seen]))
    cues, target = np.stack(columns, axis=1), np.log([o.luminance for o in seen])
    errors = np.zeros(len(seen))
    for head in set(heads):
        other = heads != head
        errors[~other] = cues[~other] @ _least_squares(cues[other], target[other]) - target[~other]
    return Estimate(_least_squares(cues, target), float(np.sqrt((errors**2).mean())))


def _least_squares(cues: np.ndarray, target: np.ndarray) -> np.ndarray:
    return np.linalg.lstsq(cues, target, rcond=None)[0]
