"""Fits of corrupt input, and of one portrait from many seeds, scored against a known truth.

Every fit runs the stages of the shipped fit with fewer steps, on a MakeHuman head that no prior was trained on, path
traced at 512 pixels. It must end with an avatar (finite, its mesh closed, every pixel of every layer defined) or with
one line that says what is wrong with the photo. A mesh with gaps or a crash counts as an infinite error."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import mitsuba as mi
import numpy as np

from studies.stability.fit_cases import CASES, EITHER, REFUSED, UNDISTURBED, Case
from studies.stability.fit_runs import Fit, run_fit
from studies.stability.fit_truth import take_portrait
from studies.stability.rows import Measure, Row

SEEDS = 32
_QUICK_SEEDS = 3
# Units of the rows.
FACE, LOSS, PICTURE, REFUSAL = "face, mm", "PSNR lost, dB", "PSNR, dB", "fits that are not refused"
# Bounds of the spread over the seeds.
_SPREADS: dict[str, tuple[Callable, dict[str, float]]] = {
    "standard deviation": (partial(np.std, ddof=1), {FACE: 0.2, PICTURE: 0.5}),
    "range": (np.ptp, {FACE: 0.8, PICTURE: 2.0}),
}
_KEYS = {FACE: "face_mm", PICTURE: "psnr_db"}


def list_measures(work: Path) -> tuple[Measure, ...]:
    """The functions that measure a row each; portraits and finished fits are kept in the folder `work`."""
    measures: list[Measure] = []
    for case in CASES:
        if case.expected == REFUSED:
            measures.append(partial(_measure_refusal, work, case))
            continue
        measures.append(partial(_measure_face, work, case))
        if np.isfinite(case.lost):
            measures.append(partial(_measure_picture, work, case))
    for name, (_, bounds) in _SPREADS.items():
        measures += [partial(_measure_spread, work, name, unit) for unit in bounds]
    return tuple(measures)


def _run(work: Path, case: Case, seed: int = 0) -> dict:
    return run_fit(Fit(case.name, take_portrait(work, case.view), str(mi.variant()), seed), work)


def _is_clear(result: dict, case: Case) -> bool:
    """Whether a refusal is one line that says what is wrong."""
    return "\n" not in result.get("refused", "\n") and case.says in result["refused"]


def _measure_refusal(work: Path, case: Case, quick: bool) -> Row:
    result = _run(work, case)
    return Row(case.name, REFUSAL, 1, int(not _is_clear(result, case)), 0, 0, note=result.get("refused", ""))


def _judge(case: Case, result: dict) -> tuple[bool, str]:
    """Whether a fit ended as it must, and what it said: its refusal, or the first note that the case asks for."""
    if "refused" in result:
        return case.expected == EITHER and _is_clear(result, case), result["refused"]
    notes = [note for note in result.get("notes", ()) if case.says and case.says in note]
    return result.get("closed", False) and bool(notes or not case.says), f"{len(notes)}x: {notes[0]}" if notes else ""


def _make_row(case: Case, unit: str, result: dict, error: float, bound: float) -> Row:
    good, said = _judge(case, result)
    return Row(case.name, unit, 1, error if good else np.inf, bound, result.get("non_finite", 0), note=said)


def _measure_face(work: Path, case: Case, quick: bool) -> Row:
    """Mean distance of the face after the protocol of H3DS: six landmarks, then ICP with scale."""
    result = _run(work, case)
    return _make_row(case, FACE, result, result.get("face_mm", 0.0), case.face)


def _measure_picture(work: Path, case: Case, quick: bool) -> Row:
    """PSNR lost against the undisturbed fit, each against its own photo, inside the true mask."""
    result, undisturbed = _run(work, case), _run(work, UNDISTURBED)
    lost = undisturbed["psnr_db"] - result["psnr_db"] if "psnr_db" in result else 0.0
    return _make_row(case, LOSS, result, lost, case.lost)


def _measure_spread(work: Path, name: str, unit: str, quick: bool) -> Row:
    """Of the undisturbed fit from different seeds."""
    results = [_run(work, UNDISTURBED, seed) for seed in range(_QUICK_SEEDS if quick else SEEDS)]
    whole = all(_judge(UNDISTURBED, result)[0] for result in results)
    values = np.array([result.get(_KEYS[unit], np.nan) for result in results])
    measure, bounds = _SPREADS[name]
    return Row(
        f"{len(results)} seeds, {name}",
        unit,
        len(results),
        float(measure(values)) if whole else np.inf,
        bounds[unit],
        sum(result.get("non_finite", 0) for result in results),
        note=f"{values.min():.2f} to {values.max():.2f}, mean {values.mean():.2f}",
    )
