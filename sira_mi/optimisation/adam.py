"""Descent by Adam: Dr.Jit's optimizer, one step of it, its state as NumPy arrays, and files that hold that state."""

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from sira_mi.errors import InputError
from sira_mi.fields.columns import to_array
from sira_mi.files import write_through


def adam(parameters: Mapping[str, np.ndarray], learning_rates: Mapping[str, float], beta_2: float = 0.99):
    """A `mi.ad.Adam` over `parameters` (float32 arrays; one-dimensional ones become Floats, others tensors), each with
    its own learning rate."""
    optimizer = mi.ad.Adam(lr=1e-3, beta_2=beta_2)
    for name, value in parameters.items():
        optimizer[name] = to_array(value)
        optimizer.set_learning_rate({name: learning_rates[name]})
    return optimizer


def take_step(optimizer, losses: Callable[[dict], dict], total: Callable[[dict], Any]) -> dict[str, float]:
    """One step along the gradient of `total` of the terms that `losses` gives for the parameters; the terms before the
    step. Terms and total are scalar tensors."""
    dr.enable_grad(*(optimizer[name] for name in optimizer))
    terms = losses(dict(optimizer.items()))
    dr.backward(total(terms))
    optimizer.step()
    dr.eval(terms)
    return {name: float(value.numpy().item()) for name, value in terms.items()}


def cosine_fall(share: float, end: float) -> float:
    """The factor of a learning rate that falls along half a cosine from 1 to `end`, after a `share` of all steps."""
    return end + (1 - end) * 0.5 * (1 + math.cos(math.pi * share))


def parameter_values(optimizer) -> dict[str, np.ndarray]:
    """The current parameters as NumPy arrays."""
    return {name: dr.detach(value).numpy() for name, value in optimizer.items()}


def optimizer_state(optimizer) -> dict[str, np.ndarray]:
    """Everything a later `restore_optimizer` needs: values, step counts and both moments of every parameter."""
    state = {}
    for name, (value, _, _, (count, first, second, *_)) in optimizer.state.items():
        state[f"{name}/value"] = dr.detach(value).numpy()
        state[f"{name}/count"] = np.array([count[0]], np.float32)
        state[f"{name}/first"], state[f"{name}/second"] = first.numpy(), second.numpy()
    return state


def restore_optimizer(optimizer, state: Mapping[str, np.ndarray]) -> None:
    """Sets the optimizer to a state of `optimizer_state`; its parameters must be those of the state.

    Raises KeyError or ValueError when they are not."""
    for name, (value, promoted, rate, (_, _, _, *rest)) in list(optimizer.state.items()):
        if state[f"{name}/value"].shape != dr.shape(value):
            raise ValueError(f"parameter {name} has another size")
        optimizer[name] = to_array(state[f"{name}/value"])
        value = optimizer.state[name][0]
        moments = mi.Float(state[f"{name}/first"].ravel()), mi.Float(state[f"{name}/second"].ravel())
        count = mi.UInt32(int(state[f"{name}/count"].ravel()[0]))
        optimizer.state[name] = (value, promoted, rate, (count, *moments, *rest))


def write_arrays(path: Path, arrays: Mapping[str, np.ndarray], metadata: Mapping[str, str]) -> None:
    """Writes a safetensors file under a temporary name, then renames it. Raises InputError when that fails."""
    arrays = {name: np.ascontiguousarray(value, dtype=np.float32) for name, value in arrays.items()}
    data = save(arrays, metadata=dict(metadata))
    write_through(path, lambda file: file.write_bytes(data))


def read_arrays(path: Path) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """The arrays and metadata of a file by `write_arrays`. Raises InputError when it cannot be read."""
    try:
        with safe_open(path, framework="numpy") as file:
            return {name: file.get_tensor(name) for name in file.keys()}, file.metadata() or {}  # noqa: SIM118
    except (OSError, SafetensorError) as error:
        raise InputError(f"cannot read the checkpoint {path}: {error}; remove it to start again") from error
