"""Path-traced pictures in passes of independent seeds, references that end when their variance is small enough, and
differences between pictures that are known as two independent halves."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable
from dataclasses import dataclass

import mitsuba as mi
import numpy as np

# Rays of one launch.
_LAUNCH = 1 << 21
# Tries of a launch, with other seeds, while it has values that are not finite.
_MOST_TRIES = 5
# Passes before the variance among them is used.
_MINIMUM_PASSES = 8


@dataclass(frozen=True, eq=False)
class Estimate:
    """A picture as two independent halves, and how far their mean is from its limit."""

    halves: np.ndarray  # [2, H, W, 3] linear radiance
    error: float  # estimated standard error of the mean, root mean square over the head, share of the mean radiance
    passes: int
    seconds: float  # wall time
    converged: bool  # whether the bound on `error` was reached before the time was over

    @property
    def mean(self) -> np.ndarray:
        """The picture [H, W, 3]."""
        return self.halves.mean(axis=0)


@dataclass
class LaunchLog:
    """How many launches were made, and how many of them were not finite everywhere and were made again."""

    launches: int = 0
    non_finite: int = 0


def pass_seed(*numbers: int) -> int:
    """A seed for Mitsuba that depends on all `numbers`."""
    return int(np.random.SeedSequence(numbers).generate_state(1)[0])


def render(
    scene: mi.Scene, integrator: mi.Integrator, samples: int, *seed: int, log: LaunchLog | None = None
) -> np.ndarray:
    """The radiance [H, W, 3] (float64) with `samples` a pixel, in launches that bound the memory.

    A launch with NaN or infinite pixels is counted in `log` and made again with another seed; RuntimeError when that
    does not help."""
    width, height = scene.sensors()[0].film().size()
    most = max(1, _LAUNCH // (int(width) * int(height)))
    log = log or LaunchLog()
    total = np.zeros((int(height), int(width), 3))
    for k, start in enumerate(range(0, samples, most)):
        count = min(most, samples - start)
        for attempt in range(_MOST_TRIES):
            key = mi.UInt32(pass_seed(*seed, k, attempt))
            image = mi.render(scene, integrator=integrator, spp=count, seed=key).numpy()
            log.launches += 1
            if np.isfinite(image).all():
                break
            log.non_finite += 1
        else:
            raise RuntimeError(f"{_MOST_TRIES} renders in a row had pixels that are not finite")
        total += count * image[..., :3].astype(np.float64)
    return total / samples


def path(depth: int = -1) -> mi.Integrator:
    """Mitsuba's path tracer to `depth` (2: direct light; -1: any), black behind the head. Russian roulette starts late,
    so that pictures of different depths share the random numbers of their first bounces."""
    return mi.load_dict({"type": "path", "max_depth": depth, "rr_depth": 16, "hide_emitters": True})


def converge(
    render_pass: Callable[[int], np.ndarray], mask: np.ndarray, bound: float, seconds: float, scale: float | None = None
) -> Estimate:
    """The mean of `render_pass(k)` [H, W, 3] for k = 0, 1, ...: until the standard error that the passes show, root
    mean square over `mask` [H, W], is below `bound` as a share of `scale` (default: the mean over the mask), or until
    `seconds` are over. There are at least 8 passes, an even number."""
    start = time.monotonic()
    sums: list[np.ndarray] = [np.zeros(1), np.zeros(1)]
    squares: np.ndarray = np.zeros(1)
    for k in itertools.count():
        image = np.asarray(render_pass(k), np.float64)
        sums[k % 2] = sums[k % 2] + image
        squares = squares + image * image
        passes = k + 1
        if passes % 2 or passes < _MINIMUM_PASSES:
            continue
        mean = (sums[0] + sums[1]) / passes
        variance = np.maximum(squares / passes - mean * mean, 0)[mask] / (passes - 1)
        level = scale if scale is not None else max(float(mean[mask].mean()), 1e-12)
        error = float(np.sqrt(variance.mean())) / level
        spent = time.monotonic() - start
        if error <= bound or spent >= seconds:
            return Estimate(np.stack(sums) * (2 / passes), error, passes, spent, error <= bound)
    raise AssertionError("the loop has no other end")


def mean_square(first: np.ndarray, second: np.ndarray, mask: np.ndarray) -> float:
    """Mean of the product of two independent estimates [H, W, 3] of one difference over `mask`: the mean square of that
    difference, without what their noise would add."""
    return float((first[mask] * second[mask]).mean()) if mask.any() else float("nan")


def root(square: float) -> float:
    """Square root of an estimate of a square, 0 where noise made it negative."""
    return float(np.sqrt(max(square, 0.0)))


def resolution(first: np.ndarray, second: np.ndarray, mask: np.ndarray) -> float:
    """The root mean square that two independent estimates [H, W, 3] of a difference may show over `mask` by noise
    alone: of two standard errors of `mean_square`."""
    products = (first * second)[mask].mean(axis=-1)
    return root(2 * float(products.std()) / np.sqrt(len(products))) if len(products) else float("nan")


def relative_error(image: np.ndarray, reference: Estimate, mask: np.ndarray) -> float:
    """Root mean square of image − reference over `mask`, share of the reference's mean there. The image's own noise
    counts, the reference's does not."""
    level = max(float(reference.mean[mask].mean()), 1e-12)
    return root(mean_square(image - reference.halves[0], image - reference.halves[1], mask)) / level
