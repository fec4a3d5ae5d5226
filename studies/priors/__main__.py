"""`python -m studies.priors measure|sizes|page …`: measures a trained prior, short trainings and network sizes.

`measure` measures the prior of a run on the collection's test split, then trains and measures the ablations; `sizes`
trains and measures networks of several sizes. Both keep results in RUNS/evidence, so that only what has changed is
measured again, and write figures (`docs/data/priors.json`), pictures and pages. `page` writes the pages from figures.
"""

import argparse
import shutil
import time
from functools import partial
from pathlib import Path

from sira_mi.errors import CommandParser, InputError, run_command
from sira_mi.files import write_through
from studies.data import read_figures, write_figures
from studies.priors.page import FIGURES, write_pages


def main() -> None:
    parser = CommandParser(
        prog="python -m studies.priors",
        description="Measures a trained prior, short trainings and network sizes.",
    )
    commands = parser.add_subparsers(dest="command", required=True)
    prior = commands.add_parser("measure", help="measure the prior and the ablations, write figures and pages")
    sizes = commands.add_parser("sizes", help="train and measure networks of several sizes, write figures and pages")
    pages = commands.add_parser("page", help="write the pages from their figures")
    for command in (prior, sizes, pages):
        command.add_argument("--out", type=Path, default=Path("docs"), help="folder of the pages (default: docs)")
    for command, option, steps in ((prior, "--ablation-steps", 600), (sizes, "--steps", 600)):
        command.add_argument("--collection", type=Path, required=True)
        command.add_argument("--runs", type=Path, required=True, help="output folder of python -m sira_mi.training")
        command.add_argument(option, type=int, default=steps, metavar="N", dest="steps", help="of every short training")
        command.add_argument("--variant", default="llvm_ad_rgb", help="Mitsuba variant")
    arguments = parser.parse_args()
    start = time.monotonic()
    if arguments.command != "page":
        if arguments.steps < 0:
            raise InputError("a number of steps is 0 (train nothing) or more")
        measure(arguments)
    written = write_pages(read_figures(arguments.out / FIGURES), arguments.out)
    print(f"{', '.join(map(str, written))} written after {time.monotonic() - start:.0f} s")


def measure(arguments: argparse.Namespace) -> None:
    """Runs the measurements of the command line; writes the figures and copies the pictures."""
    from sira_mi.variants import set_variant
    from studies.priors.measure_appearance import measure_appearance_prior, run_appearance_ablations
    from studies.priors.measure_shape import measure_shape_prior
    from studies.priors.short_trainings import run_ablations, run_sizes
    from studies.priors.summary import summarise

    set_variant(arguments.variant)
    evidence = arguments.runs / "evidence"
    if arguments.command == "measure":
        measure_shape_prior(arguments.collection, arguments.runs)
        measure_appearance_prior(arguments.collection, arguments.runs)
        if arguments.steps:
            run_ablations(arguments.collection, evidence, arguments.steps)
            run_appearance_ablations(arguments.collection, arguments.runs, arguments.steps)
    elif arguments.steps:
        run_sizes(arguments.collection, evidence, arguments.steps)
    write_figures(arguments.out / FIGURES, summarise(evidence))
    (arguments.out / "images").mkdir(exist_ok=True)
    for picture in sorted(evidence.glob("*.png")):
        write_through(arguments.out / "images" / picture.name, partial(shutil.copyfile, picture))


if __name__ == "__main__":
    run_command(main)
