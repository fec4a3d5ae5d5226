"""The error and the time saved of each decision of a fit, measured alone on one step of its stage."""

from __future__ import annotations

from dataclasses import replace
from functools import reduce
from operator import add

import drjit as dr
import mitsuba as mi
import numpy as np

from sira_mi.decisions import Decision, Plan
from sira_mi.fit.stage import FitTask, Stage
from sira_mi.fit.state import FitState
from sira_mi.relight.measure import measure_saving


def measure_fit(task: FitTask, state: FitState) -> Plan:
    """The plan of `task` with error and saved time of every decision, at what its stage would start from after
    `state`."""
    return Plan(
        tuple(
            _measure(decision, task, stage, state)
            for stage in task.settings.stages
            for decision in task.plan.decisions
            if decision.where == stage.name
        )
    )


def _measure(decision: Decision, task: FitTask, stage: Stage, state: FitState) -> Decision:
    if not decision.left_out:
        return decision
    whole = _Step(task.with_plan(Plan((replace(decision, left_out=False),))), stage, state)
    less = _Step(task.with_plan(Plan((decision,))), stage, state)
    gradient = whole.gradient()
    error = float(np.abs(less.gradient() - gradient).max() / max(np.abs(gradient).max(), 1e-30))
    saved, spread = measure_saving(whole.gradient, less.gradient)
    return replace(decision, error=error, saved=saved, saved_spread=spread)


class _Step:
    """The middle step of a stage."""

    def __init__(self, task: FitTask, stage: Stage, state: FitState):
        self.stage, self.problem = stage, stage.problem(task, state)
        self.state = self.problem.start(state)
        self.problem.refresh(self.state)

    def gradient(self) -> np.ndarray:
        """The gradient of the losses by all of the stage's parameters, one after the other."""
        parameters = {name: mi.Float(value) for name, value in self.state.parameters(self.stage.rates).items()}
        dr.enable_grad(*parameters.values())
        terms = self.problem.losses(parameters, self.stage.steps // 2, np.random.default_rng(0))
        dr.backward(reduce(add, terms.values()))
        return np.concatenate([dr.grad(value).numpy().ravel() for value in parameters.values()])
