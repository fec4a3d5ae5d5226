"""Times of the plugins as ratios: medians over runs in turn, with compiled kernels."""

from __future__ import annotations

import functools
import itertools
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from sira_mi.avatar.architecture import AvatarArchitecture
from sira_mi.avatar.file import Avatar, save_avatar
from sira_mi.conventions import LANDMARKS
from sira_mi.export import scene as scenes
from sira_mi.fields.mlp import initial_parameters
from sira_mi.fields.sdf import sphere_parameters
from sira_mi.plugins.neural_sdf import NeuralSDF, trace_head
from sira_mi.sg.lobes import evaluate_lobes
from sira_mi.sg.shading import shade
from studies.crosscheck.case import Case
from studies.crosscheck.images import path, render
from studies.crosscheck.points import primary_rays

_REPEATS = 5
# Samples a pixel of the picture that is path-traced with networks.
_NEURAL_SAMPLES = 4
_TEXTURE_SIZE = 512  # pixels
_ENVIRONMENT = (64, 128)  # height and width
LOBE_COUNTS = (8, 32, 128)
POINT_COUNTS = (1 << 14, 1 << 16, 1 << 18)
WIDTHS = (32, 64, 128, 256)


@dataclass(frozen=True)
class Ratio:
    """The time of one thing over that of another."""

    name: str
    over: str
    value: float
    seconds: float  # of the first
    mark: float | None = None  # the largest value wanted

    @property
    def met(self) -> bool:
        """Whether the mark is kept; also without one."""
        return self.mark is None or self.value <= self.mark


@dataclass(frozen=True)
class Cost:
    """Time of one size of a problem."""

    what: str
    lobes: int
    points: int
    width: int  # of the networks; 0 where there are none
    seconds: float


def interleave(functions: dict[str, Callable[[], object]], repeats: int = _REPEATS) -> dict[str, float]:
    """Median wall time of each function, after one run of each. They run in turn, so that other work on the machine
    affects all alike."""
    spent: dict[str, list[float]] = {name: [] for name in functions}
    for k in range(repeats + 1):
        for name, function in functions.items():
            start = time.perf_counter()
            function()
            if k:
                spent[name].append(time.perf_counter() - start)
    return {name: float(np.median(times)) for name, times in spent.items()}


def stock_mesh(head: NeuralSDF, bsdf: dict) -> mi.Mesh:
    """The head's mesh as Mitsuba's own, with texture coordinates from the front and its baked albedo as an attribute,
    under a stock BSDF."""
    params = mi.traverse(head)
    vertices, faces = params["vertex_positions"], params["faces"]
    props = mi.Properties()
    props["mesh_bsdf"] = mi.load_dict(bsdf)
    count = len(vertices) // 3
    mesh = mi.Mesh("stock", count, len(faces) // 3, props=props, has_vertex_normals=True, has_vertex_texcoords=True)
    mesh.add_attribute("vertex_albedo", 3, np.array(params["vertex_diffuse_albedo"]).tolist())
    own = mi.traverse(mesh)
    positions = np.array(vertices).reshape(-1, 3)
    span = np.ptp(positions[:, :2], axis=0)
    own["vertex_positions"], own["faces"] = vertices, faces
    own["vertex_texcoords"] = mi.Float(((positions[:, :2] - positions[:, :2].min(axis=0)) / span).ravel())
    own.update()
    return mesh


def _stock(texture: str) -> dict[str, dict]:
    """Stock BSDFs with a bitmap or a vertex attribute as albedo."""
    if texture == "bitmap":
        pixels = np.random.default_rng(0).uniform(0.2, 0.8, (_TEXTURE_SIZE, _TEXTURE_SIZE, 3)).astype(np.float32)
        albedo = {"type": "bitmap", "bitmap": mi.Bitmap(pixels), "raw": True}
    else:
        albedo = {"type": "mesh_attribute", "name": "vertex_albedo"}
    bsdfs = {"principled": {"type": "principled", "base_color": albedo, "roughness": 0.5, "specular": 0.5}}
    if texture == "bitmap":  # `roughplastic` wants the texture's mean, which an attribute does not tell
        bsdfs["roughplastic"] = {"type": "roughplastic", "diffuse_reflectance": albedo, "alpha": 0.25}
    return bsdfs


def _environment(lobes: np.ndarray) -> dict:
    """Mitsuba's `envmap` of the lobes."""
    height, width = _ENVIRONMENT
    theta = (np.arange(height) + 0.5) / height * np.pi
    phi = (np.arange(width) + 0.5) / width * 2 * np.pi
    sine = np.sin(theta)[:, None]
    y = np.broadcast_to(np.cos(theta)[:, None], (height, width))
    direction = np.stack([np.sin(phi) * sine, y, -np.cos(phi) * sine], axis=-1)
    image = evaluate_lobes(lobes.astype(np.float64), direction).astype(np.float32)
    return {"type": "envmap", "bitmap": mi.Bitmap(image)}


def texture_ratios(case: Case, usual: NeuralSDF, lobes: np.ndarray, samples: int) -> list[Ratio]:
    """Path tracing with neural and baked albedos against stock BSDFs on the same mesh, under the same light."""
    integrator = path()
    shapes = {"baked": usual}
    shapes |= {f"bitmap {name}": stock_mesh(usual, bsdf) for name, bsdf in _stock("bitmap").items()}
    shapes |= {f"attribute {name}": stock_mesh(usual, bsdf) for name, bsdf in _stock("attribute").items()}
    runs = {name: case.scene(shape, lobes) for name, shape in shapes.items()}
    runs["baked, envmap"] = case.scene(usual, lobes, _environment(lobes))
    runs["attribute principled, envmap"] = case.scene(shapes["attribute principled"], lobes, _environment(lobes))
    seconds = interleave({k: functools.partial(render, s, integrator, samples, 5) for k, s in runs.items()})
    # Networks are slow, so these pictures have few samples. Stock Mitsuba comes before there is a head with networks,
    # because all kernels hold the networks of every head that is alive.
    few: dict[str, float] = {}
    for name, shape in (
        ("stock", lambda: shapes["bitmap principled"]),
        ("neural", lambda: case.head(usual.voxel, False)),
    ):
        scene = case.scene(shape(), lobes)
        few |= interleave({name: functools.partial(render, scene, integrator, _NEURAL_SAMPLES, 5)}, 3)

    def ratio(name: str, over: str, first: str, second: str, mark: float | None = None) -> Ratio:
        return Ratio(name, over, seconds[first] / seconds[second], seconds[first], mark)

    first = "`path`, `sira_bsdf` with neural textures"
    baked = "`path`, `sira_bsdf` with baked textures"
    return [
        Ratio(first, "`principled`, bitmap", few["neural"] / few["stock"], few["neural"], 3.0),
        ratio(baked, "`principled`, vertex attribute", "baked", "attribute principled", 1.1),
        ratio(baked, "`roughplastic`, bitmap", "baked", "bitmap roughplastic"),
        ratio(baked, "`principled`, bitmap", "baked", "bitmap principled"),
        ratio(f"{baked}, `envmap`", "`principled`, `envmap`", "baked, envmap", "attribute principled, envmap"),
        ratio(baked + ", `sg_envmap`", "the same, `envmap`", "baked", "baked, envmap"),
    ]


def hit_ratio(case: Case, head: NeuralSDF, side: int) -> Ratio:
    """Exact primary hits on the field against Embree's on the mesh."""
    scene = case.scene(head, np.array([[0, 0, 1, 1, 1, 1, 1]], np.float32))
    rays = [primary_rays(case, scene, side, seed) for seed in range(2)]
    dr.eval(rays)
    turns = {"exact": itertools.cycle(rays), "mesh": itertools.cycle(rays)}

    def exact():
        dr.eval(trace_head(scene, head, next(turns["exact"]), mi.Bool(True)))
        dr.sync_thread()

    def mesh():
        dr.eval(scene.ray_intersect(next(turns["mesh"])))
        dr.sync_thread()

    exact()
    times = interleave({"exact": exact, "mesh": mesh})
    return Ratio(
        "primary hits refined on the field", "Embree's on the mesh", times["exact"] / times["mesh"], times["exact"]
    )


def compilation_ratio(case: Case, head: NeuralSDF, lobes: np.ndarray) -> Ratio:
    """Pictures by `sira_sg` of ever new rays, whose number of hits is new and asks for new kernels, against pictures of
    the same two sets of rays in turns. Kernels outlive the process, so the new seeds are taken from the clock."""
    scene, plugin = case.scene(head, lobes), mi.load_dict({"type": "sira_sg", "hide_emitters": True, "aovs": True})
    turns = itertools.cycle((1, 2))
    for _ in range(2):
        render(scene, plugin, 1, next(turns))
    times = interleave(
        {
            "new": lambda: render(scene, plugin, 1, time.time_ns()),
            "first": lambda: render(scene, plugin, 1, next(turns)),
            "second": lambda: render(scene, plugin, 1, next(turns)),
        },
        3,
    )
    again = 0.5 * (times["first"] + times["second"])
    return Ratio(
        "`sira_sg`, a picture with a number of hits not met before",
        "kernels compiled",
        times["new"] / again,
        times["new"],
    )


def shading_costs(repeats: int = _REPEATS) -> list[Cost]:
    """`shade` with more lobes and more points."""
    rng, result = np.random.default_rng(3), []
    for lobes in LOBE_COUNTS:
        light = np.concatenate(
            [rng.standard_normal((lobes, 3)), rng.uniform(1, 100, (lobes, 1)), rng.uniform(0, 1, (lobes, 3))], axis=1
        )
        tensor = mi.TensorXf(light.astype(np.float32))
        for count in POINT_COUNTS:
            normal, view = rng.standard_normal((2, 3, count))
            normal, view = (a / np.linalg.norm(a, axis=0) for a in (normal, view))
            view *= np.sign((normal * view).sum(axis=0))
            n, v = mi.Vector3f(normal.astype(np.float32)), mi.Vector3f(view.astype(np.float32))

            def run(n: mi.Vector3f = n, v: mi.Vector3f = v, tensor: mi.TensorXf = tensor) -> None:
                dr.eval(shade(n, v, mi.Float(0.04), mi.Float(0.5), tensor))
                dr.sync_thread()

            result.append(Cost("shade", lobes, count, 0, interleave({"shade": run}, repeats)["shade"]))
    return result


def random_avatar(width: int, seed: int = 0) -> Avatar:
    """A round head with random networks that are all `width` wide."""
    sizes = ("sdf", "rendering", "albedo", "specular", "refinement")
    architecture = AvatarArchitecture(**{f"{name}_width": width for name in sizes})
    rng, networks = np.random.default_rng([seed, width]), architecture.networks
    tensors = {name: initial_parameters(network, rng, output_scale=0.02) for name, network in networks.items()}
    tensors["reference"] = sphere_parameters(networks["reference"], rng, 1.4)
    tensors |= {name: np.zeros(size, np.float32) for name, size in architecture.latents.items()}
    tensors["lobes"] = np.array([[0, 0, 1, 1, 1, 1, 1]], np.float32)
    tensors["landmarks"] = np.full((LANDMARKS, 3), np.nan, np.float32)
    return Avatar(architecture, tensors)


def width_costs(case: Case, lobes: np.ndarray, widths: tuple[int, ...] = WIDTHS, voxel: float = 0.1) -> list[Cost]:
    """Pictures by `sira_sg`, one sample a pixel, of round heads with networks of several widths, on meshes of spacing
    `voxel`."""
    plugin, result = mi.load_dict({"type": "sira_sg", "hide_emitters": True, "aovs": True}), []
    with tempfile.TemporaryDirectory() as folder:
        for width in widths:
            file = Path(folder) / f"{width}.safetensors"
            save_avatar(file, random_avatar(width))
            head = scenes.head(file, voxel)
            scene = case.scene(mi.load_dict(head), lobes)
            layers = mi.render(scene, integrator=plugin, spp=1, seed=mi.UInt32(0)).numpy()
            turns = itertools.cycle((1, 2))
            render(scene, plugin, 1, next(turns))

            def run(scene: mi.Scene = scene, turns: Iterator[int] = turns) -> None:
                render(scene, plugin, 1, next(turns))

            spent = interleave({"sira_sg": run})["sira_sg"]
            result.append(Cost("sira_sg", len(lobes), int((layers[..., -1] > 0.5).sum()), width, spent))
    return result


def growth(costs: list[Cost], name: str) -> float:
    """Exponent with which time grows in `lobes`, `points` or `width` between the two largest values of it, at the
    largest of the other numbers. Heads of several widths are of several sizes, so that by width it is time a point."""

    def seconds(cost):
        return cost.seconds / max(cost.points, 1) if name == "width" else cost.seconds

    others = [other for other in ("lobes", "points") if other != name and name != "width"]
    top = [c for c in costs if all(getattr(c, o) == max(getattr(d, o) for d in costs) for o in others)]
    top = sorted(top, key=lambda c: getattr(c, name))[-2:]
    if len(top) < 2:
        return float("nan")
    return float(np.log(seconds(top[1]) / seconds(top[0])) / np.log(getattr(top[1], name) / getattr(top[0], name)))
