"""`python -m studies.crosscheck [AVATAR|SCENE] [--out docs]`: closed forms against path tracing, as JSON and a page."""

import argparse
import math
import shlex
import sys
from dataclasses import asdict
from pathlib import Path

from sira_mi.errors import CommandParser, InputError, run_command

_DESCRIPTION = """\
Renders one head under several lights in closed form and by path tracing, splits their difference into its causes, and
measures error against time and the speed of the plugins. Writes OUT/data/crosscheck.json, and from it OUT/crosscheck.md
and OUT/images/crosscheck_*.

AVATAR is the output folder of a fit or an avatar.safetensors, SCENE an .xml with a neural_sdf, a sira_bsdf and an
sg_envmap, whose own light is measured too; without either it is the mean head of the shipped prior."""


def _parser() -> argparse.ArgumentParser:
    parser = CommandParser(
        prog="python -m studies.crosscheck",
        description=_DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("subject", type=Path, nargs="?", metavar="AVATAR|SCENE", help="(default: the mean head)")
    parser.add_argument("--out", type=Path, default=Path("docs"), help="folder of the page (default: docs)")
    parser.add_argument("--size", type=int, default=192, metavar="N", help="longer side in pixels (default: 192)")
    parser.add_argument(
        "--minutes", type=float, default=20.0, help="wall time, about; references take half of it (default: 20)"
    )
    parser.add_argument(
        "--bound", type=float, default=0.5, metavar="PERCENT", help="standard error of a reference (default: 0.5)"
    )
    parser.add_argument("--voxel", type=float, default=0.02, help="spacing of the reference's mesh (default: 0.02)")
    parser.add_argument("--lights", nargs="+", metavar="NAME", help="settings of lights (default: all)")
    parser.add_argument(
        "--fits",
        nargs="+",
        type=Path,
        default=(),
        metavar="ROWS",
        help="rows.json of portraits score, one a row of fits",
    )
    parser.add_argument(
        "--evidence", type=Path, metavar="DIR", help="keep what is measured of each light there; a new run resumes"
    )
    parser.add_argument("--page", action="store_true", help="write the page from OUT/data/crosscheck.json alone")
    parser.add_argument("--no-speed", action="store_true", help="leave the ratios and costs out")
    parser.add_argument("--seed", type=int, default=0, help="of all random numbers")
    parser.add_argument("--variant", default="llvm_ad_rgb", help="Mitsuba variant")
    return parser


def _check(options: argparse.Namespace) -> None:
    for name, low, high in (
        ("size", 8, 1024),
        ("minutes", 0, 1e5),
        ("bound", 1e-3, 100),
        ("voxel", 0.01, 0.5),
        ("seed", 0, 2**31),
    ):
        value = getattr(options, name)
        if not (math.isfinite(value) and low <= value <= high):
            raise InputError(f"--{name} is {value}; it must be {low:g} to {high:g}")
    if not options.out.is_dir():
        raise InputError(f"{options.out} is not a folder; make it, or give another with --out")


def _command(arguments: list[str]) -> str:
    """The command of the page: without the folders that change nothing in it, and rows by QUALITY/rows.json alone."""
    parts, skipped = ["python", "-m", "studies.crosscheck"], False
    for argument in arguments:
        if not skipped and argument.split("=")[0] not in ("--out", "--evidence"):
            parts.append(f"RUNS/{'/'.join(Path(argument).parts[-2:])}" if argument.endswith("rows.json") else argument)
        skipped = argument in ("--out", "--evidence")
    return shlex.join(parts)


def main(arguments: list[str] | None = None) -> int:
    """Runs the command on `arguments` (default: the process's). Raises InputError for anything a user can mend."""
    arguments = sys.argv[1:] if arguments is None else arguments
    options = _parser().parse_args(arguments)
    _check(options)

    from sira_mi.variants import set_variant

    set_variant(options.variant)
    from studies.crosscheck import page
    from studies.data import read_figures, write_figures

    file = options.out / page.FIGURES
    if options.page:
        print(page.write_page(read_figures(file), options.out))
        return 0

    from studies.crosscheck.case import load_case
    from studies.crosscheck.curves import Point
    from studies.crosscheck.fits import read_fits
    from studies.crosscheck.lights import SETTINGS
    from studies.crosscheck.plots import plot_curves, plot_fits, plot_sheet, pyplot
    from studies.crosscheck.run import Settings, choose_lights, measure
    from studies.measures import require_flip

    if unknown := set(options.lights or ()) - set(SETTINGS):
        raise InputError(f"unknown lights {', '.join(sorted(unknown))}; known are {', '.join(SETTINGS)}")
    pyplot()
    require_flip()
    fits = read_fits(options.fits)
    case = load_case(options.subject, options.size)
    settings = Settings(
        size=options.size,
        minutes=options.minutes,
        bound=options.bound / 100,
        voxel=options.voxel,
        seed=options.seed,
        speed=not options.no_speed,
    )
    lights = choose_lights(case, tuple(options.lights or ()))
    measured, lit = measure(case, lights, settings, lambda line: print(line, flush=True), options.evidence)
    rows = {"rows": [asdict(fit) for fit in fits]}
    figures = write_figures(file, {"command": _command(arguments), **measured, "fits": rows})
    images = options.out / "images"
    plot_curves([Point(**point) for one in lit for point in one.figures["points"]], images / "crosscheck_curves.svg")
    plot_sheet(lit, images / "crosscheck_causes.png")
    if fits:
        plot_fits(fits, images / "crosscheck_fits.svg")
    print(page.write_page(figures, options.out))
    return 0


if __name__ == "__main__":
    run_command(main)
