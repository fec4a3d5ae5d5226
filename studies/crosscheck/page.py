"""`docs/crosscheck.md`: `template.md` with the figures of `docs/data/crosscheck.json` filled in."""

from __future__ import annotations

from pathlib import Path
from string import Template

from sira_mi.files import write_text
from studies.crosscheck import causes, curves, speed
from studies.crosscheck.lights import SOFT
from studies.crosscheck.regions import GRAZING_COSINE, HEAD, REGIONS, SHADOW_SHARE
from studies.markdown import number, table

FIGURES = Path("data") / "crosscheck.json"  # beside the page
TEMPLATE = Path(__file__).with_name("template.md")
# What the closed form with visibility has to reach under the soft light.
ERROR_MARK, SPEED_MARK = 0.05, 50.0
SLOPE_MARK, SLOPE_TOLERANCE = -0.5, 0.05
# A difference of this share of the mean radiance has the strongest colour on the sheet.
DIFFERENCE_RANGE = 0.3
CLOSED_FORMS = (curves.PHYSG, curves.FORM, curves.VISIBLE, curves.SHARED, curves.SHARED_MESH)

_LETTERS = {causes.PHYSG: "(a)", causes.FORM: "(b)", causes.VISIBLE: "(c)"}


def percent(value: float | None, digits: int = 1) -> str:
    """A share in percent; a dash for None and NaN."""
    return number(None if value is None else 100 * value, digits)


def times(factor: float) -> str:
    """A factor, with decimals below 10."""
    return f"{factor:.0f}×" if factor >= 10 else f"{factor:.2f}×"


def write_page(figures: dict, out: Path) -> Path:
    """Writes `out/crosscheck.md`; returns its path."""
    write_text(out / "crosscheck.md", render_page(figures))
    return out / "crosscheck.md"


def render_page(figures: dict) -> str:
    """The page's Markdown."""
    case, settings, parts = figures["case"], figures["settings"], figures["speed"]
    measured = parts.get("measured", figures["measured"])
    costs = [speed.Cost(**cost) for cost in parts["costs"]]
    shade = [cost for cost in costs if cost.what == "shade"]
    width = [cost for cost in costs if cost.what == "sira_sg"]
    largest = max(shade, key=lambda cost: (cost.lobes, cost.points), default=None)
    return Template(TEMPLATE.read_text(encoding="utf-8")).substitute(
        command=figures["command"],
        case=case["name"],
        width=case["width"],
        height=case["height"],
        minutes=number(figures["seconds"] / 60, 0),
        revision=figures["measured"]["revision"],
        date=figures["measured"]["date"],
        marks=_marks(figures),
        soft=SOFT,
        curves=_curves(figures["lights"]),
        causes=_causes(figures["lights"]),
        regions=_regions(figures["lights"]),
        references=_references(figures["lights"]),
        voxel=f"{settings['voxel']:g}",
        usual_voxel=f"{settings['usual_voxel']:g}",
        bound=f"{percent(settings['bound'])}%",
        shadow=f"{SHADOW_SHARE:.0%}",
        grazing=f"{GRAZING_COSINE:g}",
        range=f"{DIFFERENCE_RANGE:.0%}",
        speed_revision=measured["revision"],
        speed_date=measured["date"],
        ratios=_ratios([speed.Ratio(**ratio) for ratio in parts["ratios"]]),
        widths=table(
            ("width of all networks", *(f"{cost.width}" for cost in width)),
            [["µs a pixel of the head", *(number(1e6 * cost.seconds / max(cost.points, 1), 1) for cost in width)]],
        ),
        shade_nanoseconds=number(1e9 * largest.seconds / (largest.lobes * largest.points), 1) if largest else "–",
        shade_lobes=f"{largest.lobes}" if largest else "–",
        shade_points=f"{largest.points:,}" if largest else "–",
        by_lobes=number(speed.growth(shade, "lobes")),
        by_points=number(speed.growth(shade, "points")),
        by_width=number(speed.growth(width, "width")),
        fits=_fits(figures),
    )


def _verdict(met: bool) -> str:
    return "reached" if met else "**missed**"


def _points(light: dict) -> list[curves.Point]:
    return [curves.Point(**point) for point in light["points"]]


def _rows(light: dict) -> list[causes.Row]:
    return [causes.Row(**row) for row in light["causes"]]


def _total(light: dict, form: str) -> causes.Row:
    return next(row for row in _rows(light) if (row.form, row.cause) == (form, causes.TOTAL))


def find_speedups(points: list[curves.Point], method: str) -> list[tuple[curves.Point, float]]:
    """For each point of a method how many times as long the path tracer takes to its error."""
    return [(p, curves.time_of_path(points, p.light, p.error) / p.seconds) for p in points if p.method == method]


def _marks(figures: dict) -> str:
    lights, lines = figures["lights"], []
    soft = next((light for light in lights if light["light"] == SOFT), None)
    if soft is not None:
        error = _total(soft, causes.VISIBLE).errors[HEAD]
        assert error is not None, "a reference has pixels"
        lines.append(["relative RMSE with visibility", "≤ 5%", f"{percent(error)}%", _verdict(error <= ERROR_MARK)])
        for method in (curves.VISIBLE, curves.SHARED, curves.SHARED_MESH):
            point, factor = max(find_speedups(_points(soft), method), key=lambda pair: pair[1])
            lines.append(
                [
                    f"path tracing's time to the same error ({percent(point.error)}%) over {method}",
                    f"≥ {SPEED_MARK:.0f}×",
                    times(factor),
                    _verdict(factor >= SPEED_MARK),
                ]
            )
    for ratio in (speed.Ratio(**ratio) for ratio in figures["speed"]["ratios"]):
        if ratio.mark is not None:
            name = f"{ratio.name} over {ratio.over}"
            lines.append([name, f"≤ {ratio.mark:g}×", times(ratio.value), _verdict(ratio.met)])
    slopes = curves.slopes([point for light in lights for point in _points(light)])
    if slopes:
        worst = max((slope.over_samples for slope in slopes), key=lambda slope: abs(slope - SLOPE_MARK))
        lines.append(
            [
                "slope of path tracing's error over samples, worst light",
                f"−{-SLOPE_MARK} ± {SLOPE_TOLERANCE}",
                f"{worst:.3f}",
                _verdict(abs(worst - SLOPE_MARK) <= SLOPE_TOLERANCE),
            ]
        )
    limits = [curves.Limit(**limit) for light in lights for limit in light["limits"]]
    shares = [limit.error / limit.resolution for limit in limits if limit.method == curves.PATH]
    if shares:
        lines.append(
            [
                "limit of path tracing: distance from the reference over its noise, worst light",
                "≤ 1",
                number(max(shares)),
                _verdict(max(shares) <= 1),
            ]
        )
    return table(("", "to reach", "measured", ""), lines)


def _curves(lights: list[dict]) -> str:
    rows = []
    for method in dict.fromkeys(point["method"] for light in lights for point in light["points"]):
        cells = []
        for light in lights:
            points = _points(light)
            last = [point for point in points if point.method == method][-1]
            factors = [factor for _, factor in find_speedups(points, method)] if method in CLOSED_FORMS else []
            cells.append(f"{percent(last.error)}%" + (f", {times(max(factors))}" if factors else ""))
        rows.append([method, *cells])
    return table(("", *(light["light"] for light in lights)), rows)


def _causes(lights: list[dict]) -> str:
    """Errors over the head: a row for each form and cause, a column for each light. Causes that two forms share are
    told once."""
    by_light = [{(row.form, row.cause): row for row in _rows(light)} for light in lights]
    lines, shared = [], (causes.PROXY, causes.BAKED, causes.REST)
    for form, cause in by_light[0]:
        if form == causes.PHYSG and cause not in (causes.INTEGRAL, causes.TOTAL):
            continue
        if form == causes.FORM and cause in shared:
            continue
        title = f"{_LETTERS[form]} {cause}" if form else cause
        lines.append([title, *(percent(rows[form, cause].errors[HEAD], 2) for rows in by_light)])
    return table(("", *(light["light"] for light in lights)), lines)


def _regions(lights: list[dict]) -> str:
    lines = [
        [light["light"], *(percent(_total(light, causes.VISIBLE).errors[region], 2) for region in REGIONS)]
        for light in lights
    ]
    return table(("", *REGIONS), lines)


def _references(lights: list[dict]) -> str:
    lines = []
    for light in lights:
        reference = light["reference"]
        noise = [row.resolution for row in _rows(light) if row.cause == causes.REST and row.resolution is not None]
        lines.append(
            [
                light["light"],
                f"{reference['samples']}",
                f"{percent(reference['error'], 2)}%",
                f"{percent(max(noise), 2)}%",
                f"{percent(light['agreement'], 2)}%",
                f"{light['non_finite']} of {light['launches']}",
            ]
        )
    head = ("", "samples a pixel", "standard error", "resolution", "agreement", "launches with NaN")
    return table(head, lines)


def _ratios(ratios: list[speed.Ratio]) -> str:
    if not ratios:
        return "Not measured (`--no-speed`)."
    return table(("time of", "over", "ratio"), [[r.name, r.over, times(r.value)] for r in ratios])


def _fits(figures: dict) -> str:
    rows, measured = figures["fits"]["rows"], figures["fits"].get("measured", figures["measured"])
    if not rows:
        return "Not measured (`--fits`)."
    head = ("quality", "portraits", "median s", "face, mm", "re-render, dB")
    lines = [
        [r["label"], f"{r['portraits']}", f"{r['seconds']:.0f}", number(r["millimetres"]), number(r["decibels"], 1)]
        for r in rows
    ]
    return (
        f"{table(head, lines)}\n\nThe shipped fit over the [benchmark's portraits](results.md), at revision "
        f"`{measured['revision']}` on {measured['date']}.\n\n"
        "![Error of fits against time](images/crosscheck_fits.svg)"
    )
