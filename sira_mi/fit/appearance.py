"""The appearance stages of section 3.2.2 up to the refinement: light, albedo and specular term, on the surface points
behind the photo's pixels. Geometry is fixed, so that points and their visibility are found once."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from sira_mi.avatar.decoders import diffuse_albedo
from sira_mi.avatar.file import Avatar
from sira_mi.decisions import Decision
from sira_mi.fields.columns import evaluate_in_chunks, to_array
from sira_mi.fit.shaded import Arrays, PhotoPoints, Shading, base_albedo, decoder, shade_points
from sira_mi.fit.skin import find_skin_patches
from sira_mi.fit.stage import FitTask, Problem, Stage
from sira_mi.fit.state import FitState
from sira_mi.optimisation import losses

# Names of the decisions that these stages take.
SPECULAR, BASE_ALBEDO = "specular term", "base albedo at every step"


@dataclass(frozen=True)
class AppearanceWeights:
    """Weights of the losses of section 3.2.2 that all appearance stages have."""

    embedding: float = 1e-5  # on ‖z‖²
    white_light: float = 0.005  # mean squared log-chroma of the lobes: the prior on the light's colour
    skin_tone: float = 2e-2  # on the deviation of the skin's albedo from the expected tone, in standard deviations


@dataclass(frozen=True)
class AppearanceStage(Stage):
    """Light and albedos by eq. 8, without refinement."""

    weights: AppearanceWeights = field(default_factory=AppearanceWeights)

    def problem(self, task: FitTask, state: FitState) -> Problem:
        return AppearanceProblem(self, task, share_surface(task, state))

    def _without_specular(self) -> Decision:
        return Decision(SPECULAR, self.name, True, "k_s is 0 at every step")

    def _fixed_base(self) -> Decision:
        return Decision(BASE_ALBEDO, self.name, True, "its latent and network are fixed: once, with the skin's tone")


@dataclass(frozen=True)
class LightStage(AppearanceStage):
    """The light under which the prior's albedo looks like the photo."""

    def problem(self, task: FitTask, state: FitState) -> Problem:
        return LightProblem(self, task, share_surface(task, state))

    def decisions(self) -> tuple[Decision, ...]:
        return self._without_specular(), self._fixed_base()


@dataclass(frozen=True)
class AlbedoStage(AppearanceStage):
    """Light and diffuse albedo."""

    def decisions(self) -> tuple[Decision, ...]:
        return (self._without_specular(),)


@dataclass(frozen=True)
class SpecularStage(AppearanceStage):
    """Light and both albedos, while the specular term fades in."""

    k_s: tuple[float, float] = (0.0, 1.0)


class PhotoSurface:
    """The fitted surface behind the pixels of a photo, and what the photo says of it."""

    def __init__(self, task: FitTask, state: FitState):
        self.portrait = task.pose_portrait(state)
        path = str(task.write_avatar(state))
        head = mi.load_dict({"type": "neural_sdf", "avatar": path, "voxel": task.settings.voxel})
        self.points = task.photo_points(self.portrait, head)
        self.skin = find_skin_patches(self.portrait, self.points)
        row, column = self.points.row, self.points.column
        self.radiance = np.ascontiguousarray(self.portrait.image[row, column].T, dtype=np.float32)  # [3, N]


def share_surface(task: FitTask, state: FitState) -> PhotoSurface:
    """The surface of the appearance stages that follow each other."""
    return task.share(PhotoSurface, lambda: PhotoSurface(task, state))


class AppearanceProblem:
    """The losses of an appearance stage without refinement."""

    def __init__(self, stage: AppearanceStage, task: FitTask, surface: PhotoSurface):
        self.stage, self.surface, self.plan = stage, surface, task.plan
        self.avatar, self.pixels = task.prior, task.settings.pixels
        # The parameters that the fixed base albedo was evaluated at; the albedo [3, N] and the loss of the skin's tone.
        self._base_at: tuple[np.ndarray, ...] = ()
        self._base: tuple[np.ndarray, Any] | None = None

    def start(self, state: FitState) -> FitState:
        return state

    def refresh(self, state: FitState) -> None:
        """Makes arrays of all of the avatar's parameters, those that the stage holds fixed included."""
        self._fixed = state.floats()
        base_at = state.avatar["diffuse_albedo"], state.avatar["z_a"]
        if not self._base_at or not all(map(np.array_equal, self._base_at, base_at)):
            self._base_at, self._base = base_at, None

    def losses(self, parameters: Arrays, step: int, rng: np.random.Generator) -> Arrays:
        current = {**self._fixed, **parameters}
        index = self._draw(rng)
        points = self.surface.points[index]
        base, skin_tone = self._base_and_skin(current, index)
        shading = shade_points(self.avatar, current, self._k_s(step), points, base)
        target = to_array(self.surface.radiance[:, index])
        color = losses.photometric_loss(shading.diffuse + shading.specular, target)
        return {"color": color, **self._prior_losses(current, shading, skin_tone)}

    def _draw(self, rng: np.random.Generator) -> np.ndarray:
        """Indices of the points that a step looks at, ascending."""
        count = self.surface.radiance.shape[1]
        return np.sort(rng.choice(count, min(self.pixels, count), replace=False))

    def _k_s(self, step: int) -> float | None:
        """The weight of the specular term at a step; it reaches its last value in the middle of the stage. None to
        leave the term out."""
        if self.plan.leaves_out(SPECULAR, self.stage.name):
            return None
        (first, last), share = self.stage.k_s, step / max(self.stage.steps - 1, 1)
        return first + (last - first) * min(1.0, 2 * share)

    def _base_and_skin(self, current: Arrays, index: np.ndarray) -> tuple[Any, Any]:
        """Base albedo, tensor [3, n], at the points `index`, and the loss of the skin's tone (None without skin). A
        stage that holds both fixed evaluates both once."""
        if not self.plan.leaves_out(BASE_ALBEDO, self.stage.name):
            skin = self._skin_loss(current)
            return base_albedo(self.avatar, current, self.surface.points[index]), skin
        if self._base is None:
            a, points = self.avatar.architecture, self.surface.points
            network = decoder(self.avatar, "diffuse_albedo", self._fixed, "z_a")
            (base,) = evaluate_in_chunks(
                lambda x_ref, gamma: diffuse_albedo(network, a.albedo_octaves, x_ref, gamma), points.x_ref, points.gamma
            )
            self._base = base, self._skin_loss(self._fixed)
        base, skin = self._base
        return to_array(base[:, index]), skin

    def _skin_loss(self, current: Arrays) -> Any:
        return None if self.surface.skin is None else self.surface.skin.loss(self.avatar, current)

    def _prior_losses(self, current: Arrays, shading: Shading, skin_tone: Any) -> Arrays:
        """What is known of latent codes, light and skin without the photo."""
        weights, latents = self.stage.weights, ("z_a", "z_s", "z_l")
        terms = {
            "embedding": weights.embedding * losses.squared_norm(*(current[name] for name in latents)),
            "white_light": weights.white_light * losses.white_light_loss(shading.lobes[:, 4:7]),
        }
        if skin_tone is not None:
            terms["skin_tone"] = weights.skin_tone * skin_tone
        return terms

    def _base_radiance(self, points: PhotoPoints) -> tuple[np.ndarray, np.ndarray]:
        """Diffuse and specular radiance [3, n] of the base albedo at `points`, at the stage's first k_s."""
        with dr.suspend_grad():
            base = base_albedo(self.avatar, self._fixed, points)
            shading = shade_points(self.avatar, self._fixed, self.stage.k_s[0], points, base)
            return shading.diffuse.numpy(), shading.specular.numpy()


class LightProblem(AppearanceProblem):
    """The losses of the first appearance stage."""

    def start(self, state: FitState) -> FitState:
        """Scales the light to the photo's exposure, all channels alike: by the ratio of the photo's mean radiance to
        that rendered with the prior's albedo."""
        self.refresh(state)
        index = self._draw(np.random.default_rng(0))
        diffuse, _ = self._base_radiance(self.surface.points[index])
        factor = self.surface.radiance[:, index].mean() / max(float(diffuse.mean()), 1e-6)
        return state.with_parameters({"illumination": scale_light(self.avatar, state.avatar["illumination"], factor)})


def scale_light(avatar: Avatar, illumination: np.ndarray, factor: float | np.ndarray) -> np.ndarray:
    """Parameters of the illumination decoder whose lobes are about `factor` times as bright, one number or [3], by the
    bias of their log-amplitudes."""
    flat = illumination.copy()
    bias = flat[-7 * avatar.architecture.lobes :].reshape(-1, 7)
    bias[:, 4:7] += np.log(np.maximum(factor, 1e-6)).astype(np.float32)
    return flat
