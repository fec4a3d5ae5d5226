"""`docs/stability.md` from measured rows."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from sira_mi.files import write_through
from sira_mi.stability.rows import Row, Section

COMMAND = "python -m sira_mi.stability"


def _table(rows: Sequence[Row]) -> str:
    lines = ["| row | cases | worst error | bound | NaN, inf | gradients | |", "|---|---|---|---|---|---|---|"]
    for row in rows:
        gradients = {None: "–", True: "finite", False: "not finite"}[row.gradients_finite]
        cells = (
            row.name,
            f"{row.cases:,}",
            f"{row.error:.2g}",
            f"{row.bound:.3g}",
            str(row.non_finite),
            gradients,
            "met" if row.passed else "**missed**",
        )
        lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    return "\n".join(lines)


def _section(section: Section, rows: Sequence[Row]) -> str:
    meanings = "\n".join(f"- **{row.name}**: {row.meaning}" for row in rows)
    return f"## {section.title}\n\n{section.introduction}\n\n{_table(rows)}\n\n{meanings}\n"


def page(measured: Sequence[tuple[Section, Sequence[Row]]], quick: bool) -> str:
    """The page's text."""
    command = COMMAND + (" --quick" if quick else "")
    rows = [row for _, part in measured for row in part]
    missed = [row.name for row in rows if not row.passed]
    verdict = f"All {len(rows)} rows meet their bounds." if not missed else f"Missed: {'; '.join(missed)}."
    sections = "\n".join(_section(section, part) for section, part in measured)
    return f"""# Numerical stability

What single precision costs at the ends of every range, measured by

    {command}

Each row has its worst error over all cases, the bound that it must meet, the number of NaN and infinite results, which
must be 0, and whether the gradients are finite. Seeds are fixed. The tests run every row with fewer cases against the
same bounds. {verdict}

{sections}"""


def write_page(folder: Path, measured: Sequence[tuple[Section, Sequence[Row]]], quick: bool) -> Path:
    """Writes `stability.md` into `folder`; InputError when it cannot be written."""
    path = folder / "stability.md"
    write_through(path, lambda file: file.write_text(page(measured, quick), encoding="utf-8"))
    return path
