"""Measures the appearance part of a prior on unseen heads, and short AF-SM trainings without single loss terms. Results
are kept on disk."""

import dataclasses
import json
import shutil
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from time import monotonic

import numpy as np

from sira_mi.avatar.file import Avatar, load_avatar
from sira_mi.errors import InputError
from sira_mi.files import write_png
from sira_mi.training.af_sm import AppearanceTraining
from sira_mi.training.loop import read_parameters
from sira_mi.training.prior import whitening
from sira_mi.training.scenes import TrainingScene, load_scene
from sira_mi.training.train import APPEARANCE_TERMS, train_appearance
from studies.cache import fingerprint, load_or_compute, read
from studies.measures import spread_indices
from studies.priors import appearance_measures
from studies.priors.appearance_measures import HeldOut, LatentFit
from studies.priors.shape_measures import manifest_entries
from studies.priors.short_trainings import COMPLETE, read_model, seconds, training_scenes

_VERSION = "1"
_BASELINE_SCENES = 64  # training scenes whose mean albedo is a baseline


@dataclass(frozen=True)
class AppearanceMeasures:
    """Sizes of the measurements."""

    scans: int = 58  # of the test split
    imaged: int = 16  # of them compared as images
    pictured: int = 6  # of them in the picture
    training_scenes: int = 32  # re-rendered with the latents of the training
    fit: LatentFit = field(default_factory=LatentFit)


def measure_appearance_prior(collection: Path, runs: Path, measures: AppearanceMeasures | None = None) -> dict:
    """Fits appearance latents to test scans whose shape latents RUNS/evidence/fits.json holds and scores them; writes
    `appearance.json` and `prior_appearance.png` to RUNS/evidence. Raises InputError when a file is missing."""
    measures = measures or AppearanceMeasures()
    evidence = runs / "evidence"
    key = fingerprint(
        _VERSION,
        collection / "manifest.json",
        runs / "prior.safetensors",
        evidence / "fits.json",
        json.dumps(asdict(measures)),
    )
    picture = evidence / "prior_appearance.png"

    def result() -> dict:
        start = monotonic()
        prior = load_avatar(runs / "prior.safetensors")
        held_out, scenes, z_sdf = _test_scans(collection, evidence, measures.scans)
        scores = score_prior(prior, collection, held_out, scenes, z_sdf, measures.fit)
        imaged = spread_indices(len(held_out), measures.imaged)
        views = {}
        for k in imaged:
            latents = _column(scores["latents"], k)
            views[k] = appearance_measures.render_views(prior, latents, z_sdf[:, k], held_out[k])
        images = [appearance_measures.image_scores(views[k], held_out[k], scores["baseline"]) for k in imaged]
        shown = [imaged[k] for k in spread_indices(len(imaged), measures.pictured)]
        write_png(
            picture, appearance_measures.appearance_sheet([held_out[k] for k in shown], [views[k][0] for k in shown])
        )
        return {
            "scans": len(held_out),
            "imaged": len(imaged),
            "points": appearance_measures.mean_scores(scores["rows"]),
            "images": appearance_measures.mean_scores(images),
            "by_source": appearance_measures.mean_scores_by(held_out, scores["rows"], "source"),
            "by_group": appearance_measures.mean_scores_by(held_out, scores["rows"], "group"),
            "training": _training_scores(prior, collection, runs, measures.training_scenes),
            "fit": asdict(measures.fit),
            "seconds": round(monotonic() - start, 1),
        }

    return load_or_compute(evidence / "appearance.json", key, result, (picture,))


def score_prior(
    prior: Avatar,
    collection: Path,
    held_out: Sequence[HeldOut],
    scenes: Sequence[TrainingScene],
    z_sdf: np.ndarray,
    fit: LatentFit,
) -> dict:
    """`latents` [dim, S] of the scans, the `baseline` of training scenes, and the scores of each scan at points,
    `rows`."""
    train = manifest_entries(collection, "train")
    chosen = [train[k] for k in spread_indices(len(train), _BASELINE_SCENES)]
    baseline = appearance_measures.training_baseline([_load(collection, entry) for entry in chosen])
    latents = appearance_measures.fit_appearance_latents(prior, scenes, z_sdf, AppearanceTraining(), fit)
    rows = [
        appearance_measures.render_scores(prior, _column(latents, k), z_sdf[:, k], scan)
        | appearance_measures.point_scores(prior, _column(latents, k), z_sdf[:, k], scan, baseline)
        for k, scan in enumerate(held_out)
    ]
    return {"latents": latents, "baseline": baseline, "rows": rows}


def run_appearance_ablations(collection: Path, runs: Path, steps: int, scans: int = 16) -> list[dict]:
    """Short AF-SM trainings on the run's SA-SM: with all terms, and with one λ at zero; the results, which are also
    cached in RUNS/evidence/appearance_ablations."""
    return [_ablation(collection, runs, without, steps, scans) for without in (None, *APPEARANCE_TERMS)]


def _ablation(collection: Path, runs: Path, without: str | None, steps: int, scans: int) -> dict:
    name = COMPLETE if without is None else f"without_{without}"
    folder = runs / "evidence" / "appearance_ablations"
    run = folder / f"{name}_{steps}"
    run.mkdir(parents=True, exist_ok=True)
    if not (run / "shape.checkpoint").exists():
        shutil.copyfile(runs / "shape.checkpoint", run / "shape.checkpoint")
    scenes = training_scenes(collection)
    train_appearance(collection, run, steps=steps, without=without, picture_steps=steps, scenes=scenes)

    def result() -> dict:
        held_out, scenes, z_sdf = _test_scans(collection, runs / "evidence", scans)
        prior = load_avatar(run / "prior.safetensors")
        rows = score_prior(prior, collection, held_out, scenes, z_sdf, LatentFit())["rows"]
        scores = appearance_measures.mean_scores(rows)
        return {"name": name, "steps": steps, "scans": len(held_out), **scores, "seconds": seconds(run, "appearance")}

    key = fingerprint(_VERSION, run / "prior.safetensors", collection / "manifest.json", str(scans))
    return load_or_compute(folder / f"{name}_{steps}.json", key, result)


def _test_scans(collection: Path, evidence: Path, limit: int) -> tuple[list[HeldOut], list[TrainingScene], np.ndarray]:
    """Test scans evenly spread over the split, and their shape latents [dim, S] from the fits of `shape_evidence`."""
    stored = read(evidence / "fits.json")
    if stored is None:
        raise InputError(f"{evidence / 'fits.json'} is missing; run python -m studies.priors measure")
    fits = stored["result"]
    place = {row["name"]: k for k, row in enumerate(fits["scans"])}
    entries = [entry for entry in manifest_entries(collection, "test") if Path(entry["file"]).name in place]
    entries = [entries[k] for k in spread_indices(len(entries), limit)]
    columns = [place[Path(entry["file"]).name] for entry in entries]
    scenes = [load_scene(collection / Path(entry["file"]).name) for entry in entries]
    return [_load(collection, entry) for entry in entries], scenes, np.array(fits["w"], np.float32)[:, columns]


def _training_scores(prior: Avatar, collection: Path, runs: Path, count: int) -> dict[str, float]:
    """Re-rendering of held-out views of training scenes with the latents of the training."""
    _, shape = read_model(runs / "shape.checkpoint")
    appearance, _ = read_parameters(runs / "appearance.checkpoint")
    mean, spread = whitening(shape["z_sdf"])
    z_sdf = (np.linalg.pinv(spread) @ (shape["z_sdf"] - mean[:, None])).astype(np.float32)
    latents = appearance_measures.training_latents(appearance)
    entries = manifest_entries(collection, "train")
    return appearance_measures.mean_scores(
        [
            appearance_measures.render_scores(prior, _column(latents, k), z_sdf[:, k], _load(collection, entries[k]))
            for k in spread_indices(len(entries), count)
        ]
    )


def _load(collection: Path, entry: dict) -> HeldOut:
    group = entry.get("group") or {}
    path = collection / Path(entry["file"]).name
    held_out = appearance_measures.load_held_out(path, str(entry.get("source", "")), str(group.get("ancestry", "")))
    return dataclasses.replace(held_out, name=path.name)


def _column(latents: dict[str, np.ndarray], k: int) -> dict[str, np.ndarray]:
    return {name: np.ascontiguousarray(value[:, k]) for name, value in latents.items()}
