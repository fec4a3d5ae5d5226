"""All measurements of the cross-check, one after the other, within a budget of time."""

from __future__ import annotations

import dataclasses
import functools
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import mitsuba as mi
import numpy as np

from sira_mi.plugins.neural_sdf import NeuralSDF
from studies.crosscheck import causes, curves, speed
from studies.crosscheck.case import Case
from studies.crosscheck.evidence import Lit, key_of, load_or_measure
from studies.crosscheck.images import LaunchLog, converge, path, render
from studies.crosscheck.lights import OWN, SETTINGS, SOFT, lobes_of
from studies.crosscheck.regions import HEAD, SILHOUETTE

# What each light may take of its share of the budget; loading, points and speed take the rest.
_REFERENCE, _INTERREFLECTION, _CURVES = 0.45, 0.07, 0.28
# Random seeds of what must be independent.
_SEED_REFERENCE, _SEED_INTERREFLECTION, _SEED_CURVES = 101, 202, 303


@dataclass(frozen=True)
class Settings:
    """How much is measured."""

    size: int = 192  # pixels, longer side of the picture
    minutes: float = 20.0  # of wall time, about, for everything
    bound: float = 0.005  # on the reference's relative standard error
    voxel: float = 0.02  # of the reference's mesh, scene units
    usual_voxel: float = 0.05  # of the plugin's usual mesh, scene units
    pass_samples: int = 32  # a pixel and pass of the reference
    side: int = 2  # the points of a half: side² rays a pixel
    directions: int = 48  # of each kind for direct light at a point
    seed: int = 0
    speed: bool = True  # measure the ratios and costs too


def choose_lights(case: Case, chosen: tuple[str, ...]) -> dict[str, np.ndarray]:
    """Lobes [N_l, 7] by name: the `chosen` settings, or all of them and the scene's own light."""
    lights = {name: lobes_of(name) for name in chosen or SETTINGS}
    if case.lobes is not None and not chosen:
        lights = {OWN: case.lobes, **lights}
    return lights


def measure(
    case: Case,
    lights: dict[str, np.ndarray],
    settings: Settings,
    say: Callable[[str], object] = print,
    evidence: Path | None = None,
) -> tuple[dict, list[Lit]]:
    """The figures as a JSON object, and what the sheet shows of each light. `say` is told about progress. What the
    folder `evidence` holds of the same case and settings is not measured again; its time counts."""
    start, done = time.monotonic(), set()
    head = functools.cache(case.head)

    @functools.cache
    def gather() -> tuple[NeuralSDF, NeuralSDF, list[causes.Half]]:
        heads = head(settings.voxel), head(settings.usual_voxel)
        halves = causes.gather(case, *heads, settings.side, settings.seed)
        say(f"heads and points after {time.monotonic() - start:.0f} s")
        return *heads, halves

    budget = 60 * settings.minutes * (0.85 if settings.speed else 1.0) / len(lights)
    lit = []
    for name, lobes in lights.items():

        def measure_light(name: str = name, lobes: np.ndarray = lobes) -> Lit:
            done.add(name)
            return _measure_light(case, *gather(), name, lobes, settings, budget)

        lit.append(load_or_measure(evidence, name, key_of(case, settings, lobes), measure_light))
        reference = lit[-1].figures["reference"]
        say(
            f"{name}: reference of {reference['samples']} samples, standard error {100 * reference['error']:.2f}% "
            f"after {reference['seconds']:.0f} s; all after {time.monotonic() - start:.0f} s"
        )
    ratios: list[speed.Ratio] = []
    costs: list[speed.Cost] = []
    if settings.speed:
        lobes = lights.get(SOFT, next(iter(lights.values())))
        usual = head(settings.usual_voxel)
        ratios = [*speed.texture_ratios(case, usual, lobes, 16), speed.hit_ratio(case, usual, 2)]
        ratios.append(speed.compilation_ratio(case, usual, lobes))
        costs = [*speed.shading_costs(), *speed.width_costs(case, lobes)]
        say(f"speed after {time.monotonic() - start:.0f} s")
    earlier = sum(one.figures["seconds"] for one in lit if one.figures["light"] not in done)
    figures = {
        "case": {"name": case.name, "width": case.width, "height": case.height},
        "settings": dataclasses.asdict(settings),
        "seconds": time.monotonic() - start + earlier,
        "lights": [one.figures for one in lit],
        "speed": {"ratios": list(map(dataclasses.asdict, ratios)), "costs": list(map(dataclasses.asdict, costs))},
    }
    return figures, lit


def _measure_light(
    case: Case,
    head: NeuralSDF,
    usual: NeuralSDF,
    halves: list[causes.Half],
    name: str,
    lobes: np.ndarray,
    settings: Settings,
    budget: float,
) -> Lit:
    start = time.monotonic()
    pictures = causes.shade_halves(case, head, usual, halves, lobes, settings.directions, settings.seed)
    regions = causes.masks(halves, pictures)
    scene, full, direct = case.scene(head, lobes), path(), path(2)
    samples, seed, log = settings.pass_samples, settings.seed, LaunchLog()

    def traced(k):
        return render(scene, full, samples, seed, _SEED_REFERENCE, k, log=log)

    def indirect(k):
        both = (render(scene, one, samples, seed, _SEED_INTERREFLECTION, k, log=log) for one in (full, direct))
        first, second = both
        return first - second

    mask = regions[HEAD]
    traced(0)  # compiles the kernels, outside of the time
    reference = converge(traced, mask, settings.bound, _REFERENCE * budget)
    level = max(float(reference.mean[mask].mean()), 1e-12)
    interreflection = converge(indirect, mask, settings.bound / 2, _INTERREFLECTION * budget, level)
    named = causes.parts(pictures, reference, interreflection.halves)
    rows = [row for form, parts in named.items() for row in causes.rows(name, form, parts, regions, level)]
    rows.append(causes.noise_row(name, reference, regions, level))
    rows.append(causes.usual_row(name, pictures, regions, level, settings.usual_voxel))
    plain, visible = named[causes.FORM], named[causes.VISIBLE]
    sheet = {
        "reference": reference.mean,
        "with visibility": pictures.visible.mean(axis=0),
        **{cause: part.mean(axis=0) for cause, part in plain.items() if cause not in (causes.FLOAT32, causes.TOTAL)},
        "total without visibility": plain[causes.TOTAL].mean(axis=0),
        "total with visibility": visible[causes.TOTAL].mean(axis=0),
    }
    points, limits = curves.measure_curves(
        case, head, name, lobes, reference, mask, _CURVES * budget, settings.seed + _SEED_CURVES, log
    )
    figures = {
        "light": name,
        "reference": {
            "samples": reference.passes * samples,
            "error": reference.error,
            "seconds": reference.seconds,
            "converged": reference.converged,
        },
        "regions": {region: int(pixels.sum()) for region, pixels in regions.items()},
        "agreement": _agreement(scene, pictures, settings, mask & ~regions[SILHOUETTE], level),
        "launches": log.launches,
        "non_finite": log.non_finite,
        "causes": list(map(dataclasses.asdict, rows)),
        "points": list(map(dataclasses.asdict, points)),
        "limits": list(map(dataclasses.asdict, limits)),
        "seconds": time.monotonic() - start,
    }
    return Lit(figures, sheet, regions)


def _agreement(scene: mi.Scene, pictures: causes.Pictures, settings: Settings, mask: np.ndarray, level: float) -> float:
    """How far `sira_sg` is from the closed form with visibility at the points of this package, without noise."""
    plugin = mi.load_dict({"type": "sira_sg", "hide_emitters": True})
    images = [render(scene, plugin, 4 * settings.side**2, settings.seed, 4, k) for k in range(2)]
    differences = [image - form for image, form in zip(images, pictures.visible, strict=True)]
    return causes.root(causes.mean_square(differences[0], differences[1], mask)) / level
