"""A plan as data: what is left out, why, and what that costs in exactness and saves in time."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, replace


@dataclass(frozen=True)
class Decision:
    """One thing that may be left out. Errors of a picture are radiances, in units of that of a white diffuse surface
    which faces the light best; errors of a fit are those of the losses' gradient, as a share of its largest entry. They
    are 0 where nothing but rounding and the choice of random numbers differs."""

    name: str
    where: str  # the stage of a fit, or "picture"
    left_out: bool
    reason: str  # the condition, and what was found
    bound: float = 0.0  # of the error
    built_in: bool = False  # left out at all times: nothing switches it off
    changes: Mapping[str, object] = field(default_factory=dict)  # settings that carry it out
    error: float | None = None  # measured: root mean square over the head's pixels, largest over the gradient
    noise: float | None = None  # of the measured error: what two seeds of one picture differ by
    saved: float | None = None  # measured share of the time without this decision
    saved_spread: float | None = None  # of that share: half the range of the runs


@dataclass(frozen=True)
class Plan:
    """The decisions about one picture or one fit."""

    decisions: tuple[Decision, ...]

    @property
    def bound(self) -> float:
        """Of the error of all that is left out."""
        return sum(d.bound for d in self.decisions if d.left_out)

    def leaves_out(self, name: str, where: str) -> bool:
        """Whether the decision of that name, about that stage, is to leave out."""
        return any(d.left_out for d in self.decisions if (d.name, d.where) == (name, where))

    def keeping(self, decisions: Iterable[Decision] | None = None) -> Plan:
        """The plan that leaves out none of `decisions` (None: of all), but what is built in."""
        kept = self.decisions if decisions is None else tuple(decisions)
        return Plan(
            tuple(
                replace(d, left_out=False, reason=f"kept; {d.reason}")
                if d in kept and d.left_out and not d.built_in
                else d
                for d in self.decisions
            )
        )

    def apply(self, settings):
        """`settings`, a frozen dataclass, with the changes of all that is left out."""
        changes: dict[str, object] = {}
        for decision in self.decisions:
            if decision.left_out:
                changes |= decision.changes
        return replace(settings, **changes)

    def report(self) -> list[dict]:
        """For `avatar.json`: each decision as a JSON object."""
        return [{k: dict(v) if isinstance(v, Mapping) else v for k, v in asdict(d).items()} for d in self.decisions]


def explain(plan: Plan) -> str:
    """The plan in words, a line a decision."""
    width = max(len(f"{d.name} ({d.where})") for d in plan.decisions)
    lines = []
    for d in plan.decisions:
        verdict = "built in" if d.built_in and d.left_out else "left out" if d.left_out else "needed"
        lines.append(f"{verdict:8}  {f'{d.name} ({d.where})':{width}}  {d.reason}{_figures(d)}")
    return "\n".join(lines)


def _figures(decision: Decision) -> str:
    if not decision.left_out:
        return ""
    figures = [f"bound {decision.bound:.1e}" if decision.bound else "exact"]
    if decision.error is not None:
        noise = "" if not decision.noise else f" ± {decision.noise:.1e}"
        figures.append(f"measured {decision.error:.1e}{noise}")
    if decision.saved is not None:
        figures.append(f"{100 * decision.saved:.0f} ± {100 * decision.saved_spread:.0f} % of the time saved")
    return f" [{', '.join(figures)}]"
