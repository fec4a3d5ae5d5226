"""Runs the stages of a fit: one Adam a stage, checkpoints on block boundaries, resume to the same result."""

import json
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import drjit as dr
import numpy as np
from tqdm import tqdm

from sira_mi.errors import InputError
from sira_mi.fit.settings import Stage
from sira_mi.models.optimisation import (
    adam,
    optimizer_state,
    parameter_values,
    read_arrays,
    restore_optimizer,
    write_arrays,
)

_CHECKPOINT_SECONDS = 10.0


class Problem(Protocol):
    """What a stage optimises."""

    def start(self, stage: Stage, tensors: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Tensors that are set before the first step of a stage, by closed form rather than by descent."""

    def refresh(self, tensors: dict[str, np.ndarray]) -> None:
        """Rebuilds whatever may lag behind the parameters; called every block and a function of `tensors` alone."""

    def losses(self, tensors: dict, stage: Stage, step: int, rng: np.random.Generator) -> dict:
        """Weighted loss terms; `tensors` holds the stage's parameters as Dr.Jit arrays."""


@dataclass
class Progress:
    """Where a fit stands; what a checkpoint holds."""

    tensors: dict[str, np.ndarray]  # avatar tensors so far
    stage: int = 0
    step: int = 0
    optimizer: dict[str, np.ndarray] | None = None  # state of the stage's Adam, None at its start
    seconds: dict[str, float] | None = None  # spent in each stage
    losses: dict[str, dict[str, float]] | None = None  # last terms of each stage


def save_progress(path: Path, progress: Progress, identity: str) -> None:
    """Writes a checkpoint; `identity` names the photo, settings and seed that it belongs to."""
    arrays = {f"tensor/{k}": v for k, v in progress.tensors.items()}
    arrays |= {f"adam/{k}": v for k, v in (progress.optimizer or {}).items()}
    description = {k: getattr(progress, k) for k in ("stage", "step", "seconds", "losses")}
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

    Raises InputError when a loss stops being finite."""
    total = sum(stage.steps for _, stage in stages)
    done = sum(stage.steps for _, stage in stages[: progress.stage]) + progress.step
    progress.seconds, progress.losses = progress.seconds or {}, progress.losses or {}
    saved = time.monotonic()
    with tqdm(total=total, initial=done, desc="fit", unit="step", mininterval=1.0, smoothing=0.05) as bar:
        while progress.stage < len(stages):
            make_problem, stage = stages[progress.stage]
            problem = make_problem(progress.tensors)
            if progress.optimizer is None:
                progress.tensors |= problem.start(stage, progress.tensors)
            optimizer = adam({k: progress.tensors[k] for k in stage.rates}, stage.rates, beta_2=0.98)
            if progress.optimizer:
                restore_optimizer(optimizer, progress.optimizer)
            started = time.monotonic()
            try:
                for step in range(progress.step, stage.steps):
                    if step % block == 0:
                        progress.tensors |= parameter_values(optimizer)
                        progress.step, progress.optimizer = step, optimizer_state(optimizer)
                        if time.monotonic() - saved > _CHECKPOINT_SECONDS:
                            progress.seconds[stage.name] = (
                                progress.seconds.get(stage.name, 0) + time.monotonic() - started
                            )
                            started = saved = time.monotonic()
                            checkpoint(progress)
                        problem.refresh(progress.tensors)
                    rng = np.random.default_rng([seed, progress.stage, step])
                    terms = _step(problem, optimizer, stage, step, rng)
                    progress.losses[stage.name] = terms
                    bar.update()
                    bar.set_postfix_str(f"{stage.name} loss {sum(terms.values()):.4f}", refresh=False)
            finally:
                progress.tensors |= parameter_values(optimizer)
                progress.seconds[stage.name] = progress.seconds.get(stage.name, 0) + time.monotonic() - started
            progress.stage, progress.step, progress.optimizer = progress.stage + 1, 0, None
        bar.set_postfix_str("done")
    return progress


def _step(problem: Problem, optimizer, stage: Stage, step: int, rng: np.random.Generator) -> dict[str, float]:
    rates = {name: rate * _fall(step / stage.steps) for name, rate in stage.rates.items()}
    optimizer.set_learning_rate(rates)
    dr.enable_grad(*(optimizer[name] for name in optimizer))
    terms = problem.losses(dict(optimizer.items()), stage, step, rng)
    dr.backward(sum(terms.values()))
    optimizer.step()
    values = {name: float(value.numpy().item()) for name, value in terms.items()}
    if not all(math.isfinite(v) for v in values.values()):
        raise InputError(f"the fit diverged in stage {stage.name}, step {step}: {values}; try another --seed")
    return values


def _fall(share: float) -> float:
    """Learning rates fall to a fifth over a stage along a cosine, after a warm-up over its first twentieth."""
    return min(1.0, 0.1 + share * 18) * (0.2 + 0.8 * 0.5 * (1 + math.cos(math.pi * share)))
