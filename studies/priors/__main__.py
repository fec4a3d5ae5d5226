"""`python -m studies.priors measure|sizes …`: measures a trained prior, its ablations and networks of several sizes.

`measure` measures the prior of a run on the collection's test split, trains and measures the ablations, and writes
`docs/priors.md` and its pictures; `sizes` trains and measures networks of several sizes for a table on that page.
Results are kept in RUNS/evidence, so that only what has changed is measured again.
"""

import time
from pathlib import Path

from sira_mi.errors import CommandParser, InputError, run_command


def main() -> None:
    parser = CommandParser(prog="python -m studies.priors", description=__doc__.split("\n")[0])
    commands = parser.add_subparsers(dest="command", required=True)
    prior = commands.add_parser("measure", help="measure the prior and the ablations, write the page")
    sizes = commands.add_parser("sizes", help="train and measure networks of several sizes, write the page")
    for command, option, steps in ((prior, "--ablation-steps", 600), (sizes, "--steps", 600)):
        command.add_argument("--collection", type=Path, required=True)
        command.add_argument("--runs", type=Path, required=True, help="output folder of python -m sira_mi.training")
        command.add_argument("--out", type=Path, default=Path("docs"), help="folder of the page (default: docs)")
        command.add_argument(option, type=int, default=steps, metavar="N", dest="steps", help="of every short training")
        command.add_argument("--variant", default="llvm_ad_rgb", help="Mitsuba variant")
    arguments = parser.parse_args()
    if arguments.steps < 0:
        raise InputError("a number of steps is 0 (train nothing) or more")

    import mitsuba as mi

    from studies.priors.measure_appearance import measure_appearance_prior, run_appearance_ablations
    from studies.priors.measure_shape import measure_shape_prior
    from studies.priors.page import write_page
    from studies.priors.short_trainings import run_ablations, run_sizes

    mi.set_variant(arguments.variant)
    evidence = arguments.runs / "evidence"
    start = time.monotonic()
    if arguments.command == "measure":
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
