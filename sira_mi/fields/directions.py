"""Directions that cover the sphere evenly."""

import numpy as np

# The golden angle: consecutive directions of a Fibonacci lattice on the sphere differ by it in azimuth.
GOLDEN_ANGLE = np.pi * (3.0 - np.sqrt(5.0))


def fibonacci_directions(count: int) -> np.ndarray:
    """`count` near-uniform unit directions `[count, 3]` (float64), from +y down to −y."""
    index = np.arange(count)
    y = 1.0 - (2.0 * index + 1.0) / count
    radius = np.sqrt(1.0 - y * y)
    azimuth = GOLDEN_ANGLE * index
    return np.stack([radius * np.cos(azimuth), y, radius * np.sin(azimuth)], axis=1)
