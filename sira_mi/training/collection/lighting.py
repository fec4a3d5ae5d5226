"""One random light a scene, as a latitude-longitude radiance map: spherical-Gaussian lamps, an HDRI, or sun and sky.

Maps are [H, 2H, 3] linear radiance in Mitsuba's frame: u = atan2(x, -z) / 2π, v = acos(y) / π.
"""

from functools import cache
from pathlib import Path
from typing import Any

import cv2
import mitsuba as mi
import numpy as np

from sira_mi.conventions import LUMINANCE
from sira_mi.sg.fit_environment import pixel_directions
from sira_mi.sg.lights_io import read_environment
from sira_mi.sg.lobes import evaluate_lobes
from sira_mi.training.collection.render import point_towards

MAP_HEIGHT = 128
SKY_TURBIDITY = (2.0, 8.0)
# Share of the way to full white balance.
BALANCE = (0.4, 1.0)


@cache
def map_directions(height: int) -> np.ndarray:
    """Unit directions [H, 2H, 3] of the pixel centres."""
    return pixel_directions(height, 2 * height)[0]


def sample_light(random: np.random.Generator, hdri: list[Path]) -> tuple[np.ndarray, dict]:
    """A radiance map of arbitrary scale and its description (JSON types, with the lobes of SG lights).

    Its colour is moved part of the way to neutral grey, as a camera's white balance does."""
    kinds = ("sg", "sky", "hdri") if hdri else ("sg", "sky")
    shares = (0.4, 0.2, 0.4) if hdri else (0.65, 0.35)
    kind = random.choice(kinds, p=shares)
    info: dict[str, Any] = {"kind": "sg"}
    if kind == "sg":
        lobes = sample_lobes(random)
        image = render_lobes(lobes)
    elif kind == "sky":
        image, info = draw_sky(random)
    else:
        path = hdri[random.integers(len(hdri))]
        turn = float(random.uniform(0, 1))
        image = read_map(path)
        image = np.roll(image, round(turn * image.shape[1]), axis=1)
        info = {"kind": "hdri", "file": path.name, "turn": turn}
    balance = find_white_balance(image) ** random.uniform(*BALANCE)
    info["balance"] = balance.tolist()
    if kind == "sg":
        lobes[:, 4:] *= balance
        info["lobes"] = lobes.tolist()
    return image * balance, info


def find_white_balance(image: np.ndarray) -> np.ndarray:
    """Channel factors [3] that make the irradiance on a vertical plate facing +z neutral at the same luminance."""
    directions = map_directions(len(image))
    weight = np.maximum(directions[..., 2], 0) * np.sqrt(np.maximum(1 - directions[..., 1] ** 2, 0))
    colour = (image * weight[..., None]).sum((0, 1)) + 1e-6
    return colour @ np.array(LUMINANCE) / colour


def sample_lobes(random: np.random.Generator) -> np.ndarray:
    """Lobes [N, 7] of axis, sharpness and RGB amplitude: a wide ambient one, a key light mostly from the front half,
    often a fill and a rim light, of plausible lamp colours."""
    lobes = [
        np.concatenate(
            [[0.0, 1.0, 0.0], [random.uniform(0.2, 1.0)], _draw_tint(random, 0.25) * random.uniform(0.1, 0.5)]
        )
    ]
    key = random.uniform(8, 40)
    lobes.append(
        _draw_lobe(random, (-75, 75), (-5, 65), key, _draw_tint(random, 0.35) * random.uniform(0.5, 1.0) * key * 0.12)
    )
    if random.random() < 0.7:
        fill = random.uniform(2, 12)
        lobes.append(
            _draw_lobe(random, (-120, 120), (-25, 50), fill, _draw_tint(random, 0.4) * random.uniform(0.1, 0.5))
        )
    if random.random() < 0.4:
        rim = random.uniform(15, 60)
        lobes.append(
            _draw_lobe(
                random, (120, 240), (0, 60), rim, _draw_tint(random, 0.5) * random.uniform(0.1, 0.8) * rim * 0.08
            )
        )
    return np.array(lobes)


def _draw_lobe(random, yaw, elevation, sharpness, amplitude):
    towards = point_towards(np.radians(random.uniform(*yaw)), np.radians(random.uniform(*elevation)))
    return np.concatenate([towards, [sharpness], amplitude])


def _draw_tint(random, strength):
    """A lamp colour [3] of luminance 1 between warm and cool."""
    warmth = random.uniform(-strength, strength)
    colour = np.array([1 + warmth, 1 + 0.15 * random.uniform(-strength, strength), 1 - warmth])
    return colour / (colour @ np.array(LUMINANCE))


def render_lobes(lobes: np.ndarray, height: int = MAP_HEIGHT) -> np.ndarray:
    """Radiance [H, 2H, 3] of lobes [N, 7]: the sum of amplitude · exp(sharpness (axis · direction − 1))."""
    return evaluate_lobes(lobes, map_directions(height))


def draw_sky(random: np.random.Generator) -> tuple[np.ndarray, dict]:
    """Mitsuba's sun and sky with the sun mostly in front, over grey ground."""
    azimuth, elevation = random.uniform(-110, 110), random.uniform(12, 65)
    turbidity, sun = random.uniform(*SKY_TURBIDITY), random.uniform(0.0, 0.6) ** 2
    towards = point_towards(np.radians(azimuth), np.radians(elevation))
    emitter = mi.load_dict(
        {
            "type": "sunsky",
            "sun_direction": [float(towards[0]), -float(towards[2]), float(towards[1])],
            "turbidity": float(turbidity),
            "sun_scale": 0.0,
            "albedo": 0.3,
        }
    )
    directions = map_directions(MAP_HEIGHT)
    # The plug-in's frame has +z up: its direction is ours turned by a quarter about x.
    local = np.stack([directions[..., 0], -directions[..., 2], directions[..., 1]], -1).reshape(-1, 3)
    interaction = mi.SurfaceInteraction3f()
    interaction.wi = mi.Vector3f(-local.T.astype(np.float32))
    image = np.array(emitter.eval(interaction)).T.reshape(directions.shape).astype(np.float64)
    image = np.maximum(np.nan_to_num(image), 0)
    upper = image[directions[..., 1] > 0].mean(0)
    image[directions[..., 1] <= 0] = 0.2 * upper
    sharpness = 600.0
    disk = np.exp(sharpness * (directions @ towards - 1))
    warm = np.array([1.0, 0.9 - 0.25 * np.exp(-elevation / 15), 0.8 - 0.55 * np.exp(-elevation / 15)])
    # Ratio of sun to sky irradiance: 0 overcast to about 6.
    strength = 18 * sun
    image += disk[..., None] * warm * strength * (upper @ np.array(LUMINANCE)) * np.pi / (2 * np.pi / sharpness)
    info = {"azimuth": azimuth, "elevation": elevation, "turbidity": turbidity, "sun": strength}
    return image, {"kind": "sky", **{key: float(value) for key, value in info.items()}}


@cache
def read_map(path: Path) -> np.ndarray:
    """An HDRI [128, 256, 3], area-averaged to the working size. Maps of Poly Haven fit the frame as they are.

    Raises InputError for a file that is no finite latitude-longitude OpenEXR."""
    size = (2 * MAP_HEIGHT, MAP_HEIGHT)
    return cv2.resize(read_environment(path), size, interpolation=cv2.INTER_AREA).astype(float)
