"""Scores the rows of a benchmark that have been made; scores are kept beside each row."""

import json
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context

from sira_mi.errors import InputError
from sira_mi.sg.lights_io import read_environment
from sira_mi.variants import set_variant
from studies.cache import fingerprint, load_or_compute
from studies.portraits.make_rows import read_row
from studies.portraits.relit_lights import exposure_of
from studies.portraits.rows import Case, Row


def score_rows(cases: Sequence[Case], rows: Sequence[Row], workers: int) -> Iterator[dict]:
    """Yields for each portrait and row that has been made its `portrait`, `row`, `entry` of the benchmark, what
    `row.json` and `pictures.json` say, and the `scores` of `score_row.score_portrait`; without scores, why there are
    none is its `error`. `workers` portraits are scored at a time."""
    score = partial(score_case, rows=rows)
    if workers == 1:
        for results in map(score, cases):
            yield from results
        return
    start = partial(set_variant, cases[0].variant)
    with ProcessPoolExecutor(workers, get_context("spawn"), start) as pool:
        for results in pool.map(score, cases):
            yield from results


def score_case(case: Case, rows: Sequence[Row]) -> list[dict]:
    """The results of a portrait's rows, as far as they have been made."""
    exposures = {path.stem: exposure_of(read_environment(path)) for path in case.lights}
    made = [(row, read_row(case.folder(row.name))) for row in rows]
    return [_score_row(case, row, result, exposures) for row, result in made if result]


def _score_row(case: Case, row: Row, made: dict, exposures: dict[str, float]) -> dict:
    from studies.portraits.score_row import VERSION, score_portrait  # needs the variant

    folder = case.folder(row.name)
    result = {"portrait": case.name, "row": row.name, "entry": case.entry}
    pictures = folder / "pictures.json"
    files = [folder / "row.json", *([pictures] if pictures.exists() else [])]
    files += [case.truth / name for name in ("portrait.json", "truth.npz", "views.npz")]

    def compute() -> dict:
        return score_portrait(case.truth, folder, exposures, case.prior)

    result |= {name: value for name, value in made.items() if name != "key"}
    if pictures.exists():
        result |= json.loads(pictures.read_text(encoding="utf-8"))["result"]
    try:
        result["scores"] = load_or_compute(folder / "scores.json", fingerprint(VERSION, *files), compute)
    except InputError as error:
        result["error"] = str(error)
    return result
