"""`docs/results.md` from the rows of `compare_methods.compare`: marks, ablations, lights, portraits, pictures."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from sira_mi.files import write_png, write_through
from sira_mi.relight.pictures import preview
from studies.markdown import number, table
from studies.portraits import results_text
from studies.portraits.compare_methods import MEAN_HEAD
from studies.portraits.methods import BY_NAME

SHIPPED = "b.3"
GEOMETRY_ROWS = (MEAN_HEAD, "a.1", "a.2", "a.3", "a.4", "b.4")
FIT_ROWS = (MEAN_HEAD, "a.4", SHIPPED)  # of the shipped fit's geometry, as a.4 and b.3 leave it
APPEARANCE_ROWS = ("b.1", "b.2", "b.3", "b.4", "b.5", "b.6", "b.7")
_TILE = 256  # pixels, side of a picture in the sheet
_SHEET_PORTRAITS = 6
AT_MOST, AT_LEAST = "≤", "≥"


@dataclass(frozen=True)
class Column:
    """One figure of a table: the mean over portraits of a score."""

    title: str
    score: str
    digits: int = 2


GEOMETRY_COLUMNS = (
    Column("face", "h3ds_face_mean"),
    Column("truth → fit", "h3ds_face_truth_to_prediction_mean"),
    Column("median", "h3ds_face_truth_to_prediction_median"),
    Column("90%", "h3ds_face_truth_to_prediction_p90"),
    Column("fit → truth", "h3ds_face_prediction_to_truth_mean"),
    Column("no ICP", "camera_face_mean"),
    Column("head", "h3ds_head_mean"),
    Column("hidden half", "h3ds_hidden_mean"),
    Column("normals, °", "normals_mean", 1),
    Column("IoU", "silhouette_iou", 3),
)
APPEARANCE_COLUMNS = (
    Column("final, dB", "final_psnr", 1),
    Column("SSIM", "final_ssim"),
    Column("eq. 8, dB", "shaded_psnr", 1),
    Column("diffuse, dB", "diffuse_psnr", 1),
    Column("SSIM", "diffuse_ssim"),
    Column("scaled, dB", "diffuse_scaled_psnr", 1),
    Column("specular, dB", "specular_psnr", 1),
    Column("SSIM", "specular_ssim"),
    Column("skin ΔE", "skin_ciede2000_mean", 1),
    Column("scaled", "skin_scaled_ciede2000_mean", 1),
    Column("leakage", "leakage_shading"),
    Column("of shadows", "leakage_shadow"),
)


@dataclass(frozen=True)
class Measured:
    """Rows by method: those of the shipped fit at the quality of the page, and all methods at that of the ablations."""

    shipped: dict[str, list[dict]]
    ablations: dict[str, list[dict]]


@dataclass(frozen=True)
class Described:
    """Where the rows of a page come from."""

    benchmark: Path
    runs: Path  # folder of the shipped fits
    quality: str  # of the shipped fits
    ablations: str  # quality of the ablations


@dataclass(frozen=True)
class Mark:
    """What the shipped fit has to reach."""

    title: str
    sign: str  # AT_MOST or AT_LEAST
    limit: float
    score: Callable[[Measured], float]
    digits: int = 2

    def verdict(self, value: float) -> str:
        """Whether `value` keeps the mark, and by how much it does not."""
        if np.isnan(value):
            return "–"
        excess = value - self.limit if self.sign == AT_MOST else self.limit - value
        return "reached" if excess <= 0 else f"**missed** by {number(excess, self.digits)}"


def mean(rows: Sequence[dict], score: str) -> float:
    """Mean of a score over rows; NaN when one of them has none."""
    return float(np.mean([row["scores"][score] if "scores" in row else np.nan for row in rows])) if rows else np.nan


def _shipped(score: str) -> Callable[[Measured], float]:
    return lambda measured: mean(measured.shipped.get(SHIPPED, ()), score)


def _over_mean_head(measured: Measured) -> float:
    rows = measured.shipped
    return mean(rows.get(SHIPPED, ()), "h3ds_face_mean") / mean(rows.get(MEAN_HEAD, ()), "h3ds_face_mean")


def _best_ablation(measured: Measured) -> float:
    """Beside the methods that have rows; NaN where none has."""
    others = [mean(rows, "h3ds_face_mean") for name in ("a.1", "a.2", "a.3") if (rows := measured.ablations.get(name))]
    return mean(measured.ablations.get("a.4", ()), "h3ds_face_mean") - min(others, default=np.nan)


def _draft_face(measured: Measured) -> float:
    return mean(measured.ablations.get(SHIPPED, ()), "h3ds_face_mean")


def seconds(rows: dict[str, list[dict]]) -> float:
    """Median time of whole shipped fits: geometry and what goes on from it."""
    geometry = {row["portrait"]: row["total_seconds"] for row in rows.get("a.4", ()) if "scores" in row}
    both = [
        geometry[row["portrait"]] + row["total_seconds"]
        for row in rows.get(SHIPPED, ())
        if "scores" in row and row["portrait"] in geometry
    ]
    return float(np.median(both)) if both else np.nan


def _memory(measured: Measured) -> float:
    rows = [row for name in ("a.4", SHIPPED) for row in measured.shipped.get(name, ()) if "scores" in row]
    return max((row["peak_memory_megabytes"] / 1000 for row in rows), default=np.nan)


MARKS = (
    Mark("face, both directions, mm", AT_MOST, 1.0, _shipped("h3ds_face_mean")),
    Mark("the same over the mean head's", AT_MOST, 0.7, _over_mean_head),
    Mark("face in the photo's camera frame, no ICP, mm", AT_MOST, 1.5, _shipped("camera_face_mean")),
    Mark("face normals, °", AT_MOST, 8, _shipped("normals_mean"), 1),
    Mark("a.4 minus the best of a.1 to a.3, mm", AT_MOST, 0, _best_ablation),
    Mark("silhouette IoU", AT_LEAST, 0.97, _shipped("silhouette_iou"), 3),
    Mark("final render, dB", AT_LEAST, 34, _shipped("final_psnr"), 1),
    Mark("final render, SSIM", AT_LEAST, 0.95, _shipped("final_ssim"), 3),
    Mark("the same without the light's refinement, dB", AT_LEAST, 34, _shipped("shaded_psnr"), 1),
    Mark("diffuse albedo, dB", AT_LEAST, 23, _shipped("diffuse_psnr"), 1),
    Mark("diffuse albedo, SSIM", AT_LEAST, 0.88, _shipped("diffuse_ssim"), 3),
    Mark("specular albedo, dB", AT_LEAST, 19.5, _shipped("specular_psnr"), 1),
    Mark("specular albedo, SSIM", AT_LEAST, 0.71, _shipped("specular_ssim"), 3),
    Mark("time of a fit, s", AT_MOST, 300, lambda measured: seconds(measured.shipped), 0),
    Mark("its peak memory, GB", AT_MOST, 2, _memory, 1),
    Mark("time of a draft, s", AT_MOST, 60, lambda measured: seconds(measured.ablations), 1),
    Mark("face of a draft, mm", AT_MOST, 1.2, _draft_face),
)


def by_method(rows: Sequence[dict]) -> dict[str, list[dict]]:
    """Rows by the name of their method, in the order of their first appearance."""
    result: dict[str, list[dict]] = {}
    for row in rows:
        result.setdefault(row["method"], []).append(row)
    return result


def write_results(shipped: Sequence[dict], ablations: Sequence[dict], described: Described, out: Path) -> Path:
    """Writes `results.md` and its picture to the folder `out`; returns the page."""
    measured = Measured(by_method(shipped), by_method(ablations))
    fits, methods = measured.shipped, measured.ablations
    sections = [
        results_text.INTRODUCTION.format(portraits=len(fits[MEAN_HEAD]), quality=described.quality),
        "## Marks\n\n" + _marks(measured),
        "## Geometry\n\n" + results_text.GEOMETRY + "\n\n" + _methods_table(fits, GEOMETRY_COLUMNS, FIT_ROWS),
        "## Appearance\n\n" + results_text.APPEARANCE + "\n\n" + _methods_table(fits, APPEARANCE_COLUMNS, (SHIPPED,)),
        results_text.ABLATIONS.format(quality=described.ablations)
        + _methods_table(methods, GEOMETRY_COLUMNS, GEOMETRY_ROWS)
        + "\n\n"
        + _methods_table(methods, APPEARANCE_COLUMNS, APPEARANCE_ROWS),
        "## By light\n\n" + _by_light(fits),
        "## Every portrait\n\n" + _by_portrait(fits),
        "## What brought the fit here\n\n" + _changes(),
        results_text.TRIED,
        f"## Time and memory\n\n{results_text.COSTS}\n\nAt `{described.quality}`:\n\n{_costs(fits)}\n\n"
        f"At `{described.ablations}`:\n\n{_costs(methods)}",
    ]
    if errors := [row for row in (*shipped, *ablations) if "error" in row]:
        lines = [[row["portrait"], row["method"], row["error"]] for row in errors]
        sections.append("## Fits that failed\n\n" + table(("portrait", "method", "error"), lines))
    shown = [row["portrait"] for row in fits.get(SHIPPED, ()) if "scores" in row][:_SHEET_PORTRAITS]
    if shown:
        write_png(out / "images" / "results.png", picture(shown, described.benchmark, described.runs))
        sections.append(results_text.PICTURE)
    page = out / "results.md"
    write_through(page, lambda file: file.write_text("\n\n".join(sections) + "\n", encoding="utf-8"))
    return page


def _changes() -> str:
    tables = (table(head, lines) for head, *lines in (results_text.GEOMETRY_CHANGES, results_text.APPEARANCE_CHANGES))
    return "\n\n".join((results_text.CHANGES, *tables))


def _marks(measured: Measured) -> str:
    lines = []
    for mark in MARKS:
        value = mark.score(measured)
        lines.append([mark.title, f"{mark.sign} {mark.limit:g}", number(value, mark.digits), mark.verdict(value)])
    return table(("", "to reach", "measured", ""), lines)


def _title(method: str) -> str:
    return method if method == MEAN_HEAD else f"{method} {BY_NAME[method].title}"


def _methods_table(methods: dict, columns: Sequence[Column], names: Sequence[str]) -> str:
    lines = [
        [_title(name), *(number(mean(methods[name], c.score), c.digits) for c in columns)]
        for name in names
        if name in methods
    ]
    return table(("", *(c.title for c in columns)), lines)


def _by_light(methods: dict) -> str:
    columns = (*GEOMETRY_COLUMNS[:1], *GEOMETRY_COLUMNS[5:6], *GEOMETRY_COLUMNS[8:], *APPEARANCE_COLUMNS)
    rows = methods.get(SHIPPED, [])
    lights = sorted({row["light"] for row in rows})
    lines = [
        [light, *(number(mean([r for r in rows if r["light"] == light], c.score), c.digits) for c in columns)]
        for light in lights
    ]
    return table(("b.3", *(c.title for c in columns)), lines)


def _by_portrait(methods: dict) -> str:
    heads = {row["portrait"]: row for row in methods[MEAN_HEAD]}
    lines = []
    for row in methods.get(SHIPPED, []):
        if "scores" in row:
            scores, mean_head = row["scores"], heads[row["portrait"]]["scores"]
            lines.append(
                [
                    row["portrait"],
                    number(mean_head["h3ds_face_mean"]),
                    *(number(scores[c.score], c.digits) for c in GEOMETRY_COLUMNS[:1] + GEOMETRY_COLUMNS[5:]),
                    *(number(scores[c.score], c.digits) for c in APPEARANCE_COLUMNS[:8]),
                ]
            )
    titles = [c.title for c in GEOMETRY_COLUMNS[:1] + GEOMETRY_COLUMNS[5:]] + [c.title for c in APPEARANCE_COLUMNS[:8]]
    return table(("b.3", "mean head", *titles), lines)


def _costs(methods: dict) -> str:
    lines = []
    for name, rows in methods.items():
        done = [row for row in rows if "seconds" in row]
        if done:
            stages = {stage: np.median([row["seconds"].get(stage, 0) for row in done]) for stage in done[0]["seconds"]}
            shown = ", ".join(f"{stage} {value:.0f}" for stage, value in stages.items())
            total = np.median([row["total_seconds"] for row in done])
            memory = np.median([row["peak_memory_megabytes"] for row in done])
            lines.append([_title(name), f"{total:.0f}", shown, f"{memory:.0f}"])
    return table(("median over portraits", "s", "stages, s", "peak, MB"), lines)


def picture(portraits: Sequence[str], benchmark: Path, runs: Path) -> np.ndarray:
    """Display values: a row for each portrait, the photo, then fitted and true final render, normals, diffuse and
    specular albedo side by side."""
    return np.concatenate([_picture_row(benchmark / name, runs / name / "b.3") for name in portraits])


def _picture_row(folder: Path, fit: Path) -> np.ndarray:
    with np.load(folder / "truth.npz", allow_pickle=False) as truth:
        names = ("normal", "diffuse_albedo", "specular_albedo")
        true = {name: truth[name] for name in (*names, "mask")}
        turn = truth["world_to_camera"][:3, :3]
        true["normal"] = true["normal"] @ turn.T * [1, -1, -1]
    with np.load(fit / "head.npz", allow_pickle=False) as head:
        own = {name: head[f"image/{name}"] for name in (*names, "final", "mask")}
        own["normal"] = own["normal"] @ head["world_to_camera"][:3, :3].T * [1, -1, -1]
    photo = np.asarray(Image.open(folder / "photo.jpg").convert("RGB")) / 255
    shown = [photo, preview("final", own["final"], own["mask"])]
    for name in names:
        shown += [preview(name, layers[name], layers["mask"]) for layers in (own, true)]
    return np.concatenate([_tile(image) for image in shown], axis=1)


def _tile(image: np.ndarray) -> np.ndarray:
    image = image if image.ndim == 3 else np.repeat(image[..., None], 3, axis=2)
    pixels = Image.fromarray((np.clip(image, 0, 1) * 255 + 0.5).astype(np.uint8))
    return np.asarray(pixels.resize((_TILE, _TILE), Image.LANCZOS)) / 255
