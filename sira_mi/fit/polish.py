"""The polish: albedo and light of a finished fit, refined through Mitsuba's own `prb`. The paper has no such stage.

The appearance stages shade in closed form: shadows in 128 directions, and one bounce off neighbours of the same albedo.
Here the picture is path traced, with all bounces, and its derivative is Mitsuba's. Networks are slow in symbolic loops,
so `prb` sees the albedos at the vertices of a mesh; its derivatives by these and by the lobes are passed on to the
networks behind them. All other losses are those of the albedo's refinement, so that the priors keep their hold on light
and albedo.

`prb` sums derivatives by atomic additions: on several threads the last bits of a polished avatar vary from run to run.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.ndimage import binary_erosion
from skimage.transform import resize_local_mean

from sira_mi.avatar.decoders import albedo_refinement, diffuse_albedo, refine_albedo, specular_albedo
from sira_mi.avatar.file import load_avatar
from sira_mi.decisions import Decision
from sira_mi.export.scene import head, head_scene, sensor, sg_light
from sira_mi.fields.columns import evaluate_in_chunks, to_array
from sira_mi.fields.sdf import deform
from sira_mi.fit.appearance import PhotoSurface, share_surface
from sira_mi.fit.output import head_box
from sira_mi.fit.refinement import AlbedoRefinementProblem, AlbedoRefinementStage
from sira_mi.fit.shaded import Arrays, decode_lobes, decoder
from sira_mi.fit.stage import FitTask, Problem
from sira_mi.fit.state import FitState
from sira_mi.portrait.portrait import Portrait
from sira_mi.relight.pictures import psnr_inside
from sira_mi.sg.layers import split_layers

# Where the scene keeps what the picture is made of.
_SCENE_PARAMETERS = {
    "diffuse": "head.vertex_diffuse_albedo",
    "specular": "head.vertex_specular_albedo",
    "lobes": "light.lobes",
}
# Pixels of which this share shows the head are compared.
_COVERED = 0.999
# Added to radiances and albedos that are divided by.
_DARK = 1e-2
# Paths a pixel of the picture that weighs the pixels, and the error below which all count alike.
_WEIGHING_SAMPLES, _LEAST_ERROR = 64, 0.02
# Samples a pixel of the pictures that PSNRs are taken of.
_SCORED_SAMPLES = {"path_traced": 256, "closed_form": 4}


@dataclass(frozen=True)
class PolishStage(AlbedoRefinementStage):
    """Light, refinement of the albedo and specular albedo by path tracing."""

    color: float = 1.0  # weight of the error of the path-traced picture
    size: int = 128  # longest side of the head's picture, pixels
    samples: int = 16  # paths a pixel, of the picture and again of its derivative; a power of 4
    depth: int = 6  # most segments of a path; 2 is direct light

    def problem(self, task: FitTask, state: FitState) -> Problem:
        before = state.before_polish()
        return PolishProblem(self, task, share_surface(task, before), task.write_avatar(before))

    def decisions(self) -> tuple[Decision, ...]:
        """None: next to path tracing, base albedos cost nothing."""
        return ()


class PolishProblem(AlbedoRefinementProblem):
    """The losses of the polish stage, with geometry and refinement of the light of the avatar at `avatar_path`."""

    stage: PolishStage

    def __init__(self, stage: PolishStage, task: FitTask, surface: PhotoSurface, avatar_path: Path):
        super().__init__(stage, task, surface)
        self.scene, self.target, self.share = load_polish_scene(
            surface.portrait, avatar_path, stage, task.settings.final_voxel
        )
        self.scene_parameters = mi.traverse(self.scene)
        self.detail = measure_detail(self.scene, avatar_path)
        shape = self.scene.shapes()[0]
        self.x_ref, self.gamma = evaluate_in_chunks(lambda x: deform(shape.field(), x), shape.vertices())
        self.jitter = 0.5 * shape.voxel

    def start(self, state: FitState) -> FitState:
        """Keeps the parameters that the stage moves as they are before it."""
        return replace(state, unpolished=state.parameters(self.stage.rates))

    def refresh(self, state: FitState) -> None:
        """Makes arrays of all of the avatar's parameters, and weighs the pixels by their errors in a picture of many
        paths."""
        super().refresh(state)
        with dr.suspend_grad():
            self._show(self._appearance(self._fixed, np.random.default_rng(0)))
            picture = mi.render(self.scene, spp=_WEIGHING_SAMPLES, seed=mi.UInt32(0)).numpy()[..., :3] * self.detail
        scale = np.sqrt(self.target + _DARK) + np.sqrt(picture + _DARK)
        error = np.abs(picture - self.target) / scale
        self.weight = mi.TensorXf(0.5 * self.share / (scale**2 * np.maximum(error, _LEAST_ERROR)))

    def losses(self, parameters: Arrays, step: int, rng: np.random.Generator) -> Arrays:
        terms = super().losses(parameters, step, rng)
        color = self._color({**self._fixed, **parameters}, rng)
        return {**terms, "color": self.stage.color * color}

    def _color(self, current: Arrays, rng: np.random.Generator) -> Any:
        """Half the mean absolute difference of the square roots of path-traced picture and photo. Of noisy pictures
        that would be biased; so it is a squared difference over that which the pixel had when the weights were set
        (iteratively reweighted least squares), and picture and derivative come from independent paths: in expectation
        the derivative is exact."""
        seen = self._appearance(current, rng)
        seeds = (int(seed) for seed in rng.integers(1 << 31, size=2))
        value, derivatives = self._trace({kind: dr.detach(a) for kind, a in seen.items()}, *seeds)
        chained = sum(dr.sum(derivatives[kind] * (a - dr.detach(a)), axis=None) for kind, a in seen.items())
        return value + chained

    def _appearance(self, current: Arrays, rng: np.random.Generator) -> Arrays:
        """What the picture is made of: albedos [3, V] and [1, V] at the vertices, lobes [N_l, 7]. The networks are
        evaluated up to half a voxel off the vertices, at random, so that a vertex stands for its surroundings."""
        a = self.avatar.architecture
        shaken = self.x_ref + rng.uniform(-self.jitter, self.jitter, self.x_ref.shape)
        x_ref, gamma = to_array(shaken), to_array(self.gamma)
        base = diffuse_albedo(decoder(self.avatar, "diffuse_albedo", current, "z_a"), a.albedo_octaves, x_ref, gamma)
        fine = albedo_refinement(decoder(self.avatar, "albedo_refinement", current), a.refinement_octaves, x_ref, gamma)
        specular = decoder(self.avatar, "specular_albedo", current, "z_s")
        result = {
            "diffuse": refine_albedo(base, fine, self.stage.k_r),
            "specular": specular_albedo(specular, a.specular_octaves, x_ref),
            "lobes": decode_lobes(self.avatar, current),
        }
        dr.eval(result)
        return result

    def _show(self, seen: Arrays) -> Arrays:
        """Puts what `_appearance` gives into the scene: as arrays of their own, with gradients."""
        leaves = {
            kind: mi.TensorXf(a) if kind == "lobes" else mi.Float(np.ravel(a.numpy().T)) for kind, a in seen.items()
        }
        dr.enable_grad(*leaves.values())
        for kind, name in _SCENE_PARAMETERS.items():
            self.scene_parameters[name] = leaves[kind]
        self.scene_parameters.update()
        return leaves

    def _trace(self, seen: Arrays, seed: int, seed_of_derivative: int) -> tuple[Any, Arrays]:
        """The loss of the picture, and its derivatives by what `_appearance` gives."""
        leaves = self._show(seen)
        samples = self.stage.samples
        image = mi.render(
            self.scene,
            self.scene_parameters,
            spp=samples,
            spp_grad=samples,
            seed=mi.UInt32(seed),
            seed_grad=seed_of_derivative,
        )
        error = image[:, :, :3] * mi.TensorXf(self.detail) - mi.TensorXf(self.target)
        loss = dr.sum(error * error * self.weight, axis=None)
        dr.backward(loss)
        derivatives = {
            kind: dr.grad(leaf) if kind == "lobes" else to_array(dr.grad(leaf).numpy().reshape(-1, len(seen[kind])).T)
            for kind, leaf in leaves.items()
        }
        return dr.detach(loss), derivatives


def load_polish_scene(
    portrait: Portrait, avatar_path: Path, stage: PolishStage, voxel: float
) -> tuple[mi.Scene, np.ndarray, np.ndarray]:
    """The path-traced head of an avatar file with its albedo refined in full, cropped and scaled to the size of the
    polish: the scene, the photo [h, w, 3], and each pixel's share [h, w, 1] in a mean over the colours of pixels that
    show nothing but the head."""
    x0, y0, x1, y1 = head_box(portrait.mask)
    factor = min(1.0, stage.size / max(x1 - x0, y1 - y0))
    width, height = round((x1 - x0) * factor), round((y1 - y0) * factor)
    camera = portrait.camera.crop(x0, y0, x1 - x0, y1 - y0)
    camera = camera.scale(width / camera.width, height / camera.height, width, height)
    avatar, description = load_avatar(avatar_path), head(avatar_path, voxel, baked=True)
    description["bsdf"]["roughness"] = avatar.roughness
    integrator = {"type": "prb", "max_depth": stage.depth, "hide_emitters": True}
    eye = sensor(camera, {"type": "ldsampler", "sample_count": stage.samples})
    scene = mi.load_dict(head_scene(integrator, eye, description, sg_light(avatar.tensors["lobes"])))
    parameters = mi.traverse(scene)
    parameters["head.bsdf.diffuse_albedo.k_r"] = 1.0
    parameters.update()
    photo, mask = (
        resize_local_mean(a[y0:y1, x0:x1].astype(np.float32), (height, width)) for a in (portrait.image, portrait.mask)
    )
    alpha = mi.render(scene, integrator=mi.load_dict({"type": "direct", "hide_emitters": True}), spp=16).numpy()[..., 3]
    inside = binary_erosion((mask > _COVERED) & (alpha > _COVERED))
    weight = inside[..., None] / max(3.0 * inside.sum(), 1.0)
    return scene, np.ascontiguousarray(photo, np.float32), weight.astype(np.float32)


def measure_detail(scene: mi.Scene, avatar_path: Path) -> np.ndarray:
    """What the path-traced picture is multiplied by, by pixel [h, w, 3]: where the mesh is too coarse for the albedo,
    the networks' diffuse albedo over that between vertices; and the refinement of the avatar's light."""
    closed_form = {"type": "sira_sg", "hide_emitters": True, "aovs": True, "light_refinement": str(avatar_path)}
    exact = mi.render(scene, integrator=mi.load_dict(closed_form), spp=16, seed=mi.UInt32(0)).numpy()
    baked = mi.render(
        scene, integrator=mi.load_dict({"type": "aov", "aovs": "albedo:albedo"}), spp=16, seed=mi.UInt32(0)
    ).numpy()
    layers = split_layers(exact)
    albedo = np.clip((layers["diffuse_albedo"] + _DARK) / (baked[..., :3] + _DARK), 0.5, 2.0)
    light = (layers["final"] + _DARK) / (layers["diffuse"] + layers["specular"] + _DARK)
    return (albedo * light).astype(np.float32)


def measure_polish(task: FitTask, stage: PolishStage, state: FitState) -> dict[str, list[float]]:
    """PSNR in dB of the head's pictures against the photo before and after the polish, in the size of the polish:
    `path_traced_psnr_db` and `closed_form_psnr_db`."""
    portrait, avatar, avatar_path = task.pose_portrait(state), task.prior, task.write_avatar(state.before_polish())
    scene, photo, weight = load_polish_scene(portrait, avatar_path, stage, task.settings.final_voxel)
    closed_form = mi.load_dict({"type": "sira_sg", "hide_emitters": True, "light_refinement": str(avatar_path)})
    detail = measure_detail(scene, avatar_path)
    pictures: tuple[tuple[str, Any, np.ndarray | float], ...] = (
        ("path_traced", scene.integrator(), detail),
        ("closed_form", closed_form, 1.0),
    )
    parameters = mi.traverse(scene)
    gain: dict[str, list[float]] = {f"{name}_psnr_db": [] for name, _, _ in pictures}
    for one in (state.before_polish(), state):
        floats = one.floats()
        parameters["head.bsdf.diffuse_albedo.refinement"] = floats["albedo_refinement"]
        parameters["head.bsdf.specular_albedo.latent"] = floats["z_s"]
        parameters["light.lobes"] = decode_lobes(avatar, floats)
        parameters.update()
        for name, integrator, factor in pictures:
            image = mi.render(scene, integrator=integrator, spp=_SCORED_SAMPLES[name], seed=mi.UInt32(0)).numpy()
            psnr = psnr_inside(image[..., :3] * factor, photo, weight[..., 0] > 0)
            gain[f"{name}_psnr_db"].append(round(psnr, 2))
    return gain
