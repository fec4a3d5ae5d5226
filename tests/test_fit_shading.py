"""The shading stage: the photo's light determines slopes of the surface."""

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from conftest import camera, slopes
from scipy.ndimage import binary_erosion

from sira_mi.avatar.file import save_avatar
from sira_mi.fit.settings import QUALITIES
from sira_mi.fit.shaded import base_albedo, shade_points
from sira_mi.fit.shading import ShadingStage
from sira_mi.fit.state import FitState
from sira_mi.portrait.portrait import Portrait
from studies.portraits.methods import UnshadowedTask

SIZE = 64
STAGE = next(stage for stage in QUALITIES["standard"].stages if isinstance(stage, ShadingStage))
# Every pixel at every step.
SETTINGS = replace(QUALITIES["draft"], rays=SIZE * SIZE, points=64, voxel=0.1)


@pytest.fixture(scope="module")
def problem(variant, avatar, tmp_path_factory):
    """A head before the photo that eq. 8 makes of it, whose mask leaves out the head's rim: small changes of the head
    leave the same pixels in it. Without shadows: their edges, which no derivative sees, have tests of their own."""
    avatar = avatar.with_tensors(landmarks=np.zeros((468, 3), np.float32))  # the photo has none
    none = np.full((468, 2), np.nan)
    blank = Portrait(
        np.zeros((SIZE, SIZE, 3), np.float32), np.ones((SIZE, SIZE), np.float32), none, none, camera(60, SIZE), ()
    )
    folder = tmp_path_factory.mktemp("shading")
    path, state = folder / "prior.safetensors", FitState.of_avatar(avatar)
    save_avatar(path, avatar)
    head = mi.load_dict({"type": "neural_sdf", "avatar": str(path), "voxel": 0.1})
    task = UnshadowedTask(blank, avatar, path, SETTINGS, folder, SETTINGS.plan())
    points = task.photo_points(blank, head)
    floats = {name: mi.Float(v) for name, v in state.avatar.items()}
    shading = shade_points(avatar, floats, 1.0, points, base_albedo(avatar, floats, points))
    image, mask = np.zeros((SIZE, SIZE, 3), np.float32), np.zeros((SIZE, SIZE), np.float32)
    image[points.row, points.column] = (shading.diffuse + shading.specular).numpy().T
    mask[points.row, points.column] = 1
    mask = binary_erosion(mask > 0, iterations=3).astype(np.float32)
    task.portrait = replace(blank, image=image, mask=mask)
    return STAGE.problem(task, state)


@pytest.mark.slow
def test_the_colour_is_that_of_eq_8(problem):
    """Of the photo's own head it vanishes, whatever the pose was: the camera has taken it up."""
    state = replace(FitState.of_avatar(problem.scene.avatar), pose=np.full(6, 0.3, np.float32))
    problem.refresh(state)
    terms = problem.losses({}, 0, np.random.default_rng(0))
    assert float(terms["color"].numpy().item()) < 2e-3
    problem.refresh(state.with_parameters({"z_l": state.avatar["z_l"] + 1}))
    assert float(problem.losses({}, 0, np.random.default_rng(0))["color"].numpy().item()) > 1e-2


@pytest.mark.slow
@pytest.mark.parametrize("name", STAGE.rates)
def test_the_derivative_of_the_colour_is_a_difference(problem, name):
    """Of every tensor that the stage moves; off the photo's own head, where the loss has a kink."""
    state = FitState.of_avatar(problem.scene.avatar)
    rng = np.random.default_rng(1)
    own = state.avatar[name]
    start = own * (1 + 0.1 * rng.standard_normal(own.shape)).astype(np.float32)

    def color(value: np.ndarray):
        problem.refresh(state.with_parameters({name: value}))
        variable = mi.Float(value)
        dr.enable_grad(variable)
        return problem.losses({name: variable}, 0, np.random.default_rng(0))["color"], variable

    loss, variable = color(start)
    dr.backward(loss)
    slope, difference = slopes(lambda v: color(v)[0].numpy().item(), start, dr.grad(variable).numpy(), change=0.05)
    assert slope == pytest.approx(difference, rel=0.03)
