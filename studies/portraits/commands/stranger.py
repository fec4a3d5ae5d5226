"""write a sheet of relit heads and photos to be paired blindly, and its key"""

import argparse
from pathlib import Path

from sira_mi.errors import InputError


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--benchmark", type=Path, required=True, help="folder of build")
    parser.add_argument("--runs", type=Path, required=True, help="folder of the rows, a folder each")
    parser.add_argument("--row", default="draft", metavar="NAME", help="whose heads are shown (default: draft)")
    parser.add_argument("--half", choices=("choice", "report"), default="report", help="(default: report)")
    parser.add_argument("--seed", type=int, default=0, help="of the people, their portraits and their order")
    parser.add_argument("--out", type=Path, required=True, help="folder of stranger.jpg and stranger.json, the key")


def run(arguments: argparse.Namespace) -> None:
    """Writes the sheet and the key. Raises InputError when the row has pictures of fewer than two people."""
    from studies.portraits.benchmark import read_benchmark
    from studies.portraits.sheets import Album, draw_strangers
    from studies.portraits.truth import VIEWS

    albums = [
        Album(arguments.benchmark, arguments.runs, entry)
        for entry in read_benchmark(arguments.benchmark)
        if entry["half"] == arguments.half
        and all((arguments.runs / arguments.row / entry["name"] / f"{view}.exr").exists() for view in VIEWS)
    ]
    people = {album.entry["identity"] for album in albums}
    if len(people) < 2:
        raise InputError(f"{arguments.runs / arguments.row} has pictures of {len(people)} people; fit and relight more")
    draw_strangers(albums, arguments.row, arguments.out, arguments.seed)
    print(f"{arguments.out / 'stranger.jpg'} and its key, stranger.json, written")
