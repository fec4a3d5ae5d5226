"""All settings of a fit, as data: what each stage optimises, for how long, and how its losses are weighed."""

from dataclasses import dataclass, field, replace

GEOMETRY, APPEARANCE, SHADING, POLISH = "geometry", "appearance", "shading", "polish"


@dataclass(frozen=True)
class Stage:
    """One stretch of optimisation."""

    name: str
    steps: int
    rates: dict[str, float]  # learning rate of every optimised avatar tensor; all others are frozen
    mask_sharpness: float = 50.0  # α of the mask loss, per scene unit (IDR: 50 doubling to 1600 on a unit sphere)
    color: float = 1.0  # of the weight of the geometry's colour
    landmark: float = 1.0  # of the weight of the landmarks: the photo itself is the better judge once the head is near
    k_s: tuple[float, float] = (0.0, 0.0)  # weight of the specular BRDF, first and last step, eq. 8
    k_r: float = 0.0  # weight of the albedo refinement, eq. 11


@dataclass(frozen=True)
class GeometryWeights:
    """Weights of the losses of section 3.2.1 (IDR: colour 1, mask 100 over a sum of BCE / α, eikonal 0.1)."""

    color: float = 1.0
    shading: float = 2.0  # on the colour by eq. 8, in the shading stage
    mask: float = 4.0  # on a mean over rays, in scene units
    eikonal: float = 0.05
    landmark: float = 0.4  # on reprojection errors in face sizes
    embedding: float = 6e-6  # on ‖z‖², keeps latents where the prior was trained
    stay: float = 0.5  # on mean |δ − δ₀| against the prior's deformation network


@dataclass(frozen=True)
class AppearanceWeights:
    """Weights of the losses of section 3.2.2."""

    lambda_8: float = 0.5  # eq. 13, refinement in shadows
    lambda_9: float = 1.0  # eq. 13, refinement in reflections
    refinement: float = 0.1  # eq. 12
    embedding: float = 1e-5  # on ‖z‖²
    white_light: float = 0.005  # mean squared log-chroma of the lobes: the prior on the light's colour
    skin_tone: float = 2e-2  # on the deviation of the skin's albedo from the expected tone, in standard deviations
    shares: float = 0.05  # on the distance of albedo's and light's parts of the residual from their shares
    smoothness: float = 0.02  # ‖a^r(x) − a^r(x + ε)‖, keeps noise out of the refinement


@dataclass(frozen=True)
class PolishSettings:
    """Of the polish stage."""

    color: float = 1.0  # weight of the error of the path-traced picture
    size: int = 128  # longest side of the head's picture, pixels
    samples: int = 16  # paths a pixel, of the picture and again of its derivative; a power of 4
    depth: int = 6  # most segments of a path; 2 is direct light


@dataclass(frozen=True)
class FitSettings:
    """A whole fit."""

    quality: str
    working_size: int  # longest side of the working image, pixels
    rays: int  # of the geometry and shading stages, a step
    points: int  # of the eikonal loss, a step
    pixels: int  # of the appearance stages, a step
    voxel: float  # of the mesh during the fit, scene units
    final_voxel: float  # of the exported mesh, scene units
    stages: tuple[tuple[str, Stage], ...]  # (GEOMETRY, APPEARANCE, SHADING or POLISH, stage), in order
    geometry: GeometryWeights = field(default_factory=GeometryWeights)
    appearance: AppearanceWeights = field(default_factory=AppearanceWeights)
    polish: PolishSettings = field(default_factory=PolishSettings)
    learned_radiance: bool = True  # the rendering function starts as the SA-SM has it, at the exposure of its photos
    shadows: bool = True  # of the head on itself, and light that it reflects onto itself, wherever eq. 8 is
    block: int = 20  # steps between extractions of the mesh; checkpoints fall on them


def _stages(geometry: float, appearance: float, refinement: float) -> tuple[tuple[str, Stage], ...]:
    """The schedules of sections 3.2.1 and 3.2.2, lengths in proportion to the scales of the geometry stages, of light,
    albedo and speculars, and of the refinement. Geometry that is fitted for longer follows the photo further from the
    prior, on some heads away from the person. The rendering function moves from the first step on: one that cannot take
    the photo's own light puts it down to the shape."""

    def shape_steps(count: int) -> int:
        return round(count * geometry)

    def steps(count: int) -> int:
        return round(count * appearance)

    shape, networks = ("z_sdf", "z_r"), ("deformation", "rendering")
    return (
        (
            GEOMETRY,
            Stage(
                "latents",
                shape_steps(160),
                _rates(shape, 6e-2, ("rendering",), 1e-3, 3e-3),
                mask_sharpness=30,
                color=0.3,
            ),
        ),
        (
            GEOMETRY,
            Stage(
                "networks",
                shape_steps(240),
                _rates(shape, 6e-3, networks, 4e-4, 2e-3),
                mask_sharpness=60,
                landmark=0.25,
            ),
        ),
        (
            GEOMETRY,
            Stage(
                "details",
                shape_steps(120),
                _rates(shape, 2e-3, networks, 1.5e-4, 1e-3),
                mask_sharpness=240,
                landmark=0.1,
            ),
        ),
        (APPEARANCE, Stage("light", steps(120), {"z_l": 1e-1, "illumination": 1e-3})),
        (APPEARANCE, Stage("albedo", steps(120), {"z_l": 3e-2, "illumination": 5e-4, "z_a": 1e-1})),
        (
            APPEARANCE,
            Stage(
                "speculars", steps(120), {"z_l": 3e-2, "illumination": 5e-4, "z_a": 3e-2, "z_s": 6e-2}, k_s=(0.0, 1.0)
            ),
        ),
        (
            APPEARANCE,
            Stage(
                "refinement",
                round(800 * refinement),
                {"z_l": 6e-3, "illumination": 1e-4, "z_s": 1e-2, "albedo_refinement": 5e-3, "light_refinement": 5e-3},
                k_s=(1.0, 1.0),
                k_r=1.0,
            ),
        ),
    )


def with_shading(stages: tuple[tuple[str, Stage], ...], steps: int) -> tuple[tuple[str, Stage], ...]:
    """The stages with a shading stage of so many steps before the refinement: light and albedo are known by then, and
    eq. 8 mends what the learned radiance could not tell of the shape. A draft does without: it takes a sixth of its
    time."""
    rates = {"z_sdf": 6e-3, "deformation": 2e-4}
    stage = Stage("shading", steps, rates, mask_sharpness=120, landmark=0.25, k_s=(1.0, 1.0))
    first = next(number for number, (_, other) in enumerate(stages) if other.k_r > 0)
    return (*stages[:first], (SHADING, stage), *stages[first:])


def polish_stage(steps: int = 30) -> tuple[str, Stage]:
    """The stage that may follow all others: albedo and light by path tracing."""
    rates = {"z_l": 6e-3, "illumination": 1e-4, "z_s": 1e-2, "albedo_refinement": 2e-3}
    return POLISH, Stage("polish", steps, rates, k_s=(1.0, 1.0), k_r=1.0)


def _rates(first: tuple, first_rate: float, second: tuple, second_rate: float, pose_rate: float) -> dict[str, float]:
    return {**dict.fromkeys(first, first_rate), **dict.fromkeys(second, second_rate), "pose": pose_rate}


def without(settings: FitSettings, name: str) -> FitSettings:
    """The same fit with the tensor `name` held fixed in all stages."""
    stages = tuple(
        (kind, replace(stage, rates={k: v for k, v in stage.rates.items() if k != name}))
        for kind, stage in settings.stages
    )
    return replace(settings, stages=stages)


QUALITIES = {
    "draft": FitSettings("draft", 256, 1024, 256, 2048, 0.1, 0.06, _stages(0.35, 0.7, 0.25)),
    "standard": FitSettings("standard", 512, 2048, 512, 4096, 0.08, 0.05, with_shading(_stages(0.5, 1.0, 0.75), 60)),
    "high": FitSettings("high", 768, 3072, 768, 8192, 0.06, 0.04, with_shading(_stages(0.5, 2.5, 2.0), 60)),
}
