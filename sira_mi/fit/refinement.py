"""The refinement stage of section 3.2.2: a network adds to the base albedo what the prior lacks (eqs 11 to 13). Other
than in the paper, a second network refines the light, and the two share the photo's residual (`residual`)."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from sira_mi.avatar.decoders import albedo_refinement, light_refinement, refine_albedo
from sira_mi.decisions import Decision
from sira_mi.fields.columns import to_array
from sira_mi.fields.mlp import initial_parameters
from sira_mi.fit.appearance import AppearanceProblem, AppearanceStage, AppearanceWeights, share_surface
from sira_mi.fit.residual import albedo_shares, light_variances, log_residual, share_loss
from sira_mi.fit.shaded import Arrays, PhotoPoints, Shading, decoder, shade_points
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
    shares: float = 0.05  # on the distance of albedo's and light's parts of the residual from their shares
    smoothness: float = 0.02  # ‖a^r(x) − a^r(x + ε)‖, keeps noise out of the refinement


@dataclass(frozen=True)
class AlbedoRefinementStage(AppearanceStage):
    """The refinement of the paper: the albedo takes all of the residual."""

    k_s: tuple[float, float] = (1.0, 1.0)
    k_r: float = 1.0
    weights: RefinementWeights = field(default_factory=RefinementWeights)

    def problem(self, task: FitTask, state: FitState) -> Problem:
        return AlbedoRefinementProblem(self, task, share_surface(task, state))

    def decisions(self) -> tuple[Decision, ...]:
        return (self._fixed_base(),)


@dataclass(frozen=True)
class RefinementStage(AlbedoRefinementStage):
    """Albedo and light share the residual."""

    def problem(self, task: FitTask, state: FitState) -> Problem:
        return RefinementProblem(self, task, share_surface(task, state))


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


class RefinementProblem(AlbedoRefinementProblem):
    """The losses of a refinement of albedo and light."""

    def start(self, state: FitState) -> FitState:
        """Settles the albedo's shares of the residual; the refinement of the light starts from the factor 1."""
        self.refresh(state)
        points, index = self.surface.points, self._draw(np.random.default_rng(0))

        def radiance(points: PhotoPoints) -> np.ndarray:
            diffuse, specular = self._base_radiance(points)
            return diffuse + specular

        diffuse, specular = self._base_radiance(points[index])
        residual = log_residual(self.surface.radiance[:, index] - specular, diffuse)
        light = light_variances(radiance, points, index, seed=0)
        network = self.avatar.architecture.networks["light_refinement"]
        parameters = initial_parameters(network, np.random.default_rng(0), output_scale=0.0)
        shares = albedo_shares(residual, index, self.surface.albedo_variances, light)
        return replace(state.with_parameters({"light_refinement": parameters}), albedo_shares=shares)

    def refresh(self, state: FitState) -> None:
        super().refresh(state)
        if state.albedo_shares is not None:  # None before the start
            self._shares = state.albedo_shares

    def losses(self, parameters: Arrays, step: int, rng: np.random.Generator) -> Arrays:
        points = self._shade(parameters, step, rng)
        radiance = points.shading.diffuse + points.shading.specular
        network = decoder(self.avatar, "light_refinement", points.current)
        octaves = self.avatar.architecture.refinement_octaves
        of_light = light_refinement(network, octaves, points.x_ref, points.gamma)
        terms = self._losses_of(points, radiance * dr.exp(of_light), rng)
        of_albedo = self._shares[:, points.index]
        terms["shares"] = self.stage.weights.shares * share_loss(points.base, points.albedo, of_light, of_albedo)
        return terms


def _norm_1(v: Any) -> Any:
    """‖v‖₁ of the columns of v [rows, N]: [N]."""
    return dr.sum(dr.abs(v), axis=0)
