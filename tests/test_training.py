"""The training command and loop: options, checkpoints, divergence, log, pictures."""

import dataclasses
import json
import signal
import sys

import mitsuba as mi
import numpy as np
import pytest
from conftest import SMALL

from sira_mi.avatar.architecture import AvatarArchitecture
from sira_mi.avatar.file import load_avatar
from sira_mi.avatar.shape import head_of
from sira_mi.errors import InputError
from sira_mi.fields.extraction import extract
from sira_mi.optimisation.adam import adam, read_arrays
from sira_mi.portrait.camera import yaw_rotation
from sira_mi.training import af_sm, pictures, sa_sm, train
from sira_mi.training import loop as training
from sira_mi.training.__main__ import main
from sira_mi.training.loop import read_parameters, run_training
from sira_mi.training.scenes import load_training_scenes
from sira_mi.training.shape_model import ShapeModel

SIZES = dataclasses.asdict(SMALL)


def ball_collection(folder, train_heads: int = 3, test_heads: int = 2):
    """A collection of balls of different radius, the upper quarter "hair", seen by eight cameras around them."""
    folder.mkdir(parents=True, exist_ok=True)
    entries = []
    for k in range(train_heads + test_heads):
        rng = np.random.default_rng(k)
        radius = 1.1 + 0.05 * k
        normals = rng.standard_normal((600, 3))
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        volume = rng.uniform(-1.8, 1.8, (500, 3))
        landmarks = np.zeros((468, 3))
        landmarks[:40] = radius * normals[np.argsort(-normals[:, 2])][:40]
        landmarks[4] = [0, 0, radius]
        poses = np.repeat(np.eye(4)[None], 8, axis=0)
        for v, a in enumerate(np.arange(8) * np.pi / 4):
            back = np.array([np.sin(a), 0, np.cos(a)])
            poses[v, :3, :3] = [[np.cos(a), 0, -np.sin(a)], [0, -1, 0], -back]
            poses[v, 2, 3] = 6
        facing = normals @ poses[:, 2, :3].T < -0.2
        np.savez(
            folder / f"scene_{k}.npz",
            points=radius * normals,
            normals=normals,
            region=(normals[:, 1] > 0.7).astype(np.uint8),
            volume=volume,
            volume_distance=np.linalg.norm(volume, axis=1) - radius,
            landmarks=landmarks,
            landmarks_valid=np.arange(468) < 40,
            visible=facing,
            colors=np.repeat((0.3 + 0.1 * normals)[:, None], 8, axis=1),
            world_to_camera=poses,
            K=np.repeat([[[48.0, 0, 12], [0, 48, 12], [0, 0, 1]]], 8, axis=0),
            images=np.full((8, 24, 24, 3), 0.3),
            masks=np.ones((8, 24, 24), np.uint8),
            albedo=0.4 + 0.1 * normals,
            specular=np.full(600, 0.4),
            albedo_images=rng.uniform(0.3, 0.5, (2, 24, 24, 3)),
            specular_images=rng.uniform(0.3, 0.5, (2, 24, 24)),
        )
        split = "train" if k < train_heads else "test"
        group = {"ancestry": "round", "sex": "unknown", "age": "young" if k % 2 else "old"}
        entries.append({"file": f"scene_{k}.npz", "split": split, "source": "balls", "group": group})
    (folder / "manifest.json").write_text(json.dumps({"scenes": entries}))
    return folder


@pytest.fixture(scope="module")
def collection(tmp_path_factory):
    return ball_collection(tmp_path_factory.mktemp("balls"))


@pytest.fixture(scope="module")
def run(collection, tmp_path_factory):
    """Both models, a few steps by the command."""
    out = tmp_path_factory.mktemp("run")
    sizes = ["--architecture", *(f"{k}={int(v)}" for k, v in SIZES.items())]
    for model, steps in (("shape", 8), ("appearance", 4)):
        arguments = [model, "--collection", str(collection), "--out", str(out), "--steps", str(steps)]
        command(*arguments, *(sizes if model == "shape" else []))
    return out


def command(*arguments: str) -> None:
    before, sys.argv = sys.argv, ["train", *arguments]
    try:
        main()
    finally:
        sys.argv = before


# Options


def test_finishing_steps_follow_at_lower_rates_and_with_more_eikonal():
    """The steps before them are those of a training without them; after the last one nothing is left to do."""
    settings = sa_sm.ShapeTraining(steps=80, finishing=0.25, finishing_rate=0.5, finishing_eikonal=3.0)
    plain = dataclasses.replace(settings, finishing=0.0)
    assert (sa_sm.all_steps(settings), sa_sm.all_steps(plain)) == (100, 80)
    assert all(sa_sm.rates(settings, k) == sa_sm.rates(plain, k) for k in range(80))
    assert sa_sm.rates(settings, 80)["reference"] == pytest.approx(0.5 * settings.learning_rate)
    assert sa_sm.rates(settings, 99)["reference"] < 0.1 * sa_sm.rates(settings, 80)["reference"]
    assert sa_sm.weights_at(settings, 79) == settings
    finishing = sa_sm.weights_at(settings, 80)
    assert (finishing.eikonal, finishing.random_eikonal) == (3 * settings.eikonal, 3 * settings.random_eikonal)
    assert finishing.surface == settings.surface


def test_random_heads_have_the_mean_and_the_covariance_of_the_latents():
    """Otherwise the eikonal term would be trained on other heads than those that a prior gives."""
    rng = np.random.default_rng(0)
    z = rng.standard_normal((3, 3)) @ rng.standard_normal((3, 24)) + [[1], [2], [3]]
    drawn = np.concatenate([z @ sa_sm.gaussian_mixture(24, rng) for _ in range(400)], axis=1)
    assert np.allclose(drawn.mean(axis=1), z.mean(axis=1), atol=0.1)
    assert np.allclose(np.cov(drawn), np.cov(z, bias=True), rtol=0.1, atol=0.2)


def test_a_checkpoint_without_deformation_is_refused_and_an_older_one_opens(tmp_path):
    """Earlier versions also trained heads without a deformation, and say `deforms` of the others."""
    path = tmp_path / "shape.checkpoint"
    assert train.read_architecture({"architecture": json.dumps({**SIZES, "deforms": True})}, path) == SMALL
    with pytest.raises(InputError, match=r"shape\.checkpoint is of heads without a deformation"):
        train.read_architecture({"architecture": json.dumps({**SIZES, "deforms": False})}, path)


def test_the_terms_that_can_be_left_out_are_those_of_the_losses(collection):
    """Every loss has a weight of its name, and every such weight can be set to zero."""
    scenes = load_training_scenes(collection)
    settings = sa_sm.ShapeTraining(scenes=2, surface_points=8, volume_points=8, landmarks=4)
    start = sa_sm.initial_shape_model(SMALL, settings, len(scenes), 0)
    batch = sa_sm.draw_batch(scenes, settings, np.random.default_rng(0))
    optimizer = adam(start, sa_sm.rates(settings, 0))
    assert set(sa_sm.shape_losses(SMALL, dict(optimizer.items()), batch)) == set(train.SHAPE_TERMS)
    assert train.without_term(settings, train.SHAPE_TERMS, "eikonal").eikonal == 0
    assert train.without_term(settings, train.SHAPE_TERMS, None) == settings
    with pytest.raises(InputError, match=r"no such loss term; known are surface, normal"):
        train.without_term(settings, train.SHAPE_TERMS, "learning_rate")


def test_a_training_on_some_sources_sees_no_scene_of_the_others(tmp_path):
    """And goes on from no training on others: heads of a generator that is left out would not be unseen."""
    manifest = json.loads((ball_collection(tmp_path) / "manifest.json").read_text())
    for entry, source in zip(manifest["scenes"], ("balls", "eggs", "balls", "eggs", "balls"), strict=True):
        entry["source"] = source
    (tmp_path / "manifest.json").write_text(json.dumps(manifest))
    balls = load_training_scenes(tmp_path, ["balls"])
    assert [float(np.linalg.norm(scene.points[0])) for scene in balls] == pytest.approx([1.1, 1.2], abs=1e-5)
    assert len(load_training_scenes(tmp_path, ["eggs", "balls"])) == len(load_training_scenes(tmp_path)) == 3
    with pytest.raises(InputError, match="1 training scenes"):
        load_training_scenes(tmp_path, ["eggs"])
    with pytest.raises(InputError, match="no training scenes of cubes; its sources are balls, eggs"):
        load_training_scenes(tmp_path, ["cubes", "balls"])
    some, others, everything = (
        train.describe(SMALL, sa_sm.ShapeTraining(), 0, sources) for sources in (("a", "b"), ("b",), ())
    )
    assert some != others and some == train.describe(SMALL, sa_sm.ShapeTraining(), 0, ("b", "a"))
    assert "sources" not in json.loads(everything["settings"])


@pytest.mark.slow
def test_so_are_those_of_the_appearance(collection, run):
    """All but the colour, whose weight is 1."""
    shape, _ = read_parameters(run / "shape.checkpoint")
    settings = af_sm.AppearanceTraining(scenes=1, points=8, frozen_points=50)
    scene = load_training_scenes(collection)[0]
    frozen = af_sm.freeze_scene(SMALL, head_of(shape, 0), scene, settings, np.random.default_rng(0))
    batch = af_sm.draw_batch([frozen], settings, np.random.default_rng(0))
    optimizer = adam(af_sm.initial_appearance_model(SMALL, 1, 0), af_sm.rates(settings, 0))
    terms = af_sm.appearance_losses(SMALL, settings, dict(optimizer.items()), batch)
    assert set(terms) == {"color", *train.APPEARANCE_TERMS}


@pytest.mark.parametrize("item", ["width=3", "sdf_width", "sdf_width=", "sdf_width=-3", "sdf_width=6.5", "sdf_width=²"])
def test_unusable_sizes_are_named(item):
    with pytest.raises(InputError, match="--architecture"):
        train.parse_sizes([item])


def test_sizes_replace_those_of_the_architecture():
    sizes = train.parse_sizes(["sdf_width=64", "features=8"])
    assert train.with_sizes(AvatarArchitecture(), sizes) == AvatarArchitecture(sdf_width=64, features=8)
    for size in (0, 4096, 10**9):
        with pytest.raises(InputError, match="--architecture"):
            train.with_sizes(AvatarArchitecture(), {"sdf_width": size})


# Whole trainings by the command


@pytest.mark.slow
def test_the_command_trains_both_models_at_the_given_sizes(run, collection):
    parameters, metadata = read_parameters(run / "shape.checkpoint")
    assert train.read_architecture(metadata, run / "shape.checkpoint") == SMALL
    assert metadata["step"] == "10" and parameters["z_sdf"].shape == (SMALL.sdf_latent, 3)
    assert load_avatar(run / "prior.safetensors").architecture == SMALL
    for name in ("shape_000010", "appearance_000004"):
        from PIL import Image

        picture = np.asarray(Image.open(run / "pictures" / f"{name}.png"))
        assert picture.shape[0] % pictures.TILE[0] == 0 and picture.std() > 5


@pytest.mark.slow
def test_a_resume_with_other_options_is_refused(run, collection):
    options = {"steps": 9, "sizes": SIZES}
    with pytest.raises(InputError, match="sdf_width: 32 there, 48 now"):
        train.train_shape(collection, run, steps=9, sizes={**SIZES, "sdf_width": 48})
    with pytest.raises(InputError, match=r"another settings \(eikonal: 0\.\d+ there, 0\.0 now\)"):
        train.train_shape(collection, run, **options, without="eikonal")
    with pytest.raises(InputError, match="seed: 0 there, 1 now"):
        train.train_shape(collection, run, **options, seed=1)
    with pytest.raises(InputError, match="was trained with sdf_width=32"):
        train.train_appearance(collection, run, steps=5, sizes={"sdf_width": 48})
    with pytest.raises(InputError, match="albedo_width: 16 there, 24 now"):
        train.train_appearance(collection, run, steps=5, sizes={"albedo_width": 24})


def test_appearance_needs_a_trained_shape(tmp_path, collection):
    with pytest.raises(InputError, match="training shape first"):
        train.train_appearance(collection, tmp_path)
    run_training(tmp_path, "shape", 1, *plain())
    with pytest.raises(InputError, match="does not say its architecture"):
        train.train_appearance(collection, tmp_path)


# The loop


def plain(losses=lambda step: {"a": 1.0}):
    """Optimizer, rates and step function of a training that moves one number and has given losses."""
    optimizer = adam({"x": np.zeros(1, np.float32)}, {"x": 0.1})

    def step(number):
        optimizer["x"] = optimizer["x"] + 1
        return losses(number)

    return optimizer, lambda k: {"x": 0.1}, step


def stored_step(folder) -> int:
    return int(read_arrays(folder / "x.checkpoint")[1]["step"])


def test_divergence_ends_the_training_and_keeps_the_sound_checkpoint(tmp_path, monkeypatch):
    """The weighted loss rises eightfold at step 150: half a window later its median has risen; no checkpoint is
    written after the first few such steps."""
    monkeypatch.setattr(training, "_CHECKPOINT_SECONDS", 0.0)
    losses = lambda step: {"a": 1.0 if step < 150 else 15.0, "b": 1.0}  # noqa: E731
    with pytest.raises(InputError, match=r"diverges at step 199, .*\(a 15, b 1\).* is from before"):
        run_training(tmp_path, "x", 400, *plain(losses), weights={"b": 1.0})
    assert 150 <= stored_step(tmp_path) <= 160


def test_weights_decide_what_diverges(tmp_path):
    losses = lambda step: {"a": 1.0 if step < 150 else 15.0, "b": 1.0}  # noqa: E731
    run_training(tmp_path, "x", 400, *plain(losses), weights={"a": 0.0})


def test_a_short_rise_is_no_divergence(tmp_path):
    losses = lambda step: {"a": 50.0 if 150 <= step < 190 else 1.0}  # noqa: E731
    run_training(tmp_path, "x", 300, *plain(losses))


def test_the_best_loss_survives_a_resume(tmp_path):
    run_training(tmp_path, "x", 120, *plain())
    with pytest.raises(InputError, match=r"diverges at step 219, its loss is 10\.0 times its best"):
        run_training(tmp_path, "x", 400, *plain(lambda step: {"a": 10.0}))


def test_an_interrupted_training_resumes_to_the_same_result(tmp_path):
    """Ctrl-C is answered after the step, with a checkpoint."""
    ends = run_training(tmp_path, "whole", 30, *plain())
    optimizer, rates, step = plain()

    def interrupt(number):
        if number == 12:
            signal.raise_signal(signal.SIGINT)
        return step(number)

    with pytest.raises(KeyboardInterrupt):
        run_training(tmp_path, "x", 30, optimizer, rates, interrupt)
    assert stored_step(tmp_path) == 13
    assert np.array_equal(run_training(tmp_path, "x", 30, *plain())["x"], ends["x"])


def test_a_resumed_log_has_every_line_once(tmp_path, monkeypatch):
    run_training(tmp_path, "x", 250, *plain())
    log = tmp_path / "x.log"
    log.write_text(log.read_text() + '{"step": 300, "a": 7.0}\n{"step": 4')
    run_training(tmp_path, "x", 420, *plain())
    lines = [json.loads(line) for line in log.read_text().splitlines()]
    assert [line["step"] for line in lines] == [100, 200, 300, 400]
    assert all(line["a"] == 1.0 and line["seconds"] >= 0 for line in lines)


@pytest.mark.parametrize(("share", "drawn"), [(1e9, [2, 4, 5]), (0.0, [2, 5])])
def test_pictures_are_drawn_while_they_take_little_time(tmp_path, monkeypatch, share, drawn):
    monkeypatch.setattr(training, "_PICTURE_SHARE", share)
    seen = []

    def picture(path, parameters):
        seen.append((path.name, float(parameters["x"][0])))

    run_training(tmp_path, "x", 5, *plain(), picture=picture, picture_steps=2)
    assert seen == [(f"x_{step:06d}.png", float(step)) for step in drawn]


# Pictures and the latents' distribution


def test_a_ball_is_drawn_as_a_shaded_disc(avatar):
    """Of the small avatar, a blob of some 1.4 units: where the tile is covered, and from which side it is lit."""
    model = ShapeModel.of_prior(avatar)
    tile = pictures.head_tile(model.field(avatar.tensors["z_sdf"]), yaw=0.0)
    covered = (tile < 1).all(axis=2)
    pixel = 3.4 / pictures.TILE[0]
    assert covered.sum() * pixel**2 == pytest.approx(np.pi * 1.4**2, rel=0.25)
    rows, columns = np.nonzero(covered)
    upper_left = tile[rows.min() + 25, columns.min() + 22].mean()
    lower_right = tile[rows.max() - 20, columns.max() - 15].mean()
    assert upper_left > lower_right + 0.2


def test_rays_meet_an_analytic_ball_where_it_is():
    extracted = extract(lambda p: np.linalg.norm(p, axis=0) - 1.0, 0.1)
    view = yaw_rotation(40.0)
    hit, points = pictures._crossings(extracted.grid, extracted.spacing, view)
    assert np.abs(np.linalg.norm(points, axis=0) - 1).max() < 0.02
    assert (view[2] @ points > -0.02).all()
    assert hit.sum() * (3.4 / pictures.TILE[0]) ** 2 == pytest.approx(np.pi, rel=0.03)


def test_scans_show_their_near_side():
    """Two plates, the nearer one bright; the far one faces away and is not painted."""
    grid = np.stack(np.meshgrid(np.linspace(-1, 1, 60), np.linspace(-1, 1, 60)), axis=-1).reshape(-1, 2)
    points = np.concatenate([np.c_[grid, 0 * grid[:, 0] + z] for z in (0.5, -0.5)])
    normals = np.repeat([[0, 0, 1.0], [0, 0, -1.0]], len(grid), axis=0)
    values = np.repeat([[0.8] * 3, [0.1] * 3], len(grid), axis=0)
    tile = pictures.splat(points, normals, values, yaw=0.0)
    assert set(np.unique(tile.round(3))) == {np.float32(0.8), np.float32(1.0)}
    assert (tile[..., 0] < 1).sum() * (3.4 / pictures.TILE[0]) ** 2 == pytest.approx(4, rel=0.1)


def test_standard_normal_vectors_have_the_latents_distribution():
    rng = np.random.default_rng(0)
    latents = {
        name: (rng.standard_normal((size, 9)) + 2).astype(np.float32)
        for name, size in SMALL.latents.items()
        if name in ("z_sdf", "z_r")
    }
    networks = {name: np.zeros(SMALL.networks[name].parameters, np.float32) for name in sa_sm.NETWORKS}
    model = ShapeModel.of_training(SMALL, {**networks, **latents})
    basis = model.bases["z_sdf"].astype(np.float64)
    np.testing.assert_allclose(basis @ basis.T, np.cov(latents["z_sdf"]), atol=1e-5)
    np.testing.assert_allclose(
        model.latent("z_sdf", np.zeros(basis.shape[1])), latents["z_sdf"].mean(axis=1), atol=1e-6
    )
    assert np.all(np.diff(np.linalg.norm(basis, axis=0)) <= 1e-6)
    assert isinstance(model.field(model.latent("z_sdf", np.ones(basis.shape[1]))).deformation[0][0], mi.TensorXf)
