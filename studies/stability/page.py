"""`docs/stability.md` from measured rows, which are kept beside it: a section that is not measured again stays."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from sira_mi.errors import InputError
from sira_mi.files import write_through
from studies.stability.rows import Row, Section

COMMAND = "python -m studies.stability"
ROWS = "stability.json"


@dataclass(frozen=True)
class Measured:
    """A section's rows."""

    quick: bool  # measured with fewer cases
    rows: tuple[Row, ...]


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


def _section(section: Section, measured: Measured) -> str:
    meanings = "\n".join(f"- **{row.name}**: {row.meaning}" for row in measured.rows)
    fewer = "" if not measured.quick else " Measured with fewer cases, by `--quick`."
    return f"## {section.title}\n\n{section.introduction}{fewer}\n\n{_table(measured.rows)}\n\n{meanings}\n"


def page(sections: Mapping[str, Section], measured: Mapping[str, Measured]) -> str:
    """The page's text: of every section, by name, that has been measured."""
    rows = [row for part in measured.values() for row in part.rows]
    missed = [row.name for row in rows if not row.passed]
    verdict = f"All {len(rows)} rows meet their bounds." if not missed else f"Missed: {'; '.join(missed)}."
    parts = "\n".join(_section(section, measured[name]) for name, section in sections.items() if name in measured)
    return f"""# Numerical stability

What single precision costs at the ends of every range, and what fits make of bad input, measured by

    {COMMAND}

Each row has its worst error over all cases, the bound that it must meet, the number of NaN and infinite results, which
must be 0, and whether the gradients are finite. Seeds are fixed. The tests run every row but those of the fits with
fewer cases against the same bounds. {verdict}

{parts}"""


def load_rows(folder: Path) -> dict[str, Measured]:
    """What `write_page` has left in `folder`, by the names of the sections; nothing where there is none.

    Raises InputError when the file is damaged."""
    path = folder / ROWS
    try:
        stored = json.loads(path.read_text(encoding="utf-8"))
        return {k: Measured(v["quick"], tuple(Row(**row) for row in v["rows"])) for k, v in stored.items()}
    except FileNotFoundError:
        return {}
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{path} is damaged ({error}); remove it to measure everything again") from error


def write_page(folder: Path, sections: Mapping[str, Section], measured: Mapping[str, Measured]) -> Path:
    """Writes the page and the rows behind it into `folder`; InputError when they cannot be written."""
    rows = json.dumps({name: asdict(part) for name, part in measured.items()}, indent=1, ensure_ascii=False) + "\n"
    write_through(folder / ROWS, lambda file: file.write_text(rows, encoding="utf-8"))
    path = folder / "stability.md"
    write_through(path, lambda file: file.write_text(page(sections, measured), encoding="utf-8"))
    return path
