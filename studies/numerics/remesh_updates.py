"""Memory and time over many updates of a `neural_sdf` with gradients: `python -m studies.numerics.remesh_updates`.

Every update moves the shape latent at random, extracts the mesh again, renders a small picture and differentiates it.
Prints, after every 50 updates, the seconds, the resident memory and the number of vertices: memory that leaks would
grow from line to line. Linux only."""

import argparse
import time
from pathlib import Path

import sira_mi  # noqa: F401  (before Dr.Jit, which must find LLVM)

# isort: split
import drjit as dr
import mitsuba as mi
import numpy as np


def resident_megabytes() -> float:
    """Memory that this process holds now."""
    status = Path("/proc/self/status").read_text()
    return int(status.split("VmRSS:")[1].split()[0]) / 1024


def main() -> None:
    parser = argparse.ArgumentParser(description="Memory and time over many updates of a `neural_sdf` with gradients.")
    parser.add_argument("--avatar", default="", help="avatar.safetensors (default: the shipped prior)")
    parser.add_argument("--updates", type=int, default=500)
    parser.add_argument("--voxel", type=float, default=0.1, help="scene units")
    parser.add_argument("--variant", default="llvm_ad_rgb")
    arguments = parser.parse_args()
    mi.set_variant(arguments.variant)
    scene = mi.load_dict(
        {
            "type": "scene",
            "head": {"type": "neural_sdf", "avatar": arguments.avatar, "voxel": arguments.voxel},
            "light": {"type": "constant"},
            "integrator": {"type": "direct_projective", "sppi": 0},
            "sensor": {
                "type": "perspective",
                "fov": 40,
                "to_world": mi.ScalarTransform4f().look_at([0, 0, 8], [0, 0, 0], [0, 1, 0]),
                "film": {
                    "type": "hdrfilm",
                    "width": 32,
                    "height": 32,
                    "rfilter": {"type": "box"},
                    "sample_border": True,
                },
            },
        }
    )
    params = mi.traverse(scene)
    start = params["head.z_sdf"].numpy().copy()
    rng = np.random.default_rng(0)
    began = time.perf_counter()
    for update in range(arguments.updates + 1):
        if update % 50 == 0:
            seconds = time.perf_counter() - began
            vertices = len(params["head.vertex_positions"]) // 3
            print(
                f"{update:5d} updates  {seconds:7.1f} s  {resident_megabytes():7.0f} MB  {vertices} vertices",
                flush=True,
            )
        latent = mi.Float(start + 0.3 * rng.standard_normal(len(start)).astype(np.float32))
        dr.enable_grad(latent)
        params["head.z_sdf"] = latent
        params.update()
        image = mi.render(scene, params, spp=4, seed=mi.UInt32(update))
        dr.backward(dr.mean(image.array))


if __name__ == "__main__":
    main()
