"""The shape `neural_sdf`: its mesh, the mesh's derivatives in stock integrators, updates, and errors."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import trimesh
from conftest import camera, slopes
from scipy.spatial.transform import Rotation

from sira_mi.errors import InputError
from sira_mi.export import scene as scenes
from sira_mi.fields.columns import evaluate_in_chunks
from sira_mi.fields.extraction import EmptySurfaceError
from sira_mi.fields.sdf import signed_distance, surface
from sira_mi.fit.memory import peak_memory

FIELD = ("z_sdf", "deformation", "reference")


def diffuse(albedo: float) -> dict:
    return {"type": "diffuse", "reflectance": {"type": "rgb", "value": albedo}}


def build(path, sensor, integrator=None, light=None, **options):
    head = {"type": "neural_sdf", "avatar": path, "voxel": 0.12, **options}
    head.setdefault("bsdf", diffuse(0.3))
    return mi.load_dict(
        {
            "type": "scene",
            "head": head,
            "sensor": scenes.sensor(sensor, {"type": "stratified"}),
            "light": light or {"type": "constant"},
            "integrator": integrator or {"type": "direct"},
        }
    )


def head_of(scene):
    return next(shape for shape in scene.shapes() if type(shape).__name__ == "NeuralSDF")


def positions(head) -> np.ndarray:
    """[V, 3] of the mesh that Mitsuba sees."""
    return np.array(mi.traverse(head)["vertex_positions"]).reshape(-1, 3)


@pytest.fixture(scope="module")
def scene(avatar_path):
    return build(avatar_path, camera(36))


# The mesh


def test_vertices_lie_on_the_zero_level_and_normals_point_outward(scene):
    head = head_of(scene)
    f, gradient = evaluate_in_chunks(lambda p: surface(head.field(), p)[:2], head.vertices())
    assert np.abs(f).max() < 1e-4
    params = mi.traverse(head)
    normals = np.array(params["vertex_normals"]).reshape(-1, 3).T
    assert ((normals * gradient).sum(axis=0) / np.linalg.norm(gradient, axis=0)).min() > 0.9
    mesh = trimesh.Trimesh(positions(head), np.array(params["faces"]).reshape(-1, 3), process=False)
    assert mesh.is_watertight and mesh.volume > 0


def test_mitsuba_meets_the_field_where_its_mesh_is(scene):
    """Hits of the proxy lie within a chord's height of the field, refined hits on it."""
    head = head_of(scene)
    origin = np.array([[0.2, -0.4, 4.0]]).T + np.zeros((3, 100))
    target = np.random.default_rng(0).uniform(-0.7, 0.7, (3, 100))
    ray = mi.Ray3f(mi.Point3f(origin), dr.normalize(mi.Vector3f(target - origin)))
    si = scene.ray_intersect(ray)
    t, hit = head.refine(ray, si.t, si.is_valid())
    assert si.is_valid().numpy().all() and hit.numpy().all()
    distance = lambda p: np.abs(evaluate_in_chunks(lambda x: signed_distance(head.field(), x), p.numpy())[0])  # noqa: E731
    assert distance(si.p).max() < 0.12**2
    assert distance(ray(t)).max() < 1e-4


@pytest.mark.slow
def test_a_head_moved_turned_and_scaled_is_the_same_head_from_a_moved_camera(avatar_path):
    """A camera moved with the head, at a scaled distance, sees the same picture."""
    matrix = mi.ScalarTransform4f().translate([1.0, 2.0, -0.5]).rotate([0.6, 0.8, 0.0], 40).scale(1.7)
    still = camera(36)
    pose = np.array(matrix.matrix, np.float64) @ np.linalg.inv(still.world_to_camera)
    pose[:3, :3] = Rotation.from_matrix(pose[:3, :3] / 1.7).as_matrix()
    moved = type(still)(still.K, np.linalg.inv(pose), still.width, still.height)
    a = mi.render(build(avatar_path, still), spp=16, seed=1).numpy()
    turned = build(avatar_path, moved, to_world=matrix)
    b = mi.render(turned, spp=16, seed=1).numpy()
    assert np.abs(a - b).mean() < 5e-3
    assert np.abs(a[:, :, 3].sum() - b[:, :, 3].sum()) / a[:, :, 3].sum() < 2e-3
    head = head_of(turned)
    local = np.array(head.to_local @ mi.Point3f(positions(head).T))
    np.testing.assert_allclose(local, head.vertices(), atol=2e-5)


# Derivatives


def reprojected(head, start: np.ndarray, gradient: np.ndarray) -> np.ndarray:
    """The vertices `start` [3, V] moved along `gradient` onto the zero level of the head's present parameters: the
    mesh as a function of the parameters, without the jumps of a new extraction."""
    x, direction = start, gradient / (gradient**2).sum(axis=0)
    for _ in range(4):
        f = evaluate_in_chunks(lambda p: signed_distance(head.field(), p), x)[0]
        x = x - f * direction
    return x.astype(np.float32)


def moved(head, key, value, x, gradient):
    """`reprojected` with another value of one parameter."""
    kept = head.parameters[key]
    head.parameters[key] = mi.Float(value)
    try:
        return reprojected(head, x, gradient)
    finally:
        head.parameters[key] = kept


def check_image_derivatives(avatar, scene, spp: int, change: float, tolerance: float, weight: np.ndarray):
    params, head = mi.traverse(scene), head_of(scene)
    weight = mi.TensorXf(weight.astype(np.float32))
    values = {key: mi.Float(avatar.tensors[key]) for key in FIELD}
    dr.enable_grad(values)
    for key in FIELD:
        params[f"head.{key}"] = values[key]
    params.update()
    start = head.vertices()
    gradient = evaluate_in_chunks(lambda p: surface(head.field(), p)[1], start)[0]
    dr.backward(dr.mean(mi.render(scene, params, spp=spp, seed=7)[:, :, :3] * weight, axis=None))
    results = {}
    for key in FIELD:

        def loss(value, key=key):
            params["head.vertex_positions"] = mi.Float(moved(head, key, value, start, gradient).T.ravel())
            params.update()
            image = mi.render(scene, spp=4 * spp, seed=7)
            return float(dr.mean(image[:, :, :3] * weight, axis=None).numpy().item())

        results[key] = slopes(loss, avatar.tensors[key], dr.grad(values[key]).numpy(), change)
    for ad, difference in results.values():
        assert ad == pytest.approx(difference, rel=tolerance), results


def test_vertices_move_as_the_level_set_does(avatar, scene):
    """Without any rendering, hence without noise."""
    params, head = mi.traverse(scene), head_of(scene)
    for key in FIELD:
        value = mi.Float(avatar.tensors[key])
        dr.enable_grad(value)
        params[f"head.{key}"] = value
        params.update()
        start = head.vertices()
        gradient = evaluate_in_chunks(lambda p: surface(head.field(), p)[1], start)[0]
        weight = (gradient * np.maximum(start[0], 0)).T  # how far one side moves outward
        dr.backward(dr.mean(mi.traverse(head)["vertex_positions"] * mi.Float(weight.ravel())))

        def loss(value, key=key, weight=weight, start=start, gradient=gradient):
            return float((moved(head, key, value, start, gradient).T * weight).mean(dtype=np.float64))

        ad, difference = slopes(loss, avatar.tensors[key], dr.grad(value).numpy(), 3e-4)
        params[f"head.{key}"] = mi.Float(avatar.tensors[key])
        params.update()
        assert ad == pytest.approx(difference, rel=2e-3), key


@pytest.mark.slow
@pytest.mark.parametrize("integrator", ["direct_projective", "prb_projective"])
def test_silhouette_derivatives_of_stock_integrators(avatar, avatar_path, integrator):
    """A black head before a white sky: nothing but its outline."""
    settings = {"type": integrator, "sppi": 0} | ({"max_depth": 2} if integrator.startswith("prb") else {})
    scene = build(avatar_path, camera(36), settings, bsdf=diffuse(0.0))
    weight = np.repeat(np.random.default_rng(0).uniform(0.5, 1.5, (4, 4)).repeat(8, 0).repeat(8, 1)[:, :, None], 3, 2)
    check_image_derivatives(avatar, scene, 256, 1e-2, 1e-2, weight)


@pytest.mark.slow
def test_shading_derivatives_under_prb(avatar, avatar_path):
    """The head fills the picture, and the light comes from where it casts no shadow."""
    light = {"type": "point", "position": [1.0, 0.0, 4.0], "intensity": {"type": "rgb", "value": 5.0}}
    scene = build(avatar_path, camera(140), {"type": "prb", "max_depth": 2}, light)
    weight = np.linspace(0, 1, 32)[None, :, None] * np.ones((32, 1, 3))
    check_image_derivatives(avatar, scene, 16, 2e-3, 5e-3, weight)


@pytest.mark.slow
def test_a_new_extraction_changes_the_picture_as_the_derivative_says(avatar, avatar_path):
    """Differences over two extractions, whose topologies differ; they carry the mesh's own error."""
    scene = build(avatar_path, camera(36), {"type": "direct_projective", "sppi": 0}, bsdf=diffuse(0.0))
    params = mi.traverse(scene)
    value = mi.Float(avatar.tensors["deformation"])
    dr.enable_grad(value)
    params["head.deformation"] = value
    params.update()
    dr.backward(dr.mean(mi.render(scene, params, spp=256, seed=3)[:, :, :3], axis=None))
    counts = set()

    def loss(value):
        params["head.deformation"] = mi.Float(value)
        params.update()
        counts.add(len(positions(head_of(scene))))
        return float(dr.mean(mi.render(scene, spp=256, seed=3)[:, :, :3], axis=None).numpy().item())

    ad, difference = slopes(loss, avatar.tensors["deformation"], dr.grad(value).numpy(), 2e-2)
    assert ad == pytest.approx(difference, rel=3e-2)
    assert len(counts) > 1


# Updates


@pytest.mark.slow
def test_sixty_updates_leave_no_memory_behind(avatar, avatar_path):
    """The full 500 are in `python -m studies.numerics.remesh_updates`."""
    scene = build(avatar_path, camera(18), voxel=0.25)
    params = mi.traverse(scene)
    rng = np.random.default_rng(0)
    resident = []
    for step in range(60):
        value = mi.Float(avatar.tensors["deformation"] * np.float32(rng.uniform(0.9, 1.1)))
        dr.enable_grad(value)
        params["head.deformation"] = value
        params.update()
        dr.backward(dr.mean(mi.render(scene, params, spp=1, seed=step)[:, :, :3], axis=None))
        resident.append(peak_memory() / 2**20)  # MB
    assert resident[-1] - resident[20] < 40


def test_remeshing_every_third_update(avatar, avatar_path):
    scene = build(avatar_path, camera(18), voxel=0.25, remesh_every=3)
    params, head = mi.traverse(scene), head_of(scene)
    before = positions(head)
    for step in range(1, 4):
        params["head.z_sdf"] = mi.Float(avatar.tensors["z_sdf"] + 0.5)
        params.update()
        same = len(positions(head)) == len(before) and (positions(head) == before).all()
        assert same == (step < 3)
    head.remesh_at_next_update()
    params["head.z_sdf"] = mi.Float(avatar.tensors["z_sdf"])
    params.update()
    np.testing.assert_array_equal(positions(head), before)


def test_the_mesh_is_the_same_bits_every_time(avatar_path):
    first, second = (mi.traverse(head_of(build(avatar_path, camera(18)))) for _ in range(2))
    for key in ("vertex_positions", "faces"):
        np.testing.assert_array_equal(np.array(first[key]), np.array(second[key]))


@pytest.mark.slow
def test_a_nested_albedo_follows_the_shape(avatar, avatar_path):
    """A stock BSDF with a neural_albedo: after the latent changes, the texture's reference space is the new one."""
    bsdf = {"type": "principled", "base_color": {"type": "neural_albedo", "avatar": avatar_path}}
    scene = build(avatar_path, camera(36), {"type": "aov", "aovs": "albedo:albedo"}, voxel=0.25, bsdf=bsdf)
    params, head = mi.traverse(scene), head_of(scene)
    texture = head._textures[0]

    def albedo(points):
        si = dr.zeros(mi.SurfaceInteraction3f, points.shape[1])
        si.p = mi.Point3f(points)
        return np.array(texture.eval(si))

    before = albedo(head.vertices())
    params["head.z_sdf"] = mi.Float(avatar.tensors["z_sdf"] + 1.5)
    params.update()
    x = head.vertices()
    _, _, x_ref, gamma = surface(head.field(), mi.TensorXf(x))
    np.testing.assert_allclose(albedo(x), texture.evaluate_networks(x_ref, gamma).numpy(), atol=1e-5)
    stale = texture.evaluate_networks(mi.TensorXf(x), gamma).numpy()
    assert np.abs(albedo(x) - stale).max() > 1e-3
    assert before.shape[0] == 3
    image = mi.render(scene, spp=4).numpy()
    assert np.isfinite(image).all() and image[:, :, :3].max() > 0.05


# What is refused


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"voxel": 0.0}, "voxel"),
        ({"voxel": 2.0}, "voxel"),
        ({"voxel": float("nan")}, "voxel"),
        ({"remesh_every": 0}, "remesh"),
    ],
)
def test_bad_properties_are_named(avatar_path, options, message):
    with pytest.raises(Exception, match=message):
        mi.load_dict({"type": "neural_sdf", "avatar": avatar_path, **options})


def test_a_missing_avatar_is_named(tmp_path):
    with pytest.raises(Exception, match=r"nothing\.safetensors") as caught:
        mi.load_dict({"type": "neural_sdf", "avatar": str(tmp_path / "nothing.safetensors")})
    assert isinstance(caught.value, (InputError, RuntimeError))


@pytest.mark.parametrize("matrix", [np.diag([1.0, 2.0, 1.0, 1.0]), np.diag([-1.0, 1.0, 1.0, 1.0])])
def test_a_transform_that_is_no_similarity_is_refused(avatar_path, matrix):
    with pytest.raises(Exception, match="uniform"):
        mi.load_dict({"type": "neural_sdf", "avatar": avatar_path, "to_world": mi.ScalarTransform4f(matrix)})


def test_parameters_without_a_surface_are_named_so(avatar, avatar_path):
    scene = build(avatar_path, camera(18), voxel=0.25)
    params = mi.traverse(scene)
    reference = avatar.tensors["reference"].copy()
    reference[-1] += 20
    params["head.reference"] = mi.Float(reference)
    with pytest.raises(EmptySurfaceError):
        params.update()
