"""The 468 face landmarks of a head without known correspondence.

The portrait landmark network marks near-frontal renders, each mark is traced back onto the head, and a landmark is the
median of its marks. Alignment with the landmarks of the mean MakeHuman head gives the head its frame.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from sira_mi.conventions import LANDMARKS, MILLIMETRES_PER_UNIT
from sira_mi.portrait.face import Face, find_faces, refine_landmarks
from sira_mi.training.collection.landmarks import mesh_landmarks
from sira_mi.training.collection.makehuman import ANCESTRIES, Identity, identity_vertices
from sira_mi.training.collection.person import make_person
from sira_mi.training.collection.render import (
    Part,
    RenderSettings,
    build_scene,
    camera_position,
    find_exposure,
    intrinsic_matrix,
    look_at,
    project,
)
from sira_mi.training.collection.sheet import encode_srgb
from sira_mi.training.collection.similarity import Similarity, fit_robustly
from sira_mi.training.collection.skin import EYE, SKIN
from sira_mi.training.collection.subject import BrokenHead
from sira_mi.training.collection.surface import eye_spheres, head_surface
from sira_mi.training.collection.triangles import find_nearest, vertex_normals

# Direction and irradiance of the lamps: a key light, sides, above, below, from the camera.
LAMPS = np.array(
    [[0.2, 0.4, 0.9, 1], [0.8, 0.2, 0.5, 0.4], [-0.8, 0.2, 0.5, 0.4], [0, 1, 0.3, 0.5], [0, -0.6, 0.7, 0.3]]
)
AMBIENT = 0.25  # irradiance without direction
BACKGROUND = 0.4  # linear radiance behind the head
LUMINANCE = 0.3  # mean linear luminance of the head
SEARCH_SPAN = 3.4  # scene units that the longest side of a head of unknown size is scaled to while its face is sought
SEARCH_SIZE = 190  # pixels, below what `find_faces` searches with its finest, slow tiles
SHORTEST_AXIS = 1e-9  # share of the longest side of the box around a head
# Misfit to the mean head, median distance in mm at its size, above which the marks are no face.
LARGEST_MISFIT = 9.0
# Scale to the mean head's size outside which a head of known unit is not in that unit.
NATURAL_SCALE = (0.75, 1.35)
_CANDIDATES = 24  # triangles among which the skin nearest to a mark is sought
TURN_LIMIT = 8.0  # degrees between the assumed and the found frame above which the marks are made again


@dataclass(frozen=True)
class AnnotationSettings:
    size: int = 256  # pixels
    grid: int = 1  # samples a pixel along each axis
    yaws: tuple[float, ...] = (-14.0, 0.0, 14.0)  # degrees
    field_of_view: float = 14.0  # degrees
    distance: float = 14.0  # scene units
    smallest_cosine: float = 0.25  # between surface normal and view, below which a mark is not used
    # Between the mean head's surface normal at a landmark and the view, below which the mark is not used: the network
    # puts landmarks that face away onto the outline. -1 uses all.
    expected_cosine: float = 0.5
    presence: float = 0.5  # the network's confidence below which a view is not used
    search: bool = False  # find the face by the detector instead of at the position of the mean head's


@dataclass(frozen=True)
class Marks:
    """The points of a head that the landmarks of each of V views hit."""

    points: np.ndarray  # [V, 468, 3] scene units; NaN where a mark does not meet skin or eyes squarely
    part: np.ndarray  # [V, 468] index of the part
    triangle: np.ndarray  # [V, 468] index of the part's triangle
    weights: np.ndarray  # [V, 468, 3] barycentric weights


@cache
def mean_control() -> np.ndarray:
    """Base-mesh vertices [19158, 3] of the MakeHuman head of average age, sex and ancestry, scene units."""
    share = 1 / len(ANCESTRIES)
    return identity_vertices(Identity(40.0, 0.5, (share,) * len(ANCESTRIES), 0.5, 0.5, 0.4, {}))


def mean_eyes() -> np.ndarray:
    """The middle [3] between the mean head's eyes, scene units."""
    return np.mean([centre for centre, _ in eye_spheres(mean_control())], axis=0)


@cache
def mean_head() -> tuple[np.ndarray, np.ndarray]:
    """Landmarks [468, 3] in scene units and validity [468] of the MakeHuman head of average age, sex and ancestry."""
    return mesh_landmarks(head_surface(mean_control())[0])


@cache
def _mean_normals():
    """Unit normals [468, 3] at the mean head's landmarks."""
    head, triangles = head_surface(mean_control())
    normals = mesh_landmarks(vertex_normals(head, triangles))[0]
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)


def place_cameras(settings: AnnotationSettings) -> tuple[np.ndarray, np.ndarray]:
    """Intrinsics [V, 3, 3] and world-to-camera matrices [V, 4, 4] of the near-frontal views."""
    target = np.array([0.0, 0.1, 0.4])
    poses = []
    for yaw in np.radians(settings.yaws):
        poses.append(look_at(target + settings.distance * np.array([np.sin(yaw), 0.0, np.cos(yaw)]), target))
    return np.array([intrinsic_matrix(settings.field_of_view, settings.size)] * len(poses)), np.array(poses)


def mark_views(parts: list[Part], settings: AnnotationSettings) -> Marks:
    """Marks on a head in the project's frame, of the views in which a face is found."""
    intrinsics, poses = place_cameras(settings)
    scene, shown = take_photos(parts, intrinsics, poses, settings)
    rows = []
    for image, intrinsic, pose in zip(shown, intrinsics, poses, strict=True):
        face = _face(image, intrinsic, pose, settings)
        if face is not None:
            points, *hit = _trace(scene, parts, face.landmarks, intrinsic, pose, settings.smallest_cosine)
            if settings.expected_cosine > -1:
                points[~_is_turned_to(pose, settings.expected_cosine)] = np.nan
            rows.append((points, *hit))
    if not rows:
        return Marks(np.zeros((0, LANDMARKS, 3)), *(np.zeros((0, LANDMARKS), int),) * 2, np.zeros((0, LANDMARKS, 3)))
    return Marks(*(np.stack(column) for column in zip(*rows, strict=True)))


def take_photos(
    parts: list[Part], intrinsics: np.ndarray, poses: np.ndarray, settings: AnnotationSettings
) -> tuple[mi.Scene, list[np.ndarray]]:
    """The scene, and 8-bit pictures [H, W, 3] of it: diffuse reflection of distant lamps with their shadows. They
    have no noise, which would cost the landmark network more accuracy than the simpler light does."""
    scene = build_scene(parts, np.zeros((2, 4, 3)), RenderSettings())
    size, grid = settings.size, settings.grid
    at = (np.arange(size * grid) + 0.5) / grid
    pixel = np.stack([*np.meshgrid(at, at), np.ones((size * grid,) * 2)], axis=-1)
    rays = [_rays(pixel.reshape(-1, 3), k, pose) for k, pose in zip(intrinsics, poses, strict=True)]
    origin, way = (np.concatenate(column).T.astype(np.float32) for column in zip(*rays, strict=True))
    hit = scene.ray_intersect(mi.Ray3f(mi.Point3f(origin), mi.Vector3f(way)))
    normal: Any = mi.Vector3f(hit.sh_frame.n)  # the stubs of `dr.dot` take no Mitsuba vector
    normal = dr.select(dr.dot(normal, hit.to_world(hit.wi)) > 0, normal, -normal)
    light = mi.Float(AMBIENT)
    for x, y, z, irradiance in LAMPS.tolist():
        lamp = dr.normalize(mi.Vector3f(x, y, z))
        shadow = scene.ray_test(hit.spawn_ray(lamp), hit.is_valid())
        light += dr.select(shadow, 0, irradiance * dr.maximum(dr.dot(normal, lamp), 0))
    albedo = hit.shape.eval_attribute_3("vertex_albedo", hit, hit.is_valid())
    cover = dr.select(hit.is_valid(), mi.Float(1), 0)
    channels = [np.array(channel) for channel in (*(channel * light for channel in albedo), cover)]
    fine = np.nan_to_num(np.stack(channels, axis=-1)).reshape(len(poses), size, grid, size, grid, 4)
    shown = []
    for image in fine.mean((2, 4)):
        colour, cover = image[..., :3], image[..., 3]
        shown.append(
            encode_srgb(colour * find_exposure(colour, cover, LUMINANCE) + BACKGROUND * (1 - cover[..., None]))
        )
    return scene, shown


def _rays(pixels, intrinsic, pose):
    """Origins and unit directions [N, 3] through homogeneous pixel positions [N, 3]."""
    inverse = np.linalg.inv(pose)
    way = pixels @ np.linalg.inv(intrinsic).T @ inverse[:3, :3].T
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    return np.broadcast_to(inverse[:3, 3], way.shape), way


def _face(image, intrinsic, pose, settings):
    if settings.search:
        return next(iter(find_faces(image)), None)
    landmarks, valid = mean_head()
    expected = project(landmarks, intrinsic, pose)[0]
    expected[~valid] = expected[valid].mean(0)
    face = Face(expected, np.zeros(LANDMARKS), 1.0)
    for _ in range(2):
        face = refine_landmarks(image, face)
    return face if face.presence >= settings.presence else None


def _is_turned_to(pose, cosine):
    """Whether the mean head's landmarks [468] are turned to a camera."""
    way = camera_position(pose) - mean_head()[0]
    return (way * _mean_normals()).sum(1) > cosine * np.linalg.norm(way, axis=1)


def _trace(scene, parts, pixels, intrinsic, pose, smallest_cosine):
    """Points, part and triangle indices and weights, as rows of `Marks`, behind pixel positions [468, 2]."""
    origin, way = _rays(np.column_stack([pixels, np.ones(len(pixels))]), intrinsic, pose)
    ray = mi.Ray3f(mi.Point3f(origin.T.astype(np.float32)), mi.Vector3f(way.T.astype(np.float32)))
    hit = scene.ray_intersect_preliminary(ray)
    valid = np.array(hit.is_valid()).astype(bool)
    u, v = np.clip(np.nan_to_num(np.array(hit.prim_uv)), 0, 1)
    shape = np.array(dr.reinterpret_array(mi.UInt32, hit.shape))
    part = np.zeros(len(pixels), int)
    identifiers = {s.id(): np.array(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(s))).item() for s in scene.shapes()}
    for number in range(len(parts)):
        part[shape == identifiers[f"part{number}"]] = number
    triangle = np.where(valid, np.array(hit.prim_index).astype(int), 0)
    weights = np.stack([1 - u - v, u, v], axis=1)
    points = np.full((len(pixels), 3), np.nan)
    for number, surface in enumerate(parts):
        mine = np.flatnonzero(valid & (part == number))
        corner = surface.triangles[triangle[mine]]
        normal = np.einsum("nk,nkd->nd", weights[mine], surface.normals[corner])
        squarely = -(normal * way[mine]).sum(1) > smallest_cosine * np.linalg.norm(normal, axis=1)
        squarely &= np.isin(surface.region[triangle[mine]], (SKIN, EYE))
        points[mine[squarely]] = np.einsum("nk,nkd->nd", weights[mine], surface.vertices[corner])[squarely]
    return points, part, triangle, weights


def find_consensus(marks: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Median [468, 3], number of marks [468] and median distance from the median [468] of marks [R, 468, 3] with NaN
    gaps, in their unit; NaN where there is no mark."""
    number = np.isfinite(marks[..., 0]).sum(0)
    middle, spread = np.full((marks.shape[1], 3), np.nan), np.full(marks.shape[1], np.nan)
    some = number > 0
    middle[some] = np.nanmedian(marks[:, some], axis=0)
    spread[some] = np.nanmedian(np.linalg.norm(marks[:, some] - middle[some], axis=-1), axis=0)
    return middle, number, spread


def annotate(
    parts: list[Part], settings: AnnotationSettings | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Landmarks [468, 3] on the skin of a head in the project's frame, validity [468], and the median distance of the
    marks from their landmark [468] in mm, NaN where invalid.

    Raises BrokenHead when no view shows a face."""
    marks = mark_views(parts, settings or AnnotationSettings())
    middle, number, spread = find_consensus(marks.points)
    valid = number > 0
    if not valid.any():
        raise BrokenHead("no face found on its renders")
    middle[valid] = _move_onto_skin(middle[valid], parts)
    return np.where(valid[:, None], middle, 0), valid, spread * MILLIMETRES_PER_UNIT


def _move_onto_skin(positions, parts):
    """The nearest points [N, 3] on skin."""
    lower, upper = positions.min(0) - 0.2, positions.max(0) + 0.2
    pieces = []
    for part in parts:
        corners = part.vertices[part.triangles[part.region == SKIN]]
        middle = corners.mean(1)
        pieces.append(corners[((middle > lower) & (middle < upper)).all(1)])
    corners = np.concatenate(pieces)
    if not len(corners):
        raise BrokenHead("no skin where its face was found")
    triangles = np.arange(3 * len(corners)).reshape(-1, 3)
    return find_nearest(positions, None, corners.reshape(-1, 3), triangles, candidates=_CANDIDATES)[1]


def find_face(parts: list[Part], turns: Iterator[np.ndarray] | list[np.ndarray]) -> Similarity:
    """A rough similarity that takes a head of unknown position and size to the project's frame. `turns` are rotations
    [3, 3] to try in order: the first after which a face looks along +z is taken.

    Raises BrokenHead when no rotation shows a face."""
    everything = np.concatenate([part.vertices for part in parts])
    target, target_valid = mean_head()
    settings = AnnotationSettings(size=SEARCH_SIZE)
    centre = np.array([0.0, 0.0, 0.0])
    pose = look_at(centre + np.array([0, 0, settings.distance]), centre)[None]
    fov = 2 * np.degrees(np.arctan(0.62 * SEARCH_SPAN / (settings.distance - SEARCH_SPAN / 2)))
    intrinsic = intrinsic_matrix(fov, settings.size)[None]
    for turn in turns:
        turned = everything @ turn.T
        lower, upper = turned.min(0), turned.max(0)
        span = float((upper - lower).max())
        if not np.isfinite(span) or (upper - lower).min() <= SHORTEST_AXIS * span:
            raise BrokenHead("it is flat or empty")
        scale = SEARCH_SPAN / span
        first = Similarity(scale, turn, -scale * (lower + upper) / 2)
        placed = first.move(parts)
        scene, shown = take_photos(placed, intrinsic, pose, settings)
        for face in find_faces(shown[0])[:1]:
            points, *_ = _trace(scene, placed, face.landmarks, intrinsic[0], pose[0], settings.smallest_cosine)
            seen = target_valid & np.isfinite(points[:, 0])
            if seen.sum() < LANDMARKS // 3:
                continue
            second = fit_robustly(points[seen], target[seen], scaled=True)
            if measure_misfit(second(points[seen]), target[seen]) < LARGEST_MISFIT:
                return second.after(first)
    raise BrokenHead("no face found on it from any side")


def measure_misfit(points: np.ndarray, target: np.ndarray) -> float:
    """Median distance of points [N, 3] from their targets [N, 3], mm."""
    return float(np.median(np.linalg.norm(points - target, axis=1))) * MILLIMETRES_PER_UNIT


def list_axis_turns() -> Iterator[np.ndarray]:
    """The 24 rotations that permute the axes, as [3, 3], those that keep a usual up axis first."""
    signed = [s * np.eye(3)[k] for k, s in product(range(3), (1, -1))]
    x, y, z = np.eye(3)
    ups = [y, z, *(axis for axis in signed if not (axis == y).all() and not (axis == z).all())]
    for up in ups:
        fronts = [axis for axis in (z, -y, y, -z, x, -x) if abs(axis @ up) < 0.5]
        for front in fronts:
            yield np.stack([np.cross(up, front), up, front])


def find_frame(
    parts: list[Part], rough: Similarity, natural_size: bool, settings: AnnotationSettings | None = None
) -> tuple[Similarity, np.ndarray, np.ndarray, np.ndarray]:
    """A head's frame and landmarks from a rough frame: the refined similarity (rigid beyond `rough` with
    `natural_size`), and in its target landmarks, validity and spread as `annotate` gives them.

    Raises BrokenHead when the marks do not look like a face, or not like one of the natural size."""
    target, target_valid = mean_head()
    frame = rough
    for _ in range(2):
        placed = frame.move(parts)
        landmarks, valid, spread = annotate(placed, settings)
        both = valid & target_valid
        if both.sum() < LANDMARKS // 3:
            raise BrokenHead(f"only {both.sum()} of {LANDMARKS} face landmarks can be seen")
        free = fit_robustly(landmarks[both], target[both], scaled=True)
        if measure_misfit(free(landmarks[both]), target[both]) > LARGEST_MISFIT:
            raise BrokenHead("what the landmark network marked is no face")
        if natural_size and not NATURAL_SCALE[0] < free.scale < NATURAL_SCALE[1]:
            raise BrokenHead(f"its face is {1 / free.scale:.2f} times the mean face's size: not in the stated unit")
        change = fit_robustly(landmarks[both], target[both], scaled=not natural_size)
        frame = change.after(frame)
        turn = np.degrees(np.arccos(np.clip((np.trace(change.rotation) - 1) / 2, -1, 1)))
        if turn < TURN_LIMIT and abs(np.log(change.scale)) < 0.15 and np.linalg.norm(change.shift) < 0.5:
            break
    landmarks = np.where(valid[:, None], change(landmarks), 0)
    return frame, landmarks, valid, spread * change.scale


def check_landmarks(
    seeds: list[int], hair: Path | None = None, settings: AnnotationSettings | None = None
) -> dict[str, float]:
    """Automatic landmarks against the known correspondence on MakeHuman heads: distance in mm over all landmarks that
    both have (median, 95th percentile), the share annotated, and the error of the recovered frame: how far the head's
    landmarks land from their place, mm, and the turn, degrees."""
    distances, shares, shifts, turns = [], [], [], []
    for seed in seeds:
        person = make_person(seed, hair)
        known, known_valid = mesh_landmarks(person.head)
        found, valid, _ = annotate(person.parts, settings)
        both = valid & known_valid
        distances.append(np.linalg.norm(found - known, axis=1)[both])
        shares.append(both.sum() / known_valid.sum())
        target, target_valid = mean_head()
        usual = fit_robustly(known[known_valid & target_valid], target[known_valid & target_valid], scaled=False)
        change = fit_robustly(found[both & target_valid], target[both & target_valid], scaled=False)
        shifts.append(np.linalg.norm(change(known) - usual(known), axis=1)[known_valid].mean())
        cosine = (np.trace(change.rotation.T @ usual.rotation) - 1) / 2
        turns.append(np.degrees(np.arccos(np.clip(cosine, -1, 1))))
    distance = np.concatenate(distances) * MILLIMETRES_PER_UNIT
    return {
        "heads": float(len(seeds)),
        "median_mm": float(np.median(distance)),
        "percentile_95_mm": float(np.percentile(distance, 95)),
        "annotated_share": float(np.mean(shares)),
        "frame_shift_mm": float(np.mean(shifts)) * MILLIMETRES_PER_UNIT,
        "frame_turn_degrees": float(np.mean(turns)),
    }
