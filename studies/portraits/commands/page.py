"""write the page from its figures; with --benchmark and --runs, score the rows and write the figures first"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING

from sira_mi.errors import InputError
from sira_mi.files import read_json
from studies.cache import write_json
from studies.data import read_figures, write_figures
from studies.portraits.commands import score
from studies.portraits.commands.fit import add_selection

if TYPE_CHECKING:
    from studies.portraits.rows import Case, Row

# Portraits on the sheet of all rows, and on that of a row's worst.
SHOWN, WORST = 4, 3


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--out", type=Path, default=Path("docs"), help="folder of the page (default: docs)")
    parser.add_argument("--benchmark", type=Path, help="folder of build")
    parser.add_argument("--runs", type=Path, help="folder of the rows, a folder each")
    parser.add_argument("--worst-of", default="draft", metavar="ROW", help="row whose worst portraits are shown")
    parser.add_argument("--notes", type=Path, metavar="JSON", help="`stranger`, for the figures of foreign")
    add_selection(parser)
    parser.set_defaults(half="report")


def run(arguments: argparse.Namespace) -> None:
    """Writes the page, after its figures and pictures where a benchmark is given."""
    from studies.portraits.page import write_page

    if (arguments.benchmark is None) != (arguments.runs is None):
        raise InputError("--benchmark and --runs go together")
    if arguments.benchmark is not None:
        write_measured(arguments)
    if arguments.notes is not None:
        write_notes(arguments.notes, arguments.out)
    print(f"{write_page(arguments.out)} written")


def write_measured(arguments: argparse.Namespace) -> None:
    """Scores the rows; writes the figures of the benchmark's kind, whose notes are kept, and the pictures of
    `foreign`."""
    from studies.portraits.page import FIGURES, NOTES
    from studies.portraits.summary import summarise

    results, cases, rows = score.measure(arguments)
    figures = summarise(results, {row.name: row.title for row in rows})
    kind = json.loads((arguments.benchmark / "benchmark.json").read_text(encoding="utf-8"))["kind"]
    path = arguments.out / FIGURES[kind]
    if path.exists():
        before = read_figures(path)
        figures |= {name: before[name] for name in NOTES if name in before}
    if kind == "foreign":
        figures["pictures"] = draw_pictures(arguments.out, cases, rows, results, arguments.worst_of)
    write_figures(path, figures)


def write_notes(notes: Path, out: Path) -> None:
    """Puts the lists of `page.NOTES` that a file has into the figures of `foreign`. Raises InputError for anything
    else."""
    from studies.portraits.page import FIGURES, NOTES

    said = read_json(notes, "notes of the page")
    if not isinstance(said, dict) or not set(said) <= set(NOTES) or not all(isinstance(v, list) for v in said.values()):
        raise InputError(f"{notes} must be an object of the lists {' and '.join(NOTES)} alone")
    path = out / FIGURES["foreign"]
    write_json(path, read_figures(path) | said)


def draw_pictures(out: Path, cases: list[Case], rows: list[Row], results: list[dict], worst_of: str) -> dict[str, str]:
    """Draws the sheets of the page, one of the worst portraits of a row; returns what they show, by the names of
    `page.PICTURES`."""
    from studies.portraits.page import PICTURES
    from studies.portraits.sheets import VIEWS, Album, draw_large, draw_rows

    def album(case: Case) -> Album:
        return Album(case.benchmark, case.runs, case.entry)

    first = cases[:SHOWN]
    drawn = [row for row in rows if any((case.folder(row.name) / f"{VIEWS[0]}.exr").exists() for case in first)]
    draw_rows([album(case) for case in first], {row.name: row.title for row in drawn}, out / PICTURES["rows"])
    shown = {"rows": "Photo, true head, and every row: relit, and turned by 30° to its left."}
    level = {r["portrait"]: r["scores"]["relit_1_psnr"] for r in results if r["row"] == worst_of and "scores" in r}
    worst = sorted((case for case in cases if case.name in level), key=lambda case: level[case.name])[:WORST]
    if worst:
        draw_large([album(case) for case in worst], worst_of, out / PICTURES["worst"])
        shown["worst"] = f"The worst {len(worst)} of `{worst_of}`: photo; true and fitted head relit, and turned."
    return shown
