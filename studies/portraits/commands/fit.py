"""fit the benchmark's portraits and score them"""

import argparse
from pathlib import Path

from studies.cache import write_json


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--benchmark", type=Path, required=True)
    parser.add_argument("--runs", type=Path, required=True, help="folder of the fits; finished ones are kept")
    parser.add_argument(
        "--quality", choices=("draft", "standard", "high"), default="standard", help="of the shipped fit"
    )
    parser.add_argument(
        "--ablations", choices=("draft", "standard", "high"), default="draft", help="quality of all methods"
    )
    parser.add_argument("--methods", nargs="+", metavar="NAME", help="methods to compare (default: all, a.3 to b.7)")
    parser.add_argument(
        "--portraits", nargs="+", default=(), metavar="NAME", help="portraits (default: the primary ones)"
    )
    parser.add_argument("--all-lights", action="store_true", help="every portrait, not one of each head")
    parser.add_argument("--prior", type=Path, help="prior.safetensors (default: the shipped one)")
    parser.add_argument("--variant", default="llvm_ad_rgb", help="Mitsuba variant")


def run(arguments: argparse.Namespace) -> None:
    """Fits and scores the benchmark's portraits as the command line says, into RUNS/QUALITY/rows.json."""
    from sira_mi.avatar.file import PRIOR
    from sira_mi.variants import set_variant
    from studies.portraits.compare_methods import Comparison, compare
    from studies.portraits.methods import BY_NAME, SHIPPED

    set_variant(arguments.variant)

    def write_rows(quality: str, methods: tuple[str, ...]) -> None:
        comparison = Comparison(
            arguments.benchmark,
            arguments.runs / quality,
            quality,
            methods,
            arguments.prior or PRIOR,
            primary=not arguments.all_lights,
            only=tuple(arguments.portraits),
            variant=arguments.variant,
        )
        write_json(arguments.runs / quality / "rows.json", compare(comparison))

    write_rows(arguments.ablations, tuple(arguments.methods or BY_NAME))
    write_rows(arguments.quality, (SHIPPED,))
