"""The training loop of both statistical models: checkpoints, resume to the same result, log, divergence."""

import json
import math
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from tqdm import tqdm

from sira_mi.errors import InputError
from sira_mi.models.optimisation import (
    optimizer_state,
    parameter_values,
    read_arrays,
    restore_optimizer,
    write_arrays,
)

_CHECKPOINT_SECONDS = 30.0


def run_training(
    folder: Path,
    name: str,
    steps: int,
    optimizer,
    rates: Callable[[int], dict[str, float]],
    step_function: Callable[[int], dict[str, float]],
) -> dict[str, np.ndarray]:
    """Runs `step_function(step)` until `steps`, from the checkpoint `folder/name.checkpoint` if there is one, and
    returns the parameters. Writes one line of terms a hundred steps to `folder/name.log`.

    A step depends only on its number and the optimizer's state, so a resumed run repeats the uninterrupted one. Raises
    InputError when the loss stops being finite."""
    folder.mkdir(parents=True, exist_ok=True)
    checkpoint, log = folder / f"{name}.checkpoint", folder / f"{name}.log"
    start = 0
    if checkpoint.exists():
        arrays, metadata = read_arrays(checkpoint)
        try:
            restore_optimizer(optimizer, arrays)
            start = int(metadata["step"])
        except (KeyError, ValueError) as error:
            raise InputError(f"{checkpoint} is of another training ({error}); remove it to start again") from error
    saved, totals = time.monotonic(), []
    progress = tqdm(range(start, steps), initial=start, total=steps, desc=name, mininterval=5.0)
    for step in progress:
        optimizer.set_learning_rate(rates(step))
        terms = step_function(step)
        if not all(math.isfinite(v) for v in terms.values()):
            raise InputError(f"{name}: the loss is not finite at step {step}: {terms}; lower the learning rate")
        totals.append(terms)
        if (step + 1) % 100 == 0:
            means = {k: round(float(np.mean([t[k] for t in totals])), 6) for k in terms}
            with log.open("a") as file:
                file.write(json.dumps({"step": step + 1, **means}) + "\n")
            progress.set_postfix({k: f"{v:.4f}" for k, v in list(means.items())[:3]})
            totals = []
        if time.monotonic() - saved > _CHECKPOINT_SECONDS or step + 1 == steps:
            write_arrays(checkpoint, optimizer_state(optimizer), {"step": str(step + 1)})
            saved = time.monotonic()
    return parameter_values(optimizer)
