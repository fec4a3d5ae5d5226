"""`docs/results.md`: `template.md` with the figures of `docs/data/portraits.json` filled in."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from string import Template
from typing import Any

from sira_mi.files import write_text
from studies.markdown import number, table

FIGURES = Path("data") / "portraits.json"  # beside the page
TEMPLATE = Path(__file__).with_name("template.md")
AT_MOST, AT_LEAST = "≤", "≥"


@dataclass(frozen=True)
class Column:
    """One score of a table."""

    title: str
    score: str
    digits: int = 2


GEOMETRY_COLUMNS = (
    Column("face", "h3ds_face_mean"),
    Column("no ICP", "camera_face_mean"),
    Column("head", "h3ds_head_mean"),
    Column("hidden half", "h3ds_hidden_mean"),
    Column("normals, °", "normals_mean", 1),
    Column("IoU", "silhouette_iou", 3),
)
LIGHT_COLUMNS = (
    Column("face, mm", "h3ds_face_mean"),
    Column("final, dB", "final_psnr", 1),
    Column("eq. 8, dB", "shaded_psnr", 1),
    Column("diffuse, dB", "diffuse_psnr", 1),
    Column("specular, dB", "specular_psnr", 1),
)
ABLATION_COLUMNS = (
    Column("final, dB", "final_psnr", 1),
    Column("eq. 8, dB", "shaded_psnr", 1),
    Column("diffuse, dB", "diffuse_psnr", 1),
    Column("scaled, dB", "diffuse_scaled_psnr", 1),
    Column("leakage", "leakage_shading"),
)


@dataclass(frozen=True)
class Mark:
    """A bound that the shipped fit has to meet."""

    title: str
    sign: str  # AT_MOST or AT_LEAST
    limit: float
    value: Callable[[dict], float | None]  # of the figures
    digits: int = 2

    def is_met(self, value: float) -> bool:
        return value <= self.limit if self.sign == AT_MOST else value >= self.limit


def find(figures: dict, *path: str) -> Any:
    """The value at a path of keys; None where a key is missing."""
    value: Any = figures
    for key in path:
        if key not in value:
            return None
        value = value[key]
    return value


def _of_fit(group: str, score: str) -> Callable[[dict], float | None]:
    return lambda figures: find(figures, "shipped", "methods", figures["roles"]["shipped"], group, score)


def _over_mean_head(figures: dict) -> float | None:
    fit, mean = (
        find(figures, "shipped", "methods", figures["roles"][role], "geometry", "h3ds_face_mean")
        for role in ("shipped", "baseline")
    )
    return None if fit is None or mean is None else fit / mean


def _gain_over_ablations(figures: dict) -> float | None:
    """Of the fit's geometry over the best of the methods before it."""
    methods = figures["ablations"]["methods"]
    found = {name: find(methods, name, "geometry", "h3ds_face_mean") for name in methods if name.startswith("a.")}
    own = found.pop(figures["roles"]["geometry"], None)
    others = [value for value in found.values() if value is not None]
    return None if own is None or not others else own - min(others)


def _draft_face(figures: dict) -> float | None:
    """Of the shipped method, or of its geometry stages where nothing after them moves the shape."""
    methods, shipped = figures["ablations"]["methods"], figures["roles"]["shipped"]
    if shipped not in methods:
        return None
    last = shipped if "geometry" in methods[shipped] else figures["roles"]["geometry"]
    return find(methods, last, "geometry", "h3ds_face_mean")


def _gigabytes(figures: dict) -> float | None:
    megabytes = find(figures, "shipped", "fit_megabytes")
    return None if megabytes is None else megabytes / 1000


MARKS = (
    Mark("face, mm", AT_MOST, 1.0, _of_fit("geometry", "h3ds_face_mean")),
    Mark("over the mean head's", AT_MOST, 0.7, _over_mean_head),
    Mark("face, no ICP, mm", AT_MOST, 1.5, _of_fit("geometry", "camera_face_mean")),
    Mark("face normals, °", AT_MOST, 8, _of_fit("geometry", "normals_mean"), 1),
    Mark("geometry minus best ablation, mm", AT_MOST, 0, _gain_over_ablations),
    Mark("silhouette IoU", AT_LEAST, 0.97, _of_fit("geometry", "silhouette_iou"), 3),
    Mark("final render, dB", AT_LEAST, 34, _of_fit("appearance", "final_psnr"), 1),
    Mark("final render, SSIM", AT_LEAST, 0.95, _of_fit("appearance", "final_ssim"), 3),
    Mark("eq. 8 alone, dB", AT_LEAST, 34, _of_fit("appearance", "shaded_psnr"), 1),
    Mark("diffuse albedo, dB", AT_LEAST, 23, _of_fit("appearance", "diffuse_psnr"), 1),
    Mark("diffuse albedo, SSIM", AT_LEAST, 0.88, _of_fit("appearance", "diffuse_ssim"), 3),
    Mark("specular albedo, dB", AT_LEAST, 19.5, _of_fit("appearance", "specular_psnr"), 1),
    Mark("specular albedo, SSIM", AT_LEAST, 0.71, _of_fit("appearance", "specular_ssim"), 3),
    Mark("fit, s", AT_MOST, 300, lambda figures: find(figures, "shipped", "fit_seconds"), 0),
    Mark("peak memory, GB", AT_MOST, 2, _gigabytes, 1),
    Mark("draft, s", AT_MOST, 60, lambda figures: find(figures, "ablations", "fit_seconds"), 1),
    Mark("face of a draft, mm", AT_MOST, 1.2, _draft_face),
)


def write_page(figures: dict, out: Path) -> Path:
    """Writes `out/results.md`; returns its path."""
    write_text(out / "results.md", render_page(figures))
    return out / "results.md"


def render_page(figures: dict) -> str:
    """The page's Markdown."""
    shipped, ablations = figures["shipped"], figures["ablations"]
    return Template(TEMPLATE.read_text(encoding="utf-8")).substitute(
        portraits=figures["portraits"],
        revision=figures["measured"]["revision"],
        date=figures["measured"]["date"],
        quality=shipped["quality"],
        ablation_quality=ablations["quality"],
        geometry_method=figures["roles"]["geometry"],
        shipped_method=figures["roles"]["shipped"],
        marks=_marks(figures),
        geometry=table(
            ("", "quality", *(c.title for c in GEOMETRY_COLUMNS)),
            [
                *_geometry_rows(shipped),
                *(row for row in _geometry_rows(ablations) if row[0] != figures["roles"]["baseline"]),
            ],
        ),
        lights=_lights(figures),
        ablations=table(
            ("", *(c.title for c in ABLATION_COLUMNS), "s"),
            [
                [f"{name} {method['title']}", *_cells(method["appearance"], ABLATION_COLUMNS), _seconds(method)]
                for name, method in ablations["methods"].items()
                if "appearance" in method
            ],
        ),
        failed=_failed(figures["failed"]),
    )


def _cells(scores: dict, columns: Sequence[Column]) -> list[str]:
    return [number(scores.get(c.score), c.digits) for c in columns]


def _seconds(method: dict) -> str:
    return number(method.get("seconds"), 0)


def _marks(figures: dict) -> str:
    lines = []
    for mark in MARKS:
        value = mark.value(figures)
        verdict = "–" if value is None else "met" if mark.is_met(value) else "**missed**"
        lines.append([mark.title, f"{mark.sign}{mark.limit:g}", number(value, mark.digits), verdict])
    return table(("", "wanted", "measured", ""), lines)


def _geometry_rows(quality: dict) -> list[list[str]]:
    return [
        [f"{name} {method['title']}".strip(), quality["quality"], *_cells(method["geometry"], GEOMETRY_COLUMNS)]
        for name, method in quality["methods"].items()
        if "geometry" in method
    ]


def _lights(figures: dict) -> str:
    """Rows of the shipped fit: all portraits, each light, and the smallest and largest value over portraits."""
    fit = find(figures, "shipped", "methods", figures["roles"]["shipped"]) or {}
    everywhere = {**fit.get("geometry", {}), **fit.get("appearance", {})}
    lines = [["all", *_cells(everywhere, LIGHT_COLUMNS)]]
    lines += [[light, *_cells(scores, LIGHT_COLUMNS)] for light, scores in figures["lights"].items()]
    for title, choose in (("smallest", min), ("largest", max)):
        known = {c.score: [v for row in figures["each"] if (v := row.get(c.score)) is not None] for c in LIGHT_COLUMNS}
        lines.append([title, *_cells({s: choose(v) for s, v in known.items() if v}, LIGHT_COLUMNS)])
    return table(("light", *(c.title for c in LIGHT_COLUMNS)), lines)


def _failed(failed: Sequence[dict]) -> str:
    if not failed:
        return ""
    lines = [[row["portrait"], row["method"], row["error"]] for row in failed]
    return "\n## Fits that failed\n\n" + table(("portrait", "method", "error"), lines) + "\n"
