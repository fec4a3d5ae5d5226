"""Runs the stages of a fit: one Adam a stage, in blocks of steps; checkpoints on block boundaries, resume to the same
result. A block that diverges is taken back, and the steps from there on are shorter."""

import json
import math
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import drjit as dr
import numpy as np
from tqdm import tqdm

from sira_mi.errors import InputError
from sira_mi.fields.extraction import EmptySurfaceError
from sira_mi.fit.settings import Stage
from sira_mi.optimisation.adam import (
    adam,
    optimizer_state,
    parameter_values,
    read_arrays,
    restore_optimizer,
    write_arrays,
)

_CHECKPOINT_SECONDS = 10.0
# A block has diverged when one of its losses is above this multiple of the stage's lowest and its later half has not
# come below that again. Healthy steps may rise as far (windows of the photo in turn, networks that start from 0), but
# blocks hardly ever stay up, and shorter steps then cost little. A block's median alone would not do: a network that
# one step has thrown off may come to rest, dead, hardly above where it began.
_DIVERGED = 2.5
# How often the learning rates of a stage may be halved.
_MOST_ROLLBACKS = 12


class DivergedError(Exception):
    """The fit runs away; the message says how."""


class Problem(Protocol):
    """What a stage optimises."""

    def start(self, stage: Stage, tensors: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Tensors that are set before the first step of a stage, by closed form rather than by descent."""

    def refresh(self, tensors: dict[str, np.ndarray]) -> None:
        """Rebuilds whatever may lag behind the parameters; called every block and a function of `tensors` alone. Raises
        EmptySurfaceError when there is no head any more."""

    def losses(self, tensors: dict, stage: Stage, step: int, rng: np.random.Generator) -> dict:
        """Weighted loss terms; `tensors` holds the stage's parameters as Dr.Jit arrays."""


@dataclass
class Progress:
    """Where a fit stands: the start of the last block of a stage that went well. What a checkpoint holds."""

    tensors: dict[str, np.ndarray]  # avatar tensors so far
    stage: int = 0
    step: int = 0
    optimizer: dict[str, np.ndarray] | None = None  # state of the stage's Adam, None before its start
    lowest: float | None = None  # median loss of the stage's best block, None before its first
    rollbacks: int = 0  # in this stage: each has halved its learning rates
    seconds: dict[str, float] = field(default_factory=dict)  # spent in each stage
    losses: dict[str, dict[str, float]] = field(default_factory=dict)  # last terms of each stage
    notes: list[str] = field(default_factory=list)  # what the user should know, one line each


def save_progress(path: Path, progress: Progress, identity: str) -> None:
    """Writes a checkpoint; `identity` names the photo, settings and seed that it belongs to."""
    arrays = {f"tensor/{k}": v for k, v in progress.tensors.items()}
    arrays |= {f"adam/{k}": v for k, v in (progress.optimizer or {}).items()}
    described = ("stage", "step", "lowest", "rollbacks", "seconds", "losses", "notes")
    description = {k: getattr(progress, k) for k in described}
    write_arrays(path, arrays, {"identity": identity, "progress": json.dumps(description)})


def load_progress(path: Path, identity: str) -> Progress:
    """Reads a checkpoint. Raises InputError when it is damaged or belongs to another fit."""
    arrays, metadata = read_arrays(path)
    if metadata.get("identity") != identity:
        raise InputError(
            f"{path} belongs to another photo, quality, seed or prior; choose another --out or drop --resume"
        )
    try:
        description = json.loads(metadata["progress"])
        groups = {
            kind: {k.removeprefix(kind): v for k, v in arrays.items() if k.startswith(kind)}
            for kind in ("tensor/", "adam/")
        }
        return Progress(tensors=groups["tensor/"], optimizer=groups["adam/"] or None, **description)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path} is damaged ({error}); remove it to start again") from error


def run_stages(
    stages: list[tuple[Callable[[dict], Problem], Stage]],
    progress: Progress,
    block: int,
    seed: int,
    checkpoint: Callable[[Progress], None],
) -> Progress:
    """Runs every stage from where `progress` stands. Each entry of `stages` is a function from the current tensors to
    the stage's problem, and the stage. On KeyboardInterrupt the parameters so far are kept and the exception goes on.

    A block that diverges (`_run_block`) is taken back to the start of the last one that went well, with half the
    learning rates for the rest of its stage, and a note says so. Raises InputError when that does not help."""
    total = sum(stage.steps for _, stage in stages)
    done = sum(stage.steps for _, stage in stages[: progress.stage])
    saved = time.monotonic()
    with tqdm(total=total, initial=done + progress.step, desc="fit", unit="step", mininterval=1, smoothing=0.05) as bar:
        while progress.stage < len(stages):
            make_problem, stage = stages[progress.stage]
            problem = make_problem(progress.tensors)
            if progress.optimizer is None:
                progress.tensors |= problem.start(stage, progress.tensors)
            optimizer = adam({k: progress.tensors[k] for k in stage.rates}, stage.rates, beta_2=0.98)
            if progress.optimizer is None:
                progress.optimizer = optimizer_state(optimizer)
            restore_optimizer(optimizer, progress.optimizer)
            started = time.monotonic()
            step = progress.step
            try:
                while step < stage.steps:
                    steps = range(step, min(step + block, stage.steps))
                    tensors, state = progress.tensors | parameter_values(optimizer), optimizer_state(optimizer)
                    try:
                        median = _run_block(problem, optimizer, stage, steps, tensors, progress, seed, bar)
                    except (DivergedError, EmptySurfaceError) as error:
                        _roll_back(stage, progress, error)
                        restore_optimizer(optimizer, progress.optimizer)
                        step = progress.step
                        bar.n = done + step
                        continue
                    progress.tensors, progress.step, progress.optimizer = tensors, step, state
                    progress.lowest = median if progress.lowest is None else min(median, progress.lowest)
                    step = steps.stop
                    if time.monotonic() - saved > _CHECKPOINT_SECONDS:
                        progress.seconds[stage.name] = progress.seconds.get(stage.name, 0) + time.monotonic() - started
                        started = saved = time.monotonic()
                        checkpoint(progress)
            finally:
                progress.tensors |= parameter_values(optimizer)
                progress.seconds[stage.name] = progress.seconds.get(stage.name, 0) + time.monotonic() - started
            done += stage.steps
            progress.stage, progress.step, progress.optimizer = progress.stage + 1, 0, None
            progress.lowest, progress.rollbacks = None, 0
        bar.set_postfix_str("done")
    return progress


def _run_block(
    problem: Problem,
    optimizer,
    stage: Stage,
    steps: range,
    tensors: dict[str, np.ndarray],
    progress: Progress,
    seed: int,
    bar: tqdm,
) -> float:
    """Takes some steps from `tensors` on; returns the median of their losses.

    Raises DivergedError when a loss or a parameter is not finite, or a loss is far above the lowest of the stage (in
    the first block, above the loss before the first step), the losses stay above it and shorter steps may help;
    EmptySurfaceError when there is no head before the block or after the stage's last."""
    problem.refresh(tensors)
    totals = []
    for step in steps:
        rng = np.random.default_rng([seed, progress.stage, step])
        terms = _step(problem, optimizer, stage, step, 0.5**progress.rollbacks, rng)
        totals.append(sum(terms.values()))
        if not math.isfinite(totals[-1]):
            raise DivergedError("the loss is not finite")
        progress.losses[stage.name] = terms
        bar.update()
        bar.set_postfix_str(f"{stage.name} loss {totals[-1]:.4f}", refresh=False)
    values = parameter_values(optimizer)
    if not all(np.isfinite(value).all() for value in values.values()):
        raise DivergedError("a parameter is not finite")
    before = totals[0] if progress.lowest is None else progress.lowest
    stays = np.median(totals[len(totals) // 2 :]) > before
    if max(totals) > _DIVERGED * before and stays and progress.rollbacks < _MOST_ROLLBACKS:
        raise DivergedError(f"the loss rose from {before:.3g} to {max(totals):.3g}")
    if steps.stop == stage.steps:
        problem.refresh(tensors | values)
    return float(np.median(totals))


def _roll_back(stage: Stage, progress: Progress, error: Exception) -> None:
    """Halves the learning rates of a stage that has diverged, and says so. Raises InputError after too many times."""
    progress.rollbacks += 1
    if progress.rollbacks > _MOST_ROLLBACKS:
        raise InputError(
            f"the fit diverges in stage {stage.name} at any learning rate ({error}); check the mask and the camera, or "
            "try another --seed"
        ) from error
    note = (
        f"the fit diverged in stage {stage.name} ({error}): taken back to step {progress.step}, learning rates times "
        f"1/{2**progress.rollbacks}"
    )
    progress.notes.append(note)
    tqdm.write(f"note: {note}", file=sys.stderr)


def _step(
    problem: Problem, optimizer, stage: Stage, step: int, factor: float, rng: np.random.Generator
) -> dict[str, float]:
    """One step with `factor` times the stage's learning rates; the loss terms before it."""
    rates = {name: factor * rate * _fall(step / stage.steps) for name, rate in stage.rates.items()}
    optimizer.set_learning_rate(rates)
    dr.enable_grad(*(optimizer[name] for name in optimizer))
    terms = problem.losses(dict(optimizer.items()), stage, step, rng)
    dr.backward(sum(terms.values()))
    optimizer.step()
    return {name: float(value.numpy().item()) for name, value in terms.items()}


def _fall(share: float) -> float:
    """Learning rates fall to a fifth over a stage along a cosine, after a warm-up over its first twentieth."""
    return min(1.0, 0.1 + share * 18) * (0.2 + 0.8 * 0.5 * (1 + math.cos(math.pi * share)))
