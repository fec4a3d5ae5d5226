"""Computes the tables of `sira_mi/sg/specular_table.py`: `python benchmarks/fit_specular_table.py [--write]`.

For each of 26 view cosines and 14 roughnesses the specular reflectance f^s of `sira_mi/sg/brdf.py` times the light's
cosine is integrated over the hemisphere, without Fresnel (WHITE) and with F = P (GRAZING): its energy and its mean
direction. A lobe is then found that, times the cosine, has this mean direction, and the logs of energy and sharpness
and the turn of the axis from the mirror direction are fitted by Chebyshev polynomials. Weights follow what an error
does to a result: the root of the part's energy, and for the turn the lobe's width.

Without an option the tables are printed; `--write` puts them into the package's file; `--check` compares them with the
package's and ends with 1 if they differ by more than the tolerance below.
"""

import argparse
import sys
from pathlib import Path

import numpy as np
from fit_cosine_integral import hemisphere_quadrature
from numpy.polynomial.chebyshev import chebvander
from scipy.optimize import least_squares

NODES, WEIGHTS = np.polynomial.legendre.leggauss(256)
AZIMUTHS = 512
VIEW_COSINES = (1.0 - np.cos(np.linspace(0.06, np.pi - 0.03, 26))) / 2.0
ROUGHNESSES = 0.6 - 0.4 * np.cos(np.pi * (np.arange(14) + 0.5) / 14.0)
COSINE_DEGREE, ROUGHNESS_DEGREE = 7, 5
# Bounds of a lobe's angle from the normal, radians, and of its log sharpness. Some mean directions of rough surfaces
# are out of their reach; the lobe then is the nearest within them.
LOWER, UPPER = (1e-4, np.log(0.3)), (1.75, 12.0)
# Largest difference of a coefficient from the package's, which have five significant digits.
TOLERANCE = 1e-4
PARTS, QUANTITIES = ("WHITE", "GRAZING"), ("ENERGY", "TURN", "SHARPNESS")


def reflectance_moments(view_cosine: float, roughness: float) -> list[tuple[float, float, float]]:
    """Energy ∫ f^s (ω·n) dω and the mean direction's components across (away from the view) and along n, per part.

    The half vector is sampled by its distribution D: x = λ(1 − n·h) = t² up to 36 or the equator, uniform azimuth."""
    sharpness, k = 2.0 / roughness**4, (roughness + 1.0) ** 2 / 8.0
    limit = np.sqrt(min(sharpness, 36.0))
    t = 0.5 * (NODES + 1.0) * limit
    density = np.exp(-t * t) * 2.0 * t * 0.5 * WEIGHTS * limit / AZIMUTHS
    azimuth = (np.arange(AZIMUTHS) + 0.5) / AZIMUTHS * np.pi
    half_z, azimuth = np.meshgrid(1.0 - t * t / sharpness, azimuth, indexing="ij")
    half_x = np.sqrt(np.maximum(1.0 - half_z**2, 0.0)) * np.cos(azimuth)
    view_x = np.sqrt(1.0 - view_cosine**2)
    cosine = view_x * half_x + view_cosine * half_z
    light_z, light_x = 2.0 * cosine * half_z - view_cosine, 2.0 * cosine * half_x - view_x
    above = (light_z > 0.0) & (cosine > 0.0)
    masking = 1.0 / ((np.maximum(light_z, 0.0) * (1.0 - k) + k) * (view_cosine * (1.0 - k) + k))
    white = np.where(above, density[:, None] * cosine * light_z * masking, 0.0)
    fresnel = 2.0 ** (-(5.55473 * cosine + 6.8316) * cosine)
    moments = []
    for part in (white, white * fresnel):
        energy = part.sum()
        moments.append((energy, -(part * light_x).sum() / energy, (part * light_z).sum() / energy))
    return moments


def lobe_mean(angle: float, sharpness: float) -> tuple[float, float]:
    """Mean direction, across and along n, of a lobe `angle` from n times the cosine (ω·n)₊.

    Along the lobe's axis it is 1 + d/dλ log ∫ G (ω·n)₊, by a central difference."""
    cosine = np.cos(angle)
    flux = hemisphere_quadrature(sharpness, cosine, 1)
    along_normal = hemisphere_quadrature(sharpness, cosine, 2) / flux
    step = 1e-3 * sharpness
    above, below = (hemisphere_quadrature(x, cosine, 1) for x in (sharpness + step, sharpness - step))
    along_axis = 1.0 + (above - below) / (2.0 * step * flux)
    return (along_axis - along_normal * cosine) / max(np.sin(angle), 1e-6), along_normal


def matching_lobe(mean: tuple[float, float]) -> tuple[float, float, float]:
    """Angle from n and sharpness of the lobe whose `lobe_mean` is `mean`, and the distance that remains.

    The distance is in units of the lobe's width, 1/√λ of the first guess."""
    length = np.hypot(*mean)
    guess = min(max(length * (3.0 - length**2) / (1.0 - length**2), 0.5), 1e5)
    start = min(max(np.arctan2(*mean), 1e-3), 1.5), np.log(guess)
    solution = least_squares(
        lambda x: (np.array(lobe_mean(x[0], np.exp(x[1]))) - mean) * np.sqrt(guess),
        start,
        bounds=(LOWER, UPPER),
        x_scale=(1.0 / np.sqrt(guess), 0.3),
    )
    return solution.x[0], np.exp(solution.x[1]), np.abs(solution.fun).max()


def matching_lobes() -> np.ndarray:
    """Energy, angle, sharpness and remaining distance of all lobes: [26 view cosines, 14 roughnesses, 2 parts, 4]."""
    return np.array(
        [
            [[(m[0], *matching_lobe(m[1:])) for m in reflectance_moments(c, r)] for r in ROUGHNESSES]
            for c in VIEW_COSINES
        ]
    )


def fit_tables(lobes: np.ndarray) -> tuple[dict[str, np.ndarray], dict[str, float]]:
    """Chebyshev coefficients [8, 6] of each quantity by its name, and the largest weighted errors of the fits."""
    cosine, roughness = np.meshgrid(VIEW_COSINES, ROUGHNESSES, indexing="ij")
    mirror = np.arccos(cosine)
    columns = chebvander(2.0 * cosine.ravel() - 1.0, COSINE_DEGREE)
    matrix = columns[:, :, None] * chebvander((roughness.ravel() - 0.6) / 0.4, ROUGHNESS_DEGREE)[:, None, :]
    matrix = matrix.reshape(cosine.size, -1)
    tables, errors = {}, {}
    for index, part in enumerate(PARTS):
        energy, angle, sharpness = (lobes[:, :, index, k] for k in range(3))
        weight = np.sqrt(energy / energy.max(axis=0)) if part == "GRAZING" else np.ones_like(energy)
        # m + τ(c m − n) is turned from the mirror direction m by arctan(τ sin θ), away from the normal.
        turn = np.clip(np.tan(np.clip(angle - mirror, -1.4, 1.25)) / np.sin(mirror), -3.0, 3.0)
        targets = (
            (np.log(energy), weight),
            (turn, weight * np.minimum(np.sqrt(sharpness), 8.0) * np.sin(mirror)),
            (np.log(sharpness * (1.0 + cosine**2) * roughness**4), weight),
        )
        for quantity, (target, weight) in zip(QUANTITIES, targets, strict=True):
            weight, target = weight.ravel(), target.ravel()
            solution = np.linalg.lstsq(matrix * weight[:, None], target * weight, rcond=None)[0]
            tables[f"{part}_{quantity}"] = solution.reshape(COSINE_DEGREE + 1, ROUGHNESS_DEGREE + 1)
            errors[f"{part}_{quantity}"] = np.abs((matrix @ solution - target) * weight).max()
    return tables, errors


def source(tables: dict[str, np.ndarray]) -> str:
    """Python source of the tables, five significant digits; what is below 5e-5 is 0."""
    text = ""
    for name, table in tables.items():
        rows = (", ".join(f"{x:.5g}" if abs(x) >= 5e-5 else "0.0" for x in row) for row in table)
        text += f"{name} = (\n" + "".join(f"    ({row}),\n" for row in rows) + ")\n"
    return text


def write(tables: dict[str, np.ndarray]) -> None:
    """Replaces the tables in the package's file, between the marks that keep the formatter away."""
    from sira_mi.sg import specular_table

    path = Path(specular_table.__file__)
    text = path.read_text(encoding="utf-8")
    start, end = text.index("# fmt: off\n") + len("# fmt: off\n"), text.index("# fmt: on")
    path.write_text(text[:start] + source(tables) + text[end:], encoding="utf-8")
    print(f"wrote {path}")


def check(tables: dict[str, np.ndarray], errors: dict[str, float]) -> float:
    """Largest difference of a coefficient from the package's; prints it for each table."""
    from sira_mi.sg import specular_table

    differences = []
    for name, table in tables.items():
        differences.append(np.abs(table - np.array(getattr(specular_table, name))).max())
        print(f"{name}: largest difference {differences[-1]:.1e}; weighted error of the fit {errors[name]:.1e}")
    print(f"largest difference {max(differences):.1e}, tolerance {TOLERANCE:.0e}")
    return max(differences)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    action = parser.add_mutually_exclusive_group()
    action.add_argument("--check", action="store_true", help="compare with the tables of the package")
    action.add_argument("--write", action="store_true", help="put the tables into the package's file")
    arguments = parser.parse_args()
    lobes = matching_lobes()
    tables, errors = fit_tables(lobes)
    if arguments.check:
        for index, part in enumerate(PARTS):
            missed = lobes[:, :, index, 3]
            share = np.mean(missed > 1e-3)
            print(f"{part}: {share:.0%} of the lobes miss the mean direction, by at most {missed.max():.2g} widths")
        sys.exit(int(not check(tables, errors) <= TOLERANCE))
    elif arguments.write:
        write(tables)
    else:
        print(source(tables), end="")


if __name__ == "__main__":
    main()
