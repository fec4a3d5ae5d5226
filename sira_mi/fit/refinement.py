"""The refinement stage of section 3.2.2: a network adds to the base albedo what the prior lacks (eqs 11 to 13)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from sira_mi.avatar.decoders import albedo_refinement, refine_albedo
from sira_mi.decisions import Decision
from sira_mi.fields.columns import to_array
from sira_mi.fit.appearance import AppearanceProblem, AppearanceStage, AppearanceWeights, share_surface
from sira_mi.fit.shaded import Arrays, Shading, decoder, shade_points
from sira_mi.fit.stage import FitTask, Problem
from sira_mi.fit.state import FitState
from sira_mi.optimisation import losses

# ε of the smoothness of the refinement, scene units.
_JITTER = 0.01


@dataclass(frozen=True)
class RefinementWeights(AppearanceWeights):
    """Weights of the losses of section 3.2.2, those of the refinement included."""

    lambda_8: float = 0.5  # eq. 13, refinement in shadows
    lambda_9: float = 1.0  # eq. 13, refinement in reflections
    refinement: float = 0.1  # eq. 12
    smoothness: float = 0.02  # ‖a^r(x) − a^r(x + ε)‖, keeps noise out of the refinement


@dataclass(frozen=True)
class AlbedoRefinementStage(AppearanceStage):
    """The albedo takes all that eq. 8 with the base albedo leaves of the photo."""

    k_s: tuple[float, float] = (1.0, 1.0)
    k_r: float = 1.0
    weights: RefinementWeights = field(default_factory=RefinementWeights)

    def problem(self, task: FitTask, state: FitState) -> Problem:
        return AlbedoRefinementProblem(self, task, share_surface(task, state))

    def decisions(self) -> tuple[Decision, ...]:
        return (self._fixed_base(),)


@dataclass(frozen=True)
class RefinedPoints:
    """Some points of the photo with a refined albedo. Tensors, N columns."""

    index: np.ndarray  # [N] among the photo's points
    current: Arrays  # the avatar's parameters, Floats
    network: list[tuple]  # layers of the refinement of the albedo
    x_ref: Any  # [3, N]
    gamma: Any  # [N_γ, N]
    base: Any  # [3, N] base albedo
    fine: Any  # [3, N] a^r, what refines it
    albedo: Any  # [3, N] refined
    shading: Shading  # of the refined albedo
    skin_tone: Any  # loss of the skin's tone, None without skin


class AlbedoRefinementProblem(AppearanceProblem):
    """The losses of a refinement of the albedo."""

    stage: AlbedoRefinementStage

    def losses(self, parameters: Arrays, step: int, rng: np.random.Generator) -> Arrays:
        points = self._shade(parameters, step, rng)
        return self._losses_of(points, points.shading.diffuse + points.shading.specular, rng)

    def _shade(self, parameters: Arrays, step: int, rng: np.random.Generator) -> RefinedPoints:
        """Points drawn for a step."""
        current, a = {**self._fixed, **parameters}, self.avatar.architecture
        index = self._draw(rng)
        points = self.surface.points[index]
        base, skin_tone = self._base_and_skin(current, index)
        network = decoder(self.avatar, "albedo_refinement", current)
        x_ref, gamma = mi.TensorXf(points.x_ref), mi.TensorXf(points.gamma)
        fine = albedo_refinement(network, a.refinement_octaves, x_ref, gamma)
        albedo = refine_albedo(base, fine, self.stage.k_r)
        shading = shade_points(self.avatar, current, self._k_s(step), points, albedo)
        return RefinedPoints(index, current, network, x_ref, gamma, base, fine, albedo, shading, skin_tone)

    def _losses_of(self, points: RefinedPoints, radiance: Any, rng: np.random.Generator) -> Arrays:
        """The losses of a `radiance` [3, N] at the points."""
        target = to_array(self.surface.radiance[:, points.index])
        terms = {
            "color": losses.photometric_loss(radiance, target),
            **self._prior_losses(points.current, points.shading, points.skin_tone),
        }
        moved = points.x_ref + to_array(_JITTER * rng.standard_normal((3, len(points.index))))
        octaves = self.avatar.architecture.refinement_octaves
        beside = albedo_refinement(points.network, octaves, moved, points.gamma)
        smoothness = losses.smoothness_loss(points.fine, beside)
        terms["refinement"] = self.stage.weights.refinement * self._refinement_loss(points)
        terms["smoothness"] = self.stage.weights.smoothness * smoothness
        return terms

    def _refinement_loss(self, points: RefinedPoints) -> Any:
        """Eqs 12 and 13: ‖a^r‖ weighted by w, large in shadows and in reflections. Base albedo and radiances are part
        of the weight alone, without gradients."""
        weights, shading = self.stage.weights, points.shading
        base_diffuse = shading.diffuse * (points.base / dr.maximum(points.albedo, 1e-4))
        shadow = dr.maximum(_norm_1(points.base) - _norm_1(base_diffuse), 0.0)
        w = dr.detach(weights.lambda_8 * shadow + weights.lambda_9 * _norm_1(shading.specular))
        return losses.mean(losses.norm(points.fine) * w)


def _norm_1(v: Any) -> Any:
    """‖v‖₁ of the columns of v [rows, N]: [N]."""
    return dr.sum(dr.abs(v), axis=0)
