"""`python -m sira_mi.evaluate prior|sizes --collection DIR --runs DIR`: measures the priors and writes their page.

`prior` measures the prior of a run on the collection's test split, trains and measures the ablations, and writes
`docs/priors.md` and its pictures; `sizes` trains and measures networks of several sizes for a table on that page.
Results are kept in RUNS/evidence, so that only what has changed is measured again.
"""

import argparse
import time
from pathlib import Path

import mitsuba as mi

from sira_mi.errors import InputError, run_command


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m sira_mi.evaluate", description=__doc__.split("\n")[0])
    commands = parser.add_subparsers(dest="command", required=True)
    prior = commands.add_parser("prior", help="measure the prior and the ablations, write the page")
    sizes = commands.add_parser("sizes", help="train and measure networks of several sizes, write the page")
    for command, option, steps in ((prior, "--ablation-steps", 600), (sizes, "--steps", 600)):
        command.add_argument("--collection", type=Path, required=True)
        command.add_argument("--runs", type=Path, required=True, help="output folder of python -m sira_mi.train")
        command.add_argument("--out", type=Path, default=Path("docs"), help="folder of the page (default: docs)")
        command.add_argument(option, type=int, default=steps, metavar="N", dest="steps", help="of every short training")
        command.add_argument("--variant", default="llvm_ad_rgb", help="Mitsuba variant")
    arguments = parser.parse_args()
    if arguments.steps < 0:
        raise InputError("a number of steps is 0 (train nothing) or more")
    mi.set_variant(arguments.variant)

    from sira_mi.evaluate.ablations import run_ablations, run_sizes
    from sira_mi.evaluate.appearance_evidence import measure_appearance_prior, run_appearance_ablations
    from sira_mi.evaluate.prior_page import write_page
    from sira_mi.evaluate.shape_evidence import measure_shape_prior

    evidence = arguments.runs / "evidence"
    start = time.monotonic()
    if arguments.command == "prior":
        measure_shape_prior(arguments.collection, arguments.runs)
        measure_appearance_prior(arguments.collection, arguments.runs)
        if arguments.steps:
            run_ablations(arguments.collection, evidence, arguments.steps)
            run_appearance_ablations(arguments.collection, arguments.runs, arguments.steps)
    elif arguments.steps:
        run_sizes(arguments.collection, evidence, arguments.steps)
    page = write_page(evidence, arguments.out)
    print(f"{page} written after {time.monotonic() - start:.0f} s")


if __name__ == "__main__":
    run_command(main)
