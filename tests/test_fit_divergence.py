"""Fits that diverge: detected, taken back to the last good block with shorter steps, reported, repeated on resume."""

import sira_mi  # noqa: F401  (before Dr.Jit, which must find LLVM)

# isort: split
import sys
from dataclasses import dataclass, field, replace
from typing import Any, cast

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import skimage.data
from conftest import tiny_fit
from PIL import Image

from sira_mi.avatar.file import PRIOR, load_avatar, save_avatar
from sira_mi.errors import InputError, run_command
from sira_mi.fields.extraction import EmptySurfaceError
from sira_mi.fit import driver
from sira_mi.fit.__main__ import main
from sira_mi.fit.driver import Progress, load_progress, run_stages, save_progress
from sira_mi.fit.fit import FitRequest, fit_portrait, read_portrait
from sira_mi.fit.stage import FitTask, Problem, Stage
from sira_mi.fit.state import FitState, initial_state
from sira_mi.optimisation.adam import adam
from sira_mi.portrait.face import find_faces

pytestmark = pytest.mark.usefixtures("variant")

BLOCK, SEED = 5, 3
TARGET = np.linspace(-1, 1, 16).astype(np.float32)
replace_grad: Any = dr.replace_grad  # the stubs let it return nothing
# A descent down a bowl looks at no photo.
NO_TASK = cast(FitTask, None)
# The rate of a healthy descent on the bowl.
RATE = 0.03


class Bowl:
    """A descent that anything may happen to: squared distance from a target, weighed anew for every step."""

    def __init__(self, empty_beyond: float = np.inf, undefined_beyond: float = np.inf):
        self.empty_beyond, self.undefined_beyond = empty_beyond, undefined_beyond

    def start(self, state):
        return state

    def refresh(self, state):
        if np.abs(state.avatar["x"]).max() > self.empty_beyond:
            raise EmptySurfaceError("nothing left")

    def losses(self, parameters, step, rng):
        x = parameters["x"]
        weight = mi.Float(rng.uniform(0.8, 1.2, len(TARGET)).astype(np.float32))
        distance = dr.mean(weight * dr.square(x - mi.Float(TARGET)))
        return {"distance": dr.select(dr.max(dr.abs(dr.detach(x))) > self.undefined_beyond, dr.nan, distance)}


@dataclass(frozen=True)
class Descent(Stage):
    """A stage down a bowl."""

    bowl: Problem = field(default_factory=Bowl)

    def problem(self, task, state) -> Problem:
        return self.bowl


def stages(factor: float, problem: Problem | None = None, steps: int = 60) -> list[Stage]:
    bowl = problem or Bowl()
    return [Descent("first", steps, {"x": factor * RATE}, bowl=bowl), Descent("second", 8, {"x": 1e-3}, bowl=bowl)]


def descend(stages: list[Stage], progress: Progress | None = None, checkpoint=lambda progress: None) -> Progress:
    progress = progress or start_at(0.0)
    return run_stages(stages, lambda stage, state: stage.problem(NO_TASK, state), progress, BLOCK, SEED, checkpoint)


def start_at(value: float) -> Progress:
    return Progress(FitState({"x": np.full(len(TARGET), value, np.float32)}))


def distance(progress: Progress) -> float:
    return float(np.abs(progress.state.avatar["x"] - TARGET).max())


def test_a_healthy_descent_is_left_alone():
    """The bits are those of plain Adam steps: watching costs no accuracy and changes nothing."""
    progress = descend(stages(1.0))
    assert not progress.notes and distance(progress) < 0.2
    values = {"x": np.zeros(len(TARGET), np.float32)}
    for number, stage in enumerate(stages(1.0)):
        optimizer, problem = adam(values, stage.rates, beta_2=0.98), Bowl()
        for step in range(stage.steps):
            driver._step(problem, optimizer, stage, step, 1.0, np.random.default_rng([SEED, number, step]))
        values = {"x": dr.detach(optimizer["x"]).numpy()}
    assert np.array_equal(values["x"], progress.state.avatar["x"])


@pytest.mark.parametrize("factor", [300.0, 3e4])
def test_rates_too_high_are_detected_and_halved(factor, capsys):
    """Every rollback is one line on stderr and one note; the descent ends where a healthy one does."""
    progress = descend(stages(factor))
    assert progress.notes and all("diverged in stage first" in note for note in progress.notes)
    lines = [line for line in capsys.readouterr().err.replace("\r", "\n").splitlines() if line.startswith("note: ")]
    assert lines == [f"note: {note}" for note in progress.notes]
    assert distance(progress) < 0.5


class Rectifier:
    """The least network that can die: above the target its loss is steep, and below 0 it has no slope and a loss hardly
    above the first."""

    def start(self, state):
        return state

    def refresh(self, state):
        pass

    def losses(self, parameters, step, rng):
        beyond = dr.maximum(parameters["x"], 0) - 1
        return {"distance": 0.1 + dr.mean(dr.select(beyond > 0, 10.0, 1.0) * dr.square(beyond))}


def test_a_network_that_dies_is_noticed():
    """One step far too long ends where nothing moves any more: no median of a block shows it, its steps do."""
    progress = descend(stages(160.0, Rectifier()), start_at(0.05))
    assert progress.notes and np.abs(progress.state.avatar["x"] - 1).max() < 0.1


@pytest.mark.parametrize("fault", ["empty_beyond", "undefined_beyond"])
def test_lost_surface_and_undefined_loss_are_taken_back(fault):
    """A lost surface and a loss that is not a number are divergence too, whatever the losses were before."""
    progress = descend(stages(100.0, Bowl(**{fault: 1.5})))
    words = {"empty_beyond": "nothing left", "undefined_beyond": "not finite"}[fault]
    assert any(words in note for note in progress.notes)
    assert np.abs(progress.state.avatar["x"]).max() <= 1.5


def test_a_parameter_that_is_not_a_number_is_noticed_after_the_last_step():
    """Even where no later loss would show it."""

    class Poisoned(Bowl):
        steps = 0

        def losses(self, parameters, step, rng):
            terms = super().losses(parameters, step, rng)
            self.steps += 1
            if self.steps == 60 + 8:
                terms["distance"] = replace_grad(terms["distance"], dr.nan * dr.sum(parameters["x"]))
            return terms

    progress = descend(stages(1.0, Poisoned()))
    assert [note for note in progress.notes if "stage second (a parameter is not finite)" in note]
    assert np.isfinite(progress.state.avatar["x"]).all()


def test_hopeless_fits_end_with_one_line():
    """InputError, not an endless loop."""
    with pytest.raises(InputError, match="diverges in stage first at any learning rate") as error:
        descend(stages(1.0, Bowl(undefined_beyond=-1.0)))
    assert "\n" not in str(error.value)


def test_losses_that_rise_whatever_the_steps_do_not_end_a_fit():
    """It is said, and the fit goes on at its shortest steps."""

    class Steeper(Bowl):
        def losses(self, parameters, step, rng):
            return {"distance": 3.0 ** (step // BLOCK) * super().losses(parameters, step, rng)["distance"]}

    progress = descend(stages(0.01, Steeper(), steps=15))
    assert len(progress.notes) == 2 * driver._MOST_ROLLBACKS and progress.stage == 2


@pytest.mark.parametrize("killed_at", [4, 17, 31, 50])
def test_resume_after_a_rollback_ends_in_the_same_bits(killed_at, tmp_path, monkeypatch):
    """The learning rate, the lowest loss and the notes are in the checkpoint."""
    once = descend(stages(300.0))
    monkeypatch.setattr(driver, "_CHECKPOINT_SECONDS", 0.0)
    path, real, count = tmp_path / "checkpoint.safetensors", driver._step, 0

    def dies(*arguments):
        nonlocal count
        count += 1
        if count == killed_at:
            raise RuntimeError("killed")
        return real(*arguments)

    monkeypatch.setattr(driver, "_step", dies)
    with pytest.raises(RuntimeError, match="killed"):
        descend(stages(300.0), checkpoint=lambda progress: save_progress(path, progress, "this"))
    twice = descend(stages(300.0), load_progress(path, "this") if path.exists() else None)
    assert np.array_equal(once.state.avatar["x"], twice.state.avatar["x"])
    assert once.notes == twice.notes


def turned_astronaut() -> np.ndarray:
    return np.ascontiguousarray(skimage.data.astronaut()[:256, 90:346][::-1, ::-1])


def test_an_upside_down_face_is_known_as_such():
    """The detector takes it for an upright one; the landmarks must be those of the turned photo."""
    upright = find_faces(np.ascontiguousarray(turned_astronaut()[::-1, ::-1]))[0]
    turned = find_faces(turned_astronaut())[0]
    assert abs(upright.roll) < 20 and abs(turned.roll) > 160
    assert np.linalg.norm(256 - turned.landmarks - upright.landmarks, axis=1).mean() < 0.03 * upright.size


REFUSED = {
    "black": (np.zeros((128, 128, 3), np.uint8), "no face found"),
    "white": (np.full((128, 128, 3), 255, np.uint8), "no face found"),
    "16 pixels": (skimage.data.astronaut()[:256:16, 90:346:16], "16x16 pixels"),
    "upside down": (turned_astronaut(), "the face is upside down: turn the photo upright"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_portraits_that_cannot_be_fitted_are_refused_in_one_line(case, tmp_path, monkeypatch, capsys):
    """Exit code 2, one line that says what is wrong, nothing left behind."""
    pixels, words = REFUSED[case]
    Image.fromarray(pixels).save(tmp_path / "photo.png")
    out = tmp_path / "avatar"
    monkeypatch.setattr(sys, "argv", ["fit", str(tmp_path / "photo.png"), "--out", str(out)])
    with pytest.raises(SystemExit) as end:
        run_command(main)
    lines = capsys.readouterr().err.strip().splitlines()
    assert end.value.code == 2 and not out.exists()
    assert len(lines) == 1 and lines[0].startswith("error: ") and words in lines[0]


@pytest.mark.slow
def test_a_fit_at_rates_a_thousand_times_too_high_keeps_its_head(tmp_path, capsys):
    """Of a real photo, in the stage that moves the most: it is said, and head and parameters stay finite."""
    settings = tiny_fit(steps=6)
    stage = settings.stages[1]
    fast = replace(stage, rates={name: 1000 * rate for name, rate in stage.rates.items()})
    settings = replace(settings, stages=(fast,))
    prior = load_avatar(PRIOR)
    portrait = read_portrait(FitRequest(None, tmp_path, example=True), settings, prior)
    progress = Progress(initial_state(prior, 0))
    fit_portrait(FitTask(portrait, prior, PRIOR, settings, tmp_path, settings.plan()), progress, 0)
    assert progress.notes and "note: the fit diverged" in capsys.readouterr().err
    assert all(np.isfinite(value).all() for value in progress.state.arrays().values())
    shape = progress.state.parameters(("z_sdf", "deformation"))
    save_avatar(tmp_path / "a.safetensors", prior.with_tensors(**shape))
    head = mi.load_dict({"type": "neural_sdf", "avatar": str(tmp_path / "a.safetensors"), "voxel": 0.16})
    assert np.isfinite(head.vertices()).all()
