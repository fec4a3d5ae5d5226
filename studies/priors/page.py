"""`docs/priors.md` and `docs/prior_trainings.md`: templates with the figures of `docs/data/priors.json` filled in."""

from collections.abc import Callable
from pathlib import Path
from string import Template

from sira_mi.files import write_text
from studies.markdown import number, percent, table

FIGURES = Path("data") / "priors.json"  # beside the pages
TEMPLATE, TRAININGS_TEMPLATE = (Path(__file__).with_name(name) for name in ("template.md", "trainings_template.md"))

# What the shape latents have to reach: face and head, mm; the face's share of the mean head's error; the share of
# random heads' surface points with a gradient of length 0.9 to 1.1.
FACE_LIMIT, HEAD_LIMIT, FACE_SHARE, GRADIENT_SHARE = 1.0, 2.0, 0.5, 0.95

SHAPE = """Only the shape latents of {scans} scans are fitted: {steps} steps of Adam, {points} points each. The networks
stay fixed and nothing is aligned. Distances in mm, averaged over scans.

{table}

Scan → surface: {measured_points} points per scan, two Newton steps to the zero level. Surface → scan: as many points
of the extracted surface, to the tangent disc (radius {radius:g} mm) of the nearest scan point. Scan points are
{spacing} mm apart. Where the scan has radius 10 mm, a disc is {typical} mm off half way between points, and at most
{largest} mm. Face: within 95 mm of the nose tip. All above y = −130 mm.

Median face error {median}; worst {worst_face} ({worst_scan}). Normals without hair: {normals}° (mean head:
{mean_normals}°). RMS of the whitened latent: {rms}; 1 is typical.

![Scans above, fits below](images/prior_fits.png)"""

HEADS = """Latents drawn from N(0, σ²) of the prior; |∇f| at surface points.

{heads}

![Heads at 1σ](images/prior_samples_1.png)
![Heads at 2σ](images/prior_samples_2.png)
![Principal directions](images/prior_directions.png)

1σ, 2σ, and the mean head with the first {count} principal directions of the training latents at −2σ and +2σ, which hold
{share} of the variance.

RMS distance of landmarks from their mean over heads, mm, before and after the deformation into reference space; `scale`
is the ratio of sizes, after over before.

{landmarks}"""

APPEARANCE = """Latents of albedo, specular albedo and light are fitted to the training views of {scans} scans by the
AF-SM's losses, without true albedo. Scores are of two held-out views, at points or as images ({imaged} scans).
`one colour`: mean of the training heads, for re-rendering of the view.

{table}

Leakage, the correlation of the albedo's error with the shading: {leakage} on the head, {face_leakage} on the face. Mean
bias of the face's albedo: {bias} stops.

![Photo of an unseen view, re-rendering, true albedo, fitted albedo, under even light](images/prior_appearance.png)"""

APPEARANCE_ROWS = (
    ("re-rendering, dB", "render_psnr", 1),
    ("the same of training heads", "training_render_psnr", 1),
    ("diffuse albedo, dB", "albedo_psnr", 1),
    ("… one factor per channel", "albedo_psnr_scaled", 1),
    ("… of the face", "face_albedo_psnr", 1),
    ("… as images", "image_albedo_psnr", 1),
    ("… SSIM", "image_albedo_ssim", 3),
    ("specular strength, dB", "image_specular_psnr", 1),
    ("… SSIM", "image_specular_ssim", 3),
)


def write_pages(figures: dict, out: Path) -> list[Path]:
    """Writes `out/priors.md` and `out/prior_trainings.md`; returns their paths."""
    pages = {out / name: text for name, text in render_pages(figures).items()}
    for path, text in pages.items():
        write_text(path, text)
    return list(pages)


def render_pages(figures: dict) -> dict[str, str]:
    """The Markdown of both pages by file name. A section without figures says which command measures them."""

    def section(write: Callable[[dict], str], command: str, *parts: str) -> str:
        if any(figures[part] is None for part in parts):
            return f"Not measured yet: `python -m studies.priors {command}`."
        return write(figures)

    return {
        "priors.md": Template(TEMPLATE.read_text(encoding="utf-8")).substitute(
            **figures["measured"],
            data=section(_data, "measure", "collection", "training"),
            marks=section(_marks, "measure", "shape", "random_heads"),
            shape=section(_shape, "measure", "shape"),
            groups=section(_groups, "measure", "groups"),
            heads=section(_heads, "measure", "random_heads", "directions", "landmarks"),
            appearance=section(_appearance, "measure", "appearance"),
        ),
        "prior_trainings.md": Template(TRAININGS_TEMPLATE.read_text(encoding="utf-8")).substitute(
            **figures["measured"],
            terms=section(_terms, "measure", "ablations", "appearance_ablations"),
            sizes=section(_sizes, "sizes", "sizes"),
        ),
    }


def _data(figures: dict) -> str:
    heads = []
    for split, data in figures["collection"].items():
        sources = ", ".join(f"{count} {source}" for source, count in data["sources"].items())
        heads.append(f"{split}: {data['heads']} heads ({sources})")
    trainings = (
        f"{name}: {number(data['steps'], 0)} steps, {number(data['minutes'], 0)} minutes"
        for name, data in figures["training"].items()
    )
    return f"{'; '.join(heads)}. {'; '.join(trainings)}."


def _marks(figures: dict) -> str:
    face, head = (figures["shape"]["scan_to_surface"][region] for region in ("face", "head without hair"))
    share = face["fitted"]["mean"] / face["mean_head"]["mean"]
    lines = [
        _bound("face, mm", f"≤{FACE_LIMIT:g}", number(face["fitted"]["mean"]), face["fitted"]["mean"] <= FACE_LIMIT),
        _bound("face over the mean head's", f"<{percent(FACE_SHARE)}", percent(share), share < FACE_SHARE),
        _bound(
            "head without hair, mm",
            f"≤{HEAD_LIMIT:g}",
            number(head["fitted"]["mean"]),
            head["fitted"]["mean"] <= HEAD_LIMIT,
        ),
    ]
    for sigma, row in figures["random_heads"].items():
        title = f"|∇f| in 0.9–1.1 on random heads, {sigma}σ"
        met = row["gradient"] >= GRADIENT_SHARE
        lines.append(_bound(title, f"≥{percent(GRADIENT_SHARE)}", percent(row["gradient"]), met))
    return table(("", "wanted", "measured", ""), lines)


def _bound(title: str, wanted: str, measured: str, met: bool) -> list[str]:
    return [title, wanted, measured, "met" if met else "**missed**"]


def _shape(figures: dict) -> str:
    data = figures["shape"]
    head = ("region", "scan → surface", "90%", "mean head", "surface → scan", "90%", "mean head")
    lines = []
    for region in data["scan_to_surface"]:
        both = [data[way][region] for way in ("scan_to_surface", "surface_to_scan")]
        cells = [(d["fitted"]["mean"], d["fitted"]["p90"], d["mean_head"]["mean"]) for d in both]
        lines.append([region, *(number(value) for three in cells for value in three)])
    return SHAPE.format(
        scans=data["scans"],
        steps=data["fit"]["steps"],
        points=data["fit"]["points"],
        table=table(head, lines),
        measured_points=data["points"],
        radius=data["disc_radius"],
        spacing=number(data["spacing"]),
        typical=number(data["spacing"] ** 2 / 8 / 10, 3),
        largest=number(data["disc_radius"] ** 2 / 20),
        median=number(data["median_face"]),
        worst_scan=data["worst"]["scan"],
        worst_face=number(data["worst"]["face"]),
        normals=number(data["normals"]["fitted"], 1),
        mean_normals=number(data["normals"]["mean_head"], 1),
        rms=number(data["rms_w"]),
    )


def _groups(figures: dict) -> str:
    lines = [
        [
            f"{row['trait']} {row['group']}",
            str(row["scans"]),
            *(number(row[name]) for name in ("face", "head")),
            number(row["face_albedo_psnr"], 1),
            number(row["face_albedo_bias"]),
        ]
        for row in figures["groups"]
        if row["group"] != "unknown"
    ]
    head = ("group", "scans", "face, mm", "head, mm", "face albedo, dB", "bias, stops")
    return (
        "Scan → surface, head without hair. A positive bias: the albedo is too light. Heads of unknown traits are left "
        "out.\n\n" + table(head, lines)
    )


def _heads(figures: dict) -> str:
    heads = [
        [
            f"{sigma}σ",
            f"{row['connected']} of {row['heads']}",
            percent(row["largest"]),
            f"{percent(row['gradient'])} ({percent(row['worst_gradient'])})",
        ]
        for sigma, row in figures["random_heads"].items()
    ]
    landmarks = [
        [
            title,
            str(figures["landmarks"][name]["scenes"]),
            *(number(figures["landmarks"][name][key]) for key in ("undeformed", "deformed")),
            number(figures["landmarks"][name]["scale"], 3),
        ]
        for name, title in (("test", "test scans"), ("train", "training scenes"))
    ]
    return HEADS.format(
        heads=table(("latents", "one connected surface", "largest part, at least", "|∇f| 0.9–1.1 (worst)"), heads),
        landmarks=table(("", "heads", "before", "after", "scale"), landmarks),
        count=figures["directions"]["count"],
        share=percent(figures["directions"]["share"]),
    )


def _appearance(figures: dict) -> str:
    data = figures["appearance"]
    lines = [
        [title, *(number(data["scores"][name][head], digits) for head in ("fitted", "mean_head", "constant"))]
        for title, name, digits in APPEARANCE_ROWS
    ]
    return APPEARANCE.format(
        scans=data["scans"],
        imaged=data["imaged"],
        table=table(("", "fitted", "mean head", "one colour"), lines),
        leakage=number(data["points_leakage"]),
        face_leakage=number(data["face_leakage"]),
        bias=number(data["face_albedo_bias"]),
    )


def _terms(figures: dict) -> str:
    shape, appearance = figures["ablations"], figures["appearance_ablations"]
    shape_lines = [
        [
            _training_title(row),
            *(number(row["face"]), number(row["angle"], 1), percent(row["gradient"])),
            *(number(row["landmark"]), number(row["color"], 3), percent(row["connected"])),
        ]
        for row in shape
    ]
    names = ("render_psnr", "points_albedo_psnr", "face_albedo_psnr_scaled")
    appearance_lines = [
        [
            _training_title(row),
            *(number(row[name], 1) for name in names),
            number(row["face_albedo_bias"]),
            number(row["points_specular_psnr"], 1),
        ]
        for row in appearance
    ]
    shape_head = ("SA-SM", "face, mm", "normals, °", "|∇f| 0.9–1.1", "landmarks, mm", "colour", "connected")
    appearance_head = ("AF-SM", "re-rendering, dB", "albedo, dB", "face, scaled, dB", "bias, stops", "specular, dB")
    trained = f"{shape[0]['steps']} steps, {shape[0]['scans']} scans (SA-SM: {_sizes_text(shape[0]['sizes'])})"
    tables = table(shape_head, shape_lines), table(appearance_head, appearance_lines)
    return "\n\n".join((f"Short trainings with one weight at zero: {trained}.", *tables))


def _training_title(row: dict) -> str:
    return "all terms" if row["name"] == "complete" else row["name"].replace("without_", "without ")


def _sizes(figures: dict) -> str:
    rows = figures["sizes"]
    first = rows[0]["sizes"]
    lines = []
    for row in rows:
        changed = {name: value for name, value in row["sizes"].items() if value != first[name]}
        lines.append(
            [
                _sizes_text(changed) or "unchanged",
                *(number(row[name]) for name in ("face", "head")),
                *(number(row["angle"], 1), str(row["parameters"]), number(row["forward"]), number(row["backward"])),
            ]
        )
    head = ("", "face, mm", "head, mm", "normals, °", "parameters", "distance, µs", "with derivatives, µs")
    return (
        f"{rows[0]['steps']} steps, {rows[0]['scans']} scans. One size at a time differs from {_sizes_text(first)}; "
        f"shipped is {_sizes_text(figures['shipped_sizes'])}.\n\n{table(head, lines)}\n\nCosts are per point: the "
        "signed distance alone, and distance and gradient with the derivatives of a loss by all parameters."
    )


def _sizes_text(sizes: dict[str, int]) -> str:
    return ", ".join(f"{name.removeprefix('sdf_')} {value}" for name, value in sizes.items())
