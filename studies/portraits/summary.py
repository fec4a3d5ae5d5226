"""The figures of `docs/data/foreign.json` and `own.json`: scores of each row over the portraits of a benchmark."""

import math
from collections.abc import Mapping, Sequence

import numpy as np

from studies.portraits.relit_scores import PARTS, SHARES

MEAN_HEAD = "mean-head"  # names of the rows that are a mean head begin with it
REFERENCE = "draft"  # the row that all others are compared with, portrait by portrait
COMBINED = {"relit": ("relit_1", "relit_2"), "turned": ("turned_left", "turned_right")}
RELIT_SCORES = (
    *(f"{view}_{score}" for view in COMBINED for score in ("psnr", "ssim", "flip", "scaled_psnr")),
    *(f"relit_{part}_{score}" for part in PARTS for score in ("psnr", "ssim")),
    *(f"relit_share_{name}" for name in SHARES),
    "relit_missed",
    "relit_spill",
)
GEOMETRY_SCORES = (
    "h3ds_face_mean",
    "h3ds_face_truth_to_prediction_mean",
    "h3ds_face_prediction_to_truth_mean",
    "over_mean_head",
    "above_mean_head",
    "h3ds_ears_mean",
    "h3ds_head_mean",
    "normals_mean",
    "camera_face_mean",
    "camera_distance_error_size",
    "pose_error",
    "silhouette_iou",
)
APPEARANCE_SCORES = (
    "diffuse_psnr",
    "diffuse_ssim",
    "diffuse_scaled_psnr",
    "tone_bias",
    "tone_bias_size",
    "tone_ita_error",
    "tone_ita_error_size",
    "specular_psnr",
    "specular_gain",
    "leakage_shading",
    "final_psnr",
    "final_ssim",
    "shaded_psnr",
)
SCORES = RELIT_SCORES + GEOMETRY_SCORES + APPEARANCE_SCORES
# Of every portrait by itself, and of groups of portraits.
EACH_SCORES = ("relit_psnr", "relit_ssim", "turned_psnr", "h3ds_face_mean", "over_mean_head", "tone_bias")
GROUP_SCORES = ("relit_psnr", "relit_ssim", "h3ds_face_mean", "tone_bias", "tone_ita_error")
COSTS = {"cpu_seconds": np.median, "relight_cpu_seconds": np.median, "peak_memory_megabytes": np.max}
_HIGHER_IS_BETTER = ("psnr", "ssim", "iou", "gain")
_YAW_BANDS = (15.0, 30.0)  # degrees, edges
_DARKEST = 0.2  # share of the portraits
_DIGITS = 4


def summarise(rows: Sequence[dict], titles: Mapping[str, str]) -> dict:
    """The figures of results by `score_rows.score_rows`: dicts of `portrait`, `row`, its `entry` in `benchmark.json`,
    costs, `scores` of `score_row.score_portrait`, and the `error` of a row that failed. `titles` are those of the rows
    by name, in the order of the page.

    `portraits` and `identities` count; `groups` count the portraits by `tone`, `yaw`, `expression` and `hair`; `rows`
    by name, those that have been made: `title`, `count` of the portraits with scores, `mean`, `worst` and `darkest`
    (the mean over the fifth of the portraits whose skin is darkest) of `SCORES`, `to_draft` (the mean of how much
    `EACH_SCORES` are above those of the row `REFERENCE` on the same portraits), means of `GROUP_SCORES` by group in
    `by`, costs; `each` portrait: its groups and `EACH_SCORES` by row; `failed` rows with their `error`. A score that is
    NaN on a portrait does not count there; None where it is NaN on all.

    `relit_…` and `turned_…` are means of two views, `over_mean_head` is the face's distance over that of the better of
    the mean heads, `above_mean_head` 1 where it is more than 1, and `…_size` a score without its sign."""
    entries = {row["portrait"]: row["entry"] for row in rows}
    known: dict[str, dict[str, dict]] = {name: {} for name in titles}  # scores by row and portrait
    for row in rows:
        if "scores" in row:
            known[row["row"]][row["portrait"]] = _combine_views(row["scores"])
    mean_heads = _find_mean_heads(known)
    for scored in known.values():
        for portrait, scores in scored.items():
            scores |= _compare_with_mean_head(scores, mean_heads.get(portrait, math.nan))
    groups = {portrait: find_groups(entry) for portrait, entry in entries.items()}
    darkest = find_darkest(entries)
    return {
        "portraits": len(entries),
        "identities": len({entry["identity"] for entry in entries.values()}),
        "groups": _count_groups(list(groups.values())),
        "rows": {
            name: {
                "title": titles[name],
                "count": len(scored),
                "mean": average(list(scored.values()), SCORES),
                "worst": find_worst(list(scored.values()), SCORES),
                "darkest": average([scores for portrait, scores in scored.items() if portrait in darkest], SCORES),
                "to_draft": average(_subtract(scored, known.get(REFERENCE, {})), EACH_SCORES),
                "by": _average_groups(scored, groups),
                **_costs([row for row in rows if row["row"] == name]),
            }
            for name, scored in known.items()
            if scored
        },
        "each": [
            {
                "portrait": portrait,
                **groups[portrait],
                "scores": {
                    name: average([scored[portrait]], EACH_SCORES)
                    for name, scored in known.items()
                    if portrait in scored
                },
            }
            for portrait in entries
        ],
        "failed": [{name: row[name] for name in ("portrait", "row", "error")} for row in rows if "error" in row],
    }


def find_groups(entry: Mapping) -> dict[str, str]:
    """The groups that a portrait belongs to: its tone, how far it looks aside, expression, and whether it has hair."""
    yaw = abs(entry["yaw_degrees"])
    edges = (0.0, *_YAW_BANDS, math.inf)
    band = next(k for k in range(len(edges) - 1) if yaw < edges[k + 1])
    last = band == len(_YAW_BANDS)
    return {
        "tone": entry["tone"],
        "yaw": f"over {edges[band]:.0f}°" if last else f"{edges[band]:.0f} to {edges[band + 1]:.0f}°",
        "expression": entry.get("expression", "neutral"),
        "hair": "hair" if entry["hair"] else "no hair",
    }


def find_darkest(entries: Mapping[str, Mapping]) -> set[str]:
    """The fifth of the portraits, rounded up, whose skin is darkest; nothing where the benchmark does not say it."""
    levels = {name: entry["skin_luminance"] for name, entry in entries.items() if "skin_luminance" in entry}
    return set(sorted(levels, key=lambda name: levels[name])[: math.ceil(_DARKEST * len(levels))])


def average(portraits: Sequence[Mapping], names: Sequence[str]) -> dict[str, float | None]:
    """Means over portraits of scores, NaN left out."""
    return {name: _apply(np.mean, portraits, name) for name in names}


def find_worst(portraits: Sequence[Mapping], names: Sequence[str]) -> dict[str, float | None]:
    """Each score's worst value over portraits: the smallest where a higher one is better, else the largest."""
    return {name: _apply(np.min if is_better_higher(name) else np.max, portraits, name) for name in names}


def is_better_higher(score: str) -> bool:
    return score.endswith(_HIGHER_IS_BETTER)


def _apply(statistic, portraits, name):
    values = np.array([scores.get(name, math.nan) for scores in portraits], float)
    values = values[np.isfinite(values)]
    return round(float(statistic(values)), _DIGITS) if len(values) else None


def _combine_views(scores: Mapping[str, float]) -> dict[str, float]:
    """The scores with means over pairs of views, and sizes of those that have a sign."""
    result = dict(scores)
    for name, (first, second) in COMBINED.items():
        for score in [score.removeprefix(first) for score in scores if score.startswith(f"{first}_")]:
            result[f"{name}{score}"] = (scores[f"{first}{score}"] + scores.get(f"{second}{score}", math.nan)) / 2
    for name in ("camera_distance_error", "tone_bias", "tone_ita_error"):
        result[f"{name}_size"] = abs(scores.get(name, math.nan))
    return result


def _subtract(scored, reference):
    return [
        {name: scores.get(name, math.nan) - reference[portrait].get(name, math.nan) for name in EACH_SCORES}
        for portrait, scores in scored.items()
        if portrait in reference
    ]


def _find_mean_heads(known):
    """The face's distance of the better mean head by portrait."""
    result: dict[str, float] = {}
    for name, scored in known.items():
        if name.startswith(MEAN_HEAD):
            for portrait, scores in scored.items():
                if "h3ds_face_mean" in scores:
                    result[portrait] = min(scores["h3ds_face_mean"], result.get(portrait, math.inf))
    return result


def _compare_with_mean_head(scores, mean_head):
    ratio = scores.get("h3ds_face_mean", math.nan) / mean_head
    return {"over_mean_head": ratio, "above_mean_head": float(ratio > 1) if math.isfinite(ratio) else math.nan}


def _count_groups(groups: Sequence[Mapping[str, str]]) -> dict[str, dict[str, int]]:
    """Portraits by group, in the order of the page."""
    order = ("dark", "medium", "light", "neutral", "hair", "no hair")
    result: dict[str, dict[str, int]] = {}
    for kind in groups[0] if groups else ():
        found = [mine[kind] for mine in groups]
        names = sorted(set(found), key=lambda name: (order.index(name) if name in order else len(order), name))
        result[kind] = {name: found.count(name) for name in names}
    return result


def _average_groups(scored, groups):
    result: dict[str, dict[str, dict]] = {}
    for portrait in scored:
        for kind, name in groups[portrait].items():
            result.setdefault(kind, {}).setdefault(name, {})
    for kind, names in result.items():
        for name in names:
            mine = [scores for portrait, scores in scored.items() if groups[portrait][kind] == name]
            names[name] = average(mine, GROUP_SCORES)
    return result


def _costs(rows):
    """Medians and maxima over the portraits that did not fail."""
    done = [row for row in rows if "error" not in row]
    return {name: _apply(statistic, done, name) for name, statistic in COSTS.items()}
