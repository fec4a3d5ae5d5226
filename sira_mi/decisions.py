"""What a picture or a fit leaves out: each decision with its reason, its bound and, once measured, its error."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any


@dataclass(frozen=True)
class Decision:
    """One thing that may be left out.

    The error of a picture is a radiance, in units of the radiance of a white diffuse surface that faces the light best.
    The error of a fit is that of the loss gradient, as a share of its largest entry. An error is 0 when the result
    differs only by rounding and by the choice of random numbers."""

    name: str
    where: str  # the stage of a fit, or "picture"
    left_out: bool
    reason: str  # the condition, and what was found
    bound: float = 0.0  # of the error
    changes: Mapping[str, Any] = field(default_factory=dict)  # the settings that carry it out
    error: float | None = None  # measured: root mean square over the head's pixels, or largest over the gradient
    noise: float | None = None  # of the measured error: the difference between two seeds of one picture
    saved: float | None = None  # measured share of the time that is saved
    saved_spread: float | None = None  # half the range of `saved` over the runs


@dataclass(frozen=True)
class Plan:
    """The decisions about one picture or one fit."""

    decisions: tuple[Decision, ...]

    @property
    def bound(self) -> float:
        """The bound of the error of everything that is left out."""
        return sum(d.bound for d in self.decisions if d.left_out)

    def leaves_out(self, name: str, where: str) -> bool:
        """Whether the decision of this name about this stage leaves something out."""
        return any(d.left_out for d in self.decisions if (d.name, d.where) == (name, where))

    def keep_all(self) -> Plan:
        """The plan that leaves out nothing."""
        return Plan(
            tuple(replace(d, left_out=False, reason=f"kept; {d.reason}") if d.left_out else d for d in self.decisions)
        )

    def apply(self, settings):
        """`settings`, a frozen dataclass, with the changes of everything that is left out."""
        changes: dict[str, Any] = {}
        for decision in self.decisions:
            if decision.left_out:
                changes |= decision.changes
        return replace(settings, **changes)

    def report(self) -> list[dict]:
        """The decisions as JSON objects, for `avatar.json`."""
        return [{k: dict(v) if isinstance(v, Mapping) else v for k, v in asdict(d).items()} for d in self.decisions]


def explain(plan: Plan) -> str:
    """The plan as text, one line per decision."""
    width = max(len(f"{d.name} ({d.where})") for d in plan.decisions)
    lines = []
    for d in plan.decisions:
        verdict = "left out" if d.left_out else "needed"
        lines.append(f"{verdict:8}  {f'{d.name} ({d.where})':{width}}  {d.reason}{_format_figures(d)}")
    return "\n".join(lines)


def _format_figures(decision: Decision) -> str:
    if not decision.left_out:
        return ""
    figures = [f"bound {decision.bound:.1e}" if decision.bound else "exact"]
    if decision.error is not None:
        noise = "" if not decision.noise else f" ± {decision.noise:.1e}"
        figures.append(f"measured {decision.error:.1e}{noise}")
    if decision.saved is not None and decision.saved_spread is not None:
        figures.append(f"{100 * decision.saved:.0f} ± {100 * decision.saved_spread:.0f} % of the time saved")
    return f" [{', '.join(figures)}]"
