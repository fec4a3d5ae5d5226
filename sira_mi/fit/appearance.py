"""The appearance stages of section 3.2.2, on the surface points behind the photo's pixels: light, albedo, speculars,
refinement, with the losses of eqs 12 and 13. Geometry is fixed, so points are found once."""

import drjit as dr
import mitsuba as mi
import numpy as np

from sira_mi.fields.appearance import (
    albedo_refinement,
    diffuse_albedo,
    illumination,
    refined_albedo,
    specular_albedo,
)
from sira_mi.fields.mlp import layers
from sira_mi.fields.sdf import evaluate_in_chunks, in_three, surface
from sira_mi.fit.settings import FitSettings, Stage
from sira_mi.models import losses
from sira_mi.models.af_sm import physical_radiance
from sira_mi.models.avatar import Avatar
from sira_mi.plugins.neural_sdf import trace_head
from sira_mi.portrait.portrait import Portrait
from sira_mi.scene import sensor

# ε of the smoothness of the refinement, scene units.
_JITTER = 0.01


class AppearanceProblem:
    """The losses of the appearance stages for one portrait on the fitted geometry of the avatar at `avatar_path`."""

    def __init__(self, portrait: Portrait, avatar: Avatar, avatar_path: str, settings: FitSettings):
        self.avatar, self.settings = avatar, settings
        points = visible_points(portrait, avatar_path, settings.voxel)
        keep = portrait.mask[points["row"], points["column"]] > 0.5
        self.columns = {k: np.ascontiguousarray(v[:, keep]) for k, v in points.items() if k not in ("row", "column")}
        self.target = np.ascontiguousarray(portrait.image[points["row"], points["column"]][keep].T, dtype=np.float32)

    def start(self, stage: Stage, tensors: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Before the light is first optimised, its decoder is scaled to the photo's exposure: the ratio of the photo's
        to the rendered mean radiance at the prior's albedo, as one factor for all channels."""
        if stage.k_s[1] > 0 or "z_a" in stage.rates:
            return {}
        a = self.avatar.architecture
        self.refresh(tensors)
        index = np.random.default_rng(0).choice(self.target.shape[1], min(4096, self.target.shape[1]), replace=False)
        x_ref, gamma, normal, view = self._columns(np.sort(index))
        base = diffuse_albedo(self._network("diffuse_albedo", self._fixed, "z_a"), a.albedo_octaves, x_ref, gamma)
        lobes = decode_lobes(self.avatar, self._fixed)
        grey = dr.full(mi.TensorXf, 0.0, (1, len(index)))
        diffuse, _ = physical_radiance(base, grey, normal, view, self.avatar.roughness, 0.0, lobes)
        factor = self.target[:, index].mean() / max(float(diffuse.numpy().mean()), 1e-6)
        return {"illumination": exposed(self.avatar, tensors["illumination"], factor)}

    def _columns(self, index: np.ndarray) -> tuple:
        names = ("x_ref", "gamma", "normal", "view")
        return tuple(mi.TensorXf(np.ascontiguousarray(self.columns[k][:, index])) for k in names)

    def refresh(self, tensors: dict[str, np.ndarray]) -> None:
        """Makes arrays of all tensors, those that the stage holds fixed included."""
        self._fixed = {name: mi.Float(value) for name, value in tensors.items() if value.ndim == 1}

    def losses(self, tensors: dict, stage: Stage, step: int, rng: np.random.Generator) -> dict:
        weights, a = self.settings.appearance, self.avatar.architecture
        current = {**self._fixed, **tensors}
        count = self.target.shape[1]
        index = np.sort(rng.choice(count, min(self.settings.pixels, count), replace=False))
        x_ref, gamma, normal, view = self._columns(index)
        target = mi.TensorXf(np.ascontiguousarray(self.target[:, index]))

        share = step / max(stage.steps - 1, 1)
        k_s = stage.k_s[0] + (stage.k_s[1] - stage.k_s[0]) * min(1.0, 2 * share)
        base = diffuse_albedo(self._network("diffuse_albedo", current, "z_a"), a.albedo_octaves, x_ref, gamma)
        specular = specular_albedo(self._network("specular_albedo", current, "z_s"), a.specular_octaves, x_ref)
        lobes = decode_lobes(self.avatar, current)
        base_diffuse, specular_radiance = physical_radiance(
            base, specular, normal, view, self.avatar.roughness, k_s, lobes
        )
        terms = {
            "embedding": weights.embedding
            * (_square(current["z_a"]) + _square(current["z_s"]) + _square(current["z_l"])),
            "white_light": weights.white_light * _chroma(lobes),
        }
        diffuse = base_diffuse
        if stage.k_r > 0:
            network = self._network("albedo_refinement", current)
            fine = albedo_refinement(network, a.refinement_octaves, x_ref, gamma)
            # r^d is linear in the albedo, so the light is summed only once.
            ratio = refined_albedo(base, fine, stage.k_r) / dr.maximum(base, 1e-4)
            diffuse = base_diffuse * ratio
            moved = x_ref + mi.TensorXf((_JITTER * rng.standard_normal((3, len(index)))).astype(np.float32))
            rough = fine - albedo_refinement(network, a.refinement_octaves, moved, gamma)
            terms["refinement"] = weights.refinement * self._refinement_loss(
                fine, base, base_diffuse, specular_radiance
            )
            terms["smoothness"] = weights.smoothness * losses.mean(dr.abs(rough))
        terms["color"] = losses.photometric_loss(diffuse + specular_radiance, target)
        return terms

    def _network(self, name: str, current: dict, latent: str | None = None):
        z = None if latent is None else mi.TensorXf(current[latent], (len(current[latent]), 1))
        return layers(self.avatar.architecture.networks[name], current[name], z)

    def _refinement_loss(self, fine, base, base_diffuse, specular_radiance):
        """Eqs 12 and 13: ‖a^r‖ weighted by w, large in shadows and in reflections. The base albedo and the radiances
        only weigh, they are not moved by this loss."""
        weights = self.settings.appearance
        shadow = dr.maximum(_norm_1(base) - _norm_1(base_diffuse), 0.0)
        w = dr.detach(weights.lambda_8 * shadow + weights.lambda_9 * _norm_1(specular_radiance))
        length = dr.sqrt(dr.sum(fine * fine, axis=0) + 1e-8)
        return losses.mean(length * w)


def decode_lobes(avatar: Avatar, tensors: dict):
    """The light [N_l, 7] of the illumination decoder at `tensors` (Floats)."""
    network = layers(avatar.architecture.networks["illumination"], tensors["illumination"])
    return illumination(network, mi.TensorXf(tensors["z_l"], (len(tensors["z_l"]), 1)))[:, :, 0]


def exposed(avatar: Avatar, illumination_parameters: np.ndarray, factor: float) -> np.ndarray:
    """Parameters of the illumination decoder whose lobes are brighter by about `factor`, by the bias of their
    log-amplitudes."""
    flat = illumination_parameters.copy()
    bias = flat[-7 * avatar.architecture.lobes :].reshape(-1, 7)
    bias[:, 4:7] += np.float32(np.log(max(factor, 1e-6)))
    return flat


def visible_points(portrait: Portrait, avatar_path: str, voxel: float) -> dict[str, np.ndarray]:
    """The surface points at the pixel centres that show the head: `row`, `column` [N]; `x_ref`, `normal`, `view` [3, N]
    (view from the camera to the point); `gamma` [N_γ, N]."""
    scene = mi.load_dict(
        {
            "type": "scene",
            "sensor": sensor(portrait.camera),
            "head": {"type": "neural_sdf", "avatar": avatar_path, "voxel": voxel},
        }
    )
    head = scene.shapes()[0]
    height, width = portrait.mask.shape
    index = dr.arange(mi.UInt32, height * width)
    centre = mi.Point2f((mi.Float(index % width) + 0.5) / width, (mi.Float(index // width) + 0.5) / height)
    ray, _ = scene.sensors()[0].sample_ray(0.0, 0.5, centre, mi.Point2f(0.5))
    t, hit = trace_head(scene, head, ray, mi.Bool(True))
    chosen = np.flatnonzero(hit.numpy())
    direction = ray.d.numpy()[:, chosen]
    x = ray.o.numpy()[:, chosen] + t.numpy()[chosen] * direction
    field = head.field()
    _, gradient, x_ref, gamma = evaluate_in_chunks(lambda p: surface(field, p), x)
    return {
        "row": chosen // width,
        "column": chosen % width,
        "x_ref": x_ref,
        "gamma": gamma,
        "normal": (gradient / np.maximum(np.linalg.norm(gradient, axis=0), 1e-6)).astype(np.float32),
        "view": direction.astype(np.float32),
    }


def _norm_1(v):
    """‖v‖₁ of the columns of v [rows, N]: [N]."""
    return dr.sum(dr.abs(v), axis=0)


def _square(latent):
    return dr.sum(latent * latent, axis=None)


def _chroma(lobes):
    """Mean squared log-chroma of the lobes' amplitudes."""
    logarithm = dr.log(lobes[:, 4:7])
    grey = dr.reshape(dr.mean(logarithm, axis=1), (-1, 1))
    deviation = logarithm - in_three(grey, axis=1)
    return losses.mean(deviation * deviation)
