"""The worst errors of closed-form specular radiance, found by search: `python -m studies.numerics.worst_errors`.

For ranges of roughness and light sharpness and for views up to four angles, the search looks for the view, roughness,
sharpness, specular albedo and light direction with the largest error, relative to the largest value over light
directions. It starts from random points and from the worst of earlier runs, and climbs by random steps that shrink. The
closed form runs in single precision, the quadrature in double; the worst points are evaluated again with many nodes and
directions.

Writes `docs/data/shading_bounds.json` and prints the table of `docs/shading.md`. Takes about ten minutes on two cores.
"""

import argparse
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import sira_mi  # noqa: F401  (before Dr.Jit, which must find LLVM)

# isort: split
import mitsuba as mi
import numpy as np

from studies.data import read_figures, write_figures
from studies.markdown import table
from studies.numerics.specular_quadrature import integrals, light_directions, views

FIGURES = Path("data") / "shading_bounds.json"
VIEW_ANGLES = (70.0, 85.0, 88.0, 89.9)  # degrees from the normal, the largest of a range
ALBEDOS = (0.03, 0.05, 0.1, 0.2, 0.375, 0.7, 1.0)  # specular albedo
# Quadrature nodes along a radius: of random points, of the last steps, of the points that are kept.
NODES = (24, 40, 96)
# Light directions of a point: spread, mirrored about a fan of half vectors in the plane of incidence, and close to the
# parent's worst direction and to that of its largest value.
SPREAD, FAN, CLOSE = 24, 17, 8
VERIFIED_SPREAD, VERIFIED_CLOSE = 160, 32

# What is stated over what was found.
_MARGIN = 1.03


@dataclass(frozen=True)
class Range:
    """A range of roughness and of the sharpness of lights."""

    roughness: tuple[float, float]
    sharpness: tuple[float, float]

    def contains(self, other: "Range") -> bool:
        pairs = (self.roughness, other.roughness), (self.sharpness, other.sharpness)
        return all(wide[0] <= narrow[0] and narrow[1] <= wide[1] for wide, narrow in pairs)


RANGES = (
    Range((0.2, 0.7), (2.0, 2000.0)),
    Range((0.2, 0.7), (1e-3, 1e6)),
    Range((0.7, 1.0), (1e-3, 1e6)),
    Range((0.05, 0.2), (1e-3, 1e6)),
)


@dataclass(frozen=True)
class Effort:
    """How long a search takes."""

    starts: int = 640
    parents: int = 8
    children: int = 6
    steps: int = 12
    verified: int = 4


@dataclass(frozen=True)
class Worst:
    """The largest error found, as a share of the largest value over light directions, and where."""

    error: float
    view_angle: float  # degrees
    roughness: float
    sharpness: float
    albedo: float
    axis: tuple[float, float, float]  # of the light lobe, for n = z and the view in the plane y = 0


@dataclass
class _Points:
    """Points of the search [N] and, of each, the half vectors [N, 3] of its worst light direction and of the one with
    the largest value."""

    place: np.ndarray  # [N, 3] in the unit cube: view angle, roughness, log sharpness
    error: np.ndarray
    albedo: np.ndarray
    worst_half: np.ndarray
    peak_half: np.ndarray

    def select(self, index: np.ndarray) -> "_Points":
        return _Points(*(value[index] for value in vars(self).values()))

    def join(self, other: "_Points") -> "_Points":
        pairs = zip(vars(self).values(), vars(other).values(), strict=True)
        return _Points(*(np.concatenate(pair) for pair in pairs))


def _normalise(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)


def _place(worst: Worst, limits: Range, view_angle: float) -> np.ndarray | None:
    """The place of a known point in the unit cube of a range; None outside it."""
    low, high = np.log(limits.sharpness)
    place = np.array(
        [
            (worst.view_angle / view_angle) ** 2,
            (worst.roughness - limits.roughness[0]) / (limits.roughness[1] - limits.roughness[0]),
            (math.log(worst.sharpness) - low) / (high - low),
        ]
    )
    return np.clip(place, 0.0, 1.0) if ((place > -1e-6) & (place < 1.0 + 1e-6)).all() else None


def _parameters(place: np.ndarray, limits: Range, view_angle: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """View angle in degrees, roughness and sharpness [N] of places in the unit cube; large angles are more frequent."""
    low, high = np.log(limits.sharpness)
    roughness = limits.roughness[0] + (limits.roughness[1] - limits.roughness[0]) * place[:, 1]
    return view_angle * np.sqrt(place[:, 0]), roughness, np.exp(low + (high - low) * place[:, 2])


def closed_form(cosine: np.ndarray, roughness: np.ndarray, sharpness: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """The closed form's parts [2, N], F = 1 and F = P, for views of `views` and light lobes of [N, 3] axes."""
    from sira_mi.sg import specular

    view = mi.Vector3f(np.ascontiguousarray(views(cosine).T))
    lobes = specular.specular_lobes(mi.Vector3f(0, 0, 1), view, mi.Float(roughness))
    parts = specular.specular_integrals(lobes, mi.Vector3f(np.ascontiguousarray(axes.T)), mi.Float(sharpness))
    return np.stack([part.numpy().astype(np.float64) for part in parts])


def _evaluate(place, halves, limits: Range, view_angle: float, spread: int, nodes: int) -> _Points:
    """The points at `place` [N, 3] with their largest errors over `spread` light directions and those that the half
    vectors `halves` [N, H, 3] reflect."""
    angle, roughness, sharpness = _parameters(place, limits, view_angle)
    cosine = np.cos(np.radians(angle))
    view = views(cosine)[:, None]
    even = np.stack([light_directions(c, r, spread) for c, r in zip(cosine, roughness, strict=True)])
    tilt = roughness[:, None] ** 2 * np.linspace(-2.0, 2.0, FAN)
    halves = np.concatenate([halves, np.stack([np.sin(tilt), 0.0 * tilt, np.cos(tilt)], axis=-1)], axis=1)
    axes = np.concatenate([even, 2.0 * (halves * view).sum(axis=-1, keepdims=True) * halves - view], axis=1)
    shape = axes.shape[:2]
    c, r, lobe = (np.repeat(x, shape[1]) for x in (cosine, roughness, sharpness))
    flat = axes.reshape(-1, 3)
    value, exact = (x.reshape(2, *shape) for x in (closed_form(c, r, lobe, flat), integrals(c, r, lobe, flat, nodes)))
    albedo = np.array(ALBEDOS)[:, None, None]
    mixed, truth = (albedo * x[0] + (1.0 - albedo) * x[1] for x in (value, exact))
    error = np.abs(mixed - truth) / truth.max(axis=2, keepdims=True)
    by_albedo = error.max(axis=2)
    worst, rows = by_albedo.argmax(axis=0), np.arange(len(place))
    directions = error[worst, rows].argmax(axis=1), truth[worst, rows].argmax(axis=1)
    half = (_normalise(axes[rows, k] + view[:, 0]) for k in directions)
    return _Points(place, by_albedo[worst, rows], np.array(ALBEDOS)[worst], *half)


def _close_halves(rng, points: _Points, roughness, sharpness, scale: float, count: int) -> np.ndarray:
    """Half vectors [N, 2 count, 3] close to the worst and the largest of each point, and these themselves."""
    width = np.minimum(scale * (roughness**2 + 0.5 / np.sqrt(sharpness + 1.0)), 0.5)[:, None, None]
    noise = rng.standard_normal((2, len(width), count, 3)) * width
    noise[:, :, 0] = 0.0
    pairs = zip((points.worst_half, points.peak_half), noise, strict=True)
    return np.concatenate([_normalise(half[:, None] + part) for half, part in pairs], axis=1)


def search_worst(limits: Range, view_angle: float, effort: Effort, seed: int, known: Sequence[Worst] = ()) -> Worst:
    """The worst error of a range, for views up to `view_angle` degrees; starts from the `known` points in it, too."""
    rng = np.random.default_rng(seed)
    place = rng.random((effort.starts, 3))
    # A share of the starts lies on the range's faces, where worst cases often are.
    side = rng.integers(0, 6, effort.starts // 4)
    place[np.arange(len(side)), side // 2] = side % 2
    placed = [(p, w) for w in known if (p := _place(w, limits, view_angle)) is not None]
    place = np.concatenate([place, *(p[None] for p, _ in placed)])
    angle, roughness, _ = _parameters(place, limits, view_angle)
    tilt = roughness[:, None, None] ** 2 * rng.standard_normal((len(place), CLOSE, 2))
    halves = _normalise(np.concatenate([tilt, np.ones((len(place), CLOSE, 1))], axis=-1))
    for k, (_, worst) in enumerate(placed, effort.starts):
        halves[k, 0] = _normalise(np.array(worst.axis) + views(np.cos(np.radians(angle[k]))))
    start = points = _evaluate(place, halves, limits, view_angle, SPREAD, NODES[0])
    for step in range(effort.steps):
        parents = points.select(np.argsort(-points.error)[: effort.parents])
        nodes, scale = NODES[step >= effort.steps // 2], 0.15 * 0.75**step
        if step == effort.steps // 2:
            halves = _close_halves(rng, parents, *_parameters(parents.place, limits, view_angle)[1:], 0.1, CLOSE)
            parents = _evaluate(parents.place, halves, limits, view_angle, SPREAD, nodes)
        children = parents.select(np.repeat(np.arange(len(parents.error)), effort.children))
        place = np.clip(children.place + scale * rng.standard_normal(children.place.shape), 0.0, 1.0)
        halves = _close_halves(rng, children, *_parameters(place, limits, view_angle)[1:], 0.75**step, CLOSE)
        points = parents.join(_evaluate(place, halves, limits, view_angle, SPREAD, nodes))
    points = points.select(np.argsort(-points.error)[: effort.verified])
    if placed:
        points = points.join(start.select(effort.starts + np.argsort([-w.error for _, w in placed])[: effort.verified]))
    halves = _close_halves(rng, points, *_parameters(points.place, limits, view_angle)[1:], 0.3, VERIFIED_CLOSE)
    points = _evaluate(points.place, halves, limits, view_angle, VERIFIED_SPREAD, NODES[2])
    k = int(points.error.argmax())
    at_angle, at_roughness, at_sharpness = (float(x[k]) for x in _parameters(points.place, limits, view_angle))
    view, half = views(np.cos(np.radians(np.array(at_angle)))), points.worst_half[k]
    axis = 2.0 * (half @ view) * half - view
    found = float(points.error[k]), at_angle, at_roughness, at_sharpness, float(points.albedo[k])
    return Worst(*found, tuple(axis.tolist()))


def known_points(path: Path) -> list[Worst]:
    """The points of earlier figures, none without a file."""
    ranges = read_figures(path)["ranges"] if path.exists() else []
    return [Worst(**{**worst, "axis": tuple(worst["axis"])}) for part in ranges for worst in part["worst"]]


def measure_bounds(effort: Effort, seed: int, known: Sequence[Worst]) -> dict:
    """The worst for every range and view angle: of a search, and of those of narrower ranges and views."""
    found: dict[tuple[Range, float], Worst] = {}
    for limits in RANGES:
        for view_angle in VIEW_ANGLES:
            searched = search_worst(limits, view_angle, effort, seed, known)
            within = [w for (r, v), w in found.items() if limits.contains(r) and v <= view_angle]
            worst = max([*within, searched], key=lambda w: w.error)
            found[limits, view_angle] = worst
            print(f"{limits}, views to {view_angle:g}°: {100.0 * searched.error:.2f}%; {worst}", flush=True)
    ranges = [{**asdict(r), "worst": [asdict(found[r, v]) for v in VIEW_ANGLES]} for r in RANGES]
    return {"view_angles": VIEW_ANGLES, "ranges": ranges}


def stated_bound(error: float) -> float:
    """The bound in percent that the page states for a worst error: 3% more, as searches differ by 1%, rounded up to the
    next tenth."""
    return math.ceil(1000.0 * _MARGIN * error) / 10.0


def bounds_table(figures: dict) -> str:
    """The bounds as the table of `docs/shading.md`."""
    head = ["roughness", "λ", *(f"to {angle:g}°" for angle in figures["view_angles"])]
    rows = []
    for part in figures["ranges"]:
        limits = (f"{part[name][0]:g} to {part[name][1]:g}" for name in ("roughness", "sharpness"))
        rows.append([*limits, *(f"{stated_bound(worst['error']):.1f}%" for worst in part["worst"])])
    return table(head, rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument(
        "--seed", type=int, default=0, help="of the search; each run also starts from the earlier worst"
    )
    parser.add_argument("--starts", type=int, default=Effort.starts, help="random points of a search")
    parser.add_argument("--steps", type=int, default=Effort.steps, help="steps of the climb")
    parser.add_argument("--docs", type=Path, default=Path("docs"), help="folder of the pages")
    parser.add_argument("--variant", default="llvm_ad_rgb")
    arguments = parser.parse_args()
    mi.set_variant(arguments.variant)
    path = arguments.docs / FIGURES
    effort = Effort(starts=arguments.starts, steps=arguments.steps)
    figures = measure_bounds(effort, arguments.seed, known_points(path))
    print(bounds_table(write_figures(path, figures)))


if __name__ == "__main__":
    main()
