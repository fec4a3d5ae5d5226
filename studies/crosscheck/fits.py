"""Error of single-image fits against their time, from the rows that `python -m studies.portraits fit` writes."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sira_mi.errors import InputError
from studies.portraits.methods import BY_NAME, SHIPPED

# Scores: millimetres between the faces, decibels of the re-render.
MILLIMETRES, DECIBELS = "h3ds_face_mean", "final_psnr"
_MAXIMUM_BYTES = 64 << 20


@dataclass(frozen=True)
class FitPoint:
    """The portraits of one file of rows."""

    label: str
    portraits: int
    seconds: float  # median wall time of a fit, the stages that it goes on from included
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
        times = {
            (row["portrait"], row["method"]): float(row["total_seconds"]) for row in rows if "total_seconds" in row
        }
        done = [row for row in rows if row["method"] == SHIPPED and "scores" in row]
        seconds = [sum(times[row["portrait"], method] for method in _stages(SHIPPED)) for row in done]
        scores = [[float(row["scores"][name]) for row in done] for name in (MILLIMETRES, DECIBELS)]
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}") from error
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError(f"{path}: not the rows.json of python -m studies.portraits fit ({error})") from error
    if not done:
        raise InputError(f"{path} holds no fit by method {SHIPPED}; run python -m studies.portraits fit with it")
    return FitPoint(
        path.absolute().parent.name, len(done), float(np.median(seconds)), *map(float, np.mean(scores, axis=1))
    )


def _stages(method: str) -> list[str]:
    """The method and those that it goes on from."""
    before = BY_NAME[method].after
    return [method] if before is None else [method, *_stages(before)]
