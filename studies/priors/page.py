"""`docs/priors.md` from cached measurements: every number on the page is read from RUNS/evidence."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from sira_mi.avatar.architecture import AvatarArchitecture
from sira_mi.files import write_through
from studies.cache import read
from studies.markdown import average, number, percent, table
from studies.priors.shape_measures import DISC_RADIUS, REGIONS

COMMANDS = """    python -m sira_mi.training shape --collection COLLECTION --out RUNS
    python -m sira_mi.training appearance --collection COLLECTION --out RUNS
    python -m studies.priors sizes --collection COLLECTION --runs RUNS
    python -m studies.priors measure --collection COLLECTION --runs RUNS --out docs"""

# What the shape latents have to reach: face and head, mm; the face's share of the mean head's error; the share of
# random heads' surface points with a gradient of length 0.9 to 1.1.
FACE_LIMIT, HEAD_LIMIT, FACE_SHARE, GRADIENT_SHARE = 1.0, 2.0, 0.5, 0.95

# What a loss term is for, in the table of ablations.
PURPOSES = {
    "surface": "puts the zero level on the scan",
    "normal": "turns the gradient to the scan's normals",
    "distance": "sets the distance away from the surface",
    "eikonal": "keeps the gradient at length 1",
    "random_eikonal": "the same for heads between the trained ones",
    "deformation": "keeps the deformation small",
    "landmark": "brings landmarks together in reference space",
    "color": "ties the reference space to colour",
    "embedding": "keeps the latents small",
}


def _result(evidence: Path, name: str) -> dict | None:
    stored = read(evidence / f"{name}.json")
    return stored and stored["result"]


def _results(folder: Path) -> list[dict]:
    """The results of a folder's files that share the number of steps of the newest one, the complete model first."""
    files = sorted(folder.glob("*.json"), key=lambda path: path.stat().st_mtime)
    results = [stored["result"] for stored in map(read, files) if stored]
    steps = results[-1]["steps"] if results else 0
    return sorted((r for r in results if r["steps"] == steps), key=lambda r: (r["name"] != "complete", r["name"]))


def _distance_rows(rows: Sequence[dict], path: Sequence[str]) -> list[list[str]]:
    """Rows of a table of distances: per region mean, median and 90th percentile of fits and of the mean head."""
    return [
        [region]
        + [
            " / ".join(number(average(rows, head, *path, region, s)) for s in ("mean", "median", "p90"))
            for head in ("fitted", "mean_head")
        ]
        for region in REGIONS
    ]


def fits_section(evidence: Path) -> str:
    """Latents fitted to test scans."""
    data = _result(evidence, "fits")
    if data is None:
        return _missing("prior")
    rows, fit = data["scans"], data["fit"]
    face, mean_face = (average(rows, head, "distance", "face", "mean") for head in ("fitted", "mean_head"))
    head = average(rows, "fitted", "distance", "head without hair", "mean")
    worst = max(rows, key=lambda row: row["fitted"]["distance"]["face"]["mean"])
    columns = ["region", "fitted: mean / median / 90%", "mean head: mean / median / 90%"]
    wanted = [
        ["face", f"at most {FACE_LIMIT:.1f} mm", f"{number(face)} mm", _met(face <= FACE_LIMIT)],
        [
            "face against the mean head",
            f"less than {percent(FACE_SHARE)}",
            percent(face / mean_face),
            _met(face < FACE_SHARE * mean_face),
        ],
        ["head without hair", f"at most {HEAD_LIMIT:.1f} mm", f"{number(head)} mm", _met(head <= HEAD_LIMIT)],
    ]
    count, median = len(rows), np.median([row["fitted"]["distance"]["face"]["mean"] for row in rows])
    return f"""Only the shape latent is fitted to each of the {count} test scans, whose identities never entered
training; the networks stay as they are and nothing is aligned. All scans are fitted together: {fit["steps"]} steps of
Adam on {fit["points"]} points a scan, mean |f| plus {fit["normal"]:g} times the difference of gradient and normal plus
{fit["penalty"]:g} times the mean square of w, in {number(data["fitting_seconds"], 0)} s. The mean head is the prior's
zero latent. Numbers are mm: each scan's mean, median and 90th percentile, averaged over the scans.

From scan to surface: {data["points"]} points of each scan, two Newton steps along the gradient to the zero level.

{table(columns, _distance_rows(rows, ("distance",)))}

From surface to scan: {data["points"]} points of the extracted surface above the shoulders, moved onto the zero level,
and from each the distance to the tangent disc (radius {DISC_RADIUS:g} mm) of the nearest scan point. Scan points are
{number(data["spacing"])} mm apart (median). At a distance h beside the scan point, where the scan bends with radius
r, the disc is h²/2r off the scan: {number(data["spacing"] ** 2 / 8 / 10, 3)} mm for half that spacing and a radius of
10 mm, and at most {number(DISC_RADIUS**2 / 20)} mm for that radius. Surfaces that the scan does not have, such as a
leftover of another head's hair, count with their full distance.

{table(columns, _distance_rows(rows, ("to_scan",)))}

Face is the 95 mm sphere at the nose tip. Everything is above the shoulders (y > −130 mm). Hair is where the scan says
so, for the surface at the nearest scan point.

{table(["wanted, from scan to surface", "", "measured", ""], wanted)}

The median over scans of the face error is {number(median)} mm; the worst is {worst["name"]} with
{number(worst["fitted"]["distance"]["face"]["mean"])} mm. Normals on the head without hair are
{number(average(rows, "fitted", "angle", "head without hair", "mean"), 1)}° off (mean head:
{number(average(rows, "mean_head", "angle", "head without hair", "mean"), 1)}°). The root mean square of w, which is 1
for a typical head of the prior, is {number(average(rows, "rms_w"))}.

![Scans above, fits below](images/prior_fits.png)

Above the first test scans, as points; below the surfaces of their fitted latents."""


def bias_section(evidence: Path) -> str:
    """Errors by source, ancestry, sex and age."""
    data = _result(evidence, "fits")
    if data is None:
        return _missing("prior")
    lines = []
    for trait in ("source", "ancestry", "sex", "age"):
        for value in sorted({row["traits"][trait] for row in data["scans"]}):
            rows = [row for row in data["scans"] if row["traits"][trait] == value]
            cells = [
                number(average(rows, head, "distance", region, "mean"))
                for region in ("face", "head without hair")
                for head in ("fitted", "mean_head")
            ]
            lines.append([trait, value, str(len(rows)), *cells])
    head = ["", "group", "scans", "face", "face, mean head", "head", "head, mean head"]
    return f"""Mean distance from scan to surface in mm, head without hair. Groups of a few scans say little.

{table(head, lines)}"""


def heads_section(evidence: Path) -> str:
    """Random heads."""
    data, directions = _result(evidence, "heads"), _result(evidence, "directions")
    if data is None or directions is None:
        return _missing("prior")
    lines = []
    for sigma in ("1", "2"):
        rows = data[sigma]
        share = average(rows, "gradient")
        lines.append(
            [
                f"{sigma}σ",
                str(len(rows)),
                f"{sum(row['parts'] == 1 for row in rows)} of {len(rows)}",
                percent(min(row["largest"] for row in rows)),
                f"{percent(share)} ({percent(min(row['gradient'] for row in rows))})",
                _met(share >= GRADIENT_SHARE),
            ]
        )
    head = [
        "latents",
        "heads",
        "one connected surface",
        "largest part, smallest share",
        "|∇f| in 0.9–1.1, mean (worst)",
        f"{percent(GRADIENT_SHARE)} wanted",
    ]
    return f"""Latents drawn from a normal distribution of standard deviation 1 and 2 in units of the prior's. Parts
are those of the extracted mesh; |∇f| is taken at points of the surface.

{table(head, lines)}

![Heads at 1σ](images/prior_samples_1.png)

1σ

![Heads at 2σ](images/prior_samples_2.png)

2σ

![Principal directions](images/prior_directions.png)

The mean head and the first {directions["count"]} principal directions of the training latents at −2σ (above) and +2σ
(below); these hold {percent(directions["share"])} of their variance."""


def landmarks_section(evidence: Path) -> str:
    """Landmarks in reference space."""
    data = _result(evidence, "landmarks")
    if data is None:
        return _missing("prior")
    lines = [
        [
            label,
            str(data[name]["scenes"]),
            number(data[name]["deformed"]),
            number(data[name]["undeformed"]),
            number(data[name]["scale"], 3),
        ]
        for name, label in (("test", "test scans, fitted latents"), ("train", "training scenes"))
    ]
    head = ["", "heads", "spread of x_ref, mm", "spread of x, mm", "size of x_ref / size of x"]
    return f"""How far each of the 468 landmarks is from its mean over the heads (root mean square, averaged over the
landmarks), after the deformation into reference space and before. The last column shows how much of that is shrinking.

{table(head, lines)}"""


def ablations_section(evidence: Path) -> str:
    """Trainings without a loss term."""
    results = _results(evidence / "ablations")
    if not results:
        return _missing("prior")
    lines = []
    for r in results:
        term = r["name"].removeprefix("without_")
        lines.append(
            [
                "all terms" if term == "complete" else f"without {term}",
                PURPOSES.get(term, ""),
                *(number(r["face"]), number(r["head"]), number(r["angle"], 1), percent(r["gradient"])),
                *(number(r["landmark"]), number(r["color"], 4), percent(r["connected"])),
            ]
        )
    head = ["training", "the term", "face, mm", "head, mm", "normals, °", "|∇f| in 0.9–1.1"]
    head += ["landmark spread, mm", "colour", "connected"]
    sizes = ", ".join(f"{name} {size}" for name, size in results[0]["sizes"].items())
    return f"""The SA-SM ({sizes})
trained for {results[0]["steps"]} steps with all terms, and with one weight at zero. These trainings are short and only
comparable with one another. All are measured alike on {results[0]["scans"]} test scans: distances from scan to surface
after the latents are fitted, normals on the head without hair, the gradient and connectedness of random heads at 1σ,
the spread of landmarks in reference space, and the difference of square roots of radiance after z_r is fitted too.

{table(head, lines)}"""


def sizes_section(evidence: Path) -> str:
    """Trainings of other sizes."""
    results = _results(evidence / "sizes")
    if not results:
        return _missing("sizes")
    names = list(results[0]["sizes"])
    lines = [
        [
            *(str(r["sizes"][name]) for name in names),
            *(number(r["face"]), number(r["head"]), number(r["angle"], 1)),
            *(str(r["parameters"]), number(r["forward"]), number(r["backward"])),
        ]
        for r in results
    ]
    head = [*names, "face, mm", "head, mm", "normals, °", "parameters", "distance, µs", "with derivatives, µs"]
    shipped = ", ".join(f"{name} {getattr(AvatarArchitecture(), name)}" for name in names)
    return f"""Each trained for {results[0]["steps"]} steps and measured on {results[0]["scans"]} test scans as the
ablations are; the rows differ in one size each from the first. Shipped: {shipped}.
Costs are microseconds a point: the signed distance alone, and distance and gradient with the derivative of a loss on
both by all parameters. On a shared machine they vary by a third from run to run.

{table(head, lines)}"""


def training_section(evidence: Path) -> str:
    """What the prior was trained on, and for how long."""
    data, collection = _result(evidence, "training"), _result(evidence, "collection")
    if data is None or collection is None:
        return _missing("prior")
    lines = [
        [
            split,
            str(collection[split]),
            ", ".join(f"{n} {s}" for s, n in sorted(collection[f"{split}_sources"].items())),
        ]
        for split in ("train", "test")
    ]
    trainings = [
        [name, str(data[model].get("step", "–")), number(data[model]["seconds"] / 60, 0)]
        for model, name in (("shape", "SA-SM"), ("appearance", "AF-SM"))
    ]
    return f"""{table(["split", "heads", "sources"], lines)}

{table(["model", "steps", "minutes"], trainings)}"""


def appearance_section(evidence: Path) -> str:
    """The AF-SM on unseen heads."""
    data = _result(evidence, "appearance")
    if data is None:
        return _missing("prior")
    points, images = data["points"], data["images"]

    def row(label: str, scores: dict, name: str, prefix: str, digits: int = 1) -> list[str]:
        keys = (f"{prefix}{kind}{name}" for kind in ("", "mean_", "constant_"))
        return [label, *(number(scores.get(key, float("nan")), digits) for key in keys)]

    lines = [
        [
            "re-rendering of unseen views, dB (sRGB)",
            number(points["render_psnr"], 1),
            "–",
            number(points["constant_render_psnr"], 1),
        ],
        [
            "the same of training heads",
            number(data["training"]["render_psnr"], 1),
            "–",
            number(data["training"]["constant_render_psnr"], 1),
        ],
        row("diffuse albedo, dB", points, "albedo_psnr", "points_"),
        row("… after one factor a channel", points, "albedo_psnr_scaled", "points_"),
        row("… of the face", points, "albedo_psnr", "face_"),
        row("… as images of unseen views, dB", images, "albedo_psnr", "image_"),
        row("… SSIM", images, "albedo_ssim", "image_", 3),
        row("specular albedo as strength, dB", images, "specular_psnr", "image_"),
        row("… SSIM", images, "specular_ssim", "image_", 3),
    ]
    groups = [
        [
            trait,
            name,
            f"{rows['scenes']:.0f}",
            number(rows["render_psnr"], 1),
            number(rows["face_albedo_psnr"], 1),
            number(rows["face_albedo_bias"], 2),
        ]
        for trait, by in (("source", data["by_source"]), ("ancestry", data["by_group"]))
        for name, rows in by.items()
    ]
    head = ["", "group", "scans", "re-rendering, dB", "albedo of the face, dB", "its bias, stops"]
    return f"""The latents of albedo, specular albedo and light are fitted to the training views of {data["scans"]} test
scans, at their fitted shapes, by the AF-SM's own losses; true albedo is never seen. Scores are on the two views that
training and fit leave out: radiance at visible points, albedo at all observed points, and albedo as images
({data["imaged"]} scans), inside the mask. Baselines are the mean head's albedo field and one colour, the mean of the
training heads (for re-rendering, of the view itself). Specular strength is the reflectance at normal incidence / 0.08.

{table(["", "fitted", "mean head's field", "one colour"], lines)}

Correlation of the albedo's error with the shading (leakage): {number(points["points_leakage"])} on the head,
{number(points["face_leakage"])} on the face. Mean bias of the face's albedo:
{number(points["face_albedo_bias"])} stops.

{table(head, groups)}

![Photo of an unseen view, re-rendering, true albedo, fitted albedo, under even light](images/prior_appearance.png)

From the left: an unseen view, its re-rendering, true albedo, fitted albedo, the fitted head under even white light."""


APPEARANCE_PURPOSES = {
    "embedding": "keeps the latents small",
    "smoothness": "keeps the albedo smooth",
    "specular_anchor": "holds the specular albedo near its region's level",
    "white_light": "settles the colour of light against albedo",
    "skin_tone": "settles the level of light against albedo",
}


def appearance_ablations_section(evidence: Path) -> str:
    """Trainings of the AF-SM without a loss term."""
    results = _results(evidence / "appearance_ablations")
    if not results:
        return _missing("prior")
    names = ("render_psnr", "points_albedo_psnr", "face_albedo_psnr", "face_albedo_psnr_scaled")
    lines = [
        [
            "all terms" if r["name"] == "complete" else r["name"].replace("without_", "without "),
            APPEARANCE_PURPOSES.get(r["name"].removeprefix("without_"), ""),
            *(number(r[name], 1) for name in names),
            number(r["face_albedo_bias"]),
            number(r["points_specular_psnr"], 1),
            number(r["face_leakage"]),
        ]
        for r in results
    ]
    head = ["training", "the term", "re-rendering, dB", "albedo, dB", "albedo of the face, dB", "… scaled, dB"]
    head += ["its bias, stops", "specular strength, dB", "leakage, face"]
    return f"""The AF-SM trained for {results[0]["steps"]} steps on the same SA-SM, with all terms and with one weight
at zero, measured on {results[0]["scans"]} test scans as above. The colour term is the objective and stays.

{table(head, lines)}"""


# Headings of the page and what writes the text below them.
SECTIONS: tuple[tuple[str, Callable[[Path], str]], ...] = (
    ("Data and training", training_section),
    ("Shape latents fitted to unseen heads", fits_section),
    ("By source, ancestry, sex and age", bias_section),
    ("Random heads", heads_section),
    ("Landmarks in reference space", landmarks_section),
    ("Appearance latents fitted to unseen heads", appearance_section),
    ("What each loss term of the SA-SM is for", ablations_section),
    ("What each loss term of the AF-SM is for", appearance_ablations_section),
    ("Width, depth, latents, encoding and γ", sizes_section),
)


def page(evidence: Path, sections=SECTIONS) -> str:
    """The page's Markdown."""
    parts = [
        "# How good the priors are",
        "Every number here comes from files that these commands write to RUNS/evidence; the last one writes the page:",
        COMMANDS,
    ]
    for heading, section in sections:
        parts += [f"## {heading}", section(evidence)]
    return "\n\n".join(parts) + "\n"


def write_page(evidence: Path, out: Path) -> Path:
    """Writes `out/priors.md` and copies its pictures to `out/images`; returns the page's path."""
    (out / "images").mkdir(parents=True, exist_ok=True)
    for picture in sorted(evidence.glob("*.png")):
        write_through(out / "images" / picture.name, lambda file, picture=picture: shutil.copyfile(picture, file))
    text = page(evidence)
    write_through(out / "priors.md", lambda file: file.write_text(text, encoding="utf-8"))
    return out / "priors.md"


def _missing(command: str) -> str:
    return f"Not measured yet: `python -m studies.priors {command}`."


def _met(condition: bool) -> str:
    return "met" if condition else "not met"
