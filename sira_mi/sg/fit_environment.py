"""Fits spherical-Gaussian lobes to a latitude-longitude environment and keeps its total light.

Compact sources that are far brighter than the rest ("suns") are removed first, each as one lobe with its flux and its
mean direction at full resolution. The rest is reduced to at most 32 rows. Spherical k-means of the radiance gives
initial axes and sharpnesses, non-negative least squares the amplitudes. Adam then refines all of them on the squared
error, weighted by solid angle over the root of the radiance: a compromise between absolute error, which matters for
irradiance, and relative error, which matters for reflections. Finally the amplitudes are solved again, and each channel
is scaled to its flux.
"""

from dataclasses import dataclass

import numpy as np

from sira_mi.conventions import LUMINANCE
from sira_mi.fields.directions import fibonacci_directions
from sira_mi.sg.lobes import evaluate_lobes, lobe_integral


@dataclass(frozen=True)
class EnvironmentFit:
    """Settings of `fit_environment`."""

    lobes: int = 64  # lobes
    rows: int = 32  # rows of the reduced image
    iterations: int = 400  # Adam steps
    rate: float = 0.02  # Adam step, in radians, log sharpness and relative amplitude
    sun_contrast: float = 30.0  # peak over mean luminance from which a source is a sun
    sun_flux: float = 0.005  # least share of the total light that makes a source a sun
    sun_radius: float = 0.15  # radius within which a sun's light is collected, radians
    weight_floor: float = 1.0  # radiance added under the root of the error's weight, in mean luminances
    minimum_sharpness: float = 0.2  # dimensionless
    maximum_sharpness: float = 5e4  # dimensionless


def pixel_directions(height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Unit directions `[H, W, 3]` of the pixels of an image of two rows or more, and their exact solid angles `[H]` in
    steradians, as Mitsuba's `envmap` has them: the first and the last row lie at the poles, columns half a pixel off
    the seam, and radiance is interpolated bilinearly between."""
    phi = 2.0 * np.pi * (np.arange(width) + 0.5) / width
    theta = np.linspace(0.0, np.pi, height)
    sine = np.sin(theta)[:, None]
    cosine = np.broadcast_to(np.cos(theta)[:, None], (height, width))
    directions = np.stack([np.sin(phi) * sine, cosine, -np.cos(phi) * sine], axis=-1)
    # ∫ sin θ times the hat function of a row; at the poles it is half a hat.
    step = np.pi / (height - 1)
    share = np.sin(theta) * 2.0 * (1.0 - np.cos(step)) / step
    share[[0, -1]] = 1.0 - np.sin(step) / step
    return directions, share * 2.0 * np.pi / width


def total_light(image: np.ndarray) -> np.ndarray:
    """∫ l dω of each channel `[3]` of an environment `[H, W, 3]`."""
    _, solid_angle = pixel_directions(*image.shape[:2])
    return np.einsum("hwc,h->c", image.astype(np.float64), solid_angle)


def render_environment(lobes: np.ndarray, height: int) -> np.ndarray:
    """Radiance `[height, 2 height, 3]` (float32) of lobes `[N_l, 7]`.

    Lobes narrower than a pixel are widened to it at equal energy, so that the image keeps their light."""
    lobes = np.asarray(lobes, np.float64).copy()
    pixel = np.pi / height
    sharpness = 1.0 / (1.0 / lobes[:, 3] + np.where(lobes[:, 3] * pixel**2 > 0.1, (0.5 * pixel) ** 2, 0.0))
    lobes[:, 4:] *= (lobe_integral(lobes[:, 3]) / lobe_integral(sharpness))[:, None]
    lobes[:, 3] = sharpness
    directions, _ = pixel_directions(height, 2 * height)
    return np.stack([evaluate_lobes(lobes, row) for row in directions]).astype(np.float32)


def _sharpness_of_length(length):
    """Sharpness of the von Mises-Fisher density with a mean direction of that length (Banerjee et al. 2005)."""
    length = np.clip(length, 1e-3, 1.0 - 1e-7)
    return length * (3.0 - length**2) / (1.0 - length**2)


def _take_suns(image, settings):
    """Lobes of the compact bright sources, and the image without them."""
    image = image.astype(np.float64)
    directions, solid_angle = pixel_directions(*image.shape[:2])
    weight = np.broadcast_to(solid_angle[:, None], image.shape[:2])
    suns: list[list[float]] = []
    total = (image @ LUMINANCE * weight).sum()
    mean = total / (4.0 * np.pi)
    while len(suns) < settings.lobes // 4:
        luminance = image @ LUMINANCE
        peak = np.unravel_index(np.argmax(luminance), luminance.shape)
        if not luminance[peak] > settings.sun_contrast * mean:
            break
        near = directions @ directions[peak] > np.cos(settings.sun_radius)
        background = np.median(image[near], axis=0)
        inside = near & (luminance > 0.02 * luminance[peak] + background @ LUMINANCE)
        excess = np.maximum(image[inside] - background, 0.0) * weight[inside][:, None]
        flux, share = excess.sum(axis=0), excess @ LUMINANCE
        if share.sum() < settings.sun_flux * total:
            break
        mean_direction = share @ directions[inside] / share.sum()
        length = np.linalg.norm(mean_direction)
        sharpness = np.clip(_sharpness_of_length(length), 1.0, settings.maximum_sharpness)
        suns.append([*(mean_direction / length), sharpness, *(flux / lobe_integral(sharpness))])
        image[inside] = np.minimum(image[inside], background)
    return np.array(suns).reshape(-1, 7), image


def _reduce(image, rows):
    """Box reduction to at most `rows` rows: directions `[P, 3]`, solid angles `[P]`, radiance `[P, 3]`."""
    height, width = image.shape[:2]
    directions, solid_angle = pixel_directions(height, width)
    step = -(-height // rows)
    row, column = np.arange(height) // step, np.arange(width) // step
    label = (row[:, None] * (column[-1] + 1) + column[None]).ravel()
    weight = np.repeat(solid_angle, width)

    def gather(values):
        return np.bincount(label, values.ravel() * weight)

    total = np.bincount(label, weight)
    mean = np.stack([gather(directions[..., k]) for k in range(3)], axis=1)
    radiance = np.stack([gather(image[..., k]) for k in range(3)], axis=1) / total[:, None]
    return mean / np.linalg.norm(mean, axis=1, keepdims=True), total, radiance


def _cluster(directions, weight, count):
    """Spherical k-means from a Fibonacci lattice: axes `[count, 3]` and sharpnesses `[count]` of the clusters."""
    axes = fibonacci_directions(count)
    for _ in range(12):
        nearest = np.argmax(directions @ axes.T, axis=1)
        mass = np.bincount(nearest, weight, count)
        sums = np.stack([np.bincount(nearest, weight * directions[:, k], count) for k in range(3)], axis=1)
        length = np.linalg.norm(sums, axis=1)
        filled = length > 0.0
        axes[filled] = sums[filled] / length[filled, None]
    spread = np.where(filled, length / np.maximum(mass, 1e-300), 0.5)
    # Neighbours have to overlap: lobes wider than their clusters.
    return axes, 0.6 * _sharpness_of_length(spread)


def _solve_amplitudes(axes, sharpness, directions, weight, radiance, flux):
    """Non-negative amplitudes `[N, 3]` of least weighted error whose light is nearly `flux` `[3]`."""
    from scipy.optimize import nnls

    basis = np.exp(sharpness * (np.clip(directions @ axes.T, -1.0, 1.0) - 1.0))
    energy = lobe_integral(sharpness)
    root = np.sqrt(weight)[:, None]
    scale = np.sqrt(weight.sum() / len(weight)) * len(weight)
    matrix = np.concatenate([basis * root, scale * energy[None] / (4.0 * np.pi)])
    target = np.concatenate([radiance * root, scale * flux[None] / (4.0 * np.pi)])
    return np.stack([nnls(matrix, target[:, k], maxiter=50 * len(axes))[0] for k in range(3)], axis=1)


def _refine(axes, sharpness, amplitude, directions, weight, radiance, settings):
    """Adam on axes, log sharpness and amplitude; the step length falls to zero along a cosine."""
    scale = np.maximum(amplitude.max(axis=0), 1e-12)
    value = [axes.copy(), np.log(sharpness), amplitude / scale]
    first, second = [np.zeros_like(x) for x in value], [np.zeros_like(x) for x in value]
    for step in range(settings.iterations):
        axes, sharpness, amplitude = value[0], np.exp(value[1]), value[2] * scale
        cosine = directions @ axes.T - 1.0
        basis = np.exp(sharpness * cosine)
        residual = (basis @ amplitude - radiance) * weight[:, None]
        inner = basis * (residual @ amplitude.T)
        along = (inner * sharpness).T @ directions
        along -= (along * axes).sum(axis=1, keepdims=True) * axes
        gradient = [along, (inner * cosine).sum(axis=0) * sharpness, (basis.T @ residual) * scale]
        rate = settings.rate * 0.5 * (1.0 + np.cos(np.pi * step / settings.iterations))
        for k, g in enumerate(gradient):
            first[k] = 0.9 * first[k] + 0.1 * g
            second[k] = 0.99 * second[k] + 0.01 * g * g
            estimate = first[k] / (1.0 - 0.9 ** (step + 1))
            spread = np.sqrt(second[k] / (1.0 - 0.99 ** (step + 1)))
            value[k] = value[k] - rate * estimate / (spread + 1e-12 * np.abs(spread).max() + 1e-300)
        value[0] /= np.linalg.norm(value[0], axis=1, keepdims=True)
        value[1] = np.clip(value[1], np.log(settings.minimum_sharpness), np.log(settings.maximum_sharpness))
        value[2] = np.maximum(value[2], 0.0)
    return value[0], np.exp(value[1])


def fit_environment(image: np.ndarray, settings: EnvironmentFit | None = None) -> np.ndarray:
    """Lobes `[N_l, 7]` (float32) of a finite environment image `[H, W, 3]` of linear radiance."""
    settings = settings or EnvironmentFit()
    flux = total_light(image)
    suns, rest = _take_suns(image, settings)
    count = settings.lobes - len(suns)
    directions, solid_angle, radiance = _reduce(rest, settings.rows)
    luminance = radiance @ LUMINANCE
    mean = solid_angle @ luminance / (4.0 * np.pi)
    if not mean > 0.0:
        axes, sharpness = fibonacci_directions(count), np.full(count, 0.5 * count + 1.0)
        amplitude = np.zeros((count, 3))
    else:
        axes, sharpness = _cluster(directions, solid_angle * (luminance + 0.1 * mean), count)
        sharpness = np.clip(sharpness, settings.minimum_sharpness, settings.maximum_sharpness)
        weight = solid_angle / np.sqrt(luminance + settings.weight_floor * mean)
        rest_flux = solid_angle @ radiance
        problem = directions, weight, radiance
        amplitude = _solve_amplitudes(axes, sharpness, *problem, rest_flux)
        axes, sharpness = _refine(axes, sharpness, amplitude, *problem, settings)
        amplitude = _solve_amplitudes(axes, sharpness, *problem, rest_flux)
    lobes = np.concatenate([np.concatenate([axes, sharpness[:, None], amplitude], axis=1), suns])
    light = lobe_integral(lobes[:, 3]) @ lobes[:, 4:]
    lobes[:, 4:] *= np.where(light > 0.0, flux / np.maximum(light, 1e-300), 1.0)
    return lobes.astype(np.float32)
