"""The shape of a head: how its signed distance field, eqs 1-3, is put together from named parameters.

What a shape consists of is named here. Plugins, fits and trainings pass mappings of parameters through.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import mitsuba as mi
import numpy as np

from sira_mi.avatar.architecture import AvatarArchitecture
from sira_mi.fields.mlp import layers
from sira_mi.fields.sdf import SdfField, rigid_motion

SHAPE_NETWORKS = ("deformation", "reference")
SHAPE_LATENTS = ("z_sdf",)
SHAPE_PARAMETERS = (*SHAPE_NETWORKS, *SHAPE_LATENTS)
POSE = "pose"


@dataclass(frozen=True)
class HeadShape:
    """Makes fields from parameters by name, NumPy or Dr.Jit arrays: flat networks, latents [dim] of one head or
    [dim, S] of S heads, and, for a head that may move, a pose [6] (`rigid_motion`). A mapping may hold other entries
    too. Fields are differentiable in the parameters."""

    architecture: AvatarArchitecture

    def field(self, parameters: Mapping[str, Any]) -> SdfField:
        """The signed distance field; it moves where `parameters` hold a pose."""
        motion = rigid_motion(mi.TensorXf(parameters[POSE], (6, 1))) if POSE in parameters else None
        return SdfField(
            self.deformation(parameters),
            layers(self.architecture.networks["reference"], parameters["reference"]),
            self.architecture.sdf_octaves,
            motion,
        )

    def deformation(self, parameters: Mapping[str, Any]) -> list[tuple]:
        """Layers of the deformation network (`deform`), conditioned on the shape's latents."""
        return layers(self.architecture.networks["deformation"], parameters["deformation"], parameters["z_sdf"])


def with_zero_latents(parameters: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The same parameters, NumPy arrays, with the latents of a prior's mean head."""
    return {**parameters, **{name: np.zeros_like(parameters[name]) for name in SHAPE_LATENTS}}


def head_of(parameters: Mapping[str, np.ndarray], index: int) -> dict[str, np.ndarray]:
    """The shape of one head of many, whose latents are [dim, S]."""
    return {**parameters, **{name: parameters[name][:, index] for name in SHAPE_LATENTS}}
