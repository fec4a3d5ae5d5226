"""Samples of a pixel that share one shading: which do, and that `sira_sg` changes little by it."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from conftest import camera

from sira_mi.export import scene as scenes
from sira_mi.sg.multisampling import REACH, representative_samples

UP = np.array([[0.0], [0.0], [1.0]])
SIZE = 96
ALBEDO, MASK = slice(10, 13), 18


def test_the_middle_sample_represents_its_pixel():
    """Two pixels of three samples on a line: the one in the middle represents its own pixel only."""
    position = np.stack([[0.0, 0.01, 0.02, 0.5, 0.49, 0.51], np.zeros(6), np.zeros(6)])
    assert representative_samples(position, UP.repeat(6, axis=1), np.ones(6, bool), 3).tolist() == [1, 1, 1, 3, 3, 3]


@pytest.mark.parametrize("what", ["distance", "normal", "coverage"])
def test_nothing_is_shared_across_an_edge(what):
    """Samples far apart, turned away from each other, or beside the head, keep their pixel's shadings apart."""
    position, normal, hit = np.zeros((3, 4)), UP.repeat(4, axis=1), np.ones(4, bool)
    if what == "distance":
        position[2, 3] = 3 * REACH
    elif what == "normal":
        normal[:, 3] = [np.sin(0.4), 0, np.cos(0.4)]
    else:
        hit[3] = False
    assert representative_samples(position, normal, hit, 4).tolist() == [0, 1, 2, 3]


def test_representatives_represent_themselves_within_their_pixel():
    """Of random hits: a representative is hit, represents itself, and is of the same pixel."""
    rng = np.random.default_rng(0)
    position = np.repeat(rng.standard_normal((3, 200)), 5, axis=1) + 0.015 * rng.standard_normal((3, 1000))
    hit = rng.random(1000) < 0.95
    representative = representative_samples(position, UP.repeat(1000, axis=1), hit, 5)
    assert (representative[representative] == representative).all() and (
        representative // 5 == np.arange(1000) // 5
    ).all()
    assert hit[representative[hit]].all()
    alone = representative == np.arange(1000)
    assert 100 < alone.sum() < 900


@pytest.fixture(scope="module")
def scene(avatar, avatar_path):
    return mi.load_dict(
        {
            "type": "scene",
            "head": scenes.head(avatar_path, voxel=0.1),
            "sensor": scenes.sensor(camera(1.25 * SIZE, SIZE), {"type": "stratified", "sample_count": 4}),
            "light": {"type": "sg_envmap", "lobes": mi.TensorXf(avatar.tensors["lobes"])},
        }
    )


def picture(scene, **options) -> np.ndarray:
    integrator = mi.load_dict({"type": "sira_sg", "aovs": True, "hide_emitters": True, **options})
    return mi.render(scene, integrator=integrator, spp=4, seed=0).numpy()


@pytest.fixture(scope="module")
def every_sample(scene):
    return picture(scene)


def test_a_shared_shading_keeps_coverage_and_changes_little(scene, every_sample):
    """Pixels that the head covers in part are those of every sample's own shading; within it, pixels differ as much as
    shading bends within a pixel."""
    shared = picture(scene, shared=True)
    assert np.abs(shared[..., MASK] - every_sample[..., MASK]).max() < 1e-6
    edge = (every_sample[..., MASK] > 0) & (every_sample[..., MASK] < 0.99)
    inside = every_sample[..., MASK] > 0.99
    assert edge.sum() > 100 and inside.sum() > 2000
    np.testing.assert_allclose(shared[edge], every_sample[edge], atol=2e-5)
    difference = np.abs(shared - every_sample)[inside][:, :3] / every_sample[inside][:, :3].mean()
    assert 0 < difference.mean() < 0.01 and difference.max() < 0.1


def test_fewer_points_are_shaded(scene, monkeypatch):
    """Otherwise the option would be worth nothing: less than half of the samples are evaluated on the field."""
    head, counts = scene.shapes()[0], []
    refine = type(head).refine

    def counted(self, ray, t, active):
        counts.append(int(dr.count(active)[0]))
        return refine(self, ray, t, active)

    monkeypatch.setattr(type(head), "refine", counted)
    picture(scene)
    picture(scene, shared=True)
    assert counts[1] < 0.5 * counts[0]


def test_hits_of_the_mesh_are_close_to_those_of_the_field(avatar, avatar_path, scene, every_sample):
    """The blob is smooth: a mesh of spacing 0.1 shows it within a percent, with the albedos of networks and of
    vertices alike."""
    inside = every_sample[..., MASK] > 0.99
    description = scenes.head(avatar_path, voxel=0.1, baked=True)
    baked = mi.load_dict(
        {
            "type": "scene",
            "head": description,
            "sensor": scenes.sensor(camera(1.25 * SIZE, SIZE), {"type": "stratified", "sample_count": 4}),
            "light": {"type": "sg_envmap", "lobes": mi.TensorXf(avatar.tensors["lobes"])},
        }
    )
    pictures = [picture(one, exact=False) for one in (scene, baked)]
    for one in pictures:
        difference = np.abs(one - every_sample)[inside][:, :3] / every_sample[inside][:, :3].mean()
        assert 0 < difference.mean() < 0.01
    albedo = [one[inside][:, ALBEDO] for one in pictures]
    assert 0 < np.abs(albedo[0] - albedo[1]).max() < 0.02


@pytest.mark.slow
def test_what_is_differentiated_is_exact(scene):
    """Derivatives with the options are those without."""
    params = mi.traverse(scene)
    key = next(k for k in params.keys() if k.endswith("k_s"))  # noqa: SIM118 (SceneParameters is no dict)

    def derivative(**options):
        integrator = mi.load_dict({"type": "sira_sg", "aovs": True, "hide_emitters": True, **options})
        k_s = mi.Float(params[key].numpy())
        dr.enable_grad(k_s)
        params[key] = k_s
        params.update()
        image = mi.render(scene, params, integrator=integrator, spp=4, seed=0)
        dr.backward(dr.sum(image, axis=None))
        params[key] = dr.detach(k_s)
        params.update()
        return dr.grad(k_s).numpy()

    np.testing.assert_array_equal(derivative(shared=True, exact=False), derivative())
