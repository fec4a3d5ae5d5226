"""The methods that the benchmark compares: the fit itself and the paper's ablations (Figure 4), as data.

Geometry: a.3 has a rendering function that is not learned before, a.4 is SIRA. Appearance, all from the geometry of a.4
on: b.1 has no prior, b.2 the AF-SM and its schedule, b.3 is the fit as it ships, with the refinement, b.4 is b.3 with a
shading stage, which a draft has not, b.5 a polish after b.3, b.6 is b.3 without shadows: all light of the upper
hemisphere arrives at every point, and b.7 gives all that base albedo and light leave of the photo to the albedo, as the
paper does.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from sira_mi.avatar.file import Avatar
from sira_mi.fields.mlp import initial_parameters
from sira_mi.fit.settings import APPEARANCE, GEOMETRY, SHADING, FitSettings, Stage, polish_stage, with_shading
from sira_mi.training.af_sm import initial_appearance_model

# Of b.4, at draft quality.
_SHADING_STEPS = 40

Tensors = dict[str, np.ndarray]
Stages = tuple[tuple[str, Stage], ...]


@dataclass(frozen=True)
class Method:
    """One row of the tables."""

    name: str
    title: str
    stages: Callable[[Stages], Stages]  # of the shipped fit's stages, those that this method runs
    start: Callable[[Avatar, Tensors, int], Tensors]  # (prior, tensors, seed) -> tensors before the first stage
    after: str | None = None  # the method whose result it goes on from
    shadows: bool = True

    def settings(self, settings: FitSettings) -> FitSettings:
        """The settings of a fit by this method at the quality of `settings`."""
        return replace(
            settings,
            stages=self.stages(settings.stages),
            shadows=self.shadows,
            learned_radiance=self.start is not _untrained_rendering,
        )


def _of_kind(kind: str) -> Callable[[Stages], Stages]:
    return lambda stages: tuple(entry for entry in stages if entry[0] == kind)


def _unchanged(prior: Avatar, tensors: Tensors, seed: int) -> Tensors:
    return tensors


def _untrained_rendering(prior: Avatar, tensors: Tensors, seed: int) -> Tensors:
    """The rendering function as a training starts it."""
    network = prior.architecture.networks["rendering"]
    parameters = initial_parameters(network, np.random.default_rng([seed, 7]), output_scale=0.3)
    return {**tensors, "rendering": parameters}


def _untrained_appearance(prior: Avatar, tensors: Tensors, seed: int) -> Tensors:
    """Albedo networks and light as a training starts them."""
    model = initial_appearance_model(prior.architecture, 1, seed)
    networks = {name: model[name] for name in ("diffuse_albedo", "specular_albedo", "illumination")}
    return {**tensors, **networks, **{f"z_{k}": np.zeros_like(tensors[f"z_{k}"]) for k in "asl"}}


def _rendering_from_scratch(shipped: Stages) -> Stages:
    """The geometry stages with the rendering function, untrained before, optimised fast from the first on, and without
    its latent."""
    result = []
    for kind, stage in _of_kind(GEOMETRY)(shipped):
        rates = {k: v for k, v in stage.rates.items() if k in ("z_sdf", "pose")}
        rates["rendering"] = max(stage.rates.get("rendering", 0.0), 2e-3)
        rates |= {k: v for k, v in stage.rates.items() if k == "deformation"}
        result.append((kind, replace(stage, rates=rates)))
    return tuple(result)


def _without_prior(shipped: Stages) -> Stages:
    """One stage as long as all appearance stages, from untrained networks, without refinement."""
    steps = sum(stage.steps for _, stage in _of_kind(APPEARANCE)(shipped))
    rates = {"illumination": 1e-3, "diffuse_albedo": 1e-3, "specular_albedo": 1e-3}
    return ((APPEARANCE, Stage("without prior", steps, rates, k_s=(1.0, 1.0))),)


def _after_geometry(shipped: Stages) -> Stages:
    return tuple(entry for entry in shipped if entry[0] != GEOMETRY)


def _with_shading(shipped: Stages) -> Stages:
    """Those after the geometry with a shading stage, whether the quality has one or not."""
    stages = _after_geometry(shipped)
    return stages if any(kind == SHADING for kind, _ in stages) else with_shading(stages, _SHADING_STEPS)


def _without_refinement(shipped: Stages) -> Stages:
    return tuple((kind, stage) for kind, stage in _after_geometry(shipped) if stage.k_r == 0)


def _all_to_the_albedo(shipped: Stages) -> Stages:
    """The refinement of eq. 11 alone: that of the light stays 1."""
    return tuple(
        (kind, replace(stage, rates={k: v for k, v in stage.rates.items() if k != "light_refinement"}))
        for kind, stage in _after_geometry(shipped)
    )


METHODS = (
    Method("a.3", "deformation and reference", _rendering_from_scratch, _untrained_rendering),
    Method("a.4", "SIRA: shape and appearance learned together", _of_kind(GEOMETRY), _unchanged),
    Method("b.1", "no prior", _without_prior, _untrained_appearance, after="a.4"),
    Method("b.2", "AF-SM and schedule", _without_refinement, _unchanged, after="a.4"),
    Method("b.3", "with refinement: the shipped fit", _after_geometry, _unchanged, after="a.4"),
    Method("b.4", "as b.3, with a shading stage", _with_shading, _unchanged, after="a.4"),
    Method("b.5", "polished by path tracing", lambda shipped: (polish_stage(),), _unchanged, after="b.3"),
    Method("b.6", "as b.3, without shadows", _after_geometry, _unchanged, after="a.4", shadows=False),
    Method("b.7", "as b.3, all of the residual to the albedo", _all_to_the_albedo, _unchanged, after="a.4"),
)
BY_NAME = {method.name: method for method in METHODS}
