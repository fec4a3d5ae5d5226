"""Lobes to measure on: PhySG's start of an optimisation (Zhang et al. 2021)."""

import numpy as np

from sira_mi.fields.directions import fibonacci_directions
from sira_mi.sg.lobes import lobe_integral


def initial_lobes(count: int, energy: float = 2.0 * np.pi, seed: int = 0) -> np.ndarray:
    """PhySG's start `[count, 7]` (float32): Fibonacci axes, sharpness 20 + |100·N(0, 1)|, grey, `energy` in all.

    `energy` is the total ∫ l dω of each channel, radiance times steradians, shared equally by the lobes."""
    sharpness = 20.0 + np.abs(100.0 * np.random.default_rng(seed).standard_normal(count))
    amplitude = energy / count / lobe_integral(sharpness)
    columns = [fibonacci_directions(count), sharpness[:, None], np.repeat(amplitude[:, None], 3, axis=1)]
    return np.concatenate(columns, axis=1).astype(np.float32)
