"""Lobes that are too weak to be seen: an upper bound on the radiance that a surface reflects of each.

A lobe's irradiance is largest on a surface that faces it: μ ∫ exp(λ(c − 1)) c dω over the hemisphere. Its specular
radiance is at most μ times the largest reflectance under light from everywhere, and at most ∫ G dω times the largest
f^s (n·ω)₊, which is 1/(4πr⁴k), k = (r + 1)²/8, for the BRDF of `sg.brdf` with F <= 1. NumPy, float64.
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
    """Upper bounds [N_l] of the radiance that a surface reflects of each of `lobes` [N_l, 7], in its strongest channel.
    `diffuse_albedo` is the surface's largest; `reflectance` is the largest share of uniform light that its specular
    term reflects into one direction."""
    sharpness, amplitude = lobes[:, 3].astype(np.float64), lobes[:, 4:].max(axis=1).astype(np.float64)
    energy = lobe_integral(np.maximum(sharpness, 1e-12))
    peak = 2 / (np.pi * roughness**4 * (roughness + 1) ** 2)
    specular = np.minimum(reflectance, peak * energy)
    return amplitude * (diffuse_albedo / np.pi * facing_irradiance(sharpness) + k_s * specular)


def white_radiance(lobes: np.ndarray) -> float:
    """Radiance of a white diffuse surface that faces the light best, in the strongest channel; a lower bound. Only
    normals along the lobes' axes are tried, and a lobe at an angle θ is counted with E₀ cos θ, which is never more than
    its irradiance."""
    axis = lobes[:, :3] / np.linalg.norm(lobes[:, :3], axis=1, keepdims=True)
    facing = np.maximum(axis @ axis.T, 0.0)
    return float((facing @ (facing_irradiance(lobes[:, 3])[:, None] * lobes[:, 4:])).max() / np.pi)


def select_lobes(bounds: np.ndarray, limit: float) -> np.ndarray:
    """Sorted indices of the lobes to keep: the weakest are dropped while their `bounds` [N_l] add up to at most
    `limit`. The strongest is always kept."""
    order = np.argsort(bounds, kind="stable")
    weak = order[:-1][np.cumsum(bounds[order])[:-1] <= limit]
    return np.setdiff1d(np.arange(len(bounds)), weak)
