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
        _INTRODUCTION.format(portraits=len(fits[MEAN_HEAD]), quality=described.quality),
        "## Marks\n\n" + _marks(measured),
        "## Geometry\n\n" + _GEOMETRY_TEXT + "\n\n" + _methods_table(fits, GEOMETRY_COLUMNS, FIT_ROWS),
        "## Appearance\n\n" + _APPEARANCE_TEXT + "\n\n" + _methods_table(fits, APPEARANCE_COLUMNS, (SHIPPED,)),
        _ABLATIONS_TEXT.format(quality=described.ablations)
        + _methods_table(methods, GEOMETRY_COLUMNS, GEOMETRY_ROWS)
        + "\n\n"
        + _methods_table(methods, APPEARANCE_COLUMNS, APPEARANCE_ROWS),
        "## By light\n\n" + _by_light(fits),
        "## Every portrait\n\n" + _by_portrait(fits),
        _TRIED_TEXT,
        f"## Time and memory\n\n{_COSTS_TEXT}\n\nAt `{described.quality}`:\n\n{_costs(fits)}\n\n"
        f"At `{described.ablations}`:\n\n{_costs(methods)}",
    ]
    if errors := [row for row in (*shipped, *ablations) if "error" in row]:
        lines = [[row["portrait"], row["method"], row["error"]] for row in errors]
        sections.append("## Fits that failed\n\n" + table(("portrait", "method", "error"), lines))
    shown = [row["portrait"] for row in fits.get(SHIPPED, ()) if "scores" in row][:_SHEET_PORTRAITS]
    if shown:
        write_png(out / "images" / "results.png", picture(shown, described.benchmark, described.runs))
        sections.append(_PICTURE_TEXT)
    page = out / "results.md"
    write_through(page, lambda file: file.write_text("\n\n".join(sections) + "\n", encoding="utf-8"))
    return page


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
    shown = [photo, output.preview("final", own["final"], own["mask"])]
    for name in names:
        shown += [output.preview(name, layers[name], layers["mask"]) for layers in (own, true)]
    return np.concatenate([_tile(image) for image in shown], axis=1)


def _tile(image: np.ndarray) -> np.ndarray:
    image = image if image.ndim == 3 else np.repeat(image[..., None], 3, axis=2)
    pixels = Image.fromarray((np.clip(image, 0, 1) * 255 + 0.5).astype(np.uint8))
    return np.asarray(pixels.resize((_TILE, _TILE), Image.LANCZOS)) / 255


_ABLATIONS_TEXT = """## Ablations

The methods of the paper's Figure 4 and four of this project, all at `{quality}` quality. a.1 and a.2 fit a field
without deformation (H3D-Net): a.1 its latent, a.2 its networks as well. a.3 has deformation and reference, and moves
the deformation's network. In all three the rendering function starts untrained, as in H3D-Net; a.4, where it was
learned with the shapes, is the fit's geometry. b.1 to b.7 go on from a.4: b.1 with untrained decoders, b.2 without
the refinement, b.3 as shipped at that quality, b.4 with a relief stage before the refinement (shape from shading,
which moves the surface too; no quality ships with it), b.5 polished by path tracing, b.6 as b.3 but with all light of
the upper hemisphere at every point: no shadows, and no light that the head reflects onto itself. b.7 is b.3 as the
paper has it, without a refinement of the light: all that base albedo and light leave of the photo goes to the albedo.
A method without a row was left out by `--methods`: a.1 and a.2, when they were last measured, with the rendering
function fixed in the first stage of all methods, had a face of 3.58 and 3.53 mm and normals of 27°. Before landmarks
were the head's and eyes were weighed, b.1, b.2, b.5, b.6 and b.7 had final renders of 27.0, 24.6, 30.3, 28.8 and 29.7
dB and diffuse albedos of 20.3, 21.4, 21.7, 21.4 and 20.2 dB, where b.3 had 30.3 and 21.7.

"""

_TRIED_TEXT = """## What was tried against what is missed

On six other heads of the test split, at `draft`, unless said: few, so that figures show a direction rather than a
size. None of this is in the shipped fit. What such trials brought into it: a photo's exposure taken out before it is
compared with the learned radiance (face 1.36 → 1.34 mm, camera's frame 2.49 → 2.26, hidden half 6.9 → 6.3, normals
10.0° → 9.5°); the level of the skin's albedo by the white of the eyes ([how
well](benchmark.md#portraits-of-training-heads); diffuse albedo before the refinement 22.7 → 23.2 dB) and ten times as
strict (23.9 dB); at `draft` twice the steps for light, albedo and speculars (24.3 dB; at `standard` no gain, 24.3 →
24.1). On nine other heads of the test split (makehuman and ict, mean head 1.60 mm) the first stage, latents and pose
alone, left the face at 1.71 mm, worse than it began: a rendering function that cannot take the photo's own light puts
it down to the shape. Moved along it leaves 1.37; with a third of the weight of the colour and ten times that of the
latents 1.34; with the exposure taken out as well 1.32. After all stages: face 1.43 → 1.26 mm, camera's frame 2.44 →
2.18, IoU 0.965 → 0.967, normals 11.4° and hidden half 7.2 mm as before; on the photos of this benchmark, at `draft`,
face 1.26 mm both, camera's frame 2.29 → 2.08, normals 10.3° both, hidden half 5.9 → 5.4 mm. Then [landmarks of the
head](benchmark.md#portraits-of-training-heads), which are found and placed a fifth nearer to the true ones, with
latents held a tenth as strictly again, so that a fitted head may differ from the mean as real heads do: on the nine
heads face 1.26 mm as before, camera's frame 2.18 → 2.01, normals 11.4° and hidden half 7.2 mm as before; on this
benchmark, at `standard`, face 1.25 → 1.24 mm, camera's frame 2.09 → 1.91, normals 10.5° → 9.6°, IoU 0.953 → 0.958,
head 4.8 → 4.6, hidden half 5.6 mm as before, diffuse albedo 22.2 → 22.4 dB; at `draft` face 1.26 → 1.24, camera's
frame 2.08 → 2.00, normals 10.3° → 9.6°, but head 4.7 → 5.1 and hidden half 5.4 → 6.2 mm.
How finely such figures tell: with the correction of landmarks measured on 1590 other photos, which brings those of the
nine heads as near (1.9% of the face off, both), they end at 1.21 instead of 1.26 mm. On nine heads half a tenth of a
millimetre is chance. Last, eyes of which [one may mislead](benchmark.md#portraits-of-training-heads) in place of their
mean tell the skin's level: on this benchmark diffuse albedo 22.4 → 23.4 dB, scaled 26.5 as before, final render 35.4 →
35.2.

- **The camera's frame.** The landmark model errs by 4° on average on these heads, and hair over a turned face misleads
  it most: for `makehuman_0199_outdoor` the camera starts 20% too far away, and the head grows with it. The photo hardly
  corrects that: with the true camera given, two heads still ended at 1.8 and 2.6 mm in its frame and 0.95 and 1.12 mm
  after ICP, with the same losses as from the estimated one. Three times the pose's learning rate: 1.02 → 1.09 and
  0.99 → 0.88 mm. A correction of the landmarks' bias by yaw and pitch, learned from 412 views of 100 training heads, or
  landmarks fitted along with the shape's latents: 4.2° → 4.0° to 4.1°. Landmarks weighted by how much they face the
  camera: no difference on 416 small views of training heads (7.1° both, distance 6.6% → 6.5%). No landmarks after the
  first stage: no difference.
- **An alignment stage** of latents, pose and rendering function, at a quarter of the landmarks' weight, after the first
  (35 to 70 steps, same nine heads): IoU 0.967 → 0.972 to 0.974, camera's frame 2.18 → 2.06 to 2.12, face 1.26 → 1.24 to
  1.27, but head 5.8 → 6.2 to 6.4 and hidden half 7.2 → 7.7 to 8.0; and on the portrait of scikit-image the smile, which
  the prior's closed mouth cannot follow, no longer lies on the mouth. With twice the rates of the pose in all stages:
  1.28 and 2.18 mm. In the first stage three times the landmarks' weight: 1.32 → 1.39 mm, less than half of it 1.38.
  With the landmarks of the head, twice their weight after the first stage: 1.26 → 1.28 mm, camera's frame 2.01 → 2.00,
  hidden half 7.2 → 7.3.
- **Shape and pose by regression** from a photo, ridge on landmarks, features of the landmark network, outline and
  pixels: on 473 small photos of 121 training heads, each head by the others, the pose's error falls from 5.8° to 4.8°
  but the face's shape by 5% only; by true landmarks in place of those found, which are 2.4% of the face's height off,
  it falls by 13% and the pose's error to 2.0° (3.7° where the mean head is laid over them).
- **Landmarks.** Beside the direction, 60 coordinates of the network's own face tell of its errors: 2.3% of the face off
  on 1590 small photos of 409 training heads, by a polynomial of yaw and pitch 1.9%, by the coordinates 1.8%, each head
  by the others; but they take the smile of the portrait of scikit-image for a shape, and its eyes are moved. With true
  landmarks, on the nine heads, all else as shipped but the latents: face 1.11, camera's frame 1.93 mm, with three times
  their weight 1.08 and 1.81: more than landmarks is missing.
- **The face.** More steps leave the prior: twice as many took one portrait of this benchmark from 0.93 to 1.33 mm and
  another head from 1.03 to 0.94; with 260 instead of a draft's 182 two heads ended at 1.10 and 1.82 instead of 0.95 and
  1.47 mm. Weaker rates of the deformation's network, or three times the weight of the prior: within 0.06 mm. Half and a
  quarter of the weight of the colour: 1.37 and 1.34 mm, where 1.34 is shipped. Three seeds each of two photos ended
  within 0.14 mm of each other: there is little that a mean over seeds could take out.
- **Normals.** Errors are largest at eyelids, the wings of the nose, the mouth, ears and the edge of the hair: detail
  that the prior does not have. Relief helps here and the albedo (at `standard`, with 182 steps of geometry and the
  skin's level by brightness: normals 9.9°, diffuse albedo scaled 26.0 dB), but on the portrait of scikit-image it
  bends brows, eyes and mouth, whose pattern the albedo's prior cannot paint; without these three, it bends the
  fringe. On bare skin only it does not help: normals of the skin 11.4° → 11.6°, where relief everywhere has 11.1°,
  diffuse albedo 22.1 → 22.1 dB, where it has 23.1. What it mends lies at hair, neck and edges.
  At `draft` on all portraits of the benchmark (b.4 against b.7, before the light had a refinement): normals 10.2° →
  9.7°, diffuse albedo 21.1 → 22.2 dB (scaled 24.3 → 25.8), final render 31.2 → 31.0.
- **Diffuse albedo.** What is left of its level and colour is the distance between raw and scaled scores. Brightness
  of the skin or of the lit part of the face, alone or together, tells the level hardly: the 97th percentile of the
  face follows the true level with correlation 0.85 on these 12 portraits and with 0.42 on 78 of training heads. The
  colour of the eyes' white says little more of the skin's colour than its level does (log of red over green within
  0.127 instead of 0.129); twice the width for that colour: no difference. The albedo's latent optimised with the light
  from the first stage on: 24.3 → 24.4 dB before the refinement. Half of the points of light, albedo and speculars drawn
  from the face: 24.3 → 24.5 dB before the refinement and 23.5 → 24.2 on skin alone.
- **The refinement** (with all of the residual given to the albedo, b.7, unless said). Two and eight times its shipped
  weight of eq. 12: diffuse albedo 20.5 → 21.0 → 22.1 dB, final render 32.8 → 32.4 → 29.5 (the first figures are of
  half the shipped weight). Four and sixteen times λ8 of eq. 13, its weight in shadows: 22.1 → 22.7 → 23.4 dB, final
  render 32.7 → 31.7 → 29.1. The skin's tone asked of the refined albedo instead of the base: 22.1 → 23.2 dB, final
  render 32.7 → 30.1. The smooth grey part of what b.2 leaves of the photo, taken out of it before: 0.3 dB of the
  scaled albedo for 1.2 dB of the final render. What eq. 8 reaches at all, with its light fitted anew: 26 dB by what
  b.2 finds, 27 by the true albedo, 30 by true albedo and normals, 34 by these and true shadows: the residual is as
  much the light's as the albedo's. Shared between them it is in the shipped fit: diffuse albedo 22.5 → 24.8 dB
  (scaled 24.0 → 26.6), final render 32.5 → 33.7 by 280 steps, 24.7 (26.5) and 32.3 by the 200 of the shipped draft.
  Shares by the size of the residual over the whole photo instead of by the light at each point: 24.4 dB (scaled
  26.0), and of the portrait of scikit-image, whose residuals are large, hardly eyes, smile or suit were left. Six
  times the weight that holds the parts to their shares: 24.5 dB with these, final render 30.7."""

_COSTS_TEXT = """Wall-clock time of processes, their start and the writing of scored pictures included; a fit as shipped
is a.4 and b.3 together. Some fits of b.3 ran beside tests."""

_INTRODUCTION = """# Results of the single-image fit

{portraits} portraits of heads that no training has seen ([benchmark](benchmark.md)), fitted at `{quality}` quality. A
fit sees the photo and its EXIF focal length; camera, mask and landmarks are its own. This page is written by

    python -m sira_mi.evaluate benchmark --collection COLLECTION --out BENCHMARK
    python -m sira_mi.evaluate fits --benchmark BENCHMARK --runs RUNS --prior-without-deformation PRIOR"""

_GEOMETRY_TEXT = """Distances in mm from points to the other surface, means over portraits; both directions where no
direction is said. `face` is skin and eyes within 95 mm of the nose tip, after six landmarks and ICP with scale (H3DS);
`no ICP` is in the photo's camera frame, with one scale about the camera's centre; `head` is everything above the
shoulders, hair included; `hidden half` is what the photo does not show; IoU leaves out the body below the
model's floor, 30 cm under the ears. Where b.3 has a relief stage, it moves the surface of a.4."""

_APPEARANCE_TEXT = """Inside the mask, PSNR and SSIM on sRGB values. `eq. 8` is the final render without the
[refinement of the light](architecture.md#albedo-or-light), which holds in the photo's own light only: what albedo,
light and shape explain by themselves. Specular albedo is the reflectance at normal incidence over 0.08; `scaled` is
after one least-squares factor a channel; `leakage` is the correlation of the log albedo's error on skin with the log
of the light, `of shadows` with the share of light that is not shadowed: 0 is none."""

_PICTURE_TEXT = """## Pictures

Photo and fit; then, each fitted and true, normals, diffuse albedo and specular albedo.

![Photo, fit, and fitted and true normals and albedos](images/results.png)"""
