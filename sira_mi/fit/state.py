"""What a fit optimises, and what one of its stages leaves to the next."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import mitsuba as mi
import numpy as np

from sira_mi.avatar.file import Avatar
from sira_mi.avatar.shape import POSE, SHAPE_LATENTS


@dataclass(frozen=True)
class FitState:
    """Everything that a fit has found so far. Its parameters, which stages optimise by name, are those of the avatar
    and `pose`."""

    avatar: dict[str, np.ndarray]  # the avatar's networks [parameters], latent codes [dimension] and detail
    # Rotation vector (radians) and translation (scene units) [6] of points before they enter the field.
    pose: np.ndarray = field(default_factory=lambda: np.zeros(6, np.float32))
    unpolished: dict[str, np.ndarray] | None = None  # the parameters that the polish moves, as they were before it

    @classmethod
    def of_avatar(cls, avatar: Avatar) -> FitState:
        """The state at the networks and latent codes of `avatar`, without pose."""
        names = (*avatar.architecture.networks, *avatar.architecture.latents)
        return cls({name: avatar.tensors[name] for name in names if name in avatar.tensors})

    def parameters(self, names: Iterable[str]) -> dict[str, np.ndarray]:
        """The parameters of these names. Raises KeyError for an unknown one."""
        return {name: self.pose if name == POSE else self.avatar[name] for name in names}

    def with_parameters(self, values: Mapping[str, np.ndarray]) -> FitState:
        """The same state with some parameters replaced or added."""
        avatar = {name: value for name, value in values.items() if name != POSE}
        return replace(self, avatar={**self.avatar, **avatar}, pose=values.get(POSE, self.pose))

    def floats(self) -> dict[str, Any]:
        """The avatar's networks and latent codes as Floats."""
        return {name: mi.Float(value) for name, value in self.avatar.items() if value.ndim == 1}

    def before_polish(self) -> FitState:
        """The state before its polish; itself where that has not begun."""
        return self.with_parameters(self.unpolished or {})

    def arrays(self) -> dict[str, np.ndarray]:
        """All arrays by name, for a file; `from_arrays` reads them back."""
        arrays = {f"avatar/{name}": value for name, value in self.avatar.items()} | {POSE: self.pose}
        return arrays | {f"unpolished/{name}": value for name, value in (self.unpolished or {}).items()}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, np.ndarray]) -> FitState:
        """The state of `arrays`; names that no state has are ignored. Raises KeyError where the pose is missing."""

        def group(prefix: str) -> dict[str, np.ndarray]:
            return {name.removeprefix(prefix): value for name, value in arrays.items() if name.startswith(prefix)}

        return cls(group("avatar/"), arrays[POSE], group("unpolished/") or None)


def initial_state(prior: Avatar, seed: int) -> FitState:
    """The prior's networks, and latent codes drawn with small variance about the mean (section 3.2.1)."""
    rng = np.random.default_rng([seed, 1 << 20])
    state = FitState.of_avatar(prior)
    latents = state.parameters((*SHAPE_LATENTS, "z_r", "z_a", "z_s"))
    drawn = {k: (v + 0.01 * rng.standard_normal(v.shape)).astype(np.float32) for k, v in latents.items()}
    return state.with_parameters(drawn)
