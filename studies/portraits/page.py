"""`docs/results.md`: `template.md` with the figures of `docs/data/foreign.json` and `docs/data/own.json` filled in."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from string import Template
from typing import Any

from sira_mi.errors import InputError
from sira_mi.files import write_text
from studies.data import read_figures
from studies.markdown import number, table
from studies.portraits.relit_scores import SHARES
from studies.portraits.rows import RUNGS

FIGURES = {kind: Path("data") / f"{kind}.json" for kind in ("foreign", "own")}  # beside the page
PICTURES = {"rows": Path("images") / "results.jpg", "worst": Path("images") / "results_worst.jpg"}
TEMPLATE = Path(__file__).with_name("template.md")
NOTES = ("stranger",)  # parts of the figures of `foreign` that are given, not measured by the page
NOT_MEASURED = "Not measured yet."


@dataclass(frozen=True)
class Column:
    """One score of a table: its value at a path of keys in a row's figures."""

    title: str
    path: tuple[str, ...]
    digits: int = 2
    factor: float = 1.0


def _scores(statistic: str, *columns: tuple) -> tuple[Column, ...]:
    return tuple(Column(title, (statistic, score), *digits) for title, score, *digits in columns)


HEADLINE = (
    *_scores(
        "mean",
        ("relit, dB", "relit_psnr", 1),
        ("SSIM", "relit_ssim", 3),
        ("ꟻLIP", "relit_flip", 3),
        ("scaled, dB", "relit_scaled_psnr", 1),
        ("turned, dB", "turned_psnr", 1),
        ("SSIM", "turned_ssim", 3),
        ("ꟻLIP", "turned_flip", 3),
        ("scaled, dB", "turned_scaled_psnr", 1),
    ),
    *_scores("to_draft", ("to draft, dB", "relit_psnr", 1), ("SSIM", "relit_ssim", 3)),
)
TAILS = tuple(
    column
    for title, statistic in (("worst", "worst"), ("darkest fifth", "darkest"))
    for column in _scores(
        statistic,
        (f"{title}: relit, dB", "relit_psnr", 1),
        ("SSIM", "relit_ssim", 3),
        ("scaled, dB", "relit_scaled_psnr", 1),
        ("turned, dB", "turned_psnr", 1),
    )
)
PARTS = _scores(
    "mean",
    *(
        column
        for title, part in (("face", "face"), ("hair", "hair"), ("clothes", "cloth"))
        for column in ((f"{title}, dB", f"relit_{part}_psnr", 1), ("SSIM", f"relit_{part}_ssim", 3))
    ),
)
SHARE_TITLES = {"skin": "other skin", "cloth": "clothes"}
SHARE_COLUMNS = (
    *(Column(SHARE_TITLES.get(name, name), ("mean", f"relit_share_{name}"), 0, 100) for name in SHARES),
    Column("spill", ("mean", "relit_spill"), 0, 100),
)
GEOMETRY = (
    *_scores(
        "mean",
        ("face", "h3ds_face_mean"),
        ("there", "h3ds_face_truth_to_prediction_mean"),
        ("back", "h3ds_face_prediction_to_truth_mean"),
        ("over mean head", "over_mean_head"),
    ),
    Column("worst", ("worst", "over_mean_head")),
    Column("above 1, %", ("mean", "above_mean_head"), 0, 100),
    *_scores(
        "mean",
        ("ears", "h3ds_ears_mean"),
        ("head", "h3ds_head_mean"),
        ("frame", "camera_face_mean"),
        ("normals, °", "normals_mean", 1),
        ("pose, °", "pose_error", 1),
        ("camera, %", "camera_distance_error_size", 0),
        ("IoU", "silhouette_iou", 3),
    ),
)
APPEARANCE = (
    *_scores(
        "mean",
        ("albedo, dB", "diffuse_psnr", 1),
        ("SSIM", "diffuse_ssim", 3),
        ("scaled, dB", "diffuse_scaled_psnr", 1),
        ("bias", "tone_bias"),
        ("its size", "tone_bias_size"),
    ),
    *(Column(f"bias, {tone}", ("by", "tone", tone, "tone_bias")) for tone in ("dark", "medium", "light")),
    *(Column(f"ITA, {tone}", ("by", "tone", tone, "tone_ita_error"), 0) for tone in ("dark", "medium", "light")),
    *_scores(
        "mean",
        ("specular, dB", "specular_gain", 1),
        ("leakage", "leakage_shading"),
        ("final, dB", "final_psnr", 1),
        ("SSIM", "final_ssim", 3),
        ("eq. 8, dB", "shaded_psnr", 1),
    ),
)
OWN = _scores(
    "mean",
    ("relit, dB", "relit_psnr", 1),
    ("SSIM", "relit_ssim", 3),
    ("turned, dB", "turned_psnr", 1),
    ("face, mm", "h3ds_face_mean"),
    ("over mean head", "over_mean_head"),
    ("head, mm", "h3ds_head_mean"),
    ("normals, °", "normals_mean", 1),
    ("IoU", "silhouette_iou", 3),
    ("albedo, dB", "diffuse_psnr", 1),
    ("final, dB", "final_psnr", 1),
    ("eq. 8, dB", "shaded_psnr", 1),
)
COSTS = (
    Column("fit, s", ("cpu_seconds",), 0),
    Column("pictures, s", ("relight_cpu_seconds",), 0),
    Column("memory, GB", ("peak_memory_megabytes",), 1, 1e-3),
)
LADDER = (
    *_scores("mean", ("relit, dB", "relit_psnr", 1), ("SSIM", "relit_ssim", 3), ("turned, dB", "turned_psnr", 1)),
    *_scores("to_draft", ("to draft, dB", "relit_psnr", 1), ("SSIM", "relit_ssim", 3)),
)


def find(figures: Mapping, *path: str) -> Any:
    """The value at a path of keys; None where a key is missing."""
    value: Any = figures
    for key in path:
        if not isinstance(value, Mapping) or key not in value:
            return None
        value = value[key]
    return value


def write_page(out: Path) -> Path:
    """Writes `out/results.md` from the figures beside it, of which one may be missing; returns its path."""
    figures = {kind: read_figures(out / path) for kind, path in FIGURES.items() if (out / path).exists()}
    if not figures:
        raise InputError(f"{out} has no figures of a study; give --benchmark and --runs to measure them")
    write_text(out / "results.md", render_page(figures.get("foreign"), figures.get("own")))
    return out / "results.md"


def render_page(foreign: dict | None, own: dict | None) -> str:
    """The page's Markdown from the figures of both benchmarks; None for one that is not measured."""
    shown = foreign or {"portraits": 0, "identities": 0, "rows": {}, "groups": {}, "failed": [], "measured": {}}
    rows = {name: row for name, row in shown["rows"].items() if name not in RUNGS}
    ladder = {name: row for name, row in shown["rows"].items() if name in RUNGS}
    shown = {**shown, "rows": rows}
    return Template(TEMPLATE.read_text(encoding="utf-8")).substitute(
        what=_describe(shown),
        revision=find(shown, "measured", "revision") or "–",
        date=find(shown, "measured", "date") or "–",
        headline=render_table(rows, HEADLINE),
        tails=render_table(rows, TAILS),
        parts=render_table(rows, PARTS),
        shares=render_table(rows, SHARE_COLUMNS),
        groups_psnr=_groups(shown, "relit_psnr", 1),
        groups_ssim=_groups(shown, "relit_ssim", 3),
        groups_face=_groups(shown, "h3ds_face_mean", 2),
        geometry=render_table(rows, GEOMETRY),
        appearance=render_table(rows, APPEARANCE),
        ladder=_ladder(ladder) + _strangers(shown.get("stranger", [])),
        cost=render_table(rows, COSTS),
        own=_own(own),
        failed=_failed([*shown["failed"], *(own["failed"] if own else [])]),
        pictures=_pictures(shown.get("pictures", {})),
    )


def _describe(figures: Mapping) -> str:
    return (
        f"{figures['portraits']} portraits of {figures['identities']} people ([benchmark](benchmark.md)): heads from "
        "elsewhere, which\nnothing in the fit has seen, the half of them on which no setting was chosen."
    )


def render_table(rows: Mapping[str, dict], columns: Sequence[Column]) -> str:
    """A line for each of the figures' `rows` that has one of the columns, as Markdown. Columns that no row
    has are left out."""
    columns = [c for c in columns if any(find(row, *c.path) is not None for row in rows.values())]
    lines = []
    for row in rows.values():
        values = [find(row, *column.path) for column in columns]
        if any(value is not None for value in values):
            cells = (
                number(None if value is None else column.factor * value, column.digits)
                for column, value in zip(columns, values, strict=True)
            )
            lines.append([row["title"], str(row["count"]), *cells])
    return table(("", "n", *(column.title for column in columns)), lines) if lines else NOT_MEASURED


def _groups(figures: Mapping, score: str, digits: int) -> str:
    titles = {
        (kind, name): f"{name} ({count})" for kind, names in figures["groups"].items() for name, count in names.items()
    }
    columns = [Column(title, ("by", *group, score), digits) for group, title in titles.items()]
    return render_table(figures["rows"], columns)


def _own(own: dict | None) -> str:
    if own is None:
        return NOT_MEASURED
    measured = own["measured"]
    return (
        f"{own['portraits']} portraits, measured at revision `{measured['revision']}` on {measured['date']}: "
        f"[data/own.json](data/own.json).\n\n{render_table(own['rows'], OWN)}"
    )


def _ladder(rows: Mapping[str, dict]) -> str:
    """The rows of `studies.portraits.ladder`."""
    if not rows:
        return ""
    return (
        f"\n## The ladder\n\n{render_table(rows, LADDER)}\n\nA draft with one estimated thing at a time replaced by "
        "its truth, then with all: what each is worth, and the ceiling.\n"
    )


def _strangers(tests: Sequence[Mapping]) -> str:
    """Dicts of `title` of the row, `by` whom, how many were `right` `of` how many."""
    if not tests:
        return ""
    lines = [[test["title"], test["by"], f"{test['right']} of {test['of']}"] for test in tests]
    return (
        "\n## The stranger's test\n\n"
        + table(("", "paired by", "right"), lines)
        + "\n\nRelit and turned heads, paired blindly with photos: `python -m studies.portraits stranger`.\n"
    )


def _failed(failed: Sequence[Mapping]) -> str:
    if not failed:
        return ""
    lines = [[row["portrait"], row["row"], row["error"]] for row in failed]
    return "\n## What failed\n\n" + table(("portrait", "row", "error"), lines) + "\n"


def _pictures(pictures: Mapping) -> str:
    """`rows` describes the sheet of all rows, `worst` that of the worst portraits."""
    titles = {"rows": "Some portraits in all rows", "worst": "The worst portraits"}
    lines = [f"{pictures[name]}\n\n![{titles[name]}]({path})\n" for name, path in PICTURES.items() if name in pictures]
    return "\n## Pictures\n\n" + "\n".join(lines) if lines else ""
