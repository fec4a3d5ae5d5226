"""The three lights of the benchmark, and the background of each.

`studio` is a broad key with a fill, `outdoor` a captured environment or sun and sky, `extreme` one small bright lobe:
from the side, from behind, or strongly coloured.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter

from sira_mi.conventions import LUMINANCE
from sira_mi.errors import InputError
from sira_mi.sg.lights_io import read_environment
from sira_mi.training.collection.lighting import (
    draw_sky,
    find_white_balance,
    map_directions,
    read_map,
    render_lobes,
)

LIGHTS = ("studio", "outdoor", "extreme")
EXTREMES = ("side", "back", "coloured")
HARD = 500.0  # sharpness of the extreme light's lobe: 2.6 degrees to one standard deviation
BALANCE = 0.8  # share of the way to full white balance, of environments
SOFT = 6.0  # degrees, blur of an environment as a background
BRIGHTEST = 1.5  # linear, of the background
BUSY_VIEW = 100.0  # degrees of an environment across a busy background
BUSY_LUMINANCE = (0.15, 0.4)  # its mean
FEWEST_RELIGHTS = 4  # environments from which each head can have two, none its own


def light_map(light: str, random: np.random.Generator, yaw: float, environment: Path | None, extreme: str):
    """Radiance map [H, 2H, 3] of arbitrary scale. `yaw` is the camera's, degrees; `environment` is the file for
    `outdoor`, None for sun and sky; `extreme` is one of `EXTREMES`."""
    if light == "studio":
        return render_lobes(_studio(random, yaw))
    if light == "extreme":
        return render_lobes(_extreme(random, extreme))
    if environment is None:
        image, _ = draw_sky(random)
    else:
        image = read_map(environment)
        image = np.roll(image, random.integers(image.shape[1]), axis=1)
    return image * find_white_balance(image) ** BALANCE


def backdrop(light: str, random: np.random.Generator, image: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """The background [H, W, 3] in viewing directions [H, W, 3]: for `outdoor` the blurred environment `image`
    [h, 2h, 3] in its own scale, otherwise a grey wall that darkens towards the corners, in the photo's scale."""
    if light == "outdoor":
        return look_up(blur(image, SOFT), directions)
    brightness = random.uniform(0.14, 0.45) if light == "studio" else random.uniform(0.04, 0.1)
    height, width = directions.shape[:2]
    y, x = np.meshgrid(np.linspace(-1, 1, height), np.linspace(-1, 1, width), indexing="ij")
    spot = random.uniform(-0.4, 0.4, 2)
    fall = 1 - 0.22 * ((x - spot[0]) ** 2 + (y - spot[1]) ** 2) / 2
    return brightness * fall[..., None] * _tint(random, 0.06)


def busy_backdrop(random: np.random.Generator, environment: Path, directions: np.ndarray) -> np.ndarray:
    """The background [H, W, 3] in viewing directions [H, W, 3], in the photo's scale: an environment in focus."""
    image = read_environment(environment)
    behind = look_up(image * find_white_balance(read_map(environment)) ** BALANCE, directions)
    mean = np.minimum(behind, 4 * np.median(behind)).mean(axis=(0, 1)) @ np.array(LUMINANCE)
    return behind * random.uniform(*BUSY_LUMINANCE) / mean


def draw_relights(environments: list[Path], taken: Sequence[Path | None], seed: int) -> list[tuple[Path, Path]]:
    """Two environments for each portrait, none the portrait's own, `taken`: one of the more even half of all, and one
    of the more directed half, in turns the first. All are drawn about equally often. Raises InputError for fewer than
    `FEWEST_RELIGHTS` environments."""
    if len(environments) < FEWEST_RELIGHTS:
        raise InputError(
            f"{len(environments)} environment maps: relighting takes {FEWEST_RELIGHTS} or more; name a folder by --hdri"
        )
    random = np.random.default_rng([seed, 43])
    ranked = sorted(environments, key=lambda path: (measure_direction(read_map(path)), path.name))
    halves = ranked[: len(ranked) // 2], ranked[len(ranked) // 2 :]
    uses = dict.fromkeys(environments, 0)
    pairs = []
    for number, own in enumerate(taken):
        pair = []
        for half in halves:
            free = [path for path in half if path != own]
            least = min(uses[path] for path in free)
            path = free[random.choice([k for k, path in enumerate(free) if uses[path] == least])]
            uses[path] += 1
            pair.append(path)
        first, second = pair if number % 2 == 0 else pair[::-1]
        pairs.append((first, second))
    return pairs


def measure_direction(image: np.ndarray) -> float:
    """How directed the light of a map [H, 2H, 3] is: the length of its mean flux vector over its mean radiance, by
    luminance; 0 for an even light, 1 for a distant lamp."""
    directions = map_directions(len(image))
    weight = (image @ np.array(LUMINANCE)) * np.sqrt(np.maximum(1 - directions[..., 1] ** 2, 0))
    return float(np.linalg.norm((weight[..., None] * directions).sum((0, 1))) / weight.sum())


def blur(image: np.ndarray, degrees: float) -> np.ndarray:
    """A map [H, 2H, 3] blurred by a Gaussian of that standard deviation on the equator, going round."""
    sigma = degrees * image.shape[0] / 180
    return gaussian_filter(image, (sigma, sigma, 0), mode=("nearest", "wrap", "nearest"))


def look_up(image: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Bilinear values [..., 3] of a map [H, 2H, 3], its rows as in `pixel_directions`, in unit directions [..., 3]."""
    height, width = image.shape[:2]
    u = np.arctan2(directions[..., 0], -directions[..., 2]) / (2 * np.pi) % 1.0 * width - 0.5
    v = np.clip(np.arccos(np.clip(directions[..., 1], -1, 1)) / np.pi, 0, 1) * (height - 1)
    column, row = np.floor(u).astype(int), np.minimum(np.floor(v).astype(int), height - 2)
    fu, fv = (u - column)[..., None], (v - row)[..., None]
    left, right = column % width, (column + 1) % width
    upper = image[row, left] * (1 - fu) + image[row, right] * fu
    return upper * (1 - fv) + (image[row + 1, left] * (1 - fu) + image[row + 1, right] * fu) * fv


def _studio(random, yaw):
    side = random.choice([-1, 1])
    return np.array(
        [
            _lobe(0, 90, random.uniform(0.3, 0.8), 0.35 * _tint(random, 0.08)),
            _lobe(
                yaw + side * random.uniform(20, 50), random.uniform(15, 40), random.uniform(5, 12), _tint(random, 0.1)
            ),
            _lobe(
                yaw - side * random.uniform(35, 80),
                random.uniform(-5, 25),
                random.uniform(2, 4),
                random.uniform(0.25, 0.5) * _tint(random, 0.15),
            ),
        ]
    )


def _extreme(random, kind):
    side = random.choice([-1, 1])
    if kind == "side":
        key = _lobe(side * random.uniform(60, 85), random.uniform(5, 35), HARD, _tint(random, 0.2))
        return np.array([_lobe(0, 90, 0.3, 0.07 * _tint(random, 0.3)), key])
    if kind == "back":
        key = _lobe(side * random.uniform(110, 140), random.uniform(15, 40), HARD, 2.5 * _tint(random, 0.2))
        return np.array([_lobe(0, 90, 0.3, 0.25 * _tint(random, 0.3)), key])
    hue = random.uniform(0, 6)
    key = _lobe(side * random.uniform(25, 60), random.uniform(10, 40), HARD, _saturated(hue))
    rim = _lobe(-side * random.uniform(60, 110), random.uniform(0, 30), 15.0, 0.35 * _saturated(hue + 3))
    return np.array([_lobe(0, 90, 0.3, 0.05 * _tint(random, 0.1)), key, rim])


def _lobe(yaw, elevation, sharpness, irradiance):
    """A lobe [7] that gives a plate facing it about that irradiance [3]; angles in degrees."""
    a, e = np.radians(yaw), np.radians(elevation)
    amplitude = irradiance * sharpness / (2 * np.pi * -np.expm1(-2 * sharpness))
    return np.concatenate([[np.sin(a) * np.cos(e), np.sin(e), np.cos(a) * np.cos(e)], [sharpness], amplitude])


def _tint(random, strength):
    """A colour [3] of luminance 1 between warm and cool."""
    warmth = random.uniform(-strength, strength)
    colour = np.array([1 + warmth, 1.0, 1 - warmth])
    return colour / (colour @ np.array(LUMINANCE))


def _saturated(hue):
    """A strong colour [3] of luminance 1; hue from 0 to 6."""
    pure = np.clip(np.abs((hue + np.array([0.0, 4.0, 2.0])) % 6 - 3) - 1, 0, 1)
    colour = 0.15 + 0.85 * pure
    return colour / (colour @ np.array(LUMINANCE))
