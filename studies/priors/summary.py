"""The figures of `docs/data/priors.json`: means over scans and heads of the measurements that RUNS/evidence holds."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sira_mi.avatar.file import AvatarArchitecture
from studies.cache import read
from studies.measures import average
from studies.priors.shape_measures import DISC_RADIUS, REGIONS
from studies.priors.short_trainings import COMPLETE, SIZES

TRAITS = ("source", "ancestry", "sex", "age")
# Scores of the appearance: name in the figures, then part, prefix and name in the measurement.
APPEARANCE_SCORES = {
    "render_psnr": ("points", "", "render_psnr"),
    "training_render_psnr": ("training", "", "render_psnr"),
    "albedo_psnr": ("points", "points_", "albedo_psnr"),
    "albedo_psnr_scaled": ("points", "points_", "albedo_psnr_scaled"),
    "face_albedo_psnr": ("points", "face_", "albedo_psnr"),
    "image_albedo_psnr": ("images", "image_", "albedo_psnr"),
    "image_albedo_ssim": ("images", "image_", "albedo_ssim"),
    "image_specular_psnr": ("images", "image_", "specular_psnr"),
    "image_specular_ssim": ("images", "image_", "specular_ssim"),
}


def summarise(evidence: Path) -> dict:
    """The figures of the page; None stands for a part that has not been measured.

    `collection` and `training`: heads, steps and minutes. `shape`: distances of fits to unseen scans in mm, by region
    and direction; `groups`: errors by trait. `random_heads` by σ, `directions`, `landmarks` in reference space.
    `appearance`: scores of fits to unseen scans, in dB, and their baselines. `ablations`, `appearance_ablations` and
    `sizes`: rows of short trainings, the complete one first."""
    fits, appearance = _result(evidence, "fits"), _result(evidence, "appearance")
    return {
        "collection": _collection(_result(evidence, "collection")),
        "training": _training(_result(evidence, "training")),
        "shape": fits and _shape(fits),
        "groups": fits and _groups(fits["scans"], appearance or {}),
        "random_heads": _random_heads(_result(evidence, "heads")),
        "directions": _result(evidence, "directions"),
        "landmarks": _result(evidence, "landmarks"),
        "appearance": appearance and _appearance(appearance),
        "ablations": _trainings(evidence / "ablations"),
        "appearance_ablations": _trainings(evidence / "appearance_ablations"),
        "sizes": _trainings(evidence / "sizes"),
        "shipped_sizes": {name: getattr(AvatarArchitecture(), name) for name in SIZES},
    }


def _result(evidence: Path, name: str) -> dict | None:
    stored = read(evidence / f"{name}.json")
    return stored and stored["result"]


def _trainings(folder: Path) -> list[dict] | None:
    """The results of a folder's files with as many steps as the newest one, the complete training first."""
    files = sorted(folder.glob("*.json"), key=lambda path: path.stat().st_mtime)
    results = [stored["result"] for stored in map(read, files) if stored]
    if not results:
        return None
    same = [r for r in results if r["steps"] == results[-1]["steps"]]
    return sorted(same, key=lambda r: (r["name"] != COMPLETE, r["name"]))


def _collection(data: dict | None) -> dict | None:
    return data and {
        split: {"heads": data[split], "sources": dict(sorted(data[f"{split}_sources"].items()))}
        for split in ("train", "test")
    }


def _training(data: dict | None) -> dict | None:
    return data and {
        name: {"steps": data[model].get("step"), "minutes": data[model]["seconds"] / 60}
        for model, name in (("shape", "SA-SM"), ("appearance", "AF-SM"))
    }


def _shape(data: dict) -> dict:
    rows = data["scans"]

    def regions(*path: str) -> dict:
        return {
            region: {
                head: {measure: average(rows, head, *path, region, measure) for measure in ("mean", "median", "p90")}
                for head in ("fitted", "mean_head")
            }
            for region in REGIONS
        }

    faces = [row["fitted"]["distance"]["face"]["mean"] for row in rows]
    worst = int(np.argmax(faces))
    return {
        "scans": len(rows),
        "points": data["points"],
        "fit": data["fit"],
        "fitting_seconds": data["fitting_seconds"],
        "spacing": data["spacing"],
        "disc_radius": DISC_RADIUS,
        "scan_to_surface": regions("distance"),
        "surface_to_scan": regions("to_scan"),
        "normals": {
            head: average(rows, head, "angle", "head without hair", "mean") for head in ("fitted", "mean_head")
        },
        "median_face": float(np.median(faces)),
        "worst": {"scan": rows[worst]["name"], "face": faces[worst]},
        "rms_w": average(rows, "rms_w"),
    }


def _groups(scans: Sequence[dict], appearance: dict) -> list[dict]:
    scores = {"source": appearance.get("by_source", {}), "ancestry": appearance.get("by_group", {})}
    result = []
    for trait in TRAITS:
        for group in sorted({row["traits"][trait] for row in scans}):
            rows = [row for row in scans if row["traits"][trait] == group]
            own = scores.get(trait, {}).get(group, {})
            result.append(
                {
                    "trait": trait,
                    "group": group,
                    "scans": len(rows),
                    "face": average(rows, "fitted", "distance", "face", "mean"),
                    "mean_head_face": average(rows, "mean_head", "distance", "face", "mean"),
                    "head": average(rows, "fitted", "distance", "head without hair", "mean"),
                    "mean_head_head": average(rows, "mean_head", "distance", "head without hair", "mean"),
                    **{name: own.get(name) for name in ("render_psnr", "face_albedo_psnr", "face_albedo_bias")},
                }
            )
    return result


def _random_heads(data: dict | None) -> dict | None:
    return data and {
        sigma: {
            "heads": len(data[sigma]),
            "connected": sum(row["parts"] == 1 for row in data[sigma]),
            "largest": min(row["largest"] for row in data[sigma]),
            "gradient": average(data[sigma], "gradient"),
            "worst_gradient": min(row["gradient"] for row in data[sigma]),
        }
        for sigma in ("1", "2")
    }


def _appearance(data: dict) -> dict:
    scores = {
        name: {
            head: data[where].get(f"{prefix}{kind}{score}")
            for head, kind in (("fitted", ""), ("mean_head", "mean_"), ("constant", "constant_"))
        }
        for name, (where, prefix, score) in APPEARANCE_SCORES.items()
    }
    points = data["points"]
    return {
        "scans": data["scans"],
        "imaged": data["imaged"],
        "scores": scores,
        **{name: points[name] for name in ("points_leakage", "face_leakage", "face_albedo_bias")},
    }
