"""What a stage of a fit is, and what all stages of one fit share. Each kind of stage has a module of its own, with its
learning rates, the weights of its losses and its problem; `settings` puts them in order."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Protocol, TypeVar

import mitsuba as mi
import numpy as np

from sira_mi.avatar.file import Avatar, save_avatar
from sira_mi.decisions import Decision, Plan
from sira_mi.fields.sdf import rigid_motion
from sira_mi.fit.shaded import Arrays, PhotoPoints, find_photo_points
from sira_mi.fit.skin import face_exposure
from sira_mi.fit.state import FitState
from sira_mi.portrait.camera import Camera
from sira_mi.portrait.portrait import Portrait

Shared = TypeVar("Shared")


class Problem(Protocol):
    """What a stage optimises."""

    def start(self, state: FitState) -> FitState:
        """The state before the stage's first step, with what is set in closed form rather than by descent."""

    def refresh(self, state: FitState) -> None:
        """Rebuilds whatever may lag behind the parameters; called every block and a function of `state` alone. Raises
        EmptySurfaceError when there is no head any more."""

    def losses(self, parameters: Arrays, step: int, rng: np.random.Generator) -> Arrays:
        """Weighted loss terms, scalar tensors; `parameters` are those that the stage optimises, Floats."""


@dataclass(frozen=True)
class Stage(ABC):
    """One stretch of optimisation."""

    name: str
    steps: int
    rates: Mapping[str, float]  # learning rate of every optimised parameter of a `FitState`; all others are frozen
    k_s: tuple[float, float] = (0.0, 0.0)  # weight of the specular term, first and last step, eq. 8
    k_r: float = 0.0  # weight of the albedo refinement, eq. 11

    @abstractmethod
    def problem(self, task: FitTask, state: FitState) -> Problem:
        """What the stage optimises, from `state` on."""

    def decisions(self) -> tuple[Decision, ...]:
        """What the stage leaves out of its computation because it changes nothing."""
        return ()

    def hold(self, name: str) -> Stage:
        """The same stage with the parameter `name` frozen."""
        return replace(self, rates={k: v for k, v in self.rates.items() if k != name})


@dataclass(frozen=True)
class FitSettings:
    """A whole fit: its sizes, and its stages in order."""

    quality: str
    working_size: int  # longest side of the working image, pixels
    rays: int  # of the geometry and shading stages, a step
    points: int  # of the eikonal loss, a step
    pixels: int  # of the appearance stages, a step
    voxel: float  # of the mesh during the fit, scene units
    final_voxel: float  # of the exported mesh, scene units
    stages: tuple[Stage, ...]
    block: int = 20  # steps between extractions of the mesh; checkpoints fall on them

    def plan(self) -> Plan:
        """The decisions of all stages."""
        return Plan(tuple(decision for stage in self.stages for decision in stage.decisions()))

    def hold(self, name: str) -> FitSettings:
        """The same fit with the parameter `name` frozen in all stages."""
        return replace(self, stages=tuple(stage.hold(name) for stage in self.stages))

    def describe(self) -> dict:
        """All values, as JSON; a stage is described by its `type` too."""
        stages = [{"type": type(stage).__name__, **asdict(stage)} for stage in self.stages]
        return {**asdict(self), "stages": stages}


@dataclass
class FitTask:
    """One fit: what all of its stages are made from."""

    portrait: Portrait
    prior: Avatar
    prior_path: Path
    settings: FitSettings
    folder: Path  # for files in between
    plan: Plan  # what the stages leave out
    _shared: object = field(default=None, init=False)

    def with_plan(self, plan: Plan) -> FitTask:
        """The same fit, whose stages leave out what another plan says."""
        task = replace(self, plan=plan)
        task._shared = self._shared
        return task

    @property
    def avatar_file(self) -> Path:
        """Where `write_avatar` writes."""
        return self.folder / "avatar.safetensors"

    def exposure(self) -> float:
        """Factor that brings the photo to the exposure of the photos that the rendering network was trained on."""
        return face_exposure(self.portrait, self.prior)

    def photo_points(self, portrait: Portrait, head) -> PhotoPoints:
        """The points of a `neural_sdf` that `portrait` shows, and their visibility."""
        return find_photo_points(portrait, head)

    def pose_portrait(self, state: FitState) -> Portrait:
        """The portrait, its camera moved so that it sees the unmoved head as it saw the head in the pose of `state`."""
        return replace(self.portrait, camera=move_camera(self.portrait.camera, state.pose))

    def write_avatar(self, state: FitState) -> Path:
        """Writes the avatar at `state` for the plugins to read; its path."""
        save_avatar(self.avatar_file, self.prior.with_tensors(**state.avatar))
        return self.avatar_file

    def share(self, kind: type[Shared], make: Callable[[], Shared]) -> Shared:
        """What consecutive stages have in common and is slow to make: the result of `make`, of class `kind`. It is
        made once, and again after a stage that shares another class."""
        if type(self._shared) is not kind:
            self._shared = None  # frees its memory before the next is made
            self._shared = make()
        return self._shared


def move_camera(camera: Camera, pose: np.ndarray) -> Camera:
    """The camera that sees an unmoved head as `camera` sees the head moved by a `pose` [6] of the field."""
    motion = np.eye(4)
    motion[:3] = rigid_motion(mi.TensorXf(np.reshape(pose, (6, 1)).astype(np.float32))).numpy()
    u, _, v = np.linalg.svd(motion[:3, :3])
    motion[:3, :3] = u @ v
    return replace(camera, world_to_camera=camera.world_to_camera @ np.linalg.inv(motion))
