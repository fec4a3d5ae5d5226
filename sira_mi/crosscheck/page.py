"""Figures, picture and page of one avatar's cross-check."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from tqdm import tqdm

from sira_mi.colour import linear_to_srgb
from sira_mi.errors import InputError
from sira_mi.files import write_png, write_text
from sira_mi.relight.compare import CLOSED_FORM_SAMPLES, compare, mean_radiance
from sira_mi.relight.pictures import psnr_inside
from sira_mi.relight.render import RelightSettings, load_head, load_scene, render_passes
from sira_mi.relight.subject import Light, Subject

# A difference of this share of the mean radiance has the strongest colour.
_RANGE = 0.3
_BRIGHTER, _DARKER = np.array([0.70, 0.09, 0.17]), np.array([0.13, 0.40, 0.67])

_PAGE = """# Closed form against path tracing: `{avatar}`

Light: {light}. {width} × {height} pixels, head turned by {yaw:g}°, seed {seed}. All figures are over the
{pixels} pixels that the head covers; shares are of the mean radiance of the path-traced head.

| | |
| --- | --- |
| PSNR of sRGB values | {psnr_db:.1f} dB |
| relative RMSE, noise of path tracing taken out | {error:.2%} |
| noise of path tracing, in the same measure | {noise:.2%} |
| bias: mean of the closed form minus path tracing | {bias:+.2%} |
| closed form, {closed_form_samples} samples a pixel | {closed_form_seconds:.1f} s |
| path tracing, {path_samples} samples a pixel | {path_seconds:.1f} s |

![Closed form, path tracing, difference](crosscheck.png)

Left: the closed form. Middle: path tracing. Right: their difference, red where the closed form is brighter, blue where
it is darker, at full colour {range:.0%} of the mean radiance. Times include compiling the kernels, which later runs
find compiled.

Both see the same lobes; lobes are fitted to an image first. The closed form shades the field with its networks. Its
shadows come from a fixed set of directions, and it knows one bounce, off surfaces of the point's own albedo. The path
tracer follows all bounces on the mesh, with albedos stored at its vertices.
"""


def cross_check(
    subject: Subject, light: Light, names: tuple[str, str | None], yaw_degrees: float, samples: int, seed: int
) -> tuple[dict, np.ndarray]:
    """The figures as a JSON object, and display values [H, 3 W, 3] of both pictures and their difference. `names` are
    those of the avatar and of the light's file, None for the light of the photo.

    Raises InputError when the head covers no pixel."""
    # Path tracing as two halves of other random numbers: the product of their differences has no noise in its mean.
    settings = RelightSettings(samples=samples // 2, seed=seed)
    other = replace(settings, seed=seed + 1)
    print("baking the head", file=sys.stderr)
    shape = load_head(subject, settings)
    with tqdm(total=2 * settings.samples + CLOSED_FORM_SAMPLES, unit="spp", disable=None) as bar:
        result = compare(shape, subject.camera, light, yaw_degrees, settings, bar.update)
        scene = load_scene(shape, subject.camera, light, yaw_degrees, other)
        again = render_passes(scene, other, bar.update)[..., :3]
    mask, traced = result.mask, 0.5 * (result.traced + again)
    if not mask.any():
        raise InputError(f"{subject.path}: the head covers no pixel of this picture; give a larger --size")
    mean, difference = mean_radiance(traced, mask), result.closed_form - traced
    square = float(((result.closed_form - result.traced) * (result.closed_form - again))[mask].mean())
    figures = {
        "avatar": names[0],
        "light": names[1],
        "width": subject.camera.width,
        "height": subject.camera.height,
        "pixels": int(mask.sum()),
        "yaw_degrees": yaw_degrees,
        "seed": seed,
        "closed_form": {"samples": CLOSED_FORM_SAMPLES, "seconds": result.seconds[0]},
        "path": {"samples": 2 * settings.samples, "seconds": 2 * result.seconds[1]},
        "psnr_db": psnr_inside(result.closed_form, traced, mask),
        "error": max(square, 0.0) ** 0.5 / mean,
        "noise": float(np.sqrt(((again - result.traced)[mask] ** 2).mean())) / 2 / mean,
        "bias": float(difference[mask].mean()) / mean,
    }
    shown = [linear_to_srgb(np.clip(image, 0, 1)) for image in (result.closed_form, traced)]
    signed = np.where(mask, difference.mean(axis=2), 0) / (_RANGE * mean)
    return figures, np.concatenate([*shown, colour_difference(signed)], axis=1)


def colour_difference(value: np.ndarray) -> np.ndarray:
    """Colours [H, W, 3] of signed values [H, W]: white at 0, red at 1 and above, blue at −1 and below."""
    strength = np.clip(np.abs(value), 0, 1)[..., None]
    return 1 - strength * (1 - np.where(value[..., None] > 0, _BRIGHTER, _DARKER))


def page(figures: dict) -> str:
    """The page of the figures of `cross_check`."""
    return _PAGE.format(
        **{name: value for name, value in figures.items() if name not in ("light", "closed_form", "path")},
        light=f"`{figures['light']}`" if figures["light"] else "that of the photo",
        yaw=figures["yaw_degrees"],
        closed_form_samples=figures["closed_form"]["samples"],
        closed_form_seconds=figures["closed_form"]["seconds"],
        path_samples=figures["path"]["samples"],
        path_seconds=figures["path"]["seconds"],
        range=_RANGE,
    )


def write_page(folder: Path, figures: dict, picture: np.ndarray) -> Path:
    """Writes `crosscheck.json`, `.png` and `.md` to `folder`; returns the path of the page.

    Raises InputError when they cannot be written."""
    path = folder / "crosscheck.md"
    write_text(folder / "crosscheck.json", json.dumps(figures, indent=1) + "\n")
    write_text(path, page(figures))
    write_png(folder / "crosscheck.png", picture)
    return path
