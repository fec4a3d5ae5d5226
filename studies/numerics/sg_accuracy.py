"""Errors of closed-form shading under a spherical Gaussian, and its speed: `python -m studies.numerics.sg_accuracy`.

Prints four tables: the specular errors on a dense grid of views, roughnesses and sharpnesses with the largest error of
each promised range; the specular errors of PhySG's form and of this project's; the errors of the irradiance; and the
time of `shade`. The closed forms of `sira_mi/sg/shading.py` run in single precision, the quadrature in double. An error
is the largest over light directions, relative to the largest value. PhySG's form has this project's cosine integral, so
that the error of its two-term cosine does not count. Half of the light directions are spread over the sphere; the
others are reflections about half vectors that follow the normal distribution, so that narrow lights meet the lobe.
"""

import argparse
import os
import time

import sira_mi  # noqa: F401  (before Dr.Jit, which must find LLVM)

# isort: split
import drjit as dr
import mitsuba as mi
import numpy as np

from studies.initial_lobes import initial_lobes
from studies.numerics.fit_cosine_integral import hemisphere_quadrature
from studies.numerics.specular_quadrature import grid_integrals, integrals, views

SHARPNESSES = (1e-3, 0.3, 5.0, 30.0, 200.0, 1e3, 1e5)
TABULATED_ROUGHNESS = 0.1  # the closed form's tables begin here
ROUGHNESSES = (0.1, 0.2, 0.35, 0.5, 0.7, 1.0)
VIEW_ANGLES = (0, 45, 60, 75, 85)  # degrees from the normal
ALBEDOS = (0.05, 0.375)  # specular albedo
DIRECTIONS = 96  # light directions of a cell
# The dense grid of the promised range, and the promise: largest error, %, up to a view angle in degrees.
DENSE_VIEW_ANGLES = (*range(0, 70, 5), *range(70, 86, 3))
DENSE_ROUGHNESSES = tuple(round(0.2 + 0.05 * k, 2) for k in range(11))
DENSE_SHARPNESSES = tuple(2.0 * 1000.0 ** (k / 10.0) for k in range(11))
DENSE_ALBEDOS = (0.03, 0.05, 0.375)
PROMISED = ((70, 5.0), (85, 15.0))
TIMED_POINTS, TIMED_LOBES = 2**17, (1, 64)


def light_directions(view: np.ndarray, roughness: float) -> np.ndarray:
    """Axes [D, 3]: a Fibonacci lattice, and `view` reflected about a spiral of half vectors that follow D."""
    from sira_mi.fields.directions import GOLDEN_ANGLE, fibonacci_directions

    count = DIRECTIONS // 2
    distribution = 2.0 / roughness**4
    share = (np.arange(count) + 0.5) / count * -np.expm1(-distribution)
    gap, azimuth = -np.log1p(-share) / distribution, GOLDEN_ANGLE * np.arange(count)
    sine = np.sqrt(gap * (2.0 - gap))
    half = np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), 1.0 - gap], axis=1)
    reflected = 2.0 * (half @ view)[:, None] * half - view
    return np.concatenate([fibonacci_directions(DIRECTIONS - count), reflected])


def evaluate_closed_form(function, view, roughness, albedo, sharpness, axes) -> np.ndarray:
    """The closed form `function` for n = z and axes [D, 3]: [D]."""
    ones = dr.ones(mi.Float, len(axes))
    value = function(
        mi.Vector3f(0.0, 0.0, ones),
        mi.Vector3f(*(float(x) * ones for x in view)),
        mi.Float(albedo) * ones,
        dr.opaque(mi.Float, roughness, len(axes)),
        mi.Vector3f(np.ascontiguousarray(axes.T)),
        dr.opaque(mi.Float, sharpness, len(axes)),
        mi.Color3f(1.0),
    )
    return value.x.numpy().astype(np.float64)


def print_specular_table(nodes: int) -> None:
    """Prints the errors of the specular closed forms."""
    from sira_mi.sg import shading
    from studies.numerics import physg

    print("\nSpecular: largest error over light directions, % of the largest value, PhySG → this project")
    print("| roughness | albedo | view | " + " | ".join(f"λ = {x:g}" for x in SHARPNESSES) + " |")
    print("|---" * (3 + len(SHARPNESSES)) + "|")
    worst: dict[tuple[float, float], np.ndarray] = {}
    for roughness in ROUGHNESSES:
        rows: dict[float, list[str]] = {albedo: [] for albedo in ALBEDOS}
        for angle in VIEW_ANGLES:
            view = np.array([np.sin(np.radians(angle)), 0.0, np.cos(np.radians(angle))])
            axes = light_directions(view, roughness)
            same = np.ones(DIRECTIONS)
            cells: dict[float, list[str]] = {albedo: [] for albedo in ALBEDOS}
            for sharpness in SHARPNESSES:
                white, grazing = integrals(view[2] * same, roughness * same, sharpness * same, axes, nodes)
                for albedo in ALBEDOS:
                    exact = albedo * white + (1.0 - albedo) * grazing
                    errors = [
                        100.0 * np.abs(evaluate_closed_form(f, view, roughness, albedo, sharpness, axes) - exact).max()
                        for f in (physg.specular_radiance, shading.specular_radiance)
                    ]
                    baseline, ours = (error / exact.max() for error in errors)
                    cells[albedo].append(f"{baseline:.1f} → {ours:.1f}")
                    if roughness >= TABULATED_ROUGHNESS:
                        worst[angle, sharpness] = np.maximum(worst.get((angle, sharpness), 0.0), (baseline, ours))
            for albedo in ALBEDOS:
                rows[albedo].append(f"| {roughness:g} | {albedo:g} | {angle}° | " + " | ".join(cells[albedo]) + " |")
        for albedo in ALBEDOS:
            print("\n".join(rows[albedo]), flush=True)
    for angle in VIEW_ANGLES:
        last = ("{:.1f} → {:.1f}".format(*worst[angle, sharpness]) for sharpness in SHARPNESSES)
        print(f"| worst of {TABULATED_ROUGHNESS:g} to 1 | | {angle}° | " + " | ".join(last) + " |")


def measure_dense_errors(angles, roughnesses, sharpnesses, nodes: int) -> np.ndarray:
    """Largest errors of this project's form over light directions, as shares of the largest value: views in degrees ×
    roughnesses × sharpnesses × `DENSE_ALBEDOS`."""
    from sira_mi.sg import specular

    cosines = np.cos(np.radians(angles))
    axes, exact = grid_integrals(cosines, np.array(roughnesses), np.array(sharpnesses), DIRECTIONS, nodes)
    shape = exact.shape[1:]
    axis = np.broadcast_to(axes[:, :, None], (*shape, 3)).reshape(-1, 3)
    view = np.broadcast_to(views(cosines)[:, None, None, None], (*shape, 3)).reshape(-1, 3)
    lobes = specular.specular_lobes(
        mi.Vector3f(0, 0, 1),
        mi.Vector3f(np.ascontiguousarray(view.T)),
        mi.Float(np.broadcast_to(np.array(roughnesses)[:, None, None], shape).ravel()),
    )
    sharpness = mi.Float(np.broadcast_to(np.array(sharpnesses)[:, None], shape).ravel())
    parts = specular.specular_integrals(lobes, mi.Vector3f(np.ascontiguousarray(axis.T)), sharpness)
    value = np.stack([part.numpy().astype(np.float64).reshape(shape) for part in parts])
    errors = []
    for albedo in DENSE_ALBEDOS:
        mixed, truth = (albedo * x[0] + (1.0 - albedo) * x[1] for x in (value, exact))
        errors.append(np.abs(mixed - truth).max(axis=-1) / truth.max(axis=-1))
    return np.stack(errors, axis=-1)


def print_range_table(nodes: int) -> None:
    """Prints the errors on the dense grid and the largest within the promised ranges."""
    errors = 100.0 * measure_dense_errors(DENSE_VIEW_ANGLES, DENSE_ROUGHNESSES, DENSE_SHARPNESSES, nodes)
    names = ", ".join(f"{x:g}" for x in DENSE_ALBEDOS)
    print(f"\nSpecular, dense: largest error over λ = 2 to 2000 ({len(DENSE_SHARPNESSES)} values), albedos {names} and")
    print("light directions, % of the largest value over these")
    print("| view | " + " | ".join(f"r = {r:g}" for r in DENSE_ROUGHNESSES) + " |")
    print("|---" * (1 + len(DENSE_ROUGHNESSES)) + "|")
    for angle, row in zip(DENSE_VIEW_ANGLES, errors.max(axis=(2, 3)), strict=True):
        print(f"| {angle}° | " + " | ".join(f"{x:.1f}" for x in row) + " |")
    for angle, promised in PROMISED:
        largest = errors[np.array(DENSE_VIEW_ANGLES) <= angle].max()
        print(f"\nViews to {angle}°: at most {largest:.2f}% (promised: {promised:g}%)")


def print_diffuse_table() -> None:
    """Prints the errors of the irradiance, which PhySG takes from two more Gaussians and this project does not."""
    from sira_mi.sg.integrals import cosine_integral

    print("\nDiffuse: error of the irradiance over light angles 0° to 180° (181 of them)")
    print("| λ | % of the value at 0° | % of the value itself, light above the horizon |")
    print("|---|---|---|")
    cosine = np.cos(np.radians(np.arange(181.0)))
    for sharpness in SHARPNESSES:
        exact = np.array([hemisphere_quadrature(sharpness, c, 1) for c in cosine])
        value = cosine_integral(mi.Float(cosine), dr.opaque(mi.Float, sharpness, 181)).numpy()
        error = 100.0 * np.abs(value - exact)
        print(f"| {sharpness:g} | {error.max() / exact[0]:.3f} | {(error[:91] / exact[:91]).max():.3f} |")


def print_timing_table() -> None:
    """Prints the time of `shade`, forward and with its gradients, the kernels compiled before."""
    from sira_mi.sg import shading

    print(f"\nTime of `shade` per million points ({TIMED_POINTS} points timed, least of 5; {os.cpu_count()} cores)")
    print("| lobes | forward, s | forward and gradients of all inputs, s |")
    print("|---|---|---|")
    generator = np.random.default_rng(0)
    normal, view = generator.standard_normal((2, 3, TIMED_POINTS)).astype(np.float32)
    normal, view = normal / np.linalg.norm(normal, axis=0), view / np.linalg.norm(view, axis=0)
    view = np.where((normal * view).sum(axis=0) < 0.0, -view, view)
    albedo, roughness = generator.uniform(0.1, 0.9, TIMED_POINTS), generator.uniform(0.2, 1.0, TIMED_POINTS)
    for count in TIMED_LOBES:
        forward, both = [], []
        for _ in range(5):
            point = mi.Vector3f(normal), mi.Vector3f(view), mi.Float(albedo), mi.Float(roughness)
            inputs = (*point, mi.TensorXf(initial_lobes(count)))
            dr.eval(inputs)
            dr.sync_thread()
            start = time.perf_counter()
            dr.eval(shading.shade(*inputs))
            dr.sync_thread()
            forward.append(time.perf_counter() - start)
            dr.enable_grad(inputs)
            start = time.perf_counter()
            irradiance, specular = shading.shade(*inputs)
            dr.backward(dr.mean(dr.sum(irradiance) + 2.0 * dr.sum(specular)))
            dr.eval(dr.grad(inputs))
            dr.sync_thread()
            both.append(time.perf_counter() - start)
        print(
            f"| {count} | {min(forward) * 1e6 / TIMED_POINTS:.2f} | {min(both) * 1e6 / TIMED_POINTS:.2f} |", flush=True
        )


def main() -> None:
    parser = argparse.ArgumentParser(
        description="Errors of closed-form shading under a spherical Gaussian, and its speed."
    )
    parser.add_argument("--nodes", type=int, default=128, help="quadrature nodes along a radius, twice as many around")
    parser.add_argument("--variant", default="llvm_ad_rgb")
    arguments = parser.parse_args()
    mi.set_variant(arguments.variant)
    print_range_table(arguments.nodes // 2)
    print_specular_table(arguments.nodes)
    print_diffuse_table()
    print_timing_table()


if __name__ == "__main__":
    main()
