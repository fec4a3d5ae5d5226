"""The methods that the benchmark compares: the fit itself and the paper's ablations (Figure 4), as data.

Geometry: a.3 has a rendering function that is not learned before, a.4 is SIRA. Appearance, all from the geometry of a.4
on: b.1 has no prior, b.2 the AF-SM and its schedule, b.3 is the fit as it ships, with refinement and detail, b.4 is b.3
with a shading stage, which a draft has not, b.5 a polish after b.3, b.6 is b.3 without shadows: all light of the upper
hemisphere arrives at every point, b.7 lacks the detail, as the paper does, and in b.8, which lacks it too, a refinement
of the light shares what base albedo and light leave of the photo. `landmarks` has the shape and pose that the landmarks
alone tell, and the appearance of b.3.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from sira_mi.avatar.file import Avatar
from sira_mi.avatar.shape import POSE, SHAPE_LATENTS
from sira_mi.fields.mlp import initial_parameters
from sira_mi.fields.sdf import SdfField
from sira_mi.fit.appearance import AppearanceStage
from sira_mi.fit.detail import DetailStage
from sira_mi.fit.geometry import GeometryStage, LatentProblem, LatentStage, share_scene
from sira_mi.fit.refinement import AlbedoRefinementStage
from sira_mi.fit.settings import add_shading, polish_stage
from sira_mi.fit.shaded import DIRECTIONS, Arrays, PhotoPoints, find_masked_points
from sira_mi.fit.shading import ShadingStage
from sira_mi.fit.stage import FitSettings, FitTask, Problem, Stage
from sira_mi.fit.state import FitState
from sira_mi.optimisation.losses import squared_norm
from sira_mi.portrait.portrait import Portrait
from sira_mi.training.af_sm import initial_appearance_model
from studies.portraits.shared_residual import SharedResidualStage

# Of b.4, at draft quality.
_SHADING_STEPS = 40

Stages = tuple[Stage, ...]


class UntrainedRadianceTask(FitTask):
    """A fit whose rendering network is untrained: it expects no exposure."""

    def exposure(self) -> float:
        return 1.0


class UnshadowedTask(FitTask):
    """A fit in which nothing blocks the light."""

    def photo_points(self, portrait: Portrait, head) -> PhotoPoints:
        seen = find_masked_points(portrait, head)
        return PhotoPoints(**vars(seen), unoccluded=np.ones((DIRECTIONS, len(seen.row)), bool))


@dataclass(frozen=True)
class LandmarkStage(LatentStage):
    """Shape and pose by the landmarks and the prior; the photo's colours and mask do not count."""

    def problem(self, task: FitTask, state: FitState) -> Problem:
        return LandmarkProblem(self, share_scene(task))


class LandmarkProblem(LatentProblem):
    """The losses of the landmarks and of the latent codes."""

    def _losses_of(self, shape: SdfField, parameters: Arrays, step: int, rng: np.random.Generator) -> Arrays:
        weights = self.stage.weights
        terms = {"embedding": weights.embedding * squared_norm(*(parameters[name] for name in SHAPE_LATENTS))}
        if self.scene.landmarks is not None:
            terms["landmark"] = weights.landmark * self._landmark_loss(shape, self.scene.landmarks)
        return terms


@dataclass(frozen=True)
class Method:
    """One row of the tables."""

    name: str
    title: str
    stages: Callable[[Stages], Stages]  # of the shipped fit's stages, those that this method runs
    start: Callable[[Avatar, FitState, int], FitState]  # (prior, state, seed) -> state before the first stage
    after: str | None = None  # the method whose result it goes on from
    task: type[FitTask] = FitTask

    def settings(self, settings: FitSettings) -> FitSettings:
        """The settings of a fit by this method at the quality of `settings`."""
        return replace(settings, stages=self.stages(settings.stages))


def is_geometry(stage: Stage) -> bool:
    """Whether a stage comes before the appearance and fits the shape."""
    return isinstance(stage, GeometryStage) and not isinstance(stage, ShadingStage)


def _geometry(shipped: Stages) -> Stages:
    return tuple(stage for stage in shipped if is_geometry(stage))


def _unchanged(prior: Avatar, state: FitState, seed: int) -> FitState:
    return state


def _untrained_rendering(prior: Avatar, state: FitState, seed: int) -> FitState:
    """The rendering network as a training starts it."""
    network = prior.architecture.networks["rendering"]
    parameters = initial_parameters(network, np.random.default_rng([seed, 7]), output_scale=0.3)
    return state.with_parameters({"rendering": parameters})


def _untrained_appearance(prior: Avatar, state: FitState, seed: int) -> FitState:
    """Albedo networks and light as a training starts them."""
    model = initial_appearance_model(prior.architecture, 1, seed)
    networks = {name: model[name] for name in ("diffuse_albedo", "specular_albedo", "illumination")}
    latents = {name: np.zeros_like(state.avatar[name]) for name in ("z_a", "z_s", "z_l")}
    return state.with_parameters({**networks, **latents})


def _rendering_from_scratch(shipped: Stages) -> Stages:
    """The geometry stages with the rendering network, untrained before, optimised fast from the first on, and without
    its latent."""
    result = []
    for stage in _geometry(shipped):
        rates = {k: v for k, v in stage.rates.items() if k in ("z_sdf", "pose")}
        rates["rendering"] = max(stage.rates.get("rendering", 0.0), 2e-3)
        rates |= {k: v for k, v in stage.rates.items() if k == "deformation"}
        result.append(replace(stage, rates=rates))
    return tuple(result)


def _landmarks_alone(shipped: Stages) -> Stages:
    """One stage as long as all geometry stages, which moves shape and pose by the landmarks, and the appearance."""
    geometry = _geometry(shipped)
    rates = {name: geometry[0].rates[name] for name in (*SHAPE_LATENTS, POSE)}
    stage = LandmarkStage("landmarks", sum(stage.steps for stage in geometry), rates)
    return (stage, *(after for after in _after_geometry(shipped) if not isinstance(after, ShadingStage)))


def _without_prior(shipped: Stages) -> Stages:
    """One stage as long as all appearance stages, from untrained networks, without refinement."""
    steps = sum(stage.steps for stage in shipped if isinstance(stage, AppearanceStage))
    rates = {"illumination": 1e-3, "diffuse_albedo": 1e-3, "specular_albedo": 1e-3}
    return (AppearanceStage("without prior", steps, rates, k_s=(1.0, 1.0)),)


def _after_geometry(shipped: Stages) -> Stages:
    return tuple(stage for stage in shipped if not is_geometry(stage))


def _with_shading(shipped: Stages) -> Stages:
    """Those after the geometry with a shading stage, whether the quality has one or not."""
    stages = _after_geometry(shipped)
    return stages if any(isinstance(s, ShadingStage) for s in stages) else add_shading(stages, _SHADING_STEPS)


def _without_refinement(shipped: Stages) -> Stages:
    return tuple(stage for stage in _without_detail(shipped) if not isinstance(stage, AlbedoRefinementStage))


def _without_detail(shipped: Stages) -> Stages:
    return tuple(stage for stage in _after_geometry(shipped) if not isinstance(stage, DetailStage))


def _share_the_residual(shipped: Stages) -> Stages:
    """With a refinement of the light beside that of the albedo, and without detail."""

    def with_light(stage: Stage) -> Stage:
        if not isinstance(stage, AlbedoRefinementStage):
            return stage
        rates = {**stage.rates, "light_refinement": stage.rates["albedo_refinement"]}
        return SharedResidualStage(stage.name, stage.steps, rates)

    return tuple(map(with_light, _without_detail(shipped)))


METHODS = (
    Method(
        "a.3", "deformation and reference", _rendering_from_scratch, _untrained_rendering, task=UntrainedRadianceTask
    ),
    Method("a.4", "SIRA: shape and appearance learned together", _geometry, _unchanged),
    Method("landmarks", "shape and pose by landmarks alone", _landmarks_alone, _unchanged),
    Method("b.1", "no prior", _without_prior, _untrained_appearance, after="a.4"),
    Method("b.2", "AF-SM and schedule", _without_refinement, _unchanged, after="a.4"),
    Method("b.3", "with refinement and detail: the shipped fit", _after_geometry, _unchanged, after="a.4"),
    Method("b.4", "as b.3, with a shading stage", _with_shading, _unchanged, after="a.4"),
    Method("b.5", "polished by path tracing", lambda shipped: (polish_stage(),), _unchanged, after="b.3"),
    Method("b.6", "as b.3, without shadows", _after_geometry, _unchanged, after="a.4", task=UnshadowedTask),
    Method(
        "b.7", "without detail: all of the residual to the albedo's network", _without_detail, _unchanged, after="a.4"
    ),
    Method("b.8", "without detail: albedo and light share the residual", _share_the_residual, _unchanged, after="a.4"),
)
BY_NAME = {method.name: method for method in METHODS}
