"""How well a shape prior describes scans of real faces: latents fitted to each scan, in millimetres.

A check of priors; nothing is trained or chosen by it. A scan has a face in front of whatever else, +y up and +z front;
its nose is the foremost point. The mean head and the fitted head are both aligned to the face by ICP with scale.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sira_mi.conventions import MILLIMETRES_PER_UNIT
from sira_mi.errors import InputError
from sira_mi.training.collection.similarity import Similarity
from sira_mi.training.collection.triangles import vertex_normals
from sira_mi.training.pictures import extract_surface
from sira_mi.training.scenes import TrainingScene
from sira_mi.training.shape_model import ShapeModel
from studies.measures import FACE_RADIUS, spread_indices
from studies.portraits.alignment import distances_from, icp, inverse
from studies.portraits.surface_distance import TriangleTree
from studies.priors.shape_measures import ShapeFit, fit_shape

ROUNDS = 2  # of alignment and fit
POINTS = 3000  # of a face, at most
_STORED = {"f": 1.0, "i": 0.01}  # millimetres of 1 in a file, by the kind of its numbers


@dataclass(frozen=True, eq=False)
class FaceScan:
    """The face of a scan: what lies within the radius of a face around its nose."""

    name: str
    points: np.ndarray  # [P, 3] scene units
    normals: np.ndarray  # [P, 3] unit, outward
    nose: np.ndarray  # [3]


def read_scans(folder: Path) -> list[FaceScan]:
    """The scans in a folder's `.npz` files: `f` [T, 3] and `v` [N, 3], or several [S, N, 3] with their `names` [S];
    millimetres, or whole hundredths of them. Raises InputError for other files and when there are none."""
    scans = []
    for path in sorted(folder.glob("*.npz")):
        try:
            with np.load(path, allow_pickle=False) as file:
                vertices, faces = file["v"], file["f"]
                names = [str(name) for name in file["names"]] if "names" in file else [path.stem]
            many = vertices.reshape(len(names), -1, 3) * (_STORED[vertices.dtype.kind] / MILLIMETRES_PER_UNIT)
            scans += [cut_face(name, one, faces) for name, one in zip(names, many, strict=True)]
        except (OSError, KeyError, ValueError, IndexError) as error:
            raise InputError(f"{path} is no scan with v and f: {error}") from error
    if not scans:
        raise InputError(f"{folder} has no scans, .npz files with v and f")
    return scans


def cut_face(name: str, vertices: np.ndarray, faces: np.ndarray) -> FaceScan:
    """The face of a mesh, `POINTS` of its vertices [N, 3], scene units; faces [T, 3] wound either way."""
    normals = vertex_normals(vertices, faces)
    foremost = np.argmax(vertices[:, 2])
    normals *= np.sign(normals[foremost, 2])
    nose = vertices[foremost]
    face = np.flatnonzero(np.linalg.norm(vertices - nose, axis=1) * MILLIMETRES_PER_UNIT < FACE_RADIUS)
    chosen = face[spread_indices(len(face), POINTS)]
    return FaceScan(name, vertices[chosen], normals[chosen], nose)


def fit_scans(
    model: ShapeModel, nose: np.ndarray, scans: Sequence[FaceScan], fit: ShapeFit | None = None
) -> list[dict]:
    """Latents fitted to all scans at once, from the mean head with its `nose` [3] on the scan's: of each its `name`,
    and the mean distance (mm) of its points from the `mean_head` and from the `fitted` one."""
    mean = _tree(model, np.zeros(model.bases["z_sdf"].shape[1]))
    maps = [icp(s.points, mean, Similarity(1.0, np.eye(3), s.nose - nose)) for s in scans]
    rows = [{"name": s.name, "mean_head": _distance(s, mean, map)} for s, map in zip(scans, maps, strict=True)]
    for _ in range(ROUNDS):
        w = fit_shape(model, [place_scan(s, map) for s, map in zip(scans, maps, strict=True)], fit)
        for k, scan in enumerate(scans):
            tree = _tree(model, w[:, k])
            maps[k] = icp(scan.points, tree, maps[k])
            rows[k]["fitted"] = _distance(scan, tree, maps[k])
    return rows


def _tree(model: ShapeModel, w: np.ndarray) -> TriangleTree:
    surface = extract_surface(model.field(model.latent("z_sdf", w)))
    return TriangleTree(surface.vertices, surface.faces)


def _distance(scan: FaceScan, tree: TriangleTree, map: Similarity) -> float:
    return float(distances_from(scan.points, tree, map).mean() * MILLIMETRES_PER_UNIT)


def place_scan(scan: FaceScan, map: Similarity) -> TrainingScene:
    """The scan before a head that `map` takes to it, as a scene of points without colours."""
    nothing = np.zeros((0, 3), np.float32)
    return TrainingScene(
        points=inverse(map)(scan.points).astype(np.float32),
        normals=(scan.normals @ map.rotation).astype(np.float32),
        region=np.zeros(len(scan.points), np.uint8),
        volume=nothing,
        volume_distance=nothing[:, 0],
        landmarks=nothing,
        sample_point=nothing[:, 0],
        sample_view=nothing[:, 0],
        sample_color=nothing,
        camera_centres=nothing,
    )
