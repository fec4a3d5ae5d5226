"""What the decisions of a fit's plan really cost and save: each alone, on one step of its stage."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np

from sira_mi.decisions import Decision, Plan
from sira_mi.fit.settings import APPEARANCE, FitSettings, Stage
from sira_mi.relight.measure import measure_saving


def measured_fit(plan: Plan, problem, settings: FitSettings, tensors: dict[str, np.ndarray]) -> Plan:
    """The plan with the error and the time saved of all that it leaves out of the stages of an `AppearanceProblem`, at
    the avatar tensors `tensors`, and where these have none, at what a stage starts from."""
    stages = {stage.name: stage for kind, stage in settings.stages if kind == APPEARANCE}
    for stage in stages.values():
        tensors = {**problem.start(stage, tensors), **tensors}
    problem.refresh(tensors)

    def gradient(stage: Stage, chosen: Plan) -> np.ndarray:
        problem.plan = chosen
        parameters = {name: mi.Float(tensors[name]) for name in stage.rates}
        dr.enable_grad(*parameters.values())
        terms = problem.losses(parameters, stage, stage.steps // 2, np.random.default_rng(0))
        dr.backward(sum(terms.values()))
        return np.concatenate([dr.grad(value).numpy().ravel() for value in parameters.values()])

    def measure(decision: Decision) -> Decision:
        stage = stages[decision.where]
        kept = Plan((replace(decision, left_out=False),))
        first, second = gradient(stage, kept), gradient(stage, Plan((decision,)))
        error = float(np.abs(second - first).max() / max(np.abs(first).max(), 1e-30))
        saved, spread = measure_saving(lambda: gradient(stage, kept), lambda: gradient(stage, Plan((decision,))))
        return replace(decision, error=error, saved=saved, saved_spread=spread)

    return Plan(tuple(measure(d) if d.left_out and not d.built_in else d for d in plan.decisions))
