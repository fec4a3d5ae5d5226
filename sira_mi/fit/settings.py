"""The shipped fits: the stages of each quality in order, their lengths and learning rates."""

from sira_mi.fit.appearance import AlbedoStage, LightStage, SpecularStage
from sira_mi.fit.detail import DetailStage
from sira_mi.fit.geometry import GeometryStage, LatentStage
from sira_mi.fit.polish import PolishStage
from sira_mi.fit.refinement import AlbedoRefinementStage
from sira_mi.fit.shading import ShadingStage
from sira_mi.fit.stage import FitSettings, Stage


def schedule_stages(geometry: float, appearance: float, refinement: float) -> tuple[Stage, ...]:
    """The schedules of sections 3.2.1 and 3.2.2. The lengths are in proportion to three scales: of the geometry stages,
    of light, albedo and specular term, and of the refinement.

    A longer geometry fit follows the photo further from the prior, on some heads away from the person. The rendering
    network is optimised from the first step on; otherwise the shape has to explain the photo's own light."""

    def shape_steps(count: int) -> int:
        return round(count * geometry)

    def steps(count: int) -> int:
        return round(count * appearance)

    def shape_rates(latents: float, networks: dict[str, float], pose: float) -> dict[str, float]:
        return {"z_sdf": latents, "z_r": latents, **networks, "pose": pose}

    return (
        LatentStage(
            "latents",
            shape_steps(160),
            shape_rates(6e-2, {"rendering": 1e-3}, 3e-3),
            mask_sharpness=30,
            color=0.3,
        ),
        GeometryStage(
            "networks",
            shape_steps(240),
            shape_rates(6e-3, {"deformation": 4e-4, "rendering": 4e-4}, 2e-3),
            mask_sharpness=60,
            landmark=0.25,
        ),
        GeometryStage(
            "details",
            shape_steps(120),
            shape_rates(2e-3, {"deformation": 1.5e-4, "rendering": 1.5e-4}, 1e-3),
            mask_sharpness=240,
            landmark=0.1,
        ),
        LightStage("light", steps(120), {"z_l": 1e-1, "illumination": 1e-3}),
        AlbedoStage("albedo", steps(120), {"z_l": 3e-2, "illumination": 5e-4, "z_a": 1e-1}),
        SpecularStage("specular", steps(120), {"z_l": 3e-2, "illumination": 5e-4, "z_a": 3e-2, "z_s": 6e-2}),
        AlbedoRefinementStage(
            "refinement",
            round(800 * refinement),
            {"z_l": 6e-3, "illumination": 1e-4, "z_s": 1e-2, "albedo_refinement": 5e-3},
        ),
        DetailStage("detail", 0, {}),
    )


def add_shading(stages: tuple[Stage, ...], steps: int) -> tuple[Stage, ...]:
    """The stages with a shading stage of so many steps before the refinement, when light and albedo are known. It
    corrects what the learned radiance gets wrong of the shape. A draft has none, as it would take a sixth of its
    time."""
    shading = ShadingStage("shading", steps, {"z_sdf": 6e-3, "deformation": 2e-4}, mask_sharpness=120, landmark=0.25)
    first = next(number for number, stage in enumerate(stages) if isinstance(stage, AlbedoRefinementStage))
    return (*stages[:first], shading, *stages[first:])


def polish_stage(steps: int = 30) -> PolishStage:
    """The stage that may follow all others."""
    rates = {"z_l": 6e-3, "illumination": 1e-4, "z_s": 1e-2, "albedo_refinement": 2e-3}
    return PolishStage("polish", steps, rates)


QUALITIES = {
    "draft": FitSettings("draft", 256, 1024, 256, 2048, 0.1, 0.06, schedule_stages(0.35, 0.7, 0.25)),
    "standard": FitSettings(
        "standard", 512, 2048, 512, 4096, 0.08, 0.05, add_shading(schedule_stages(0.5, 1.0, 0.75), 60)
    ),
    "high": FitSettings("high", 768, 3072, 768, 8192, 0.06, 0.04, add_shading(schedule_stages(0.5, 2.5, 2.0), 60)),
}
