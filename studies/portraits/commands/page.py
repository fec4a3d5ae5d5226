"""write the page from its figures"""

import argparse
from pathlib import Path

from studies.data import read_figures
from studies.portraits.page import FIGURES, write_page


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--out", type=Path, default=Path("docs"), help="folder of the page (default: docs)")


def run(arguments: argparse.Namespace) -> None:
    """Writes the page from its figures."""
    print(f"{write_page(read_figures(arguments.out / FIGURES), arguments.out)} written")
