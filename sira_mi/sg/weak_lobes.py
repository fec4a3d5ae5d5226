"""Lobes that are too weak to be seen: an upper bound on what each adds to the radiance that a surface reflects.

A lobe's irradiance is largest on a surface that faces it, μ ∫ exp(λ(c − 1)) c dω over the hemisphere, and its specular
radiance is at most both μ times the largest reflectance under light from everywhere and ∫ G dω times the largest
f^s (n·ω)₊ = 1/(4πr⁴k), k = (r + 1)²/8, of `sg.brdf` with F <= 1. NumPy, float64.
"""

import numpy as np

from sira_mi.sg.lobes import lobe_integral


def facing_irradiance(sharpness: np.ndarray) -> np.ndarray:
    """∫ exp(λ(ω·n − 1)) (ω·n)₊ dω [N_l], steradians: the irradiance of a unit lobe on a surface that faces it."""
    value = np.asarray(sharpness, np.float64)
    safe = np.maximum(value, 1e-3)
    exact = (safe - 1 + np.exp(-safe)) / safe**2
    return 2 * np.pi * np.where(value < 1e-3, 0.5 - value / 6, exact)


def radiance_bounds(
    lobes: np.ndarray, roughness: float, k_s: float, diffuse_albedo: float = 1.0, reflectance: float = 1.0
) -> np.ndarray:
    """Most radiance [N_l] that a surface reflects of each of `lobes` [N_l, 7], in its strongest channel.
    `diffuse_albedo` is the largest of the surface, `reflectance` the largest share of a light from everywhere that its
    specular term sends anywhere."""
    sharpness, amplitude = lobes[:, 3].astype(np.float64), lobes[:, 4:].max(axis=1).astype(np.float64)
    energy = lobe_integral(np.maximum(sharpness, 1e-12))
    peak = 2 / (np.pi * roughness**4 * (roughness + 1) ** 2)
    specular = np.minimum(reflectance, peak * energy)
    return amplitude * (diffuse_albedo / np.pi * facing_irradiance(sharpness) + k_s * specular)


def white_radiance(lobes: np.ndarray) -> float:
    """Radiance of a white diffuse surface in the strongest channel where it faces the light best, or a little less:
    over normals along the lobes' axes, and with E₀ cos θ, never more than the irradiance, of a lobe at an angle θ."""
    axis = lobes[:, :3] / np.linalg.norm(lobes[:, :3], axis=1, keepdims=True)
    facing = np.maximum(axis @ axis.T, 0.0)
    return float((facing @ (facing_irradiance(lobes[:, 3])[:, None] * lobes[:, 4:])).max() / np.pi)


def select_lobes(bounds: np.ndarray, limit: float) -> np.ndarray:
    """Indices, in order, of the lobes that are left when the weakest go whose `bounds` [N_l] add up to at most `limit`;
    the strongest always stays."""
    order = np.argsort(bounds, kind="stable")
    weak = order[:-1][np.cumsum(bounds[order])[:-1] <= limit]
    return np.setdiff1d(np.arange(len(bounds)), weak)
