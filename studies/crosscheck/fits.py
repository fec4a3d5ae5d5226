"""Error of single-image fits against their time, from the rows that `python -m studies.portraits score` writes."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sira_mi.errors import InputError

# Scores: millimetres between the faces, decibels of the re-render.
MILLIMETRES, DECIBELS = "h3ds_face_mean", "final_psnr"
_MAXIMUM_BYTES = 64 << 20


@dataclass(frozen=True)
class FitPoint:
    """The portraits of one file of rows."""

    label: str
    portraits: int
    seconds: float  # median wall time of a fit
    millimetres: float  # mean distance between true and fitted face
    decibels: float  # mean PSNR of the re-render


def read_fits(paths: Sequence[Path]) -> list[FitPoint]:
    """One point for each file, labelled by its folder, the quickest first. InputError for what is not such a file."""
    return sorted((_read(path) for path in paths), key=lambda point: point.seconds)


def _read(path: Path) -> FitPoint:
    try:
        if path.stat().st_size > _MAXIMUM_BYTES:
            raise InputError(f"{path} is larger than rows of fits can be")
        rows = json.loads(path.read_text(encoding="utf-8"))
        done = [row for row in rows if "scores" in row]
        seconds = [float(row["wall_seconds"]) for row in done]
        scores = [[float(row["scores"][name]) for row in done] for name in (MILLIMETRES, DECIBELS)]
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}") from error
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError(f"{path}: not the rows.json of python -m studies.portraits score ({error})") from error
    if not done:
        raise InputError(f"{path} holds no fit with scores; run python -m studies.portraits fit and score")
    return FitPoint(
        path.absolute().parent.name, len(done), float(np.median(seconds)), *map(float, np.mean(scores, axis=1))
    )
