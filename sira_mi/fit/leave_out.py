"""What the stages of a fit leave out. Every decision is exact: what is left out is zero, or was computed before."""

from __future__ import annotations

from sira_mi.decisions import Decision, Plan
from sira_mi.fit.settings import APPEARANCE, FitSettings, Stage

SPECULARS, BASE_ALBEDO, REFINEMENT = "speculars", "base albedo at every step", "refinement"


def plan_fit(settings: FitSettings) -> Plan:
    """The decisions about all stages, from their settings alone."""
    stages = [stage for kind, stage in settings.stages if kind == APPEARANCE]
    decisions = [
        decision for stage in stages for decision in (_speculars(stage), _base_albedo(stage), _refinement(stage))
    ]
    return Plan((*decisions, *_ALWAYS))


def _speculars(stage: Stage) -> Decision:
    dark = tuple(stage.k_s) == (0.0, 0.0)
    return Decision(SPECULARS, stage.name, dark, "k_s is 0 at every step" if dark else f"k_s goes to {stage.k_s[1]:g}")


def _base_albedo(stage: Stage) -> Decision:
    moved = [name for name in ("z_a", "diffuse_albedo") if name in stage.rates]
    reason = f"moved by {', '.join(moved)}" if moved else "its latent and network are fixed: once, with the skin's tone"
    return Decision(BASE_ALBEDO, stage.name, not moved, reason)


def _refinement(stage: Stage) -> Decision:
    unused = stage.k_r == 0
    return Decision(REFINEMENT, stage.name, unused, f"k_r is {stage.k_r:g}", built_in=unused)


_ALWAYS = (
    Decision("deformation at every step", "appearance", True, "the geometry is fixed: once a point", built_in=True),
    Decision("shadow rays at every step", "appearance", True, "the geometry is fixed: once a point", built_in=True),
    Decision("gradients of points", "appearance", True, "the geometry is fixed", built_in=True),
    Decision("pixels outside the mask", "appearance", True, "no loss looks at them", built_in=True),
    Decision("extra channels", "turned views", True, "the contact sheet shows the radiance alone", built_in=True),
    Decision("weak lobes", "appearance", False, "all lobes are optimised; a weak one may grow"),
)
