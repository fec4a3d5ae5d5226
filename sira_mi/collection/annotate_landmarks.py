"""Finds where the 468 face landmarks lie on the MakeHuman topology; writes `data/landmark_barycentrics.npz`.

    python -m sira_mi.collection.annotate_landmarks --out sira_mi/collection/data/landmark_barycentrics.npz

Bald synthetic heads are rendered from the front and slightly aside, the portrait landmark network marks each render,
and every mark is traced back onto the head. A landmark's place is the median over all renders of its rest-pose
position, made symmetric and moved to the nearest surface point. The median distance of its
marks from there, in mm, is stored and printed.
"""

import argparse
from pathlib import Path

import mitsuba as mi
import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree
from tqdm import tqdm

from sira_mi.collection.landmarks import COUNT
from sira_mi.collection.lighting import lobe_map
from sira_mi.collection.person import make_person
from sira_mi.collection.render import (
    RenderSettings,
    build_scene,
    exposure,
    intrinsic_matrix,
    look_at,
    render_views,
)
from sira_mi.collection.sheet import encode_srgb
from sira_mi.collection.skin import rest_surface
from sira_mi.collection.surface import head_topology, vertex_normals
from sira_mi.conventions import MILLIMETRES_PER_UNIT
from sira_mi.errors import InputError, run_command
from sira_mi.portrait.face import find_faces

SIZE = 512  # pixels
YAWS = (-14.0, 0.0, 14.0)  # degrees
FIELD_OF_VIEW = 14.0  # degrees
DISTANCE = 14.0  # scene units
SMALLEST_COSINE = 0.25  # between surface normal and view, below which a mark is not used
FEWEST_MARKS = 5
LIGHT = np.array([[0, 1, 0, 0.3, 0.6, 0.6, 0.6], [0.2, 0.4, 0.9, 8, 0.9, 0.9, 0.9]])


def marks_on_head(seed: int) -> list[np.ndarray]:
    """For each view of one head in which a face is found: rest-pose positions [468, 3] of its landmarks, NaN where a
    mark does not meet the surface squarely."""
    person = make_person(seed, None)
    settings = RenderSettings(size=SIZE, samples=24)
    scene = build_scene(person.parts, lobe_map(LIGHT), settings)
    target = np.array([0.0, 0.1, 0.4])
    poses = []
    for yaw in np.radians(YAWS):
        poses.append(look_at(target + DISTANCE * np.array([np.sin(yaw), 0.0, np.cos(yaw)]), target))
    intrinsics = np.array([intrinsic_matrix(FIELD_OF_VIEW, SIZE)] * len(poses))
    images, coverage = render_views(scene, intrinsics, np.array(poses), settings, seed)
    found = []
    for image, cover, intrinsic, pose in zip(images, coverage, intrinsics, poses, strict=True):
        shown = encode_srgb(image * exposure(image, cover, 0.3) + 0.4 * (1 - cover[..., None]))
        faces = find_faces(shown)
        if faces:
            found.append(_trace(scene, person, faces[0].landmarks, intrinsic, pose))
    return found


def _trace(scene, person, pixels, intrinsic, pose):
    inverse = np.linalg.inv(pose)
    local = np.column_stack([pixels, np.ones(len(pixels))]) @ np.linalg.inv(intrinsic).T
    way = local @ inverse[:3, :3].T
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    origin = mi.Point3f(*inverse[:3, 3].tolist())
    hit = scene.ray_intersect_preliminary(mi.Ray3f(origin, mi.Vector3f(way.T.astype(np.float32))))
    distance = np.array(hit.t)
    distance[~np.array(hit.is_valid())] = np.nan
    points = inverse[:3, 3] + distance[:, None] * way
    normals = vertex_normals(person.head, head_topology()[0])
    good = np.isfinite(distance)
    _, near = cKDTree(person.head).query(np.where(good[:, None], points, 0), k=6)
    weights = 1 / (np.linalg.norm(person.head[near] - points[:, None], axis=2) + 1e-4)
    weights /= weights.sum(1, keepdims=True)
    rest = np.einsum("nk,nkd->nd", weights, rest_surface()[near])
    facing = -(normals[near[:, 0]] * way).sum(1) > SMALLEST_COSINE
    rest[~(good & facing)] = np.nan
    return rest


def consensus(marks: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Median [468, 3], number of marks [468] and median distance from the median [468] of marks [R, 468, 3] with NaN
    gaps, in decimetres."""
    number = np.isfinite(marks[..., 0]).sum(0)
    middle = np.nanmedian(marks, axis=0)
    spread = np.nanmedian(np.linalg.norm(marks - middle, axis=-1), axis=0)
    return middle, number, spread


def symmetrise(positions: np.ndarray) -> np.ndarray:
    """Positions [N, 3] averaged with their mirror partners in x, as the rest pose is symmetric; partners are the
    assignment of mirrored to unmirrored positions with the least total distance."""
    mirrored = positions * [-1, 1, 1]
    _, partner = linear_sum_assignment(np.linalg.norm(mirrored[:, None] - positions, axis=2))
    mutual = partner[partner] == np.arange(len(positions))
    return np.where(mutual[:, None], (positions + mirrored[partner]) / 2, positions)


def attach(positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertex indices [N, 3] and barycentric weights [N, 3] of the rest surface's points nearest to positions [N, 3]."""
    rest, triangles = rest_surface(), head_topology()[0]
    corners = rest[triangles]
    _, near = cKDTree(corners.mean(1)).query(positions, k=24)
    best, weights = np.full(len(positions), np.inf), np.zeros((len(positions), 3))
    chosen = np.zeros(len(positions), int)
    for column in near.T:
        bary = _closest_weights(positions, corners[column])
        gap = np.linalg.norm(np.einsum("nk,nkd->nd", bary, corners[column]) - positions, axis=1)
        better = gap < best
        best[better], weights[better], chosen[better] = gap[better], bary[better], column[better]
    return triangles[chosen], weights


def _closest_weights(points, corners):
    """Barycentric weights of the plane projections, clipped into the triangle."""
    a, u, v = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    w = points - a
    uu, uv, vv = (u * u).sum(1), (u * v).sum(1), (v * v).sum(1)
    determinant = np.maximum(uu * vv - uv * uv, 1e-18)
    s = (vv * (w * u).sum(1) - uv * (w * v).sum(1)) / determinant
    t = (uu * (w * v).sum(1) - uv * (w * u).sum(1)) / determinant
    weights = np.clip(np.stack([1 - s - t, s, t], 1), 0, 1)
    return weights / weights.sum(1, keepdims=True)


def main() -> None:
    parser = argparse.ArgumentParser(prog="sira_mi.collection.annotate_landmarks", description=__doc__.split("\n")[0])
    parser.add_argument("--out", type=Path, required=True, help=".npz file to write")
    parser.add_argument("--heads", type=int, default=16)
    arguments = parser.parse_args()
    mi.set_variant("llvm_ad_rgb")
    marks = [m for seed in tqdm(range(arguments.heads), unit="head") for m in marks_on_head(900_000 + seed)]
    if len(marks) < FEWEST_MARKS:
        raise InputError(f"only {len(marks)} faces were found on the renders")
    middle, number, spread = consensus(np.array(marks))
    valid = number >= FEWEST_MARKS
    if len(middle) != COUNT or not valid.any():
        raise InputError("the landmark network returned no usable marks")
    middle[valid] = symmetrise(middle[valid])
    vertices, weights = attach(np.where(valid[:, None], middle, 0))
    rest = np.einsum("nk,nkd->nd", weights, rest_surface()[vertices])
    gap = np.linalg.norm(rest - middle, axis=1)[valid]
    np.savez_compressed(
        arguments.out,
        vertices=vertices.astype(np.uint16),
        weights=weights.astype(np.float32),
        valid=valid,
        spread_mm=(spread * MILLIMETRES_PER_UNIT).astype(np.float32),
    )
    millimetres = spread[valid] * MILLIMETRES_PER_UNIT
    print(f"{len(marks)} renders, {valid.sum()} landmarks; distance of the marks from their median position:")
    print(f"median {np.median(millimetres):.2f} mm, 95% under {np.percentile(millimetres, 95):.2f} mm")
    print(f"moved onto the surface by up to {gap.max() * MILLIMETRES_PER_UNIT:.2f} mm")


if __name__ == "__main__":
    run_command(main)
