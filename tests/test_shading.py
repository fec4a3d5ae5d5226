"""The shading stage: slopes that the photo's light tells."""

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from conftest import camera, slopes
from scipy.ndimage import binary_erosion

from sira_mi.fit.fit import initial_tensors
from sira_mi.fit.settings import QUALITIES, SHADING
from sira_mi.fit.shaded import base_albedo, photo_points, shade_points
from sira_mi.fit.shading import ShadingProblem
from sira_mi.portrait.portrait import Portrait

SIZE = 64
STAGE = next(stage for kind, stage in QUALITIES["standard"].stages if kind == SHADING)
# Every pixel at every step; shadows, whose edges no derivative sees, have tests of their own.
SETTINGS = replace(QUALITIES["draft"], rays=SIZE * SIZE, points=64, voxel=0.1, learned_radiance=False, shadows=False)


@pytest.fixture(scope="module")
def problem(variant, avatar, avatar_path):
    """A head before the photo that eq. 8 makes of it, whose mask leaves out the head's rim: small changes of the head
    leave the same pixels in it."""
    avatar = avatar.replaced(landmarks=np.zeros((468, 3), np.float32))  # the photo has none
    none = np.full((468, 2), np.nan)
    blank = Portrait(
        np.zeros((SIZE, SIZE, 3), np.float32), np.ones((SIZE, SIZE), np.float32), none, none, camera(60, SIZE), ()
    )
    head = mi.load_dict({"type": "neural_sdf", "avatar": avatar_path, "voxel": 0.1})
    points = photo_points(blank, head, shadows=False)
    floats = {name: mi.Float(v) for name, v in tensors_of(avatar).items() if v.ndim == 1}
    shading = shade_points(avatar, floats, 1.0, points, base_albedo(avatar, floats, points))
    image, mask = np.zeros((SIZE, SIZE, 3), np.float32), np.zeros((SIZE, SIZE), np.float32)
    image[points.row, points.column] = (shading.diffuse + shading.specular).numpy().T
    mask[points.row, points.column] = 1
    mask = binary_erosion(mask > 0, iterations=3).astype(np.float32)
    return ShadingProblem(replace(blank, image=image, mask=mask), avatar, avatar_path, SETTINGS)


def tensors_of(avatar) -> dict:
    own = {name: avatar.tensors[name] for name in ("z_sdf", "z_r", "z_a", "z_s", "z_l") if name in avatar.tensors}
    return initial_tensors(avatar, 0) | own


@pytest.mark.slow
def test_the_colour_is_that_of_eq_8(problem):
    """Of the photo's own head it vanishes, whatever the pose was: the camera has taken it up."""
    tensors = tensors_of(problem.avatar) | {"pose": np.full(6, 0.3, np.float32)}
    problem.refresh(tensors)
    terms = problem.losses({}, STAGE, 0, np.random.default_rng(0))
    assert float(terms["color"].numpy().item()) < 2e-3
    darker = tensors | {"z_l": tensors["z_l"] + 1}
    problem.refresh(darker)
    assert float(problem.losses({}, STAGE, 0, np.random.default_rng(0))["color"].numpy().item()) > 1e-2


@pytest.mark.slow
@pytest.mark.parametrize("name", STAGE.rates)
def test_the_derivative_of_the_colour_is_a_difference(problem, name):
    """Of every tensor that the stage moves; off the photo's own head, where the loss has a kink."""
    tensors = tensors_of(problem.avatar)
    rng = np.random.default_rng(1)
    start = tensors[name] * (1 + 0.1 * rng.standard_normal(tensors[name].shape)).astype(np.float32)

    def color(value: np.ndarray):
        problem.refresh(tensors | {name: value})
        variable = mi.Float(value)
        dr.enable_grad(variable)
        return problem.losses({name: variable}, STAGE, 0, np.random.default_rng(0))["color"], variable

    loss, variable = color(start)
    dr.backward(loss)
    slope, difference = slopes(lambda v: color(v)[0].numpy().item(), start, dr.grad(variable).numpy(), change=0.05)
    assert slope == pytest.approx(difference, rel=0.03)
