"""AF-SM, the appearance factorization model: self-supervised auto-decoder training, eq. 10 (section 3.1.4).

It sees the images and the region of every point, never the true albedo. Points are mapped to reference space by the
frozen deformation of a trained SA-SM."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from sira_mi.avatar.architecture import AvatarArchitecture
from sira_mi.avatar.decoders import SKIN_SPECULAR, diffuse_albedo, illumination, specular_albedo
from sira_mi.avatar.shape import HeadShape
from sira_mi.avatar.skin_tone import SkinPrior
from sira_mi.conventions import LUMINANCE
from sira_mi.fields.columns import evaluate_in_chunks, to_array, unit_columns
from sira_mi.fields.mlp import initial_parameters, layers
from sira_mi.fields.sdf import deform, surface
from sira_mi.optimisation import losses
from sira_mi.optimisation.adam import cosine_fall, take_step
from sira_mi.portrait.landmarks import BARE_SKIN
from sira_mi.sg.radiance import Material, radiance_of_scenes
from sira_mi.training.scenes import TrainingScene

NETWORKS = ("diffuse_albedo", "specular_albedo", "illumination")
LATENTS = ("z_a", "z_s", "z_l")
# Share of the learning rates that is left at the end.
_LAST_RATE = 0.05
# Observations this near to a landmark of bare skin are taken as skin, scene units.
_SKIN_RADIUS = 0.06


@dataclass(frozen=True)
class AppearanceTraining:
    """Settings of the AF-SM training; λ as in eq. 10."""

    steps: int = 8000
    scenes: int = 24  # scenes a step; many scenes with few points each update the latents often
    points: int = 128  # a scene and step
    frozen_points: int = 6000  # of each scene's points, drawn once, at which the frozen deformation is evaluated
    learning_rate: float = 2e-3  # of the networks; falls to a twentieth along a cosine
    latent_rate: float = 4e-3  # of the latents
    roughness: float = 0.5  # of skin (FLARE: 0.5 ± 0.1), fixed
    jitter: float = 0.015  # ε of L_Reg, scene units (NeRFactor 0.01 on another scale)
    embedding: float = 1e-4  # λ6, on ‖z‖²
    smoothness: float = 0.01  # λ7 (NeRFactor 0.05)
    specular_anchor: float = 0.01  # pulls the log specular albedo to its region's level; images constrain it little
    # Reflectance at normal incidence of skin (FLARE), hair, eyes and cloth (those of the collection).
    specular_levels: tuple[float, ...] = (SKIN_SPECULAR, 0.024, 0.07, 0.008)
    white_light: float = 0.02  # pulls the light to grey, since images do not tell its colour from the albedo's
    skin_tone: float = 1e-3  # pulls skin albedo to measured skin, since images do not tell its level from the light's
    skin_radiance: float = 0.286  # luminance of average skin in a photo: the geometric mean of the collection's photos
    skin_deviations: tuple[float, float] = (0.6, 0.08)  # of log skin albedo along and across the axis of skin tone:
    # half a stop from the tone that the photo's brightness tells, and Yun et al. 2010

    @property
    def skin(self) -> SkinPrior:
        """What the prior will expect of skin."""
        return SkinPrior(self.skin_radiance, self.skin_deviations)


@dataclass(frozen=True)
class FrozenScene:
    """What the AF-SM sees of a scene: the frozen deformation's outputs at its points, and its observations."""

    x_ref: np.ndarray  # [3, P]
    gamma: np.ndarray  # [N_γ, P]
    normals: np.ndarray  # [3, P] unit, of the field
    specular_level: np.ndarray  # [1, P] of the points' regions
    jittered_x_ref: np.ndarray  # [3, P] at x + ε
    jittered_gamma: np.ndarray  # [N_γ, P]
    skin_x_ref: np.ndarray  # [3, L] at `BARE_SKIN`
    skin_gamma: np.ndarray  # [N_γ, L]
    skin_weight: np.ndarray  # [1, L] shares of the known landmarks; all 0 where none is known
    skin_radiance: float  # luminance of the skin in the photos, geometric mean; NaN where none is seen
    sample_point: np.ndarray  # [C] index of the point of observation c
    sample_view: np.ndarray  # [3, C] unit direction from the camera to the point
    sample_color: np.ndarray  # [3, C] linear radiance


def freeze_scene(
    architecture: AvatarArchitecture,
    shape: Mapping[str, np.ndarray],
    scene: TrainingScene,
    settings: AppearanceTraining,
    rng: np.random.Generator,
) -> FrozenScene:
    """Evaluates the head of a trained SA-SM with the parameters `shape` (`HeadShape`) at points of a scene."""
    field = HeadShape(architecture).field(shape)
    count = len(scene.points)
    chosen = np.sort(rng.choice(count, min(settings.frozen_points, count), replace=False))
    x = scene.points[chosen].T
    moved = x + settings.jitter * rng.standard_normal(x.shape).astype(np.float32)
    _, gradient, x_ref, gamma = evaluate_in_chunks(lambda p: surface(field, p), x)
    jittered_x_ref, jittered_gamma = evaluate_in_chunks(lambda p: deform(field, p), moved)
    landmarks = scene.landmarks[list(BARE_SKIN)]
    known = np.isfinite(landmarks).all(axis=1)
    skin_x_ref, skin_gamma = evaluate_in_chunks(lambda p: deform(field, p), np.where(known[:, None], landmarks, 0).T)
    place = np.full(count, -1)
    place[chosen] = np.arange(len(chosen))
    samples = np.flatnonzero(place[scene.sample_point] >= 0)
    return FrozenScene(
        x_ref,
        gamma,
        unit_columns(gradient),
        np.array(settings.specular_levels, np.float32)[None, scene.region[chosen]],
        jittered_x_ref,
        jittered_gamma,
        skin_x_ref,
        skin_gamma,
        known[None, :].astype(np.float32) / max(known.sum(), 1),
        skin_radiance(scene, landmarks[known]),
        place[scene.sample_point[samples]],
        scene.views(samples).T,
        scene.sample_color[samples].T,
    )


def initial_appearance_model(architecture: AvatarArchitecture, scenes: int, seed: int) -> dict:
    """Starting values of the three decoders and the latents [dim, scenes]."""
    rng = np.random.default_rng([seed, 1])
    networks = architecture.networks
    return {
        **{name: initial_parameters(networks[name], rng, output_scale=0.1) for name in NETWORKS},
        **{
            name: (rng.standard_normal((architecture.latents[name], scenes)) * 0.1).astype(np.float32)
            for name in LATENTS
        },
    }


@dataclass(frozen=True)
class AppearanceBatch:
    """Observations of some scenes, those of one scene consecutive; tensors."""

    scenes: mi.TensorXf  # [total scenes, S] one-hot columns
    count: int  # S
    x_ref: mi.TensorXf  # [3, S·n]
    gamma: mi.TensorXf
    normals: mi.TensorXf
    specular_level: mi.TensorXf  # [1, S·n]
    jittered_x_ref: mi.TensorXf
    jittered_gamma: mi.TensorXf
    skin_x_ref: mi.TensorXf  # [3, S·L]
    skin_gamma: mi.TensorXf
    skin_weight: mi.TensorXf  # [1, S·L]
    skin_radiance: np.ndarray  # [S]
    views: mi.TensorXf  # [3, S·n] from the camera to the point
    colors: mi.TensorXf  # [3, S·n]


def draw_batch(scenes: list[FrozenScene], settings: AppearanceTraining, rng: np.random.Generator) -> AppearanceBatch:
    """A random batch of observations."""
    chosen = np.sort(rng.choice(len(scenes), min(settings.scenes, len(scenes)), replace=False))
    names = ("x_ref", "gamma", "normals", "specular_level", "jittered_x_ref", "jittered_gamma")
    skin = ("skin_x_ref", "skin_gamma", "skin_weight")
    parts: dict[str, list] = {name: [] for name in (*names, *skin, "views", "colors")}
    for k in chosen:
        frozen = scenes[k]
        samples = rng.integers(len(frozen.sample_point), size=settings.points)
        points = frozen.sample_point[samples]
        for name in names:
            parts[name].append(getattr(frozen, name)[:, points])
        for name in skin:
            parts[name].append(getattr(frozen, name))
        parts["views"].append(frozen.sample_view[:, samples])
        parts["colors"].append(frozen.sample_color[:, samples])
    one_hot = np.zeros((len(scenes), len(chosen)), np.float32)
    one_hot[chosen, np.arange(len(chosen))] = 1
    tensor = {k: to_array(np.concatenate(v, axis=1)) for k, v in parts.items()}
    level = np.array([scenes[k].skin_radiance for k in chosen])
    return AppearanceBatch(mi.TensorXf(one_hot), len(chosen), skin_radiance=level, **tensor)


def appearance_losses(architecture, settings: AppearanceTraining, parameters: dict, batch: AppearanceBatch) -> dict:
    """Every term of eq. 10 and the anchors, unweighted, by the names of `AppearanceTraining`."""
    z_a, z_s, z_l = (parameters[name] @ batch.scenes for name in LATENTS)
    networks = architecture.networks
    diffuse = layers(networks["diffuse_albedo"], parameters["diffuse_albedo"], z_a)
    speculars = layers(networks["specular_albedo"], parameters["specular_albedo"], z_s)
    albedo = diffuse_albedo(diffuse, architecture.albedo_octaves, batch.x_ref, batch.gamma)
    moved = diffuse_albedo(diffuse, architecture.albedo_octaves, batch.jittered_x_ref, batch.jittered_gamma)
    specular = specular_albedo(speculars, architecture.specular_octaves, batch.x_ref)
    lobes = illumination(layers(networks["illumination"], parameters["illumination"]), z_l)

    material = Material(albedo, specular, settings.roughness, 1.0)
    diffuse_part, specular_part = radiance_of_scenes(batch.normals, batch.views, material, lobes, batch.count)
    skin = diffuse_albedo(diffuse, architecture.albedo_octaves, batch.skin_x_ref, batch.skin_gamma)
    anchor = dr.log(specular / batch.specular_level)
    return {
        "color": losses.photometric_loss(diffuse_part + specular_part, batch.colors),
        "embedding": losses.embedding_loss(z_a, z_s, z_l),
        "smoothness": losses.smoothness_loss(albedo, moved),
        "specular_anchor": losses.mean(anchor * anchor),
        "white_light": losses.white_light_loss(lobes[:, 4:7, :]),
        "skin_tone": settings.skin.loss(skin, batch.skin_weight, settings.skin.tone_in_photo(batch.skin_radiance)),
    }


def weighted_sum(terms: dict, settings: AppearanceTraining):
    """L_Col + Σ λ L."""
    return sum((getattr(settings, k) * v for k, v in terms.items() if k != "color"), terms["color"])


def rates(settings: AppearanceTraining, step: int) -> dict[str, float]:
    """Learning rate of every parameter at `step`."""
    fall = cosine_fall(step / settings.steps, _LAST_RATE)
    return {
        **dict.fromkeys(NETWORKS, settings.learning_rate * fall),
        **dict.fromkeys(LATENTS, settings.latent_rate * fall),
    }


def training_step(architecture, settings: AppearanceTraining, optimizer, batch: AppearanceBatch) -> dict[str, float]:
    """One Adam step; returns the unweighted terms."""
    return take_step(
        optimizer,
        lambda parameters: appearance_losses(architecture, settings, parameters, batch),
        lambda terms: weighted_sum(terms, settings),
    )


def skin_radiance(scene: TrainingScene, landmarks: np.ndarray) -> float:
    """Geometric mean of the luminance of the observations near `landmarks` [L, 3]; NaN when there are none."""
    from scipy.spatial import cKDTree

    if not len(landmarks):
        return float("nan")
    near = cKDTree(landmarks).query(scene.points, distance_upper_bound=_SKIN_RADIUS)[0] < _SKIN_RADIUS
    luminance = scene.sample_color[near[scene.sample_point]] @ np.array(LUMINANCE)
    return float(np.exp(np.mean(np.log(np.maximum(luminance, 1e-3))))) if len(luminance) else float("nan")
