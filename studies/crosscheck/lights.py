"""The lights of the cross-check: lobes as in a `lights.json`."""

import numpy as np

# A lobe: axis (any length), sharpness, linear RGB amplitude.
SETTINGS = {
    "soft studio": (
        (-0.62, 0.48, 0.62, 14.0, 8.6, 7.8, 7.0),
        (0.86, 0.12, 0.5, 4.0, 0.95, 1.05, 1.2),
        (0.62, 0.5, -0.6, 25.0, 6.0, 6.3, 6.8),
        (0.0, 1.0, 0.0, 0.8, 0.44, 0.46, 0.5),
    ),
    "sun": (
        (0.6, 0.6, 0.55, 1000.0, 480.0, 450.0, 400.0),
        (0.0, 1.0, 0.0, 0.5, 0.15, 0.18, 0.25),
    ),
    "back light": (
        (0.3, 0.4, -0.85, 20.0, 12.0, 11.0, 10.0),
        (-0.8, 0.1, -0.5, 40.0, 10.0, 11.0, 13.0),
        (0.0, 0.0, 1.0, 1.0, 0.12, 0.12, 0.13),
    ),
    "coloured": (
        (-0.8, 0.2, 0.5, 30.0, 12.0, 1.0, 1.0),
        (0.8, 0.2, 0.5, 30.0, 1.0, 2.0, 12.0),
        (0.0, -0.7, 0.7, 15.0, 0.5, 3.0, 0.5),
        (0.0, 0.9, 0.3, 60.0, 6.0, 6.0, 6.0),
        (0.2, 0.1, 0.95, 100.0, 4.0, 3.0, 1.0),
        (-0.3, 0.8, 0.5, 8.0, 0.3, 0.5, 0.5),
    ),
}
# The light of the marks of error and speed.
SOFT = "soft studio"
# The name of a scene file's own light.
OWN = "the scene's own"


def lobes_of(name: str) -> np.ndarray:
    """Lobes `[N_l, 7]` (float32, unit axes) of a setting."""
    lobes = np.array(SETTINGS[name], np.float32)
    lobes[:, :3] /= np.linalg.norm(lobes[:, :3], axis=1, keepdims=True)
    return lobes
