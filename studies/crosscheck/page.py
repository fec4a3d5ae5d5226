"""`docs/crosscheck.md` and its tables as CSV, from what was measured."""

from __future__ import annotations

import csv
import dataclasses
import io
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from sira_mi.files import write_through
from studies.crosscheck import causes, curves, speed
from studies.crosscheck.evidence import Lit
from studies.crosscheck.fits import FitPoint
from studies.crosscheck.lights import SOFT
from studies.crosscheck.plots import DIFFERENCE_RANGE, plot_curves, plot_fits, sheet
from studies.crosscheck.regions import GRAZING_COSINE, HEAD, REGIONS, SHADOW_SHARE
from studies.crosscheck.run import Measured
from studies.markdown import number, table

# What the closed form with visibility has to reach under the soft light.
ERROR_MARK, SPEED_MARK = 0.05, 50.0
_SLOPE_TOLERANCE = 0.05
_IMAGES = "images/crosscheck_{}"


def percent(value: float, digits: int = 1) -> str:
    """A share in percent; a dash for NaN."""
    return number(100 * value, digits)


def write_page(out: Path, measured: Measured, fits: Sequence[FitPoint], command: str) -> Path:
    """Writes `crosscheck.md`, the folder `crosscheck` of CSV files and the figures in `images` to the folder `out`.

    Raises InputError when they cannot be written."""
    _write_tables(out / "crosscheck", measured, fits)
    plot_curves(measured.lit, out / _IMAGES.format("curves.svg"))
    sheet(measured.lit, out / _IMAGES.format("causes.png"))
    if fits:
        plot_fits(fits, out / _IMAGES.format("fits.svg"))
    path = out / "crosscheck.md"
    write_through(path, lambda file: file.write_text(page(measured, fits, command), encoding="utf-8"))
    return path


def _write_csv(path: Path, head: Sequence[str], rows: Iterable[Sequence]) -> None:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(head)
    writer.writerows([f"{v:.6g}" if isinstance(v, float) else v for v in row] for row in rows)
    write_through(path, lambda file: file.write_text(text.getvalue(), encoding="utf-8"))


def _write_records(path: Path, kind: type, records: Sequence) -> None:
    _write_csv(path, [field.name for field in dataclasses.fields(kind)], map(dataclasses.astuple, records))


def _write_tables(folder: Path, measured: Measured, fits: Sequence[FitPoint]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    points = [point for one in measured.lit for point in one.points]
    _write_records(folder / "curves.csv", curves.Point, points)
    _write_records(folder / "limits.csv", curves.Limit, [limit for one in measured.lit for limit in one.limits])
    _write_records(folder / "slopes.csv", curves.Slope, curves.slopes(points))
    regions = (*REGIONS, HEAD)
    head = ("light", "form", "cause", *regions, "bias", "share", "resolution")
    rows = [
        (
            row.light,
            row.form,
            row.cause,
            *(row.errors[region] for region in regions),
            row.bias,
            row.share,
            row.resolution,
        )
        for one in measured.lit
        for row in one.rows
    ]
    _write_csv(folder / "causes.csv", head, rows)
    _write_records(folder / "ratios.csv", speed.Ratio, measured.ratios)
    _write_records(folder / "costs.csv", speed.Cost, measured.costs)
    if fits:
        _write_records(folder / "fits.csv", FitPoint, fits)


def page(measured: Measured, fits: Sequence[FitPoint], command: str) -> str:
    """The page's text."""
    case, settings = measured.case, measured.settings
    sections = [
        _INTRODUCTION.format(
            command=command,
            name=case.name,
            width=case.width,
            height=case.height,
            voxel=f"{settings.voxel:g}",
            minutes=number(measured.seconds / 60, 0),
        ),
        "## Marks\n\n" + _marks(measured),
        "## References\n\n" + _references(measured),
        "## Error against run time\n\n" + _curves(measured),
        "## Causes\n\n" + _causes(measured),
        "## Speed\n\n" + (_speed(measured) if measured.ratios else "Not measured in this run (`--no-speed`)."),
        "## The fit\n\n" + _fits(fits),
    ]
    return "\n\n".join(sections) + "\n"


def _soft(measured: Measured) -> Lit | None:
    return next((one for one in measured.lit if one.light == SOFT), None)


def _total(one: Lit, form: str) -> float:
    return next(row.errors[HEAD] for row in one.rows if (row.form, row.cause) == (form, causes.TOTAL))


def speedups(one: Lit, method: str) -> list[tuple[curves.Point, float]]:
    """For each point of a method how many times as long the path tracer takes for its error."""
    points = [point for point in one.points if point.method == method]
    return [(point, curves.time_of_path(one.points, one.light, point.error) / point.seconds) for point in points]


def _verdict(met: bool, missed_by: str) -> str:
    return "reached" if met else f"**missed** {missed_by}"


def _marks(measured: Measured) -> str:
    lines, soft = [], _soft(measured)
    if soft is not None:
        error = _total(soft, causes.VISIBLE)
        lines.append(
            [
                "with visibility against full path tracing, soft light, relative RMSE",
                f"≤ {percent(ERROR_MARK, 0)}%",
                f"{percent(error)}%",
                _verdict(error <= ERROR_MARK, f"by {percent(error - ERROR_MARK)} percentage points"),
            ]
        )
        for method in (curves.VISIBLE, curves.SHARED, curves.SHARED_MESH):
            point, factor = max(speedups(soft, method), key=lambda pair: pair[1])
            lines.append(
                [
                    f"{method[method.index(' ') + 1 :]}: path tracing's time for the same error, soft light "
                    f"({point.samples} sample{'s' * (point.samples > 1)} a pixel, error {percent(point.error)}%)",
                    f"≥ {SPEED_MARK:.0f}×",
                    f"{factor:.2g}×",
                    _verdict(factor >= SPEED_MARK, f"by a factor of {SPEED_MARK / factor:.1f}"),
                ]
            )
    for ratio in measured.ratios:
        if ratio.mark is not None:
            lines.append(
                [
                    f"{ratio.name} over {ratio.over}",
                    f"≤ {ratio.mark:g}×",
                    f"{ratio.value:.3g}×",
                    _verdict(ratio.met, f"by a factor of {ratio.value / ratio.mark:.3g}"),
                ]
            )
    for slope in curves.slopes([point for one in measured.lit for point in one.points]):
        met = abs(slope.over_samples + 0.5) <= _SLOPE_TOLERANCE
        lines.append(
            [
                f"slope of the path tracer, {slope.light}: error over samples (over time)",
                f"−0.5 ± {_SLOPE_TOLERANCE}",
                f"{slope.over_samples:.3f} ({slope.over_time:.3f})",
                _verdict(met, f"by {abs(slope.over_samples + 0.5) - _SLOPE_TOLERANCE:.3f}"),
            ]
        )
    for one in measured.lit:
        for limit in one.limits:
            if limit.method == curves.PATH:
                lines.append(
                    [
                        f"limit of the path tracer against the reference, {one.light}",
                        "0 within noise",
                        f"{percent(limit.error, 2)}% (noise {percent(limit.resolution, 2)}%)",
                        _verdict(limit.error <= limit.resolution, f"by {percent(limit.error - limit.resolution, 2)}%"),
                    ]
                )
    return table(("", "to reach", "measured", ""), lines) + "\n\n" + _MARKS_TEXT


def _references(measured: Measured) -> str:
    samples, bound = measured.settings.pass_samples, measured.settings.bound
    lines = []
    for one in measured.lit:
        estimate = one.reference
        end = "bound reached" if estimate.converged else f"time over before {percent(bound)}%"
        lines.append(
            [
                one.light,
                f"{estimate.passes * samples}",
                f"{percent(estimate.error, 2)}%",
                end,
                f"{estimate.seconds:.0f}",
                f"{percent(one.agreement, 2)}%",
                f"{one.non_finite} of {one.launches}",
            ]
        )
    head = (
        "light",
        "samples a pixel",
        "standard error",
        "why it ended",
        "s",
        "`sira_sg` against its form at our points",
        "launches with NaN",
    )
    return _REFERENCES_TEXT.format(bound=percent(bound)) + "\n\n" + table(head, lines)


def _curves(measured: Measured) -> str:
    parts = [_CURVES_TEXT.format(image=_IMAGES.format("curves.svg"))]
    for one in measured.lit:
        lines = []
        factors = {id(p): f for m in curves_of_closed_forms() for p, f in speedups(one, m)}
        for point in one.points:
            factor = factors.get(id(point))
            lines.append(
                [
                    point.method,
                    f"{point.samples}",
                    f"{point.seconds:.3g}",
                    f"{percent(point.error)}%",
                    f"{point.flip:.4f}",
                    "" if factor is None else f"{factor:.2g}×",
                ]
            )
        head = ("method", "samples a pixel", "s", "relative RMSE", "FLIP", "`path`'s time for that error")
        limits = "; ".join(
            f"{limit.method[3:]} {percent(limit.error, 2)}% (noise {percent(limit.resolution, 2)}%)"
            for limit in one.limits
        )
        parts.append(f"### {one.light}\n\n{table(head, lines)}\n\nLimits, noise taken out: {limits}.")
    return "\n\n".join(parts)


def curves_of_closed_forms() -> tuple[str, ...]:
    """The methods without noise of their own."""
    return (curves.PHYSG, curves.FORM, curves.VISIBLE, curves.SHARED, curves.SHARED_MESH)


def _causes(measured: Measured) -> str:
    settings = measured.settings
    parts = [
        _CAUSES_TEXT.format(
            shadow=SHADOW_SHARE,
            grazing=GRAZING_COSINE,
            angle=f"{np.degrees(np.arccos(GRAZING_COSINE)):.0f}",
            image=_IMAGES.format("causes.png"),
            range=percent(DIFFERENCE_RANGE, 0),
            usual=f"{settings.usual_voxel:g}",
        )
    ]
    for one in measured.lit:
        sizes = {region: int(one.regions[region].sum()) for region in (*REGIONS, HEAD)}
        head = ("", *(f"{region} ({sizes[region]} px)" for region in (*REGIONS, HEAD)), "mean", "share of square")
        lines = []
        for row in one.rows:
            title = row.cause
            if row.form and (row.cause == causes.TOTAL or row.form != causes.FORM):
                title = f"{row.form}: {row.cause}"
            if row.form == causes.PHYSG and row.cause not in (causes.INTEGRAL, causes.TOTAL):
                continue
            cells = [percent(row.errors[region], 2) for region in (*REGIONS, HEAD)]
            bias = f"{100 * row.bias:+.2f}" if row.cause != causes.NOISE else "–"
            lines.append([title, *cells, bias, percent(row.share)])
        least = max(row.resolution for row in one.rows if row.cause == causes.REST)
        text = f"Over the head, less than {percent(least, 2)}% of what noise is in cannot be told from it."
        parts.append(f"### {one.light}\n\n{table(head, lines)}\n\n{text}")
    return "\n\n".join(parts)


def _speed(measured: Measured) -> str:
    lines = [
        [r.name, r.over, f"{r.value:.3g}×", f"{r.seconds:.3g}", "" if r.mark is None else f"≤ {r.mark:g}×"]
        for r in measured.ratios
    ]
    ratios = table(("", "over", "ratio", "s", "mark"), lines)
    shade = [cost for cost in measured.costs if cost.what == "shade"]
    width = [cost for cost in measured.costs if cost.what == "sira_sg"]
    counts = sorted({cost.points for cost in shade})
    grid = {(cost.lobes, cost.points): cost.seconds for cost in shade}
    lobes = sorted({cost.lobes for cost in shade})
    shading = table(
        ("lobes", *(f"{count:,} points" for count in counts)),
        [[f"{n}", *(f"{1e9 * grid[n, count] / (n * count):.2f}" for count in counts)] for n in lobes],
    )
    widths = table(
        ("width of all networks", "s", "µs a pixel of the head"),
        [[f"{c.width}", f"{c.seconds:.3g}", f"{1e6 * c.seconds / max(c.points, 1):.2f}"] for c in width],
    )
    return _SPEED_TEXT.format(
        ratios=ratios,
        shading=shading,
        widths=widths,
        by_lobes=f"{speed.growth(shade, 'lobes'):.2f}",
        by_points=f"{speed.growth(shade, 'points'):.2f}",
        by_width=f"{speed.growth(width, 'width'):.2f}",
    )


def _fits(fits: Sequence[FitPoint]) -> str:
    if not fits:
        return _NO_FITS
    lines = [
        [f"{p.label}", f"{p.portraits}", f"{p.seconds:.0f}", number(p.millimetres), number(p.decibels, 1)] for p in fits
    ]
    head = ("rows", "portraits", "median s", "face, mm", "re-render, dB")
    return f"{_FITS_TEXT}\n\n{table(head, lines)}\n\n![Error of fits against time]({_IMAGES.format('fits.svg')})"


_INTRODUCTION = """# Closed forms against path tracing

The same head, light, view and BRDF by closed forms and by Mitsuba's path tracer:
{name}, {width} × {height} pixels, measured in {minutes} minutes by

    {command}

The figures of this page as CSV: [curves](crosscheck/curves.csv), [limits](crosscheck/limits.csv),
[slopes](crosscheck/slopes.csv), [causes](crosscheck/causes.csv), [ratios](crosscheck/ratios.csv),
[costs](crosscheck/costs.csv). Relative RMSE is the root mean square of the difference of linear RGB over the pixels of
the head, divided by the mean of the reference there. The reference's own noise is taken out: it is kept as two
independent halves R₀ and R₁, and the mean of (I − R₀)(I − R₁) has no noise of theirs in it. FLIP is the mean of
LDR-FLIP (Andersson et al. 2020) over the head, on sRGB values, at 67 pixels a degree.

The methods: (a) PhySG's closed form, with its two-term cosine; (b) this project's closed form; (c) the same with
visibility, `sira_sg`, also with fewer shadings and on the mesh; (d) direct light by Monte Carlo, `path` with
`max_depth` 2; (e) `path` of one bounce and of all. All see the lobes of `sira_mi/crosscheck/lights.py` and
`sira_bsdf`. Samples of closed forms are spread evenly over each pixel, those of `path` are independent. The path
tracer sees a mesh of spacing {voxel} with albedos at its vertices, the closed forms the field and its networks. How
well the closed form approximates the integral alone is in [shading.md](shading.md)."""

_MARKS_TEXT = """Neural textures inside `path` are networks evaluated at every hit of every sample: that is what the
first ratio of textures shows, and why baked ones are the default of `python -m sira_mi.relight`. `sira_sg` finds exact
hits and evaluates the field's networks with its gradient at each of them, which the path tracer with baked albedos
does without. "Shared": samples of one pixel that see almost the same place share one shading (its option `shared`,
which `python -m sira_mi.relight --draft` uses); it samples what varies within a pixel once, as the albedo of a fit
with fine detail does and the mean head's does not. "On the mesh, baked": hits, normals and albedos of the mesh that
the path tracer sees (its option `exact`, switched off)."""

_REFERENCES_TEXT = """`path` with all bounces, in passes of independent seeds, until the standard error of the picture
that the variance among the passes shows (root mean square over the head, share of the mean radiance) is below {bound}%,
or until the light's share of the time is over. The last column compares the plugin `sira_sg` with the same closed form
at the points that the causes are measured at, away from the silhouette and noise taken out: the two are one thing.
Launches of at most two million rays that had a pixel of NaN or infinity were made again with another seed."""

_CURVES_TEXT = """Wall times with compiled kernels, medians of two or three runs after others; of one run from 64
samples a pixel on. The last column of the tables is how many times as long `path` with all bounces takes for
the error of a closed form, from its own curve.

![Relative RMSE and FLIP against wall time]({image})"""

_CAUSES_TEXT = """Each cause is the difference of two pictures that differ by one thing, at the same points and with the
same random numbers where there are any:

- **float32**: the closed form in float64 at normals of the field in float64, minus that of single precision.
- **integral approximation**: direct light without shadows by Monte Carlo at the field's points, minus the closed form.
- **missing visibility**: the same with shadow rays, minus without.
- **proxy mesh instead of the field**: the same at hits and normals of the reference's mesh, minus at the field's.
- **baked instead of neural textures**: the same with albedos from the vertices, minus from the networks.
- **missing interreflection**: `path` with all bounces minus `path` with direct light only, same seeds.
- **left over**: reference minus closed form minus all of the above. It is direct light of `path` against that of this
  package's own estimator, two independent programs, and should be noise.

For the form with visibility, the first three are one row (direct light with shadows by Monte Carlo minus the form
without its bounce), and interreflection counts beyond the form's own bounce.

The figures are percent of the head's mean radiance: root mean square by region, noise taken out by the product of two
independent halves, 0.00 where noise is all there is; the mean over the head, which adds up to the total's mean; and the
cause's share of the total's mean square, its product with the total, which adds up to 100. A negative share is a cause
that makes up for others. "Monte Carlo noise" is what is left in the reference; the last row, outside of the sum, is
what a mesh of the usual spacing {usual} would add to direct light.

Regions, each pixel of the head (where any ray hits it) in the first that fits: **silhouette**, where the pixel or one
of its eight neighbours is not wholly covered by the head; **shadow**, where less than {shadow:g} of the direct light
without shadows arrives; **grazing**, where the mean cosine of normal and view is below {grazing:g} ({angle}°); **lit**,
the rest.

![Reference, closed form, regions, and what each cause adds]({image})

Differences are of the mean of the channels, red where the later picture is brighter, at full colour {range}% of the
mean radiance."""

_SPEED_TEXT = """Medians over repeats that take turns, after one run of each that compiles the kernels. `path` with all
bounces, mesh of the plugin's usual spacing, the same lobes.

{ratios}

The last ratio is compilation: some kernels of `sira_sg` know the number of hits. The curves and marks above are without
that.

The closed form without visibility (`shade`): nanoseconds for each lobe and point.

{shading}

Time grows with lobes to the power of {by_lobes} and with points to the power of {by_points}, at the upper ends.

`sira_sg` on a round head whose networks all have one width, one sample a pixel:

{widths}

At the upper end the time a pixel grows with the width to the power of {by_width}."""

_NO_FITS = """Error in mm and dB against the time of a fit over the quality presets comes from the rows of a benchmark,
which this run was not given. With them:

    python -m studies.portraits fit --benchmark BENCHMARK --runs RUNS
    python -m studies.crosscheck --fits RUNS/draft/rows.json RUNS/standard/rows.json"""

_FITS_TEXT = """The shipped fit over the benchmark's portraits, a point for each set of fits: median wall time of a fit
with all of its stages, mean distance between the true face and the fitted one, and PSNR of the re-render."""
