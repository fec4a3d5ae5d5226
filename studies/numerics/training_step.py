"""How fast the shape model trains: `python -m studies.numerics.training_step [--width 96]`.

Times one SA-SM training step on random scenes, counts its multiplications, and compares the rate with NumPy's matrix
product of the hidden layers' shape in the same run (the practical ceiling), forward and in the two transposed forms
that the reverse pass needs. Printed are points a second, GFLOP/s, the share of the ceiling, and where the time goes."""

import argparse
import dataclasses
import time
from collections import defaultdict

import sira_mi  # noqa: F401  (before Dr.Jit, which must find LLVM)

# isort: split
import drjit as dr
import mitsuba as mi
import numpy as np

from sira_mi.avatar.architecture import AvatarArchitecture
from sira_mi.fields.mlp import Architecture
from sira_mi.optimisation.adam import adam
from sira_mi.training import sa_sm
from sira_mi.training.scenes import TrainingScene

SCENES, REPEATS, WARM_UP = 64, 30, 5


def random_scene(seed: int, points: int = 2000) -> TrainingScene:
    """Points on a unit sphere with random colours: as costly as a head."""
    rng = np.random.default_rng(seed)
    normals = rng.standard_normal((points, 3))
    normals = (normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32)
    volume = rng.uniform(-2, 2, (points, 3)).astype(np.float32)
    return TrainingScene(
        points=normals,
        normals=normals,
        region=np.zeros(points, np.uint8),
        volume=volume,
        volume_distance=(np.linalg.norm(volume, axis=1) - 1).astype(np.float32),
        landmarks=normals[:468],
        sample_point=np.arange(points),
        sample_view=np.zeros(points, np.uint8),
        sample_color=rng.random((points, 3)).astype(np.float32),
        camera_centres=np.array([[0.0, 0, 12]], np.float32),
    )


def products(network: Architecture) -> int:
    """Multiply-adds of a network at one point, the latent's share left out."""
    return sum(weight[0] * weight[1] for weight, _, _ in network.shapes())


def step_flops(architecture: AvatarArchitecture, settings: sa_sm.ShapeTraining) -> float:
    """Floating-point operations of the matrix products of a step: value and three tangents of both SDF networks at
    every point, the rendering function at surface points, the deformation at landmarks; a reverse pass costs twice
    the forward one."""
    networks = architecture.networks
    sdf = products(networks["deformation"]) + products(networks["reference"])
    a_scene = 4 * sdf * (settings.surface_points + settings.volume_points)
    a_scene += products(networks["rendering"]) * settings.surface_points
    a_scene += products(networks["deformation"]) * settings.landmarks
    return 2.0 * 3.0 * a_scene * settings.scenes


def median_seconds(function, repeats: int = REPEATS) -> float:
    """Median wall time of `function`, warmed up."""
    for _ in range(WARM_UP):
        function()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return float(np.median(times))


def ceiling(width: int, columns: int) -> dict[str, float]:
    """GFLOP/s of NumPy's W H, Wᵀ H and H Hᵀ for W [width, width] and H [width, columns]."""
    rng = np.random.default_rng(0)
    w = rng.standard_normal((width, width)).astype(np.float32)
    h = rng.standard_normal((width, columns)).astype(np.float32)
    work = 2e-9 * width * width * columns
    forms = {"W H": lambda: w @ h, "Wᵀ H": lambda: w.T @ h, "H Hᵀ": lambda: h @ h.T}
    return {name: work / median_seconds(form) for name, form in forms.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description="How fast the shape model trains")
    parser.add_argument("--width", type=int, default=AvatarArchitecture().sdf_width)
    parser.add_argument("--points", type=int, help="points a step (default: the training's)")
    arguments = parser.parse_args()
    mi.set_variant("llvm_ad_rgb")
    architecture = dataclasses.replace(AvatarArchitecture(), sdf_width=arguments.width)
    settings = sa_sm.ShapeTraining()
    if arguments.points:
        a_scene = settings.surface_points + settings.volume_points
        settings = dataclasses.replace(settings, scenes=max(1, arguments.points // a_scene))
    scenes = [random_scene(k) for k in range(max(SCENES, settings.scenes))]
    optimizer = adam(
        sa_sm.initial_shape_model(architecture, settings, len(scenes), 0), sa_sm.rates(settings, 0), beta_2=0.99
    )
    batches = iter(range(10**9))

    def step() -> None:
        batch = sa_sm.draw_batch(scenes, settings, np.random.default_rng(next(batches)))
        sa_sm.training_step(architecture, settings, optimizer, batch)

    points = settings.scenes * (settings.surface_points + settings.volume_points)
    seconds = median_seconds(step)
    best = ceiling(arguments.width, points)
    rate = 1e-9 * step_flops(architecture, settings) / seconds
    mixed = 3 / sum(1 / value for value in best.values())
    print(f"{points} points a step, {1e3 * seconds:.1f} ms a step, {points / seconds:,.0f} points/s")
    print(f"matrix products: {rate:.0f} GFLOP/s")
    print("NumPy's ceiling: " + ", ".join(f"{name} {value:.0f}" for name, value in best.items()) + " GFLOP/s")
    print(f"share of W H: {rate / best['W H']:.2f}; of the three forms together ({mixed:.0f}): {rate / mixed:.2f}")
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history()
        step()
        history = dr.kernel_history()
    spent: dict[str, list] = defaultdict(lambda: [0, 0.0])
    for kernel in history:
        entry = spent[str(kernel["type"]).split(".")[-1]]
        entry[0] += 1
        entry[1] += kernel["execution_time"]
    for name, (count, milliseconds) in sorted(spent.items(), key=lambda item: -item[1][1]):
        print(f"  {name}: {count} launches, {milliseconds:.1f} ms")


if __name__ == "__main__":
    main()
