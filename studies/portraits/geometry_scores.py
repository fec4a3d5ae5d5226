"""Errors of a predicted head: distances between surfaces, angles between normals, overlap of silhouettes.

Distances are in mm from points, spread evenly by area over the outer surface of one head, to the outer surface of the
other, never to its vertices. Each is measured after four alignments:

    h3ds        six landmarks, then ICP with scale on the skin of the face: after the protocol of H3DS
                (Ramon et al. 2021), whose distances are to the nearest vertex
    landmarks   six landmarks alone
    camera      both in their own camera's coordinates, one scale about the camera's centre
    camera_raw  the same without that scale

in these regions of the truth. A predicted point is assigned by its position and its closest true point:

    face      within 95 mm of the nose tip, skin and eyes only: what hair or cloth covers does not count
    face_all  the same sphere, with everything in it
    ears      within 45 mm of the usual places of the ears, skin only
    head      everything above the plane y = -1.3, 130 mm below the ears' axis, with hair
    seen      the part of the head that the photo shows
    hidden    the rest of it: the sides, the back, what lies behind something else
"""

from dataclasses import dataclass, field

import numpy as np

from sira_mi.conventions import LANDMARKS, MILLIMETRES_PER_UNIT
from sira_mi.errors import InputError
from sira_mi.fit.rays import find_modelled_pixels
from sira_mi.portrait.camera import Camera
from sira_mi.portrait.landmarks import NOSE_TIP
from sira_mi.training.collection.skin import EYE, SKIN
from studies.measures import FACE_RADIUS, SHOULDERS, statistics
from studies.portraits.alignment import (
    Icp,
    camera_alignment,
    camera_scale,
    distances_from,
    icp,
    inverse,
    landmark_alignment,
    select_shared_landmarks,
)
from studies.portraits.surface_distance import TriangleTree
from studies.portraits.truth import Truth, check_array, check_mesh
from studies.portraits.visible_surface import (
    MeshImages,
    OuterSurface,
    is_seen_by_camera,
    mesh_images,
    outer_surface,
)

REGIONS = ("face", "face_all", "ears", "head", "seen", "hidden")
EARS = ((-0.85, 0.08, -0.2), (0.85, 0.08, -0.2))  # scene units, in the subject's own frame
EAR_RADIUS = 45.0  # mm
DIRECTIONS = ("truth_to_prediction", "prediction_to_truth")


@dataclass(frozen=True)
class GeometrySettings:
    """Settings of `score_geometry` and `true_surface`."""

    samples: int = 20000  # places drawn on each head
    margin: float = 0.5  # scene units below the head's plane down to which the prediction is sampled
    icp_points: int = 4000  # at most
    icp: Icp = field(default_factory=Icp)
    seed: int = 0


@dataclass(frozen=True, eq=False)
class PredictedHead:
    """A method's estimate of a head. Lengths in scene units of 100 mm; all fields share one world frame."""

    vertices: np.ndarray  # [N, 3]
    faces: np.ndarray  # [T, 3]
    landmarks: np.ndarray  # [468, 3] on the head, NaN where unknown
    camera: Camera  # the estimated one, at the photo's pixels
    normal: np.ndarray | None = None  # [H, W, 3] world, any length, 0 where there is no head; None: the mesh's own
    mask: np.ndarray | None = None  # [H, W] coverage, 0 to 1; None: the mesh's own

    def check(self, height: int, width: int) -> None:
        """Raises InputError for arrays of wrong shape, a broken mesh, or images and camera not of the photo's size."""
        check_array("the prediction's vertices", self.vertices, (None, 3))
        check_array("the prediction's faces", self.faces, (None, 3))
        check_mesh("the prediction", self.vertices, self.faces)
        check_array("the prediction's landmarks", self.landmarks, (LANDMARKS, 3), finite=False)
        if (self.camera.height, self.camera.width) != (height, width):
            raise InputError(
                f"the prediction's camera is for {self.camera.width}x{self.camera.height} pixels but the photo is "
                f"{width}x{height}"
            )
        if self.normal is not None:
            check_array("the prediction's normal", self.normal, (height, width, 3), finite=False)
        if self.mask is not None:
            check_array("the prediction's mask", self.mask, (height, width))


@dataclass(frozen=True, eq=False)
class TrueSurface:
    """Data computed once per truth, for all predictions."""

    outer: OuterSurface
    tree: TriangleTree  # of the outer surface
    face_region: np.ndarray  # [F] region codes of its faces
    nose: np.ndarray  # [3] the nose tip
    images: MeshImages  # in the photo's camera


def true_surface(truth: Truth, settings: GeometrySettings | None = None) -> TrueSurface:
    """Raises InputError when the truth has no nose tip or none of its surface can be seen."""
    settings = settings or GeometrySettings()
    nose = truth.landmarks[NOSE_TIP]
    if not np.isfinite(nose).all():
        raise InputError(f"the truth has no landmark {NOSE_TIP}, the nose tip: the face is undefined")
    outer = outer_surface(truth.vertices, truth.faces, settings.samples, SHOULDERS, settings.seed)
    if not len(outer.points):
        raise InputError("nothing of the truth's head can be seen from outside")
    return TrueSurface(
        outer,
        TriangleTree(outer.vertices, outer.faces),
        truth.face_region[outer.face_index],
        nose,
        mesh_images(truth.vertices, truth.faces, truth.camera, outer.scene),
    )


def score_geometry(
    prediction: PredictedHead,
    truth: Truth,
    surface: TrueSurface | None = None,
    settings: GeometrySettings | None = None,
) -> dict[str, float]:
    """All geometry scores of a prediction; `surface` is `true_surface(truth, settings)`, if known already.

    `ALIGNMENT_REGION_DIRECTION_mean|median|p90|points` for all `ALIGNMENTS`, `REGIONS` and `DIRECTIONS`, where `points`
    counts the points measured (the others are NaN when there are none); `ALIGNMENT_REGION_mean`, the mean of both
    directions' means; `ALIGNMENT_scale` and `ALIGNMENT_turn` (degrees), of the map from prediction to truth, for the
    cameras from camera to camera; `camera_distance_error`, percent by which the estimated camera is farther from the
    landmarks than the true one, and `pose_error`, degrees between the face as it lies in the two cameras;
    `landmarks_used` of six and their root mean square distance `landmarks_rms`; and
    the scores of `score_normals` and `silhouette_iou`, the latter where a head model can be: over the pixels of
    `fit.rays.find_modelled_pixels`. Raises InputError for a prediction that cannot be measured."""
    settings = settings or GeometrySettings()
    prediction.check(truth.camera.height, truth.camera.width)
    surface = surface or true_surface(truth, settings)
    predicted, true = select_shared_landmarks(prediction.landmarks, truth.landmarks)
    placed = landmark_alignment(predicted, true)
    # The samples are drawn in the truth's frame, so that they are above its plane.
    outer = outer_surface(
        placed(prediction.vertices), prediction.faces, settings.samples, SHOULDERS - settings.margin, settings.seed
    )
    if not len(outer.points):
        raise InputError("nothing of the prediction's head can be seen from outside")
    points = inverse(placed)(outer.points)
    tree = TriangleTree(prediction.vertices, np.asarray(prediction.faces)[outer.face_index])

    scale = camera_scale(predicted, true, prediction.camera, truth.camera)
    own = _own_points(truth, surface)
    face = np.flatnonzero(own["face"])
    thinned = face[:: max(1, -(-len(face) // settings.icp_points))]
    if not len(thinned):
        raise InputError("the truth has no visible skin within the face: nothing to align to")
    maps = {
        "h3ds": icp(surface.outer.points[thinned], tree, placed, settings.icp),
        "landmarks": placed,
        "camera": camera_alignment(prediction.camera, truth.camera, scale),
        "camera_raw": camera_alignment(prediction.camera, truth.camera),
    }
    offsets = np.linalg.norm(placed(predicted) - true, axis=1) * MILLIMETRES_PER_UNIT
    scores = {"landmarks_used": float(len(true)), "landmarks_rms": float(np.sqrt((offsets**2).mean()))}
    away, true_away = (
        np.linalg.norm(points.mean(axis=0) - camera.centre)
        for points, camera in ((predicted, prediction.camera), (true, truth.camera))
    )
    scores["camera_distance_error"] = float(100 * (away / true_away - 1))
    scores["pose_error"] = _angle(maps["camera"].rotation @ maps["h3ds"].rotation.T)
    for name, map in maps.items():
        scores[f"{name}_scale"] = map.scale
        scores[f"{name}_turn"] = _angle(map.rotation)
        scores |= _distances(name, map(points), distances_from(surface.outer.points, tree, map), own, truth, surface)

    normal, mask = prediction.normal, prediction.mask
    if normal is None or mask is None:
        images = mesh_images(prediction.vertices, prediction.faces, prediction.camera)
        normal = images.normal if normal is None else normal
        mask = images.mask if mask is None else mask
    scores |= score_normals(normal, mask, prediction.camera, truth, surface)
    modelled = find_modelled_pixels(truth.camera)
    scores["silhouette_iou"] = silhouette_iou(np.where(modelled, mask, 0), np.where(modelled, truth.mask, 0))
    return scores


def score_normals(
    normal: np.ndarray, mask: np.ndarray, camera: Camera, truth: Truth, surface: TrueSurface
) -> dict[str, float]:
    """Angles in degrees between predicted normals [H, W, 3], of any length in the world of `camera`, and the true ones,
    each in its own camera's coordinates: `normals_mean`, `normals_median`, `normals_p90`, over the `normals_pixels`
    that show skin of the face where mask [H, W] > 0.5; `normals_missing` counts those of the face's skin without a
    prediction, because of the mask or a normal that is 0 or not finite."""
    away = np.nan_to_num(np.linalg.norm(surface.images.position - surface.nose, axis=2), nan=np.inf)
    skin = (truth.mask > 0.5) & (truth.region == SKIN) & (away * MILLIMETRES_PER_UNIT < FACE_RADIUS)
    length = np.linalg.norm(normal, axis=2)
    known = skin & (np.asarray(mask) > 0.5) & np.isfinite(length) & (length > 1e-6)
    first = normal[known] / length[known, None] @ camera.world_to_camera[:3, :3].T
    second = truth.normal[known] @ truth.camera.world_to_camera[:3, :3].T
    second = second / np.maximum(np.linalg.norm(second, axis=1, keepdims=True), 1e-12)
    angle = np.degrees(2 * np.arcsin(np.clip(np.linalg.norm(first - second, axis=1) / 2, 0, 1)))
    return {
        **{f"normals_{name}": value for name, value in statistics(angle).items()},
        "normals_pixels": float(known.sum()),
        "normals_missing": float((skin & ~known).sum()),
    }


def silhouette_iou(mask: np.ndarray, truth: np.ndarray) -> float:
    """Intersection over union of two masks [H, W] at coverage 0.5; NaN when both are empty."""
    first, second = np.asarray(mask) > 0.5, np.asarray(truth) > 0.5
    union = (first | second).sum()
    return float((first & second).sum() / union) if union else float("nan")


def _own_points(truth, surface):
    """Which of the truth's own samples belong to each region."""
    outer = surface.outer
    return _regions(truth, surface, outer.points, outer.points, outer.point_face)


def _regions(truth, surface, points, nearest, nearest_face) -> dict[str, np.ndarray]:
    """Which points [P, 3] belong to each region, given their nearest points on the truth and these points' faces."""
    head = points[:, 1] > SHOULDERS
    to_ear = np.linalg.norm(points[:, None] - np.array(EARS), axis=2).min(axis=1)
    near = head & (np.linalg.norm(points - surface.nose, axis=1) * MILLIMETRES_PER_UNIT < FACE_RADIUS)
    ears = (to_ear * MILLIMETRES_PER_UNIT < EAR_RADIUS) & (surface.face_region[nearest_face] == SKIN)
    bare = np.isin(surface.face_region[nearest_face], (SKIN, EYE))
    seen = is_seen_by_camera(surface.outer.scene, truth.camera, nearest, surface.outer.normals[nearest_face])
    return dict(zip(REGIONS, (near & bare, near, ears, head, head & seen, head & ~seen), strict=True))


def _distances(name, predicted, own_distance, own, truth, surface) -> dict[str, float]:
    """Scores of one alignment: `predicted` [P, 3] are the prediction's samples in the truth's world, `own_distance` the
    distances of the truth's samples to the prediction."""
    distance, nearest, face = surface.tree.nearest(predicted)
    there = _regions(truth, surface, predicted, nearest, face)
    scores: dict[str, float] = {}
    for region in REGIONS:
        sides = own_distance[own[region]], distance[there[region]]
        means = []
        for direction, values in zip(DIRECTIONS, sides, strict=True):
            found = statistics(values * MILLIMETRES_PER_UNIT)
            means.append(found["mean"])
            scores |= {f"{name}_{region}_{direction}_{measure}": value for measure, value in found.items()}
            scores[f"{name}_{region}_{direction}_points"] = float(len(values))
        scores[f"{name}_{region}_mean"] = float(np.mean(means))
    return scores


def _angle(rotation):
    return float(np.degrees(np.arccos(np.clip((np.trace(rotation) - 1) / 2, -1, 1))))
