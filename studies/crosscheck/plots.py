"""The plots of the page, by Matplotlib, an optional package."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sira_mi.colour import linear_to_srgb
from sira_mi.errors import InputError
from sira_mi.files import write_through
from studies.crosscheck import curves
from studies.crosscheck.evidence import Lit
from studies.crosscheck.fits import FitPoint
from studies.crosscheck.page import DIFFERENCE_RANGE
from studies.crosscheck.regions import HEAD, REGIONS

# Colour and marker of each method.
_STYLE = {
    curves.PHYSG: ("tab:brown", "x"),
    curves.FORM: ("tab:orange", "^"),
    curves.VISIBLE: ("tab:red", "o"),
    curves.SHARED: ("tab:purple", "P"),
    curves.SHARED_MESH: ("tab:pink", "D"),
    curves.DIRECT: ("tab:green", "s"),
    curves.BOUNCE: ("tab:cyan", "v"),
    curves.PATH: ("tab:blue", "."),
}
_REGION_COLOURS = ((0.95, 0.85, 0.5), (0.3, 0.7, 0.4), (0.25, 0.3, 0.7), (0.85, 0.2, 0.2))


def pyplot():
    """Matplotlib set up for files that are the same on every run. InputError when it is not installed."""
    try:
        import matplotlib
    except ImportError as error:
        raise InputError("plots need an optional package; install it with: pip install 'sira-mi[plots]'") from error
    matplotlib.use("agg")
    import matplotlib.pyplot as plt

    plt.rcParams.update({"svg.hashsalt": "sira-mi", "svg.fonttype": "none", "font.size": 9, "axes.grid": True})
    plt.rcParams.update({"grid.alpha": 0.3, "grid.linewidth": 0.5, "savefig.facecolor": "white"})
    return plt


def _save(figure, path: Path, **options) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    metadata = {"Date": None} if path.suffix == ".svg" else {}
    write_through(path, lambda file: figure.savefig(file, metadata=metadata, **options))


def plot_curves(points: Sequence[curves.Point], path: Path) -> None:
    """Relative RMSE and FLIP against wall time under every light."""
    plt = pyplot()
    lights = list(dict.fromkeys(point.light for point in points))
    columns = min(len(lights), 4)
    legend = 0.25 * math.ceil((len(_STYLE) + 1) / columns)  # inches
    height = 6.0 + legend
    figure, axes = plt.subplots(
        2, len(lights), figsize=(3.4 * len(lights), height), squeeze=False, sharex="col", sharey="row"
    )
    for column, light in enumerate(lights):
        for axis, name, label in zip(axes[:, column], ("error", "flip"), ("relative RMSE", "FLIP"), strict=True):
            for method, (colour, marker) in _STYLE.items():
                used = [p for p in points if (p.light, p.method) == (light, method)]
                x, y = [p.seconds for p in used], [getattr(p, name) for p in used]
                axis.plot(x, y, color=colour, marker=marker, markersize=5, linewidth=1.2, label=method)
            axis.set(xscale="log", yscale="log")
            axis.yaxis.set_major_locator(plt.matplotlib.ticker.LogLocator(subs=(1, 2, 5)))
            axis.yaxis.set_major_formatter("{x:g}")
            axis.yaxis.set_minor_formatter(plt.matplotlib.ticker.NullFormatter())
            if column == 0:
                axis.set_ylabel(label)
        _slope_triangle(axes[0, column], [p for p in points if (p.light, p.method) == (light, curves.PATH)])
        axes[0, column].set_title(light)
        axes[1, column].set_xlabel("wall time, s")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="lower center", ncols=columns, frameon=False)
    figure.tight_layout(rect=(0, legend / height, 1, 1))
    _save(figure, path)
    plt.close(figure)


def _slope_triangle(axis, points) -> None:
    """A dashed line of slope −½ through the last point of the path tracer."""
    if points:
        last = points[-1]
        x = np.array([min(p.seconds for p in points), last.seconds])
        y = last.error * np.sqrt(last.seconds / x)
        axis.plot(x, y, color="0.4", linewidth=0.8, linestyle="--", label="slope −½")


def plot_fits(points: Sequence[FitPoint], path: Path) -> None:
    """Error in millimetres and decibels against the time of a fit."""
    plt = pyplot()
    figure, axes = plt.subplots(1, 2, figsize=(7, 3.2))
    for axis, name, label in zip(axes, ("millimetres", "decibels"), ("face, mm", "re-render, dB"), strict=True):
        axis.plot([p.seconds for p in points], [getattr(p, name) for p in points], marker="o", color="tab:blue")
        for p in points:
            axis.annotate(p.label, (p.seconds, getattr(p, name)), textcoords="offset points", xytext=(4, 4))
        axis.set(xlabel="wall time of a fit, s", ylabel=label, xlim=(0, 1.3 * max(p.seconds for p in points)))
        axis.margins(y=0.2)
    axes[0].set_ylim(0, 1.2 * max(p.millimetres for p in points))
    figure.tight_layout()
    _save(figure, path)
    plt.close(figure)


def plot_sheet(lit: Sequence[Lit], path: Path) -> None:
    """A row for each light: reference and closed form in sRGB, regions, then what each cause adds, signed."""
    plt = pyplot()
    names = list(lit[0].pictures)
    titles = ["reference", "with visibility", "regions", *names[2:]]
    height, width = lit[0].pictures["reference"].shape[:2]
    figure, axes = plt.subplots(
        len(lit), len(titles), figsize=(1.75 * len(titles), 1.75 * height / width * len(lit) + 0.6), squeeze=False
    )
    for row, one in zip(axes, lit, strict=True):
        level = one.pictures["reference"][one.regions[HEAD]].mean()
        shown = [linear_to_srgb(np.clip(one.pictures[name], 0, 1)) for name in names[:2]]
        shown.append(_region_picture(one.regions))
        shown += [one.pictures[name].mean(axis=-1) / (DIFFERENCE_RANGE * level) for name in names[2:]]
        for axis, image in zip(row, shown, strict=True):
            if image.ndim == 3:
                axis.imshow(np.clip(image, 0, 1), interpolation="nearest")
            else:
                axis.imshow(image, cmap="RdBu_r", vmin=-1, vmax=1, interpolation="nearest")
            axis.set(xticks=[], yticks=[])
            axis.grid(False)
        row[0].set_ylabel(one.figures["light"])
    for axis, title in zip(axes[0], titles, strict=True):
        axis.set_title(_wrap(title), fontsize=8)
    figure.tight_layout(pad=0.4)
    _save(figure, path, dpi=110)
    plt.close(figure)


def _region_picture(regions) -> np.ndarray:
    picture = np.zeros((*next(iter(regions.values())).shape, 3))
    for name, colour in zip(REGIONS, _REGION_COLOURS, strict=True):
        picture[regions[name]] = colour
    return picture


def _wrap(title: str) -> str:
    words, lines = title.split(), [""]
    for word in words:
        if len(lines[-1]) + len(word) > 18:
            lines.append("")
        lines[-1] = f"{lines[-1]} {word}".strip()
    return "\n".join(lines)
