"""`docs/stability.md`: `template.md` with the tables of `docs/data/stability.json` filled in."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from string import Template

from sira_mi.errors import InputError
from sira_mi.files import write_text
from studies.cache import write_json
from studies.markdown import table
from studies.stability.rows import Row

ROWS = Path("data") / "stability.json"
TEMPLATE = Path(__file__).with_name("template.md")


@dataclass(frozen=True)
class Measured:
    """The rows of a section."""

    quick: bool  # measured with fewer cases
    rows: tuple[Row, ...]


def fill_template(measured: Mapping[str, Measured]) -> str:
    """The page's text. A section that has not been measured says so."""
    template = TEMPLATE.read_text(encoding="utf-8")
    tables = dict.fromkeys(re.findall(r"\$(\w+)", template), "Not measured yet.")
    for name, part in measured.items():
        rows = _pivot(part.rows) if len({row.name for row in part.rows}) < len(part.rows) else _list(part.rows)
        tables[name] = rows + ("\n\nMeasured with fewer cases (`--quick`)." if part.quick else "")
    tables["marks"] = _summarise([row for part in measured.values() for row in part.rows])
    return Template(template).substitute(tables)


def _summarise(rows: Sequence[Row]) -> str:
    missed = [f"{row.name} ({row.unit})" for row in rows if not row.passed]
    gradients = [row.gradients_finite for row in rows if row.gradients_finite is not None]
    return table(
        ("mark", "value"),
        (
            ("rows within their bounds", f"{len(rows) - len(missed)} of {len(rows)}"),
            ("rows that miss theirs", ", ".join(missed) or "none"),
            ("NaN and infinite results", str(sum(row.non_finite for row in rows))),
            ("rows with finite gradients", f"{sum(gradients)} of {len(gradients)}"),
            ("cases", f"{sum(row.cases for row in rows):,}"),
        ),
    )


def _mark(row: Row) -> str:
    """The worst error with its bound in parentheses."""
    text = f"{row.error:.2g} ({row.bound:.3g})"
    return text if row.passed else f"**{text}, missed**"


def _list(rows: Iterable[Row]) -> str:
    """A line a row."""
    lines = []
    for row in rows:
        name = f"{row.name} ({row.note})" if row.note else row.name
        lines.append((name, _mark(row), row.unit))
    return table(("row", "worst (bound)", "unit"), lines)


def _pivot(rows: Sequence[Row]) -> str:
    """A line a name, a column a unit."""
    units, names = (list(dict.fromkeys(values)) for values in ([r.unit for r in rows], [r.name for r in rows]))
    cells = {(row.name, row.unit): _mark(row) for row in rows}
    return table(("case", *units), [(name, *(cells.get((name, unit), "") for unit in units)) for name in names])


def load_rows(folder: Path) -> dict[str, Measured]:
    """What `write_page` has left in `folder`, by the names of the sections; empty where there is none.

    Raises InputError when the file is damaged."""
    path = folder / ROWS
    try:
        stored = json.loads(path.read_text(encoding="utf-8"))
        return {k: Measured(v["quick"], tuple(Row(**row) for row in v["rows"])) for k, v in stored.items()}
    except FileNotFoundError:
        return {}
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{path} is damaged ({error}); remove it to measure everything again") from error


def write_page(folder: Path, measured: Mapping[str, Measured]) -> Path:
    """Writes the page and the rows behind it into `folder`; InputError when they cannot be written."""
    (folder / ROWS).parent.mkdir(exist_ok=True)
    write_json(folder / ROWS, {name: asdict(part) for name, part in measured.items()})
    path = folder / "stability.md"
    write_text(path, fill_template(measured))
    return path
