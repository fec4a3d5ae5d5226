"""score the rows that fit has made, and print the headline; scores that are up to date are kept"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from studies.cache import write_json
from studies.portraits.commands.fit import add_selection, select

if TYPE_CHECKING:
    from studies.portraits.rows import Case, Row


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--benchmark", type=Path, required=True, help="folder of build")
    parser.add_argument("--runs", type=Path, required=True, help="folder of the rows, a folder each")
    add_selection(parser)


def measure(arguments: argparse.Namespace) -> tuple[list[dict], list[Case], list[Row]]:
    """Scores what the options name; returns the results of `score_rows`, portraits and rows. Writes RUNS/ROW/rows.json,
    and prints what is not made yet."""
    from tqdm import tqdm

    from sira_mi.variants import set_variant

    set_variant(arguments.variant)
    from studies.portraits.score_rows import score_rows

    cases, rows = select(arguments)
    results = list(tqdm(score_rows(cases, rows, arguments.workers), total=len(rows) * len(cases), unit="row"))
    for row in rows:
        mine = [result for result in results if result["row"] == row.name]
        if mine:
            write_json(arguments.runs / row.name / "rows.json", mine)
        if len(mine) < len(cases):
            print(f"{row.name}: {len(cases) - len(mine)} of {len(cases)} portraits are not made yet")
    return results, cases, rows


def run(arguments: argparse.Namespace) -> None:
    """Scores, and prints the headline and what has failed."""
    from studies.portraits.page import HEADLINE, render_table
    from studies.portraits.summary import summarise

    results, _, rows = measure(arguments)
    figures = summarise(results, {row.name: row.title for row in rows})
    print(render_table(figures["rows"], HEADLINE))
    for row in figures["failed"]:
        print(f"failed: {row['row']} of {row['portrait']}: {row['error']}")
