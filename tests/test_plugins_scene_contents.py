"""What else a user's scene may hold or set: numbers that no plugin takes, heads at any scale, other shapes and lights.
Each gives the right picture or an error that names it."""

import sira_mi  # noqa: F401, I001  (first: Dr.Jit must find LLVM)

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from conftest import camera

from sira_mi import scene_path
from sira_mi.export.scene_file import write_scene
from sira_mi.sg.fit_environment import pixel_directions, total_light
from sira_mi.sg.lights_io import write_lights

mi.set_variant("llvm_ad_rgb")

T = mi.ScalarTransform4f
NAN, INFINITY = float("nan"), float("inf")
LOBES = np.array([[0.5, 0.5, 0.7, 4, 1, 1, 1], [0, 1, 0, 1e-3, 0.2, 0.2, 0.2]], np.float32)
SIZE = 24


def light(lobes=LOBES, **options):
    return {"type": "sg_envmap", "lobes": mi.TensorXf(np.array(lobes, np.float32)), **options}


def head(**options):
    return {"type": "neural_sdf", "voxel": 0.3, "bsdf": {"type": "sira_bsdf"}, **options}


def scene(integrator, scale=1.0, shape=None, **more):
    """A head in front of a camera, all of it `scale` times as large."""
    eye = {
        "type": "perspective",
        "fov": 22,
        "near_clip": 0.01 * scale,
        "far_clip": 1000 * scale,
        "to_world": T().look_at([0, 0, 14 * scale], [0, 0, 0], [0, 1, 0]),
        "film": {
            "type": "hdrfilm",
            "width": SIZE,
            "height": SIZE,
            "rfilter": {"type": "box"},
            "component_format": "float32",
            "pixel_format": "rgba",
        },
    }
    shape = shape or head(to_world=T().scale(scale))
    return mi.load_dict(
        {"type": "scene", "integrator": integrator, "sensor": eye, "head": shape, "light": light(), **more}
    )


def picture(scene, spp=1):
    return mi.render(scene, spp=spp, seed=1).numpy()


def refusal(call) -> str:
    """The line in which a call is refused."""
    with pytest.raises(Exception) as caught:
        call()
    return str(caught.value.__cause__ or caught.value).strip().splitlines()[-1]


def lobe(**changes):
    row = dict(zip("xyzsrgb", [0.0, 0, 1, 2, 1, 1, 1], strict=True)) | changes
    return list(row.values())


BAD_LOBES = {
    "finite": [lobe(r=NAN)],
    "zero length": [lobe(z=0)],
    "sharpness": [lobe(s=-1)],
    "negative amplitude": [lobe(), lobe(g=-1e-3)],
    "brighter": [lobe(r=1e38)] * 40,
}


@pytest.mark.parametrize("word", BAD_LOBES)
def test_lobes_are_refused_by_loading_and_by_update(word):
    bad = np.array(BAD_LOBES[word], np.float32)
    assert word in refusal(lambda: mi.load_dict(light(bad)))
    params = mi.traverse(mi.load_dict(light()))
    params["lobes"] = mi.TensorXf(bad)
    line = refusal(params.update)
    assert word in line and "sg_envmap" in line


@pytest.mark.parametrize(
    ("plugin", "name", "value"),
    [
        *(("sg_envmap", "scale", v) for v in (-1.0, NAN, INFINITY)),
        *(("sira_bsdf", "roughness", v) for v in (0.0, 0.01, 1.5, -1.0, NAN)),
        *(("sira_bsdf", "k_s", v) for v in (-0.1, NAN, INFINITY)),
    ],
)
def test_numbers_are_refused_by_loading_and_by_update(plugin, name, value):
    line = refusal(lambda: mi.load_dict({"type": plugin, name: value}))
    assert f"{plugin}: {name} is" in line
    params = mi.traverse(mi.load_dict({"type": plugin}))
    params[name] = mi.Float(value)
    assert refusal(params.update) == line.removeprefix("InputError: ")


@pytest.mark.parametrize(
    ("plugin", "name"), [("neural_albedo", "latent"), ("neural_albedo", "k_r"), ("neural_sdf", "z_sdf")]
)
def test_networks_refuse_what_no_avatar_holds(plugin, name):
    params = mi.traverse(mi.load_dict({"type": plugin} | ({"voxel": 0.4} if plugin == "neural_sdf" else {})))
    good = params[name].numpy().copy()
    params[name] = mi.Float(np.full_like(good, NAN))
    assert f"{plugin}: {name} has an entry that is not finite" in refusal(params.update)
    params[name] = mi.Float(np.zeros(len(good) + 1, np.float32))
    assert f"{plugin}: {name} has {len(good) + 1} entries" in refusal(params.update)
    params[name] = mi.Float(good)
    params.update()


@pytest.mark.parametrize(
    ("scene", "line"),
    [
        ({"type": "sira_bsdf", "roughness": {"type": "checkerboard"}}, "roughness must be a number, not a texture"),
        ({"type": "sira_bsdf", "k_s": "big"}, "k_s must be a number, not 'big'"),
        ({"type": "sg_envmap", "lobe_count": 8.5}, "lobe_count is 8.5; it must be a whole number"),
        ({"type": "neural_albedo", "baked": "false"}, "baked must be true or false, not 'false'"),
        ({"type": "neural_sdf", "voxel": NAN}, "voxel is nan"),
        ({"type": "neural_sdf", "movable": 1}, "movable must be true or false"),
        ({"type": "sira_radiance", "mask_sharpness": 0.0}, "mask_sharpness is 0"),
    ],
)
def test_parameters_of_another_kind_are_named(scene, line):
    assert line in refusal(lambda: mi.load_dict(scene))


@pytest.mark.parametrize("plugin", [{"type": "sg_envmap"}, {"type": "neural_sdf", "voxel": 0.4}])
@pytest.mark.parametrize(
    "matrix",
    [np.diag([1, 1, -1, 1]), np.diag([1, 2, 1, 1]), np.diag([0, 0, 0, 1]), [[1, 0.5, 0, 0], *np.eye(4)[1:].tolist()]],
    ids=["mirror", "stretch", "zero", "shear"],
)
def test_to_world_may_not_distort(plugin, matrix):
    transform = T(np.array(matrix, np.float64))
    assert "to_world may rotate" in refusal(lambda: mi.load_dict({**plugin, "to_world": transform}))


def test_scale_and_place_of_an_environment_have_no_effect():
    """As Mitsuba's `envmap`."""
    direction = mi.Vector3f([0, 0.6, -0.8], [0, 0.8, 0.6], [-1, 0, 0])
    seen = []
    for transform in (T(), T().scale(10), T().translate([1, 2, 3]).scale(1e-3)):
        emitter = mi.load_dict(light(to_world=transform.rotate([0, 1, 0], 40)))
        si = dr.zeros(mi.SurfaceInteraction3f, 3)
        si.wi = direction
        seen.append(emitter.eval(si).numpy())
    np.testing.assert_allclose(seen[1:], [seen[0]] * 2, rtol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("integrator", ["sira_sg", "sira_radiance", "path"])
@pytest.mark.parametrize("scale", [0.01, 1000.0])
def test_a_head_of_any_scale_is_the_same_picture(integrator, scale):
    one, other = (picture(scene({"type": integrator}, s)) for s in (1.0, scale))
    distance = SIZE * SIZE * 0.005  # pixels at the outline may fall to either side
    assert (np.abs(one[..., :4] - other[..., :4]).max(axis=2) > 0.01).sum() <= distance
    if integrator == "sira_radiance":
        np.testing.assert_allclose(one[..., 5], other[..., 5], atol=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("integrator", ["sira_sg", "sira_radiance"])
def test_a_head_of_any_scale_has_the_same_derivatives(integrator):
    """By the shape's latent code, whose units do not change with the scale."""
    gradients = []
    for scale in (1.0, 0.01, 1000.0):
        params = mi.traverse(made := scene({"type": integrator}, scale))
        dr.enable_grad(params["head.z_sdf"])
        params.update()
        image = mi.render(made, params, spp=1, seed=1)
        dr.backward(dr.mean(image[:, :, :3], axis=None))
        gradients.append(dr.grad(params["head.z_sdf"]).numpy())
    for gradient in gradients[1:]:
        assert np.linalg.norm(gradient - gradients[0]) < 0.05 * np.linalg.norm(gradients[0])


WALL = {
    "type": "rectangle",
    "to_world": T().translate([0, 0, -2]).scale(4),
    "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.6, 0.3, 0.2]}},
}
BALL = {"type": "sphere", "center": [1.5, -1, 1.5], "radius": 0.6, "bsdf": {"type": "sira_bsdf", "roughness": 0.6}}
BACK = {  # seen from behind
    "type": "rectangle",
    "to_world": T().translate([-1.5, 1.2, 2]).rotate([0, 1, 0], 180).scale(0.5),
    "bsdf": {"type": "twosided", "bsdf": {"type": "diffuse"}},
}


@pytest.mark.slow
def test_shapes_beside_the_head_are_shaded():
    """As the path integrator shades them with one bounce."""
    shapes = {"wall": WALL, "ball": BALL, "back": BACK}
    closed = picture(scene({"type": "sira_sg", "visibility_directions": 128}, **shapes), 4)[..., :4]
    traced = picture(scene({"type": "path", "max_depth": 3}, **shapes), 128)[..., :4]
    assert (closed[..., 3] == 1).all()
    error = np.abs(closed - traced)[..., :3] / traced[..., :3].mean()
    assert np.median(error) < 0.05 and error.mean() < 0.12
    np.testing.assert_allclose(closed.mean(axis=(0, 1)), traced.mean(axis=(0, 1)), rtol=0.05)


@pytest.mark.slow
def test_the_gradient_of_the_light_is_whole():
    """By the light's scale, in which the picture is linear; the derivative has samples of its own. Repeated: parts of
    the gradient must not get lost at random."""
    for _ in range(8):
        params = mi.traverse(made := scene({"type": "sira_sg"}, wall=WALL))
        dr.enable_grad(params["light.scale"])
        params.update()
        total = dr.mean(mi.render(made, params, spp=1, seed=1)[:, :, :3], axis=None)
        dr.backward(total)
        np.testing.assert_allclose(dr.grad(params["light.scale"]).numpy(), total.numpy(), rtol=0.02)


@pytest.mark.parametrize(
    ("part", "words"),
    [
        ({"type": "point", "position": [0, 1, 9], "intensity": 3.0}, "PointLight"),
        ({"type": "directional", "direction": [0, 0, -1]}, "Directional"),
        ({"type": "sphere", "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 1.0}}}, "AreaLight"),
        ({"type": "sphere", "bsdf": {"type": "conductor"}}, "cannot shade 'part'"),
        ({"type": "sphere", "bsdf": {"type": "twosided", "bsdf": {"type": "plastic"}}}, "cannot shade 'part'"),
    ],
)
def test_what_the_closed_form_cannot_show_is_named(part, words):
    made = scene({"type": "sira_sg"}, part=part, shape=head(voxel=0.5))
    line = refusal(lambda: picture(made))
    assert "sira_sg: " in line and words in line


def test_heads_that_share_a_texture_are_refused():
    """One texture knows the reference space of one head: the other would have wrong colours."""
    skin = {"type": "diffuse", "id": "skin", "reflectance": {"type": "neural_albedo"}}
    two = {f"at {x}": head(bsdf={"type": "ref", "id": "skin"}, to_world=T().translate([x, 0, 0])) for x in (-3, 3)}
    assert "two heads share one texture" in refusal(lambda: mi.load_dict({"type": "scene", "skin": skin, **two}))


def test_heads_are_not_merged_with_other_meshes():
    """Two heads of one stock material, which Mitsuba would merge to one mesh without a head's parameters."""
    two = {name: head(bsdf={"type": "diffuse"}, to_world=T().translate([x, 0, 0])) for name, x in (("a", -3), ("b", 3))}
    made = mi.load_dict({"type": "scene", **two})
    assert [type(shape).__name__ for shape in made.shapes()] == ["NeuralSDF", "NeuralSDF"]
    params = mi.traverse(made)
    assert {"a.z_sdf", "b.z_sdf"} <= {key for key, _ in params}


@pytest.mark.slow
@pytest.mark.parametrize("baked", [False, True])
def test_an_instance_shows_the_heads_own_albedo(baked):
    """Albedos at the hits of a turned and moved instance are those of the same head with that `to_world`."""
    place = T().translate([0.8, 0.3, 0]).rotate([0, 1, 0], 60)
    skin = {"type": "diffuse", "reflectance": {"type": "neural_albedo", "baked": baked}}
    ray = mi.Ray3f(mi.Point3f([0.8, 0.3, 1.0], [0.3, 1.0, -0.2], 14), mi.Vector3f(0, 0, -1))

    def albedo(**shapes):
        made = mi.load_dict({"type": "scene", **shapes})
        si = made.ray_intersect(ray)
        assert dr.all(si.is_valid())
        return si.bsdf().eval_diffuse_reflectance(si).numpy()

    group = {"type": "shapegroup", "id": "group", "head": head(bsdf=skin)}
    instance = {"type": "instance", "to_world": place, "shape": {"type": "ref", "id": "group"}}
    direct = albedo(head=head(bsdf=skin, to_world=place))
    assert np.ptp(direct, axis=1).max() > 0.01
    np.testing.assert_allclose(albedo(group=group, instance=instance), direct, atol=3e-3)


def test_a_scene_outlives_a_change_of_the_variant():
    made = scene({"type": "sira_sg"}, shape=head(voxel=0.5))
    before = picture(made)
    for variant in ("scalar_rgb", "llvm_ad_mono"):
        mi.set_variant(variant)
        mi.set_variant("llvm_ad_rgb")
    np.testing.assert_array_equal(picture(made), before)


@pytest.mark.parametrize(
    "plugin", ["neural_albedo", "neural_sdf", "sira_bsdf", "sg_envmap", "sira_radiance", "sira_sg"]
)
def test_scalar_variants_are_refused_by_name(plugin):
    mi.set_variant("scalar_rgb")
    try:
        line = refusal(lambda: mi.load_dict({"type": plugin}))
    finally:
        mi.set_variant("llvm_ad_rgb")
    assert plugin in line and "scalar_rgb" in line and "llvm_ad_rgb" in line


@pytest.mark.parametrize("row", [0, 1, 7, 14, 15])
def test_an_environment_is_lit_where_mitsuba_has_it(row):
    """Light and direction of each row against a quadrature of `envmap`."""
    image = np.zeros((16, 32, 3), np.float32)
    image[row] = 10
    count = 1 << 16
    z, angle = 1 - 2 * (np.arange(count) + 0.5) / count, np.pi * (1 + 5**0.5) * np.arange(count)
    radius = np.sqrt(1 - z * z)
    si = dr.zeros(mi.SurfaceInteraction3f, count)
    si.wi = mi.Vector3f(radius * np.cos(angle), z, radius * np.sin(angle))
    emitter = mi.load_dict({"type": "envmap", "bitmap": mi.Bitmap(image)})
    kept = mi.load_dict({"type": "scene", "light": emitter})
    values = emitter.eval(si).numpy()[0] * 4 * np.pi / count
    np.testing.assert_allclose(total_light(image)[0], values.sum(), rtol=0.01)
    directions, steradians = pixel_directions(16, 32)
    height = (image[..., 0] * steradians[:, None] * directions[..., 1]).sum()
    np.testing.assert_allclose(height, -(values * z).sum(), atol=0.02 * values.sum())
    del kept


@pytest.mark.slow
@pytest.mark.parametrize("name", ["fit.xml", "scene.xml"])
def test_the_scene_files_can_be_written_as_png(name, tmp_path):
    path, options = scene_path("fit.xml"), {"width": 16, "height": 16, "voxel": 0.4, "spp": 1}
    if name == "scene.xml":
        path = tmp_path / name
        write_scene(path, camera(40.0))
        write_lights(tmp_path / "lights.json", LOBES)
        options |= {"avatar": "", "refinement": ""}
    picture = mi.render(mi.load_file(str(path), **options))
    mi.util.write_bitmap(str(tmp_path / "head.png"), picture, write_async=False)
    written = np.array(mi.Bitmap(str(tmp_path / "head.png")))
    assert written.shape[:2] == (16, 16) and written[8, 8, :3].min() > 0 and written[0, 0, :3].max() == 0
