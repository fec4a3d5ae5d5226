"""`python -m sira_mi.crosscheck AVATAR [--lights FILE] [--out DIR]`: how far the closed form is from path tracing."""

import argparse
import math
from pathlib import Path

from sira_mi.errors import CommandParser, InputError, check_range, check_writable, run_command

_DESCRIPTION = """\
Renders a fitted head in closed form and by path tracing, with the same camera and lobes, and writes their difference
to DIR: crosscheck.md (the page), crosscheck.png (both pictures and their difference) and crosscheck.json (the
figures)."""


def _parser() -> argparse.ArgumentParser:
    parser = CommandParser(
        prog="python -m sira_mi.crosscheck",
        description=_DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("avatar", type=Path, metavar="AVATAR", help="output folder of a fit, or an avatar.safetensors")
    parser.add_argument(
        "--lights", type=Path, metavar="FILE", help=".exr environment or .json lobes (default: the light of the photo)"
    )
    parser.add_argument("--out", type=Path, default=Path(), metavar="DIR", help="a folder (default: the current one)")
    parser.add_argument("--size", type=int, default=256, metavar="N", help="longer side in pixels (default: 256)")
    parser.add_argument("--spp", type=int, default=512, metavar="N", help="samples a pixel of path (default: 512)")
    parser.add_argument("--yaw", type=float, default=0.0, metavar="DEG", help="turns the head to its left (default: 0)")
    parser.add_argument("--seed", type=int, default=0, help="of the samples; the same seed repeats the figures")
    parser.add_argument("--variant", default="llvm_ad_rgb", help="Mitsuba variant, e.g. cuda_ad_rgb")
    return parser


def _check(options: argparse.Namespace) -> None:
    check_range("size", options.size, 8, 4096)
    check_range("spp", options.spp, 2, 1 << 20)
    check_range("seed", options.seed, 0, 2**32 - 2)
    if not math.isfinite(options.yaw):
        raise InputError(f"--yaw is {options.yaw}; it must be a number of degrees")
    if not options.out.is_dir():
        raise InputError(f"{options.out} is not a folder; make it, or give another with --out")
    check_writable(options.out)


def main(arguments: list[str] | None = None) -> int:
    """Runs the command on `arguments` (default: the process's). Raises InputError for anything a user can mend."""
    options = _parser().parse_args(arguments)
    _check(options)

    from sira_mi.files import check_outputs

    check_outputs([options.out / f"crosscheck.{kind}" for kind in ("json", "md", "png")], (options.lights,))

    from sira_mi.crosscheck.page import cross_check, write_page
    from sira_mi.relight.subject import read_light, read_subject
    from sira_mi.variants import set_variant

    set_variant(options.variant)
    subject = read_subject(options.avatar, options.size)
    light = read_light(options.lights, subject.avatar, lobes=True)
    names = options.avatar.name, options.lights.name if options.lights else None
    figures, picture = cross_check(subject, light, names, options.yaw, options.spp, options.seed)
    print(write_page(options.out, figures, picture))
    return 0


if __name__ == "__main__":
    run_command(main)
