"""Study of the appearance prior: measures equal their definitions, latents fitted to a head of the model recover it,
held-out views, and the parts of the AF-SM training that the study needs."""

import dataclasses
import json

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from conftest import SMALL, small_avatar
from doubles import head_field

from sira_mi.conventions import HELD_OUT_VIEWS, LANDMARKS, LUMINANCE
from sira_mi.errors import InputError
from sira_mi.fields.columns import evaluate_in_chunks
from sira_mi.fields.sdf import signed_distance_and_slope
from sira_mi.portrait.landmarks import BARE_SKIN
from sira_mi.sg.radiance import Material, closed_form_radiance, radiance_of_scenes
from sira_mi.training import af_sm
from sira_mi.training.prior import assemble_prior
from sira_mi.training.scenes import TrainingScene
from studies.priors import appearance_measures as ap

SETTINGS = af_sm.AppearanceTraining(frozen_points=400)


def random(*shape, seed=0) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal(shape).astype(np.float32)


def unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v, axis=0)


# Measures


def test_psnr_is_that_of_a_known_error():
    assert ap.psnr(np.full(7, 0.6), np.full(7, 0.5)) == pytest.approx(20.0)
    assert np.isnan(ap.psnr(np.zeros((0, 3)), np.zeros((0, 3))))


def test_scaling_takes_out_a_tint_and_nothing_else():
    truth = np.abs(random(500, 3)) * 0.2 + 0.1
    tinted = truth * [0.5, 0.8, 1.3]
    np.testing.assert_allclose(ap.scale_channels(tinted, truth), truth, rtol=1e-6)
    scores = ap.albedo_scores(tinted, truth)
    assert scores["psnr_scaled"] > 100 > 40 > scores["psnr"]
    assert ap.albedo_scores(truth + 0.1 * random(500, 3), truth)["psnr_scaled"] < 25


def test_specular_strength_and_f0_differ_by_a_factor():
    """PSNR with peak 1 of values 0.08 times as large is −20 log10 0.08 higher."""
    scores = ap.specular_scores(np.full(10, 0.03), np.full(10, 0.5))
    assert scores["psnr"] == pytest.approx(-20 * np.log10(0.125))
    assert scores["psnr_f0"] - scores["psnr"] == pytest.approx(-20 * np.log10(0.08))


def test_similarity_looks_only_inside_the_mask():
    truth = np.abs(random(40, 40, 3)) * 0.3
    mask = np.zeros((40, 40), bool)
    mask[10:30, 10:30] = True
    other = np.where(mask[..., None], truth, 0.9)
    assert ap.ssim_inside(other, truth, mask) == pytest.approx(1.0)
    assert ap.ssim_inside(truth, other[..., 0:1] * truth, mask) < 0.9
    assert ap.ssim_inside(truth[..., 0], truth[..., 0], mask) == pytest.approx(1.0)
    assert np.isnan(ap.ssim_inside(truth, truth, np.zeros((40, 40), bool)))


def test_leakage_sees_shading_in_the_albedo():
    rng = np.random.default_rng(0)
    truth, light = rng.uniform(0.2, 0.4, (2000, 3)), rng.uniform(0.5, 3.0, (2000, 1)) * np.ones(3)
    noise = np.exp(0.1 * rng.standard_normal((2000, 1)))
    assert abs(ap.leakage(truth * noise, truth, light)) < 0.06
    assert ap.leakage(truth * np.sqrt(light), truth, light) > 0.95
    assert ap.leakage(truth / np.sqrt(light), truth, light) < -0.95
    assert ap.leakage(truth, truth, light) == 0.0


def test_means_leave_out_what_is_missing():
    rows = [{"a": 1.0, "b": float("nan")}, {"a": 3.0, "b": 2.0}, {"b": 4.0}]
    assert ap.mean_scores(rows) == {"a": 2.0, "b": 3.0}


# The training's parts


@pytest.fixture(scope="module")
def lit_points():
    """Points of three scenes, 7 each, under lights of 5 lobes: normals, views, specular, lobes [5, 7, 3]."""
    rng = np.random.default_rng(4)
    normals, views = unit(random(3, 21, seed=5)), unit(random(3, 21, seed=6))
    lobes = np.concatenate(
        [unit(random(3, 15, seed=7)).T, rng.uniform(1, 30, (15, 1)), rng.uniform(0.1, 2, (15, 3))], axis=1
    )
    lobes = lobes.reshape(3, 5, 7).transpose(1, 2, 0)
    return normals, views, rng.uniform(0.01, 0.1, (1, 21)).astype(np.float32), lobes.astype(np.float32)


def shaded(lit_points, per_scene: bool):
    """Radiances [3, 21] and the gradients by the specular albedo and the lobes of their randomly weighted sum."""
    normals, views = (mi.TensorXf(np.ascontiguousarray(a)) for a in lit_points[:2])
    specular, lobes = (mi.TensorXf(np.ascontiguousarray(a)) for a in lit_points[2:])
    dr.enable_grad(specular, lobes)
    if per_scene:
        parts = []
        for k in range(3):
            mine = slice(7 * k, 7 * k + 7)
            white = mi.TensorXf(np.full((3, 7), np.pi, np.float32))
            material = Material(white, specular[:, mine], 0.5, 1.0)
            both = closed_form_radiance(normals[:, mine], views[:, mine], material, lobes[:, :, k])
            parts.append(both[0] + 2.0 * both[1])
        radiance = dr.concat(parts, axis=1)
    else:
        white = mi.TensorXf(np.full((3, 21), np.pi, np.float32))
        both = radiance_of_scenes(normals, views, Material(white, specular, 0.5, 1.0), lobes, 3)
        radiance = both.diffuse + 2.0 * both.specular
    dr.backward(dr.sum(radiance * mi.TensorXf(random(3, 21, seed=8)), axis=None))
    return radiance.numpy(), dr.grad(specular).numpy(), dr.grad(lobes).numpy()


def test_scenes_shaded_together_are_those_shaded_alone(lit_points):
    """`closed_form_radiance`, scene by scene, is the reference, gradients included."""
    for together, alone in zip(shaded(lit_points, False), shaded(lit_points, True), strict=True):
        assert np.abs(alone).max() > 0.01
        np.testing.assert_allclose(together, alone, rtol=1e-3, atol=1e-4 * np.abs(alone).max())


def test_shading_of_scenes_repeats_to_the_bit(lit_points):
    for first, second in zip(shaded(lit_points, False), shaded(lit_points, False), strict=True):
        np.testing.assert_array_equal(first, second)


def skin_loss(albedo: np.ndarray, weight: np.ndarray, radiance: float = SETTINGS.skin_radiance) -> float:
    """Of scenes whose landmarks all have the same albedo [S, 3], with landmark weights [S, L]."""
    columns = np.repeat(albedo.T[:, :, None], weight.shape[1], axis=2).reshape(3, -1).astype(np.float32)
    weight = mi.TensorXf(weight.reshape(1, -1).astype(np.float32))
    level = np.full(len(albedo), SETTINGS.skin.luminance * radiance / SETTINGS.skin_radiance)
    expected = SETTINGS.skin.tone_of_luminance(level)
    loss = SETTINGS.skin.loss(mi.TensorXf(columns), weight, expected)
    return float(loss.numpy().item())


def linear(srgb: list[int]) -> np.ndarray:
    return ((np.array([srgb]) / 255 + 0.055) / 1.055) ** 2.4


def test_skin_tone_loss_expects_measured_skin():
    """0 at the mean of measured skin, large for blue and for grey skin; scenes without landmarks do not count. The
    skin patches of the ColorChecker lie on the axis: they are expected when the photo is as much brighter or darker."""
    even = np.full((1, 4), 0.25)
    mean = np.exp(SETTINGS.skin.mean)
    assert skin_loss(mean[None], even) < 1e-6
    assert skin_loss(mean[None], even, radiance=float("nan")) < 1e-6
    for patch in ([194, 150, 130], [115, 82, 68]):
        ratio = (linear(patch) @ LUMINANCE).item() / (mean @ LUMINANCE).item()
        assert skin_loss(linear(patch), even) > 2
        assert skin_loss(linear(patch), even, radiance=SETTINGS.skin_radiance * ratio) < 0.3
        assert skin_loss(linear(patch), even, radiance=SETTINGS.skin_radiance / ratio) > 5
    assert skin_loss(linear([120, 120, 120]), even) > 10
    assert skin_loss(linear([130, 150, 194]), even) > 20
    both = np.concatenate([linear([194, 150, 130]), [[1.0, 1.0, 1.0]]])
    known = np.array([[0.5, 0.5], [0, 0]])
    assert skin_loss(both, known) == pytest.approx(0.5 * skin_loss(both[:1], known[:1]))


def test_skin_radiance_is_that_of_the_observations_near_the_landmarks(scene):
    landmarks = scene.points[[5, 70]]
    near = np.linalg.norm(scene.points[:, None] - landmarks, axis=2).min(axis=1) < 0.06
    luminance = (scene.sample_color @ LUMINANCE)[near[scene.sample_point]]
    assert len(luminance) > 1
    expected = np.exp(np.log(luminance).mean())
    assert af_sm.skin_radiance(scene, landmarks) == pytest.approx(expected, rel=1e-5)
    assert np.isnan(af_sm.skin_radiance(scene, landmarks[:0]))
    assert np.isnan(af_sm.skin_radiance(scene, landmarks + 50))


# A head made by the model


@pytest.fixture(scope="module")
def model():
    """A small avatar whose latents are zero, with albedo decoders that their latents move."""
    avatar = small_avatar()
    return avatar.with_tensors(**{name: np.zeros_like(avatar.tensors[name]) for name in SMALL.latents})


@pytest.fixture(scope="module")
def surface_points(model):
    """Points [N, 3] on the model's surface, by bisection along rays from the origin."""
    field = head_field(model, z_sdf=np.zeros(SMALL.sdf_latent, np.float32))
    directions = unit(random(3, 600, seed=11))
    near, far = np.full((1, 600), 0.5, np.float32), np.full((1, 600), 2.5, np.float32)
    for _ in range(24):
        middle = 0.5 * (near + far)
        f = evaluate_in_chunks(lambda x, d: signed_distance_and_slope(field, x, d)[0], middle * directions, directions)[
            0
        ]
        near, far = np.where(f < 0, middle, near), np.where(f < 0, far, middle)
    return (0.5 * (near + far) * directions).T.astype(np.float32)


@pytest.fixture(scope="module")
def true_latents():
    return {name: random(SMALL.latents[name], seed=20 + k) for k, name in enumerate(af_sm.LATENTS)}


@pytest.fixture(scope="module")
def scene(model, surface_points, true_latents):
    """What the model itself shows with `true_latents` from eight cameras."""
    centres = 8.0 * unit(random(3, 8, seed=12)).T
    inputs = ap.surface_inputs(model, model.tensors["z_sdf"], surface_points)
    way = surface_points[:, None] - centres
    way /= np.linalg.norm(way, axis=2, keepdims=True)
    point, view = np.nonzero((way * inputs[2].T[:, None]).sum(axis=2) < -0.1)
    seen = ap.factors(model, true_latents, [v[:, point] for v in inputs], way[point, view].T.astype(np.float32))
    landmarks = np.full((LANDMARKS, 3), np.nan, np.float32)
    landmarks[list(BARE_SKIN[:7])] = surface_points[:7]
    return TrainingScene(
        points=surface_points,
        normals=inputs[2].T,
        region=np.zeros(len(surface_points), np.uint8),
        volume=surface_points,
        volume_distance=np.zeros(len(surface_points), np.float32),
        landmarks=landmarks,
        sample_point=point,
        sample_view=view,
        sample_color=seen.radiance.T,
        camera_centres=centres.astype(np.float32),
    )


def held_out_of(scene: TrainingScene, model, true_latents, **changes) -> ap.HeldOut:
    """All observations of `scene` as held-out ones, with the model's own albedos as truth."""
    inputs = ap.surface_inputs(model, model.tensors["z_sdf"], scene.points)
    true = ap.factors(model, true_latents, inputs, -inputs[2])
    count = len(scene.points)
    world_to_camera = np.array([[[1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 6], [0, 0, 0, 1]]])
    values = {
        "name": "scene",
        "source": "made",
        "group": "light",
        "points": scene.points,
        "observed": np.ones(count, bool),
        "face": np.arange(count) < count // 2,
        "albedo": true.albedo.T,
        "specular": true.specular[0] / ap.F0_OF_STRENGTH,
        "sample_point": scene.sample_point,
        "sample_view": scene.views(np.arange(len(scene.sample_point))),
        "sample_color": scene.sample_color,
        "K": np.array([[[50.0, 0, 16], [0, 50, 12], [0, 0, 1]]]),
        "world_to_camera": world_to_camera,
        "images": np.zeros((1, 24, 32, 3), np.float32),
        "masks": np.ones((1, 24, 32), bool),
        "albedo_images": None,
        "specular_images": None,
    }
    return ap.HeldOut(**{**values, **changes})


BASELINE = ap.Baseline(np.array([0.5, 0.5, 0.5]), 0.4)


@pytest.mark.slow
def test_latents_fitted_to_views_of_the_model_explain_them(model, scene, true_latents):
    """Fitted to radiance alone, the latents re-render unseen directions far better than the mean head does."""
    settings = dataclasses.replace(SETTINGS, skin_tone=0.0, white_light=0.0, specular_anchor=0.0, smoothness=0.0)
    fit = ap.LatentFit(steps=120, scenes=2, points=256, embedding=0.0)
    even = scene.sample_view % 2 == 0

    def part(keep):
        samples = {k: getattr(scene, k)[keep] for k in ("sample_point", "sample_view", "sample_color")}
        return dataclasses.replace(scene, **samples)

    z_sdf = np.zeros((6, 2), np.float32)
    latents = ap.fit_appearance_latents(model, [part(even)] * 2, z_sdf, settings, fit)
    first = {name: value[:, 0] for name, value in latents.items()}
    unseen = held_out_of(part(~even), model, true_latents)
    zero = {name: np.zeros_like(value) for name, value in first.items()}
    fitted = ap.render_scores(model, first, z_sdf[:, 0], unseen)
    mean = ap.render_scores(model, zero, z_sdf[:, 0], unseen)
    assert fitted["render_psnr"] > max(mean["render_psnr"], mean["constant_render_psnr"]) + 6


def test_a_fit_of_latents_repeats_to_the_bit(model, scene):
    """With every term of the loss."""
    fit = ap.LatentFit(steps=6, scenes=2, points=256)
    first, second = (
        ap.fit_appearance_latents(model, [scene] * 2, np.zeros((6, 2), np.float32), SETTINGS, fit) for _ in range(2)
    )
    for name in af_sm.LATENTS:
        assert np.abs(first[name]).max() > 0.1
        np.testing.assert_array_equal(first[name], second[name])


def test_true_latents_score_perfectly_and_baselines_do_not(model, scene, true_latents):
    held = held_out_of(scene, model, true_latents)
    scores = ap.point_scores(model, true_latents, model.tensors["z_sdf"], held, BASELINE)
    for part in ("points", "face"):
        assert scores[f"{part}_albedo_psnr"] > 80 and scores[f"{part}_specular_psnr"] > 80
        for prefix in ("mean", "constant"):
            assert scores[f"{part}_{prefix}_albedo_psnr"] < 30 and scores[f"{part}_{prefix}_specular_psnr"] < 60
    assert scores["points_albedo_bias"] == pytest.approx(0, abs=1e-5)
    brighter = held_out_of(scene, model, true_latents, albedo=held.albedo / 2)
    assert ap.point_scores(model, true_latents, model.tensors["z_sdf"], brighter, BASELINE)[
        "points_albedo_bias"
    ] == pytest.approx(1, abs=1e-4)
    assert ap.render_scores(model, true_latents, model.tensors["z_sdf"], held)["render_psnr"] > 80


def test_images_of_the_fitted_head(model, scene, true_latents):
    """Hits lie on the surface and on their pixels' rays; the images are the factors at the hits, so that true images
    made of them score perfectly; without true images there is a clear error; the sheet has a row a head."""
    z_sdf = model.tensors["z_sdf"]
    held = held_out_of(scene, model, true_latents)
    (found,) = ap.primary_hits(model, z_sdf, held.K, held.world_to_camera, (24, 32), 0.15)
    local = found["points"] @ held.world_to_camera[0, :3, :3].T + held.world_to_camera[0, :3, 3]
    pixel = local @ held.K[0].T
    pixel = pixel[:, :2] / pixel[:, 2:]
    expected = np.stack([found["pixel"] % 32 + 0.5, found["pixel"] // 32 + 0.5], axis=1)
    assert len(pixel) > 100
    np.testing.assert_allclose(pixel, expected, atol=1e-3)

    (view,) = ap.render_views(model, true_latents, z_sdf, held, voxel=0.15)
    assert view.hit.sum() == len(pixel)
    inputs = ap.surface_inputs(model, z_sdf, found["points"])
    direct = ap.factors(model, true_latents, inputs, found["directions"].T)
    np.testing.assert_allclose(view.albedo[view.hit], direct.albedo.T, rtol=1e-5)
    np.testing.assert_allclose(view.radiance[view.hit], direct.radiance.T, rtol=1e-5)
    assert view.albedo[~view.hit].max() == 0
    assert (view.even[view.hit] >= view.albedo[view.hit] * 0.99).all()

    with pytest.raises(InputError, match="no true albedo images"):
        ap.image_scores([view], held, BASELINE)
    true = dataclasses.replace(
        held,
        masks=view.hit[None],
        albedo_images=view.albedo[None],
        specular_images=view.specular[None] / ap.F0_OF_STRENGTH,
    )
    scores = ap.image_scores([view], true, BASELINE)
    assert scores["image_covered"] == 1
    assert scores["image_albedo_psnr"] > 80 and scores["image_albedo_ssim"] == pytest.approx(1)
    assert scores["image_specular_psnr"] > 80 and scores["image_specular_ssim"] == pytest.approx(1)
    for prefix in ("mean", "constant"):
        assert scores[f"image_{prefix}_albedo_psnr"] < 30 and scores[f"image_{prefix}_albedo_ssim"] < 0.99
    sheet = ap.appearance_sheet([true, true], [view, view])
    assert sheet.shape == (48, 5 * 32, 3) and sheet.min() >= 0 and sheet.max() <= 1
    np.testing.assert_array_equal(sheet[:24, 64:96], sheet[:24, 96:128])


def test_scores_by_group(model, scene, true_latents):
    heads = [held_out_of(scene, model, true_latents, group=g, source=s) for g, s in (("a", "x"), ("b", "x"), ("a", ""))]
    rows = [{"v": 1.0}, {"v": 2.0}, {"v": 5.0}]
    assert ap.mean_scores_by(heads, rows, "group") == {"a": {"scenes": 2, "v": 3}, "b": {"scenes": 1, "v": 2}}
    assert ap.mean_scores_by(heads, rows, "source") == {"x": {"scenes": 2, "v": 1.5}}


def test_training_latents_are_those_of_the_prior(model):
    """The prior's networks with the whitened latents give what the trained networks gave with the trained ones."""
    scenes = 12
    appearance = {name: model.tensors[name] for name in af_sm.NETWORKS}
    appearance |= {name: 0.5 + random(SMALL.latents[name], scenes, seed=k) for k, name in enumerate(af_sm.LATENTS)}
    shape = {name: model.tensors[name] for name in ("deformation", "reference", "rendering")}
    shape |= {name: random(SMALL.latents[name], scenes, seed=9) for name in ("z_sdf", "z_r")}
    prior = assemble_prior(SMALL, shape, appearance, np.zeros((1, LANDMARKS, 3)), SETTINGS, 0)
    latents = ap.training_latents(appearance)
    for name in af_sm.LATENTS:
        np.testing.assert_allclose(latents[name].mean(axis=1), 0, atol=1e-5)
        np.testing.assert_allclose(latents[name].std(axis=1, ddof=1), 1, rtol=1e-4)
    inputs = [random(3, 50, seed=1), random(SMALL.features, 50, seed=2), unit(random(3, 50, seed=3))]
    views = unit(random(3, 50, seed=4))
    for k in (0, 5):
        ours = ap.factors(prior, {n: v[:, k] for n, v in latents.items()}, inputs, views)
        trained = ap.factors(model, {n: appearance[n][:, k] for n in af_sm.LATENTS}, inputs, views)
        np.testing.assert_allclose(ours.radiance, trained.radiance, rtol=5e-3)


# Scene files


def scene_arrays(views: int = 8) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    poses = np.repeat(np.eye(4)[None], views, axis=0)
    poses[:, 2, 3] = 5
    return {
        "points": random(30, 3),
        "albedo": rng.uniform(0, 1, (30, 3)).astype(np.float16),
        "specular": rng.uniform(0, 1, 30).astype(np.float16),
        "visible": rng.random((30, views)) < 0.7,
        "colors": rng.uniform(0, 1, (30, views, 3)).astype(np.float16),
        "K": np.repeat(np.eye(3)[None], views, axis=0),
        "world_to_camera": poses,
        "images": rng.uniform(0, 1, (views, 6, 6, 3)).astype(np.float16),
        "masks": np.ones((views, 6, 6), np.uint8),
        "landmarks": np.zeros((LANDMARKS, 3), np.float32),
    }


def test_only_held_out_views_are_loaded(tmp_path):
    arrays = scene_arrays()
    np.savez(tmp_path / "scene.npz", **arrays)
    held = ap.load_held_out(tmp_path / "scene.npz", source="s", group="g")
    views = list(HELD_OUT_VIEWS)
    assert (held.name, held.source, held.group) == ("scene", "s", "g") and held.albedo_images is None
    assert len(held.sample_point) == arrays["visible"][:, views].sum()
    true = np.concatenate([arrays["colors"][p, views] for p in [held.sample_point[0]]])
    assert np.abs(true - held.sample_color[0]).sum(axis=1).min() < 1e-3
    np.testing.assert_array_equal(held.images, arrays["images"][views].astype(np.float32))
    centre = np.array([0, 0, -5.0])
    way = arrays["points"][held.sample_point] - centre
    np.testing.assert_allclose(held.sample_view, way / np.linalg.norm(way, axis=1, keepdims=True), rtol=1e-5)
    baseline = ap.training_baseline([held])
    observed = arrays["visible"].any(axis=1)
    np.testing.assert_allclose(baseline.albedo, arrays["albedo"][observed].astype(float).mean(axis=0), rtol=1e-3)


def test_a_file_that_is_no_scene_is_named(tmp_path):
    (tmp_path / "scene.npz").write_text(json.dumps(LUMINANCE))
    with pytest.raises(InputError, match="not a scene"):
        ap.load_held_out(tmp_path / "scene.npz")
