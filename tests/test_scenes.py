"""The scene files: they load for every integrator, every parameter works, and files are found."""

import shutil
import xml.etree.ElementTree as ET
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from conftest import camera

from sira_mi.avatar.file import load_avatar
from sira_mi.export.scene_file import scene_of_fit, scene_xml, write_scene
from sira_mi.sg.lights_io import read_lights, write_lights

SCENES = Path(__file__).parent.parent / "scenes"
SMALL = {"width": 32, "height": 32, "spp": 2, "voxel": 0.1}


def load(name: str, **parameters):
    return mi.load_file(str(SCENES / name), **{**SMALL, **parameters})


def picture(scene) -> np.ndarray:
    return mi.render(scene, seed=1).numpy()


@pytest.fixture
def one_light(tmp_path):
    path = tmp_path / "one light.json"
    write_lights(path, np.array([[0, 0, 1, 2, 1, 0.5, 0]], np.float32))
    return str(path)


@pytest.mark.slow
@pytest.mark.parametrize("integrator", ["sira_sg", "sira_radiance", "path", "prb", "direct"])
@pytest.mark.parametrize("name", ["fit.xml", "relight.xml"])
def test_every_integrator_renders_the_scene(name, integrator, avatar_path, one_light):
    lights = {"lights": one_light} if name == "relight.xml" else {}
    image = picture(load(name, avatar=avatar_path, integrator=integrator, **lights))
    assert image.shape[:2] == (32, 32) and np.isfinite(image).all()
    assert image[10:20, 12:20, :3].sum(axis=2).min() > 0
    assert (image[16, 16, 3], image[0, 0, 3]) == (1, 0) and (image[0, 0, :3] == 0).all()


@pytest.mark.parametrize("name", ["fit.xml", "relight.xml"])
def test_size_samples_voxel_and_baking(name, avatar_path, one_light):
    scene = load(name, avatar=avatar_path, lights=one_light, width=20, height=12, spp=3, voxel=0.2, baked=False)
    head, sensor = scene.shapes()[0], scene.sensors()[0]
    assert tuple(sensor.film().size()) == (20, 12) and sensor.sampler().sample_count() == 3
    assert head.voxel == 0.2 and not head.bsdf().diffuse_albedo.baked and not head.bsdf().specular_albedo.baked
    assert load(name, avatar=avatar_path, lights=one_light, baked=True).shapes()[0].bsdf().diffuse_albedo.baked


def test_lights_and_visible_environment(avatar_path, one_light):
    image = picture(load("fit.xml", avatar=avatar_path, lights=one_light, hide_emitters=False))
    assert image[16, 16, 0] > 0 and image[16, 16, 2] == 0, "the light has no blue"
    behind = np.exp(-2 * 2) * np.array([1, 0.5, 0])
    np.testing.assert_allclose(image[0, 0, :3], behind, atol=0.02)


@pytest.mark.slow
def test_scale_is_that_of_the_light(avatar_path, one_light):
    images = [
        picture(load("relight.xml", avatar=avatar_path, lights=one_light, integrator="sira_sg", scale=scale))
        for scale in (1, 3)
    ]
    np.testing.assert_allclose(3 * images[0][..., :3], images[1][..., :3], rtol=1e-4)


@pytest.mark.slow
def test_an_environment_map_is_taken_as_it_is_or_fitted(avatar_path):
    exact = load("relight.xml", avatar=avatar_path, environment="envmap", hide_emitters=False)
    fitted = load("relight.xml", avatar=avatar_path, hide_emitters=False)
    assert fitted.environment().class_name() != exact.environment().class_name()
    rows = [mi.render(s, spp=256, seed=1).numpy()[8:20, 10:22, :3].mean(axis=1) for s in (exact, fitted)]
    np.testing.assert_allclose(*rows, rtol=0.15)
    np.testing.assert_allclose(*(row.mean(axis=0) for row in rows), rtol=0.03)


@pytest.mark.slow
def test_yaw_turns_the_head_and_not_the_light(avatar_path, one_light):
    still, turned = (
        load("relight.xml", avatar=avatar_path, lights=one_light, integrator="sira_sg", yaw=yaw) for yaw in (0, 90)
    )
    extra = mi.load_dict({"type": "sira_sg", "hide_emitters": True, "aovs": True})
    layers = [mi.render(scene, integrator=extra, seed=1).numpy() for scene in (still, turned)]
    assert np.abs(layers[0][..., 10:13] - layers[1][..., 10:13]).max() > 0.02, "the albedo turns with the head"
    assert layers[1][..., :3].max() > 0.7 * layers[0][..., :3].max(), "the light still comes from the front"
    x, z = turned.shapes()[0].to_world.matrix.numpy()[[0, 2], [2, 2]].ravel()
    assert x == pytest.approx(1, abs=1e-6) and z == pytest.approx(0, abs=1e-6), "+z, the face, turns to +x, its left"


def test_without_an_avatar_it_is_the_mean_head_of_the_prior():
    head = load("fit.xml", voxel=0.2).shapes()[0]
    prior = load_avatar()
    assert head.head_shape.architecture == prior.architecture
    assert (head.parameters["z_sdf"].numpy() == prior.tensors["z_sdf"]).all()
    assert (head.parameters["reference"].numpy() == prior.tensors["reference"]).all()


def test_the_default_lights_are_there():
    assert len(read_lights(SCENES / "lights" / "key_fill_rim.json")) == 4
    assert (SCENES / "lights" / "studio.exr").stat().st_size < 200_000


@pytest.mark.slow
def test_avatars_are_found_beside_the_scene_and_in_the_current_folder(avatar, avatar_path, tmp_path, monkeypatch):
    folder = tmp_path / "Zoë's fit ü"
    folder.mkdir()
    shutil.copy(avatar_path, folder / "my avatar.safetensors")
    expected = avatar.tensors["z_sdf"]
    whole = load("fit.xml", avatar=str(folder / "my avatar.safetensors"))
    monkeypatch.chdir(folder)
    here = load("fit.xml", avatar="my avatar.safetensors")
    monkeypatch.chdir("/")
    write_scene(folder / "scene.xml", camera(40.0))
    shutil.copy(avatar_path, folder / "avatar.safetensors")
    write_lights(folder / "lights.json", avatar.tensors["lobes"])
    beside = mi.load_file(str(folder / "scene.xml"), voxel=0.1, integrator="path")
    for scene in (whole, here, beside):
        assert (scene.shapes()[0].parameters["z_sdf"].numpy() == expected).all()
    assert picture(beside)[16, 16, :3].min() > 0


@pytest.mark.slow
def test_learned_radiance_is_that_of_the_scenes_own_avatar(avatar_path):
    own = load("fit.xml", avatar=avatar_path, integrator="sira_radiance")
    image = picture(own)
    named = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "sira_radiance", "avatar": avatar_path},
            "sensor": own.sensors()[0],
            "head": {"type": "neural_sdf", "avatar": avatar_path, "voxel": 0.1},
        }
    )
    np.testing.assert_array_equal(image, picture(named))
    assert "z_r" in mi.traverse(own.integrator()), "exposed from the first render on"


def test_what_scene_files_cannot_hold_is_said():
    description = {"type": "scene", "light": {"type": "sg_envmap", "lobes": mi.TensorXf([[0, 1, 0, 1, 1, 1, 1]])}}
    with pytest.raises(TypeError, match="lobes: scene files hold no TensorXf"):
        scene_xml(description, "")


def test_the_shipped_scene_is_that_of_the_descriptions():
    """`fit.xml` says the same of a head, its light and its integrator as the scene of a fit does."""
    shipped, fitted = ET.parse(SCENES / "fit.xml").getroot(), ET.fromstring(scene_xml(scene_of_fit(camera(40.0)), ""))
    for element in ("shape", "emitter", "sensor/film/rfilter", "sensor/sampler"):
        one, other = (ET.canonicalize(ET.tostring(root.find(element)), strip_text=True) for root in (shipped, fitted))
        assert one == other, element
