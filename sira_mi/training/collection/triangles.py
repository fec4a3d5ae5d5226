"""Triangle meshes: areas, normals, edges, connected pieces, random points, and the points closest to others."""

from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

CANDIDATES = 6  # triangles that `find_nearest` tries for each point


def triangle_areas(corners: np.ndarray) -> np.ndarray:
    """Areas [T] of triangles [T, 3, 3]."""
    return 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)


def face_normals(corners: np.ndarray) -> np.ndarray:
    """Unit normals [T, 3] of triangles [T, 3, 3]."""
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return cross / np.maximum(np.linalg.norm(cross, axis=1, keepdims=True), 1e-12)


def vertex_normals(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Area-weighted unit vertex normals [N, 3]."""
    corners = vertices[triangles]
    face = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    incidence = sparse.csr_matrix(
        (np.ones(triangles.size), (triangles.ravel(), np.repeat(np.arange(len(triangles)), 3))),
        (len(vertices), len(triangles)),
    )
    normals = incidence @ face
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)


def vertex_areas(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """A third of the adjacent triangles' area for every vertex [N]."""
    area = triangle_areas(vertices[triangles])
    return np.bincount(triangles.ravel(), np.repeat(area / 3, 3), len(vertices))


def draw_barycentric(random: np.random.Generator, count: int) -> np.ndarray:
    """Barycentric weights [count, 3] of points that are uniform on a triangle."""
    a, b = random.random((2, count))
    a, b = np.where(a + b > 1, 1 - a, a), np.where(a + b > 1, 1 - b, b)
    return np.stack([1 - a - b, a, b], axis=1)


def undirected_edges(triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The different edges [E, 2] of triangles [T, 3], the number of uses of each [E], and each triangle's edges 01, 12
    and 20 among them [T, 3]."""
    ends = np.sort(np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=-1).reshape(-1, 2), axis=1)
    key, edge, uses = np.unique((ends[:, 0] << 32) + ends[:, 1], return_inverse=True, return_counts=True)
    return np.stack([key >> 32, key & 0xFFFFFFFF], axis=1), uses, edge.reshape(-1, 3)


def connected_pieces(edges: np.ndarray, count: int) -> np.ndarray:
    """Number [count] of the connected piece that each of `count` vertices belongs to by edges [E, 2]."""
    graph = sparse.csr_matrix((np.ones(len(edges), bool), (edges[:, 0], edges[:, 1])), (count, count))
    return connected_components(graph, directed=False)[1]


@dataclass(frozen=True)
class Places:
    """Points on a triangle mesh."""

    triangles: np.ndarray  # [N] triangle indices
    weights: np.ndarray  # [N, 3] barycentric

    def matrix(self, triangles: np.ndarray, count: int) -> sparse.csr_matrix:
        """The matrix [N, count] that evaluates vertex values of the mesh `triangles` [T, 3] at the points."""
        rows = np.repeat(np.arange(len(self.triangles)), 3)
        columns = triangles[self.triangles].ravel()
        return sparse.csr_matrix((self.weights.ravel(), (rows, columns)), (len(self.triangles), count))


def closest_on_triangles(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Barycentric weights [..., 3] of the points of triangles [..., 3, 3] closest to points [..., 3]: the plane's foot
    point if it lies inside, else the best of the three edges."""
    a, b, c = corners[..., 0, :], corners[..., 1, :], corners[..., 2, :]
    u, v, w = b - a, c - a, points - a
    uu, uv, vv = dot(u, u), dot(u, v), dot(v, v)
    wu, wv = dot(w, u), dot(w, v)
    area = np.maximum(uu * vv - uv * uv, 1e-24)
    s, t = (vv * wu - uv * wv) / area, (uu * wv - uv * wu) / area
    best = np.stack([1 - s - t, s, t], axis=-1)
    inside = (best >= 0).all(-1)
    distance = np.where(inside, 0.0, np.inf)
    for k in range(3):
        start, end = corners[..., k, :], corners[..., (k + 1) % 3, :]
        edge = end - start
        along = np.clip(dot(points - start, edge) / np.maximum(dot(edge, edge), 1e-24), 0, 1)
        gap = dot(points - start - along[..., None] * edge, points - start - along[..., None] * edge)
        nearer = ~inside & (gap < distance)
        weights = np.zeros_like(best)
        weights[..., k], weights[..., (k + 1) % 3] = 1 - along, along
        best = np.where(nearer[..., None], weights, best)
        distance = np.where(nearer, gap, distance)
    return best


def find_nearest(
    points: np.ndarray,
    normals: np.ndarray | None,
    vertices: np.ndarray,
    triangles: np.ndarray,
    normal_weight: float = 0.0,
    candidates: int = CANDIDATES,
) -> tuple[Places, np.ndarray, np.ndarray]:
    """The nearest points of a mesh to points [N, 3] with unit normals [N, 3]: their places, positions [N, 3], and the
    cosines [N] between the normals of point and triangle (1 without normals). `candidates` triangles are tried for
    each point, those with the nearest centroids in positions and `normal_weight`-scaled normals."""
    corners = vertices[triangles]
    centres, faces = corners.mean(1), face_normals(corners)
    if normals is None:
        tree, query = cKDTree(centres), points
    else:
        tree = cKDTree(np.hstack([centres, normal_weight * faces]))
        query = np.hstack([points, normal_weight * normals])
    _, index = tree.query(query, k=min(candidates, len(triangles)))
    index = index.reshape(len(points), -1)
    weights = closest_on_triangles(points[:, None], corners[index])
    found = np.einsum("nck,nckd->ncd", weights, corners[index])
    gap = ((found - points[:, None]) ** 2).sum(-1)
    if normals is not None:
        gap = gap + normal_weight**2 * ((faces[index] - normals[:, None]) ** 2).sum(-1)
    pick = np.arange(len(points)), gap.argmin(1)
    chosen = index[pick]
    cosine = np.ones(len(points)) if normals is None else dot(normals, faces[chosen])
    return Places(chosen, weights[pick]), found[pick], cosine


def dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Dot products [...] of vectors [..., 3]."""
    return (a * b).sum(-1)
