"""`python -m studies.leave_out AVATAR [--lights FILE] [--out docs]`: measures what a head's pictures and a fit
leave out."""

from pathlib import Path

from sira_mi.errors import CommandParser, InputError, run_command


def main() -> int:
    parser = CommandParser(
        prog="python -m studies.leave_out", description="Measures what a head's pictures and a fit leave out."
    )
    parser.add_argument("avatar", type=Path, metavar="AVATAR", help="output folder of a fit, or an avatar.safetensors")
    parser.add_argument("--lights", type=Path, help=".exr environment or .json lobes (default: the light of the photo)")
    parser.add_argument("--out", type=Path, default=Path("docs"), help="folder of plan.md (default: docs)")
    parser.add_argument("--size", type=int, default=64, metavar="N", help="longer side of the pictures, pixels")
    parser.add_argument("--voxel", type=float, default=0.05, help="of the head's mesh, scene units (default: 0.05)")
    parser.add_argument("--variant", default="llvm_ad_rgb", help="Mitsuba variant")
    arguments = parser.parse_args()
    if not arguments.out.is_dir():
        raise InputError(f"{arguments.out} is not a folder; make it, or give another with --out")
    if not 16 <= arguments.size <= 1024:
        raise InputError(f"--size is {arguments.size}; it must be 16 to 1024")
    if not 0.02 <= arguments.voxel <= 0.2:
        raise InputError(f"--voxel is {arguments.voxel}; it must be 0.02 to 0.2")

    from sira_mi.variants import set_variant
    from studies.leave_out.page import write_page

    set_variant(arguments.variant)
    print(write_page(arguments.out, arguments.avatar, arguments.lights, arguments.size, arguments.voxel))
    return 0


if __name__ == "__main__":
    run_command(main)
