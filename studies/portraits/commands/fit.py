"""fit the benchmark's portraits, score them, write figures and page"""

import argparse
from pathlib import Path

from studies.cache import write_json
from studies.data import write_figures
from studies.portraits.commands import page


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--benchmark", type=Path, required=True)
    parser.add_argument("--runs", type=Path, required=True, help="folder of the fits; finished ones are kept")
    parser.add_argument("--out", type=Path, default=Path("docs"), help="folder of the page (default: docs)")
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
    """Fits and scores the benchmark's portraits as the command line says; writes figures, picture and page."""
    from sira_mi.avatar.file import PRIOR
    from sira_mi.variants import set_variant
    from studies.portraits.compare_methods import Comparison, compare
    from studies.portraits.methods import BY_NAME
    from studies.portraits.page import FIGURES
    from studies.portraits.picture import write_picture
    from studies.portraits.summary import SHIPPED, summarise

    set_variant(arguments.variant)

    def rows(quality: str, methods: tuple[str, ...]) -> list[dict]:
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
        found = compare(comparison)
        write_json(arguments.runs / quality / "rows.json", found)
        return found

    ablations = rows(arguments.ablations, tuple(arguments.methods or BY_NAME))
    shipped = rows(arguments.quality, (SHIPPED,))
    figures = summarise(shipped, ablations, arguments.quality, arguments.ablations)
    write_figures(arguments.out / FIGURES, figures)
    picture = arguments.out / "images" / "results.png"
    write_picture(shipped, arguments.benchmark, arguments.runs / arguments.quality, picture)
    page.run(arguments)
