"""The integrators `sira_radiance` and `sira_sg` and their camera: channels, derivatives, repeatability, errors.

Rays go through pixel centres and hits are exact, so derivatives are compared without noise."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from conftest import camera, slopes
from scipy.ndimage import binary_erosion

from sira_mi.avatar.decoders import light_refinement
from sira_mi.avatar.file import save_avatar
from sira_mi.conventions import DOMAIN_LOWER, DOMAIN_UPPER
from sira_mi.errors import InputError
from sira_mi.export import scene as scenes
from sira_mi.fields.columns import evaluate_in_chunks
from sira_mi.fields.mlp import initial_parameters, layers
from sira_mi.fields.sdf import deform, signed_distance, surface
from sira_mi.fit.rays import Window, find_modelled_pixels, pixel_rays, window_around, window_pixels
from sira_mi.portrait.camera import Camera

CENTRES = {"type": "stratified", "jitter": False, "sample_count": 1}
SIZE = 24
FAR = 1.0
SG_CHANNELS = {
    "diffuse": slice(4, 7),
    "specular": slice(7, 10),
    "diffuse_albedo": slice(10, 13),
    "specular_albedo": 13,
    "normal": slice(14, 17),
    "depth": 17,
    "mask": 18,
}


def build(path, avatar, integrator, sensor=None, light=True, **others):
    description = {
        "type": "scene",
        "head": scenes.head(path, voxel=0.2),
        "sensor": scenes.sensor(sensor or camera(30, SIZE), CENTRES),
        "integrator": integrator,
        **others,
    }
    if light:
        description["light"] = {"type": "sg_envmap", "lobes": mi.TensorXf(avatar.tensors["lobes"])}
    return mi.load_dict(description)


def head_of(scene):
    return next(shape for shape in scene.shapes() if type(shape).__name__ == "NeuralSDF")


def weights(channels: int, seed: int = 5) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0, 1, (SIZE, SIZE, channels)).astype(np.float32)


def check(scene, key: str, weight: np.ndarray, change: float = 2e-3, tolerance: float = 1e-3):
    """AD of the mean of weight × channels by the scene's parameter `key`, against differences of whole updates."""
    params = mi.traverse(scene)
    kind, start = type(params[key]), params[key].numpy().copy()
    weight = mi.TensorXf(weight)

    def value_of(flat):
        return kind(np.ascontiguousarray(flat.reshape(start.shape), np.float32))

    def put(flat):
        params[key] = value_of(flat)

    value = value_of(start)
    dr.enable_grad(value)
    params[key] = value
    params.update()
    dr.backward(dr.sum(mi.render(scene, params) * weight, axis=None))
    gradient = dr.grad(value).numpy().ravel()

    def loss(flat):
        put(flat)
        params.update()
        return float((mi.render(scene).numpy().astype(np.float64) * weight.numpy()).sum())

    try:
        ad, difference = slopes(loss, start.ravel(), gradient, change)
    finally:
        put(start)
        params.update()
    print(f"{key}: {ad:.6g} {difference:.6g}")
    assert ad == pytest.approx(difference, rel=tolerance), key


# sira_radiance


@pytest.fixture(scope="module")
def radiance(avatar, avatar_path):
    return build(avatar_path, avatar, {"type": "sira_radiance", "avatar": avatar_path}, light=False)


@pytest.fixture(scope="module")
def radiance_image(radiance):
    return mi.render(radiance).numpy()


def refusal(scene) -> str:
    """All messages of the error that rendering ends with."""
    with pytest.raises(Exception) as caught:
        mi.render(scene)
    messages, error = [], caught.value
    while error is not None:
        messages.append(str(error))
        error = error.__cause__ or error.__context__
    return " ".join(messages)


def interior(alpha: np.ndarray) -> np.ndarray:
    """Pixels that hit the head, two away from its outline."""
    return binary_erosion(alpha > 0.5, iterations=2)


@pytest.mark.slow
def test_radiance_channels(radiance, radiance_image):
    """Alpha marks hits, `closest` is min f along the ray (dense sampling), `mask` its soft step."""
    image, head = radiance_image, head_of(radiance)
    assert image.shape == (SIZE, SIZE, 6)
    alpha, mask, closest = image[:, :, 3], image[:, :, 4], image[:, :, 5]
    assert set(np.unique(alpha)) == {0.0, 1.0}
    np.testing.assert_allclose(mask, 1 / (1 + np.exp(np.clip(50 * closest, -60, 60))), atol=1e-5)
    assert (closest[alpha > 0.5] < 1e-3).all() and (closest[alpha < 0.5] > -0.02).all()
    assert (image[alpha < 0.5][:, :3] == 0).all() and (image[alpha > 0.5][:, :3] > 0).all()
    columns, rows = np.meshgrid(np.arange(SIZE), np.arange(SIZE))
    origin, direction = pixel_rays(camera(30, SIZE), columns.ravel(), rows.ravel())
    t = np.linspace(2.5, 7.5, 400)
    points = (origin[:, :, None] + direction[:, :, None] * t).transpose(1, 0, 2).reshape(3, -1).astype(np.float32)
    best = (
        evaluate_in_chunks(lambda x: signed_distance(head.field(), x), points)[0].reshape(SIZE * SIZE, -1).min(axis=1)
    )
    best = best.reshape(SIZE, SIZE)
    near = np.abs(best) < 0.1
    assert near.sum() > 10
    np.testing.assert_allclose(closest[near], best[near], atol=5e-3)


@pytest.mark.slow
def test_a_ray_outside_the_box_is_far(avatar, avatar_path):
    wide = build(avatar_path, avatar, {"type": "sira_radiance", "avatar": avatar_path}, camera(6, SIZE), light=False)
    image = mi.render(wide).numpy()
    assert image[0, 0, 5] == FAR and image[0, 0, 4] < 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("key", ["head.z_sdf", "head.deformation", "head.reference"])
def test_colour_derivatives_by_the_shape(radiance, radiance_image, key):
    weight = weights(6) * interior(radiance_image[:, :, 3])[:, :, None]
    weight[:, :, 3:] = 0
    check(radiance, key, weight, change=3e-4)


@pytest.mark.slow
@pytest.mark.parametrize("key", ["head.z_sdf", "head.deformation", "head.reference"])
def test_silhouette_derivatives_by_the_closest_approach(radiance, radiance_image, key):
    weight = np.zeros((SIZE, SIZE, 6), np.float32)
    closest = radiance_image[:, :, 5]
    weight[:, :, 5] = weights(1)[:, :, 0] * (np.abs(closest) < 0.15) * np.sign(closest)  # no cancellation
    assert (weight != 0).sum() > 30
    check(radiance, key, weight, tolerance=2e-3)


@pytest.mark.parametrize("key", ["integrator.rendering", "integrator.z_r"])
def test_colour_derivatives_by_the_rendering_function(radiance, key):
    weight = weights(6)
    weight[:, :, 3:] = 0
    check(radiance, key, weight)


@pytest.mark.slow
def test_other_shapes_occlude(avatar, avatar_path, radiance_image):
    """A screen before the left half of the head; the soft mask is of the head alone."""
    screen = {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().translate([-1, 0, 2.5]),
        "bsdf": {"type": "diffuse"},
    }
    scene = build(avatar_path, avatar, {"type": "sira_radiance", "avatar": avatar_path}, light=False, screen=screen)
    image = mi.render(scene).numpy()
    right = slice(SIZE // 2 + 1, None)
    np.testing.assert_allclose(image[:, right], radiance_image[:, right], atol=1e-5)
    middle = slice(SIZE // 2 - 2, SIZE // 2)
    assert (radiance_image[middle, middle, 3] == 1).all() and (image[middle, middle, :4] == 0).all()


@pytest.mark.parametrize("integrator", ["sira_radiance", "sira_sg"])
@pytest.mark.parametrize("heads", [0, 2])
def test_one_head_is_needed(avatar, avatar_path, integrator, heads):
    shapes = {f"head{k}": scenes.head(avatar_path, voxel=0.4) for k in range(heads)}
    options = {"avatar": avatar_path} if integrator == "sira_radiance" else {}
    scene = mi.load_dict(
        {
            "type": "scene",
            **(shapes or {"ball": {"type": "sphere"}}),
            "sensor": scenes.sensor(camera(30, 8), CENTRES),
            "integrator": {"type": integrator, **options},
        },
        optimize=False,  # Mitsuba makes one texture of two that are alike
    )
    assert f"exactly one neural_sdf, it holds {heads}" in refusal(scene)


@pytest.mark.slow
def test_a_picture_with_one_ray_on_the_head(avatar, avatar_path, radiance_image):
    """A film of one pixel: tensors of one column."""
    hit = Camera(np.array([[30.0, 0, 0.5], [0, 30, 0.5], [0, 0, 1]]), camera(30).world_to_camera, 1, 1)
    for integrator in ({"type": "sira_radiance", "avatar": avatar_path}, {"type": "sira_sg"}):
        scene = build(avatar_path, avatar, integrator, hit)
        params = mi.traverse(scene)
        value = mi.Float(avatar.tensors["z_sdf"])
        dr.enable_grad(value)
        params["head.z_sdf"] = value
        params.update()
        image = mi.render(scene, params)
        assert image.numpy()[0, 0, 3] == 1 and np.isfinite(image.numpy()).all()
        dr.backward(dr.sum(image, axis=None))
        assert np.isfinite(dr.grad(value).numpy()).all() and np.abs(dr.grad(value).numpy()).max() > 0


# sira_sg


@pytest.fixture(scope="module")
def shaded(avatar, avatar_path):
    return build(avatar_path, avatar, {"type": "sira_sg", "aovs": True})


@pytest.fixture(scope="module")
def shaded_image(shaded):
    return mi.render(shaded).numpy()


def test_channels_of_the_closed_form(shaded, shaded_image):
    """Depth, normal and albedos against the field itself at the hits; nothing off the head."""
    head = head_of(shaded)
    part = {name: shaded_image[:, :, channel] for name, channel in SG_CHANNELS.items()}
    mask = part["mask"] == 1
    assert 100 < mask.sum() < SIZE * SIZE
    columns, rows = np.meshgrid(np.arange(SIZE), np.arange(SIZE))
    origin, direction = pixel_rays(camera(30, SIZE), columns[mask], rows[mask])
    x = (origin + part["depth"][mask][:, None] * direction).T.astype(np.float32)
    f, gradient, x_ref, gamma = evaluate_in_chunks(lambda p: surface(head.field(), p), x)
    assert np.abs(f).max() < 2e-3  # the ray starts at the near plane
    np.testing.assert_allclose(part["normal"][mask].T, gradient / np.linalg.norm(gradient, axis=0), atol=2e-3)
    bsdf = head.bsdf()
    albedo = bsdf.diffuse_albedo.evaluate_networks(mi.TensorXf(x_ref), mi.TensorXf(gamma)).numpy()
    specular = bsdf.specular_albedo.evaluate_networks(mi.TensorXf(x_ref), mi.TensorXf(gamma)).numpy()
    np.testing.assert_allclose(part["diffuse_albedo"][mask].T, albedo, atol=2e-3)
    np.testing.assert_allclose(part["specular_albedo"][mask], specular[0], atol=2e-3)
    np.testing.assert_allclose(
        shaded_image[:, :, :3][mask], part["diffuse"][mask] + part["specular"][mask], rtol=1e-5, atol=1e-6
    )
    for name in ("diffuse", "specular"):
        assert (part[name][mask] >= 0).all() and part[name][mask].max() > 0.01
    for name, values in part.items():
        assert (values[~mask] == 0).all(), name


@pytest.mark.parametrize("exact", [True, False])
def test_a_refined_light_multiplies_the_radiance_alone(avatar, avatar_path, tmp_path, exact):
    """By exp of the network at the hit, in reference space; the channels are those of eq. 8. An avatar without a
    refinement changes nothing."""
    rng = np.random.default_rng(8)
    network = avatar.architecture.networks["light_refinement"]
    parameters = initial_parameters(network, rng, output_scale=0.5)
    path = tmp_path / "refined.safetensors"
    save_avatar(path, avatar.with_tensors(light_refinement=parameters))

    def image(**options):
        integrator = {"type": "sira_sg", "aovs": True, "hide_emitters": True, "exact": exact, **options}
        scene = build(avatar_path, avatar, integrator)
        return scene, mi.render(scene).numpy()

    scene, plain = image()
    refined = image(light_refinement=str(path))[1]
    for same, other in ((image(light_refinement=avatar_path)[1], plain), (refined[..., 4:], plain[..., 4:])):
        np.testing.assert_allclose(same, other, rtol=1e-5, atol=1e-6)
    mask = plain[..., SG_CHANNELS["mask"]] > 0
    rows, columns = np.nonzero(mask)
    origin, direction = pixel_rays(camera(30, SIZE), columns, rows)
    x = (origin + direction * plain[..., SG_CHANNELS["depth"]][mask][:, None]).T
    x_ref, gamma = deform(head_of(scene).field(), mi.TensorXf(np.ascontiguousarray(x, np.float32)))
    layer = layers(network, mi.Float(parameters))
    factor = np.exp(light_refinement(layer, avatar.architecture.refinement_octaves, x_ref, gamma).numpy()).T
    np.testing.assert_allclose(refined[mask][:, :3], factor * plain[mask][:, :3], rtol=5e-3)
    assert factor.std() > 0.05


def test_normals_are_world_normals_of_a_turned_head(avatar, avatar_path, shaded_image):
    """Head and camera turned together: the same picture but for normals, which turn, and the light, which does not."""
    matrix = mi.ScalarTransform4f().rotate([0, 1, 0], 35)
    still = camera(30, SIZE)
    turn = np.array(matrix.matrix, np.float64)
    moved = Camera(still.K, still.world_to_camera @ turn.T, SIZE, SIZE)
    lobes = mi.TensorXf(avatar.tensors["lobes"])
    scene = mi.load_dict(
        {
            "type": "scene",
            "head": scenes.head(avatar_path, voxel=0.2, to_world=matrix),
            "sensor": scenes.sensor(moved, CENTRES),
            "light": {"type": "sg_envmap", "lobes": lobes, "to_world": matrix},
            "integrator": {"type": "sira_sg", "aovs": True},
        }
    )
    image = mi.render(scene).numpy()
    inside = interior(shaded_image[:, :, 18])
    for name, channel in SG_CHANNELS.items():
        expected = shaded_image[:, :, channel][inside]
        expected = expected @ turn[:3, :3].T if name == "normal" else expected
        np.testing.assert_allclose(image[:, :, channel][inside], expected, atol=2e-3, err_msg=name)


@pytest.mark.slow
@pytest.mark.parametrize(
    "key",
    [
        "light.lobes",
        "head.bsdf.k_s",
        "head.bsdf.roughness",
        "head.bsdf.diffuse_albedo.weights",
        "head.bsdf.diffuse_albedo.latent",
        "head.bsdf.diffuse_albedo.refinement",
        "head.bsdf.diffuse_albedo.k_r",
        "head.bsdf.specular_albedo.weights",
        "head.z_sdf",
    ],
)
def test_derivatives_of_the_closed_form(shaded, shaded_image, key):
    weight = weights(19) * interior(shaded_image[:, :, 18])[:, :, None]
    weight[:, :, 3:] = 0
    check(shaded, key, weight, change=3e-4 if key == "head.z_sdf" else 2e-3)


@pytest.mark.slow
def test_pictures_and_derivatives_repeat_bit_for_bit(avatar, avatar_path):
    def run():
        scene = build(avatar_path, avatar, {"type": "sira_sg", "aovs": True, "hide_emitters": True})
        params = mi.traverse(scene)
        keys = ("light.lobes", "head.z_sdf", "head.bsdf.diffuse_albedo.weights", "head.bsdf.roughness")
        values = {key: type(params[key])(params[key]) for key in keys}
        dr.enable_grad(values)
        for key, value in values.items():
            params[key] = value
        params.update()
        image = mi.render(scene, params)
        dr.backward(dr.mean(image, axis=None))
        return [image.numpy(), *(dr.grad(value).numpy() for value in values.values())]

    first = run()
    for _ in range(2):
        for a, b in zip(first, run(), strict=True):
            np.testing.assert_array_equal(a, b)
    assert all(np.abs(a).max() > 0 for a in first)


def test_other_materials_and_lights_are_named(avatar, avatar_path):
    scene = build(avatar_path, avatar, {"type": "sira_sg"}, light=False, sky={"type": "constant"})
    assert "must be an sg_envmap" in refusal(scene)
    scene = mi.load_dict(
        {
            "type": "scene",
            "head": {"type": "neural_sdf", "avatar": avatar_path, "voxel": 0.4},
            "sensor": scenes.sensor(camera(30, 8), CENTRES),
            "light": {"type": "sg_envmap"},
            "integrator": {"type": "sira_sg"},
        }
    )
    assert "must have a sira_bsdf" in refusal(scene)


# The camera


def off_centre() -> Camera:
    """A camera that is turned, shifted, not square, and has its principal point off the middle."""
    angle = np.radians(20)
    pose = np.eye(4)
    pose[:3, :3] = np.diag([1.0, -1, -1]) @ [
        [np.cos(angle), 0, -np.sin(angle)],
        [0, 1, 0],
        [np.sin(angle), 0, np.cos(angle)],
    ]
    pose[:3, 3] = [0.2, 0.3, 6.0]
    return Camera(np.array([[90.0, 0, 40.0], [0, 90.0, 14.0], [0, 0, 1]]), pose, 60, 40)


def test_mitsuba_looks_through_the_pixels_that_the_camera_projects_to():
    for lens in (off_centre(), camera(36)):
        points = np.random.default_rng(0).uniform(-1, 1, (50, 3))
        pixel = lens.project(points)
        sensor = mi.load_dict(scenes.sensor(lens))
        position = mi.Point2f((pixel / [lens.width, lens.height]).T)
        ray, _ = sensor.sample_ray(0.0, 0.5, position, mi.Point2f(0.5))
        origin, direction = np.array(ray.o).T, np.array(ray.d).T
        offset = points - origin
        across = offset - (offset * direction).sum(axis=1, keepdims=True) * direction
        assert np.linalg.norm(across, axis=1).max() < 1e-3
        assert ((offset * direction).sum(axis=1) > 0).all()


def test_pixel_rays_are_mitsubas_rays():
    lens = off_centre()
    columns, rows = np.array([0, 30, 59]), np.array([0, 25, 39])
    origin, direction = pixel_rays(lens, columns, rows)
    sensor = mi.load_dict(scenes.sensor(lens))
    position = mi.Point2f((columns + 0.5) / lens.width, (rows + 0.5) / lens.height)
    ray, _ = sensor.sample_ray(0.0, 0.5, position, mi.Point2f(0.5))
    np.testing.assert_allclose(np.array(ray.d).T, direction, atol=1e-5)
    np.testing.assert_allclose(lens.project(origin + 3 * direction), np.stack([columns, rows], 1) + 0.5, atol=1e-9)


def test_the_shifted_grids_of_a_window_show_every_photo_pixel_once():
    window = window_around(5, 3, 50, 38, 16)
    assert window.left <= 5 and window.top <= 3
    assert window.left + window.stride * window.size >= 50 and window.top + window.stride * window.size >= 38
    shifts = [(x, y) for y in range(window.stride) for x in range(window.stride)]
    seen = np.concatenate([np.stack(window_pixels(window, shift), axis=-1).reshape(-1, 2) for shift in shifts])
    side = np.arange(window.stride * window.size)
    expected = np.stack(np.meshgrid(window.left + side, window.top + side), axis=-1).reshape(-1, 2)
    np.testing.assert_array_equal(np.unique(seen, axis=0), np.unique(expected, axis=0))
    assert len(seen) == len(expected)
    assert window_around(0, 0, 4, 4, 16) == Window(-6, -6, 1, 16)


def test_modelled_pixels_are_those_whose_rays_leave_the_box_through_a_wall():
    """Against marching along every ray."""
    pose = camera(20, 40).world_to_camera.copy()
    pose[1, 3] = 1.0
    lens = Camera(np.array([[25.0, 0, 20], [0, 25, 20], [0, 0, 1]]), pose, 40, 40)
    columns, rows = np.meshgrid(np.arange(40), np.arange(40))
    origin, direction = pixel_rays(lens, columns, rows)
    expected = np.zeros((40, 40), bool)
    t = np.linspace(0, 20, 4000)
    for row in range(0, 40, 3):
        p = origin[row, :, None] + t[:, None] * direction[row, :, None]
        inside = ((p > DOMAIN_LOWER) & (p < DOMAIN_UPPER)).all(axis=-1)
        last = np.where(inside.any(axis=1), inside.shape[1] - 1 - inside[:, ::-1].argmax(axis=1), 0)
        leaving = p[np.arange(40), np.minimum(last + 1, len(t) - 1)]
        expected[row] = inside.any(axis=1) & (leaving[:, 1] > DOMAIN_LOWER[1])
        np.testing.assert_array_equal(find_modelled_pixels(lens)[row], expected[row])
    assert expected.sum() > 0


def test_orbiting_turns_the_view_about_the_vertical_axis():
    """Turned by +90° to its left, the head shows its right side: the camera stands at −x."""
    turned = scenes.orbit(camera(36), 90.0)
    np.testing.assert_allclose(turned.centre, [-5, 0, 0], atol=1e-9)
    np.testing.assert_allclose(scenes.orbit(camera(36), 0.0).centre, [0, 0, 5], atol=1e-9)


# Every parameter alone

PLAIN_PARAMETERS = [
    "light.lobes",
    "light.scale",
    "head.bsdf.diffuse_albedo.value",
    "head.bsdf.specular_albedo.value",
    "head.bsdf.k_s",
    "head.bsdf.roughness",
    "head.deformation",
    "head.reference",
    "head.z_sdf",
    "head.pose",
]
# Of the mesh, which follows the parameters above and is no parameter of the field.
MESH_ARRAYS = {
    "silhouette_sampling_weight",
    "faces",
    "vertex_positions",
    "vertex_normals",
    "vertex_texcoords",
    "vertex_unmerged",
}


def posed(scene):
    """The scene with its head moved a little: differences are taken in proportion to a parameter."""
    params = mi.traverse(scene)
    params["head.pose"] = mi.Float([0.2, -0.3, 0.1, 0.2, 0.1, -0.3])
    params.update()
    return scene


@pytest.fixture(scope="module")
def movable(avatar, avatar_path):
    """A movable head with stock albedos: no network of the albedo has gradients beside the parameter under test."""
    head = scenes.head(avatar_path, voxel=0.2, movable=True)
    head["bsdf"]["diffuse_albedo"] = {"type": "rgb", "value": [0.6, 0.4, 0.3]}
    head["bsdf"]["specular_albedo"] = 0.04
    return posed(build(avatar_path, avatar, {"type": "sira_sg", "aovs": True}, head=head))


def test_the_parameters_tested_are_all_that_head_and_light_expose(movable):
    exposed = {key for key in mi.traverse(movable).keys() if key.startswith(("light.", "head."))}  # noqa: SIM118
    arrays = {key for key in exposed if key.split(".")[-1] in MESH_ARRAYS}
    assert exposed - arrays == set(PLAIN_PARAMETERS)


@pytest.mark.slow
@pytest.mark.parametrize("key", PLAIN_PARAMETERS)
def test_derivatives_of_the_closed_form_by_each_parameter_alone(movable, key):
    weight = weights(19) * interior(mi.render(movable).numpy()[:, :, 18])[:, :, None]
    weight[:, :, 3:] = 0
    shape = key in ("head.z_sdf", "head.deformation", "head.reference", "head.pose")
    check(movable, key, weight, change=3e-4 if shape else 2e-3, tolerance=3e-3 if shape else 1e-3)


@pytest.mark.slow
def test_radiance_is_differentiable_by_the_pose_alone(avatar, avatar_path):
    head = scenes.head(avatar_path, voxel=0.2, movable=True)
    head["bsdf"] = {"type": "diffuse"}
    scene = posed(build(avatar_path, avatar, {"type": "sira_radiance", "avatar": avatar_path}, light=False, head=head))
    weight = weights(6) * interior(mi.render(scene).numpy()[:, :, 3])[:, :, None]
    weight[:, :, 3:] = 0
    check(scene, "head.pose", weight, change=3e-4, tolerance=3e-3)


def test_numbers_of_lobes_are_checked():
    """`sira_sg` refuses numbers of lobes that the light does not have."""
    lobes = np.random.default_rng(0).uniform(0.1, 1, (5, 7)).astype(np.float32)
    for numbers in ([5], [-1], [0, 7]):
        integrator = mi.load_dict({"type": "sira_sg", "shaded_lobes": mi.TensorXf(np.array(numbers, np.float32))})
        with pytest.raises(InputError, match="numbers of lobes"):
            integrator.select_lobes(mi.TensorXf(lobes))
    integrator = mi.load_dict({"type": "sira_sg", "shaded_lobes": mi.TensorXf(np.array([2, 0], np.float32))})
    np.testing.assert_array_equal(integrator.select_lobes(mi.TensorXf(lobes)).numpy(), lobes[[2, 0]])
