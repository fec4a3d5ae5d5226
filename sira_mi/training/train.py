"""The trainings of both statistical models, from a collection to `prior.safetensors`.

`shape` trains the SA-SM and writes `shape.checkpoint`; `appearance` trains the AF-SM on top of it and writes
`prior.safetensors`, which a fit takes with `--prior`. Both write a log and pictures, and resume from their checkpoints.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sira_mi.avatar.architecture import AvatarArchitecture
from sira_mi.avatar.file import save_avatar
from sira_mi.avatar.shape import head_of
from sira_mi.errors import InputError
from sira_mi.optimisation.adam import adam
from sira_mi.training import af_sm, sa_sm
from sira_mi.training.loop import read_parameters, run_training
from sira_mi.training.pictures import AppearancePicture, shape_picture
from sira_mi.training.prior import assemble_prior
from sira_mi.training.sa_sm import LATENTS, NETWORKS
from sira_mi.training.scenes import load_training_scenes

# The loss terms of each model whose weight λ is a setting of that name.
SHAPE_TERMS = (
    "surface",
    "normal",
    "distance",
    "eikonal",
    "random_eikonal",
    "deformation",
    "landmark",
    "color",
    "embedding",
)
APPEARANCE_TERMS = ("embedding", "smoothness", "specular_anchor", "white_light", "skin_tone")


def parse_sizes(items: list[str]) -> dict[str, int]:
    """`["sdf_width=64", ...]` as sizes of an AvatarArchitecture. Raises InputError for anything else."""

    names, sizes = [field.name for field in dataclasses.fields(AvatarArchitecture)], {}
    for item in items:
        name, _, value = item.partition("=")
        if name not in names:
            raise InputError(f"--architecture {item}: unknown size {name!r}; known are {', '.join(names)}")
        if not value.isascii() or not value.isdigit():
            raise InputError(f"--architecture {item}: give a whole number, e.g. {name}=64")
        sizes[name] = int(value)
    return sizes


def with_sizes(architecture: AvatarArchitecture, sizes: dict[str, int]) -> AvatarArchitecture:
    """The architecture with some sizes replaced. Raises InputError for sizes that no network can have."""
    try:
        changed = dataclasses.replace(architecture, **sizes)
        _ = changed.networks  # refuses networks that are too large
        return changed
    except ValueError as error:
        raise InputError(f"--architecture: {error}") from error


def without_term(settings, terms: tuple[str, ...], without: str | None):
    """Settings of a training with the weight of the loss term `without` set to zero. Raises InputError for an unknown
    term."""
    if without is None:
        return settings
    if without not in terms:
        raise InputError(f"--without {without}: no such loss term; known are {', '.join(terms)}")
    return dataclasses.replace(settings, **{without: 0.0})


def read_architecture(metadata: dict[str, str], checkpoint: Path) -> AvatarArchitecture:
    """The architecture that a training's checkpoint holds. Raises InputError when there is none."""
    try:
        return AvatarArchitecture.from_dict(json.loads(metadata["architecture"]), checkpoint)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{checkpoint} does not say its architecture ({error}); train it again") from error


def describe(architecture: AvatarArchitecture, settings, seed: int, sources: Sequence[str]) -> dict[str, str]:
    """What a resumed training must have in common with the one that it continues: all but the number of steps."""
    values = {k: v for k, v in dataclasses.asdict(settings).items() if k != "steps"}
    if sources:
        values["sources"] = sorted(sources)
    return {
        "architecture": json.dumps(architecture.to_dict(), sort_keys=True),
        "settings": json.dumps({**values, "seed": seed}, sort_keys=True),
    }


def train_shape(
    collection: Path,
    out: Path,
    *,
    steps: int | None = None,
    seed: int = 0,
    without: str | None = None,
    sizes: dict[str, int] | None = None,
    picture_steps: int = 1000,
    sources: Sequence[str] = (),
    scenes: list | None = None,
) -> dict[str, np.ndarray]:
    """Trains the SA-SM; returns its networks and latents [dim, scenes]. `without` names a loss term to leave out,
    `sizes` those that differ from AvatarArchitecture's, `sources` those of the collection to train on, or all; `scenes`
    are their scenes if they are loaded already."""
    architecture = with_sizes(AvatarArchitecture(), sizes or {})
    settings = without_term(sa_sm.ShapeTraining(), SHAPE_TERMS, without)
    if steps is not None:
        settings = dataclasses.replace(settings, steps=steps)
    scenes = scenes or load_training_scenes(collection, sources)
    initial = sa_sm.initial_shape_model(architecture, settings, len(scenes), seed)
    optimizer = adam(initial, sa_sm.rates(settings, 0))

    def step(number: int) -> dict[str, float]:
        batch = sa_sm.draw_batch(scenes, settings, np.random.default_rng([seed, 2, number]))
        return sa_sm.training_step(architecture, sa_sm.weights_at(settings, number), optimizer, batch)

    def picture(path: Path, parameters: dict[str, np.ndarray]) -> None:
        shape_picture(path, architecture, parameters, scenes, seed)

    return run_training(
        out,
        "shape",
        sa_sm.all_steps(settings),
        optimizer,
        lambda k: sa_sm.rates(settings, k),
        step,
        weights={name: getattr(settings, name) for name in SHAPE_TERMS},
        description=describe(architecture, settings, seed, sources),
        picture=picture,
        picture_steps=picture_steps,
    )


def train_appearance(
    collection: Path,
    out: Path,
    *,
    steps: int | None = None,
    seed: int = 0,
    without: str | None = None,
    sizes: dict[str, int] | None = None,
    picture_steps: int = 1000,
    sources: Sequence[str] = (),
    scenes: list | None = None,
) -> None:
    """Trains the AF-SM on the SA-SM of `out/shape.checkpoint`, whose architecture it takes over; writes
    `out/prior.safetensors`. `sizes` may change the networks of the AF-SM and of the refinement only; `sources`
    and `scenes` are as in `train_shape`."""
    checkpoint = out / "shape.checkpoint"
    if not checkpoint.exists():
        raise InputError(f"{checkpoint} is missing; run python -m sira_mi.training shape first")
    shape, metadata = read_parameters(checkpoint)
    trained = read_architecture(metadata, checkpoint)
    architecture = with_sizes(trained, sizes or {})
    frozen_sizes = ("features", "sdf_", "rendering_")
    for name in sizes or {}:
        if name.startswith(frozen_sizes) and getattr(trained, name) != getattr(architecture, name):
            raise InputError(f"--architecture: {checkpoint} was trained with {name}={getattr(trained, name)}")
    settings = without_term(af_sm.AppearanceTraining(), APPEARANCE_TERMS, without)
    if steps is not None:
        settings = dataclasses.replace(settings, steps=steps)
    scenes = scenes or load_training_scenes(collection, sources)
    if any(shape[name].shape != (architecture.networks[name].parameters,) for name in NETWORKS):
        raise InputError(f"{checkpoint} does not fit its architecture; train it again")
    if any(shape[name].shape != (architecture.latents[name], len(scenes)) for name in LATENTS):
        raise InputError(f"{out} was trained on {shape[LATENTS[0]].shape[1]} scenes, {collection} has {len(scenes)}")
    frozen = [
        af_sm.freeze_scene(architecture, head_of(shape, k), scene, settings, np.random.default_rng([seed, 5, k]))
        for k, scene in enumerate(scenes)
    ]
    initial = af_sm.initial_appearance_model(architecture, len(scenes), seed)
    optimizer = adam(initial, af_sm.rates(settings, 0))

    def step(number: int) -> dict[str, float]:
        batch = af_sm.draw_batch(frozen, settings, np.random.default_rng([seed, 3, number]))
        return af_sm.training_step(architecture, settings, optimizer, batch)

    appearance = run_training(
        out,
        "appearance",
        settings.steps,
        optimizer,
        lambda k: af_sm.rates(settings, k),
        step,
        weights={name: getattr(settings, name) for name in APPEARANCE_TERMS},
        description=describe(architecture, settings, seed, sources),
        picture=AppearancePicture(architecture, shape, scenes, settings.roughness).write,
        picture_steps=picture_steps,
    )
    landmarks = np.stack([scene.landmarks for scene in scenes])
    save_avatar(out / "prior.safetensors", assemble_prior(architecture, shape, appearance, landmarks, settings, seed))
