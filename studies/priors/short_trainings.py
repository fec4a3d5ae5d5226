"""Short trainings of the SA-SM that differ in one loss term or one size, all measured alike.

The trainings are those of `python -m sira_mi.training shape`; each has its own folder and resumes from its checkpoint.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from functools import lru_cache
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from sira_mi.avatar.architecture import AvatarArchitecture
from sira_mi.avatar.shape import SHAPE_NETWORKS, SHAPE_PARAMETERS, HeadShape
from sira_mi.fields.columns import evaluate_in_chunks
from sira_mi.fields.sdf import signed_distance, surface
from sira_mi.optimisation import losses
from sira_mi.portrait.landmarks import NOSE_TIP
from sira_mi.training.loop import read_parameters
from sira_mi.training.scenes import TrainingScene, load_training_scenes
from sira_mi.training.shape_model import ShapeModel
from sira_mi.training.train import SHAPE_TERMS, read_architecture, train_shape
from studies.cache import fingerprint, load_or_compute
from studies.priors import shape_measures
from studies.priors.shape_measures import Scan, ShapeFit

COMPLETE = "complete"
_VERSION = "1"

# The sizes that are varied, one at a time around the architecture's own.
SIZES = {
    "sdf_width": (64, 96, 128),
    "sdf_depth": (3, 4, 5),
    "sdf_latent": (32, 64, 128),
    "sdf_octaves": (4, 6),
    "features": (8, 16),
}


@dataclass(frozen=True)
class Protocol:
    """How every short training is measured."""

    scans: int = 16  # of the test split, evenly spread
    points: int = 3000  # of each scan
    heads: int = 8  # random ones at 1σ
    cost_points: int = 16384  # points of a timed evaluation
    fit: ShapeFit = field(default_factory=ShapeFit)
    color_steps: int = 200  # of the fit of z_r


def architectures() -> dict[str, dict[str, int]]:
    """The trainings of the table of sizes: by name the sizes that differ from AvatarArchitecture's."""
    default = AvatarArchitecture()
    variations = {
        f"{name}_{value}": {name: value}
        for name, values in SIZES.items()
        for value in values
        if value != getattr(default, name)
    }
    return {COMPLETE: {}, **variations}


def read_model(checkpoint: Path) -> tuple[ShapeModel, dict[str, np.ndarray]]:
    """A trained SA-SM and its parameters from a checkpoint of the train command. Raises InputError."""
    parameters, metadata = read_parameters(checkpoint)
    return ShapeModel.of_training(read_architecture(metadata, checkpoint), parameters), parameters


def ablation(collection: Path, evidence: Path, without: str | None, steps: int, protocol: Protocol) -> dict:
    """Trains the SA-SM without a loss term (or completely) for `steps` and measures it: `face` and `head` (mm),
    `angle` (degrees), `landmark` (mm), `color`, and the shares `gradient` and `connected` of random heads."""
    name = COMPLETE if without is None else f"without_{without}"

    def measure(model: ShapeModel, scans: list[Scan]) -> dict:
        w = shape_measures.fit_shape(model, [scan.scene for scan in scans], protocol.fit)
        latents = np.stack([model.latent("z_sdf", w[:, k]) for k in range(len(scans))], axis=1)
        rows, _ = shape_measures.random_heads(model, 1.0, protocol.heads)
        landmarks = np.stack([scan.scene.landmarks for scan in scans])
        return {
            **fit_scores(model, scans, w, protocol.points),
            "landmark": shape_measures.landmark_spread(model, latents, landmarks)["deformed"],
            "color": float(np.mean(shape_measures.color_errors(model, scans, w, protocol.color_steps))),
            "gradient": float(np.mean([row["gradient"] for row in rows])),
            "connected": float(np.mean([row["parts"] == 1 for row in rows])),
            "sizes": {size: getattr(model.architecture, size) for size in SIZES},
        }

    return _trained(collection, evidence / "ablations", name, steps, protocol, measure, without=without)


def size(collection: Path, evidence: Path, name: str, sizes: dict[str, int], steps: int, protocol: Protocol) -> dict:
    """Trains the SA-SM with some `sizes` for `steps` and measures `face` and `head` (mm), `angle` (degrees),
    `parameters` of the field, and the cost of its evaluation, `forward` and `backward` (µs a point)."""

    def measure(model: ShapeModel, scans: list[Scan]) -> dict:
        w = shape_measures.fit_shape(model, [scan.scene for scan in scans], protocol.fit)
        forward, backward = evaluation_cost(model, protocol.cost_points)
        return {
            **fit_scores(model, scans, w, protocol.points),
            "parameters": sum(len(model.networks[network]) for network in SHAPE_NETWORKS),
            "forward": forward,
            "backward": backward,
            "sizes": {size: getattr(model.architecture, size) for size in SIZES},
        }

    return _trained(collection, evidence / "sizes", name, steps, protocol, measure, sizes=sizes)


def _trained(collection: Path, folder: Path, name: str, steps: int, protocol: Protocol, measure, **options) -> dict:
    """Trains into `folder/name_steps`, then measures, each unless that is done already; `options` are of
    `train_shape`."""
    run = folder / f"{name}_{steps}"
    train_shape(collection, run, steps=steps, picture_steps=steps, scenes=training_scenes(collection), **options)
    checkpoint = run / "shape.checkpoint"

    def result() -> dict:
        model, _ = read_model(checkpoint)
        scans = shape_measures.load_scans(collection, mean_nose(collection), protocol.scans)
        return {"name": name, "steps": steps, "scans": len(scans), **measure(model, scans), "seconds": seconds(run)}

    key = fingerprint(_VERSION, checkpoint, collection / "manifest.json", json.dumps(asdict(protocol)))
    return load_or_compute(folder / f"{name}_{steps}.json", key, result)


@lru_cache(maxsize=1)
def training_scenes(collection: Path) -> list[TrainingScene]:
    """The training scenes of a collection, kept from one short training to the next."""
    return load_training_scenes(collection)


def mean_nose(collection: Path) -> np.ndarray:
    """The nose tip [3] of the training scenes, on average."""
    return np.nanmean(shape_measures.load_landmarks(collection)[:, NOSE_TIP], axis=0)


def seconds(run: Path, model: str = "shape") -> float:
    """Training time in the log of a run."""
    try:
        lines = (run / f"{model}.log").read_text().splitlines()
        return float(sum(json.loads(line).get("seconds", 0.0) for line in lines))
    except (OSError, ValueError):
        return 0.0


def fit_scores(model: ShapeModel, scans: Sequence[Scan], w: np.ndarray, points: int) -> dict[str, float]:
    """Mean distance (mm) of scan points to the surfaces of `w` [k, S], `face` and `head` (without hair), and the mean
    angle (degrees) of normals on the head without hair."""
    errors = [
        shape_measures.scan_errors(model.field(model.latent("z_sdf", w[:, k])), scan, points)
        for k, scan in enumerate(scans)
    ]
    return {
        "face": float(np.mean([e["distance"]["face"]["mean"] for e in errors])),
        "head": float(np.nanmean([e["distance"]["head without hair"]["mean"] for e in errors])),
        "angle": float(np.nanmean([e["angle"]["head without hair"]["mean"] for e in errors])),
    }


def evaluation_cost(model: ShapeModel, points: int, repeats: int = 7) -> tuple[float, float]:
    """Microseconds a point, the shortest of some repeats after two that compile: of the signed distance alone, and of
    distance and gradient with the derivative of a loss on both by all parameters."""
    x = np.random.default_rng(0).uniform(-1.5, 1.5, (3, points)).astype(np.float32)
    field = model.field(model.means["z_sdf"])

    def forward() -> None:
        evaluate_in_chunks(lambda p: signed_distance(field, p), x)

    def backward() -> None:
        values = {name: mi.Float((model.networks | model.means)[name]) for name in SHAPE_PARAMETERS}
        dr.enable_grad(values)
        f, gradient, _, _ = surface(HeadShape(model.architecture).field(values), mi.TensorXf(x))
        dr.backward(losses.surface_loss(f) + losses.eikonal_loss(gradient))
        dr.eval([dr.grad(v) for v in values.values()])
        dr.sync_thread()

    return _shortest(forward, repeats) / points * 1e6, _shortest(backward, repeats) / points * 1e6


def _shortest(function: Callable[[], None], repeats: int) -> float:
    times = []
    for _ in range(repeats + 2):
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return min(times[2:])


def run_ablations(collection: Path, evidence: Path, steps: int, protocol: Protocol | None = None) -> list[dict]:
    """The complete training and one without each loss term, all of `steps`; the results, which are also cached."""
    return [ablation(collection, evidence, without, steps, protocol or Protocol()) for without in (None, *SHAPE_TERMS)]


def run_sizes(collection: Path, evidence: Path, steps: int, protocol: Protocol | None = None) -> list[dict]:
    """One training of `steps` for each of `architectures`; the results, which are also cached."""
    return [
        size(collection, evidence, name, sizes, steps, protocol or Protocol())
        for name, sizes in architectures().items()
    ]
