"""`python -m sira_mi.training.collection build|sheet|landmarks`:
makes training scenes and contact sheets, checks landmarks."""

import argparse
from pathlib import Path

from sira_mi.errors import CommandParser, InputError, run_command

# Seed of the first head of the landmark check; no collection's heads have it.
FIRST_CHECKED = 800_000


def main() -> int:
    parser = CommandParser(prog="sira_mi.training.collection", description="Training scenes of synthetic heads.")
    commands = parser.add_subparsers(dest="command", required=True)
    make = commands.add_parser("build", help="build or resume a collection")
    make.add_argument("--out", type=Path, required=True, help="folder for the scenes")
    make.add_argument("--count", type=int, default=64, help="number of MakeHuman heads")
    make.add_argument("--ict", type=Path, help="file of ICT-FaceKit's mean, modes and triangles")
    make.add_argument("--ict-count", type=int, default=64, help="number of ICT-FaceKit identities")
    make.add_argument("--valid", type=Path, help="folder of VALID avatars")
    make.add_argument("--meshes", type=Path, help="folder of textured head meshes: OBJ, PLY, GLB")
    make.add_argument("--seed", type=int, default=0)
    make.add_argument("--hair", type=Path, help="folder of MakeHuman hair, NAME/NAME.mhclo and NAME.obj")
    make.add_argument("--hdri", type=Path, help="folder of .exr environment maps")
    make.add_argument("--workers", type=int, default=1, help="processes")
    sheet = commands.add_parser("sheet", help="write a contact sheet of a collection")
    sheet.add_argument("folder", type=Path)
    sheet.add_argument("--out", type=Path, required=True, help="PNG file")
    sheet.add_argument("--count", type=int, default=24, help="number of scenes shown")
    sheet.add_argument("--views", type=int, nargs="+", default=[0], help="view numbers shown of each scene")
    check = commands.add_parser("landmarks", help="compare automatic landmarks with known ones")
    check.add_argument("--heads", type=int, default=8, help="number of MakeHuman heads")
    check.add_argument("--hair", type=Path, help="folder of MakeHuman hair")
    arguments = parser.parse_args()
    if arguments.command == "landmarks":
        return print_landmark_errors(arguments.heads, arguments.hair)

    from sira_mi.files import check_own, hold_folder
    from sira_mi.training.collection.build import BuildSettings, build
    from sira_mi.training.collection.makehuman import load_pack
    from sira_mi.training.collection.sheet import write_sheet

    if arguments.command == "sheet":
        check_own([arguments.out])
        write_sheet(arguments.folder, arguments.out, count=arguments.count, views=tuple(arguments.views))
        return 0
    if arguments.seed < 0 or arguments.workers < 1 or arguments.count < 0 or arguments.ict_count < 0:
        raise InputError("--seed, --count and --ict-count must not be negative, --workers must be at least 1")
    load_pack()  # before anything is written, as it may be missing
    settings = BuildSettings(sources_of(arguments), arguments.seed, arguments.hdri, arguments.workers)
    with hold_folder(arguments.out):
        manifest = build(arguments.out, settings)
        write_sheet(arguments.out, arguments.out / "contact.png")
    for entry in manifest["scenes"]:
        if "error" in entry:
            print(f"skipped {entry['file']}: {entry['error']}")
    print(f"{arguments.out}: {manifest['counts']}")
    return 0


def print_landmark_errors(heads: int, hair: Path | None) -> int:
    """Prints how far automatic landmarks are from the known ones of MakeHuman heads."""
    if heads < 1:
        raise InputError("--heads must be at least 1")

    import mitsuba as mi

    from sira_mi.training.collection.annotation import check_landmarks
    from sira_mi.training.collection.build import VARIANT

    mi.set_variant(VARIANT)
    errors = check_landmarks([FIRST_CHECKED + k for k in range(heads)], hair)
    print(
        f"{heads} heads, {errors['annotated_share']:.0%} of the landmarks annotated: "
        f"median {errors['median_mm']:.2f} mm, 95% under {errors['percentile_95_mm']:.2f} mm; "
        f"frame {errors['frame_shift_mm']:.2f} mm and {errors['frame_turn_degrees']:.2f}° off"
    )
    return 0


def sources_of(arguments: argparse.Namespace) -> tuple:
    """The sources that the command line names."""
    from sira_mi.training.collection.hair import list_hair
    from sira_mi.training.collection.sources.ict import IctSource
    from sira_mi.training.collection.sources.makehuman import MakeHumanSource
    from sira_mi.training.collection.sources.meshes import MeshSource
    from sira_mi.training.collection.sources.valid import ValidSource
    from sira_mi.training.collection.subject import Source

    if arguments.hair is not None:
        list_hair(arguments.hair)
    sources: list[Source] = [MakeHumanSource(arguments.count, arguments.hair)]
    if arguments.ict is not None:
        sources.append(IctSource(arguments.ict, arguments.ict_count, arguments.hair))
    if arguments.valid is not None:
        sources.append(ValidSource(arguments.valid))
    if arguments.meshes is not None:
        sources.append(MeshSource(arguments.meshes))
    return tuple(sources)


if __name__ == "__main__":
    run_command(main)
