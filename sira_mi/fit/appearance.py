"""The appearance stages of section 3.2.2, on the surface points behind the photo's pixels: light, albedo, speculars,
refinement, with the losses of eqs 12 and 13. Geometry is fixed, so points are found once."""

import drjit as dr
import mitsuba as mi
import numpy as np

from sira_mi.avatar.decoders import albedo_refinement, diffuse_albedo, light_refinement, refine_albedo
from sira_mi.avatar.file import Avatar
from sira_mi.decisions import Plan
from sira_mi.fields.columns import evaluate_in_chunks, in_three
from sira_mi.fields.mlp import initial_parameters
from sira_mi.fit.leave_out import BASE_ALBEDO, SPECULARS, plan_fit
from sira_mi.fit.residual import albedo_shares, albedo_variances, light_variances, log_residual, share_loss
from sira_mi.fit.settings import FitSettings, Stage
from sira_mi.fit.shaded import PhotoPoints, base_albedo, decoder, photo_points, shade_points
from sira_mi.fit.skin import skin_patches
from sira_mi.optimisation import losses
from sira_mi.portrait.portrait import Portrait

# ε of the smoothness of the refinement, scene units.
_JITTER = 0.01


class AppearanceProblem:
    """The losses of the appearance stages for one portrait on the fitted geometry of the avatar at `avatar_path`.
    `plan` says what each stage leaves out (default: all that `plan_fit` finds)."""

    def __init__(
        self, portrait: Portrait, avatar: Avatar, avatar_path: str, settings: FitSettings, plan: Plan | None = None
    ):
        self.avatar, self.settings = avatar, settings
        self.plan = plan_fit(settings) if plan is None else plan
        self._base_at, self._base = None, None
        head = mi.load_dict({"type": "neural_sdf", "avatar": avatar_path, "voxel": settings.voxel})
        self.points = photo_points(portrait, head, settings.shadows)
        self.skin = skin_patches(portrait, self.points)
        self.albedo_variances = albedo_variances(portrait, self.points.row, self.points.column)
        self.target = np.ascontiguousarray(portrait.image[self.points.row, self.points.column].T, dtype=np.float32)

    def start(self, stage: Stage, tensors: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Before the light is first optimised, its decoder is scaled to the photo's exposure: the ratio of the photo's
        to the rendered mean radiance at the prior's albedo, as one factor for all channels. Before it is refined, it
        is settled which shares of the residual are the albedo's; the refinement of the light starts from 1."""
        self.refresh(tensors)
        index = self._draw(np.random.default_rng(0))
        if stage.k_s[1] == 0 and "z_a" not in stage.rates:
            diffuse, _ = self._base_radiance(self.points[index], stage.k_s[0])
            factor = self.target[:, index].mean() / max(float(diffuse.mean()), 1e-6)
            return {"illumination": exposed(self.avatar, tensors["illumination"], factor)}
        if not _refines_light(stage):
            return {}

        def radiance(points: PhotoPoints) -> np.ndarray:
            return sum(self._base_radiance(points, stage.k_s[0]))

        diffuse, specular = self._base_radiance(self.points[index], stage.k_s[0])
        residual = log_residual(self.target[:, index] - specular, diffuse)
        light = light_variances(radiance, self.points, index, seed=0)
        network = self.avatar.architecture.networks["light_refinement"]
        return {
            "light_refinement": initial_parameters(network, np.random.default_rng(0), output_scale=0.0),
            "albedo_shares": albedo_shares(residual, index, self.albedo_variances, light),
        }

    def _base_radiance(self, points: PhotoPoints, k_s: float) -> tuple[np.ndarray, np.ndarray]:
        """Diffuse and specular radiance [3, n] of the base albedo at `points`."""
        with dr.suspend_grad():
            shading = shade_points(self.avatar, self._fixed, k_s, points, base_albedo(self.avatar, self._fixed, points))
            return shading.diffuse.numpy(), shading.specular.numpy()

    def _draw(self, rng: np.random.Generator) -> np.ndarray:
        count = self.target.shape[1]
        return np.sort(rng.choice(count, min(self.settings.pixels, count), replace=False))

    def refresh(self, tensors: dict[str, np.ndarray]) -> None:
        """Makes arrays of all tensors, those that the stage holds fixed included."""
        self.shares = tensors.get("albedo_shares")
        self._fixed = {name: mi.Float(value) for name, value in tensors.items() if value.ndim == 1}
        decoder_of_base = tensors["diffuse_albedo"], tensors["z_a"]
        if self._base_at is None or not all(map(np.array_equal, self._base_at, decoder_of_base)):
            self._base_at, self._base = decoder_of_base, None

    def _base_and_skin(self, current: dict, stage: Stage, index: np.ndarray) -> tuple:
        """Base albedo [3, n] at the points `index` and the loss of the skin's tone (None without skin); of a stage that
        holds both fixed, both are evaluated once."""
        if not self.plan.leaves_out(BASE_ALBEDO, stage.name):
            skin = self._skin_loss(current)
            return base_albedo(self.avatar, current, self.points[index]), skin
        if self._base is None:
            a, points = self.avatar.architecture, self.points
            network = decoder(self.avatar, "diffuse_albedo", self._fixed, "z_a")
            (base,) = evaluate_in_chunks(
                lambda x_ref, gamma: diffuse_albedo(network, a.albedo_octaves, x_ref, gamma), points.x_ref, points.gamma
            )
            self._base = base, self._skin_loss(self._fixed)
        base, skin = self._base
        return mi.TensorXf(np.ascontiguousarray(base[:, index])), skin

    def _skin_loss(self, current: dict):
        return None if self.skin is None else self.skin.loss(self.avatar, current)

    def losses(self, tensors: dict, stage: Stage, step: int, rng: np.random.Generator) -> dict:
        weights, a = self.settings.appearance, self.avatar.architecture
        current = {**self._fixed, **tensors}
        index = self._draw(rng)
        points = self.points[index]

        share = step / max(stage.steps - 1, 1)
        k_s = stage.k_s[0] + (stage.k_s[1] - stage.k_s[0]) * min(1.0, 2 * share)
        if self.plan.leaves_out(SPECULARS, stage.name):
            k_s = None
        base, skin_tone = self._base_and_skin(current, stage, index)
        albedo = base
        if stage.k_r > 0:
            network = decoder(self.avatar, "albedo_refinement", current)
            x_ref, gamma = mi.TensorXf(points.x_ref), mi.TensorXf(points.gamma)
            fine = albedo_refinement(network, a.refinement_octaves, x_ref, gamma)
            albedo = refine_albedo(base, fine, stage.k_r)
        shading = shade_points(self.avatar, current, k_s, points, albedo)
        target = mi.TensorXf(np.ascontiguousarray(self.target[:, index]))
        radiance = shading.diffuse + shading.specular
        if _refines_light(stage):
            of_light = light_refinement(
                decoder(self.avatar, "light_refinement", current), a.refinement_octaves, x_ref, gamma
            )
            radiance = radiance * dr.exp(of_light)
        terms = {
            "color": losses.photometric_loss(radiance, target),
            "embedding": weights.embedding * losses.squared_norm(*(current[name] for name in ("z_a", "z_s", "z_l"))),
            "white_light": weights.white_light * _chroma(shading.lobes),
        }
        if skin_tone is not None:
            terms["skin_tone"] = weights.skin_tone * skin_tone
        if stage.k_r > 0:
            moved = x_ref + mi.TensorXf((_JITTER * rng.standard_normal((3, len(index)))).astype(np.float32))
            rough = fine - albedo_refinement(network, a.refinement_octaves, moved, gamma)
            base_diffuse = shading.diffuse * (base / dr.maximum(albedo, 1e-4))
            terms["refinement"] = weights.refinement * self._refinement_loss(fine, base, base_diffuse, shading.specular)
            terms["smoothness"] = weights.smoothness * losses.mean(dr.abs(rough))
        if _refines_light(stage):
            terms["shares"] = weights.shares * share_loss(base, albedo, of_light, self.shares[:, index])
        return terms

    def _refinement_loss(self, fine, base, base_diffuse, specular_radiance):
        """Eqs 12 and 13: ‖a^r‖ weighted by w, large in shadows and in reflections. The base albedo and the radiances
        only weigh, they are not moved by this loss."""
        weights = self.settings.appearance
        shadow = dr.maximum(_norm_1(base) - _norm_1(base_diffuse), 0.0)
        w = dr.detach(weights.lambda_8 * shadow + weights.lambda_9 * _norm_1(specular_radiance))
        length = dr.sqrt(dr.sum(fine * fine, axis=0) + 1e-8)
        return losses.mean(length * w)


def _refines_light(stage: Stage) -> bool:
    return "light_refinement" in stage.rates


def exposed(avatar: Avatar, illumination_parameters: np.ndarray, factor: float) -> np.ndarray:
    """Parameters of the illumination decoder whose lobes are brighter by about `factor`, by the bias of their
    log-amplitudes."""
    flat = illumination_parameters.copy()
    bias = flat[-7 * avatar.architecture.lobes :].reshape(-1, 7)
    bias[:, 4:7] += np.float32(np.log(max(factor, 1e-6)))
    return flat


def _norm_1(v):
    """‖v‖₁ of the columns of v [rows, N]: [N]."""
    return dr.sum(dr.abs(v), axis=0)


def _chroma(lobes):
    """Mean squared log-chroma of the lobes' amplitudes."""
    logarithm = dr.log(lobes[:, 4:7])
    grey = dr.reshape(dr.mean(logarithm, axis=1), (-1, 1))
    deviation = logarithm - in_three(grey, axis=1)
    return losses.mean(deviation * deviation)
