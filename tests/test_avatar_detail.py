"""The detail of the albedo: where a photo shows a point, and what a fit makes of the photo."""

from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
from conftest import camera

from sira_mi.avatar.detail import AlbedoDetail
from sira_mi.avatar.file import DETAIL, load_avatar, save_avatar
from sira_mi.errors import InputError
from sira_mi.fit.settings import QUALITIES
from sira_mi.fit.state import FitState
from sira_mi.portrait.portrait import Portrait

DEPTH = 4.0  # of the plane z = 1 before `camera`
SIZE, FACTOR = 48, 4  # of the working image, and how many times as large the photo is
STRIPE = np.array([0.1, 0.7])


def flat_detail(weight=1.0, columns=8):
    """Columns of different albedos on the plane z = 1, seen by `camera`."""
    view = camera(60, SIZE)
    detail = np.full((4, columns, 4), weight, np.float32)
    detail[..., :3] = (np.arange(columns)[:, None] + np.array([0, 0.1, 0.2])) / columns
    to_unit = np.diag([1 / SIZE, 1 / SIZE, 1.0])
    return {
        "detail": detail,
        "detail_depth": np.full((4, columns), DEPTH, np.float32),
        "detail_camera": (to_unit @ view.K @ view.world_to_camera[:3]).astype(np.float32),
    }


def blended(tensors, points):
    """[3, N] at points [N, 3], over an albedo of 0.9."""
    point = mi.Point3f(np.array(points, np.float32).T)
    return np.array(mi.Color3f(*AlbedoDetail(tensors).blend([mi.Float(0.9)] * 3, point)))


def point_of_column(column, columns=8, z=1.0):
    """The point at a height z that the middle of a column of the picture shows."""
    pixel = (column + 0.5) / columns * SIZE
    return [(pixel - SIZE / 2) / 60 * (5 - z), 0.0, z]


def test_a_point_takes_the_albedo_of_its_pixel(variant):
    found = blended(flat_detail(), [point_of_column(k) for k in range(8)])
    np.testing.assert_allclose(found, flat_detail()["detail"][0, :, :3].T, atol=1e-3)


def test_half_a_weight_is_half_the_detail(variant):
    whole, half = (blended(flat_detail(w), [point_of_column(3)]) for w in (1.0, 0.5))
    np.testing.assert_allclose(half, (whole + 0.9) / 2, atol=1e-4)


@pytest.mark.parametrize(
    "point",
    [point_of_column(3, z=0.7), point_of_column(3, z=1.3), [9.0, 0.0, 1.0], [0.0, 0.0, 7.0]],
    ids=["behind the surface", "before it", "outside the frame", "behind the camera"],
)
def test_a_point_that_the_photo_does_not_show_keeps_its_albedo(variant, point):
    np.testing.assert_allclose(blended(flat_detail(), [point]), 0.9, atol=1e-6)


@pytest.mark.parametrize("name", ["detail", "detail_depth", "detail_camera"])
def test_a_detail_is_whole_or_refused(avatar, tmp_path, name):
    """It comes back from a file; without one of its tensors, or with one of another shape, the file is damaged."""
    tensors = {**avatar.tensors, **flat_detail()}
    save_avatar(tmp_path / "a", replace(avatar, tensors=tensors))
    np.testing.assert_array_equal(load_avatar(tmp_path / "a").tensors[name], tensors[name])
    for wrong in ({k: v for k, v in tensors.items() if k != name}, {**tensors, name: tensors[name][:3, :3, ..., None]}):
        save_avatar(tmp_path / "b", replace(avatar, tensors=wrong))
        with pytest.raises(InputError, match="damaged"):
            load_avatar(tmp_path / "b")


@pytest.mark.slow
def test_a_fit_finds_the_stripes_of_a_photo(variant, avatar, tmp_path):
    """Of a head with stripes half as wide as a pixel of the working image; rendered by eq. 8 of the same head."""
    from sira_mi.fit.shaded import find_surface_points, shade_points
    from sira_mi.fit.stage import FitTask

    avatar = avatar.with_tensors(landmarks=np.zeros((468, 3)))
    path = tmp_path / "prior.safetensors"
    save_avatar(path, avatar)
    head = mi.load_dict({"type": "neural_sdf", "avatar": str(path), "voxel": 0.05})
    view, nowhere = camera(60, SIZE), np.full((468, 2), np.nan)
    large = view.scale(FACTOR, FACTOR, FACTOR * SIZE, FACTOR * SIZE)
    settings = replace(QUALITIES["draft"], voxel=0.05)
    blank = Portrait(
        *(np.ones((large.height, large.width, 3)[:n], np.float32) for n in (3, 2)), nowhere, nowhere, large, ()
    )
    task = FitTask(blank, avatar, path, settings, tmp_path, settings.plan())
    points = task.photo_points(blank, head)
    true = STRIPE[points.column // 2 % 2]
    state = FitState.of_avatar(avatar)
    floats = {name: mi.Float(v) for name, v in state.avatar.items()}
    albedo = mi.TensorXf(np.repeat(true[None], 3, axis=0).astype(np.float32))
    shading = shade_points(avatar, floats, 1.0, points, albedo)
    photo = np.zeros((large.height, large.width, 3), np.float32)
    photo[points.row, points.column] = (shading.diffuse + shading.specular).numpy().T
    mask = np.zeros((large.height, large.width), np.float32)
    mask[points.row, points.column] = 1

    coarse, covered = (a.reshape(SIZE, FACTOR, SIZE, FACTOR, -1).mean(axis=(1, 3)) for a in (photo, mask))
    portrait = Portrait(
        coarse.astype(np.float32), covered[..., 0].astype(np.float32), nowhere, nowhere, view, (), sharp=photo
    )
    task = FitTask(portrait, avatar, path, settings, tmp_path, settings.plan())
    fitted = settings.stages[-1].problem(task, state).start(state).avatar
    found = {name: fitted[name] for name in DETAIL}
    assert found["detail"].shape == (*photo.shape[:2], 4)
    detail = found["detail"][points.row, points.column]
    whole = detail[:, 3] == 1
    assert whole.mean() > 0.6
    assert np.median(np.abs(detail[whole, :3] - true[whole, None])) < 0.01
    assert np.quantile(np.abs(detail[whole, :3] - true[whole, None]), 0.9) < 0.04

    save_avatar(tmp_path / "fitted", avatar.with_tensors(**fitted))
    shown = mi.load_dict(
        {
            "type": "neural_sdf",
            "avatar": str(tmp_path / "fitted"),
            "voxel": 0.05,
            "bsdf": {
                "type": "sira_bsdf",
                "diffuse_albedo": {"type": "neural_albedo", "avatar": str(tmp_path / "fitted")},
            },
        }
    )
    seen = find_surface_points(large, shown)
    texture = shown.bsdf().diffuse_albedo
    place = (seen.origin + seen.t * seen.view).astype(np.float32)
    columns = texture.evaluate_columns(mi.TensorXf(place), mi.TensorXf(seen.x_ref), mi.TensorXf(seen.gamma)).numpy()
    expected = found["detail"][seen.row, seen.column]
    sure = expected[:, 3] == 1
    assert np.quantile(np.abs(columns.T[sure] - expected[sure, :3]), 0.9) < 0.02


def test_the_light_is_scaled_to_the_tone_of_the_skin(variant):
    """Skin under a light brighter than the fit's by a factor a channel, specular term included; where none is seen, and
    in a channel where no light within three stops does it, the light stays as it is."""
    from sira_mi.fit.detail import find_light_factors

    rng = np.random.default_rng(0)
    irradiance, specular = rng.uniform(0.2, 0.8, (3, 51)), rng.uniform(0.0, 0.05, (3, 51))
    tone, factors = np.array([0.3, 0.2, 0.1]), np.array([1.7, 0.6, 1.0])
    radiance = factors[:, None] * (tone[:, None] * irradiance + specular)
    np.testing.assert_allclose(find_light_factors(radiance, irradiance, specular, tone), factors, rtol=2e-3)
    assert (find_light_factors(radiance[:, :0], irradiance[:, :0], specular[:, :0], tone) == 1).all()
    radiance[0] *= 100
    np.testing.assert_allclose(find_light_factors(radiance, irradiance, specular, tone), [1, 0.6, 1], rtol=2e-3)
