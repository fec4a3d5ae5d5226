"""The figures of `docs/data/portraits.json`: means over portraits of the rows of `compare_methods.compare`."""

from collections.abc import Sequence

import numpy as np

from sira_mi.fit.geometry import GeometryStage
from sira_mi.fit.settings import QUALITIES
from studies.portraits.compare_methods import MEAN_HEAD
from studies.portraits.methods import BY_NAME

GEOMETRY_METHOD, SHIPPED = "a.4", "b.3"  # the shipped fit: its geometry stages, and the stages after them
GEOMETRY_SCORES = (
    "h3ds_face_mean",
    "h3ds_face_truth_to_prediction_mean",
    "h3ds_face_truth_to_prediction_median",
    "h3ds_face_truth_to_prediction_p90",
    "h3ds_face_prediction_to_truth_mean",
    "camera_face_mean",
    "h3ds_head_mean",
    "h3ds_hidden_mean",
    "normals_mean",
    "silhouette_iou",
)
APPEARANCE_SCORES = (
    "final_psnr",
    "final_ssim",
    "shaded_psnr",
    "diffuse_psnr",
    "diffuse_ssim",
    "diffuse_scaled_psnr",
    "specular_psnr",
    "specular_ssim",
    "skin_ciede2000_mean",
    "skin_scaled_ciede2000_mean",
    "leakage_shading",
    "leakage_shadow",
)


def summarise(shipped: Sequence[dict], ablations: Sequence[dict], quality: str, ablation_quality: str) -> dict:
    """The figures of the page: `portraits`, their number; `roles`, the names of the methods that the page refers to;
    `shipped` and `ablations`, scores and costs by method; the shipped fit's scores by light in `lights` and by portrait
    in `each`; and the fits that `failed`."""
    own = [row for row in shipped if row["method"] == SHIPPED]
    lights = sorted({row["light"] for row in own})
    mean_head = {row["portrait"]: row["scores"]["h3ds_face_mean"] for row in shipped if row["method"] == MEAN_HEAD}
    return {
        "portraits": len(mean_head),
        "roles": {"baseline": MEAN_HEAD, "geometry": GEOMETRY_METHOD, "shipped": SHIPPED},
        "shipped": _summarise_quality(shipped, quality),
        "ablations": _summarise_quality(ablations, ablation_quality),
        "lights": {light: _means([row for row in own if row["light"] == light]) for light in lights},
        "each": [
            {
                "portrait": row["portrait"],
                "light": row["light"],
                "mean_head_face": mean_head[row["portrait"]],
                **_means([row]),
            }
            for row in own
            if "scores" in row
        ],
        "failed": [
            {name: row[name] for name in ("portrait", "method", "error")}
            for row in (*shipped, *ablations)
            if "error" in row
        ],
    }


def _summarise_quality(rows: Sequence[dict], quality: str) -> dict:
    """Scores and costs by method, and the costs of whole fits: `fit_seconds`, median, and `fit_megabytes`, peak."""
    methods: dict[str, list[dict]] = {}
    for row in rows:
        methods.setdefault(row["method"], []).append(row)
    result: dict[str, dict] = {}
    for name, mine in methods.items():
        result[name] = {"title": "" if name == MEAN_HEAD else BY_NAME[name].title}
        if name == MEAN_HEAD or _moves_the_shape(name, quality):
            result[name]["geometry"] = _means(mine, GEOMETRY_SCORES)
        if name != MEAN_HEAD and BY_NAME[name].after is not None:
            result[name]["appearance"] = _means(mine, APPEARANCE_SCORES)
        if done := [row for row in mine if "seconds" in row]:
            result[name] |= {
                "seconds": float(np.median([row["total_seconds"] for row in done])),
                "megabytes": float(np.median([row["peak_memory_megabytes"] for row in done])),
                "stages": {
                    stage: float(np.median([row["seconds"].get(stage, 0) for row in done]))
                    for stage in done[0]["seconds"]
                },
            }
    return {"quality": quality, **_costs_of_whole_fits(methods), "methods": result}


def _moves_the_shape(method: str, quality: str) -> bool:
    return any(isinstance(s, GeometryStage) for s in BY_NAME[method].settings(QUALITIES[quality]).stages)


def _costs_of_whole_fits(methods: dict[str, list[dict]]) -> dict[str, float | None]:
    first, then = (
        {row["portrait"]: row for row in methods.get(name, ()) if "scores" in row}
        for name in (GEOMETRY_METHOD, SHIPPED)
    )
    both = [(first[name], row) for name, row in then.items() if name in first]
    if not both:
        return {"fit_seconds": None, "fit_megabytes": None}
    return {
        "fit_seconds": float(np.median([a["total_seconds"] + b["total_seconds"] for a, b in both])),
        "fit_megabytes": float(max(row["peak_memory_megabytes"] for pair in both for row in pair)),
    }


def _means(
    rows: Sequence[dict], scores: Sequence[str] = GEOMETRY_SCORES + APPEARANCE_SCORES
) -> dict[str, float | None]:
    """Means over rows; None for a score that is missing or NaN in one of them."""
    result: dict[str, float | None] = {}
    for score in scores:
        value = float(np.mean([row.get("scores", {}).get(score, np.nan) for row in rows])) if rows else np.nan
        result[score] = value if np.isfinite(value) else None
    return result
