"""How well a prior reaches heads that it has not seen: `python benchmarks/prior_error.py COLLECTION [--prior FILE]`.

Only the shape latent is fitted to each test scan of a collection. Printed are distances |f| / |∇f| in mm at true
surface points, on the face (95 mm around the nose tip) and on the whole head above the shoulders, the mean head's
beside them. The scans are in the prior's own frame; nothing is aligned."""

import argparse
import json
from pathlib import Path

import sira_mi  # noqa: F401  (before Dr.Jit, which must find LLVM)

# isort: split
import drjit as dr
import mitsuba as mi
import numpy as np

from sira_mi.conventions import MILLIMETRES_PER_UNIT
from sira_mi.fields.mlp import layers
from sira_mi.fields.sdf import SdfField, evaluate_in_chunks, signed_distance, surface
from sira_mi.models import losses
from sira_mi.models.avatar import load_avatar
from sira_mi.models.optimisation import adam
from sira_mi.models.scenes import load_scene

NOSE_TIP = 4
STEPS, POINTS = 300, 1024


def field_of(avatar, z) -> SdfField:
    """The prior's field at shape latent z (Float)."""
    networks = avatar.architecture.networks
    return SdfField(
        layers(networks["deformation"], mi.Float(avatar.tensors["deformation"]), mi.TensorXf(z, (len(z), 1))),
        layers(networks["reference"], mi.Float(avatar.tensors["reference"])),
        avatar.architecture.sdf_octaves,
    )


def fit_latent(avatar, points: np.ndarray, seed: int) -> np.ndarray:
    """The shape latent that brings surface points [P, 3] nearest to the zero level."""
    optimizer = adam({"z": np.zeros_like(avatar.tensors["z_sdf"])}, {"z": 2e-2})
    rng = np.random.default_rng(seed)
    for step in range(STEPS):
        optimizer.set_learning_rate({"z": 2e-2 * (1 - 0.9 * step / STEPS)})
        z = optimizer["z"]
        dr.enable_grad(z)
        chosen = np.ascontiguousarray(points[rng.integers(len(points), size=POINTS)].T)
        loss = losses.surface_loss(signed_distance(field_of(avatar, z), mi.TensorXf(chosen)))
        dr.backward(loss + 1e-5 * dr.sum(z * z))
        optimizer.step()
    return optimizer["z"].numpy()


def distances(avatar, z: np.ndarray, points: np.ndarray) -> np.ndarray:
    """|f| / |∇f| in mm at points [P, 3]."""
    field = field_of(avatar, mi.Float(z))
    f, gradient = evaluate_in_chunks(lambda x: surface(field, x)[:2], points.T)
    return np.abs(f[0]) / np.maximum(np.linalg.norm(gradient, axis=0), 1e-3) * MILLIMETRES_PER_UNIT


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split(":")[0])
    parser.add_argument("collection", type=Path)
    parser.add_argument("--prior", type=Path)
    arguments = parser.parse_args()
    mi.set_variant("llvm_ad_rgb")
    avatar = load_avatar(arguments.prior)
    manifest = json.loads((arguments.collection / "manifest.json").read_text())
    print("| scan | face, fitted | face, mean head | head, fitted | head, mean head |\n| --- | --- | --- | --- | --- |")
    rows = []
    for entry in manifest["scenes"]:
        if entry["split"] != "test":
            continue
        scene = load_scene(arguments.collection / entry["file"])
        nose = (
            scene.landmarks[NOSE_TIP]
            if np.isfinite(scene.landmarks[NOSE_TIP]).all()
            else avatar.tensors["landmarks"][NOSE_TIP]
        )
        face = np.linalg.norm(scene.points - nose, axis=1) * MILLIMETRES_PER_UNIT < 95
        head = scene.points[:, 1] > -1.3
        z = fit_latent(avatar, scene.points, seed=0)
        fitted, mean = distances(avatar, z, scene.points), distances(avatar, np.zeros_like(z), scene.points)
        rows.append([fitted[face].mean(), mean[face].mean(), fitted[head].mean(), mean[head].mean()])
        print(f"| {entry['file']} | " + " | ".join(f"{v:.2f}" for v in rows[-1]) + " |")
    print("| mean of all | " + " | ".join(f"{v:.2f}" for v in np.mean(rows, axis=0)) + " | (mm)")


if __name__ == "__main__":
    main()
