"""`python -m sira_mi.collection build|sheet`: makes training scenes and contact sheets."""

import argparse
from pathlib import Path

from sira_mi.collection.build import BuildSettings, build
from sira_mi.collection.sheet import write_sheet
from sira_mi.errors import InputError, run_command


def main() -> int:
    parser = argparse.ArgumentParser(prog="sira_mi.collection", description="Training scenes of synthetic heads.")
    commands = parser.add_subparsers(dest="command", required=True)
    make = commands.add_parser("build", help="build or resume a collection")
    make.add_argument("--out", type=Path, required=True, help="folder for the scenes")
    make.add_argument("--count", type=int, default=64, help="number of heads")
    make.add_argument("--seed", type=int, default=0)
    make.add_argument("--hair", type=Path, help="folder of MakeHuman hair, NAME/NAME.mhclo and NAME.obj")
    make.add_argument("--hdri", type=Path, help="folder of .exr environment maps")
    make.add_argument("--workers", type=int, default=1, help="processes")
    sheet = commands.add_parser("sheet", help="write a contact sheet of a collection")
    sheet.add_argument("folder", type=Path)
    sheet.add_argument("--out", type=Path, required=True, help="PNG file")
    sheet.add_argument("--count", type=int, default=24, help="number of scenes shown")
    sheet.add_argument("--views", type=int, nargs="+", default=[0], help="view numbers shown of each scene")
    arguments = parser.parse_args()
    if arguments.command == "sheet":
        write_sheet(arguments.folder, arguments.out, count=arguments.count, views=tuple(arguments.views))
        return 0
    if arguments.seed < 0 or arguments.workers < 1:
        raise InputError("--seed must not be negative and --workers at least 1")
    settings = BuildSettings(arguments.count, arguments.seed, arguments.hair, arguments.hdri, arguments.workers)
    manifest = build(arguments.out, settings)
    write_sheet(arguments.out, arguments.out / "contact.png")
    failed = [entry for entry in manifest["scenes"] if "error" in entry]
    for entry in failed:
        print(f"{entry['file']}: {entry['error']}")
    print(f"{arguments.out}: {manifest['counts']}")
    return 1 if failed else 0


if __name__ == "__main__":
    run_command(main)
