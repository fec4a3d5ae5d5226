"""The polish: albedo and light of a finished fit, refined through Mitsuba's own `prb`. The paper has no such stage.

The appearance stages shade in closed form: shadows of 128 directions, and one bounce off neighbours of the same albedo.
Here the picture is path traced, with all bounces, and its derivative is Mitsuba's. Networks are slow in symbolic loops,
so `prb` sees the albedos at the vertices of a mesh; what it finds for these and for the lobes is handed on to the
networks behind them. The losses other than the picture's are those of the refinement stage, so that light and albedo
stay where the priors hold them.

`prb` sums derivatives by atomic additions: on several threads the last bits of a polished avatar vary from run to run.
"""

from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.ndimage import binary_erosion
from skimage.transform import resize_local_mean

from sira_mi.avatar.decoders import albedo_refinement, diffuse_albedo, refine_albedo, specular_albedo
from sira_mi.avatar.file import Avatar, load_avatar
from sira_mi.export.scene import head, head_scene, sensor, sg_light
from sira_mi.fields.columns import evaluate_in_chunks
from sira_mi.fields.sdf import deform
from sira_mi.fit.appearance import AppearanceProblem
from sira_mi.fit.output import head_box
from sira_mi.fit.settings import FitSettings, Stage
from sira_mi.fit.shaded import decode_lobes, decoder
from sira_mi.portrait.portrait import Portrait
from sira_mi.relight.pictures import psnr_inside
from sira_mi.sg.layers import split_layers

# Where the scene keeps what the picture is made of.
_SEEN = {
    "diffuse": "head.vertex_diffuse_albedo",
    "specular": "head.vertex_specular_albedo",
    "lobes": "light.lobes",
}
# Tensors of a fit under this prefix are as they were before the polish.
_BEFORE = "before_polish/"
# Pixels of which this share shows the head are compared.
_COVERED = 0.999
# Added to radiances and albedos that are divided by.
_DARK = 1e-2
# Paths a pixel of the picture that weighs the pixels, and the error below which all count alike.
_WEIGHING_SAMPLES, _LEAST_ERROR = 64, 0.02
# Samples a pixel of the pictures that PSNRs are taken of.
_SCORED_SAMPLES = {"path_traced": 256, "closed_form": 4}


class PolishProblem:
    """The losses of the polish stage for one portrait on the fitted geometry of the avatar at `avatar_path`."""

    def __init__(self, portrait: Portrait, avatar: Avatar, avatar_path: str, settings: FitSettings):
        self.avatar, self.settings = avatar, settings
        self.regular = AppearanceProblem(portrait, avatar, avatar_path, settings)
        self.scene, self.target, self.share = polish_scene(portrait, avatar_path, settings)
        self.parameters = mi.traverse(self.scene)
        self.detail = picture_detail(self.scene, avatar_path)
        shape = self.scene.shapes()[0]
        self.x_ref, self.gamma = evaluate_in_chunks(lambda x: deform(shape.field(), x), shape.vertices())
        self.jitter = 0.5 * shape.voxel

    def start(self, stage: Stage, tensors: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Keeps what the stage moves as it was before."""
        return {_BEFORE + name: tensors[name] for name in stage.rates}

    def refresh(self, tensors: dict[str, np.ndarray]) -> None:
        """Makes arrays of all tensors, those that the stage holds fixed included, and weighs the pixels by their errors
        in a picture of many paths."""
        self._fixed = {name: mi.Float(value) for name, value in tensors.items() if value.ndim == 1}
        self.regular.refresh(tensors)
        with dr.suspend_grad():
            self._show(self._appearance(self._fixed, 1.0, np.random.default_rng(0)))
            picture = mi.render(self.scene, spp=_WEIGHING_SAMPLES, seed=0).numpy()[..., :3] * self.detail
        scale = np.sqrt(self.target + _DARK) + np.sqrt(picture + _DARK)
        error = np.abs(picture - self.target) / scale
        self.weight = mi.TensorXf(0.5 * self.share / (scale**2 * np.maximum(error, _LEAST_ERROR)))

    def losses(self, tensors: dict, stage: Stage, step: int, rng: np.random.Generator) -> dict:
        terms = self.regular.losses(tensors, stage, step, rng)
        return {**terms, "color": self.settings.polish.color * self._color({**self._fixed, **tensors}, stage.k_r, rng)}

    def _color(self, tensors: dict, k_r: float, rng: np.random.Generator):
        """Half the mean absolute difference of the square roots of path-traced picture and photo. Of noisy pictures
        that would be biased; so it is a squared difference over that which the pixel had when the weights were set
        (iteratively reweighted least squares), and picture and derivative come from independent paths: in expectation
        the derivative is exact."""
        seen = self._appearance(tensors, k_r, rng)
        seeds = (int(seed) for seed in rng.integers(1 << 31, size=2))
        value, derivatives = self._traced({kind: dr.detach(a) for kind, a in seen.items()}, *seeds)
        chained = sum(dr.sum(derivatives[kind] * (a - dr.detach(a)), axis=None) for kind, a in seen.items())
        return value + chained

    def _appearance(self, tensors: dict, k_r: float, rng: np.random.Generator) -> dict:
        """What the picture is made of: albedos [3, V] and [1, V] at the vertices, lobes [N_l, 7]. The places at which
        the networks are asked are shaken by half a voxel, so that a vertex stands for its surroundings."""
        a = self.avatar.architecture
        shaken = self.x_ref + rng.uniform(-self.jitter, self.jitter, self.x_ref.shape)
        x_ref, gamma = mi.TensorXf(shaken.astype(np.float32)), mi.TensorXf(self.gamma)
        base = diffuse_albedo(decoder(self.avatar, "diffuse_albedo", tensors, "z_a"), a.albedo_octaves, x_ref, gamma)
        fine = albedo_refinement(decoder(self.avatar, "albedo_refinement", tensors), a.refinement_octaves, x_ref, gamma)
        specular = decoder(self.avatar, "specular_albedo", tensors, "z_s")
        result = {
            "diffuse": refine_albedo(base, fine, k_r),
            "specular": specular_albedo(specular, a.specular_octaves, x_ref),
            "lobes": decode_lobes(self.avatar, tensors),
        }
        dr.eval(result)
        return result

    def _show(self, seen: dict) -> dict:
        """Puts what `_appearance` gives into the scene: as arrays of their own, with gradients."""
        leaves = {
            kind: mi.TensorXf(a) if kind == "lobes" else mi.Float(np.ravel(a.numpy().T)) for kind, a in seen.items()
        }
        dr.enable_grad(*leaves.values())
        for kind, name in _SEEN.items():
            self.parameters[name] = leaves[kind]
        self.parameters.update()
        return leaves

    def _traced(self, seen: dict, seed: int, seed_of_derivative: int) -> tuple:
        """The loss of the picture, and its derivatives by what `_appearance` gives."""
        leaves = self._show(seen)
        samples = self.settings.polish.samples
        image = mi.render(
            self.scene,
            self.parameters,
            spp=samples,
            spp_grad=samples,
            seed=seed,
            seed_grad=seed_of_derivative,
        )
        error = image[:, :, :3] * mi.TensorXf(self.detail) - mi.TensorXf(self.target)
        loss = dr.sum(error * error * self.weight, axis=None)
        dr.backward(loss)
        derivatives = {
            kind: dr.grad(leaf)
            if kind == "lobes"
            else mi.TensorXf(np.ascontiguousarray(dr.grad(leaf).numpy().reshape(-1, len(seen[kind])).T))
            for kind, leaf in leaves.items()
        }
        return dr.detach(loss), derivatives


def polish_scene(portrait: Portrait, avatar_path: str | Path, settings: FitSettings) -> tuple:
    """The head of an avatar file with its albedo refined in full, cropped and scaled to the size of the polish, before
    `prb`: the scene, the photo [h, w, 3], and each pixel's share [h, w, 1] in a mean over the colours of pixels that
    show nothing but the head."""
    x0, y0, x1, y1 = head_box(portrait.mask)
    factor = min(1.0, settings.polish.size / max(x1 - x0, y1 - y0))
    width, height = round((x1 - x0) * factor), round((y1 - y0) * factor)
    camera = portrait.camera.crop(x0, y0, x1 - x0, y1 - y0)
    camera = camera.scale(width / camera.width, height / camera.height, width, height)
    avatar, description = load_avatar(avatar_path), head(avatar_path, settings.final_voxel, baked=True)
    description["bsdf"]["roughness"] = avatar.roughness
    integrator = {"type": "prb", "max_depth": settings.polish.depth, "hide_emitters": True}
    eye = sensor(camera, {"type": "ldsampler", "sample_count": settings.polish.samples})
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


def picture_detail(scene: mi.Scene, avatar_path: str | Path) -> np.ndarray:
    """What the path-traced picture is multiplied by, by pixel [h, w, 3]: where the mesh is too coarse for the albedo,
    the networks' diffuse albedo over that between vertices; and the refinement of the avatar's light."""
    closed_form = {"type": "sira_sg", "hide_emitters": True, "light_refinement": str(avatar_path)}
    exact = mi.render(scene, integrator=mi.load_dict(closed_form), spp=16, seed=0).numpy()
    baked = mi.render(scene, integrator=mi.load_dict({"type": "aov", "aovs": "albedo:albedo"}), spp=16, seed=0).numpy()
    layers = split_layers(exact)
    albedo = np.clip((layers["diffuse_albedo"] + _DARK) / (baked[..., :3] + _DARK), 0.5, 2.0)
    light = (layers["final"] + _DARK) / (layers["diffuse"] + layers["specular"] + _DARK)
    return (albedo * light).astype(np.float32)


def before_polish(tensors: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The tensors of a fit as they were before its polish, or as they are where that has not begun."""
    kept = {name.removeprefix(_BEFORE): value for name, value in tensors.items() if name.startswith(_BEFORE)}
    return {**tensors, **kept}


def polish_gain(
    portrait: Portrait, avatar: Avatar, tensors: dict[str, np.ndarray], avatar_path: Path, settings: FitSettings
) -> dict[str, list[float]]:
    """PSNR in dB of the head's pictures against the photo before and after the polish, in the size of the polish:
    `path_traced_psnr_db` and `closed_form_psnr_db`."""
    scene, photo, weight = polish_scene(portrait, avatar_path, settings)
    closed_form = mi.load_dict({"type": "sira_sg", "hide_emitters": True, "light_refinement": str(avatar_path)})
    detail = picture_detail(scene, avatar_path)
    pictures = ("path_traced", scene.integrator(), detail), ("closed_form", closed_form, 1.0)
    parameters = mi.traverse(scene)
    gain: dict[str, list[float]] = {f"{name}_psnr_db": [] for name, _, _ in pictures}
    for state in (before_polish(tensors), tensors):
        floats = {name: mi.Float(value) for name, value in state.items() if value.ndim == 1}
        parameters["head.bsdf.diffuse_albedo.refinement"] = floats["albedo_refinement"]
        parameters["head.bsdf.specular_albedo.latent"] = floats["z_s"]
        parameters["light.lobes"] = decode_lobes(avatar, floats)
        parameters.update()
        for name, integrator, detail in pictures:
            image = mi.render(scene, integrator=integrator, spp=_SCORED_SAMPLES[name], seed=0).numpy()[..., :3]
            gain[f"{name}_psnr_db"].append(round(psnr_inside(image * detail, photo, weight[..., 0] > 0), 2))
    return gain
