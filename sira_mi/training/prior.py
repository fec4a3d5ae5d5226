"""The prior: a trained SA-SM and AF-SM as one avatar with mean latents, its mean head."""

import mitsuba as mi
import numpy as np

from sira_mi.avatar.architecture import AvatarArchitecture
from sira_mi.avatar.decoders import illumination
from sira_mi.avatar.file import Avatar
from sira_mi.fields.mlp import initial_parameters, layers
from sira_mi.training import af_sm, sa_sm


def whitening(latents: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean [dim] of latents [dim, scenes] and a matrix [dim, dim] that takes a standard normal vector to their
    covariance: its columns are the principal directions, the widest first, as long as their standard deviations."""
    mean = latents.mean(axis=1)
    directions, deviations, _ = np.linalg.svd(latents - mean[:, None], full_matrices=True)
    padded = np.zeros(len(latents))
    padded[: len(deviations)] = deviations / np.sqrt(max(latents.shape[1] - 1, 1))
    return mean, directions * padded


def whiten(architecture, name: str, network: np.ndarray, mean: np.ndarray, spread: np.ndarray) -> np.ndarray:
    """Parameters of the network with a standard normal latent code w in place of z = mean + spread w. In every layer
    that z shifts by Z z, Z mean is added to the bias and Z spread replaces Z. The illumination decoder has z as its
    input; there the same is done with the weights of the first layer."""
    flat, offset = network.copy(), 0
    for k, (weight, bias, latent) in enumerate(architecture.networks[name].shapes()):
        start_bias = offset + weight[0] * weight[1]
        start_latent = start_bias + bias[0]
        end = start_latent + latent[0] * latent[1]
        if latent[1]:
            mixed, shape = slice(start_latent, end), latent
        elif k == 0 and name == "illumination":
            mixed, shape = slice(offset, start_bias), weight
        else:
            mixed = None
        if mixed is not None:
            matrix = flat[mixed].reshape(shape)
            flat[start_bias:start_latent] += matrix @ mean
            flat[mixed] = (matrix @ spread).ravel()
        offset = end
    return flat


def assemble_prior(
    architecture: AvatarArchitecture,
    shape: dict[str, np.ndarray],
    appearance: dict[str, np.ndarray],
    landmarks: np.ndarray,
    settings: af_sm.AppearanceTraining,
    seed: int,
) -> Avatar:
    """The mean head of both trained models. All latent codes become standard normal: 0 is the mean of the trained ones
    [dim, scenes]. The light is the mean light. The refinement starts at zero and is switched off. `landmarks`
    [scenes, 468, 3] are averaged over the scenes that have them.
    Roughness and the prior on skin are those of the appearance's `settings`."""
    owners = {
        "z_sdf": "deformation",
        "z_r": "rendering",
        "z_a": "diffuse_albedo",
        "z_s": "specular_albedo",
        "z_l": "illumination",
    }
    tensors = {name: shape[name] for name in sa_sm.NETWORKS} | {name: appearance[name] for name in af_sm.NETWORKS}
    latents = {**shape, **appearance}
    for name, network in owners.items():
        tensors[network] = whiten(architecture, network, tensors[network], *whitening(latents[name]))
    for name, size in architecture.latents.items():
        tensors[name] = np.zeros(size, np.float32)
    rng = np.random.default_rng([seed, 4])
    refinement = architecture.networks["albedo_refinement"]
    tensors["albedo_refinement"] = initial_parameters(refinement, rng, output_scale=0.0)
    light = layers(architecture.networks["illumination"], tensors["illumination"])
    tensors["lobes"] = illumination(light, mi.TensorXf(tensors["z_l"][:, None])).numpy()[:, :, 0]
    with np.errstate(invalid="ignore"):
        counts = np.isfinite(landmarks[:, :, :1]).sum(axis=0)
        mean = np.nansum(landmarks, axis=0) / np.maximum(counts, 1)
    tensors["landmarks"] = np.where(counts > 0, mean, np.nan).astype(np.float32)
    tensors = {name: value.astype(np.float32) for name, value in tensors.items()}
    return Avatar(architecture, tensors, roughness=settings.roughness, k_r=0.0, skin=settings.skin)
