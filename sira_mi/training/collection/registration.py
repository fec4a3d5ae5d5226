"""Non-rigid registration of a control mesh to a triangle mesh, by the control mesh's refined surface.

The unknowns are the control vertices; every residual is a row on them: refined vertices to the nearest compatible
target points, target points to the nearest refined surface points, and given pairs. The displacement from the template
is kept smooth by the biharmonic energy (stiffness as a length, lowered level by level; after Amberg et al. 2007, with
the local affine term replaced by the discrete Laplacian of Pinkall and Polthier 1993). All correspondences come from
a k-d tree over positions and scaled normals, then the exact closest point of the candidate triangles.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import SuperLU, splu

from sira_mi.training.collection.triangles import dot, find_nearest, undirected_edges, vertex_areas, vertex_normals

# Cosine between normals under which a pair is dropped, and from which it counts fully.
COMPATIBLE = (0.3, 0.75)
LARGEST_COTANGENT = 8.0  # keeps slivers from stiffening the mesh


@dataclass(frozen=True)
class Level:
    """One stiffness of a registration."""

    stiffness: float  # scene units: the length below which displacements are smoothed
    reach: float  # scene units: pairs further apart than this are dropped
    normal_weight: float  # scene units that a unit difference of normals counts in the search
    pair_weight: float  # factor on the weights of the given pairs
    iterations: int


@dataclass(frozen=True)
class Rows:
    """Weighted linear residuals on the control vertices: matrix @ control − goals."""

    matrix: sparse.csr_matrix  # [R, n]
    goals: np.ndarray  # [R, 3] scene units
    source: sparse.csr_matrix  # [R, V] how the goals move with the target's vertices
    weights: np.ndarray  # [R] square scene units, the area a row stands for

    def weigh(self, factor: float) -> "Rows":
        """The rows with their weights multiplied by a factor."""
        return replace(self, weights=factor * self.weights)


def stack(rows: list[Rows]) -> Rows:
    """All rows one after another."""
    return Rows(
        sparse.vstack([r.matrix for r in rows]).tocsr(),
        np.concatenate([r.goals for r in rows]),
        sparse.vstack([r.source for r in rows]).tocsr(),
        np.concatenate([r.weights for r in rows]),
    )


def biharmonic(vertices: np.ndarray, quads: np.ndarray) -> sparse.csc_matrix:
    """The matrix [n, n] of the squared Laplacian integrated over a quad mesh: cotangent weights, averaged over both
    ways of splitting each quad, and lumped areas."""
    first = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]], quads[:, [0, 1, 3]], quads[:, [1, 2, 3]]])
    corners, n = vertices[first], len(vertices)
    twice_area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    twice_area = np.maximum(twice_area, 1e-8)
    laplacian = sparse.csr_matrix((n, n))
    for k in range(3):
        i, j = first[:, (k + 1) % 3], first[:, (k + 2) % 3]
        cotangent = dot(corners[:, (k + 1) % 3] - corners[:, k], corners[:, (k + 2) % 3] - corners[:, k]) / twice_area
        half = 0.25 * np.clip(cotangent, -LARGEST_COTANGENT, LARGEST_COTANGENT)
        laplacian = laplacian + sparse.csr_matrix(
            (
                np.concatenate([half, half, -half, -half]),
                (np.concatenate([i, j, i, j]), np.concatenate([i, j, j, i])),
            ),
            (n, n),
        )
    area = np.bincount(first.ravel(), np.repeat(twice_area / 12, 3), n)
    return (laplacian.T @ sparse.diags(1 / np.maximum(area, np.median(area) / 20)) @ laplacian).tocsc()


@dataclass(frozen=True)
class Solver:
    """The linear step: control displacements that balance rows against smoothness."""

    factor: SuperLU  # LU of the normal matrix
    rows: Rows

    def displacement(self, residuals: np.ndarray) -> np.ndarray:
        """Control displacements [n, D] for residuals [R, D] (goal minus template) of the rows."""
        return self.factor.solve(self.rows.matrix.T @ (self.rows.weights[:, None] * residuals))

    def response(self, motion: np.ndarray) -> np.ndarray:
        """Control displacements [n, D] for a motion [V, D] of the target's vertices."""
        return self.displacement(self.rows.source @ motion)


def linear_step(rows: Rows, smooth: sparse.csc_matrix, stiffness: float) -> Solver:
    """Factorises the normal equations of rows and the biharmonic energy times stiffness⁴."""
    normal = rows.matrix.T @ sparse.diags(rows.weights) @ rows.matrix + stiffness**4 * smooth
    return Solver(splu(normal.tocsc()), rows)


@dataclass(frozen=True)
class Problem:
    """A control mesh, the target and the known correspondences."""

    template: np.ndarray  # [n, 3] control vertices, roughly aligned
    refine: sparse.csr_matrix  # [M, n] control vertices to vertices of the refined surface
    quads: np.ndarray  # [F, 4] control vertex indices
    triangles: np.ndarray  # [T, 3] refined vertex indices
    region: np.ndarray  # [M] share of each refined vertex in the registration, 0 to 1
    target: np.ndarray  # [V, 3] scene units
    target_triangles: np.ndarray  # [S, 3]
    pairs: Rows  # marks and curves that are known to belong together, weighed by `Level.pair_weight`
    anchors: Rows  # points that stay, with the same weight at every level


def register(problem: Problem, levels: Sequence[Level]) -> tuple[np.ndarray, Solver]:
    """Control vertices [n, 3] registered by alternating correspondences and linear steps through the levels, and the
    last step's solver."""
    p = problem
    smooth = biharmonic(p.template, p.quads)
    normals = vertex_normals(p.target, p.target_triangles)
    ends, uses, _ = undirected_edges(p.target_triangles)
    border = np.unique(ends[uses == 1])
    inner = np.setdiff1d(np.unique(p.target_triangles), border)
    pick_inner = sparse.identity(len(p.target), format="csr")[inner]
    at_border = np.asarray(np.isin(p.target_triangles, border).any(1))
    active = np.flatnonzero(p.region > 0)
    area = (vertex_areas(p.refine @ p.template, p.triangles) * p.region)[active]
    target_area = vertex_areas(p.target, p.target_triangles)[inner]
    control = p.template
    for level in levels:
        for _ in range(level.iterations):
            surface = p.refine @ control
            points, facing = surface[active], vertex_normals(surface, p.triangles)[active]
            places, goals, cosine = find_nearest(points, facing, p.target, p.target_triangles, level.normal_weight)
            weights = area * _weigh_agreement(cosine, points - goals, level) * ~at_border[places.triangles]
            data = Rows(p.refine[active], goals, places.matrix(p.target_triangles, len(p.target)), weights)
            feet, found, cosine = find_nearest(
                p.target[inner], normals[inner], surface, p.triangles, level.normal_weight
            )
            matrix = feet.matrix(p.triangles, len(surface))
            weights = target_area * (matrix @ p.region) * _weigh_agreement(cosine, p.target[inner] - found, level)
            back = Rows((matrix @ p.refine).tocsr(), p.target[inner], pick_inner, weights)
            rows = stack([data, back, p.pairs.weigh(level.pair_weight), p.anchors])
            solver = linear_step(rows, smooth, level.stiffness)
            control = p.template + solver.displacement(rows.goals - rows.matrix @ p.template)
    return control, solver


def _weigh_agreement(cosine, gap, level):
    low, high = COMPATIBLE
    near = np.linalg.norm(gap, axis=1) < level.reach
    return np.clip((cosine - low) / (high - low), 0, 1) * near


def match_rings(source: np.ndarray, target: np.ndarray, along: np.ndarray) -> sparse.csr_matrix:
    """The matrix [N, K] that gives each point of a closed curve [N, 3] its partner on another [K, 3], which runs the
    same way round: both are split at their extremes in the direction `along` [3], and each half is matched by its share
    of arc length."""
    rows, columns, values = [], [], []
    ends = [(int((c @ along).argmin()), int((c @ along).argmax())) for c in (source, target)]
    for first in (0, 1):
        (index, share), (curve, position) = (
            _half(c, e[first], e[1 - first]) for c, e in zip((source, target), ends, strict=True)
        )
        index, share = index[:-1], share[:-1]
        after = np.clip(np.searchsorted(position, share, side="right"), 1, len(position) - 1)
        part = (share - position[after - 1]) / np.maximum(position[after] - position[after - 1], 1e-12)
        rows += [index, index]
        columns += [curve[after - 1], curve[after]]
        values += [1 - part, part]
    shape = (len(source), len(target))
    return sparse.csr_matrix((np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))), shape)


def _half(curve, start, end):
    """Indices from start to end round a closed curve, and their share of the way."""
    index = (start + np.arange((end - start) % len(curve) + 1)) % len(curve)
    length = np.concatenate([[0], np.linalg.norm(np.diff(curve[index], axis=0), axis=1).cumsum()])
    return index, length / length[-1]


def fit_sphere(points: np.ndarray) -> tuple[np.ndarray, float]:
    """Centre [3] and radius of the least-squares sphere of points [N, 3]."""
    solution = np.linalg.lstsq(np.column_stack([2 * points, np.ones(len(points))]), (points**2).sum(1), rcond=None)[0]
    return solution[:3], float(np.sqrt(solution[3] + solution[:3] @ solution[:3]))
