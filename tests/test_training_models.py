"""Losses equal their definitions, checkpoints of the optimiser continue, both models train on two small scenes, and
the prior is assembled from them."""

import dataclasses
import json

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from conftest import SMALL

from sira_mi.avatar.shape import head_of
from sira_mi.errors import InputError
from sira_mi.fields.mlp import evaluate, layers
from sira_mi.optimisation import losses
from sira_mi.optimisation.adam import (
    adam,
    optimizer_state,
    parameter_values,
    read_arrays,
    restore_optimizer,
    write_arrays,
)
from sira_mi.training import af_sm, sa_sm
from sira_mi.training.loop import run_training
from sira_mi.training.prior import assemble_prior, whiten, whitening
from sira_mi.training.scenes import TrainingScene, load_scene, load_training_scenes


def number(tensor) -> float:
    return float(tensor.numpy().item())


def random(*shape, seed=0) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal(shape).astype(np.float32)


# Losses


def test_deformation_loss_is_equation_5():
    scenes, n = 3, 7
    delta = random(3, scenes * n)
    expected = 0.0
    for k in range(scenes):
        mine = delta[:, k * n : (k + 1) * n].astype(np.float64)
        expected += (np.linalg.norm(mine, axis=0).sum() + np.linalg.norm(mine.sum(axis=1))) / n
    assert number(losses.deformation_loss(mi.TensorXf(delta), scenes)) == pytest.approx(expected / scenes, rel=1e-5)


def test_landmark_loss_is_the_sum_over_pairs_of_scenes():
    """Section 3.1.2 as written, divided by the numbers of landmarks and of pairs (i, j), i = j included."""
    scenes, count = 4, 5
    x = random(3, scenes * count).astype(np.float64)
    total = 0.0
    for i in range(scenes):
        for j in range(scenes):
            a, b = x[:, i * count : (i + 1) * count], x[:, j * count : (j + 1) * count]
            total += ((a - b) ** 2).sum()
    expected = total / (scenes**2 * count)
    assert number(losses.landmark_loss(mi.TensorXf(x.astype(np.float32)), scenes)) == pytest.approx(expected, rel=1e-5)


def test_other_losses_against_numpy():
    g, n, f, d = random(3, 9), random(3, 9, seed=1), random(1, 9, seed=2), random(1, 9, seed=3)
    cases = [
        (losses.eikonal_loss(mi.TensorXf(g)), ((np.linalg.norm(g, axis=0) - 1) ** 2).mean()),
        (losses.normal_loss(mi.TensorXf(g), mi.TensorXf(n)), np.linalg.norm(g - n, axis=0).mean()),
        (losses.surface_loss(mi.TensorXf(f)), np.abs(f).mean()),
        (losses.distance_loss(mi.TensorXf(f), mi.TensorXf(d)), (np.abs(f - d) / (0.1 + np.abs(d))).mean()),
        (losses.embedding_loss(mi.TensorXf(g)), (g**2).sum(axis=0).mean()),
    ]
    for mine, expected in cases:
        assert number(mine) == pytest.approx(float(expected), rel=1e-4)
    bright, dark = mi.TensorXf([[4.0]]), mi.TensorXf([[-1.0]])
    assert number(losses.photometric_loss(bright, dark)) == pytest.approx(2 - 0.01, abs=1e-3)


@pytest.mark.parametrize("name", ["eikonal_loss", "embedding_loss"])
def test_losses_have_finite_gradients_at_zero(name):
    value = mi.TensorXf(np.zeros((3, 4), np.float32))
    dr.enable_grad(value)
    dr.backward(getattr(losses, name)(value))
    assert np.isfinite(dr.grad(value).numpy()).all()


# Optimiser


def quadratic_step(optimizer, step: int) -> None:
    optimizer.set_learning_rate({"vector": 0.1 / (step + 1), "matrix": 0.05})
    target = mi.Float([1.0, 2.0, 3.0])
    vector, matrix = optimizer["vector"], optimizer["matrix"]
    loss = dr.sum(dr.square(vector - target)) + dr.sum(dr.square(matrix).array * (1.0 + step))
    dr.backward(loss)
    optimizer.step()


@pytest.mark.parametrize("stop", [0, 1, 4])
def test_a_restored_optimiser_continues_to_the_same_bits(tmp_path, stop):
    start = {"vector": np.zeros(3, np.float32), "matrix": random(2, 4)}
    rates = {"vector": 0.1, "matrix": 0.05}
    whole = adam(start, rates)
    for step in range(8):
        quadratic_step(whole, step)
    first = adam(start, rates)
    for step in range(stop):
        quadratic_step(first, step)
    write_arrays(tmp_path / "c", optimizer_state(first), {"step": str(stop)})
    arrays, metadata = read_arrays(tmp_path / "c")
    assert metadata["step"] == str(stop)
    second = adam({name: np.zeros_like(value) for name, value in start.items()}, rates)
    restore_optimizer(second, arrays)
    for step in range(stop, 8):
        quadratic_step(second, step)
    for name, value in parameter_values(whole).items():
        np.testing.assert_array_equal(value, parameter_values(second)[name])
    for name, value in optimizer_state(whole).items():
        np.testing.assert_array_equal(value.ravel(), optimizer_state(second)[name].ravel())


def test_a_state_of_other_parameters_is_refused():
    state = optimizer_state(adam({"a": np.zeros(3, np.float32)}, {"a": 0.1}))
    with pytest.raises(KeyError):
        restore_optimizer(adam({"b": np.zeros(3, np.float32)}, {"b": 0.1}), state)
    with pytest.raises(ValueError, match="size"):
        restore_optimizer(adam({"a": np.zeros(4, np.float32)}, {"a": 0.1}), state)


def test_a_damaged_checkpoint_is_named(tmp_path):
    path = tmp_path / "fit.checkpoint"
    path.write_bytes(b"half a file")
    with pytest.raises(InputError, match=r"fit\.checkpoint"):
        read_arrays(path)


# Training


def ball_scene(radius: float, color, seed: int) -> TrainingScene:
    """A ball of one colour, seen by two cameras, with some landmarks."""
    rng = np.random.default_rng(seed)
    normals = rng.standard_normal((400, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    volume = rng.uniform(-1.8, 1.8, (500, 3))
    landmarks = np.full((468, 3), np.nan)
    landmarks[:40] = radius * normals[np.argsort(-normals[:, 2])][:40]
    view = rng.integers(0, 2, 800)
    return TrainingScene(
        points=(radius * normals).astype(np.float32),
        normals=normals.astype(np.float32),
        region=(normals[:, 1] < 0) * np.uint8(3),
        volume=volume.astype(np.float32),
        volume_distance=(np.linalg.norm(volume, axis=1) - radius).astype(np.float32),
        landmarks=landmarks.astype(np.float32),
        sample_point=rng.integers(0, 400, 800),
        sample_view=view,
        sample_color=np.tile(np.float32(color), (800, 1)),
        camera_centres=np.array([[0, 0, 8], [6, 0, 6]], np.float32),
    )


@pytest.fixture(scope="module")
def two_scenes():
    return [ball_scene(1.2, (0.6, 0.4, 0.3), 1), ball_scene(1.5, (0.3, 0.3, 0.4), 2)]


SHAPE = sa_sm.ShapeTraining(steps=30, surface_points=64, volume_points=32, landmarks=8)
APPEARANCE = af_sm.AppearanceTraining(steps=30, points=64, frozen_points=200)


def train_shape(folder, scenes, settings=SHAPE, until=None):
    initial = sa_sm.initial_shape_model(SMALL, settings, len(scenes), 0)
    optimizer = adam(initial, sa_sm.rates(settings, 0))
    seen = []

    def step(number):
        batch = sa_sm.draw_batch(scenes, settings, np.random.default_rng([0, 2, number]))
        terms = sa_sm.training_step(SMALL, settings, optimizer, batch)
        seen.append(sum(getattr(settings, k) * v for k, v in terms.items()))
        return terms

    return run_training(
        folder, "shape", until or settings.steps, optimizer, lambda k: sa_sm.rates(settings, k), step
    ), seen


@pytest.fixture(scope="module")
def shape(two_scenes, tmp_path_factory):
    return train_shape(tmp_path_factory.mktemp("whole"), two_scenes)


def test_shape_training_lowers_the_loss(shape):
    parameters, seen = shape
    assert np.mean(seen[-5:]) < 0.7 * np.mean(seen[:3])
    assert parameters["z_sdf"].shape == (SMALL.sdf_latent, 2)
    assert all(np.isfinite(v).all() for v in parameters.values())


@pytest.mark.slow
def test_shape_training_resumes_to_the_same_bits(shape, two_scenes, tmp_path):
    train_shape(tmp_path, two_scenes, until=12)
    resumed, seen = train_shape(tmp_path, two_scenes)
    assert len(seen) == 18
    for name, value in shape[0].items():
        np.testing.assert_array_equal(resumed[name], value, err_msg=name)


def test_a_step_of_half_the_scenes_moves_only_their_latents(two_scenes):
    """With one scene a step, the other scene's latent gets no gradient."""
    settings = dataclasses.replace(SHAPE, scenes=1)
    batch = sa_sm.draw_batch(two_scenes, settings, np.random.default_rng(0))
    parameters = {k: adam({k: v}, {k: 1})[k] for k, v in sa_sm.initial_shape_model(SMALL, settings, 2, 0).items()}
    dr.enable_grad(parameters)
    dr.backward(sa_sm.weighted_sum(sa_sm.shape_losses(SMALL, parameters, batch), settings))
    chosen = batch.scenes.numpy()[:, 0].astype(bool)
    for name in sa_sm.LATENTS:
        gradient = dr.grad(parameters[name]).numpy()
        assert np.abs(gradient[:, chosen]).max() > 0 and np.abs(gradient[:, ~chosen]).max() == 0


def test_batches_keep_the_points_of_a_scene_together(two_scenes):
    """Of each scene first its surface points, then its volume points, whose distances fit."""
    batch = sa_sm.draw_batch(two_scenes, SHAPE, np.random.default_rng(3))
    points, n, q = batch.points.numpy().reshape(3, 2, -1), SHAPE.surface_points, SHAPE.volume_points
    assert points.shape == (3, 2, n + q)
    landmarks, distance = batch.landmarks.numpy().reshape(3, 2, -1), batch.volume_distance.numpy().reshape(2, -1)
    for k, radius in enumerate((1.2, 1.5)):
        np.testing.assert_allclose(np.linalg.norm(points[:, k, :n], axis=0), radius, rtol=1e-5)
        np.testing.assert_allclose(np.linalg.norm(landmarks[:, k], axis=0), radius, rtol=1e-5)
        np.testing.assert_allclose(np.linalg.norm(points[:, k, n:], axis=0) - radius, distance[k], atol=1e-5)
    again = sa_sm._columns_of(batch.points, 2, n, n + q).numpy().reshape(3, 2, q)
    np.testing.assert_array_equal(again, points[:, :, n:])
    np.testing.assert_array_equal(batch.scenes.numpy(), np.eye(2))
    assert (np.abs(np.linalg.norm(batch.views.numpy(), axis=0) - 1) < 1e-5).all()
    inward = (batch.views.numpy() * batch.normals.numpy()).sum(axis=0)
    assert inward.min() < 0  # views run from the camera to the point


def train_appearance(folder, scenes, parameters, until=None):
    frozen = [
        af_sm.freeze_scene(SMALL, head_of(parameters, k), scene, APPEARANCE, np.random.default_rng(k))
        for k, scene in enumerate(scenes)
    ]
    initial = af_sm.initial_appearance_model(SMALL, len(scenes), 0)
    optimizer = adam(initial, af_sm.rates(APPEARANCE, 0))
    seen = []

    def step(number):
        batch = af_sm.draw_batch(frozen, APPEARANCE, np.random.default_rng([0, 3, number]))
        terms = af_sm.training_step(SMALL, APPEARANCE, optimizer, batch)
        seen.append(terms["color"])
        return terms

    rates = lambda k: af_sm.rates(APPEARANCE, k)  # noqa: E731
    return run_training(folder, "appearance", until or APPEARANCE.steps, optimizer, rates, step), seen


@pytest.fixture(scope="module")
def appearance(shape, two_scenes, tmp_path_factory):
    return train_appearance(tmp_path_factory.mktemp("whole"), two_scenes, shape[0])


@pytest.mark.slow
def test_appearance_training_lowers_the_loss(appearance):
    parameters, seen = appearance
    assert np.mean(seen[-5:]) < 0.85 * np.mean(seen[:3])
    assert all(np.isfinite(v).all() for v in parameters.values())


def test_the_specular_albedo_is_held_near_the_level_of_its_region(shape, two_scenes):
    """Where the decoder says 0.03 everywhere, the anchor is ln² of the factor that a region's level is off."""
    settings = dataclasses.replace(APPEARANCE, specular_levels=(0.03, 0.02, 0.07, 0.008))
    rng = np.random.default_rng(0)
    frozen = af_sm.freeze_scene(SMALL, head_of(shape[0], 0), two_scenes[0], settings, rng)
    model = af_sm.initial_appearance_model(SMALL, 1, 0)
    model["specular_albedo"] = np.zeros_like(model["specular_albedo"])
    values = {k: mi.TensorXf(v) if v.ndim == 2 else mi.Float(v) for k, v in model.items()}
    batch = af_sm.draw_batch([frozen], settings, np.random.default_rng(0))
    cloth = (batch.specular_level.numpy() == np.float32(0.008)).mean()
    assert 0.2 < cloth < 0.8
    found = af_sm.appearance_losses(SMALL, settings, values, batch)["specular_anchor"].numpy().item()
    assert found == pytest.approx(cloth * np.log(0.03 / 0.008) ** 2, rel=1e-4)


@pytest.mark.slow
def test_appearance_training_resumes_to_the_same_bits(appearance, shape, two_scenes, tmp_path):
    train_appearance(tmp_path, two_scenes, shape[0], until=11)
    resumed, seen = train_appearance(tmp_path, two_scenes, shape[0])
    assert len(seen) == 19
    for name, value in appearance[0].items():
        np.testing.assert_array_equal(resumed[name], value, err_msg=name)


def test_a_checkpoint_of_another_training_is_named(two_scenes, tmp_path):
    train_shape(tmp_path, two_scenes, until=1)
    with pytest.raises(InputError, match="another training"):
        train_shape(tmp_path, [*two_scenes, two_scenes[0]], until=2)


def test_a_loss_that_is_not_finite_ends_the_training(tmp_path):
    optimizer = adam({"a": np.zeros(1, np.float32)}, {"a": 0.1})
    with pytest.raises(InputError, match="not finite at step 0"):
        run_training(tmp_path, "x", 3, optimizer, lambda k: {"a": 0.1}, lambda k: {"loss": float("nan")})


# The prior


@pytest.mark.parametrize("name", ["deformation", "diffuse_albedo", "illumination"])
def test_the_whitened_network_takes_standard_normal_latents(name):
    """It equals the trained network at mean + spread z, and spread spreadᵀ is the trained latents' covariance."""
    architecture = SMALL.networks[name]
    dimension = architecture.latent or architecture.inputs
    flat, trained = random(architecture.parameters) * 0.3, random(dimension, 9, seed=1)
    mean, spread = whitening(trained)
    np.testing.assert_allclose(spread @ spread.T, np.cov(trained), atol=1e-5)
    assert (np.diff(np.linalg.norm(spread, axis=0)) <= 1e-6).all()
    features = mi.TensorXf(random(architecture.inputs, 20, seed=3))

    def outputs(flat, latent):
        latent = mi.TensorXf(np.ascontiguousarray(latent[:, None], np.float32))
        if architecture.latent:
            return evaluate(layers(architecture, mi.Float(flat), latent), features).numpy()
        return evaluate(layers(architecture, mi.Float(flat)), latent).numpy()

    moved = whiten(SMALL, name, flat, mean, spread)
    for z in (np.zeros(dimension), random(dimension, seed=2)):
        original = outputs(flat, mean + spread @ z)
        np.testing.assert_allclose(outputs(moved, z), original, atol=2e-5 * np.abs(original).max())


@pytest.mark.slow
def test_the_assembled_prior_is_an_avatar(shape, appearance, two_scenes, tmp_path):
    from sira_mi.avatar.file import load_avatar, save_avatar

    landmarks = np.stack([scene.landmarks for scene in two_scenes])
    landmarks[0, 3] = np.nan
    prior = assemble_prior(SMALL, shape[0], appearance[0], landmarks, APPEARANCE, 0)
    save_avatar(tmp_path / "prior", prior)
    back = load_avatar(tmp_path / "prior")
    for name in SMALL.latents:
        assert (back.tensors[name] == 0).all()
    assert back.k_r == 0 and back.roughness == APPEARANCE.roughness and back.skin == APPEARANCE.skin
    np.testing.assert_allclose(back.tensors["landmarks"][5], landmarks[:, 5].mean(axis=0), atol=1e-6)
    np.testing.assert_allclose(back.tensors["landmarks"][3], landmarks[1, 3], atol=1e-6)
    assert np.isnan(back.tensors["landmarks"][100]).all()
    assert (back.tensors["lobes"][:, 3:] > 0).all()


# Collections


def scene_file(path):
    pose = np.eye(4)[None].repeat(2, 0)
    pose[0, :3, 3], pose[1, :3, :3] = [1, 2, 3], [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]
    pose[1, :3, 3] = [0, 0, 4]
    visible = np.array([[1, 0], [1, 1], [0, 1]], bool)
    np.savez(
        path,
        points=random(3, 3),
        normals=random(3, 3),
        volume=random(4, 3),
        volume_distance=random(4),
        region=np.zeros(3, np.uint8),
        landmarks=random(468, 3),
        landmarks_valid=np.arange(468) % 2 == 0,
        visible=visible,
        colors=np.arange(18.0).reshape(3, 2, 3),
        world_to_camera=pose,
    )


def test_a_scene_file_becomes_observations(tmp_path):
    scene_file(tmp_path / "a.npz")
    scene = load_scene(tmp_path / "a.npz")
    np.testing.assert_array_equal(scene.sample_point, [0, 1, 1, 2])
    np.testing.assert_array_equal(scene.sample_view, [0, 0, 1, 1])
    np.testing.assert_array_equal(scene.sample_color[:, 0], [0, 6, 9, 15])
    np.testing.assert_allclose(scene.camera_centres, [[-1, -2, -3], [4, 0, 0]], atol=1e-6)
    assert np.isnan(scene.landmarks[1]).all() and np.isfinite(scene.landmarks[0]).all()


def test_bad_collections_are_named(tmp_path):
    with pytest.raises(InputError, match=r"manifest\.json: no such manifest of a collection"):
        load_training_scenes(tmp_path)
    (tmp_path / "manifest.json").write_text("[]")
    with pytest.raises(InputError, match="not a collection"):
        load_training_scenes(tmp_path)
    (tmp_path / "manifest.json").write_text(json.dumps({"scenes": [{"file": "a.npz", "split": "train"}]}))
    with pytest.raises(InputError, match="1 training scenes"):
        load_training_scenes(tmp_path)
    for data in (b"", b"PK\x03\x04 broken", b"no zip at all"):
        (tmp_path / "b.npz").write_bytes(data)
        with pytest.raises(InputError, match=r"b\.npz"):
            load_scene(tmp_path / "b.npz")
