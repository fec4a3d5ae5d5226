"""Computes the tables of `sira_mi/sg/specular_table.py`: `python -m studies.numerics.fit_specular_table`.

The closed form of `sira_mi/sg/specular.py` is evaluated in double precision and compared with quadrature for views from
5° to 89.9°, roughnesses from 0.1 to 1, lights of sharpness 0.5 to 10⁵ and the light directions of
`specular_quadrature.light_directions`. First the tables of energy are fitted to the energies, by least squares. Then
the others are fitted together to the radiance for specular albedos of 0.03 and 0.375: an error counts relative to the
largest value over the light directions and to an allowance, which is 1 up to 70° and grows beyond. The sum of the
errors' squares, then of their fourth and sixth powers is minimised by Levenberg and Marquardt's method.

Prints the tables; `--write` puts them into the package's file; `--check` compares them with the
package's and ends with 1 if the results of the closed form differ by more than the tolerance below.
"""

import argparse
import sys
import time
from pathlib import Path

import sira_mi  # noqa: F401  (before Dr.Jit, which must find LLVM)

# isort: split
import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.polynomial.chebyshev import chebvander

from sira_mi.sg import specular, specular_table
from studies.numerics.specular_quadrature import grid_integrals, integrals, views
from studies.stability.double import in_double

VIEW_ANGLES = np.array([5, 20, 35, 45, 52, 58, 63, 67, 70, 73, 76, 79, 82, 84, 86, 88, 89.3, 89.9])  # degrees
ROUGHNESSES = np.array([0.1, 0.14, 0.2, 0.25, 0.3, 0.37, 0.45, 0.53, 0.61, 0.7, 0.82, 1.0])
SHARPNESSES = np.array([0.5, 2.0, 5.0, 12.0, 30.0, 80.0, 200.0, 500.0, 1100.0, 2200.0, 1e4, 1e5])
ALBEDOS = (0.03, 0.375)  # specular albedo
DIRECTIONS, NODES, ENERGY_NODES = 64, 48, 192
# Allowance of an error: per degree beyond 70 and beyond 86, and as a factor for roughness above 0.7.
SLOPE, GRAZING_SLOPE, ROUGH = 0.08, 0.6, 2.0
ERROR_UNIT = 0.03  # an error of this size counts 1
EXPONENTS = (1, 2, 3)  # halves of the powers that are minimised, one after the other
ITERATIONS, CONVERGED, STEP = 60, 1e-4, 1e-4
RIDGE = 1e-2  # weight of a coefficient's square
FITTED = tuple(name for name in specular.LobeShape._fields if not name.endswith("_energy"))
START = {"half_point": 0.5}
# Largest difference of a result, relative to the largest value over light directions, from the package's tables.
TOLERANCE = 2e-3


class Samples:
    """The grid of cells (view, roughness), the quadratures there and the closed form's errors."""

    def __init__(self):
        cosines = np.cos(np.radians(VIEW_ANGLES))
        self.cosine, self.roughness = (x.ravel() for x in np.meshgrid(cosines, ROUGHNESSES, indexing="ij"))
        cells = len(self.cosine)
        poles = np.broadcast_to([0.0, 0.0, 1.0], (cells, 3))
        self.energy = integrals(self.cosine, self.roughness, np.zeros(cells), poles, ENERGY_NODES)
        axes, exact = grid_integrals(cosines, ROUGHNESSES, SHARPNESSES, DIRECTIONS, NODES)
        self.exact = exact.reshape(2, cells, -1)
        per_cell = self.exact.shape[2]
        angle = np.repeat(VIEW_ANGLES, len(ROUGHNESSES))
        allowance = 1.0 + SLOPE * np.maximum(angle - 70.0, 0.0) + GRAZING_SLOPE * np.maximum(angle - 86.0, 0.0)
        allowance *= np.where(self.roughness > 0.7, ROUGH, 1.0)
        peaks = [self.mixed(self.exact, a).reshape(cells, len(SHARPNESSES), -1).max(axis=2) for a in ALBEDOS]
        self.weights = [np.repeat(1.0 / peak, DIRECTIONS, axis=1) for peak in peaks]
        self.allowance = allowance[:, None]
        with in_double() as double:
            shape = cells, len(SHARPNESSES), DIRECTIONS
            many = np.broadcast_to(axes.reshape(cells, 1, DIRECTIONS, 3), (*shape, 3)).reshape(-1, 3)
            self.axis = double.Vector3f(np.ascontiguousarray(many.T))
            self.sharpness = double.Float(np.broadcast_to(SHARPNESSES[:, None], shape).ravel())
            self.view = double.Vector3f(np.repeat(views(self.cosine), per_cell, axis=0).T)
            self.lane_roughness = double.Float(np.repeat(self.roughness, per_cell))
            dr.eval(self.axis, self.sharpness, self.view, self.lane_roughness)

    @staticmethod
    def mixed(parts: np.ndarray, albedo: float) -> np.ndarray:
        return albedo * parts[0] + (1.0 - albedo) * parts[1]

    def closed_form(self, shape: dict[str, np.ndarray]) -> np.ndarray:
        """The two parts [2, cells, sharpnesses · directions] for quantities [cells] of a `LobeShape`."""
        with in_double() as double:
            per_cell = self.exact.shape[2]
            normal = double.Vector3f(0, 0, 1)
            spread = specular.LobeShape(**{k: double.Float(np.repeat(v, per_cell)) for k, v in shape.items()})
            lobes = specular.lobes_of_shape(normal, self.view, self.lane_roughness, spread, self.view.z)
            parts = specular.specular_integrals(lobes, self.axis, self.sharpness)
            dr.eval(parts)
            return np.stack([x.numpy() for x in parts]).reshape(self.exact.shape)

    def errors(self, shape: dict[str, np.ndarray]) -> np.ndarray:
        """Errors [cells, albedos · sharpnesses · directions], relative to the largest value over directions."""
        difference = self.closed_form(shape) - self.exact
        parts = (self.mixed(difference, a) * weight for a, weight in zip(ALBEDOS, self.weights, strict=True))
        return np.concatenate(list(parts), axis=1)


def basis(cosine: np.ndarray, roughness: np.ndarray) -> np.ndarray:
    """Products of Chebyshev polynomials [cells, table size] in the variables of the tables."""
    with in_double() as double:
        variables = [x.numpy() for x in specular.table_variables(double.Float(cosine), double.Float(roughness))]
    u, v = (chebvander(x, count - 1) for x, count in zip(variables, specular_table.TERMS, strict=True))
    return (u[:, :, None] * v[:, None, :]).reshape(len(cosine), -1)


def fit_energies(samples: Samples, matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Tables [2, table size] of the log of the energies over their limits, and the largest weighted errors [2].

    The weight is 1 for F = 1 and, for F = P, the root of its share where F = 1 weighs least."""
    with in_double() as double:
        limits = specular.log_energy(double.Float(samples.cosine), double.Float(samples.roughness))
        target = np.log(samples.energy) - np.stack([x.numpy() for x in limits])
    share = samples.energy * np.array([ALBEDOS[0], 1.0 - ALBEDOS[0]])[:, None]
    weights = np.sqrt(share / share.sum(axis=0))
    weights[0] = 1.0
    solutions = (
        np.linalg.lstsq(matrix * w[:, None], t * w, rcond=None)[0] for t, w in zip(target, weights, strict=True)
    )
    tables = np.stack(list(solutions))
    return tables, (np.abs(tables @ matrix.T - target) * weights).max(axis=1)


def fit_shapes(samples: Samples, matrix: np.ndarray, energies: np.ndarray) -> np.ndarray:
    """Tables [quantities of FITTED, table size]."""
    fixed = dict(zip(("white_energy", "grazing_energy"), energies @ matrix.T, strict=True))
    tables = np.zeros((len(FITTED), matrix.shape[1]))
    tables[:, 0] = [START.get(name, 0.0) for name in FITTED]

    def local_errors(values):
        return samples.errors({**fixed, **dict(zip(FITTED, values, strict=True))})

    for exponent in EXPONENTS:
        scaled = ERROR_UNIT * samples.allowance
        damping = 1e-2

        def cost(tables, exponent=exponent, scaled=scaled):
            errors = local_errors(tables @ matrix.T) / scaled
            return (errors ** (2 * exponent)).sum() + RIDGE * (tables**2).sum(), errors

        value, errors = cost(tables)
        for iteration in range(ITERATIONS):
            start = time.perf_counter()
            local = tables @ matrix.T
            residual = np.abs(errors) ** exponent
            slope = exponent * np.abs(errors) ** (exponent - 1) * np.sign(errors)
            jacobian = []
            for k in range(len(FITTED)):
                moved = local.copy()
                moved[k] += STEP
                jacobian.append((local_errors(moved) / scaled - errors) / STEP * slope)
            normal = np.array([[(a * b).sum(axis=1) for b in jacobian] for a in jacobian])
            gradient = np.array([(a * residual).sum(axis=1) for a in jacobian]) @ matrix + RIDGE * tables
            hessian = np.einsum("ijc,ca,cb->iajb", normal, matrix, matrix, optimize=True)
            hessian = hessian.reshape(tables.size, tables.size) + RIDGE * np.eye(tables.size)
            before = value
            while damping < 1e6:
                damped = hessian + damping * np.diag(np.diag(hessian))
                trial = tables - np.linalg.solve(damped, gradient.ravel()).reshape(tables.shape)
                trial_value, trial_errors = cost(trial)
                if trial_value < value:
                    tables, value, errors = trial, trial_value, trial_errors
                    damping /= 4.0
                    break
                damping *= 4.0
            largest = 100.0 * (np.abs(errors) * scaled).reshape(len(VIEW_ANGLES), len(ROUGHNESSES), -1).max(axis=2)
            print(
                f"power {2 * exponent}, step {iteration}: {value:.6g}; largest errors, roughness 0.2 to 0.7:"
                f" {largest[VIEW_ANGLES <= 70, 2:10].max():.2f}% to 70°, {largest[VIEW_ANGLES <= 86, 2:10].max():.2f}%"
                f" to 86° ({time.perf_counter() - start:.1f} s)",
                file=sys.stderr,
                flush=True,
            )
            if before - value < CONVERGED * value:
                break
    return tables


def fit_tables(samples: Samples) -> dict[str, np.ndarray]:
    """All tables by their names."""
    matrix = basis(samples.cosine, samples.roughness)
    energies, missed = fit_energies(samples, matrix)
    print(f"energies: largest weighted errors {100.0 * missed[0]:.2f}%, {100.0 * missed[1]:.2f}%", file=sys.stderr)
    tables = dict(zip(("white_energy", "grazing_energy"), energies, strict=True))
    tables |= dict(zip(FITTED, fit_shapes(samples, matrix, energies), strict=True))
    return {name: tables[name].reshape(specular_table.TERMS) for name in specular.LobeShape._fields}


def source(tables: dict[str, np.ndarray]) -> str:
    """Python source of the tables, five significant digits; what is below 5e-5 is 0."""
    text = ""
    for name, table in tables.items():
        rows = (", ".join(f"{x:.5g}" if abs(x) >= 5e-5 else "0.0" for x in row) for row in table)
        text += f"{name.upper()} = (\n" + "".join(f"    ({row}),\n" for row in rows) + ")\n"
    return text


def write(tables: dict[str, np.ndarray]) -> None:
    """Replaces the tables in the package's file, between the marks that keep the formatter away."""
    path = Path(specular_table.__file__)
    text = path.read_text(encoding="utf-8")
    start, end = text.index("# fmt: off\n") + len("# fmt: off\n"), text.index("# fmt: on")
    path.write_text(text[:start] + source(tables) + text[end:], encoding="utf-8")
    print(f"wrote {path}")


def check(samples: Samples, tables: dict[str, np.ndarray]) -> float:
    """Largest difference of the errors with these tables and with the package's; prints both tables' errors."""
    matrix = basis(samples.cosine, samples.roughness)
    package = {name: np.array(getattr(specular_table, name.upper())) for name in tables}
    errors = [
        samples.errors({name: matrix @ table.ravel() for name, table in each.items()}) for each in (tables, package)
    ]
    difference = np.abs(errors[0] - errors[1]) / samples.allowance
    print(f"largest difference {difference.max():.1e} of the allowance, tolerance {TOLERANCE:.0e}")
    return difference.max()


def main() -> None:
    parser = argparse.ArgumentParser(description="Computes the tables of `sira_mi/sg/specular_table.py`.")
    action = parser.add_mutually_exclusive_group()
    action.add_argument("--check", action="store_true", help="compare with the tables of the package")
    action.add_argument("--write", action="store_true", help="put the tables into the package's file")
    arguments = parser.parse_args()
    mi.set_variant("llvm_ad_rgb")
    samples = Samples()
    tables = fit_tables(samples)
    if arguments.check:
        sys.exit(int(not check(samples, tables) <= TOLERANCE))
    elif arguments.write:
        write(tables)
    else:
        print(source(tables), end="")


if __name__ == "__main__":
    main()
