"""Checks of what a plugin is given: by a scene that is loaded, and by `mi.traverse` and `update`.

Each raises InputError in one line that names the plugin and the parameter."""

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from sira_mi.errors import InputError


def read_number(props, plugin: str, name: str, default: float, lower: float, upper: float = np.inf) -> float:
    """The number in a plugin's property `name`: finite, from `lower` to `upper`."""
    value = props.get(name, default)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(f"{plugin}: {name} must be a number, not {_kind(value)}")
    check_numbers(plugin, name, np.array(value), lower, upper)
    return float(value)


def read_integer(props, plugin: str, name: str, default: int, lower: int, upper: int) -> int:
    """The whole number in a plugin's property `name`, from `lower` to `upper`; 8.0 is one."""
    value = read_number(props, plugin, name, default, lower, upper)
    if value != int(value):
        raise InputError(f"{plugin}: {name} is {value}; it must be a whole number")
    return int(value)


def read_flag(props, plugin: str, name: str, default: bool) -> bool:
    """The boolean in a plugin's property `name`."""
    value = props.get(name, default)
    if not isinstance(value, bool):
        raise InputError(f"{plugin}: {name} must be true or false, not {_kind(value)}")
    return value


def read_similarity(props, plugin: str) -> tuple[np.ndarray, float]:
    """The matrix [4, 4] in the property `to_world` (double precision) and its scale. It must rotate, translate and
    scale uniformly, and no more."""
    matrix = np.array(props.get("to_world", mi.ScalarTransform4f()).matrix, np.float64)
    linear = matrix[:3, :3]
    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
        scale = float(np.cbrt(np.linalg.det(linear)))
        uniform = np.abs(linear @ linear.T / scale**2 - np.eye(3)).max() < 1e-3
    affine = np.isfinite(matrix).all() and np.abs(matrix[3] - [0, 0, 0, 1]).max() < 1e-6
    if not (affine and scale > 0 and uniform):
        raise InputError(f"{plugin}: to_world may rotate, translate and scale uniformly; it does more")
    return matrix, scale


def check_numbers(plugin: str, name: str, values: np.ndarray, lower: float, upper: float = np.inf) -> None:
    """Raises InputError unless all `values` are finite and from `lower` to `upper`."""
    wrong = values[~(np.isfinite(values) & (values >= lower) & (values <= upper))]
    if wrong.size:
        span = f"{lower:g} to {upper:g}" if np.isfinite(upper) else f"finite and at least {lower:g}"
        raise InputError(f"{plugin}: {name} is {wrong.flat[0]:g}; it must be {span}")


def check_networks(plugin: str, parameters: dict[str, Any], sizes: dict[str, int]) -> None:
    """Raises InputError unless every array of `parameters` is finite and as long as `sizes` says; evaluates one
    sum."""
    for name, value in parameters.items():
        if len(value) != sizes[name]:
            raise InputError(f"{plugin}: {name} has {len(value)} entries; it must have {sizes[name]}")
    if not can_evaluate(*parameters.values()):
        return
    with dr.suspend_grad():
        total = sum((dr.sum(value) for value in parameters.values()), mi.Float(0.0))
    if np.isfinite(total.numpy()).all():
        return
    for name, value in parameters.items():
        if not np.isfinite(dr.detach(value).numpy()).all():
            raise InputError(f"{plugin}: {name} has an entry that is not finite")


def can_evaluate(*values) -> bool:
    """Whether arrays can be checked: not while a symbolic loop or a frozen function is recorded."""
    recorded = dr.flag(dr.JitFlag.SymbolicScope) or dr.flag(dr.JitFlag.FreezingScope)
    return not recorded and not any(value.state is dr.VarState.Symbolic for value in values)


def _kind(value) -> str:
    """What a value of a scene is, for a message."""
    if isinstance(value, mi.Texture):
        return "a texture"
    return f"a {type(value).__name__}" if isinstance(value, mi.Object) else repr(value)
