"""`python -m sira_mi.stability [--out docs] [--quick]`: measures every row and writes the page of numerical stability.

Ends with 1 when a row misses its bound."""

import argparse
import time
from pathlib import Path

import mitsuba as mi

from sira_mi.errors import InputError, run_command


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m sira_mi.stability", description=__doc__.split("\n")[0])
    parser.add_argument("--out", type=Path, default=Path("docs"), help="folder of the page (default: docs)")
    parser.add_argument("--quick", action="store_true", help="fewer cases, as in the tests")
    parser.add_argument("--variant", default="llvm_ad_rgb", help="Mitsuba variant")
    arguments = parser.parse_args()
    if not arguments.out.is_dir():
        raise InputError(f"{arguments.out} is not a folder; make it, or give another with --out")
    mi.set_variant(arguments.variant)

    from sira_mi.stability.page import write_page
    from sira_mi.stability.sections import SECTIONS

    start, measured = time.monotonic(), []
    for section in SECTIONS:
        rows = []
        for measure in section.measures:
            began = time.monotonic()
            row = measure(arguments.quick)
            verdict = "met" if row.passed else "MISSED"
            print(
                f"{verdict:6} {row.name}: {row.error:.2g}, bound {row.bound:.3g}, {row.non_finite} not finite "
                f"({row.cases} cases, {time.monotonic() - began:.0f} s)",
                flush=True,
            )
            rows.append(row)
        measured.append((section, rows))
    path = write_page(arguments.out, measured, arguments.quick)
    print(f"{path} written after {time.monotonic() - start:.0f} s")
    return int(not all(row.passed for _, rows in measured for row in rows))


if __name__ == "__main__":
    run_command(main)
