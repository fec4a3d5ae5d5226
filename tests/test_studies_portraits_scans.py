"""Scans of real faces: files are read in their units, and scans are brought to the head before latents are fitted."""

import sys

import numpy as np
import pytest
import trimesh
from conftest import SMALL, small_avatar
from scipy.spatial.transform import Rotation

from sira_mi.errors import InputError
from sira_mi.training.collection.similarity import Similarity
from sira_mi.training.pictures import extract_surface
from sira_mi.training.shape_model import ShapeModel
from studies.portraits import __main__ as portraits
from studies.portraits import fit_scans
from studies.portraits.alignment import icp
from studies.portraits.fit_scans import cut_face, read_scans
from studies.portraits.surface_distance import TriangleTree
from studies.priors.shape_measures import ShapeFit, to_surface


def test_scans_are_read_in_millimetres_whatever_their_unit_and_winding(tmp_path):
    """A ball of 80 mm; the same twice in hundredths of a millimetre, wound inwards."""
    ball = trimesh.creation.icosphere(subdivisions=4, radius=80.0)
    np.savez(tmp_path / "a.npz", v=ball.vertices.astype(np.float32), f=ball.faces)
    hundredths = np.stack([100 * ball.vertices] * 2).round().astype(np.int16)
    np.savez(tmp_path / "b.npz", v=hundredths, f=ball.faces[:, ::-1], names=["one", "two"])
    scans = read_scans(tmp_path)
    assert [scan.name for scan in scans] == ["a", "one", "two"]
    for scan in scans:
        np.testing.assert_allclose(scan.nose, [0, 0, 0.8], atol=1e-3)
        np.testing.assert_allclose(scan.points, 0.8 * scan.normals, atol=0.01)
        assert np.linalg.norm(scan.points - scan.nose, axis=1).max() < 0.95 and len(scan.points) > 500
    (tmp_path / "c.npz").write_bytes(b"no scan")
    with pytest.raises(InputError, match=r"c\.npz is no scan"):
        read_scans(tmp_path)
    with pytest.raises(InputError, match="has no scans"):
        read_scans(tmp_path / "nowhere")


@pytest.mark.slow
def test_a_moved_head_is_brought_back_before_latents_are_fitted():
    """The mean head itself, turned by 4°, moved and 3% larger: its points come to lie on the head, normals along the
    gradient, and distances are those of the scan's size."""
    model = ShapeModel.of_prior(small_avatar())
    field = model.field(model.latent("z_sdf", np.zeros(SMALL.sdf_latent)))
    head = extract_surface(field)
    turn = Rotation.from_euler("yx", [4, -4], degrees=True).as_matrix()
    scan = cut_face("own", 1.03 * head.vertices @ turn.T + [0.3, -0.2, 1.0], head.faces.astype(int))
    nose = head.vertices[np.argmax(head.vertices[:, 2])]
    tree = TriangleTree(head.vertices, head.faces)
    placed = fit_scans.place_scan(scan, icp(scan.points, tree, Similarity(1.0, np.eye(3), scan.nose - nose)))
    distance, angle = to_surface(field, placed.points, placed.normals)
    assert distance.mean() < 0.5 and np.median(angle) < 3
    (row,) = fit_scans.fit_scans(model, nose, [scan], ShapeFit(steps=2, rate=1e-3))
    assert row["name"] == "own" and row["mean_head"] < 0.5 and row["fitted"] < 0.5


def test_the_command_prints_each_face_and_the_mean(monkeypatch, capsys, tmp_path):
    rows = [{"name": "f18", "mean_head": 2.0, "fitted": 1.0}, {"name": "m18", "mean_head": 3.0, "fitted": 1.5}]
    monkeypatch.setattr(fit_scans, "read_scans", lambda folder: [])
    monkeypatch.setattr(fit_scans, "fit_scans", lambda model, nose, scans: rows)
    monkeypatch.setattr(sys, "argv", ["portraits", "scans", "--scans", str(tmp_path)])
    portraits.main()
    assert capsys.readouterr().out.splitlines()[-2:] == ["| m18 | 3.00 | 1.50 |", "| all | 2.50 | 1.25 |"]
