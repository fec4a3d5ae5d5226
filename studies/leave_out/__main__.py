"""`python -m studies.leave_out AVATAR [--lights FILE] [--out docs]`: measures what a head's pictures and a fit
leave out."""

import argparse
from pathlib import Path

from sira_mi.errors import CommandParser, InputError, run_command


def _parser() -> argparse.ArgumentParser:
    parser = CommandParser(
        prog="python -m studies.leave_out",
        description="Measures what a head's pictures and a fit leave out. Writes OUT/data/leave_out.json, and from it "
        "OUT/leave_out.md.",
    )
    parser.add_argument(
        "avatar", type=Path, nargs="?", metavar="AVATAR", help="output folder of a fit, or an avatar.safetensors"
    )
    parser.add_argument("--lights", type=Path, help=".exr environment or .json lobes (default: the light of the photo)")
    parser.add_argument("--out", type=Path, default=Path("docs"), help="folder of the page (default: docs)")
    parser.add_argument("--size", type=int, default=64, metavar="N", help="longer side of the pictures, pixels")
    parser.add_argument("--voxel", type=float, default=0.05, help="of the head's mesh, scene units (default: 0.05)")
    parser.add_argument("--page", action="store_true", help="write the page from OUT/data/leave_out.json alone")
    parser.add_argument("--variant", default="llvm_ad_rgb", help="Mitsuba variant")
    return parser


def main(arguments: list[str] | None = None) -> int:
    """Runs the command on `arguments` (default: the process's). Raises InputError for anything a user can mend."""
    options = _parser().parse_args(arguments)
    if not options.out.is_dir():
        raise InputError(f"{options.out} is not a folder; make it, or give another with --out")
    if not 16 <= options.size <= 1024:
        raise InputError(f"--size is {options.size}; it must be 16 to 1024")
    if not 0.02 <= options.voxel <= 0.2:
        raise InputError(f"--voxel is {options.voxel}; it must be 0.02 to 0.2")
    if not options.page and options.avatar is None:
        raise InputError("give an AVATAR to measure, or --page")

    from studies.data import read_figures, write_figures
    from studies.leave_out.page import FIGURES, write_page

    file = options.out / FIGURES
    if options.page:
        print(write_page(read_figures(file), options.out))
        return 0

    from sira_mi.variants import set_variant

    set_variant(options.variant)
    from sira_mi.relight.leave_out import TOLERANCE
    from sira_mi.relight.subject import read_light, read_subject
    from studies.leave_out.measure import measure_fit_of_example, measure_pictures

    subject = read_subject(options.avatar)
    light = read_light(options.lights, subject.avatar, lobes=True)
    figures = {
        "command": f"python -m studies.leave_out AVATAR --size {options.size}",
        "size": options.size,
        "voxel": options.voxel,
        "tolerance": TOLERANCE,
        "pictures": measure_pictures(subject, light, options.size, options.voxel),
        "fit": measure_fit_of_example(),
    }
    print(write_page(write_figures(file, figures), options.out))
    return 0


if __name__ == "__main__":
    run_command(main)
