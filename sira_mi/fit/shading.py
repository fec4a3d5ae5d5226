"""The shading stage: shape from shading. The paper has no such stage.

Once light and albedo are known, eq. 8 says how bright each slope of the surface is. The stage goes on with the losses
of the geometry stages, with eq. 8's colour in place of the learned radiance's. It optimises the latent code and the
deformation network of the shape; light, albedo and camera are fixed. The albedo is a function of the reference space
and moves with the surface."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import mitsuba as mi
import numpy as np

from sira_mi.avatar.decoders import diffuse_albedo
from sira_mi.fields.columns import normalise
from sira_mi.fields.sdf import SdfField, surface
from sira_mi.fields.tracing import differentiable_hit
from sira_mi.fit.geometry import GeometryProblem, GeometryScene, GeometryStage
from sira_mi.fit.shaded import Arrays, decoder, shade_points
from sira_mi.fit.stage import FitTask, Problem
from sira_mi.fit.state import FitState
from sira_mi.optimisation import losses
from sira_mi.portrait.portrait import halve


@dataclass(frozen=True)
class ShadingStage(GeometryStage):
    """Shape by eq. 8 under the light and with the albedo fitted before."""

    k_s: tuple[float, float] = (1.0, 1.0)
    shading: float = 2.0  # weight of the colour by eq. 8

    def problem(self, task: FitTask, state: FitState) -> Problem:
        return ShadingProblem(self, task, task.share(ShadingScene, lambda: ShadingScene(task, state)))


class ShadingScene(GeometryScene):
    """The fitted head before a camera that sees it unmoved. Eq. 8's colour is compared at half the portrait's size:
    slopes are smooth, and points and their visibility are traced in every block."""

    def __init__(self, task: FitTask, state: FitState):
        path = task.write_avatar(state)
        super().__init__(task.pose_portrait(state), task.prior, path, task.settings, task.exposure())
        self.photo = halve(self.portrait)


class ShadingProblem(GeometryProblem):
    """The losses of the shading stage."""

    stage: ShadingStage
    scene: ShadingScene

    def __init__(self, stage: ShadingStage, task: FitTask, scene: ShadingScene):
        super().__init__(stage, scene)
        self.task = task

    def refresh(self, state: FitState) -> None:
        """Extracts the mesh and finds the photo's points on it, and their visibility. Raises EmptySurfaceError."""
        super().refresh(replace(state, pose=np.zeros(6, np.float32)))
        self.points = self.task.photo_points(self.scene.photo, self.scene.head)
        others = state.avatar.keys() - self._fixed.keys()
        self._fixed |= {name: mi.Float(state.avatar[name]) for name in others}

    def _losses_of(self, shape: SdfField, parameters: Arrays, step: int, rng: np.random.Generator) -> Arrays:
        terms = super()._losses_of(shape, parameters, step, rng)
        terms["color"] = self.stage.shading * self._shading_loss(shape, {**self._fixed, **parameters}, rng)
        return terms

    def _shading_loss(self, shape: SdfField, current: Arrays, rng: np.random.Generator) -> Any:
        """Photometric loss of eq. 8 on pixels drawn from the photo. The surface's places and normals carry the
        derivative; the points' visibility is that of the last refresh."""
        count = len(self.points.row)
        points = self.points[np.sort(rng.choice(count, min(self.scene.settings.rays, count), replace=False))]
        rays = (mi.TensorXf(v) for v in (points.origin, points.view, points.t))
        _, gradient, x_ref, gamma = surface(shape, differentiable_hit(shape, *rays))
        avatar = self.scene.avatar
        network = decoder(avatar, "diffuse_albedo", current, "z_a")
        albedo = diffuse_albedo(network, avatar.architecture.albedo_octaves, x_ref, gamma)
        shading = shade_points(avatar, current, self.stage.k_s[1], points, albedo, normalise(gradient))
        target = np.ascontiguousarray(self.scene.photo.image[points.row, points.column].T, np.float32)
        return losses.photometric_loss(shading.diffuse + shading.specular, mi.TensorXf(target))
