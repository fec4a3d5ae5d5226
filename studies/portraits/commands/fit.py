"""make rows of the benchmark, fits and baselines; what is done already is kept"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from sira_mi.errors import InputError, check_range

if TYPE_CHECKING:
    from studies.portraits.rows import Case, Row


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--benchmark", type=Path, required=True, help="folder of build")
    parser.add_argument("--runs", type=Path, required=True, help="folder of the rows, a folder each")
    add_selection(parser)
    parser.set_defaults(rows=["draft"])


def add_selection(parser: argparse.ArgumentParser) -> None:
    """The options that say which rows of which portraits, and how they are worked on."""
    parser.add_argument("--rows", nargs="+", metavar="NAME", help="names of studies.portraits.rows (default: draft)")
    parser.add_argument("--half", choices=("choice", "report"), help="of the identities (default: both)")
    parser.add_argument("--portraits", type=int, metavar="N", help="the first N (default: all)")
    parser.add_argument("--prior", type=Path, help="prior.safetensors of all fits (default: the shipped one)")
    parser.add_argument("--workers", type=int, default=1, metavar="N", help="portraits at a time (default: 1)")
    parser.add_argument("--variant", default="llvm_ad_rgb", help="Mitsuba variant")


def select(arguments: argparse.Namespace) -> tuple[list[Case], list[Row]]:
    """The portraits and rows that the options name; without names of rows those that RUNS holds. Raises InputError when
    there are none."""
    for name in ("portraits", "workers"):
        check_range(name, getattr(arguments, name), 1, 1 << 20)

    from sira_mi.avatar.file import PRIOR
    from studies.portraits.benchmark import read_benchmark
    from studies.portraits.rows import ROWS, Case, select_rows

    names = arguments.rows or [row.name for row in ROWS if (arguments.runs / row.name).is_dir()]
    if not names:
        raise InputError(f"{arguments.runs} holds no rows; run python -m studies.portraits fit first")
    entries = [e for e in read_benchmark(arguments.benchmark) if arguments.half in (None, e["half"])]
    if not entries:
        raise InputError(f"{arguments.benchmark} has no portraits of the half {arguments.half}")
    if unlit := [entry["name"] for entry in entries if not entry["relights"]]:
        raise InputError(f"{arguments.benchmark} shows {unlit[0]} under no other light; scores need test heads")
    where = arguments.benchmark, arguments.runs
    cases = [Case(*where, e, arguments.prior or PRIOR, arguments.variant) for e in entries[: arguments.portraits]]
    return cases, select_rows(names)


def run(arguments: argparse.Namespace) -> None:
    """Makes the rows and prints what has failed."""
    from tqdm import tqdm

    from studies.portraits.make_rows import make_rows

    cases, rows = select(arguments)
    failed = []
    with tqdm(make_rows(cases, rows, arguments.workers), total=len(rows) * len(cases), unit="row") as bar:
        for result in bar:
            bar.set_postfix_str(f"{result['portrait']} {result['row']}")
            if "error" in result:
                failed.append(result)
    for result in failed:
        print(f"failed: {result['row']} of {result['portrait']}: {result['error']}")
    print(f"{arguments.runs}: {len(rows)} rows of {len(cases)} portraits, {len(failed)} failed")
