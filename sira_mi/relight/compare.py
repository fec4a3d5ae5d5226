"""Closed-form shading against path tracing: the same head, camera and lobes by both integrators."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from sira_mi.portrait.camera import Camera
from sira_mi.relight.pictures import psnr_inside
from sira_mi.relight.render import RelightSettings, load_scene, render_passes
from sira_mi.relight.subject import Light
from sira_mi.sg.layers import split_layers

if TYPE_CHECKING:
    from sira_mi.plugins.neural_sdf import NeuralSDF

# Samples a pixel of the closed form, which only its outlines need.
CLOSED_FORM_SAMPLES = 8


@dataclass(frozen=True, eq=False)
class Comparison:
    """Both pictures [H, W, 3] of linear radiance, and how far the closed form is from the path-traced one. The figures
    are those of the pixels that the head covers, NaN where there are none."""

    closed_form: np.ndarray
    traced: np.ndarray
    mask: np.ndarray  # bool [H, W]: pixels that the head covers
    psnr: float  # dB, of sRGB values
    relative_error: float  # mean |difference| over mean radiance
    bias: float  # mean difference over mean radiance; positive where the closed form is brighter
    seconds: tuple[float, float]  # of the closed form and of path tracing, compilation included


def compare(
    shape: NeuralSDF,
    camera: Camera,
    light: Light,
    yaw_degrees: float,
    settings: RelightSettings,
    done: Callable[[int], object] | None = None,
) -> Comparison:
    """Renders the head `shape` (of `load_head` for `path`) by `sira_sg` and by `path` under the same lobes and measures
    the difference: what the closed form only approximates, shadows and interreflections among it, and the noise of the
    samples. `done` is called as by `render_passes`."""
    images, seconds = [], []
    for one in (
        replace(settings, integrator="sg", samples=CLOSED_FORM_SAMPLES),
        replace(settings, integrator="path"),
    ):
        scene = load_scene(shape, camera, light, yaw_degrees, one)
        start = time.monotonic()
        images.append(render_passes(scene, one, done))
        seconds.append(time.monotonic() - start)
    closed_form, traced = (image[..., :3] for image in images)
    mask = split_layers(images[0])["mask"] > 0.99
    difference, mean = (closed_form - traced)[mask], mean_radiance(traced, mask)
    return Comparison(
        closed_form=closed_form,
        traced=traced,
        mask=mask,
        psnr=psnr_inside(closed_form, traced, mask),
        relative_error=float(np.abs(difference).mean() / mean) if mask.any() else float("nan"),
        bias=float(difference.mean() / mean) if mask.any() else float("nan"),
        seconds=(seconds[0], seconds[1]),
    )


def mean_radiance(image: np.ndarray, mask: np.ndarray) -> float:
    """Mean of an image [H, W, 3] over a mask [H, W], at least 1e-12; 1 where the mask is empty."""
    return max(float(image[mask].mean()), 1e-12) if mask.any() else 1.0
