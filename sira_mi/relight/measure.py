"""The measured error and saving of what a picture leaves out: each decision alone, on a small picture."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from sira_mi.decisions import Decision, Plan
from sira_mi.relight.leave_out import approximate_lobes
from sira_mi.relight.render import RelightSettings, load_head, load_scene, render_passes
from sira_mi.relight.subject import Light, Subject
from sira_mi.sg.weak_lobes import white_radiance

if TYPE_CHECKING:
    from sira_mi.plugins.neural_sdf import NeuralSDF

_SIZE = 64
_SAMPLES = {"path": 64, "sg": 4}
# Networks inside path tracing are slow.
_EXACT_SIZE, _EXACT_SAMPLES = 64, 4
_REPEATS = 3


def measure_plan(
    plan: Plan, subject: Subject, light: Light, settings: RelightSettings, yaw: float, size: int = _SIZE
) -> Plan:
    """The plan with the error, its noise and the time saved of everything that is left out, in a picture whose longer
    side has `size` pixels; `settings` leave nothing out."""
    white = max(white_radiance(approximate_lobes(light)), 1e-30)

    @cache
    def head(exact: bool, specular: bool) -> NeuralSDF:
        return load_head(subject, replace(settings, exact=exact, specular=specular))

    def measure(decision: Decision) -> Decision:
        exact = "exact" in decision.changes
        samples = _EXACT_SAMPLES if exact else _SAMPLES[settings.integrator]
        small = subject.resize(_EXACT_SIZE if exact else size)
        keeping = replace(settings, samples=samples, exact=exact)
        leaving_out = replace(keeping, **decision.changes)

        def renderer(one: RelightSettings) -> Callable[[int], np.ndarray]:
            scene = load_scene(head(one.exact, one.specular), small.camera, light, yaw, one)
            return lambda seed: render_passes(scene, replace(one, seed=seed))[..., :3]

        if exact:
            # One after the other: the kernels of every head hold the networks of all heads that are alive.
            reference, other, seconds = _render_alone(renderer(keeping), head.cache_clear)
            picture, _, less = _render_alone(renderer(leaving_out), head.cache_clear)
            saved, spread = 1 - less / max(seconds, 1e-9), 0.0
        else:
            full, part = renderer(keeping), renderer(leaving_out)
            reference, picture, other = full(0), part(0), full(1)
            saved, spread = measure_saving(lambda: full(0), lambda: part(0))
        covered = reference.max(axis=2) > 0
        error, noise = (
            float(np.sqrt(((image - reference)[covered] ** 2).mean())) / white if covered.any() else 0.0
            for image in (picture, other)
        )
        # Closed forms of the same film have the same random numbers: they differ by the decision alone.
        if settings.integrator == "sg" and "crop" not in decision.changes:
            noise = 0.0
        return replace(decision, error=error, noise=noise, saved=saved, saved_spread=spread)

    return Plan(tuple(measure(d) if d.left_out and d.changes else d for d in plan.decisions))


def _render_alone(
    render: Callable[[int], np.ndarray], forget_heads: Callable[[], None]
) -> tuple[np.ndarray, np.ndarray, float]:
    """A picture by two seeds, and the median processor time of some more, s."""
    first, second = render(0), render(1)
    seconds = []
    for _ in range(_REPEATS):
        start = time.process_time()
        render(0)
        seconds.append(time.process_time() - start)
    del render
    forget_heads()
    return first, second, float(np.median(seconds))


def measure_saving(
    keep: Callable[[], object], leave_out: Callable[[], object], repeats: int = _REPEATS
) -> tuple[float, float]:
    """The share of processor time that `leave_out` saves of `keep`: the median over pairs of runs in turn, after a
    first pair that does not count; and half the range over the pairs."""
    shares = []
    for _ in range(repeats + 1):
        seconds = []
        for run in (keep, leave_out):
            start = time.process_time()
            run()
            seconds.append(time.process_time() - start)
        shares.append(1 - seconds[1] / max(seconds[0], 1e-9))
    return float(np.median(shares[1:])), float(np.ptp(shares[1:]) / 2)
