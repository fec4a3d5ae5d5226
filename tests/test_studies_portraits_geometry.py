"""Scores of geometry: distances equal brute force and analytic values, alignments recover known maps, and regions leave
out what they must."""

import dataclasses

import numpy as np
import pytest
import trimesh
from egg import HAIR, SIZE, SKIN, head_like, landmarks_on, truth_of, turned_camera
from scipy.spatial.transform import Rotation

from sira_mi.errors import InputError
from sira_mi.portrait.landmarks import INNER_EYE_CORNERS, MOUTH_CORNERS
from sira_mi.training.collection.similarity import Similarity
from studies.portraits.alignment import Icp, distances_from, icp, inverse
from studies.portraits.geometry_scores import (
    EARS,
    REGIONS,
    GeometrySettings,
    PredictedHead,
    score_geometry,
    score_normals,
    silhouette_iou,
    true_surface,
)
from studies.portraits.surface_distance import TriangleTree, nearest_reference
from studies.portraits.truth import Truth
from studies.portraits.visible_surface import even_samples, mesh_images, outer_surface

QUICK = GeometrySettings(samples=4000, icp_points=1500)


@pytest.fixture(scope="module")
def truth() -> Truth:
    return truth_of(*head_like())


@pytest.fixture(scope="module")
def surface(truth):
    return true_surface(truth, QUICK)


def copy_of(truth: Truth, **changes) -> PredictedHead:
    """The truth as a prediction."""
    whole = {"vertices": truth.vertices, "faces": truth.faces, "landmarks": truth.landmarks, "camera": truth.camera}
    return PredictedHead(**(whole | changes))


# Distances


def soup(seed: int) -> np.ndarray:
    """Triangles [300, 3, 3]: small and huge ones, needles, and ones without area."""
    rng = np.random.default_rng(seed)
    corners = rng.standard_normal((300, 1, 3)) + rng.standard_normal((300, 3, 3)) * 10 ** rng.uniform(
        -3, 0.5, (300, 1, 1)
    )
    corners[::10, 2] = corners[::10, 1] + 1e-6 * rng.standard_normal((30, 3))
    corners[5::50, 2] = 0.3 * corners[5::50, 0] + 0.7 * corners[5::50, 1]
    return corners


@pytest.mark.parametrize("away", [0.01, 0.3, 5.0])
def test_distance_to_a_mesh_is_that_to_its_nearest_triangle(away):
    """Against all triangles in turn, and against another implementation of the distance to a triangle."""
    corners = soup(1)
    vertices, faces = corners.reshape(-1, 3), np.arange(900).reshape(-1, 3)
    rng = np.random.default_rng(2)
    points = corners[rng.integers(300, size=80)].mean(axis=1) + away * rng.standard_normal((80, 3))
    distance, closest, face = TriangleTree(vertices, faces).nearest(points)
    np.testing.assert_allclose(np.linalg.norm(points - closest, axis=1), distance, rtol=1e-12)
    solid = np.flatnonzero(np.linalg.norm(np.cross(*(corners[:, k] - corners[:, 0] for k in (1, 2))), axis=1) > 1e-12)
    other = [
        np.linalg.norm(trimesh.triangles.closest_point(corners[solid], np.tile(p, (len(solid), 1))) - p, axis=1)
        for p in points
    ]
    np.testing.assert_allclose(distance, np.min(other, axis=1), rtol=1e-7, atol=1e-9)
    expected, _, where = nearest_reference(points, vertices, faces[solid])
    np.testing.assert_array_equal(distance, expected)
    assert (face == solid[where]).mean() > 0.95  # ties aside


def test_search_takes_any_number_of_points_and_triangles():
    one = np.eye(3), np.array([[0, 1, 2]])
    distance, closest, face = TriangleTree(*one).nearest(np.zeros((2, 3)))
    np.testing.assert_allclose(distance, 1 / np.sqrt(3))
    np.testing.assert_allclose(closest, 1 / 3)
    assert face.tolist() == [0, 0]
    assert [len(a) for a in TriangleTree(*one).nearest(np.zeros((0, 3)))] == [0, 0, 0]
    with pytest.raises(ValueError, match="no triangle"):
        TriangleTree(np.zeros((3, 3)), one[1])


# Surfaces


def test_samples_are_even_by_area():
    """Each of very unequal triangles gets its share, spread all over it."""
    vertices, faces = head_like()
    corners = np.concatenate([vertices[faces], [[[-3, 0, 3], [3, 0, 3], [0, 3, 3]]]])
    index, points = even_samples(corners, 5000)
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    assert np.mean(index == len(faces)) == pytest.approx(area[-1] / area.sum(), abs=1e-3)
    flat = points[index == len(faces)]
    np.testing.assert_allclose(flat.mean(axis=0), [0, 1, 3], atol=0.05)
    np.testing.assert_allclose(flat[:, 2], 3)


@pytest.mark.slow
@pytest.mark.parametrize("winding", [1, -1])
def test_only_what_can_be_seen_from_outside_is_surface(winding):
    """A head within a head and a plate inside both are left out, whichever way the triangles turn."""
    vertices, faces = head_like()
    inner, count = 0.8 * vertices, len(vertices)
    plate = np.array([[-0.3, 0, 0], [0.3, 0, 0], [0, 0.3, 0]])
    everything = np.concatenate([faces, faces + count, [[2 * count, 2 * count + 1, 2 * count + 2]]])[:, ::winding]
    outer = outer_surface(np.concatenate([vertices, inner, plate]), everything, 2000, -9.0)
    assert len(outer.points) > 1990
    np.testing.assert_array_equal(outer.face_index, np.arange(len(faces)))
    assert TriangleTree(vertices, faces).nearest(outer.points)[0].max() < 1e-6
    assert (outer.vertices[outer.faces[outer.point_face]].mean(axis=1) - outer.points).max() < 0.1


def test_images_of_a_mesh_are_what_the_camera_sees(truth):
    """Positions project onto their own pixel centres and lie on the mesh; normals of a ball are radial, also of a ball
    that is wound inside out."""
    images = mesh_images(truth.vertices, truth.faces, truth.camera)
    row, column = np.nonzero(images.mask)
    assert 0.2 < images.mask.mean() < 0.8
    pixel = truth.camera.project(images.position[images.mask])
    np.testing.assert_allclose(pixel, np.stack([column, row], axis=1) + 0.5, atol=1e-3)
    assert TriangleTree(truth.vertices, truth.faces).nearest(images.position[images.mask])[0].max() < 1e-6
    ball = trimesh.creation.icosphere(subdivisions=5)
    for faces in (ball.faces, ball.faces[:, ::-1]):
        seen = mesh_images(ball.vertices, faces, truth.camera)
        position = seen.position[seen.mask]
        radial = position / np.linalg.norm(position, axis=1, keepdims=True)
        np.testing.assert_allclose(seen.normal[seen.mask], radial, atol=5e-3)


# Alignments


SHIFTED = Similarity(1.08, Rotation.from_euler("xyz", [12, -35, 8], degrees=True).as_matrix(), np.array([0.4, -2, 1]))


@pytest.mark.slow
def test_a_similar_head_is_no_error_in_any_frame_but_the_raw_camera(truth, surface):
    """The truth in another world, at another size and as much farther away: one photo shows the same. Only without the
    scale about the camera's centre it is a head at another distance."""
    to_camera = truth.camera.world_to_camera
    back = inverse(SHIFTED)
    pose = np.eye(4)
    pose[:3, :3] = to_camera[:3, :3] @ SHIFTED.rotation
    pose[:3, 3] = (to_camera[:3, :3] @ SHIFTED.shift + to_camera[:3, 3]) / SHIFTED.scale
    camera = dataclasses.replace(truth.camera, world_to_camera=pose)
    prediction = copy_of(truth, vertices=back(truth.vertices), landmarks=back(truth.landmarks), camera=camera)
    scores = score_geometry(prediction, truth, surface, QUICK)
    for name in ("h3ds", "landmarks", "camera"):
        assert scores[f"{name}_scale"] == pytest.approx(1.08, rel=1e-6)
        for region in REGIONS:
            assert scores[f"{name}_{region}_mean"] < 1e-3, (name, region)
    assert scores["camera_distance_error"] == pytest.approx(100 / 1.08 - 100)
    assert scores["pose_error"] < 0.01 and scores["camera_turn"] == pytest.approx(scores["h3ds_turn"], abs=0.01)
    assert scores["h3ds_turn"] == pytest.approx(scores["landmarks_turn"], abs=1e-3)
    assert scores["landmarks_rms"] < 1e-6 and scores["landmarks_used"] == 6
    assert scores["camera_raw_scale"] == 1 and scores["camera_raw_head_mean"] > 20
    assert scores["normals_mean"] < 0.1 and scores["normals_missing"] == 0 and scores["normals_pixels"] > 200
    assert scores["silhouette_iou"] == 1
    again = score_geometry(prediction, truth, None, QUICK)
    assert again == scores


@pytest.mark.slow
def test_a_mirrored_head_is_another_head(truth, surface):
    """The egg has no symmetry: no alignment brings its mirror image onto it."""
    mirror = np.array([-1, 1, 1])
    swapped = truth.landmarks * mirror
    swapped[[INNER_EYE_CORNERS, MOUTH_CORNERS]] = swapped[[INNER_EYE_CORNERS[::-1], MOUTH_CORNERS[::-1]]]
    mirrored = copy_of(truth, vertices=truth.vertices * mirror, faces=truth.faces[:, ::-1], landmarks=swapped)
    scores = score_geometry(mirrored, truth, surface, QUICK)
    assert scores["h3ds_face_mean"] > 0.2 and scores["camera_face_mean"] > 2 and scores["h3ds_head_mean"] > 3
    assert scores["silhouette_iou"] < 0.97 and scores["normals_mean"] > 3


@pytest.mark.slow
def test_an_ear_that_sticks_out_costs_there_alone(truth, surface):
    """2 mm of one ear: the points within 45 mm of the ears are off by some of that, those of the face by nothing. That
    the camera is turned by 3 degrees is an error of the pose."""
    away = np.linalg.norm(truth.vertices - EARS[1], axis=1)
    bump = 0.02 * np.clip(1 - away / 0.4, 0, 1)[:, None] * [1, 0, 0]
    nodded = truth.camera.world_to_camera.copy()
    nodded[:3, :3] = Rotation.from_euler("x", 3, degrees=True).as_matrix() @ nodded[:3, :3]
    camera = dataclasses.replace(truth.camera, world_to_camera=nodded)
    scores = score_geometry(copy_of(truth, vertices=truth.vertices + bump, camera=camera), truth, surface, QUICK)
    assert scores["pose_error"] == pytest.approx(3, abs=0.05)
    for direction in ("truth_to_prediction", "prediction_to_truth"):
        assert scores[f"landmarks_ears_{direction}_points"] > 100
        assert 0.1 < scores[f"landmarks_ears_{direction}_mean"] < 1
        assert scores[f"landmarks_face_{direction}_mean"] < 0.1 * scores[f"landmarks_ears_{direction}_mean"]


@pytest.mark.slow
def test_icp_mends_wrong_landmarks(truth, surface):
    """Landmarks that err by 3 mm place the head wrongly; ICP brings it back."""
    off = truth.landmarks + 0.03 * np.random.default_rng(5).standard_normal(truth.landmarks.shape)
    scores = score_geometry(copy_of(truth, landmarks=off), truth, surface, QUICK)
    assert scores["landmarks_face_mean"] > 0.8
    assert scores["h3ds_face_mean"] < 0.02 and scores["h3ds_scale"] == pytest.approx(1, abs=1e-3)
    assert scores["h3ds_head_mean"] < 0.05


def test_icp_finds_a_known_map_despite_outliers(truth):
    """From 5 degrees, 5% and 4 mm away, with a twentieth of the points up to 60 mm off the surface."""
    rng = np.random.default_rng(6)
    tree = TriangleTree(truth.vertices, truth.faces)
    _, points = even_samples(truth.vertices[truth.faces], 1500)
    goals = SHIFTED(points)
    goals[::20] += 0.3 * rng.standard_normal((75, 3))
    nudge = Similarity(1.05, Rotation.from_euler("xyz", [3, -3, 3], degrees=True).as_matrix(), np.full(3, 0.023))
    start = SHIFTED.after(nudge)
    assert np.median(distances_from(goals, tree, start)) > 0.02
    found = icp(goals, tree, start, Icp())
    assert found.scale == pytest.approx(SHIFTED.scale, rel=1e-4)
    np.testing.assert_allclose(found.rotation, SHIFTED.rotation, atol=1e-3)
    np.testing.assert_allclose(found.shift, SHIFTED.shift, atol=1e-3)


def test_fewer_landmarks_are_counted_and_too_few_refused(truth, surface):
    missing = truth.landmarks.copy()
    missing[[133, 94]] = np.nan
    assert score_geometry(copy_of(truth, landmarks=missing), truth, surface, QUICK)["landmarks_used"] == 4
    missing[362] = np.nan
    with pytest.raises(InputError, match="only 3 of the landmarks"):
        score_geometry(copy_of(truth, landmarks=missing), truth, surface, QUICK)


# Scores of heads


def ball_truth() -> Truth:
    ball = trimesh.creation.icosphere(subdivisions=5)
    return truth_of(np.array(ball.vertices), np.array(ball.faces), camera=turned_camera(0))


@pytest.mark.slow
def test_larger_ball_is_as_far_as_its_radius_says():
    """Balls of 100 and 105 mm about one centre are 5 mm apart everywhere, in both directions; after alignment they are
    the same."""
    truth = ball_truth()
    prediction = copy_of(truth, vertices=1.05 * truth.vertices, landmarks=1.05 * truth.landmarks)
    scores = score_geometry(prediction, truth, None, QUICK)
    for region in ("face", "head", "hidden"):
        for direction in ("truth_to_prediction", "prediction_to_truth"):
            for measure in ("mean", "median", "p90"):
                assert scores[f"camera_raw_{region}_{direction}_{measure}"] == pytest.approx(5, abs=0.03)
    assert scores["h3ds_head_mean"] < 0.02 and scores["h3ds_scale"] == pytest.approx(1 / 1.05, rel=1e-4)
    assert scores["camera_raw_head_truth_to_prediction_points"] > 3900


@pytest.mark.slow
def test_no_icp_hides_a_shift_in_the_camera_frame():
    """A ball that is 4 mm too far to the right is, over its whole surface, 2 mm away on average."""
    truth = ball_truth()
    offset = np.array([0.04, 0, 0])
    prediction = copy_of(truth, vertices=truth.vertices + offset, landmarks=truth.landmarks + offset)
    scores = score_geometry(prediction, truth, None, QUICK)
    for name in ("camera", "camera_raw"):
        assert scores[f"{name}_head_mean"] == pytest.approx(2, abs=0.05)
    assert scores["h3ds_head_mean"] < 0.02


def test_seen_and_hidden_parts_are_told_apart(truth, surface):
    """A head whose back, beyond what the photo shows, is 6 mm too large."""
    towards = truth.camera.centre / np.linalg.norm(truth.camera.centre)
    vertices, _ = head_like(lambda way: 1 + 0.06 * np.clip((-way @ towards - 0.2) / 0.2, 0, 1))
    scores = score_geometry(copy_of(truth, vertices=vertices), truth, surface, QUICK)
    assert scores["camera_raw_seen_mean"] < 0.05 and 3.5 < scores["camera_raw_hidden_mean"] < 7
    points = [scores[f"camera_raw_{r}_truth_to_prediction_points"] for r in ("head", "seen", "hidden")]
    assert points[0] == points[1] + points[2] and points[2] > points[1] > 0.3 * points[0]


def with_hair() -> Truth:
    """The head under a cap of hair 12 mm thick, which comes down into the sphere of the face."""
    vertices, faces = head_like()
    cap = faces[(vertices[faces][:, :, 1] > 0.25).all(axis=1)]
    region = np.r_[np.full(len(faces), SKIN), np.full(len(cap), HAIR)].astype(np.uint8)
    both = np.concatenate([vertices, 1.12 * vertices])
    return truth_of(both, np.concatenate([faces, cap + len(vertices)]), region, landmarks_on(vertices))


@pytest.mark.slow
def test_hair_counts_for_the_head_and_not_for_the_face():
    """A bald prediction, exact where there is skin. Its scalp still counts along the hair's rim, where true skin is
    nearer to it than hair."""
    truth = with_hair()
    vertices, faces = head_like()
    surface = true_surface(truth, QUICK)
    scores = score_geometry(copy_of(truth, vertices=vertices, faces=faces), truth, surface, QUICK)
    for name in ("h3ds", "camera"):
        assert scores[f"{name}_face_mean"] < 0.3
        assert scores[f"{name}_face_all_mean"] > 1 and scores[f"{name}_head_mean"] > 2
        assert scores[f"{name}_face_truth_to_prediction_p90"] < 0.1
    for direction, most in (("truth_to_prediction", 0.9), ("prediction_to_truth", 0.99)):
        face, everything = (scores[f"h3ds_{r}_{direction}_points"] for r in ("face", "face_all"))
        assert 0.5 * everything < face < most * everything
    under = surface.face_region[surface.outer.point_face] == SKIN
    assert surface.outer.points[under, 1].max() < 0.8  # no scalp but what shows under the hair's rim


@pytest.mark.slow
def test_a_bubble_inside_the_prediction_is_no_help(truth, surface):
    """A prediction that is 5 mm too large all over scores the same when it has the true surface inside itself."""
    large = 1.05 * truth.vertices
    plain = copy_of(truth, vertices=large)
    faces = np.concatenate([truth.faces, truth.faces + len(large)])
    filled = copy_of(truth, vertices=np.concatenate([large, truth.vertices]), faces=faces)
    first, second = (score_geometry(p, truth, surface, QUICK) for p in (plain, filled))
    assert first["camera_raw_face_mean"] > 4
    assert second["camera_raw_face_mean"] == pytest.approx(first["camera_raw_face_mean"], abs=0.02)


def test_angle_between_normals_is_measured_in_camera_coordinates(truth, surface):
    """Normals turned by 10 degrees, of any length, in a world that is turned against the truth's; what is missing or
    not finite is counted."""
    axis = np.cross(truth.normal, [0.3, 0.9, 0.1])
    axis /= np.maximum(np.linalg.norm(axis, axis=2, keepdims=True), 1e-9)
    angle = np.radians(10)
    turned = np.cos(angle) * truth.normal + np.sin(angle) * np.cross(axis, truth.normal)
    pose = truth.camera.world_to_camera.copy()
    pose[:3, :3] = pose[:3, :3] @ SHIFTED.rotation
    camera = dataclasses.replace(truth.camera, world_to_camera=pose)
    scores = score_normals(3 * turned @ SHIFTED.rotation, truth.mask, camera, truth, surface)
    assert [scores[f"normals_{k}"] for k in ("mean", "median", "p90")] == pytest.approx([10] * 3, abs=1e-3)
    assert scores["normals_missing"] == 0
    row, column = np.argwhere((truth.mask > 0) & (np.abs(surface.images.position - surface.nose).max(axis=2) < 0.3))[0]
    turned[row, column], mask = np.nan, truth.mask.copy()
    mask[row, column + 1] = 0
    holes = score_normals(turned @ SHIFTED.rotation, mask, camera, truth, surface)
    assert holes["normals_missing"] == 2 and holes["normals_pixels"] == scores["normals_pixels"] - 2
    assert holes["normals_mean"] == pytest.approx(10, abs=1e-3)


def test_silhouettes_overlap_by_their_pixels():
    first, second = np.zeros((10, 10)), np.zeros((10, 10))
    first[:, :6], second[:, 3:] = 0.7, 0.9
    assert silhouette_iou(first, second) == pytest.approx(0.3)
    assert silhouette_iou(first, first) == 1 and np.isnan(silhouette_iou(0 * first, 0 * first))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"vertices": np.full((2562, 3), np.nan)}, "vertices contains NaN"),
        ({"vertices": np.zeros((2562, 2))}, r"vertices must be numbers \[any, 3\]"),
        ({"faces": np.array([[0, 1, 9999]])}, "do not exist"),
        ({"faces": np.zeros((0, 3), int)}, "at least one row"),
        ({"landmarks": np.zeros((68, 3))}, r"landmarks must be numbers \[468, 3\]"),
        ({"camera": dataclasses.replace(turned_camera(), width=32)}, "32x64"),
        ({"mask": np.zeros((5, 5))}, "mask must be numbers"),
        ({"normal": np.zeros((SIZE, SIZE))}, "normal must be numbers"),
    ],
)
def test_a_prediction_that_cannot_be_measured_is_refused(truth, surface, changes, message):
    with pytest.raises(InputError, match=message):
        score_geometry(copy_of(truth, **changes), truth, surface, QUICK)
