"""`python -m sira_mi.train shape|appearance --collection DIR --out DIR`: trains the statistical models on a collection.

`shape` trains the SA-SM and writes `shape.checkpoint`; `appearance` trains the AF-SM on top of it and writes
`prior.safetensors`, which a fit takes with `--prior`. Both resume from their checkpoints.
"""

import argparse
import dataclasses
from pathlib import Path

import mitsuba as mi
import numpy as np

from sira_mi.errors import InputError, run_command


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m sira_mi.train", description=__doc__.split("\n")[0])
    parser.add_argument("model", choices=("shape", "appearance"))
    parser.add_argument("--collection", type=Path, required=True, help="folder of python -m sira_mi.collection build")
    parser.add_argument("--out", type=Path, required=True, help="folder for checkpoints, logs and the prior")
    parser.add_argument("--steps", type=int, help="number of steps (default: the model's)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--variant", default="llvm_ad_rgb", help="Mitsuba variant")
    arguments = parser.parse_args()
    mi.set_variant(arguments.variant)
    train = train_shape if arguments.model == "shape" else train_appearance
    train(arguments.collection, arguments.out, arguments.steps, arguments.seed)


def train_shape(collection: Path, out: Path, steps: int | None, seed: int) -> dict[str, np.ndarray]:
    """Trains the SA-SM; returns its networks and latents [dim, scenes]."""
    from sira_mi.models import sa_sm
    from sira_mi.models.avatar import AvatarArchitecture
    from sira_mi.models.optimisation import adam
    from sira_mi.models.scenes import load_training_scenes
    from sira_mi.models.training import run_training

    architecture, settings = AvatarArchitecture(), sa_sm.ShapeTraining()
    if steps is not None:
        settings = dataclasses.replace(settings, steps=steps)
    scenes = load_training_scenes(collection)
    initial = sa_sm.initial_shape_model(architecture, settings, len(scenes), seed)
    optimizer = adam(initial, sa_sm.rates(settings, 0))

    def step(number: int) -> dict[str, float]:
        batch = sa_sm.draw_batch(scenes, settings, np.random.default_rng([seed, 2, number]))
        return sa_sm.training_step(architecture, settings, optimizer, batch)

    return run_training(out, "shape", settings.steps, optimizer, lambda k: sa_sm.rates(settings, k), step)


def train_appearance(collection: Path, out: Path, steps: int | None, seed: int) -> None:
    """Trains the AF-SM on the SA-SM of `out/shape.checkpoint`; writes `out/prior.safetensors`."""
    from sira_mi.models import af_sm
    from sira_mi.models.avatar import AvatarArchitecture, save_avatar
    from sira_mi.models.optimisation import adam, read_arrays
    from sira_mi.models.prior import assemble_prior
    from sira_mi.models.scenes import load_training_scenes
    from sira_mi.models.training import run_training

    architecture, settings = AvatarArchitecture(), af_sm.AppearanceTraining()
    if steps is not None:
        settings = dataclasses.replace(settings, steps=steps)
    scenes = load_training_scenes(collection)
    state, _ = read_arrays(out / "shape.checkpoint")
    shape = {name.removesuffix("/value"): value for name, value in state.items() if name.endswith("/value")}
    if shape["z_sdf"].shape[1] != len(scenes):
        raise InputError(f"{out} was trained on {shape['z_sdf'].shape[1]} scenes, {collection} has {len(scenes)}")
    frozen = [
        af_sm.freeze_scene(
            architecture, shape, shape["z_sdf"][:, k], scene, settings, np.random.default_rng([seed, 5, k])
        )
        for k, scene in enumerate(scenes)
    ]
    initial = af_sm.initial_appearance_model(architecture, len(scenes), seed)
    optimizer = adam(initial, af_sm.rates(settings, 0))

    def step(number: int) -> dict[str, float]:
        batch = af_sm.draw_batch(frozen, settings, np.random.default_rng([seed, 3, number]))
        return af_sm.training_step(architecture, settings, optimizer, batch)

    appearance = run_training(out, "appearance", settings.steps, optimizer, lambda k: af_sm.rates(settings, k), step)
    landmarks = np.stack([scene.landmarks for scene in scenes])
    save_avatar(
        out / "prior.safetensors", assemble_prior(architecture, shape, appearance, landmarks, settings.roughness, seed)
    )


if __name__ == "__main__":
    run_command(main)
