"""write the page from its figures; with --benchmark and --runs, score the rows and write the figures first"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING

from sira_mi.errors import InputError
from studies.data import read_figures, write_figures
from studies.portraits.commands import score
from studies.portraits.commands.fit import add_selection

if TYPE_CHECKING:
    from studies.portraits.rows import Case, Row

# The pictures of the page: portraits in the sheet of all rows, and the worst ones of a row.
SHOWN, WORST, WORST_ROW = 4, 3, "draft"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--out", type=Path, default=Path("docs"), help="folder of the page (default: docs)")
    parser.add_argument("--benchmark", type=Path, help="folder of build")
    parser.add_argument("--runs", type=Path, help="folder of the rows, a folder each")
    add_selection(parser)
    parser.set_defaults(half="report")


def run(arguments: argparse.Namespace) -> None:
    """Writes the page, after its figures and pictures where a benchmark is given."""
    from studies.portraits.page import write_page

    if (arguments.benchmark is None) != (arguments.runs is None):
        raise InputError("--benchmark and --runs go together")
    if arguments.benchmark is not None:
        write_measured(arguments)
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
        figures["pictures"] = draw_pictures(arguments.out, cases, rows, results)
    write_figures(path, figures)


def draw_pictures(out: Path, cases: list[Case], rows: list[Row], results: list[dict]) -> dict[str, str]:
    """Draws the sheets of the page; returns what they show, by the names of `page.PICTURES`."""
    from studies.portraits.page import PICTURES
    from studies.portraits.sheets import VIEWS, Album, draw_large, draw_rows

    def album(case: Case) -> Album:
        return Album(case.benchmark, case.runs, case.entry)

    first = cases[:SHOWN]
    drawn = [row for row in rows if any((case.folder(row.name) / f"{VIEWS[0]}.exr").exists() for case in first)]
    draw_rows([album(case) for case in first], {row.name: row.title for row in drawn}, out / PICTURES["rows"])
    shown = {"rows": "Photo, true head, and every row: relit, and turned by 30° to its left."}
    level = {r["portrait"]: r["scores"]["relit_1_psnr"] for r in results if r["row"] == WORST_ROW and "scores" in r}
    worst = sorted((case for case in cases if case.name in level), key=lambda case: level[case.name])[:WORST]
    if worst:
        draw_large([album(case) for case in worst], WORST_ROW, out / PICTURES["worst"])
        shown["worst"] = f"The worst {len(worst)} of `{WORST_ROW}`: photo; true and fitted head relit, and turned."
    return shown
