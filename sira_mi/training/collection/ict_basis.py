"""The ICT-FaceKit identity basis (Li et al. 2020): the file, its skin and eyeballs, and the mean's landmarks."""

import zipfile
from dataclasses import dataclass
from pathlib import Path

import mitsuba as mi
import numpy as np

from sira_mi.conventions import LANDMARKS
from sira_mi.errors import InputError
from sira_mi.portrait.face import find_faces
from sira_mi.training.collection.lighting import render_lobes
from sira_mi.training.collection.registration import fit_sphere
from sira_mi.training.collection.render import (
    Part,
    RenderSettings,
    build_scene,
    intrinsic_matrix,
    look_at,
    render_views,
)
from sira_mi.training.collection.sheet import encode_srgb
from sira_mi.training.collection.skin import step
from sira_mi.training.collection.surface import unit_eye
from sira_mi.training.collection.triangles import Places, connected_pieces, find_nearest, vertex_normals

CENTIMETRES_PER_UNIT = 10.0
SIZE_LIMIT = 200_000  # vertices
EYE_RADIUS = (0.08, 0.25)  # scene units
SPAN = (15.0, 80.0)  # centimetres: diagonal of the mean's bounding box

# Renders on which the landmark network marks the mean.
MARK_SIZE = 256  # pixels
MARK_SAMPLES = 9
MARK_YAWS = (-12.0, 0.0, 12.0)  # degrees
MARK_DISTANCE = 14.0  # scene units
MARK_VIEW = 14.0  # degrees
MARK_COSINE = 0.35  # between surface normal and view, below which a mark is not used
MARK_TOLERANCE = 0.005  # scene units between a mark and the skin above which it is on an eyeball
MARK_LIGHT = np.array([[0, 1, 0, 0.3, 0.5, 0.5, 0.5], [0.3, 0.4, 0.9, 8, 0.8, 0.8, 0.8]])
MARK_SKIN, MARK_SCLERA, MARK_IRIS = (0.55, 0.38, 0.3), (0.6, 0.56, 0.54), (0.03, 0.02, 0.015)
FEWEST_MARKS = 300
SMALLEST_PIECE = 50  # vertices of an eyeball


@dataclass(frozen=True)
class Basis:
    """The file in scene units."""

    mean: np.ndarray  # [V, 3]
    modes: np.ndarray  # [K, V, 3] float32
    skin: np.ndarray  # [S, 3] triangles of face, head and neck, an open surface
    eyes: tuple[np.ndarray, np.ndarray]  # vertices on the rear of the left (+x) and the right eyeball


def read_basis(path: Path) -> Basis:
    """Reads `mean` [V, 3] and `basis` [K, V, 3] in centimetres (+y up, +z front) and `tris` [T, 3] of an npz file.

    Raises InputError when an array is missing, has another shape, is not finite, or when skin or eyeballs are not
    found among the connected pieces."""
    try:
        with np.load(path, allow_pickle=False) as data:
            mean, modes, triangles = data["mean"], data["basis"], data["tris"]
    except (OSError, ValueError, KeyError, EOFError, MemoryError, zipfile.BadZipFile) as error:
        raise InputError(f"{path}: not an npz file with mean, basis and tris ({_first_line(error)})") from None
    if mean.ndim != 2 or mean.shape[1] != 3 or not 0 < len(mean) <= SIZE_LIMIT:
        raise InputError(f"{path}: mean has shape {mean.shape}; expected [vertices, 3]")
    if modes.ndim != 3 or modes.shape[1:] != mean.shape or not 0 < len(modes) <= 100:
        raise InputError(f"{path}: basis has shape {modes.shape}; expected up to 100 modes of {mean.shape}")
    if triangles.ndim != 2 or triangles.shape[1] != 3 or not np.issubdtype(triangles.dtype, np.integer):
        raise InputError(f"{path}: tris has shape {triangles.shape}; expected integers [triangles, 3]")
    if not len(triangles) or triangles.min() < 0 or triangles.max() >= len(mean):
        raise InputError(f"{path}: tris names vertices outside mean")
    for name, values in (("mean", mean), ("basis", modes)):
        if values.dtype.kind != "f" or not np.isfinite(values).all():
            raise InputError(f"{path}: {name} holds values that are not finite numbers")
    if np.abs(modes).max() > SPAN[1]:
        raise InputError(f"{path}: basis holds displacements beyond {SPAN[1]:.0f} cm; expected centimetres")
    span = float(np.linalg.norm(np.ptp(mean[np.unique(triangles)], axis=0)))
    if not SPAN[0] < span < SPAN[1]:
        raise InputError(f"{path}: the mean spans {span:.3g} cm; expected a head in centimetres")
    return _take_apart(path, mean / CENTIMETRES_PER_UNIT, (modes / CENTIMETRES_PER_UNIT).astype(np.float32), triangles)


def _take_apart(path, mean, modes, triangles):
    """The largest connected piece is the skin, the largest other one on either side of it an eyeball."""
    triangles = triangles.astype(np.int64)
    mean = mean.astype(np.float64)
    ends = np.concatenate([triangles[:, :2], triangles[:, 1:]])
    label = connected_pieces(ends, len(mean))
    size = np.bincount(label)
    skin = size.argmax()
    eyes = []
    for side in (1, -1):
        best, reach = None, 0.0
        for piece in np.flatnonzero(size >= SMALLEST_PIECE):
            points = mean[label == piece]
            extent = float(np.linalg.norm(np.ptp(points, axis=0)))
            if piece != skin and (points[:, 0] * side > 0).all() and extent > reach:
                best, reach = piece, extent
        rear = np.flatnonzero(label == best) if best is not None else np.zeros(0, int)
        rear = rear[mean[rear, 2] <= np.median(mean[rear, 2])] if len(rear) else rear
        if not len(rear) or not EYE_RADIUS[0] < fit_sphere(mean[rear])[1] < EYE_RADIUS[1]:
            raise InputError(f"{path}: the mean has no eyeball on the side of {'+-'[side < 0]}x")
        eyes.append(rear)
    return Basis(mean, modes, triangles[label[triangles[:, 0]] == skin], (eyes[0], eyes[1]))


def _first_line(error):
    return (str(error).splitlines() or [type(error).__name__])[0]


def mark(basis: Basis, path: str) -> tuple[np.ndarray, Places, np.ndarray]:
    """Landmarks [468, 3] on the mean's skin, their places and their validity [468]: the median of what the
    portrait landmark network marks on near-frontal renders, traced back onto the skin.

    Raises InputError when no face is found."""
    settings = RenderSettings(size=MARK_SIZE, samples=MARK_SAMPLES, depth=2)
    normals = vertex_normals(basis.mean, basis.skin)
    parts = [_part(basis.mean, basis.skin, normals, np.tile(MARK_SKIN, (len(basis.mean), 1)))]
    unit, triangles = unit_eye()
    for eye in basis.eyes:
        centre, radius = fit_sphere(basis.mean[eye])
        iris = step(unit[:, 2], 0.91, 0.93)[:, None]
        albedo = MARK_SCLERA + iris * np.subtract(MARK_IRIS, MARK_SCLERA)
        parts.append(_part(centre + radius * unit, triangles, unit, albedo))
    scene = build_scene(parts, render_lobes(MARK_LIGHT), settings)
    target = np.mean([fit_sphere(basis.mean[eye])[0] for eye in basis.eyes], axis=0) * [0, 1, 0.5] - [0, 0.2, 0]
    turns = np.radians(MARK_YAWS)
    poses = np.array([look_at(target + MARK_DISTANCE * np.array([np.sin(t), 0, np.cos(t)]), target) for t in turns])
    intrinsic = intrinsic_matrix(MARK_VIEW, MARK_SIZE)
    images, coverage = render_views(scene, np.array([intrinsic] * len(poses)), poses, settings, 0)
    marks = []
    for image, cover, pose in zip(images, coverage, poses, strict=True):
        for face in find_faces(encode_srgb(image + 0.4 * (1 - cover[..., None])))[:1]:
            marks.append(_trace(scene, basis, normals, face.landmarks, intrinsic, pose))
    number = np.isfinite(marks).all(-1).sum(0) if marks else np.zeros(LANDMARKS)
    valid = number > 0
    if valid.sum() < FEWEST_MARKS:
        raise InputError(f"{path}: no face was found on renders of the mean; expected +y up and +z in front")
    middle = np.zeros((LANDMARKS, 3))
    middle[valid] = np.nanmedian(np.array(marks)[:, valid], axis=0)
    places, landmarks, _ = find_nearest(middle, None, basis.mean, basis.skin, candidates=24)
    return landmarks, places, valid


def _part(vertices, triangles, normals, albedo):
    return Part(vertices, triangles, normals, albedo, np.full(len(vertices), 0.3), np.zeros(len(triangles), int))


def _trace(scene, basis, normals, pixels, intrinsic, pose):
    """Points [468, 3] of the skin behind pixel positions [468, 2], NaN where it is not met squarely."""
    inverse = np.linalg.inv(pose)
    way = np.column_stack([pixels, np.ones(len(pixels))]) @ np.linalg.inv(intrinsic).T @ inverse[:3, :3].T
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    ray = mi.Ray3f(mi.Point3f(*inverse[:3, 3].tolist()), mi.Vector3f(way.T.astype(np.float32)))
    hit = scene.ray_intersect_preliminary(ray)
    distance = np.where(np.array(hit.is_valid()), np.array(hit.t), 0.0)
    points = inverse[:3, 3] + distance[:, None] * way
    places, found, _ = find_nearest(points, None, basis.mean, basis.skin, candidates=24)
    facing = -(places.matrix(basis.skin, len(basis.mean)) @ normals * way).sum(1)
    seen = (np.linalg.norm(found - points, axis=1) < MARK_TOLERANCE) & (facing > MARK_COSINE)
    return np.where(seen[:, None], found, np.nan)
