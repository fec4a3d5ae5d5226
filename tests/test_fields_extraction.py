"""The mesh of a field: closed, without slivers, the same from coarse to fine as from a dense grid."""

import numpy as np
import pytest
import trimesh
from doubles import head_field

from sira_mi.conventions import DOMAIN_LOWER, DOMAIN_UPPER
from sira_mi.fields import columns, extraction, sdf

RADIUS = 1.2


def sphere(points: np.ndarray) -> np.ndarray:
    return (np.linalg.norm(points, axis=0) - RADIUS).astype(np.float32)


def watertight(surface) -> trimesh.Trimesh:
    mesh = trimesh.Trimesh(surface.vertices, surface.faces, process=False)
    assert mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0
    return mesh


def test_extracted_sphere_has_the_volume_and_area_of_a_sphere():
    mesh = watertight(extraction.extract(sphere, 0.05))
    assert mesh.volume == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=2e-3)
    assert mesh.area == pytest.approx(4 * np.pi * RADIUS**2, rel=2e-3)
    outward = (mesh.face_normals * mesh.triangles_center).sum(axis=1)
    assert (outward[mesh.area_faces > 1e-7] > 0).all()


def test_coarse_to_fine_extraction_equals_the_dense_one(avatar):
    field = head_field(avatar)
    evaluate = lambda x: columns.evaluate_in_chunks(lambda p: sdf.signed_distance(field, p), x)[0][0]  # noqa: E731
    for function, voxel in ((evaluate, 0.1), (sphere, 0.07)):
        fast, slow = extraction.extract(function, voxel), extraction.extract_reference(function, voxel)
        np.testing.assert_array_equal(fast.faces, slow.faces)
        np.testing.assert_allclose(fast.vertices, slow.vertices, atol=1e-5)
        assert fast.grid.shape == slow.grid.shape and fast.spacing == pytest.approx(slow.spacing)
        watertight(fast)


def test_a_solid_that_leaves_the_box_is_closed_along_it():
    """Half a space below y = 0.5: a box with its lid on the field's surface."""
    surface = extraction.extract(lambda x: x[1] - 0.5, 0.1)
    mesh = watertight(surface)
    lower, upper = mesh.bounds
    assert lower == pytest.approx(DOMAIN_LOWER, abs=1e-3)
    assert upper == pytest.approx((DOMAIN_UPPER[0], 0.5, DOMAIN_UPPER[2]), abs=1e-3)
    on_lid = np.abs(surface.vertices[:, 1] - 0.5) < 1e-5
    inside = np.abs(surface.vertices[:, 0]) < 2.4
    assert not surface.on_box[on_lid & inside & (np.abs(surface.vertices[:, 2]) < 1.8)].any()
    assert surface.on_box[surface.vertices[:, 1] < 0.4].all()


@pytest.mark.parametrize("value", [1.0, -1.0])
def test_a_field_without_a_surface_is_named_so(value):
    if value < 0:
        mesh = watertight(extraction.extract(lambda x: np.full(x.shape[1], value, np.float32), 0.2))
        assert mesh.volume > 0  # solid everywhere: the box itself
    else:
        with pytest.raises(extraction.EmptySurfaceError):
            extraction.extract(lambda x: np.full(x.shape[1], value, np.float32), 0.2)


def test_a_surface_through_grid_points_has_no_slivers():
    """A sphere whose radius is a multiple of the spacing passes within rounding of many grid points; barycentric
    coordinates of triangles with edges of 1e-6 voxels are not a number."""
    voxel = 0.25
    mesh = extraction.extract(lambda x: np.linalg.norm(x, axis=0) - np.float32(1.25), voxel)
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    edges = np.concatenate([np.linalg.norm(d, axis=1) for d in (a - b, b - c, c - a)])
    assert edges.min() > 5e-4 * voxel
    watertight(mesh)
