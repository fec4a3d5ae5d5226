"""Random lobes, directions and shading points that dwell on the ends of their ranges; NumPy, exact in float32.

Every function takes a NumPy generator; axes, normals and directions are `[3, n]`, of unit length up to rounding."""

import numpy as np

from studies.stability.double import single

SHARPNESS = (1e-6, 1e7)
ROUGHNESS = (0.02, 1.0)
# Directions are drawn within this many widths 1/√λ of an axis; at 5.3 a lobe is at 1e-6 of its peak.
_WIDTHS = 6.5


def normalise(vectors: np.ndarray) -> np.ndarray:
    """Columns scaled to unit length."""
    return vectors / np.linalg.norm(vectors, axis=0)


def draw_directions(rng: np.random.Generator, count: int) -> np.ndarray:
    """Uniform on the sphere."""
    return single(normalise(rng.standard_normal((3, count))))


def draw_perpendicular(rng: np.random.Generator, axis: np.ndarray) -> np.ndarray:
    """Unit vectors at right angles to `axis`."""
    return normalise(np.cross(axis.T, rng.standard_normal(axis.T.shape)).T)


def tilt(rng: np.random.Generator, axis: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Unit vectors at `angle` (radians) to `axis`, in random azimuths."""
    return single(np.cos(angle) * normalise(axis) + np.sin(angle) * draw_perpendicular(rng, axis))


def draw_near(rng: np.random.Generator, axis: np.ndarray, sharpness: np.ndarray) -> np.ndarray:
    """Directions in the reach of lobes."""
    angle = rng.uniform(0.0, _WIDTHS, axis.shape[1]) / np.sqrt(np.maximum(sharpness, 1.0))
    return tilt(rng, axis, np.minimum(angle, np.pi * rng.random(axis.shape[1]) ** 0.5))


def draw_sharpnesses(rng: np.random.Generator, count: int, highest: float = SHARPNESS[1]) -> np.ndarray:
    """Even in the logarithm from 1e-6 to `highest`; a tenth each is 0, the lowest and the highest."""
    values = np.exp(rng.uniform(np.log(SHARPNESS[0]), np.log(highest), count))
    kind = rng.integers(0, 10, count)
    for index, value in enumerate((0.0, SHARPNESS[0], highest)):
        values[kind == index] = value
    return single(values)


def draw_amplitudes(rng: np.random.Generator, count: int) -> np.ndarray:
    """RGB `[3, count]`: even in the logarithm from 1e-3 to 1e6; a tenth each is 0 and 1e6."""
    values = 10.0 ** rng.uniform(-3.0, 6.0, (3, count))
    kind = rng.integers(0, 10, count)
    values[:, kind == 0] = 0.0
    values[:, kind == 1] = 1e6
    return single(values)


def draw_second_axes(rng: np.random.Generator, axis: np.ndarray, sharpness: np.ndarray) -> np.ndarray:
    """Axes of second lobes: parallel, opposite, orthogonal, nearly opposite (a tenth each), random (two tenths), and
    within the reach of lobes of `sharpness`."""
    count = axis.shape[1]
    kind = rng.integers(0, 10, count)
    result = draw_near(rng, axis, sharpness)
    orthogonal, anywhere = single(draw_perpendicular(rng, axis)), draw_directions(rng, count)
    opposite = tilt(rng, -axis, np.exp(rng.uniform(np.log(1e-6), np.log(1e-1), count)))
    for index, value in enumerate((axis, -axis, orthogonal, opposite, anywhere, anywhere)):
        result[:, kind == index] = value[:, kind == index]
    return result


def draw_roughnesses(rng: np.random.Generator, count: int) -> np.ndarray:
    """Even in the logarithm from 0.02 to 1, both ends included."""
    values = np.exp(rng.uniform(np.log(ROUGHNESS[0]), np.log(ROUGHNESS[1]), count))
    values[: count // 10] = ROUGHNESS[0]
    values[count // 10 : count // 5] = ROUGHNESS[1]
    return single(rng.permutation(values))


def draw_views(rng: np.random.Generator, normal: np.ndarray, lowest: float = 1e-6) -> np.ndarray:
    """Directions above the surface; half of them even in the logarithm of n·v from `lowest` to 1."""
    count = normal.shape[1]
    cosine = np.where(rng.random(count) < 0.5, np.exp(rng.uniform(np.log(lowest), 0.0, count)), rng.random(count))
    return single(cosine * normalise(normal) + np.sqrt(1.0 - cosine**2) * draw_perpendicular(rng, normal))


def draw_lobes(rng: np.random.Generator, count: int) -> np.ndarray:
    """Lobes `[count, 7]`; the first has the amplitude 1e6, the second, if there is one, 0."""
    axes, sharpness, amplitudes = (draw(rng, count) for draw in (draw_directions, draw_sharpnesses, draw_amplitudes))
    lobes = np.concatenate([axes, sharpness[None], amplitudes]).T
    lobes[0, 4:] = 1e6
    lobes[1:2, 4:] = 0.0
    return lobes
