"""Fits of spoilt portraits, and of one portrait from many seeds: what comes of them, against a known truth."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import mitsuba as mi
import numpy as np

from studies.stability.fit_cases import CASES, EITHER, REFUSED, UNDISTURBED, Case
from studies.stability.fit_runs import Fit, fitted
from studies.stability.fit_truth import truth_portrait
from studies.stability.rows import Row, Section

SEEDS = 32
_QUICK_SEEDS = 3
# Bounds of the spread over the seeds: standard deviation and range, in mm and in dB.
_SPREAD = {"face_mm": (0.2, 0.8), "psnr_db": (0.5, 2.0)}
_UNITS = {"face_mm": "face, mm", "psnr_db": "picture, dB"}


def section(work: Path) -> Section:
    """The part of the page; portraits and finished fits are kept in `work`."""
    measures = []
    for case in CASES:
        if case.expected != REFUSED:
            measures.append(partial(_face, work, case))
        if case.expected != REFUSED and np.isfinite(case.lost):
            measures.append(partial(_picture, work, case))
        if case.expected == REFUSED:
            measures.append(partial(_refusal, work, case))
    for quantity in _SPREAD:
        for which in range(2):
            measures.append(partial(_spread, work, quantity, which))
    return Section(
        "Fits",
        "Whole fits, each by the steps of the shipped one but fewer, of a MakeHuman head of the shipped pack, which is "
        "no training head, path traced at 512 pixels. A fit must end with an avatar (finite, its mesh closed, no "
        "undefined pixel in any layer), or with one line that says what is wrong with the photo. A mesh with gaps or a "
        "crash counts as an infinite error. Errors of the face are mean distances after the protocol of H3DS (six "
        "landmarks, then ICP with scale); pictures are compared with the photo that was fed, inside the true mask, and "
        "their PSNR with that of the undisturbed fit.",
        tuple(measures),
    )


def _result(work: Path, case: Case, seed: int = 0) -> dict:
    return fitted(Fit(case.name, truth_portrait(work, case.view), mi.variant(), seed), work)


def _is_clear(result: dict, case: Case) -> bool:
    """Whether a refusal is one line that says what is wrong."""
    return "\n" not in result.get("refused", "\n") and case.says in result["refused"]


def _refusal(work: Path, case: Case, quick: bool) -> Row:
    result = _result(work, case)
    said = f" It says: “{result['refused']}”." if "refused" in result else ""
    wrong = int(not _is_clear(result, case))
    return Row(f"{case.name}: refused", f"{case.fed} Fits that end in any other way.{said}", 1, wrong, 0, 0)


def _verdict(case: Case, result: dict) -> tuple[bool, str]:
    """Whether a fit ended as it must, and what it said."""
    if "refused" in result:
        return case.expected == EITHER and _is_clear(result, case), f" Refused: “{result['refused']}”."
    notes = [note for note in result.get("notes", ()) if case.says and case.says in note]
    said = f" It says {len(notes)} times, first: “{notes[0]}”." if notes else ""
    return result.get("closed", False) and bool(notes or not case.says), said


def _row(case: Case, name: str, meaning: str, result: dict, error: float, bound: float) -> Row:
    good, said = _verdict(case, result)
    error = error if good else np.inf
    return Row(f"{case.name}: {name}", f"{case.fed}{meaning}{said}", 1, error, bound, result.get("non_finite", 0))


def _face(work: Path, case: Case, quick: bool) -> Row:
    result = _result(work, case)
    told = f" PSNR {result['psnr_db']:.1f} dB." if "psnr_db" in result else ""
    return _row(case, _UNITS["face_mm"], told, result, result.get("face_mm", 0.0), case.face)


def _picture(work: Path, case: Case, quick: bool) -> Row:
    result, undisturbed = _result(work, case), _result(work, UNDISTURBED)
    lost = undisturbed["psnr_db"] - result["psnr_db"] if "psnr_db" in result else 0.0
    return _row(case, "picture, dB lost", "", result, lost, case.lost)


def _spread(work: Path, quantity: str, which: int, quick: bool) -> Row:
    results = [_result(work, UNDISTURBED, seed) for seed in range(_QUICK_SEEDS if quick else SEEDS)]
    whole = all(_verdict(UNDISTURBED, result)[0] for result in results)
    values = np.array([result.get(quantity, np.nan) for result in results])
    spread = (values.std(ddof=1), np.ptp(values))[which]
    return Row(
        f"{len(results)} seeds: {_UNITS[quantity]}, {('standard deviation', 'range')[which]}",
        f"Of the undisturbed fit; {values.min():.2f} to {values.max():.2f}, mean {values.mean():.2f}.",
        len(results),
        float(spread) if whole else np.inf,
        _SPREAD[quantity][which],
        sum(result.get("non_finite", 0) for result in results),
    )
