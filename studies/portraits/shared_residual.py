"""A refinement stage in which albedo and light share the photo's residual (`residual`); the shipped fit gives it all to
the albedo."""

from __future__ import annotations

from dataclasses import dataclass, field

import drjit as dr
import numpy as np

from sira_mi.avatar.decoders import light_refinement
from sira_mi.fields.mlp import initial_parameters
from sira_mi.fit.appearance import share_surface
from sira_mi.fit.refinement import AlbedoRefinementProblem, AlbedoRefinementStage, RefinementWeights
from sira_mi.fit.shaded import Arrays, PhotoPoints, decoder
from sira_mi.fit.stage import FitTask, Problem
from sira_mi.fit.state import FitState
from studies.portraits.residual import albedo_shares, albedo_variances, light_variances, log_residual, share_loss


@dataclass(frozen=True)
class SharedResidualWeights(RefinementWeights):
    """Weights of the losses of section 3.2.2 and of the shares."""

    shares: float = 0.05  # on the distance of albedo's and light's parts of the residual from their shares


@dataclass(frozen=True)
class SharedResidualStage(AlbedoRefinementStage):
    """Albedo and light share the residual."""

    weights: SharedResidualWeights = field(default_factory=SharedResidualWeights)

    def problem(self, task: FitTask, state: FitState) -> Problem:
        return SharedResidualProblem(self, task, share_surface(task, state))


class SharedResidualProblem(AlbedoRefinementProblem):
    """The losses of a refinement of albedo and light."""

    stage: SharedResidualStage

    def start(self, state: FitState) -> FitState:
        """Settles the albedo's shares of the residual; the refinement of the light starts from the factor 1."""
        self.refresh(state)
        surface, index = self.surface, self._draw(np.random.default_rng(0))
        points = surface.points

        def radiance(points: PhotoPoints) -> np.ndarray:
            diffuse, specular = self._base_radiance(points)
            return diffuse + specular

        diffuse, specular = self._base_radiance(points[index])
        residual = log_residual(surface.radiance[:, index] - specular, diffuse)
        of_albedo = albedo_variances(surface.portrait, points.row, points.column)
        self._shares = albedo_shares(residual, index, of_albedo, light_variances(radiance, points, index, seed=0))
        network = self.avatar.architecture.networks["light_refinement"]
        parameters = initial_parameters(network, np.random.default_rng(0), output_scale=0.0)
        return state.with_parameters({"light_refinement": parameters})

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
