"""The polish: its derivative is that of the path-traced picture, it recovers albedo and light, and a fit leaves a whole
avatar however it ends."""

import dataclasses
import json
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from conftest import camera, slopes, tiny_fit

from sira_mi.fit import settings as fit_settings
from sira_mi.fit.driver import Progress, run_stages
from sira_mi.fit.settings import polish_stage
from sira_mi.fit.stage import FitTask
from sira_mi.fit.state import FitState
from sira_mi.optimisation.adam import read_arrays
from sira_mi.portrait.portrait import Portrait

STAGE = dataclasses.replace(polish_stage(30), size=32, samples=64)
MOVED = ("z_l", "illumination", "z_s", "albedo_refinement")


@pytest.fixture(scope="module")
def problem(variant, avatar, avatar_path, tmp_path_factory):
    """The polish of a blob, whose photo is the path-traced picture of the avatar's own tensors."""
    whole = np.ones((32, 32), np.float32)
    nowhere = np.full((468, 2), np.nan)
    photo = Portrait(np.zeros((32, 32, 3), np.float32), whole, nowhere, nowhere, camera(focal=40, size=32), ())
    folder = tmp_path_factory.mktemp("polish")
    state, settings = FitState.of_avatar(avatar), tiny_fit(steps=2)
    task = FitTask(photo, avatar, Path(avatar_path), settings, folder, settings.plan())
    problem = STAGE.problem(task, state)
    problem.target = picture(problem, state)
    return problem


def picture(problem, state: FitState) -> np.ndarray:
    """The path-traced picture [h, w, 3] of an avatar's networks and latents."""
    floats = {name: mi.Float(value) for name, value in state.avatar.items()}
    with dr.suspend_grad():
        problem._show(problem._appearance(floats, np.random.default_rng(0)))
        return mi.render(problem.scene, spp=256, seed=3).numpy()[..., :3]


def other(avatar) -> FitState:
    """The avatar with another refinement and light."""
    rng = np.random.default_rng(5)
    changed = {}
    for name, size in (("albedo_refinement", 0.2), ("z_l", 0.5)):
        value = avatar.tensors[name]
        changed[name] = value + (size * rng.standard_normal(value.shape)).astype(np.float32)
    return FitState.of_avatar(avatar).with_parameters(changed)


@pytest.mark.slow
@pytest.mark.parametrize("name", MOVED)
def test_derivative_is_that_of_the_path_traced_picture(problem, avatar, name):
    """Through vertices, `prb` and networks: the mean of a few steps' derivatives against a central difference of the
    same paths."""
    state = other(avatar)
    problem.refresh(state)
    fixed = {key: mi.Float(value) for key, value in state.avatar.items()}
    start = state.avatar[name]

    def color(value):
        return problem._color({**fixed, name: value}, np.random.default_rng(1))

    def loss(value):
        return float(color(mi.Float(value)).numpy().item())

    value = mi.Float(start)
    dr.enable_grad(value)
    dr.backward(color(value))
    gradient = dr.grad(value).numpy()
    ad, difference = slopes(loss, start, gradient, 0.05)
    assert ad == pytest.approx(difference, rel=0.1)


@pytest.mark.slow
def test_polish_finds_albedo_and_light_again(problem, avatar):
    """From another albedo and light, a few steps bring the path-traced picture most of the way to the photo, through
    the driver that runs all stages."""
    start = other(avatar)
    stage = dataclasses.replace(STAGE, rates={name: 2 * rate for name, rate in STAGE.rates.items()})
    progress = run_stages([stage], lambda stage, state: problem, Progress(start), 10, 0, lambda progress: None)
    before, after = (np.abs(picture(problem, state) - problem.target).mean() for state in (start, progress.state))
    assert after < 0.6 * before
    assert all(not np.array_equal(start.avatar[name], progress.state.avatar[name]) for name in MOVED)


@pytest.fixture(scope="module")
def fit(tmp_path_factory):
    """A tiny fit of the example with a polish, stopped by Ctrl-C in the polish and then resumed: avatar and report that
    it would write at the interrupt and at its end, and the checkpoint at the interrupt."""
    from sira_mi.fit import driver
    from sira_mi.fit.fit import FitRequest, fit_photo

    out = tmp_path_factory.mktemp("fit") / "a"
    request = FitRequest(photo=None, out=out, quality="draft", example=True, resume=True, polish=True)
    step_of_driver, written = driver._step, []

    def interrupted(problem, optimizer, stage, step, *arguments):
        if stage.name == "polish" and step == 7:
            raise KeyboardInterrupt
        return step_of_driver(problem, optimizer, stage, step, *arguments)

    def write(out, portrait, avatar, settings, report, started):
        written.append((avatar, json.loads(json.dumps(report))))

    with pytest.MonkeyPatch.context() as patch:
        stage = dataclasses.replace(polish_stage(9), size=48, samples=4)
        patch.setitem(fit_settings.QUALITIES, "draft", tiny_fit(steps=2))
        patch.setattr("sira_mi.fit.fit.polish_stage", lambda: stage)
        patch.setattr("sira_mi.fit.fit.write_folder", write)
        patch.setattr(driver, "_CHECKPOINT_SECONDS", 0.0)
        patch.setattr(driver, "_step", interrupted)
        assert fit_photo(request) == 130
        checkpoint = FitState.from_arrays(read_arrays(out / ".fit" / "checkpoint.safetensors")[0])
        patch.setattr(driver, "_step", step_of_driver)
        assert fit_photo(request) == 0
    return *written, checkpoint


@pytest.mark.slow
def test_interrupt_in_the_polish_leaves_the_avatar_as_it_was_before(fit):
    """Although the checkpoint holds one that is polished in part."""
    (avatar, report), _, checkpoint = fit
    assert report["complete"] is False and "polish" not in report
    for name in MOVED:
        assert np.array_equal(avatar.tensors[name], checkpoint.before_polish().avatar[name])
        assert not np.array_equal(avatar.tensors[name], checkpoint.avatar[name])


@pytest.mark.slow
def test_a_polished_fit_reports_what_it_gained(fit):
    """The pictures come closer to the photo; geometry and base albedo stay; the avatar's lobes are those polished."""
    from sira_mi.fit.shaded import decode_lobes

    (unpolished, _), (avatar, report), _ = fit
    assert report["complete"] and report["seconds"]["polish"] > 0
    before, after = report["polish"]["path_traced_psnr_db"]
    assert 8 < before < after < 50
    assert all(8 < value < 50 for value in report["polish"]["closed_form_psnr_db"])
    for name, value in unpolished.tensors.items():
        assert np.array_equal(value, avatar.tensors[name], equal_nan=True) == (name not in (*MOVED, "lobes")), name
    lobes = decode_lobes(avatar, {name: mi.Float(avatar.tensors[name]) for name in ("illumination", "z_l")})
    assert np.allclose(lobes.numpy(), avatar.tensors["lobes"], rtol=1e-5)
