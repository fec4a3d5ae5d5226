"""`python -m studies.stability [--only SECTION …]`: measures numerical stability, writes the figures and their page.

The figures go to `docs/data/stability.json`, the page that is filled with them to `docs/stability.md`. The fits take
half an hour; finished ones are kept in `--work` and run again only when something that they depend on has changed.
Sections that are not measured keep their figures. Ends with 1 when a row misses its bound."""

import time
from pathlib import Path

from sira_mi.errors import CommandParser, InputError, run_command


def main() -> int:
    parser = CommandParser(
        prog="python -m studies.stability",
        description="Measures numerical stability, writes the figures and their page.",
    )
    parser.add_argument("--out", type=Path, default=Path("docs"), help="folder of the page (default: docs)")
    parser.add_argument("--work", type=Path, default=Path("build/stability"), help="folder of portraits and fits")
    parser.add_argument("--only", nargs="+", metavar="SECTION", help="measure only these sections: fits, tracing, ...")
    parser.add_argument("--quick", action="store_true", help="fewer cases, as in the tests")
    parser.add_argument("--variant", default="llvm_ad_rgb", help="Mitsuba variant")
    arguments = parser.parse_args()
    if not arguments.out.is_dir():
        raise InputError(f"{arguments.out} is not a folder; make it, or give another with --out")

    from sira_mi.variants import set_variant

    set_variant(arguments.variant)

    from studies.stability.page import Measured, load_rows, write_page
    from studies.stability.sections import list_sections

    sections = list_sections(arguments.work)
    if unknown := set(arguments.only or ()) - set(sections):
        raise InputError(f"unknown sections {', '.join(sorted(unknown))}; known are {', '.join(sections)}")
    measured = {name: part for name, part in load_rows(arguments.out).items() if name in sections}
    start, passed = time.monotonic(), True
    for name in arguments.only or sections:
        rows = []
        for measure in sections[name]:
            began = time.monotonic()
            row = measure(arguments.quick)
            verdict = "met" if row.passed else "MISSED"
            print(
                f"{verdict:6} {row.name}: {row.error:.2g}, bound {row.bound:.3g}, {row.non_finite} not finite "
                f"({row.cases} cases, {time.monotonic() - began:.0f} s)",
                flush=True,
            )
            rows.append(row)
            passed &= row.passed
        measured[name] = Measured(arguments.quick, tuple(rows))
        path = write_page(arguments.out, measured)
    print(f"wrote {path} after {time.monotonic() - start:.0f} s")
    return int(not passed)


if __name__ == "__main__":
    run_command(main)
