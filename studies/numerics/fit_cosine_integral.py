"""Fits the polynomials of `sira_mi/sg/integrals.py` to quadrature: `python -m studies.numerics.fit_cosine_integral`.

Prints `_COSINE_DEVIATION`, `_STEP_RATIO` and `_TAIL` as source, and the errors of the forms in float64. With `--check`
it compares them with the constants of the package and ends with 1 if they differ by more than the tolerances below.

The first two are even polynomials in the cosine c = ξ·n with coefficients in y = λ/(λ + k). All are fitted by
iteratively reweighted least squares: a point's weight grows with its error, which brings the largest error down.

- `_COSINE_DEVIATION` is s²/v of `cosine_integral`, v the lobe's variance across its axis. The value that makes the form
  exact is found by Newton's method; the error that counts is divided by 98% of the integral plus 2% of that at ξ = n.
- `_STEP_RATIO` is t of `hemisphere_integral` over its slope. The error that counts is absolute.
- `_TAIL` is (1 − t M(t)) / y² with Mills' ratio M and y = 1/(1 + 0.35 t), a polynomial in y. The error that counts is
  relative.
"""

import argparse
import sys

import numpy as np
from scipy.special import erfcx, i0e, ndtr, ndtri

NODES, WEIGHTS = np.polynomial.legendre.leggauss(600)
COSINE_TERMS, COSINE_HALF_POINT, COSINE_FLOOR, COSINE_ITERATIONS = (6, 3), 3.0, 0.02, 200
STEP_TERMS, STEP_HALF_POINT, STEP_ITERATIONS = (6, 4), 4.0, 30
TAIL_TERMS, TAIL_SCALE, TAIL_END, TAIL_ITERATIONS = 9, 0.35, 40.0, 60
# Largest difference of a recomputed polynomial from the package's, whose coefficients have seven digits, over
# 0 <= c <= 1 and 0 <= y < 1, where both are about 1. Single coefficients may differ more, by their conditioning.
TOLERANCE = 1e-4
TAIL_TOLERANCE = 1e-6


def hemisphere_quadrature(sharpness: float, cosine: float, power: int) -> float:
    """∫ exp(λ(ω·ξ − 1)) (ω·n)^power dω over the hemisphere around n for `cosine` = ξ·n in [−1, 1], float64.

    The azimuth is a Bessel function; the elevation is summed within 14/√λ of the axis."""
    centre, width = np.arcsin(cosine), 14.0 / np.sqrt(sharpness)
    low, high = max(0.0, centre - width), min(np.pi / 2, centre + width)
    if high <= low:
        low, high = 0.0, min(np.pi / 2, width)
    elevation = 0.5 * (high - low) * NODES + 0.5 * (high + low)
    z, rim = np.sin(elevation), np.cos(elevation)
    sine = np.sqrt(1.0 - cosine * cosine)
    density = np.exp(sharpness * (cosine * z + sine * rim - 1.0)) * i0e(sharpness * sine * rim)
    return 0.5 * (high - low) * np.sum(WEIGHTS * z**power * rim * 2.0 * np.pi * density)


def sphere_integral(sharpness):
    """∫ exp(λ(ω·ξ − 1)) dω over the sphere."""
    return -2.0 * np.pi * np.expm1(-2.0 * sharpness) / sharpness


def mean_length(sharpness):
    """A(λ) = coth λ − 1/λ, by its first term below 0.01."""
    safe = np.maximum(sharpness, 1e-2)
    return np.where(sharpness > 1e-2, 1.0 / np.tanh(safe) - 1.0 / safe, sharpness / 3.0)


def normal_density(x):
    return np.exp(-0.5 * x * x) / np.sqrt(2.0 * np.pi)


def samples() -> tuple[np.ndarray, ...]:
    """Sharpness, cosine, and of the whole lobe the part of cosine, step and cosine at ξ = n; each [P].

    Half of the cosines are even over [0, 1]; the others follow the lobe's width to the equator."""
    sharpnesses = np.concatenate([np.geomspace(1e-3, 1, 8), np.geomspace(1.2, 60, 36), np.geomspace(70, 1e5, 12)])
    rows = []
    for sharpness in sharpnesses:
        whole = sphere_integral(sharpness)
        peak = hemisphere_quadrature(sharpness, 1.0, 1) / whole
        near = np.linspace(0.01, 1.0, 8) * min(1.0, 3.0 / np.sqrt(sharpness))
        for cosine in np.concatenate([np.linspace(0.0, 1.0, 24), near]):
            clamped, step = (hemisphere_quadrature(sharpness, cosine, power) / whole for power in (1, 0))
            rows.append((sharpness, cosine, clamped, step, peak))
    return tuple(np.array(rows).T)


def basis(cosine, sharpness, terms, half_point) -> np.ndarray:
    """Monomials y^i c^{2j}, [..., n_i n_j] with j fastest, for terms = (n_i, n_j)."""
    y = sharpness / (sharpness + half_point)
    columns = [y**i * cosine ** (2 * j) for i in range(terms[0]) for j in range(terms[1])]
    return np.stack(columns, axis=-1)


def weighted_solution(matrix, target, weight) -> np.ndarray:
    return np.linalg.lstsq(matrix * weight[:, None], target * weight, rcond=None)[0]


def clamped_mean(mean, deviation):
    """E max(x, 0) of a normal distribution."""
    x = mean / deviation
    return mean * ndtr(x) + deviation * normal_density(x)


def exact_ratio(mean, variance, clamped) -> np.ndarray:
    """s²/v for which `clamped_mean` has the value `clamped`; kept in [0.3, 1.4] where it hardly matters."""
    ratio = np.ones_like(mean)
    for _ in range(60):
        deviation = np.sqrt(variance * ratio)
        slope = normal_density(mean / deviation)
        step = (clamped_mean(mean, deviation) - clamped) / np.maximum(slope, 1e-9)
        step = np.where(slope > 1e-7, step * 2.0 * np.sqrt(ratio / variance), 0.0)
        ratio = np.clip(ratio - step, 0.3, 1.4)
    return ratio


def fit_cosine(sharpness, cosine, clamped, peak) -> tuple[np.ndarray, float]:
    """Coefficients [3, 6] of s²/v and the largest error relative to the value at ξ = n."""
    length = mean_length(sharpness)
    variance, mean = length / sharpness, length * cosine
    scale = clamped * (1.0 - COSINE_FLOOR) + COSINE_FLOOR * peak
    ratio = exact_ratio(mean, variance, clamped)
    deviation = np.sqrt(variance * ratio)
    matrix = basis(cosine, sharpness, COSINE_TERMS, COSINE_HALF_POINT)
    weight = normal_density(mean / deviation) * deviation / (2.0 * ratio * scale) + 1e-9
    best, solution = np.inf, np.zeros(matrix.shape[1])
    for _ in range(COSINE_ITERATIONS):
        trial = weighted_solution(matrix, ratio, weight)
        fitted = matrix @ trial
        error = np.abs(clamped_mean(mean, np.sqrt(variance * np.maximum(fitted, 0.05))) - clamped) / scale
        if error.max() < best and fitted.min() > 0.3:
            best, solution = error.max(), trial
        weight *= 1.0 + 0.3 * error / error.max()
        weight /= weight.max()
    error = np.abs(clamped_mean(mean, np.sqrt(variance * (matrix @ solution))) - clamped) / peak
    return solution.reshape(COSINE_TERMS).T, error.max()


def fit_step(sharpness, cosine, step) -> tuple[np.ndarray, float]:
    """Coefficients [4, 6] of t over its slope, and the largest error relative to the whole lobe."""
    slope = np.sqrt(np.pi / 8.0) * sharpness / np.sqrt(1.0 + sharpness * (np.pi / 8.0))
    known = (cosine > 0.0) & (step < 1.0 - 1e-10)
    argument = np.where(known, ndtri(np.minimum(step, 1.0 - 1e-10)), 0.0)
    ratio = np.where(known, argument / (np.where(known, cosine, 1.0) * slope), 1.0)
    matrix = basis(cosine, sharpness, STEP_TERMS, STEP_HALF_POINT)
    weight = np.where(known, normal_density(argument) * cosine * slope, 0.0)
    for _ in range(STEP_ITERATIONS):
        solution = weighted_solution(matrix, ratio, weight)
        error = np.abs(ndtr(cosine * slope * (matrix @ solution)) - step)
        weight *= 1.0 + error / error.max()
        weight /= weight.max()
    return solution.reshape(STEP_TERMS).T, error.max()


def tail(distance: np.ndarray) -> np.ndarray:
    """1 − t M(t): from t = 3 by the continued fraction of M, which does not cancel."""
    fraction = distance.copy()
    for k in range(400, 1, -1):
        fraction = distance + k / fraction
    mills = np.sqrt(np.pi / 2.0) * erfcx(distance / np.sqrt(2.0))
    return np.where(distance < 3.0, 1.0 - distance * mills, 1.0 / (fraction * distance + 1.0))


def fit_tail() -> tuple[np.ndarray, float]:
    """Coefficients [9] of `_TAIL` and the largest relative error for 0 <= t <= 40."""
    y = 0.5 - 0.5 * np.cos(np.pi * (np.arange(4000) + 0.5) / 4000)
    y = y[y > 1.0 / (1.0 + TAIL_SCALE * TAIL_END)]
    matrix = np.vander(y, TAIL_TERMS, increasing=True) * (y**2 / tail((1.0 / y - 1.0) / TAIL_SCALE))[:, None]
    weight = np.ones_like(y)
    for _ in range(TAIL_ITERATIONS):
        solution = weighted_solution(matrix, np.ones_like(y), weight)
        error = np.abs(matrix @ solution - 1.0)
        weight *= np.sqrt(error / error.max() + 1e-3)
        weight /= weight.max()
    return solution, error.max()


def source(name: str, rows: np.ndarray) -> str:
    """Python source of a table [n_j, n_i]."""
    lines = ("    (" + ", ".join(f"{x:.7g}" for x in row) + "),\n" for row in rows)
    return f"{name} = (\n{''.join(lines)})"


def difference(name: str, rows: np.ndarray, shipped, half_point: float) -> float:
    """Largest difference of two polynomials over c in [0, 1] and sharpness in [1e-4, 1e6]; printed."""
    shipped = np.array(shipped)
    cosine, sharpness = np.meshgrid(np.linspace(0.0, 1.0, 201), np.geomspace(1e-4, 1e6, 401))
    values = basis(cosine, sharpness, rows.shape[::-1], half_point)
    largest = np.abs(values @ (rows - shipped).T.ravel()).max()
    coefficient = np.abs(rows - shipped).max()
    print(f"{name}: largest difference {largest:.1e} of the polynomial, {coefficient:.1e} of a coefficient")
    return largest


def main() -> None:
    parser = argparse.ArgumentParser(description="Fits the polynomials of `sira_mi/sg/integrals.py` to quadrature.")
    parser.add_argument("--check", action="store_true", help="compare with the constants of the package")
    arguments = parser.parse_args()
    sharpness, cosine, clamped, step, peak = samples()
    deviation, cosine_error = fit_cosine(sharpness, cosine, clamped, peak)
    ratio, step_error = fit_step(sharpness, cosine, step)
    tail_coefficients, tail_error = fit_tail()
    if not arguments.check:
        print(f"# largest error relative to the value at ξ = n: {cosine_error:.2e}")
        print(source("_COSINE_DEVIATION", deviation))
        print(f"# largest error relative to the whole lobe: {step_error:.2e}")
        print(source("_STEP_RATIO", ratio))
        print(f"# largest relative error: {tail_error:.2e}")
        print(f"_TAIL = ({', '.join(f'{x:.7g}' for x in tail_coefficients)})")
        return
    from sira_mi.sg import integrals

    largest = max(
        difference("_COSINE_DEVIATION", deviation, integrals._COSINE_DEVIATION, integrals._COSINE_HALF_POINT),
        difference("_STEP_RATIO", ratio, integrals._STEP_RATIO, integrals._STEP_HALF_POINT),
    )
    print(f"tolerance {TOLERANCE:.0e} of the polynomials")
    y = np.linspace(1.0 / (1.0 + TAIL_SCALE * TAIL_END), 1.0, 401)
    powers = np.vander(y, TAIL_TERMS, increasing=True)
    tail_difference = np.abs(powers @ integrals._TAIL / (powers @ tail_coefficients) - 1.0).max()
    print(f"_TAIL: largest relative difference {tail_difference:.1e}, tolerance {TAIL_TOLERANCE:.0e}")
    sys.exit(int(not (largest <= TOLERANCE and tail_difference <= TAIL_TOLERANCE)))


if __name__ == "__main__":
    main()
