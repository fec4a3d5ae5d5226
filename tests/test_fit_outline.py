"""The fitted outline is the photo's: the mask loss has its minimum there, and its derivative is that of its values."""

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from conftest import camera

from sira_mi.fit.geometry import GeometryProblem, GeometryScene
from sira_mi.fit.settings import QUALITIES
from sira_mi.fit.shaded import find_surface_points
from sira_mi.fit.state import FitState
from sira_mi.portrait.portrait import Portrait


@pytest.mark.slow
@pytest.mark.parametrize("sharpness", [30.0, 60.0, 240.0])
def test_the_derivative_of_the_mask_loss_is_that_of_its_values(variant, avatar, avatar_path, sharpness):
    """A head before its own photo, moved along the line of sight: the integral of AD's derivative is the change of the
    loss, on both sides of the outline, and the head comes to rest where it stands. IDR's loss leaves out rays that hit
    inside the mask: which rays these are, no derivative sees, and the integral is off by up to twice the change."""
    size = 160
    view = camera(focal=150, size=size)
    avatar = avatar.with_tensors(landmarks=np.zeros((468, 3), np.float32))  # the photo has none
    head = mi.load_dict({"type": "neural_sdf", "avatar": avatar_path, "voxel": 0.1})
    seen = find_surface_points(view, head)
    mask = np.zeros((size, size), np.float32)
    mask[seen.row, seen.column] = 1
    assert 0.1 < mask.mean() < 0.6 and not mask[0].any()
    photo = Portrait(np.full((size, size, 3), 0.2, np.float32), mask, np.full((468, 2), np.nan), None, view, ())
    settings = replace(QUALITIES["draft"], rays=size * size, points=64, voxel=0.1)
    photo = replace(photo, head_landmarks=photo.landmarks)
    stage = replace(settings.stages[0], mask_sharpness=sharpness)
    problem = GeometryProblem(stage, GeometryScene(photo, avatar, avatar_path, settings, exposure=1.0))

    def loss(z: float) -> tuple[float, float]:
        state = replace(FitState.of_avatar(avatar), pose=np.array([0, 0, 0, 0, 0, z], np.float32))
        problem.refresh(state)
        variables = {name: mi.Float(value) for name, value in state.parameters(stage.rates).items()}
        dr.enable_grad(variables["pose"])
        result = problem.losses(variables, 0, np.random.default_rng(0))["mask"]
        dr.backward(result)
        return result.numpy().item(), dr.grad(variables["pose"]).numpy()[5]

    z = np.linspace(-0.1, 0.1, 11)
    values, slopes = np.transpose([loss(v) for v in z])
    for half in (slice(0, 6), slice(5, 11)):
        assert np.trapezoid(slopes[half], z[half]) == pytest.approx(values[half][-1] - values[half][0], rel=0.02)
    assert abs(np.interp(0.0, slopes, z)) < 0.03
