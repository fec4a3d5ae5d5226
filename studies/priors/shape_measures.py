"""Measures of a SA-SM: latents fitted to unseen scans, random heads, landmarks in reference space.

All distances are in mm between points and surfaces; nothing is aligned, the scans are in the model's own frame. The
mean head, w = 0, is measured beside every fit.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from zipfile import BadZipFile

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from sira_mi.avatar.decoders import render_radiance
from sira_mi.conventions import MILLIMETRES_PER_UNIT
from sira_mi.errors import InputError
from sira_mi.fields.columns import evaluate_in_chunks, to_array, unit_columns
from sira_mi.fields.extraction import EmptySurfaceError, ExtractedSurface
from sira_mi.fields.sdf import SdfField, deform, signed_distance, surface
from sira_mi.optimisation import losses
from sira_mi.optimisation.adam import adam, cosine_fall
from sira_mi.portrait.landmarks import NOSE_TIP
from sira_mi.training.pictures import blank_tile, extract_surface, head_tile
from sira_mi.training.scenes import TrainingScene, load_scene
from sira_mi.training.shape_model import ShapeModel
from studies.measures import FACE_RADIUS, SHOULDERS, spread_indices, statistics

DISC_RADIUS = 3.0  # mm: a scan is a disc of this radius at every point, across its normal
VOXEL = 0.05  # of extracted meshes, scene units
GRADIENT_RANGE = (0.9, 1.1)
_HAIR = 1  # of a scene's region
REGIONS = ("face", "face without hair", "head without hair", "head with hair")


@dataclass(frozen=True, eq=False)
class Scan:
    """A head that the model has not seen. Coordinates in scene units."""

    name: str
    traits: dict[str, str]  # source, ancestry, sex, age
    scene: TrainingScene
    hair: np.ndarray  # [P] bool
    nose: np.ndarray  # [3] the nose tip


@dataclass(frozen=True)
class ShapeFit:
    """Settings of `fit_shape`."""

    steps: int = 400
    points: int = 64  # a scan and step
    rate: float = 0.2  # of w; falls to a twentieth along a cosine
    normal: float = 0.1  # weight of the scan's normals beside the distance of its points, scene units
    penalty: float = 1e-4  # on the mean of w² over its entries


def manifest_entries(collection: Path, split: str) -> list[dict]:
    """The manifest's finished scenes of a split. Raises InputError when there is no manifest."""
    try:
        scenes = json.loads((collection / "manifest.json").read_text(encoding="utf-8"))["scenes"]
        return [entry for entry in scenes if entry["split"] == split and "error" not in entry]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"{collection} is not a collection: {error}; run python -m sira_mi.training.collection"
        ) from error


def load_scans(collection: Path, nose: np.ndarray, limit: int | None = None) -> list[Scan]:
    """The scans of the test split, or `limit` of them evenly spread over it; `nose` [3] stands in for a nose tip that
    a scan does not know. Raises InputError when there is none."""
    entries = manifest_entries(collection, "test")
    if not entries:
        raise InputError(f"{collection} has no test scenes; build a larger collection")
    if limit is not None:
        entries = [entries[k] for k in spread_indices(len(entries), limit)]
    scans = []
    for entry in entries:
        path = collection / Path(entry["file"]).name
        scene = load_scene(path)
        with np.load(path, allow_pickle=False) as file:
            region = file["region"]
        tip = scene.landmarks[NOSE_TIP]
        group = entry.get("group") or {}
        traits = {"source": str(entry.get("source", "makehuman"))}
        traits |= {trait: str(group.get(trait, "unknown")) for trait in ("ancestry", "sex", "age")}
        scans.append(Scan(path.name, traits, scene, region == _HAIR, tip if np.isfinite(tip).all() else nose))
    return scans


def load_landmarks(collection: Path) -> np.ndarray:
    """Landmarks [scenes, 468, 3] of the training scenes, NaN where unknown."""
    result = []
    for entry in manifest_entries(collection, "train"):
        path = collection / Path(entry["file"]).name
        try:
            with np.load(path, allow_pickle=False) as file:
                result.append(np.where(file["landmarks_valid"][:, None], file["landmarks"], np.nan))
        except (OSError, KeyError, ValueError, EOFError, BadZipFile) as error:
            raise InputError(f"{path} is not a scene of a collection: {error}") from error
    return np.stack(result).astype(np.float32)


# Fitting


def _latents(model: ShapeModel, name: str, w):
    """z [dim, S] of a tensor w [k, S]."""
    mean = mi.TensorXf(np.repeat(model.means[name][:, None], w.shape[1], axis=1))
    return mi.TensorXf(model.bases[name]) @ w + mean


def fit_shape(
    model: ShapeModel, scenes: Sequence[TrainingScene], fit: ShapeFit | None = None, seed: int = 0
) -> np.ndarray:
    """w [k, S] of the shape latents that fit the surface to each scene's scan, all scans at once, starting from the
    mean head; the networks are fixed."""
    fit = fit or ShapeFit()
    size = model.bases["z_sdf"].shape[1]
    optimizer = adam({"w": np.zeros((size, len(scenes)), np.float32)}, {"w": fit.rate})
    for step in range(fit.steps):
        optimizer.set_learning_rate({"w": fit.rate * cosine_fall(step / fit.steps, 0.05)})
        rng = np.random.default_rng([seed, 11, step])
        chosen = [rng.integers(len(scene.points), size=fit.points) for scene in scenes]
        points = np.concatenate([s.points[c] for s, c in zip(scenes, chosen, strict=True)])
        normals = np.concatenate([s.normals[c] for s, c in zip(scenes, chosen, strict=True)])
        w = optimizer["w"]
        dr.enable_grad(w)
        field = model.field(_latents(model, "z_sdf", w))
        f, gradient, _, _ = surface(field, to_array(points.T))
        loss = losses.surface_loss(f) + fit.penalty * losses.mean(w * w)
        loss += fit.normal * losses.normal_loss(gradient, to_array(normals.T))
        dr.backward(loss)
        optimizer.step()
    return dr.detach(optimizer["w"]).numpy()


def color_errors(
    model: ShapeModel, scans: Sequence[Scan], w: np.ndarray, steps: int = 200, points: int = 192, seed: int = 0
) -> list[float]:
    """The photometric loss (mean difference of square roots of radiance) of each scan whose shape `w` [k, S] is given,
    after its latent z_r is fitted to half of some observations, on the other half."""
    inputs = []
    for k, scan in enumerate(scans):
        scene = scan.scene
        samples = np.random.default_rng([seed, 12, k]).integers(len(scene.sample_point), size=4096)
        field = model.field(model.latent("z_sdf", w[:, k]))
        x = scene.points[scene.sample_point[samples]].T
        _, gradient, x_ref, gamma = evaluate_in_chunks(lambda x, field=field: surface(field, x), x)
        normals = unit_columns(gradient)
        inputs.append([x_ref, normals, scene.views(samples).T, gamma, scene.sample_color[samples].T])
    arrays = [np.stack(column, axis=1) for column in zip(*inputs, strict=True)]  # [rows, S, 4096]

    def radiance(w_r, index):
        parts = [to_array(a[:, :, index].reshape(len(a), -1)) for a in arrays]
        rendering = model.layers_at("rendering", _latents(model, "z_r", w_r))
        return render_radiance(rendering, model.architecture.rendering_octaves, *parts[:4]), parts[4]

    size = model.bases["z_r"].shape[1]
    optimizer = adam({"w": np.zeros((size, len(scans)), np.float32)}, {"w": 0.1})
    for step in range(steps):
        optimizer.set_learning_rate({"w": 0.1 * cosine_fall(step / steps, 0.05)})
        w_r = optimizer["w"]
        dr.enable_grad(w_r)
        index = np.random.default_rng([seed, 13, step]).integers(2048, size=points)
        loss = losses.photometric_loss(*radiance(w_r, index)) + 1e-4 * losses.mean(w_r * w_r)
        dr.backward(loss)
        optimizer.step()
    with dr.suspend_grad():
        seen, truth = radiance(dr.detach(optimizer["w"]), np.arange(2048, 4096))
        difference = np.abs(losses.display(seen).numpy() - losses.display(truth).numpy())
    return [float(v) for v in difference.reshape(3, len(scans), -1).mean(axis=(0, 2))]


# Distances


def to_surface(field: SdfField, points: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance (mm) of points [P, 3] to the zero level: two Newton steps along the gradient's direction at the point;
    and the angle (degrees) between the gradient and `normals` [P, 3]."""
    f, gradient = evaluate_in_chunks(lambda x: surface(field, x)[:2], points.T)
    length = np.maximum(np.linalg.norm(gradient, axis=0), 0.1)
    way = -f[0] / length
    (f,) = evaluate_in_chunks(lambda x: signed_distance(field, x), points.T + way * gradient / length)
    cosine = (gradient * normals.T).sum(axis=0) / np.maximum(np.linalg.norm(gradient, axis=0), 1e-6)
    angle = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    return np.abs(way - f[0] / length) * MILLIMETRES_PER_UNIT, angle


def surface_samples(field: SdfField, extracted: ExtractedSurface, count: int, seed: int = 0) -> np.ndarray:
    """Points [count, 3] spread evenly over the surface above the shoulders, moved from the mesh onto the zero level."""
    corners = extracted.vertices[extracted.faces.astype(np.int64)]
    usable = ~extracted.on_box[extracted.faces].any(axis=1) & (corners[:, :, 1].min(axis=1) > SHOULDERS)
    corners = corners[usable]
    if not len(corners):
        return np.zeros((0, 3), np.float32)
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    rng = np.random.default_rng([seed, 14])
    a, b = np.sqrt(rng.random((count, 1))), rng.random((count, 1))
    chosen = corners[rng.choice(len(corners), count, p=area / area.sum())]
    points = (1 - a) * chosen[:, 0] + a * (1 - b) * chosen[:, 1] + a * b * chosen[:, 2]
    f, gradient = evaluate_in_chunks(lambda x: surface(field, x)[:2], points.T.astype(np.float32))
    way = np.clip(-f[0], -VOXEL, VOXEL) / np.maximum((gradient * gradient).sum(axis=0), 0.1)
    return (points.T + way * gradient).T.astype(np.float32)


def to_scan(points: np.ndarray, scan: Scan) -> tuple[np.ndarray, np.ndarray]:
    """Distance (mm) of points [P, 3] to the tangent disc of the nearest scan point, and that point's index."""
    _, nearest = cKDTree(scan.scene.points).query(points)
    offset = (points - scan.scene.points[nearest]) * MILLIMETRES_PER_UNIT
    height = (offset * scan.scene.normals[nearest]).sum(axis=1)
    beside = np.sqrt(np.maximum((offset * offset).sum(axis=1) - height**2, 0))
    return np.hypot(height, np.maximum(beside - DISC_RADIUS, 0)), nearest


def spacing(points: np.ndarray) -> float:
    """Median distance (mm) of points [P, 3] to their nearest neighbour."""
    return float(np.median(cKDTree(points).query(points, 2)[0][:, 1])) * MILLIMETRES_PER_UNIT


def regions_of(points: np.ndarray, hair: np.ndarray, nose: np.ndarray) -> dict[str, np.ndarray]:
    """Which of the points [P, 3] belong to each of `REGIONS`."""
    head = points[:, 1] > SHOULDERS
    face = head & (np.linalg.norm(points - nose, axis=1) * MILLIMETRES_PER_UNIT < FACE_RADIUS)
    return dict(zip(REGIONS, (face, face & ~hair, head & ~hair, head), strict=True))


def scan_errors(field: SdfField, scan: Scan, count: int, seed: int = 0) -> dict[str, dict]:
    """`distance` (mm) and `angle` (degrees) at `count` random scan points by region, as `statistics`."""
    chosen = np.random.default_rng([seed, 15]).integers(len(scan.scene.points), size=count)
    points = scan.scene.points[chosen]
    distance, angle = to_surface(field, points, scan.scene.normals[chosen])
    regions = regions_of(points, scan.hair[chosen], scan.nose)
    return {
        "distance": {name: statistics(distance[mask]) for name, mask in regions.items()},
        "angle": {name: statistics(angle[mask]) for name, mask in regions.items()},
    }


def surface_errors(points: np.ndarray, scan: Scan) -> dict[str, dict]:
    """Distances (mm) of `surface_samples` [P, 3] to a scan by region, as `statistics`; hair is where the nearest scan
    point is hair."""
    distance, nearest = to_scan(points, scan)
    regions = regions_of(points, scan.hair[nearest], scan.nose)
    return {name: statistics(distance[mask]) for name, mask in regions.items()}


# Random heads


def components(extracted: ExtractedSurface) -> tuple[int, float]:
    """The number of connected parts of a mesh and the share of its triangles in the largest."""
    faces = extracted.faces.astype(np.int64)
    n = len(extracted.vertices)
    edges = coo_matrix((np.ones(2 * len(faces)), (faces[:, [0, 1]].ravel(), faces[:, [1, 2]].ravel())), shape=(n, n))
    _, label = connected_components(edges, directed=False)
    sizes = np.bincount(label[faces[:, 0]])
    return int((sizes > 0).sum()), float(sizes.max() / len(faces))


def random_heads(model: ShapeModel, sigma: float, count: int, seed: int = 0) -> tuple[list[dict], list[np.ndarray]]:
    """Heads of latents drawn from N(0, σ²): of each its connected `parts`, the share of triangles in the `largest`,
    the share of surface points whose |∇f| is within 0.9 and 1.1 (`gradient`), and a picture."""
    rows, tiles = [], []
    for k in range(count):
        normal = np.random.default_rng([seed, 16, k]).standard_normal(size=(model.bases["z_sdf"].shape[1],))
        w = sigma * normal
        field = model.field(model.latent("z_sdf", w))
        try:
            extracted = extract_surface(field, VOXEL)
        except EmptySurfaceError:
            rows.append({"parts": 0, "largest": 0.0, "gradient": 0.0})
            tiles.append(blank_tile())
            continue
        parts, largest = components(extracted)
        vertices = extracted.vertices[~extracted.on_box]
        chosen = np.random.default_rng([seed, 17, k]).integers(max(len(vertices), 1), size=4096)
        (gradient,) = evaluate_in_chunks(lambda x, field=field: surface(field, x)[1], vertices[chosen].T)
        length = np.linalg.norm(gradient, axis=0)
        share = np.mean((length > GRADIENT_RANGE[0]) & (length < GRADIENT_RANGE[1]))
        rows.append({"parts": parts, "largest": largest, "gradient": float(share)})
        tiles.append(head_tile(field, extracted))
    return rows, tiles


# Landmarks


def landmark_spread(model: ShapeModel, latents: np.ndarray, landmarks: np.ndarray) -> dict[str, float]:
    """How far the landmarks [S, 468, 3] of scenes with shape `latents` [dim, S] are from their mean over the scenes,
    root mean square, averaged over the landmarks that at least half of the scenes know, in mm: `deformed`, at x_ref,
    and `undeformed`, at x. `scale` is the size of the mean x_ref over that of the mean x, which tells agreement from
    shrinking."""
    moved = np.empty_like(landmarks)
    for k, x in enumerate(landmarks):
        field = model.field(latents[:, k])
        (x_ref,) = evaluate_in_chunks(lambda p, field=field: deform(field, p)[0], np.nan_to_num(x).T)
        moved[k] = np.where(np.isfinite(x), x_ref.T, np.nan)
    known = np.isfinite(landmarks[:, :, 0]).mean(axis=0) >= 0.5
    if not known.any():
        raise InputError("no landmark is known in half of the scenes; check the landmarks of the collection")
    spreads, sizes = [], []
    for x in (moved[:, known], landmarks[:, known]):
        centre = np.nanmean(x, axis=0)
        spreads.append(
            float(np.sqrt(np.nanmean(((x - centre) ** 2).sum(axis=2), axis=0)).mean()) * MILLIMETRES_PER_UNIT
        )
        sizes.append(float(np.sqrt(((centre - centre.mean(axis=0)) ** 2).sum(axis=1).mean())))
    return {"deformed": spreads[0], "undeformed": spreads[1], "scale": sizes[0] / sizes[1], "scenes": len(landmarks)}
