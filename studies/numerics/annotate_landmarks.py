"""Finds where the 468 face landmarks lie on the MakeHuman topology; writes `landmark_barycentrics.npz`.

    python -m studies.numerics.annotate_landmarks

Bald synthetic heads are marked by the portrait landmark network from the front and slightly aside. A landmark's place
is the median over all pictures of its marks' rest-pose position, made symmetric and moved to the nearest surface point.
The median distance of its marks from there, in mm, is stored and printed.
"""

import argparse
from pathlib import Path

import mitsuba as mi
import numpy as np
from scipy.optimize import linear_sum_assignment
from tqdm import tqdm

from sira_mi.conventions import LANDMARKS, MILLIMETRES_PER_UNIT
from sira_mi.errors import InputError, run_command
from sira_mi.training.collection.annotation import AnnotationSettings, find_consensus, mark_views
from sira_mi.training.collection.landmarks import BARYCENTRICS
from sira_mi.training.collection.person import make_person
from sira_mi.training.collection.skin import rest_surface
from sira_mi.training.collection.surface import head_topology
from sira_mi.training.collection.triangles import find_nearest

SETTINGS = AnnotationSettings(size=512, grid=2, expected_cosine=-1, search=True)
FEWEST_MARKS = 5


def mark_head(seed: int) -> np.ndarray:
    """Rest-pose positions [V, 468, 3] of the marks on one head, NaN where a mark does not meet the skin squarely; V is
    the number of views in which a face is found."""
    marks = mark_views(make_person(seed, None).parts, SETTINGS)
    head = np.isfinite(marks.points[..., 0]) & (marks.part == 0)
    corner = head_topology()[0][np.where(head, marks.triangle, 0)]
    rest = np.einsum("vnk,vnkd->vnd", marks.weights, rest_surface()[corner])
    return np.where(head[..., None], rest, np.nan)


def symmetrise(positions: np.ndarray) -> np.ndarray:
    """Positions [N, 3] averaged with their mirror partners in x, as the rest pose is symmetric; partners are the
    assignment of mirrored to unmirrored positions with the least total distance."""
    mirrored = positions * [-1, 1, 1]
    _, partner = linear_sum_assignment(np.linalg.norm(mirrored[:, None] - positions, axis=2))
    mutual = partner[partner] == np.arange(len(positions))
    return np.where(mutual[:, None], (positions + mirrored[partner]) / 2, positions)


def attach(positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertex indices [N, 3] and barycentric weights [N, 3] of the rest surface's points nearest to positions [N, 3]."""
    triangles = head_topology()[0]
    places, _, _ = find_nearest(positions, None, rest_surface(), triangles, candidates=24)
    return triangles[places.triangles], places.weights


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="studies.numerics.annotate_landmarks",
        description="Finds where the 468 face landmarks lie on the MakeHuman topology.",
    )
    parser.add_argument("--out", type=Path, default=BARYCENTRICS, help=".npz file to write (default: the package's)")
    parser.add_argument("--heads", type=int, default=16)
    arguments = parser.parse_args()
    mi.set_variant("llvm_ad_rgb")
    marks = [m for seed in tqdm(range(arguments.heads), unit="head") for m in mark_head(900_000 + seed)]
    if len(marks) < FEWEST_MARKS:
        raise InputError(f"only {len(marks)} faces were found on the pictures")
    middle, number, spread = find_consensus(np.array(marks))
    valid = number >= FEWEST_MARKS
    if len(middle) != LANDMARKS or not valid.any():
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
    print(f"{len(marks)} pictures, {valid.sum()} landmarks; distance of the marks from their median position:")
    print(f"median {np.median(millimetres):.2f} mm, 95% under {np.percentile(millimetres, 95):.2f} mm")
    print(f"moved onto the surface by up to {gap.max() * MILLIMETRES_PER_UNIT:.2f} mm")


if __name__ == "__main__":
    run_command(main)
