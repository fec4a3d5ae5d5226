"""What the decisions of a plan really cost and save: each alone, on a small picture or on some steps of a fit."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np

from sira_mi.decisions import Decision, Plan
from sira_mi.relight.leave_out import image_lobes
from sira_mi.relight.render import RelightSettings, load_head, load_scene, render_passes
from sira_mi.relight.subject import Light, Subject
from sira_mi.sg.weak_lobes import white_radiance

_SIZE = 64
_SAMPLES = {"path": 64, "sg": 4}
# Networks inside of path tracing are slow.
_EXACT_SIZE, _EXACT_SAMPLES = 64, 4
_REPEATS = 3


def measure_plan(
    plan: Plan, subject: Subject, light: Light, settings: RelightSettings, yaw: float, size: int = _SIZE
) -> Plan:
    """The plan with the error, its noise and the time saved of all that it leaves out, on a picture whose longer side
    has `size` pixels; `settings` are those that leave nothing out."""

    @cache
    def head(exact: bool, specular: bool):
        return load_head(subject, replace(settings, exact=exact, specular=specular))

    decisions = tuple(
        _measure_decision(d, head, subject, light, settings, yaw, size) if d.left_out and d.changes else d
        for d in plan.decisions
    )
    return Plan(decisions)


def _measure_decision(decision: Decision, head, subject, light, settings: RelightSettings, yaw, size) -> Decision:
    exact = "exact" in decision.changes
    samples = _EXACT_SAMPLES if exact else _SAMPLES[settings.integrator]
    subject = subject.resize(_EXACT_SIZE if exact else size)
    kept = replace(settings, samples=samples, exact=exact)
    left_out = replace(kept, **decision.changes)

    def pictures(one: RelightSettings) -> Callable[..., np.ndarray]:
        scene = load_scene(head(one.exact, one.specular), subject.camera, light, yaw, one)
        return lambda seed=0: render_passes(scene, replace(one, seed=seed))[..., :3]

    if exact:
        # One after the other: the kernels of every head hold the networks of all that are alive.
        reference, other, seconds = _measure_alone(pictures(kept), head)
        picture, _, less = _measure_alone(pictures(left_out), head)
        saved, spread = 1 - less / max(seconds, 1e-9), 0.0
    else:
        full, part = pictures(kept), pictures(left_out)
        reference, picture, other = full(), part(), full(seed=1)
        saved, spread = measure_saving(full, part)
    lobes = image_lobes(light.image) if light.lobes is None else light.lobes
    white = max(white_radiance(lobes), 1e-30)
    covered = reference.max(axis=2) > 0
    error, noise = (
        float(np.sqrt(((image - reference)[covered] ** 2).mean())) / white if covered.any() else 0.0
        for image in (picture, other)
    )
    # Where the random numbers are the same, nothing but the decision differs.
    same_numbers = not ({"crop"} & decision.changes.keys()) and settings.integrator == "sg"
    return replace(decision, error=error, noise=0.0 if same_numbers else noise, saved=saved, saved_spread=spread)


def _measure_alone(picture: Callable[..., np.ndarray], head) -> tuple[np.ndarray, np.ndarray, float]:
    """A picture by two seeds, and the processor's time of one, the median of some after those; forgets all heads."""
    images, seconds = [picture(seed=seed) for seed in range(2)], []
    for _ in range(_REPEATS):
        start = time.process_time()
        picture()
        seconds.append(time.process_time() - start)
    del picture
    head.cache_clear()
    return *images, float(np.median(seconds))


def measure_saving(kept: Callable[[], object], left_out: Callable[[], object], repeats: int = _REPEATS) -> tuple:
    """Share of the processor's time that `left_out` takes less than `kept`: the median over pairs of runs in turn,
    after a first pair that does not count; and half the range over the pairs."""
    shares = []
    for _ in range(repeats + 1):
        seconds = []
        for run in (kept, left_out):
            start = time.process_time()
            run()
            seconds.append(time.process_time() - start)
        shares.append(1 - seconds[1] / max(seconds[0], 1e-9))
    return float(np.median(shares[1:])), float(np.ptp(shares[1:]) / 2)
