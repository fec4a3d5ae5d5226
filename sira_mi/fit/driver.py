"""Runs the stages of a fit: one Adam a stage, in blocks of steps. Checkpoints fall between blocks, and a fit resumes
from them to the same result. A block that diverges is undone, and the steps after it are shorter."""

import json
import math
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from sira_mi.errors import InputError
from sira_mi.fields.extraction import EmptySurfaceError
from sira_mi.files import parse_json
from sira_mi.fit.stage import Problem, Stage
from sira_mi.fit.state import FitState
from sira_mi.interrupts import check_interrupt, postpone_interrupts
from sira_mi.optimisation.adam import (
    adam,
    cosine_fall,
    optimizer_state,
    parameter_values,
    read_arrays,
    restore_optimizer,
    take_step,
    write_arrays,
)

_CHECKPOINT_SECONDS = 10.0
# A block has diverged when one of its losses exceeds this multiple of the stage's lowest median and the losses of its
# later half stay above that median. Single losses of a healthy fit may rise as far, since windows of the photo take
# turns and some networks start from 0; they hardly ever stay there. The median alone is no test: a network that a long
# step has killed can come to rest with a loss little above the first.
_DIVERGED = 2.5
# How often the learning rates of a stage may be halved.
_MOST_ROLLBACKS = 12


class DivergedError(Exception):
    """The fit runs away; the message says how."""


@dataclass
class Progress:
    """Where a fit stands: the start of the last block of a stage that went well. What a checkpoint holds."""

    state: FitState
    stage: int = 0
    step: int = 0
    optimizer: dict[str, np.ndarray] | None = None  # state of the stage's Adam, None before its start
    lowest: float | None = None  # median loss of the stage's best block, None before its first
    rollbacks: int = 0  # in this stage: each has halved its learning rates
    seconds: dict[str, float] = field(default_factory=dict)  # spent in each stage
    losses: dict[str, dict[str, float]] = field(default_factory=dict)  # last terms of each stage
    notes: list[str] = field(default_factory=list)  # what the user should know, one line each

    def finish_stage(self) -> None:
        """Goes on to the start of the next stage."""
        self.stage, self.step, self.optimizer = self.stage + 1, 0, None
        self.lowest, self.rollbacks = None, 0


def save_progress(path: Path, progress: Progress, identity: str) -> None:
    """Writes a checkpoint; `identity` names the fit that it belongs to."""
    arrays = progress.state.arrays() | {f"adam/{k}": v for k, v in (progress.optimizer or {}).items()}
    described = ("stage", "step", "lowest", "rollbacks", "seconds", "losses", "notes")
    description = {k: getattr(progress, k) for k in described}
    write_arrays(path, arrays, {"identity": identity, "progress": json.dumps(description)})


def load_progress(path: Path, identity: str) -> Progress:
    """Reads a checkpoint. Raises InputError when it is damaged or belongs to another fit."""
    arrays, metadata = read_arrays(path)
    if metadata.get("identity") != identity:
        raise InputError(
            f"{path} belongs to another photo, quality, seed, prior, variant or version; choose another --out or drop "
            "--resume"
        )
    try:
        optimizer = {k.removeprefix("adam/"): v for k, v in arrays.items() if k.startswith("adam/")}
        description = parse_json(metadata["progress"], f"the progress in {path}")
        return Progress(FitState.from_arrays(arrays), optimizer=optimizer or None, **description)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path} is damaged ({error}); remove it to start again") from error


def run_stages(
    stages: Sequence[Stage],
    make_problem: Callable[[Stage, FitState], Problem],
    progress: Progress,
    block: int,
    seed: int,
    checkpoint: Callable[[Progress], None],
) -> Progress:
    """Runs every stage from where `progress` stands, which follows; `make_problem` gives the problem of a stage from a
    state on. Ctrl-C ends it between two steps: a checkpoint is written, `progress` gets the parameters so far, and
    KeyboardInterrupt is raised.

    A block that diverges (`_run_block`) is undone: the stage goes on from the last block that went well, at half the
    learning rates, and a note says so. Raises InputError when that does not help."""
    run = _Run(progress, block, seed, checkpoint)
    total, done = (sum(stage.steps for stage in some) for some in (stages, stages[: progress.stage]))
    bar = tqdm(total=total, initial=done + progress.step, desc="fit", unit="step", mininterval=1, smoothing=0.05)
    with postpone_interrupts(), bar:
        for stage in stages[progress.stage :]:
            bar.set_postfix_str(f"{stage.name}: starting, compiling")
            _run_stage(run, stage, make_problem(stage, progress.state), bar, done)
            done += stage.steps
            progress.finish_stage()
        run.checkpoint(progress)
        bar.set_postfix_str("done")
    return progress


@dataclass
class _Run:
    """What is the same for all stages of a fit."""

    progress: Progress
    block: int  # steps
    seed: int
    checkpoint: Callable[[Progress], None]
    saved: float = field(default_factory=time.monotonic)  # when the last checkpoint was written


def _run_stage(run: _Run, stage: Stage, problem: Problem, bar: tqdm, done: int) -> None:
    """Runs a stage from where the progress stands to its end; `done` steps lie before the stage."""
    progress = run.progress
    if progress.optimizer is None:
        progress.state = problem.start(progress.state)
    optimizer = adam(progress.state.parameters(stage.rates), stage.rates, beta_2=0.98)
    if progress.optimizer is None:
        progress.optimizer = optimizer_state(optimizer)
    restore_optimizer(optimizer, progress.optimizer)
    started = time.monotonic()
    step = progress.step
    try:
        while step < stage.steps:
            steps = range(step, min(step + run.block, stage.steps))
            state, moments = progress.state.with_parameters(parameter_values(optimizer)), optimizer_state(optimizer)
            try:
                median = _run_block(problem, optimizer, stage, steps, state, progress, run.seed, bar)
            except (DivergedError, EmptySurfaceError) as error:
                _roll_back(stage, progress, error)
                restore_optimizer(optimizer, progress.optimizer)
                step = progress.step
                bar.n = done + step
                continue
            progress.state, progress.step, progress.optimizer = state, step, moments
            progress.lowest = median if progress.lowest is None else min(median, progress.lowest)
            step = steps.stop
            if time.monotonic() - run.saved > _CHECKPOINT_SECONDS:
                progress.seconds[stage.name] = progress.seconds.get(stage.name, 0) + time.monotonic() - started
                started = run.saved = time.monotonic()
                run.checkpoint(progress)
    except KeyboardInterrupt:
        run.checkpoint(progress)
        raise
    finally:
        progress.state = progress.state.with_parameters(parameter_values(optimizer))
        progress.seconds[stage.name] = progress.seconds.get(stage.name, 0) + time.monotonic() - started


def _run_block(
    problem: Problem,
    optimizer: Any,
    stage: Stage,
    steps: range,
    state: FitState,
    progress: Progress,
    seed: int,
    bar: tqdm,
) -> float:
    """Takes some steps from `state` on; returns the median of their losses.

    Raises DivergedError when a loss or a parameter is not finite, or when the losses rise and stay high (`_DIVERGED`;
    in the first block, compared with the loss before the first step) and the learning rates can still be halved.
    Raises EmptySurfaceError when there is no head before the block or after the stage's last."""
    problem.refresh(state)
    totals: list[float] = []
    for step in steps:
        check_interrupt()
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
        problem.refresh(state.with_parameters(values))
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
    problem: Problem, optimizer: Any, stage: Stage, step: int, factor: float, rng: np.random.Generator
) -> dict[str, float]:
    """One step with `factor` times the stage's learning rates; the loss terms before it."""
    rates = {name: factor * rate * _fall(step / stage.steps) for name, rate in stage.rates.items()}
    optimizer.set_learning_rate(rates)
    return take_step(
        optimizer, lambda parameters: problem.losses(parameters, step, rng), lambda terms: sum(terms.values())
    )


def _fall(share: float) -> float:
    """Learning rates fall to a fifth over a stage along a cosine, after a warm-up over its first twentieth."""
    return min(1.0, 0.1 + share * 18) * cosine_fall(share, 0.2)
