"""SA-SM, the shape and appearance model: auto-decoder training with the losses of eq. 7 (section 3.1.2)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from sira_mi.avatar.architecture import AvatarArchitecture
from sira_mi.avatar.decoders import render_radiance
from sira_mi.avatar.shape import SHAPE_LATENTS, SHAPE_NETWORKS, HeadShape
from sira_mi.errors import InputError
from sira_mi.fields.columns import normalise, to_array
from sira_mi.fields.mlp import initial_parameters, layers
from sira_mi.fields.sdf import deform, sphere_parameters, surface
from sira_mi.optimisation import losses
from sira_mi.optimisation.adam import cosine_fall, take_step
from sira_mi.training.scenes import TrainingScene

NETWORKS = (*SHAPE_NETWORKS, "rendering")
LATENTS = (*SHAPE_LATENTS, "z_r")

# Share of the learning rates that is left at the end.
_LAST_RATE = 0.05
# Deviation of the random heads' points from the scenes' surfaces, scene units.
_JITTER = 0.1


@dataclass(frozen=True)
class ShapeTraining:
    """Settings of the SA-SM training; λ as in eq. 7."""

    steps: int = 10_000
    finishing: float = 0.25  # as many steps again, of `steps`, in which the gradient is brought to length 1
    finishing_rate: float = 0.25  # of the learning rates in these, which fall anew
    finishing_eikonal: float = 10.0  # both eikonal weights in these, times
    scenes: int = 32  # scenes a step
    surface_points: int = 96  # a scene and step
    volume_points: int = 32  # a scene and step
    random_points: int = 24  # of a random head, a step; as many random heads as scenes
    landmarks: int = 24  # a scene and step
    learning_rate: float = 2e-3  # of the networks; falls to a twentieth along a cosine
    latent_rate: float = 4e-3  # of the latents
    initial_radius: float = 1.4  # of the reference sphere, scene units
    surface: float = 2.0  # L_Surf (NPHM)
    normal: float = 0.3  # normals of the scans (IGR, NPHM)
    distance: float = 0.4  # signed distance of the volume points: clears other heads' hair from free space
    eikonal: float = 0.2  # λ1 (NPHM 0.1), at surface and volume points
    random_eikonal: float = 0.2  # the same of random heads: latents from the Gaussian of the scenes' latents
    deformation: float = 2e-3  # λ2 (i3DMM 1e-4, there on other units)
    landmark: float = 0.5  # λ3 (i3DMM 1.0)
    color: float = 0.25  # λ4 (i3DMM)
    embedding: float = 1e-4  # λ5 (i3DMM), on ‖z‖²


def initial_shape_model(architecture: AvatarArchitecture, settings: ShapeTraining, scenes: int, seed: int) -> dict:
    """Starting values of all networks and latents [dim, scenes]: the reference a sphere, the deformation almost
    zero."""
    rng = np.random.default_rng([seed, 0])
    networks = architecture.networks
    return {
        "deformation": initial_parameters(networks["deformation"], rng, output_scale=0.02),
        "reference": sphere_parameters(networks["reference"], rng, settings.initial_radius),
        "rendering": initial_parameters(networks["rendering"], rng, output_scale=0.3),
        **{
            name: (rng.standard_normal((architecture.latents[name], scenes)) * 0.1 / np.sqrt(10)).astype(np.float32)
            for name in LATENTS
        },
    }


@dataclass(frozen=True)
class ShapeBatch:
    """Points of some scenes, those of one scene consecutive; tensors."""

    scenes: mi.TensorXf  # [total scenes, S] one-hot columns that pick the scenes' latents
    count: int  # S
    points: mi.TensorXf  # [3, S·(n + q)]: of each scene first n surface points, then q volume points
    normals: mi.TensorXf  # [3, S·n] at the surface points
    views: mi.TensorXf  # [3, S·n]
    colors: mi.TensorXf  # [3, S·n]
    volume_distance: mi.TensorXf  # [1, S·q]
    landmarks: mi.TensorXf  # [3, S·l]
    mixture: mi.TensorXf  # [S, S]: its columns take the latents of the scenes to those of random heads
    random_points: mi.TensorXf  # [3, S·r]: of each random head r points about the heads of all scenes


def draw_batch(scenes: list[TrainingScene], settings: ShapeTraining, rng: np.random.Generator) -> ShapeBatch:
    """A random batch; landmarks that are unknown in any of the drawn scenes are left out of the draw."""
    chosen = np.sort(rng.choice(len(scenes), min(settings.scenes, len(scenes)), replace=False))
    parts: dict[str, list] = {k: [] for k in ("points", "normals", "views", "colors", "volume_distance", "landmarks")}
    known = np.all([np.isfinite(scenes[k].landmarks).all(axis=1) for k in chosen], axis=0)
    if not known.any():
        raise InputError("no landmark is known in all scenes of a batch; check the landmarks of the collection")
    landmarks = rng.choice(np.flatnonzero(known), settings.landmarks)
    for k in chosen:
        scene = scenes[k]
        samples = rng.integers(len(scene.sample_point), size=settings.surface_points)
        points = scene.sample_point[samples]
        volume = rng.integers(len(scene.volume), size=settings.volume_points)
        parts["points"] += [scene.points[points], scene.volume[volume]]
        parts["normals"].append(scene.normals[points])
        parts["views"].append(scene.views(samples))
        parts["colors"].append(scene.sample_color[samples])
        parts["volume_distance"].append(scene.volume_distance[volume][:, None])
        parts["landmarks"].append(scene.landmarks[landmarks])
    one_hot = np.zeros((len(scenes), len(chosen)), np.float32)
    one_hot[chosen, np.arange(len(chosen))] = 1
    on_surface = np.concatenate(parts["points"][::2])
    near = on_surface[rng.integers(len(on_surface), size=len(chosen) * settings.random_points)]
    parts["random_points"] = [near + _JITTER * rng.standard_normal(near.shape)]
    tensor = {k: to_array(np.concatenate(v).T) for k, v in parts.items()}
    mixture = mi.TensorXf(gaussian_mixture(len(chosen), rng))
    return ShapeBatch(mi.TensorXf(one_hot), len(chosen), mixture=mixture, **tensor)


def gaussian_mixture(count: int, rng: np.random.Generator) -> np.ndarray:
    """Weights [count, count] whose columns take vectors z_k to samples of their Gaussian: Z @ weights has their mean
    and, over many draws, their covariance (with 1 / count)."""
    noise = rng.standard_normal((count, count)) / np.sqrt(count)
    return (noise - noise.mean(axis=0) + 1 / count).astype(np.float32)


def _columns_of(tensor, scenes: int, first: int, last: int):
    """Columns `first` to `last` of each scene's share: tensor [rows, S·m] -> [rows, S·(last − first)]."""
    rows, total = tensor.shape
    width = total // scenes
    index = dr.arange(mi.UInt32, rows * scenes * (last - first))
    group, column = index // (last - first), index % (last - first)
    return mi.TensorXf(
        dr.gather(mi.Float, tensor.array, group * width + first + column), (rows, scenes * (last - first))
    )


def shape_losses(architecture: AvatarArchitecture, parameters: dict, batch: ShapeBatch) -> dict:
    """Every term of eq. 7 and the two on scan normals and distances, unweighted, by the names of `ShapeTraining`."""
    latents = {name: parameters[name] @ batch.scenes for name in LATENTS}
    networks = architecture.networks
    field = HeadShape(architecture).field({**parameters, **latents})
    mixed = {name: dr.detach(latents[name]) @ batch.mixture for name in SHAPE_LATENTS}
    random_heads = HeadShape(architecture).field({**parameters, **mixed})
    n = batch.normals.shape[1] // batch.count
    width = batch.points.shape[1] // batch.count
    everywhere = surface(field, batch.points)
    f, gradient, x_ref, gamma = (_columns_of(t, batch.count, 0, n) for t in everywhere)
    f_volume = _columns_of(everywhere[0], batch.count, n, width)
    points = _columns_of(batch.points, batch.count, 0, n)
    rendering = layers(networks["rendering"], parameters["rendering"], latents["z_r"])
    octaves = architecture.rendering_octaves
    radiance = render_radiance(rendering, octaves, x_ref, normalise(gradient), batch.views, gamma)
    return {
        "surface": losses.surface_loss(f),
        "normal": losses.normal_loss(gradient, batch.normals),
        "distance": losses.distance_loss(f_volume, batch.volume_distance),
        "eikonal": losses.eikonal_loss(everywhere[1]),
        "random_eikonal": losses.eikonal_loss(surface(random_heads, batch.random_points)[1]),
        "deformation": losses.deformation_loss(x_ref - points, batch.count),
        "landmark": losses.landmark_loss(deform(field, batch.landmarks)[0], batch.count),
        "color": losses.photometric_loss(radiance, batch.colors),
        "embedding": losses.embedding_loss(*latents.values()),
    }


def weighted_sum(terms: dict, settings: ShapeTraining):
    """Σ λ L over the terms."""
    return sum((getattr(settings, name) * value for name, value in terms.items()), mi.TensorXf([0.0]))


def all_steps(settings: ShapeTraining) -> int:
    """Number of steps, the finishing ones included."""
    return settings.steps + round(settings.finishing * settings.steps)


def rates(settings: ShapeTraining, step: int) -> dict[str, float]:
    """Learning rate of every parameter at `step`."""
    first, length, height = 0, settings.steps, 1.0
    if step >= settings.steps:
        first, length, height = settings.steps, all_steps(settings) - settings.steps, settings.finishing_rate
    fall = height * cosine_fall((step - first) / max(length, 1), _LAST_RATE)
    return {
        **dict.fromkeys(NETWORKS, settings.learning_rate * fall),
        **dict.fromkeys(LATENTS, settings.latent_rate * fall),
    }


def weights_at(settings: ShapeTraining, step: int) -> ShapeTraining:
    """The settings with the weights of `step`."""
    if step < settings.steps:
        return settings
    factor = settings.finishing_eikonal
    return replace(settings, eikonal=factor * settings.eikonal, random_eikonal=factor * settings.random_eikonal)


def training_step(architecture, settings: ShapeTraining, optimizer, batch: ShapeBatch) -> dict[str, float]:
    """One Adam step; returns the unweighted terms."""
    return take_step(
        optimizer,
        lambda parameters: shape_losses(architecture, parameters, batch),
        lambda terms: weighted_sum(terms, settings),
    )
