"""Relighting by a page of code, which a fit must beat: the photo divided by a smooth shading, times another light's.

The shading is nine spherical harmonics of the normal, as diffuse reflection of distant light nearly is (Ramamoorthi and
Hanrahan 2001), fitted robustly to the face as if all of its skin had one colour. What it does not explain
is taken for albedo. There are no shadows and no highlights, and only what the photo shows can be relit.
"""

import numpy as np

from sira_mi.sg.fit_environment import pixel_directions

MEAN_SKIN = np.exp([-0.695, -1.139, -1.453])  # linear albedo: the mean of the logarithms of measured skin
LARGEST_ALBEDO = 1.2
_DARKEST = 0.05  # least shading, times the median on the face
# The least squares: damping of each harmonic but the first, times the number of pixels; iterations; and the error, in
# medians, at which a pixel counts half (Cauchy's weights).
_DAMPING = 1e-3 * np.array([0, 1, 1, 1, 3, 3, 3, 3, 3.0])
_ITERATIONS, _HALF = 10, 2.0
_ROWS_OF_LIGHT = 32  # rows of blocks that an environment is summed up in
_CHUNK = 8192  # normals


def evaluate_harmonics(normals: np.ndarray) -> np.ndarray:
    """The real spherical harmonics [..., 9] of degree two and less at unit normals [..., 3], up to factors."""
    x, y, z = np.moveaxis(normals, -1, 0)
    return np.stack([np.ones_like(x), x, y, z, x * y, x * z, y * z, x * x - y * y, 3 * z * z - 1], axis=-1)


def fit_shading(photo: np.ndarray, normals: np.ndarray, colour: np.ndarray) -> np.ndarray:
    """Coefficients [9, 3] of the shading that explains pixels [N, 3] of a linear photo by their unit normals [N, 3] and
    one albedo [3]."""
    basis = evaluate_harmonics(normals)
    result = np.zeros((9, 3))
    for channel, goal in enumerate((photo / colour).T):
        weight = np.ones(len(goal))
        for _ in range(_ITERATIONS):
            weighted = basis * weight[:, None]
            matrix = weighted.T @ basis + len(goal) * np.diag(_DAMPING)
            result[:, channel] = np.linalg.solve(matrix, weighted.T @ goal)
            error = np.abs(basis @ result[:, channel] - goal)
            weight = 1 / (1 + (error / (_HALF * np.median(error) + 1e-6)) ** 2)
    return result


def divide_by_shading(
    photo: np.ndarray, normals: np.ndarray, inside: np.ndarray, face: np.ndarray, colour: np.ndarray = MEAN_SKIN
) -> np.ndarray:
    """The albedo [H, W, 3], 0 where not `inside` [H, W]: a linear photo [H, W, 3] over the shading of its unit normals
    [H, W, 3], if the pixels of the `face` [H, W] are mostly skin of the albedo `colour` [3]."""
    coefficients = fit_shading(photo[face], normals[face], colour)
    least = _DARKEST * np.median(evaluate_harmonics(normals[face]) @ coefficients, axis=0)
    shading = np.maximum(evaluate_harmonics(normals[inside]) @ coefficients, least)
    albedo = np.zeros(photo.shape)
    albedo[inside] = np.clip(photo[inside] / shading, 0, LARGEST_ALBEDO)
    return albedo


def integrate_irradiance(environment: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Irradiance over π [N, 3] at unit normals [N, 3] under an environment [H, W, 3]: times the albedo, it is the
    radiance of a diffuse surface without shadows."""
    directions, solid_angle = pixel_directions(*environment.shape[:2])
    step = max(1, round(len(environment) / _ROWS_OF_LIGHT))

    def sum_blocks(image: np.ndarray) -> np.ndarray:
        starts = (np.arange(0, side, step) for side in image.shape[:2])
        for axis, start in enumerate(starts):
            image = np.add.reduceat(image, start, axis=axis)
        return image.reshape(-1, 3)

    flux, way = (sum_blocks(image * solid_angle[:, None, None]) for image in (environment, directions))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    flux, way, normals = (array.astype(np.float32) for array in (flux, way, normals))
    chunks = [normals[start : start + _CHUNK] for start in range(0, len(normals), _CHUNK)]
    return np.concatenate([np.maximum(chunk @ way.T, 0) @ flux for chunk in chunks] or [np.zeros((0, 3))]) / np.pi


def shade(albedo: np.ndarray, normals: np.ndarray, inside: np.ndarray, environment: np.ndarray) -> np.ndarray:
    """Radiance [H, W, 3], 0 outside, of albedo [H, W, 3] or [3] on unit normals [H, W, 3] under an environment."""
    picture = np.zeros(normals.shape)
    picture[inside] = integrate_irradiance(environment, normals[inside])
    return picture * albedo
