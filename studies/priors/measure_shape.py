"""Measures the shape part of a prior on unseen heads and draws the pictures. Results are kept on disk."""

import json
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from time import monotonic

import numpy as np

from sira_mi.avatar.file import load_avatar
from sira_mi.errors import InputError
from sira_mi.fields.extraction import EmptySurfaceError
from sira_mi.files import write_png
from sira_mi.training.pictures import extract_surface, head_tile, scan_tile, sheet
from sira_mi.training.shape_model import ShapeModel
from studies.cache import fingerprint, load_or_compute
from studies.priors import shape_measures
from studies.priors.shape_measures import Scan, ShapeFit
from studies.priors.short_trainings import mean_nose, read_model, seconds

_VERSION = "1"
_PICTURED = 8  # scans in the picture of fits


@dataclass(frozen=True)
class Measures:
    """Sizes of the measurements."""

    scans: int | None = None  # of the test split; all when None
    points: int = 6000  # of each scan and of each surface
    heads: int = 32  # random ones at each of 1σ and 2σ
    fit: ShapeFit = field(default_factory=ShapeFit)
    color_steps: int = 200  # of the fit of z_r


def measure_shape_prior(collection: Path, runs: Path, measures: Measures | None = None) -> None:
    """Measures `runs/prior.safetensors` on the test split of `collection` and writes `collection`, `training`, `fits`,
    `heads` and `landmarks` as JSON, and pictures, to `runs/evidence`. Raises InputError when a file is missing."""
    measures = measures or Measures()
    for name, command in (("shape.checkpoint", "shape"), ("prior.safetensors", "appearance")):
        if not (runs / name).exists():
            raise InputError(f"{runs / name} is missing; run python -m sira_mi.training {command} first")
    evidence, manifest = runs / "evidence", collection / "manifest.json"
    evidence.mkdir(exist_ok=True)
    prior = ShapeModel.of_prior(load_avatar(runs / "prior.safetensors"))
    trained, parameters = read_model(runs / "shape.checkpoint")
    shape_measures.manifest_entries(collection, "test")
    key = fingerprint(
        _VERSION, manifest, runs / "shape.checkpoint", runs / "prior.safetensors", json.dumps(asdict(measures))
    )

    def part(name: str, compute: Callable[[], dict], *pictures: str) -> dict:
        start = monotonic()

        def timed() -> dict:
            return {**compute(), "seconds": round(monotonic() - start, 1)}

        return load_or_compute(evidence / f"{name}.json", key, timed, tuple(evidence / picture for picture in pictures))

    part("collection", lambda: _collection(collection))
    part("training", lambda: _training(runs, parameters))
    scans = shape_measures.load_scans(collection, mean_nose(collection), measures.scans)
    fits = part("fits", lambda: _fits(prior, scans, measures, evidence / "prior_fits.png"), "prior_fits.png")
    part("heads", lambda: _heads(prior, measures.heads, evidence), "prior_samples_1.png", "prior_samples_2.png")
    part("directions", lambda: _directions(trained, evidence / "prior_directions.png"), "prior_directions.png")
    w = np.array(fits["w"], np.float32)
    part("landmarks", lambda: _landmarks(prior, trained, parameters, w, scans, collection))


def _collection(collection: Path) -> dict:
    """Counts of scenes by split and trait."""
    result: dict[str, int | dict[str, int]] = {}
    for split in ("train", "test"):
        entries = shape_measures.manifest_entries(collection, split)
        result[split] = len(entries)
        result[f"{split}_sources"] = dict(Counter(str(entry.get("source", "makehuman")) for entry in entries))
    return result


def _training(runs: Path, parameters: dict[str, np.ndarray]) -> dict:
    """Steps and time of both trainings by their logs, and the last line of terms."""
    result = {"scenes": parameters["z_sdf"].shape[1]}
    for model in ("shape", "appearance"):
        log = runs / f"{model}.log"
        lines = log.read_text().splitlines() if log.exists() else []
        result[model] = {**(json.loads(lines[-1]) if lines else {}), "seconds": seconds(runs, model)}
    return result


def _fits(model: ShapeModel, scans: list[Scan], measures: Measures, picture: Path) -> dict:
    start = monotonic()
    w = shape_measures.fit_shape(model, [scan.scene for scan in scans], measures.fit)
    fitting = monotonic() - start
    zero = model.field(model.latent("z_sdf", 0 * w[:, 0]))
    zero_points = _surface_points(zero, measures.points)
    rows: list[dict] = []
    tiles: list[tuple[np.ndarray, np.ndarray]] = []
    for k, scan in enumerate(scans):
        fitted = model.field(model.latent("z_sdf", w[:, k]))
        row = {"name": scan.name, "traits": scan.traits, "rms_w": float(np.sqrt(np.mean(w[:, k] ** 2)))}
        points = _surface_points(fitted, measures.points)
        for name, head, on_surface in (("fitted", fitted, points), ("mean_head", zero, zero_points)):
            errors = shape_measures.scan_errors(head, scan, measures.points)
            row[name] = {**errors, "to_scan": shape_measures.surface_errors(on_surface, scan)}
        rows.append(row)
        if len(tiles) < _PICTURED:
            tiles.append((scan_tile(scan.scene.points, scan.scene.normals), head_tile(fitted)))
    write_png(picture, sheet([[tile[0] for tile in tiles], [tile[1] for tile in tiles]]))
    colors = shape_measures.color_errors(model, scans, w, measures.color_steps)
    return {
        "fit": asdict(measures.fit),
        "points": measures.points,
        "spacing": float(np.median([shape_measures.spacing(scan.scene.points) for scan in scans])),
        "fitting_seconds": round(fitting, 1),
        "color": float(np.mean(colors)),
        "scans": rows,
        "w": [[round(float(v), 5) for v in row] for row in w],
    }


def _surface_points(field, count: int) -> np.ndarray:
    """Points [count, 3] on a field's surface above the shoulders; none where there is no surface."""
    try:
        return shape_measures.surface_samples(field, extract_surface(field, shape_measures.VOXEL), count)
    except EmptySurfaceError:
        return np.zeros((0, 3), np.float32)


def _heads(model: ShapeModel, count: int, evidence: Path) -> dict:
    result = {}
    for sigma in (1, 2):
        rows, tiles = shape_measures.random_heads(model, float(sigma), count, seed=sigma)
        write_png(evidence / f"prior_samples_{sigma}.png", sheet([tiles[k : k + 8] for k in range(0, count, 8)]))
        result[str(sigma)] = rows
    return result


def _directions(model: ShapeModel, picture: Path) -> dict:
    """The mean head and the first principal directions of the training's latents, ±2σ."""
    basis = model.bases["z_sdf"]
    count = min(5, basis.shape[1])
    heads = [
        [head_tile(model.field(model.latent("z_sdf", sign * 2 * np.eye(basis.shape[1])[k]))) for k in range(count)]
        for sign in (-1, 1)
    ]
    mean = head_tile(model.field(model.means["z_sdf"]))
    write_png(picture, sheet([[mean, *heads[0]], [mean, *heads[1]]]))
    variances = (basis.astype(np.float64) ** 2).sum(axis=0)
    return {"count": count, "share": float(variances[:count].sum() / variances.sum())}


def _landmarks(
    prior: ShapeModel,
    trained: ShapeModel,
    parameters: dict[str, np.ndarray],
    w: np.ndarray,
    scans: list[Scan],
    collection: Path,
) -> dict:
    latents = np.stack([prior.latent("z_sdf", w[:, k]) for k in range(len(scans))], axis=1)
    training = shape_measures.load_landmarks(collection)
    if len(training) != parameters["z_sdf"].shape[1]:
        raise InputError(f"{collection} has {len(training)} training scenes, the run {parameters['z_sdf'].shape[1]}")
    return {
        "test": shape_measures.landmark_spread(prior, latents, np.stack([scan.scene.landmarks for scan in scans])),
        "train": shape_measures.landmark_spread(trained, parameters["z_sdf"], training),
    }
