"""The exposure at which pictures of a head under another light are compared."""

import numpy as np

from sira_mi.conventions import LUMINANCE
from sira_mi.errors import InputError
from sira_mi.sg.fit_environment import total_light

LEVEL = 0.8  # exposed radiance of a white surface that the light reaches evenly from all sides


def exposure_of(environment: np.ndarray) -> float:
    """The factor on linear radiance: `LEVEL` over the mean luminance of an environment [H, W, 3] over the sphere. It
    depends on the light alone, so that a head that is too dark or too light stays so. Raises InputError for an
    environment without light."""
    mean = float(total_light(environment) @ np.array(LUMINANCE)) / (4 * np.pi)
    if not (np.isfinite(mean) and mean > 0):
        raise InputError(f"the environment's mean luminance is {mean:g}: nothing can be exposed under it")
    return LEVEL / mean
