"""A photo's skin: its brightness, what that says of its albedo, and that the geometry does not depend on it."""

import dataclasses

import mitsuba as mi
import numpy as np
import pytest
from conftest import camera

from sira_mi.avatar.file import PRIOR, load_avatar
from sira_mi.conventions import LUMINANCE
from sira_mi.fit.settings import QUALITIES
from sira_mi.fit.stage import FitTask
from sira_mi.fit.state import FitState, initial_state
from sira_mi.portrait.portrait import Portrait
from studies.portraits.methods import UntrainedRadianceTask

SIZE = 128
EYES = (33, 246, 161, 160, 159, 158, 157, 173, 133, 155, 154, 153, 145, 144, 163, 7)  # around the right one
LEFT_EYE = (263, 466, 388, 387, 386, 385, 384, 398, 362, 382, 381, 380, 374, 373, 390, 249)
PRIOR_HEAD = load_avatar(PRIOR)
USUAL = PRIOR_HEAD.skin_prior().radiance


@pytest.fixture(scope="module")
def portrait():
    """The mean head's landmarks before a camera; a grey face of usual brightness, one eye twice as bright, the rest
    darker, all foreground."""
    view = camera(focal=200, size=SIZE)
    points = load_avatar(PRIOR).tensors["landmarks"] @ view.world_to_camera[:3, :3].T + view.world_to_camera[:3, 3]
    landmarks = (points @ view.K.T)[:, :2] / points[:, 2:]
    image = np.full((SIZE, SIZE, 3), 0.02, np.float32)
    left, top, right, bottom = (int(v) for v in (*np.nanmin(landmarks, axis=0), *np.nanmax(landmarks, axis=0)))
    image[top : bottom + 1, left : right + 1] = USUAL
    for column, row in landmarks[list(EYES)]:
        image[int(row) - 1 : int(row) + 2, int(column) - 1 : int(column) + 2] = 2 * USUAL
    return Portrait(image, np.ones((SIZE, SIZE), np.float32), landmarks, landmarks, view, ())


def darker(portrait: Portrait, factor: float) -> Portrait:
    return dataclasses.replace(portrait, image=portrait.image / np.float32(factor))


def test_exposure_brings_the_skin_to_that_of_the_training(variant, portrait):
    """Whatever the rest of the photo; bounded, and 1 where no skin is seen."""
    from sira_mi.fit.skin import face_exposure, find_skin_cues

    assert find_skin_cues(portrait).radiance == pytest.approx(USUAL, rel=1e-5)
    assert face_exposure(darker(portrait, 4), PRIOR_HEAD) == pytest.approx(4, rel=1e-5)
    assert face_exposure(darker(portrait, 0.8), PRIOR_HEAD) == pytest.approx(0.8, rel=1e-5)
    assert face_exposure(darker(portrait, 1e4), PRIOR_HEAD) == 16
    assert face_exposure(darker(portrait, 0.1), PRIOR_HEAD) == 0.5
    for blind in blind_portraits(portrait):
        assert find_skin_cues(blind) is None and face_exposure(blind, PRIOR_HEAD) == 1


def blind_portraits(portrait: Portrait) -> tuple[Portrait, Portrait]:
    """Without landmarks, and without a person at them."""
    nowhere = dataclasses.replace(portrait, landmarks=np.full((468, 2), np.nan))
    return nowhere, dataclasses.replace(portrait, mask=np.zeros_like(portrait.mask))


def test_the_white_of_the_eyes_tells_light_from_skin(variant, portrait):
    """The ratio of skin to eyes does not depend on the exposure; where eyes are as bright, skin is light. An eye that
    is not seen does not count; without any, brightness alone tells. Dark glasses do not make skin white."""
    from sira_mi.fit.skin import Eye, SkinCues, find_skin_cues, skin_luminance

    landmarks = portrait.landmarks.copy()
    landmarks[list(LEFT_EYE)] = np.nan
    one = dataclasses.replace(portrait, landmarks=landmarks)
    for factor in (1, 4):
        (eye,) = find_skin_cues(darker(one, factor)).eyes
        assert eye.contrast == pytest.approx(-np.log(2), abs=1e-5)
        assert eye.white == pytest.approx(np.log(2 * USUAL / factor), abs=1e-5)
    eyeless = portrait.landmarks.copy()
    eyeless[[*EYES, *LEFT_EYE]] = np.nan
    blind = find_skin_cues(dataclasses.replace(portrait, landmarks=eyeless))
    assert blind.eyes == () and blind.radiance == pytest.approx(USUAL, rel=1e-5)
    levels = [skin_luminance(SkinCues(0.2, (Eye(contrast, -1),))) for contrast in (-1.5, -0.7, 0.0)]
    assert 0.07 < levels[0] < levels[1] < levels[2] < 0.45
    assert levels[0] < skin_luminance(SkinCues(0.2, ())) < levels[2]
    sunglasses = dataclasses.replace(one, image=np.where(one.image > USUAL * 1.01, 0, one.image))
    assert skin_luminance(find_skin_cues(sunglasses)) < 0.45
    assert skin_luminance(SkinCues(1e-3, (Eye(-6.0, -1),))) > 0.06


def test_an_eye_that_misleads_hardly_counts(variant):
    """Two eyes that agree tell more than one; of two that do not, the one in the brighter light does."""
    from sira_mi.fit.skin import Eye, SkinCues, skin_luminance

    def level(*eyes: Eye) -> float:
        return float(np.log(skin_luminance(SkinCues(0.1, eyes))))

    lit, shaded = Eye(-0.2, -1.0), Eye(-1.7, -2.5)
    assert abs(level(lit, shaded) - level(lit)) < 0.1 < abs(level(lit, shaded) - level(shaded))
    assert level(lit, shaded) == pytest.approx(level(shaded, lit), abs=1e-12)
    usual = level()
    assert abs(level(lit, lit) - usual) > abs(level(lit) - usual)


@pytest.mark.slow
def test_skin_is_expected_as_light_as_its_cues_say(variant, portrait):
    """The loss is lowest where the albedo at the landmarks has the expected luminance."""
    from sira_mi.fit.shaded import base_albedo, find_masked_points
    from sira_mi.fit.skin import find_skin_cues, find_skin_patches, skin_luminance

    prior = load_avatar(PRIOR)
    head = mi.load_dict({"type": "neural_sdf", "avatar": str(PRIOR), "voxel": 0.1})
    points = find_masked_points(portrait, head)
    floats = {name: mi.Float(value) for name, value in FitState.of_avatar(prior).avatar.items()}
    patches = find_skin_patches(portrait, points)
    assert len(patches.points.row) > 6
    assert patches.luminance == skin_luminance(find_skin_cues(portrait))
    shown = float((base_albedo(prior, floats, patches.points).numpy().mean(axis=1) @ np.array(LUMINANCE)).item())
    levels = np.array([0.3, 0.6, 1.0, 1.6, 3.0])
    losses = [
        dataclasses.replace(patches, luminance=shown * level).loss(prior, floats).numpy().item() for level in levels
    ]
    assert np.argmin(losses) == 2 and np.all(np.diff(losses[:3]) < 0) and np.all(np.diff(losses[2:]) > 0)
    off = dataclasses.replace(portrait, landmarks=portrait.landmarks + 1000)
    assert find_skin_patches(off, points) is None


@pytest.mark.slow
def test_geometry_does_not_depend_on_the_exposure(variant, portrait, tmp_path):
    """A photo a quarter as bright has the same losses: the learned radiance starts a quarter as bright, and both are
    compared at the exposure of the training. An untrained rendering network is left alone."""
    prior, state = load_avatar(PRIOR), initial_state(load_avatar(PRIOR), 0)
    settings = dataclasses.replace(QUALITIES["draft"], rays=256, points=64, voxel=0.16)
    stage = settings.stages[0]

    def losses(photo: Portrait) -> dict[str, float]:
        problem = stage.problem(FitTask(photo, prior, PRIOR, settings, tmp_path, settings.plan()), state)
        started = problem.start(state)
        problem.refresh(started)
        moved = {name: mi.Float(value) for name, value in started.parameters(stage.rates).items()}
        return {k: v.numpy().item() for k, v in problem.losses(moved, 0, np.random.default_rng(0)).items()}

    usual, dark = losses(portrait), losses(darker(portrait, 4))
    assert usual["color"] > 1e-3
    assert dark == pytest.approx(usual, rel=1e-3)
    untrained = UntrainedRadianceTask(darker(portrait, 4), prior, PRIOR, settings, tmp_path, settings.plan())
    started = stage.problem(untrained, state).start(state)
    assert np.array_equal(started.avatar["rendering"], state.avatar["rendering"])
