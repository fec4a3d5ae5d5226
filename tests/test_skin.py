"""The skin of a photo: how bright it is, what that says of the skin itself, and that geometry does not depend on it."""

import dataclasses

import mitsuba as mi
import numpy as np
import pytest
from conftest import camera

from sira_mi.fit.fit import initial_tensors
from sira_mi.fit.settings import QUALITIES
from sira_mi.models.af_sm import AppearanceTraining
from sira_mi.models.avatar import PRIOR, load_avatar
from sira_mi.models.skin_tone import SKIN_LANDMARKS
from sira_mi.portrait.portrait import Portrait

SIZE = 64
USUAL = AppearanceTraining().skin_radiance


@pytest.fixture(scope="module")
def portrait():
    """The mean head's landmarks before a camera; grey skin of usual brightness, a darker rest, all foreground."""
    view = camera(focal=100, size=SIZE)
    points = load_avatar(PRIOR).tensors["landmarks"] @ view.world_to_camera[:3, :3].T + view.world_to_camera[:3, 3]
    landmarks = (points @ view.K.T)[:, :2] / points[:, 2:]
    image = np.full((SIZE, SIZE, 3), 0.02, np.float32)
    for column, row in landmarks[list(SKIN_LANDMARKS)]:
        image[int(row) - 2 : int(row) + 3, int(column) - 2 : int(column) + 3] = USUAL
    return Portrait(image, np.ones((SIZE, SIZE), np.float32), landmarks, view, ())


def darker(portrait: Portrait, factor: float) -> Portrait:
    return dataclasses.replace(portrait, image=portrait.image / np.float32(factor))


def test_exposure_brings_the_skin_to_that_of_the_training(variant, portrait):
    """Whatever the rest of the photo; bounded, and 1 where no skin is seen."""
    from sira_mi.fit.skin import face_exposure, skin_radiance

    assert skin_radiance(portrait) == pytest.approx(USUAL, rel=1e-5)
    assert face_exposure(darker(portrait, 4)) == pytest.approx(4, rel=1e-5)
    assert face_exposure(darker(portrait, 0.8)) == pytest.approx(0.8, rel=1e-5)
    assert face_exposure(darker(portrait, 1e4)) == 16 and face_exposure(darker(portrait, 0.1)) == 0.5
    nowhere = dataclasses.replace(portrait, landmarks=np.full((468, 2), np.nan))
    behind = dataclasses.replace(portrait, mask=np.zeros_like(portrait.mask))
    for blind in (nowhere, behind):
        assert skin_radiance(blind) is None and face_exposure(blind) == 1


def test_a_share_of_the_darkness_is_put_down_to_the_skin(variant, portrait):
    """Of dark skin: with share 1 skin as dark as in the photo is expected, with 0 that of usual photos. Skin that is
    brighter than usual is lighter skin."""
    from sira_mi.fit.shaded import photo_points
    from sira_mi.fit.skin import skin_patches

    prior = load_avatar(PRIOR)
    head = mi.load_dict({"type": "neural_sdf", "avatar": str(PRIOR), "voxel": 0.1})
    points = photo_points(portrait, head, shadows=False)
    floats = {name: mi.Float(value) for name, value in prior.tensors.items() if value.ndim == 1}

    def loss(photo: Portrait, share: float) -> float:
        return skin_patches(photo, points).loss(prior, floats, share).numpy().item()

    dark = darker(portrait, 8)
    assert len(skin_patches(portrait, points).points.row) > 6
    assert loss(dark, 0.0) == pytest.approx(loss(portrait, 1.0), rel=1e-5)
    assert loss(dark, 0.0) < loss(dark, 0.3) < loss(dark, 1.0)
    bright = darker(portrait, 0.5)
    assert loss(bright, 0.0) == loss(bright, 1.0) != loss(portrait, 1.0)
    off = dataclasses.replace(portrait, landmarks=portrait.landmarks + 1000)
    assert skin_patches(off, points) is None


def test_geometry_does_not_depend_on_the_exposure(variant, portrait):
    """A photo a quarter as bright has the same losses: the learned radiance starts a quarter as bright, and both are
    compared at the exposure of the training. An untrained rendering function is left alone."""
    from sira_mi.fit.geometry import GeometryProblem

    prior = load_avatar(PRIOR)
    settings = dataclasses.replace(QUALITIES["draft"], rays=256, points=64, voxel=0.16)
    stage = settings.stages[0][1]

    def losses(photo: Portrait) -> dict[str, float]:
        problem = GeometryProblem(photo, prior, str(PRIOR), settings)
        tensors = initial_tensors(prior, 0)
        tensors |= problem.start(stage, tensors)
        problem.refresh(tensors)
        moved = {name: mi.Float(tensors[name]) for name in stage.rates}
        terms = problem.losses(moved, stage, 0, np.random.default_rng(0))
        return {name: value.numpy().item() for name, value in terms.items()}

    usual, dark = losses(portrait), losses(darker(portrait, 4))
    assert usual["color"] > 1e-3
    assert dark == pytest.approx(usual, rel=1e-3)
    untrained = dataclasses.replace(stage, rates={**stage.rates, "rendering": 1e-3})
    settings = dataclasses.replace(settings, stages=(("geometry", untrained),))
    problem = GeometryProblem(darker(portrait, 4), prior, str(PRIOR), settings)
    tensors = initial_tensors(prior, 0)
    assert np.array_equal(problem.start(untrained, tensors)["rendering"], tensors["rendering"])
