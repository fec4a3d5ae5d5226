"""write the page from its figures"""

import argparse
from pathlib import Path


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--out", type=Path, default=Path("docs"), help="folder of the page (default: docs)")


def run(arguments: argparse.Namespace) -> None:
    """Writes the page from its figures."""
    from studies.portraits.page import write_page

    print(f"{write_page(arguments.out)} written")
