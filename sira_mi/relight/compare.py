"""The cross-validation of closed-form shading: the same head, camera and lobes by path tracing."""

import time
from dataclasses import dataclass, replace

import numpy as np

from sira_mi.relight.pictures import LAYERS, psnr_inside
from sira_mi.relight.render import RelightSettings, load_head, load_scene, render_passes
from sira_mi.relight.subject import Light, Subject

# Samples a pixel of the closed form, which only its outlines need.
CLOSED_FORM_SAMPLES = 8


@dataclass(frozen=True, eq=False)
class Comparison:
    """Both pictures [H, W, 3] of linear radiance, and how far the closed form is from the path-traced one."""

    closed_form: np.ndarray
    traced: np.ndarray
    psnr: float  # dB, of sRGB values inside the head
    relative_error: float  # mean |difference| over mean radiance, inside the head
    bias: float  # mean difference over mean radiance, inside the head; positive where the closed form is brighter
    seconds: tuple[float, float]  # of the closed form and of path tracing, compilation included


def compare(subject: Subject, light: Light, yaw_degrees: float, settings: RelightSettings, done=None) -> Comparison:
    """Renders the head by `sira_sg` and by `path` under the same lobes and measures the difference: what the closed
    form only approximates, shadows and interreflections among it, and the noise of the samples."""
    closed_form = replace(settings, integrator="sg", samples=CLOSED_FORM_SAMPLES)
    traced = replace(settings, integrator="path")
    shape = load_head(subject, traced)
    images, seconds = [], []
    for one in (closed_form, traced):
        scene = load_scene(shape, subject.camera, light, yaw_degrees, one)
        start = time.monotonic()
        images.append(render_passes(scene, one, done))
        seconds.append(time.monotonic() - start)
    first, second = (image[..., :3] for image in images)
    start, _ = LAYERS["mask"]
    mask = images[0][..., start] > 0.99
    difference, mean = (first - second)[mask], max(float(second[mask].mean()), 1e-12) if mask.any() else 1.0
    return Comparison(
        closed_form=first,
        traced=second,
        psnr=psnr_inside(first, second, mask),
        relative_error=float(np.abs(difference).mean() / mean) if mask.any() else float("nan"),
        bias=float(difference.mean() / mean) if mask.any() else float("nan"),
        seconds=(seconds[0], seconds[1]),
    )
