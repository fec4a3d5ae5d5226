"""`docs/results.md` from the rows of `fits.compare`: marks, ablations, lights, portraits, pictures."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from sira_mi.evaluate.markdown import number, table
from sira_mi.evaluate.portraits.fits import MEAN_HEAD
from sira_mi.evaluate.portraits.methods import BY_NAME
from sira_mi.files import write_png, write_through
from sira_mi.fit import output

_TILE = 256  # pixels, side of a picture in the sheet
_SHEET_PORTRAITS = 6


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
class Mark:
    """What the shipped fit has to reach."""

    title: str
    wanted: str
    score: Callable[[dict[str, Sequence[dict]]], float]  # of the rows by method
    met: Callable[[float], bool]
    digits: int = 2


def mean(rows: Sequence[dict], score: str) -> float:
    """Mean of a score over rows; NaN when one of them has none."""
    return float(np.mean([row["scores"][score] if "scores" in row else np.nan for row in rows])) if rows else np.nan


def _of(method: str, score: str) -> Callable[[dict], float]:
    return lambda rows: mean(rows.get(method, ()), score)


def _over_mean_head(rows: dict) -> float:
    return mean(rows.get("b.3", ()), "h3ds_face_mean") / mean(rows.get(MEAN_HEAD, ()), "h3ds_face_mean")


def _best_ablation(rows: dict) -> float:
    others = [mean(rows.get(name, ()), "h3ds_face_mean") for name in ("a.1", "a.2", "a.3")]
    return mean(rows.get("a.4", ()), "h3ds_face_mean") - min(others)


def at_most(limit: float) -> Callable[[float], bool]:
    return lambda value: value <= limit


def at_least(limit: float) -> Callable[[float], bool]:
    return lambda value: value >= limit


MARKS = (
    Mark("face, both directions, mm", "≤ 1.0", _of("b.3", "h3ds_face_mean"), at_most(1.0)),
    Mark("the same over the mean head's", "≤ 0.7", _over_mean_head, at_most(0.7)),
    Mark("face in the photo's camera frame, no ICP, mm", "≤ 1.5", _of("b.3", "camera_face_mean"), at_most(1.5)),
    Mark("face normals, °", "≤ 8", _of("b.3", "normals_mean"), at_most(8), 1),
    Mark("a.4 minus the best of a.1 to a.3, mm", "≤ 0", _best_ablation, at_most(0)),
    Mark("silhouette IoU", "≥ 0.97", _of("b.3", "silhouette_iou"), at_least(0.97), 3),
    Mark("final render, dB", "≥ 34", _of("b.3", "final_psnr"), at_least(34), 1),
    Mark("final render, SSIM", "≥ 0.95", _of("b.3", "final_ssim"), at_least(0.95)),
    Mark("diffuse albedo, dB", "≥ 23", _of("b.3", "diffuse_psnr"), at_least(23), 1),
    Mark("diffuse albedo, SSIM", "≥ 0.88", _of("b.3", "diffuse_ssim"), at_least(0.88)),
    Mark("specular albedo, dB", "≥ 19.5", _of("b.3", "specular_psnr"), at_least(19.5), 1),
    Mark("specular albedo, SSIM", "≥ 0.71", _of("b.3", "specular_ssim"), at_least(0.71)),
)


def by_method(rows: Sequence[dict]) -> dict[str, list[dict]]:
    """Rows by the name of their method, in the order of their first appearance."""
    result: dict[str, list[dict]] = {}
    for row in rows:
        result.setdefault(row["method"], []).append(row)
    return result


def write_results(rows: Sequence[dict], benchmark: Path, runs: Path, out: Path, quality: str) -> Path:
    """Writes `results.md` and its picture to the folder `out`; returns the page."""
    methods = by_method(rows)
    sections = [
        _INTRODUCTION.format(portraits=len(methods[MEAN_HEAD]), quality=quality),
        "## Marks\n\n" + _marks(methods),
        "## Geometry\n\n" + _GEOMETRY_TEXT + "\n\n" + _methods_table(methods, GEOMETRY_COLUMNS, shaded=False),
        "## Appearance\n\n" + _APPEARANCE_TEXT + "\n\n" + _methods_table(methods, APPEARANCE_COLUMNS, shaded=True),
        "## By light\n\n" + _by_light(methods),
        "## Every portrait\n\n" + _by_portrait(methods),
        "## Time and memory\n\n" + _costs(methods),
    ]
    if errors := [row for row in rows if "error" in row]:
        lines = [[row["portrait"], row["method"], row["error"]] for row in errors]
        sections.append("## Fits that failed\n\n" + table(("portrait", "method", "error"), lines))
    if "b.3" in methods:
        shown = [row["portrait"] for row in methods["b.3"] if "scores" in row][:_SHEET_PORTRAITS]
        write_png(out / "images" / "results.png", picture(shown, benchmark, runs))
        sections.append(_PICTURE_TEXT)
    page = out / "results.md"
    write_through(page, lambda file: file.write_text("\n\n".join(sections) + "\n", encoding="utf-8"))
    return page


def _marks(methods: dict) -> str:
    lines = []
    for mark in MARKS:
        value = mark.score(methods)
        verdict = "–" if np.isnan(value) else ("reached" if mark.met(value) else "missed")
        lines.append([mark.title, mark.wanted, number(value, mark.digits), verdict])
    return table(("", "to reach", "measured", ""), lines)


def _title(method: str) -> str:
    return method if method == MEAN_HEAD else f"{method} {BY_NAME[method].title}"


def _methods_table(methods: dict, columns: Sequence[Column], shaded: bool) -> str:
    lines = []
    for name, rows in methods.items():
        if shaded == (name != MEAN_HEAD and BY_NAME[name].after is not None):
            lines.append([_title(name), *(number(mean(rows, c.score), c.digits) for c in columns)])
    if not shaded and "b.4" in methods:
        lines.append(
            ["b.4, after its relief stage", *(number(mean(methods["b.4"], c.score), c.digits) for c in columns)]
        )
    return table(("", *(c.title for c in columns)), lines)


def _by_light(methods: dict) -> str:
    columns = (*GEOMETRY_COLUMNS[:1], *GEOMETRY_COLUMNS[5:6], *GEOMETRY_COLUMNS[8:], *APPEARANCE_COLUMNS)
    rows = methods.get("b.3", [])
    lights = sorted({row["light"] for row in rows})
    lines = [
        [light, *(number(mean([r for r in rows if r["light"] == light], c.score), c.digits) for c in columns)]
        for light in lights
    ]
    return table(("b.3", *(c.title for c in columns)), lines)


def _by_portrait(methods: dict) -> str:
    heads = {row["portrait"]: row for row in methods[MEAN_HEAD]}
    lines = []
    for row in methods.get("b.3", []):
        if "scores" in row:
            scores, mean_head = row["scores"], heads[row["portrait"]]["scores"]
            lines.append(
                [
                    row["portrait"],
                    number(mean_head["h3ds_face_mean"]),
                    *(number(scores[c.score], c.digits) for c in GEOMETRY_COLUMNS[:1] + GEOMETRY_COLUMNS[5:]),
                    *(number(scores[c.score], c.digits) for c in APPEARANCE_COLUMNS[:7]),
                ]
            )
    titles = [c.title for c in GEOMETRY_COLUMNS[:1] + GEOMETRY_COLUMNS[5:]] + [c.title for c in APPEARANCE_COLUMNS[:7]]
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
    shown = [photo, output.preview("final", own["final"], own["mask"])]
    for name in names:
        shown += [output.preview(name, layers[name], layers["mask"]) for layers in (own, true)]
    return np.concatenate([_tile(image) for image in shown], axis=1)


def _tile(image: np.ndarray) -> np.ndarray:
    image = image if image.ndim == 3 else np.repeat(image[..., None], 3, axis=2)
    pixels = Image.fromarray((np.clip(image, 0, 1) * 255 + 0.5).astype(np.uint8))
    return np.asarray(pixels.resize((_TILE, _TILE), Image.LANCZOS)) / 255


_INTRODUCTION = """# Results of the single-image fit

{portraits} portraits of heads that no training has seen ([benchmark](benchmark.md)), fitted at `{quality}` quality. A
fit sees the photo and its EXIF focal length; camera, mask and landmarks are its own. This page is written by

    python -m sira_mi.evaluate benchmark --collection COLLECTION --out BENCHMARK
    python -m sira_mi.evaluate fits --benchmark BENCHMARK --runs RUNS --prior-without-deformation PRIOR"""

_GEOMETRY_TEXT = """Distances in mm from points to the other surface, means over portraits; both directions where no
direction is said. `face` is skin and eyes within 95 mm of the nose tip, after six landmarks and ICP with scale (H3DS);
`no ICP` is in the photo's camera frame, with one scale about the camera's centre; `head` is everything above the
shoulders, hair included; `hidden half` is what the photo does not show; IoU leaves out the body below the
model's floor, 30 cm under the ears."""

_APPEARANCE_TEXT = """Inside the mask, PSNR and SSIM on sRGB values. Specular albedo is the reflectance at normal
incidence over 0.08; `scaled` is after one least-squares factor a channel; `leakage` is the correlation of the log
albedo's error on skin with the log of the light, `of shadows` with the share of light that is not shadowed: 0 is
none."""

_PICTURE_TEXT = """## Pictures

Photo and fit; then, each fitted and true, normals, diffuse albedo and specular albedo.

![Photo, fit, and fitted and true normals and albedos](images/results.png)"""
