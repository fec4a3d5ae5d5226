"""Landmarks: the correction of those that the network finds in a photo, and their places on a prior's head."""

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from conftest import SMALL, one_line, small_avatar
from safetensors.numpy import load_file, save_file

from sira_mi.avatar.file import load_avatar, save_avatar
from sira_mi.avatar.landmark_model import LandmarkModel
from sira_mi.conventions import LANDMARKS
from sira_mi.errors import InputError
from sira_mi.portrait.face import Face
from sira_mi.portrait.head_landmarks import (
    LandmarkCorrection,
    correct_landmarks,
    find_upright_axes,
    find_view_direction,
    load_shipped_correction,
)
from studies.head_landmarks import landmarks_of
from studies.portraits.measure_landmarks import Observation, align_face, fit_correction, measure_held_out_errors
from studies.priors import fit_landmark_model
from studies.priors.landmark_regression import landmark_tensors

MEAN = np.random.default_rng(11).uniform(-0.5, 0.5, (LANDMARKS, 3))
MEAN[[33, 263]] = (-0.2, -0.1, -0.2), (0.2, -0.1, -0.2)


def turned(yaw: float, pitch: float, roll: float, size: float = 150.0) -> Face:
    """The mean face, turned about its y axis, then its x axis, then in the photo; radians."""
    about_y = np.array([[np.cos(yaw), 0, np.sin(yaw)], [0, 1, 0], [-np.sin(yaw), 0, np.cos(yaw)]])
    about_x = np.array([[1, 0, 0], [0, np.cos(pitch), -np.sin(pitch)], [0, np.sin(pitch), np.cos(pitch)]])
    about_z = np.array([[np.cos(roll), -np.sin(roll), 0], [np.sin(roll), np.cos(roll), 0], [0, 0, 1]])
    points = size * MEAN @ (about_z @ about_x @ about_y).T + [200, 220, 0]
    return Face(points[:, :2], points[:, 2], 1.0)


def observations(count: int, seed: int) -> list[Observation]:
    """Turned faces whose network errs by a bias and in proportion to the turn; a few landmarks are unknown."""
    rng = np.random.default_rng(12)
    bias, by_yaw, by_pitch = 0.02 * rng.standard_normal((3, LANDMARKS, 2)) * np.array([1, 3, 3])[:, None, None]
    rng = np.random.default_rng(seed)
    result = []
    for k in range(count):
        yaw, pitch, roll = rng.uniform(-0.7, 0.7), rng.uniform(-0.2, 0.2), rng.uniform(-1, 1)
        face = turned(yaw, pitch, roll)
        angle = np.radians(face.roll)
        axes = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        true = face.landmarks + face.size * (bias + yaw * by_yaw + pitch * by_pitch) @ axes
        true[rng.integers(LANDMARKS, size=5)] = np.nan
        result.append(Observation(f"head {k // 2}", face, true))
    return result


@pytest.mark.parametrize("roll", (-2.5, 0.0, 1.2))
def test_a_face_is_seen_from_where_it_was_turned(roll):
    """However the photo is rolled and whatever its size; the alignment takes the turn back."""
    for yaw, pitch in ((0.0, 0.0), (0.6, 0.0), (-0.4, 0.0), (0.0, 0.3)):
        face = turned(yaw, pitch, roll, size=90.0)
        np.testing.assert_allclose(find_view_direction(face, MEAN), [-yaw, pitch], atol=1e-9)
        back = align_face(face, MEAN)
        np.testing.assert_allclose(back * face.size / 90, MEAN - MEAN.mean(axis=0), atol=1e-9)


def test_the_correction_turns_and_grows_with_the_photo(face):
    """Of the photo turned by a quarter and enlarged, the corrected landmarks are the turned, enlarged ones."""
    moved = Face(face.landmarks @ np.array([[0, 3.0], [-3.0, 0]]) + [1600, 20], 3 * face.depth, face.presence)
    expected = correct_landmarks(face) @ np.array([[0, 3.0], [-3.0, 0]]) + [1600, 20]
    np.testing.assert_allclose(correct_landmarks(moved), expected, atol=0.02 * moved.size)


@pytest.mark.slow
def test_errors_that_follow_from_the_direction_are_learned():
    """They are gone on other heads; beyond what was measured the correction stays where it was."""
    known = observations(200, seed=1)
    correction = fit_correction(known)
    for o in observations(20, seed=2):
        left = np.nanmean(np.linalg.norm(correct_landmarks(o.face, correction) - o.true, axis=1))
        assert left < 0.15 * np.nanmean(np.linalg.norm(o.face.landmarks - o.true, axis=1))
    found, corrected = measure_held_out_errors(known)
    assert corrected < 0.15 * found
    assert found == pytest.approx(np.mean([np.nanmean(np.linalg.norm(o.offset, axis=1)) for o in known]))
    near, far = (turned(yaw, 0, 0) for yaw in (0.8, 2.0))
    near, far = (
        (correct_landmarks(f, correction) - f.landmarks) @ find_upright_axes(f).T / f.size for f in (near, far)
    )
    assert np.abs(far - near).mean() < 0.02 < 0.04 < np.abs(near).mean()
    with pytest.raises(InputError) as error:
        measure_held_out_errors(known[:8])
    one_line(error, "4 heads")


def test_the_shipped_correction_moves_a_real_face_a_little(face):
    """By less than the network errs on rendered heads; its eyes, which the photo shows, stay."""
    offset = np.linalg.norm(correct_landmarks(face) - face.landmarks, axis=1) / face.size
    assert 0.002 < offset.mean() < 0.02 and offset.max() < 0.1
    assert offset[[33, 133, 362, 263]].max() < 0.008


def test_a_damaged_correction_is_refused(tmp_path):
    path = tmp_path / "head_landmarks.safetensors"
    load_shipped_correction().save(path)
    again = LandmarkCorrection.load(path)
    np.testing.assert_allclose(again.offsets, load_shipped_correction().offsets)
    arrays = load_file(path)
    for name, values in (("mean", np.zeros((5, 3), np.float32)), ("offsets", arrays["offsets"] * np.float32(np.nan))):
        save_file(arrays | {name: values}, tmp_path / "bad.safetensors")
        with pytest.raises(InputError) as error:
            LandmarkCorrection.load(tmp_path / "bad.safetensors")
        one_line(error, name)
    path.write_bytes(path.read_bytes()[:50])
    for missing in (path, tmp_path / "none"):
        with pytest.raises(InputError) as error:
            LandmarkCorrection.load(missing)
        one_line(error, str(missing))


@pytest.fixture(scope="module")
def prior():
    """A small prior whose mean head knows all landmarks but two."""
    rng = np.random.default_rng(3)
    landmarks = rng.uniform(-1, 1, (LANDMARKS, 3)).astype(np.float32)
    landmarks[[5, 100]] = np.nan
    avatar = small_avatar()
    return avatar.with_tensors(landmarks=landmarks, **{name: 0 * avatar.tensors[name] for name in SMALL.latents})


@pytest.fixture(scope="module")
def found(prior):
    """Places of heads in three directions, and true landmarks that are linear in them."""
    rng = np.random.default_rng(4)
    w = rng.standard_normal((60, 3))
    placed = prior.tensors["landmarks"] + np.tensordot(w, 0.2 * rng.standard_normal((3, LANDMARKS, 3)), axes=1)
    true = prior.tensors["landmarks"] + np.tensordot(w, 0.2 * rng.standard_normal((3, LANDMARKS, 3)), axes=1)
    true -= true.mean(axis=0) - prior.tensors["landmarks"]
    true[4, 7] = np.nan
    return fit_landmark_model.Places(placed.astype(np.float32), true.astype(np.float32))


@pytest.mark.slow
def test_a_prior_learns_where_its_heads_carry_landmarks(prior, found, tmp_path):
    """A linear relation is found, kept in the prior's file, and holds on heads left out; without it, places stay."""
    learned = fit_landmark_model.add_landmark_model(prior, found)
    save_avatar(tmp_path / "prior.safetensors", learned)
    learned = load_avatar(tmp_path / "prior.safetensors")
    known = np.isfinite(prior.tensors["landmarks"]).all(axis=1)
    placed = mi.TensorXf(np.ascontiguousarray(found.placed[9, known].T))
    error = np.linalg.norm(LandmarkModel(learned)(placed).numpy().T - found.true[9, known], axis=1)
    assert error.mean() < 0.05 * np.linalg.norm(found.placed[9, known] - found.true[9, known], axis=1).mean()
    assert np.array_equal(LandmarkModel(prior)(placed).numpy(), placed.numpy())
    before, after = fit_landmark_model.measure_held_out_errors(prior, found)
    assert after < 0.1 * before
    assert fit_landmark_model.without_landmark_model(learned).tensors.keys() == prior.tensors.keys()
    with pytest.raises(InputError) as few:
        fit_landmark_model.measure_held_out_errors(prior, fit_landmark_model.Places(found.placed[:3], found.true[:3]))
    one_line(few, "3 training heads")


def test_damaged_landmark_models_are_refused(prior, found, tmp_path):
    tensors = landmark_tensors(prior, found.placed, found.true)
    path = tmp_path / "prior.safetensors"
    for name, values in tensors.items():
        save_avatar(path, prior.with_tensors(**{**tensors, name: values[:0]}))
        with pytest.raises(InputError) as error:
            load_avatar(path)
        one_line(error, "damaged")
        save_avatar(path, prior.with_tensors(**{k: v for k, v in tensors.items() if k != name}))
        with pytest.raises(InputError) as error:
            load_avatar(path)
        one_line(error, name)


def test_landmarks_of_a_head_lie_where_its_field_has_the_mean_heads(prior):
    """At zero latents they are the mean head's; at others the deformation takes both to one place in reference
    space."""
    from sira_mi.fields.sdf import deform
    from sira_mi.training.shape_model import ShapeModel

    model = ShapeModel.of_prior(prior)
    zero = np.zeros(SMALL.sdf_latent, np.float32)
    known = np.isfinite(prior.tensors["landmarks"]).all(axis=1)
    landmarks = landmarks_of(prior, model.field(zero))
    np.testing.assert_allclose(landmarks[known], prior.tensors["landmarks"][known], atol=1e-3)
    assert np.isnan(landmarks[~known]).all()
    other = model.field(np.full(SMALL.sdf_latent, 0.3, np.float32))
    at_other = mi.TensorXf(np.ascontiguousarray(landmarks_of(prior, other)[known].T))
    at_mean = mi.TensorXf(np.ascontiguousarray(prior.tensors["landmarks"][known].T))
    there, here = deform(other, at_other)[0].numpy(), deform(model.field(zero), at_mean)[0].numpy()
    assert np.abs(there - here).max() < 0.1 * np.abs(deform(other, at_mean)[0].numpy() - here).max()


def test_the_reprojection_error_falls_along_its_derivative(prior, found, tmp_path):
    """AD through placing, landmark model, pose and camera against central differences."""
    from conftest import camera, slopes

    from sira_mi.fit.geometry import GeometryProblem, GeometryScene, GeometryStage
    from sira_mi.fit.settings import QUALITIES
    from sira_mi.fit.state import initial_state
    from sira_mi.portrait.portrait import Portrait

    learned = fit_landmark_model.add_landmark_model(prior, found)
    path = tmp_path / "prior.safetensors"
    save_avatar(path, learned)
    view = camera(focal=70, size=64)
    pixels = view.project(np.nan_to_num(prior.tensors["landmarks"])) + np.array([3.0, -2.0])
    pixels[50] = np.nan
    grey, whole = np.full((64, 64, 3), 0.2, np.float32), np.ones((64, 64), np.float32)
    settings = QUALITIES["draft"]
    scene = GeometryScene(Portrait(grey, whole, pixels, pixels, view, ()), learned, path, settings, exposure=1.0)
    stage, found = settings.stages[0], scene.landmarks
    assert isinstance(stage, GeometryStage) and found is not None
    problem = GeometryProblem(stage, scene)
    state = replace(initial_state(learned, 0), pose=np.array([0.1, -0.2, 0.05, 0.1, -0.1, 0.2], np.float32))
    problem.refresh(state)
    start = state.parameters(("pose", "z_sdf", "deformation", "reference"))
    for name in ("pose", "z_sdf"):

        def loss(value, name=name):
            values = {k: mi.Float(v) for k, v in start.items()}
            values[name] = mi.Float(value)
            dr.enable_grad(values[name])
            return problem._landmark_loss(problem._field(values), found), values[name]

        result, value = loss(start[name])
        dr.backward(result)
        gradient = dr.grad(value).numpy()
        assert np.isfinite(gradient).all() and np.abs(gradient).max() > 0
        slope, difference = slopes(lambda v: loss(v)[0].numpy().item(), start[name], gradient, 0.02)
        assert slope == pytest.approx(difference, rel=0.05)
