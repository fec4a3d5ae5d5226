"""`docs/leave_out.md`: `template.md` with the figures of `docs/data/leave_out.json` filled in."""

from __future__ import annotations

from pathlib import Path
from string import Template

from sira_mi.files import write_text
from studies.markdown import table

FIGURES = Path("data") / "leave_out.json"  # beside the page
TEMPLATE = Path(__file__).with_name("template.md")


def write_page(figures: dict, out: Path) -> Path:
    """Writes `out/leave_out.md`; returns its path."""
    write_text(out / "leave_out.md", render_page(figures))
    return out / "leave_out.md"


def render_page(figures: dict) -> str:
    """The page's Markdown."""
    pictures = figures["pictures"]
    return Template(TEMPLATE.read_text(encoding="utf-8")).substitute(
        command=figures["command"],
        revision=figures["measured"]["revision"],
        date=figures["measured"]["date"],
        size=figures["size"],
        tolerance=f"{figures['tolerance']:g}",
        pictures=table(
            ("picture: left out", "bound", "error", "noise", "time saved"),
            [
                [f"{picture['title']}: {decision['name']}", *_errors(decision), _saving(decision)]
                for picture in pictures
                for decision in picture["decisions"]
                if decision["left_out"]
            ],
        ),
        needed="\n".join(f"- {d['name']}: {d['reason']}" for d in pictures[0]["decisions"] if not d["left_out"]),
        fit=table(
            ("stage: left out", "error", "time saved"),
            [[f"{d['where']}: {d['name']}", _error(d["error"]), _saving(d)] for d in figures["fit"] if d["left_out"]],
        ),
    )


def _errors(decision: dict) -> list[str]:
    return [_error(decision[key]) for key in ("bound", "error", "noise")]


def _error(value: float | None) -> str:
    return "–" if value is None else "0" if value == 0 else f"{value:.1e}"


def _saving(decision: dict) -> str:
    if decision["saved"] is None:
        return "–"
    return f"{100 * decision['saved']:.0f} ± {100 * decision['saved_spread']:.0f} %"
