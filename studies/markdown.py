"""Tables and numbers of the pages that evaluations write."""

from collections.abc import Sequence

import numpy as np


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)


def number(value: float, digits: int = 2) -> str:
    """A number with `digits` decimals; a dash for NaN."""
    return f"{value:.{digits}f}" if np.isfinite(value) else "–"


def percent(value: float) -> str:
    return f"{100 * value:.0f}%"


def average(rows: Sequence[dict], *path: str) -> float:
    """The mean over rows of the number at a path of keys, NaN left out."""
    values = []
    for row in rows:
        value = row
        for key in path:
            value = value[key]
        values.append(value)
    values = np.array(values, float)
    return float(np.nanmean(values)) if np.isfinite(values).any() else float("nan")
