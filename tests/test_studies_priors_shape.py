"""Study of the shape prior: distances equal analytic ones, fits recover the model's own heads, the landmarks' spread
equals NumPy's, and the command runs on a collection of balls."""

import dataclasses
import json
import sys

import mitsuba as mi
import numpy as np
import pytest
from conftest import SMALL, small_avatar
from test_training import SIZES, ball_collection

from sira_mi.avatar.decoders import render_radiance
from sira_mi.errors import InputError
from sira_mi.fields.columns import evaluate_in_chunks
from sira_mi.fields.extraction import extract
from sira_mi.fields.sdf import signed_distance, surface
from sira_mi.training import pictures, train
from sira_mi.training.pictures import extract_surface
from sira_mi.training.scenes import TrainingScene
from sira_mi.training.shape_model import ShapeModel
from studies.cache import fingerprint, load_or_compute, read
from studies.priors import __main__ as command
from studies.priors import measure_appearance, measure_shape, shape_measures, short_trainings
from studies.priors.appearance_measures import LatentFit
from studies.priors.shape_measures import Scan, ShapeFit


@pytest.fixture(scope="module")
def model():
    """Blobs of some 1.4 units around a mean blob."""
    return ShapeModel.of_prior(small_avatar())


def scan_of(model, w, w_r, seed: int) -> Scan:
    """A scan of the model's own head `w`, in the model's own colours `w_r`, from one camera."""
    rng = np.random.default_rng(seed)
    field = model.field(model.latent("z_sdf", w))
    points = shape_measures.surface_samples(field, extract_surface(field), 3000, seed)
    _, gradient, x_ref, gamma = evaluate_in_chunks(lambda x: surface(field, x), points.T)
    normals = gradient / np.linalg.norm(gradient, axis=0)
    centre = np.float32([[0, 0, 8]])
    views = (points - centre) / np.linalg.norm(points - centre, axis=1, keepdims=True)
    rendering = model.layers_at("rendering", mi.TensorXf(model.latent("z_r", w_r)[:, None]))
    octaves = model.architecture.rendering_octaves
    (colors,) = evaluate_in_chunks(
        lambda *inputs: render_radiance(rendering, octaves, *inputs), x_ref, normals, views.T, gamma
    )
    scene = TrainingScene(
        points=points,
        normals=normals.T,
        region=np.zeros(len(points), np.uint8),
        volume=np.zeros((1, 3), np.float32),
        volume_distance=np.zeros(1, np.float32),
        landmarks=np.full((468, 3), np.nan, np.float32),
        sample_point=np.arange(len(points)),
        sample_view=np.zeros(len(points), int),
        sample_color=colors.T,
        camera_centres=centre,
    )
    hair = points[:, 1] > 0.8
    return Scan(f"scan {seed}", {"source": "model"}, scene, hair, points[rng.integers(len(points))])


@pytest.fixture(scope="module")
def own(model):
    """Scans of three heads of the model, and the latents that they were made with."""
    rng = np.random.default_rng(4)
    w, w_r = 0.5 * rng.standard_normal((SMALL.sdf_latent, 3)), rng.standard_normal((SMALL.rendering_latent, 3))
    return [scan_of(model, w[:, k], w_r[:, k], k) for k in range(3)], w


# Distances


def test_distance_to_the_surface_is_the_offset_from_it(model):
    """Points moved off the surface along its normals by up to 2 mm are as far from it as they were moved."""
    field = model.field(model.latent("z_sdf", np.zeros(SMALL.sdf_latent)))
    on = shape_measures.surface_samples(field, extract_surface(field), 500)
    f, gradient = evaluate_in_chunks(lambda x: surface(field, x)[:2], on.T)
    normals = (gradient / np.linalg.norm(gradient, axis=0)).T
    assert np.abs(f).max() < 2e-3
    offset = np.random.default_rng(0).uniform(-2, 2, (500, 1))
    distance, angle = shape_measures.to_surface(field, on + normals * offset / 100, normals)
    np.testing.assert_allclose(distance, np.abs(offset[:, 0]), atol=0.25)
    assert np.median(np.abs(distance - np.abs(offset[:, 0]))) < 0.05 and np.median(angle) < 3
    _, opposite = shape_measures.to_surface(field, on, -normals)
    assert opposite.min() > 179


def test_distance_to_a_scan_is_that_to_its_discs():
    """A plate of points 2 mm apart: above it the height, beside it the distance to the edge of the last disc, by brute
    force over all discs of the nearest point."""
    x, z = (a.ravel() * 0.02 for a in np.meshgrid(np.arange(-20, 21), np.arange(-20, 21)))
    points = np.stack([x, 0 * x, z], axis=1)
    scan = plate(points)
    above = np.array([[0.011, 0.3, 0.007], [0.1, -0.25, -0.2]])
    np.testing.assert_allclose(shape_measures.to_scan(above, scan)[0], [30, 25], rtol=1e-6)
    beside = np.array([[0.6, 0.0, 0.0], [0.6, 0.1, 0.0], [0.41, 0.0, 0.0]])
    np.testing.assert_allclose(shape_measures.to_scan(beside, scan)[0], [17, np.hypot(17, 10), 0], atol=1e-6)
    assert shape_measures.spacing(points) == pytest.approx(2)


def plate(points) -> Scan:
    empty = np.zeros((0, 3), np.float32)
    normals = np.repeat([[0.0, 1.0, 0.0]], len(points), axis=0)
    scene = TrainingScene(
        points,
        normals,
        np.zeros(len(points), np.uint8),
        empty,
        empty[:, 0],
        empty,
        empty[:, 0],
        empty[:, 0],
        empty,
        empty,
    )
    return Scan("plate", {}, scene, np.zeros(len(points), bool), np.zeros(3))


def test_surface_samples_are_even_and_on_the_surface(model):
    """On each side of the blob as many as its share of the area."""
    field = model.field(model.latent("z_sdf", np.zeros(SMALL.sdf_latent)))
    extracted = extract_surface(field)
    points = shape_measures.surface_samples(field, extracted, 4000)
    (f,) = evaluate_in_chunks(lambda x: signed_distance(field, x), points.T)
    assert np.abs(f).max() < 5e-3
    corners = extracted.vertices[extracted.faces.astype(int)]
    corners = corners[corners[:, :, 1].min(axis=1) > shape_measures.SHOULDERS]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    for axis in range(3):
        share = area[corners[:, :, axis].mean(axis=1) > 0].sum() / area.sum()
        assert (points[:, axis] > 0).mean() == pytest.approx(share, abs=0.03)


def test_regions_leave_out_shoulders_hair_and_what_is_far_from_the_nose():
    points = np.array([[0, 0, 1.0], [0, 0.9, 0.9], [0, -2.0, 0.5], [0, 0.3, -1.0]])
    hair = np.array([False, True, False, True])
    regions = shape_measures.regions_of(points, hair, np.array([0, 0, 1.2]))
    assert list(regions) == list(shape_measures.REGIONS)
    expected = [[1, 1, 0, 0], [1, 0, 0, 0], [1, 0, 0, 0], [1, 1, 0, 1]]
    for mask, row in zip(regions.values(), expected, strict=True):
        np.testing.assert_array_equal(mask, np.array(row, bool))


def test_statistics_of_a_region():
    assert shape_measures.statistics(np.arange(101.0)) == {"mean": 50.0, "median": 50.0, "p90": 90.0}
    assert np.isnan(list(shape_measures.statistics(np.zeros(0)).values())).all()


@pytest.mark.parametrize(("centres", "parts"), [([0.0], 1), ([-1.2, 1.2], 2), ([-0.5, 0.5], 1)])
def test_components_of_a_mesh(centres, parts):
    def balls(p):
        return np.min([np.linalg.norm(p - np.array([[c], [0], [0]]), axis=0) - 0.8 for c in centres], axis=0)

    count, largest = shape_measures.components(extract(balls, 0.1))
    assert count == parts and largest == pytest.approx(1 / parts, abs=0.02)


# Fits


@pytest.mark.slow
def test_a_fit_recovers_the_models_own_heads(model, own):
    scans, _ = own
    w = shape_measures.fit_shape(model, [scan.scene for scan in scans], ShapeFit(steps=200))
    errors = {}
    for name, latents in (("fitted", w), ("mean", 0 * w)):
        fields = [model.field(model.latent("z_sdf", latents[:, k])) for k in range(3)]
        errors[name] = [
            shape_measures.scan_errors(field, scan, 500)["distance"]["head with hair"]["mean"]
            for field, scan in zip(fields, scans, strict=True)
        ]
    assert np.max(np.array(errors["fitted"]) / errors["mean"]) < 0.2, errors


def test_a_fit_repeats_bit_for_bit(model, own):
    scenes = [scan.scene for scan in own[0]]
    fits = [shape_measures.fit_shape(model, scenes, ShapeFit(steps=5), seed=3) for _ in range(2)]
    np.testing.assert_array_equal(*fits)
    assert np.abs(fits[0]).max() > 0


def test_colours_are_fitted_on_one_half_and_measured_on_the_other(model, own):
    scans, w = own
    before = shape_measures.color_errors(model, scans, w, steps=0)
    after = shape_measures.color_errors(model, scans, w, steps=60)
    assert len(after) == 3 and np.mean(after) < 0.4 * np.mean(before), (before, after)
    assert (np.array(after) < before).all()


# Landmarks


def test_landmark_spread_is_the_root_mean_square_over_heads(model):
    """At x against NumPy, with unknown landmarks; at x_ref the same where the deformation is zero, and half of it where
    the deformation halves x."""
    rng = np.random.default_rng(0)
    landmarks = rng.uniform(-1, 1, (4, 468, 3)).astype(np.float32)
    landmarks[1, 7], landmarks[:3, 9] = np.nan, np.nan
    expected = []
    for k in range(468):
        known = landmarks[np.isfinite(landmarks[:, k, 0]), k].astype(float)
        if len(known) >= 2:
            expected.append(np.sqrt(((known - known.mean(axis=0)) ** 2).sum(axis=1).mean()))
    still = dataclasses.replace(
        model, networks={**model.networks, "deformation": np.zeros_like(model.networks["deformation"])}
    )
    result = shape_measures.landmark_spread(still, np.zeros((SMALL.sdf_latent, 4)), landmarks)
    assert result["undeformed"] == pytest.approx(100 * np.mean(expected), rel=1e-5)
    assert result["deformed"] == pytest.approx(result["undeformed"], rel=1e-5)
    assert result["scale"] == pytest.approx(1, rel=1e-5) and result["scenes"] == 4
    moved = shape_measures.landmark_spread(model, rng.standard_normal((SMALL.sdf_latent, 4)), landmarks)
    assert moved["deformed"] != pytest.approx(moved["undeformed"], rel=1e-3)


# Cache


def test_results_are_measured_again_only_when_something_changed(tmp_path):
    calls = []

    def compute():
        calls.append(1)
        (tmp_path / "picture").write_text("x")
        return {"calls": len(calls)}

    file, picture = tmp_path / "deep" / "a.json", (tmp_path / "picture",)
    assert [load_or_compute(file, "k", compute, picture)["calls"] for _ in range(2)] == [1, 1]
    assert load_or_compute(file, "other", compute, picture)["calls"] == 2
    picture[0].unlink()
    assert load_or_compute(file, "other", compute, picture)["calls"] == 3
    for damaged in ("", "[]", '{"key": "other"}', '{"key": "other", "result": 3}'):
        file.write_text(damaged)
        assert read(file) is None
    assert load_or_compute(file, "other", compute, picture)["calls"] == 4
    assert fingerprint("ab", "c") != fingerprint("a", "bc")
    assert fingerprint(picture[0]) == fingerprint("x")


# The command


@pytest.fixture
def coarse(monkeypatch):
    """Meshes and pictures on a coarse grid, for speed."""
    monkeypatch.setattr(pictures, "extract", lambda evaluate, voxel: extract(evaluate, 0.3))


@pytest.fixture(scope="module")
def balls(tmp_path_factory):
    """A collection, and a run of both models on it."""
    folder = tmp_path_factory.mktemp("balls")
    collection, runs = ball_collection(folder / "collection"), folder / "runs"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pictures, "extract", lambda evaluate, voxel: extract(evaluate, 0.3))
        train.train_shape(collection, runs, steps=20, sizes=SIZES)
        train.train_appearance(collection, runs, steps=2)
    return collection, runs


FIT = ShapeFit(steps=20, points=32)
MEASURES = measure_shape.Measures(points=300, heads=2, fit=FIT, color_steps=5)
LATENT_FIT = LatentFit(steps=3, scenes=2, points=16)
APPEARANCE_MEASURES = measure_appearance.AppearanceMeasures(imaged=1, pictured=1, training_scenes=1, fit=LATENT_FIT)
PROTOCOL = short_trainings.Protocol(scans=1, points=100, heads=1, cost_points=256, fit=FIT, color_steps=5)


@pytest.mark.slow
def test_the_command_writes_the_page_from_its_measurements(balls, coarse, tmp_path, monkeypatch):
    collection, runs = balls
    monkeypatch.setattr(measure_shape, "Measures", lambda: MEASURES)
    monkeypatch.setattr(short_trainings, "Protocol", lambda: PROTOCOL)
    monkeypatch.setattr(short_trainings, "SHAPE_TERMS", ("eikonal",))
    monkeypatch.setattr(measure_appearance, "AppearanceMeasures", lambda: APPEARANCE_MEASURES)
    monkeypatch.setattr(measure_appearance, "LatentFit", lambda: LATENT_FIT)
    monkeypatch.setattr(measure_appearance, "APPEARANCE_TERMS", ("smoothness",))
    monkeypatch.setattr(
        short_trainings, "architectures", lambda: {"complete": SIZES, "small": {**SIZES, "features": 2}}
    )
    for name, option in (("sizes", "--steps"), ("measure", "--ablation-steps")):
        arguments = [name, "--collection", str(collection), "--runs", str(runs), "--out", str(tmp_path), option, "2"]
        monkeypatch.setattr(sys, "argv", ["evaluate", *arguments])
        command.main()
    text = (tmp_path / "priors.md").read_text() + (tmp_path / "prior_trainings.md").read_text()
    assert "Not measured yet" not in text and "nan" not in text
    for row in (
        "| ancestry round | 2 |",
        "| age old | 1 |",
        "| without eikonal |",
        "| all terms |",
        "3 balls",
        "| without smoothness |",
        "| specular strength, dB |",
    ):
        assert row in text, row
    for picture in ("prior_fits", "prior_samples_1", "prior_samples_2", "prior_directions", "prior_appearance"):
        assert (tmp_path / "images" / f"{picture}.png").stat().st_size > 500 and f"images/{picture}.png" in text

    fits = json.loads((runs / "evidence" / "fits.json").read_text())["result"]
    face = np.mean([row["fitted"]["distance"]["face"]["mean"] for row in fits["scans"]])
    assert f"| face, mm | ≤1 | {face:.2f} |" in text
    assert [row["name"] for row in fits["scans"]] == ["scene_3.npz", "scene_4.npz"]

    def again(*_, **__):
        raise AssertionError("measured again")

    for name in ("fit_shape", "random_heads", "landmark_spread", "scan_errors"):
        monkeypatch.setattr(shape_measures, name, again)
    command.main()
    assert text.startswith((tmp_path / "priors.md").read_text())


@pytest.mark.slow
def test_the_reference_of_the_ablations_differs_from_them(balls, coarse):
    """What `--without` leaves out is left out: after a few steps the networks differ."""
    collection, runs = balls
    values = []
    for without in (None, "surface"):
        parameters = train.train_shape(collection, runs / str(without), steps=3, sizes=SIZES, without=without)
        values.append(parameters["deformation"])
    assert np.abs(values[0] - values[1]).max() > 1e-4


@pytest.mark.slow
def test_missing_files_are_named(balls, tmp_path):
    collection, runs = balls
    with pytest.raises(InputError, match=r"shape\.checkpoint is missing; run python -m sira_mi\.training shape"):
        measure_shape.measure_shape_prior(collection, tmp_path, MEASURES)
    with pytest.raises(InputError, match="not a collection"):
        measure_shape.measure_shape_prior(tmp_path, runs, MEASURES)
    (tmp_path / "manifest.json").write_text('{"scenes": [{"file": "a", "split": "test", "error": "broken"}]}')
    with pytest.raises(InputError, match="no test scenes"):
        shape_measures.load_scans(tmp_path, np.zeros(3))


def test_every_size_of_the_table_is_one_of_the_architecture():
    names = short_trainings.architectures()
    assert names[short_trainings.COMPLETE] == {} and all(len(sizes) == 1 for name, sizes in list(names.items())[1:])
    assert {next(iter(sizes)) for sizes in list(names.values())[1:]} == set(short_trainings.SIZES)
