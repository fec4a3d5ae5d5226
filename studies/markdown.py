"""Tables and numbers of the pages that the studies write."""

from collections.abc import Sequence

import numpy as np


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)


def number(value: float | None, digits: int = 2) -> str:
    """A number with `digits` decimals; a dash for None and NaN."""
    return "–" if value is None or not np.isfinite(value) else f"{value:.{digits}f}"


def percent(value: float) -> str:
    """A share as a whole percentage."""
    return f"{100 * value:.0f}%"
