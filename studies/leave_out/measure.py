"""Measures what a head's pictures and a fit leave out."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from sira_mi.avatar.file import PRIOR, load_avatar, save_avatar
from sira_mi.fit.fit import FitRequest, read_portrait
from sira_mi.fit.measure import measure_fit
from sira_mi.fit.settings import QUALITIES
from sira_mi.fit.stage import FitTask
from sira_mi.fit.state import initial_state
from sira_mi.relight.leave_out import plan_relight
from sira_mi.relight.measure import measure_plan
from sira_mi.relight.render import RelightSettings, load_head
from sira_mi.relight.subject import Light, Subject

# How bright the dim lobes are, as a share of the photo's.
_DIM = 1e-5


def measure_pictures(
    subject: Subject, light: Light, size: int, voxel: float, say: Callable[[str], object] = print
) -> list[dict]:
    """The measured decisions, as JSON objects, of pictures of a head: as asked for, under dim lobes too, and with
    k_s = 0. The longer side has `size` pixels, the mesh the spacing `voxel`, scene units."""
    lobes = subject.avatar.tensors["lobes"]
    dim = np.concatenate([lobes, lobes])
    dim[len(lobes) :, 4:] *= _DIM
    with tempfile.TemporaryDirectory() as work:
        file = Path(work) / "avatar.safetensors"
        save_avatar(file, replace(subject.avatar, k_s=0.0))
        whole = subject.resize(size)
        matt = replace(whole, path=file, avatar=load_avatar(file))
        cases = (
            ("closed form", "sg", whole, light),
            ("path tracing", "path", whole, light),
            ("dim lobes too", "sg", whole, Light(dim)),
            ("k_s = 0", "sg", matt, light),
            ("k_s = 0, traced", "path", matt, light),
        )
        found = []
        for title, integrator, one, lit in cases:
            settings = RelightSettings(integrator, exact=integrator == "path", voxel=voxel)
            shape = load_head(one, replace(settings, exact=False))
            plan = measure_plan(plan_relight(one, lit, shape, settings, [0.0]), one, lit, settings, 0.0, size)
            found.append({"title": title, "integrator": integrator, "decisions": plan.report()})
            say(f"measured: {title}")
    return found


def measure_fit_of_example() -> list[dict]:
    """The measured decisions of the appearance stages of the example at standard quality, as JSON objects."""
    settings, prior = QUALITIES["standard"], load_avatar(PRIOR)
    with tempfile.TemporaryDirectory() as folder:
        portrait = read_portrait(FitRequest(None, Path(folder), example=True), settings, prior)
        task = FitTask(portrait, prior, PRIOR, settings, Path(folder), settings.plan())
        return measure_fit(task, initial_state(prior, 0)).report()
