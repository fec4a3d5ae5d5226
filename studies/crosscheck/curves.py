"""Error against time: every method with more and more samples, and the limits of path tracing."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import mitsuba as mi
import numpy as np

from sira_mi.plugins.neural_sdf import NeuralSDF
from studies.crosscheck import forms
from studies.crosscheck.case import Case
from studies.crosscheck.images import (
    Estimate,
    LaunchLog,
    mean_square,
    path,
    relative_error,
    render,
    resolution,
    root,
)
from studies.crosscheck.points import field_points
from studies.measures import flip

PHYSG, FORM, VISIBLE = "a: PhySG", "b: closed form", "c: with visibility (sira_sg)"
SHARED = "c: with visibility, shared by samples"
SHARED_MESH = "c: with visibility, shared, on the mesh, baked"
DIRECT, BOUNCE, PATH = "d: direct light, Monte Carlo", "e: path, one bounce", "e: path, all bounces"
# Depths of Mitsuba's path tracer.
DEPTHS = {DIRECT: 2, BOUNCE: 3, PATH: -1}
# Square roots of the samples a pixel of closed forms: those that shade every sample, and those that share shadings.
_SIDES, _SHARED_SIDES = (1, 2, 3), (2, 3, 4, 6)
_TRACED_SAMPLES = (1, 4, 16, 64, 256, 1024, 4096)
_REPEATS = 3
# Runs of closed forms, which alternate between two sets of rays.
_TURNS = 2
# From this many samples a pixel on, the time of a launch grows with its samples.
_FIRST_FITTED = 16


@dataclass(frozen=True)
class Point:
    """One point of a curve."""

    light: str
    method: str
    samples: int  # a pixel
    seconds: float  # wall time of the picture, kernels compiled before
    error: float  # relative root mean square against the reference, inside the head
    flip: float


@dataclass(frozen=True)
class Limit:
    """The difference between the limit of path tracing to some depth and the reference."""

    light: str
    method: str
    error: float  # relative root mean square without noise
    resolution: float  # the error that noise alone may show (two standard errors of the square)


@dataclass(frozen=True)
class Slope:
    """Straight lines through log error over log time and over log samples, of the path tracer."""

    light: str
    over_time: float
    over_samples: float


def time_runs(function: Callable[[int], np.ndarray], repeats: int, warm: bool) -> tuple[np.ndarray, float]:
    """The last result and the median wall time of `repeats` runs of `function(k)` with k alternating between 0 and 1;
    `warm` runs each once before. Alternating keeps `neural_sdf` from reusing the hits of the last run, and kernels of
    two numbers of hits are compiled after two runs."""
    if warm:
        function(0)
        function(1)
    spent = []
    for k in range(repeats):
        start = time.perf_counter()
        result = function(k % 2)
        spent.append(time.perf_counter() - start)
    return result, float(np.median(spent))


def _closed_forms(case: Case, head: NeuralSDF, lobes: np.ndarray, seed: int, log: LaunchLog) -> Iterator:
    """(method, samples, function of the run's number that renders it)."""
    scene = case.scene(head, lobes, even=True)
    light = (forms.local_lobes(lobes, head), case.roughness, case.k_s)

    def physg(side, k):
        points = field_points(case, scene, head, side, seed + k)
        return points.picture(forms.physg(points, *light))

    for side in _SIDES:
        yield PHYSG, side**2, lambda k, side=side: physg(side, k)
    for name, sides, options in (
        (FORM, _SIDES, {"visibility": False}),
        (VISIBLE, _SIDES, {}),
        (SHARED, _SHARED_SIDES, {"shared": True}),
        (SHARED_MESH, _SHARED_SIDES, {"shared": True, "exact": False}),
    ):
        plugin = mi.load_dict({"type": "sira_sg", "hide_emitters": True, "aovs": False, **options})
        for side in sides:
            yield name, side**2, lambda k, side=side, plugin=plugin: render(scene, plugin, side**2, seed, 2, k, log=log)


def measure_curves(
    case: Case,
    head: NeuralSDF,
    light: str,
    lobes: np.ndarray,
    reference: Estimate,
    mask: np.ndarray,
    seconds: float,
    seed: int,
    log: LaunchLog,
) -> tuple[list[Point], list[Limit]]:
    """The curves of all methods under one light, within about `seconds`."""
    scene, points, limits = case.scene(head, lobes), [], []
    start = time.monotonic()

    def add(method, samples, image, spent):
        error = relative_error(image, reference, mask)
        points.append(Point(light, method, samples, spent, error, flip(image, reference.mean, mask)))

    for method, samples, function in _closed_forms(case, head, lobes, seed, log):
        add(method, samples, *time_runs(function, _TURNS, warm=True))
    left = max(seconds - (time.monotonic() - start), 0.4 * seconds)
    for method, depth in DEPTHS.items():
        integrator, halves, spent = path(depth), [], 0.0
        # Half of the time that is left is for all bounces. Each step takes four times as long as the one before, and
        # the last is taken twice.
        allowed = left * (0.5 if method == PATH else 0.25)
        began = time.monotonic()
        for samples in _TRACED_SAMPLES:
            if samples > 4 * _FIRST_FITTED and time.monotonic() - began + 8 * spent > allowed:
                break

            def run(k, samples=samples, integrator=integrator):
                return render(scene, integrator, samples, seed, 3, samples, k, log=log)

            few = samples <= 16
            image, spent = time_runs(run, _REPEATS if few else 1, warm=few)
            halves = [image]
            add(method, samples, image, spent)
        halves.append(render(scene, integrator, points[-1].samples, seed, 3, points[-1].samples, _REPEATS + 1, log=log))
        limits.append(limit(light, method, halves, reference, mask))
    return points, limits


def limit(light: str, method: str, halves: list[np.ndarray], reference: Estimate, mask: np.ndarray) -> Limit:
    """How far the limit of a method is from the reference, by two independent pictures of it, without their noise."""
    first, second = (halves[k] - reference.halves[k] for k in range(2))
    level = max(float(reference.mean[mask].mean()), 1e-12)
    error = root(mean_square(first, second, mask))
    return Limit(light, method, error / level, resolution(first, second, mask) / level)


def slope_of(x: np.ndarray, error: np.ndarray) -> float:
    """Slope of the straight line through log error over log x; NaN for fewer than two points."""
    return float(np.polyfit(np.log(x), np.log(error), 1)[0]) if len(x) > 1 else float("nan")


def slopes(points: list[Point]) -> list[Slope]:
    """The path tracer's slopes under every light, from `_FIRST_FITTED` samples a pixel on."""
    result = []
    for light in dict.fromkeys(point.light for point in points):
        used = [p for p in points if (p.light, p.method) == (light, PATH) and p.samples >= _FIRST_FITTED]
        error = np.array([p.error for p in used])
        over = (slope_of(np.array([getattr(p, name) for p in used]), error) for name in ("seconds", "samples"))
        result.append(Slope(light, *over))
    return result


def time_of_path(points: list[Point], light: str, error: float) -> float:
    """Wall time that path tracing takes to `error` under a light, by a line of slope −½ through its points on
    logarithmic axes; NaN without points."""
    used = [p for p in points if (p.light, p.method) == (light, PATH) and p.samples >= _FIRST_FITTED]
    if not used:
        return float("nan")
    square = float(np.exp(np.mean([np.log(p.error**2 * p.seconds) for p in used])))
    return square / max(error, 1e-9) ** 2
