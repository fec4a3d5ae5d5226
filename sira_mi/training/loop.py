"""The training loop of both statistical models: checkpoints, resume to the same result, log, pictures, divergence."""

import json
import math
import time
from collections import deque
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
from tqdm import tqdm

from sira_mi.errors import InputError
from sira_mi.interrupts import check_interrupt, postpone_interrupts, was_interrupted
from sira_mi.optimisation.adam import (
    optimizer_state,
    parameter_values,
    read_arrays,
    restore_optimizer,
    write_arrays,
)

_CHECKPOINT_SECONDS = 30.0
_WINDOW, _RECENT = 100, 20  # steps whose median loss is compared with the best median of a window
_DIVERGED = 3.0  # times the best median: the training ends when that of a window is above
_SOUND = 2.0  # times the best median: checkpoints are written while that of the recent steps is below
_PICTURE_SHARE = 0.02  # of the training time that pictures may take


class Divergence:
    """Compares the running median of a training's weighted loss with its best value so far.

    The window of the median has to fill first, at the start and again after a resume; the best value survives that."""

    def __init__(self, best: float = math.inf):
        self.best = best
        self._losses: deque[float] = deque(maxlen=_WINDOW)
        self._median = 0.0

    def add(self, loss: float) -> None:
        """Takes in the weighted loss of one step."""
        self._losses.append(loss)
        if len(self._losses) == _WINDOW:
            self._median = float(np.median(self._losses))
            self.best = min(self.best, self._median)

    @property
    def ratio(self) -> float:
        """The window's median over its best; 0 while there is none."""
        return self._median / max(self.best, 1e-12)

    @property
    def sound(self) -> bool:
        """Whether the recent steps are near the best."""
        return float(np.median(list(self._losses)[-_RECENT:])) <= _SOUND * self.best


def read_parameters(checkpoint: Path) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """The parameters in a checkpoint of `run_training` and its metadata: `step`, and what the training was described
    by. Raises InputError when it cannot be read."""
    state, metadata = read_arrays(checkpoint)
    return {name.removesuffix("/value"): value for name, value in state.items() if name.endswith("/value")}, metadata


def run_training(
    folder: Path,
    name: str,
    steps: int,
    optimizer,
    rates: Callable[[int], dict[str, float]],
    step_function: Callable[[int], dict[str, float]],
    *,
    weights: Mapping[str, float] | None = None,
    description: Mapping[str, str] | None = None,
    picture: Callable[[Path, dict[str, np.ndarray]], None] | None = None,
    picture_steps: int = 1000,
) -> dict[str, np.ndarray]:
    """Runs `step_function(step)`, which takes a step and returns the unweighted loss terms, `steps` times, or on from
    the checkpoint `folder/name.checkpoint`. Returns the parameters.

    It writes to `folder`: the checkpoint every half minute and on Ctrl-C, unless the loss has risen; a line of
    `name.log` every hundred steps, with mean terms and seconds; `pictures/name_STEP.png`, by
    `picture(path, parameters)`, every `picture_steps` steps and at the end, unless pictures have taken 2% of the time
    already.

    `weights` are the λ of the terms, 1 where missing. `description`, whose values are JSON objects, is stored in the
    checkpoint and has to be the same on a resume. A step depends only on its number and the optimizer's state, so a
    run that resumes repeats one without interruption.

    Raises InputError when a term stops being finite, or when the loss's median over a hundred steps is more than three
    times the best such median. The checkpoint is then the last one from before the rise."""
    folder.mkdir(parents=True, exist_ok=True)
    checkpoint, log = folder / f"{name}.checkpoint", folder / f"{name}.log"
    description, weights = dict(description or {}), weights or {}
    start, watch = 0, Divergence()
    if checkpoint.exists():
        start, watch = _resume(checkpoint, optimizer, description)
        _shorten(log, start)
    began = saved = logged = time.monotonic()
    drawing, totals = 0.0, []
    progress = tqdm(range(start, steps), initial=start, total=steps, desc=name, mininterval=5.0)
    with postpone_interrupts():
        for step in progress:
            optimizer.set_learning_rate(rates(step))
            terms = step_function(step)
            if not all(math.isfinite(v) for v in terms.values()):
                raise InputError(f"{name}: the loss is not finite at step {step}: {terms}; lower the learning rate")
            watch.add(sum(weights.get(k, 1.0) * v for k, v in terms.items()))
            if watch.ratio > _DIVERGED:
                shown = ", ".join(f"{k} {v:.4g}" for k, v in terms.items())
                raise InputError(
                    f"{name}: the training diverges at step {step}, its loss is {watch.ratio:.1f} times its best "
                    f"({shown}); lower the learning rate; {checkpoint} is from before that"
                )

            totals.append(terms)
            done, now = step + 1, time.monotonic()
            if done % 100 == 0:
                means = {k: round(float(np.mean([t[k] for t in totals])), 6) for k in terms}
                with log.open("a") as file:
                    file.write(json.dumps({"step": done, **means, "seconds": round(now - logged, 2)}) + "\n")
                progress.set_postfix({k: f"{v:.4f}" for k, v in list(means.items())[:3]})
                totals, logged = [], now

            interrupted = was_interrupted()
            if done == steps or ((interrupted or now - saved > _CHECKPOINT_SECONDS) and watch.sound):
                metadata = {"step": str(done), "best": repr(watch.best), **description}
                write_arrays(checkpoint, optimizer_state(optimizer), metadata)
                saved = now

            due = done == steps or (done % picture_steps == 0 and drawing <= _PICTURE_SHARE * (now - began))
            if picture is not None and due:
                (folder / "pictures").mkdir(exist_ok=True)
                picture(folder / "pictures" / f"{name}_{done:06d}.png", parameter_values(optimizer))
                drawing += time.monotonic() - now
                logged += time.monotonic() - now
            if interrupted:
                check_interrupt()
    return parameter_values(optimizer)


def _resume(checkpoint: Path, optimizer, description: dict[str, str]) -> tuple[int, Divergence]:
    """Restores the optimizer; returns the step to go on from. Raises InputError for a checkpoint of another
    training."""
    arrays, metadata = read_arrays(checkpoint)
    for key, value in description.items():
        if differences := _differences(metadata.get(key, "{}"), value):
            raise InputError(
                f"{checkpoint} is of a training with another {key} ({differences}); repeat its options, or "
                "remove it to start again"
            )
    try:
        restore_optimizer(optimizer, arrays)
        return int(metadata["step"]), Divergence(float(metadata.get("best", "inf")))
    except (KeyError, ValueError) as error:
        raise InputError(f"{checkpoint} is of another training ({error}); remove it to start again") from error


def _differences(stored: str, wanted: str) -> str:
    """What differs between two JSON objects, in words; empty when nothing does."""
    try:
        there, now = json.loads(stored), json.loads(wanted)
        names = sorted(k for k in {*there, *now} if there.get(k) != now.get(k))
    except (ValueError, TypeError, AttributeError):
        return "unreadable"
    return ", ".join(f"{k}: {there.get(k)} there, {now.get(k)} now" for k in names)


def _shorten(log: Path, step: int) -> None:
    """Drops the lines of a log that a resumed training from `step` on writes again."""
    if not log.exists():
        return
    kept = []
    for line in log.read_text().splitlines():
        try:
            if json.loads(line)["step"] <= step:
                kept.append(line)
        except (ValueError, KeyError, TypeError):
            continue
    log.write_text("".join(line + "\n" for line in kept))
