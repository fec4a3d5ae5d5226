"""Exact distances from points to triangle meshes, and a slow reference.

The triangles, in Morton order, are the leaves of a complete binary tree of bounding boxes, which every point walks
depth first and without a stack. It starts with an upper bound, the distance to the triangle with the nearest centroid,
and passes over every box that lies farther away, so that the result is that of all triangles. The walk is compiled by
Dr.Jit, in double precision; a Mitsuba variant must be set.
"""

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.spatial import cKDTree

from sira_mi.training.collection.triangles import closest_on_triangles

_MORTON_BITS = 16
_FLAT = 1e-12  # of twice a triangle's area over its longest edge squared: thinner ones are left out


class TriangleTree:
    """The triangles of a mesh, vertices [N, 3] and faces [T, 3], for searches of closest points; `normals` [T, 3] are
    theirs.

    Triangles without area are left out. Raises ValueError when none is left."""

    def __init__(self, vertices: np.ndarray, faces: np.ndarray):
        vertices, faces = np.asarray(vertices, np.float64), np.asarray(faces, np.int64)
        self.normals = face_normals(vertices, faces)
        corners = vertices[faces]
        edges = corners - np.roll(corners, 1, axis=1)
        twice_area = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
        solid = np.flatnonzero(twice_area > _FLAT * (edges * edges).sum(axis=2).max(axis=1, initial=0))
        if not len(solid):
            raise ValueError("the mesh has no triangle with an area")
        centroids = corners[solid].mean(axis=1)
        order = np.argsort(_morton(centroids), kind="stable")
        self._face = solid[order]
        self._corners = corners[self._face]
        self._centroids = cKDTree(centroids[order])
        self._boxes, self._leaves = _boxes(self._corners)

    def nearest(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Distances [P], closest points [P, 3] and face indices [P] for points [P, 3]."""
        points = np.asarray(points, np.float64)
        if not len(points):
            return np.zeros(0), np.zeros((0, 3)), np.zeros(0, np.int64)
        order = np.argsort(_morton(points), kind="stable")
        _, start = self._centroids.query(points[order])
        best = np.zeros(len(points), np.int64)
        lower, upper, corners = (mi.Float64(a.ravel()) for a in (*self._boxes, self._corners))
        best[order] = _walk(
            mi.Vector3d(np.ascontiguousarray(points[order].T)),
            mi.UInt32(start.astype(np.uint32)),
            lower,
            upper,
            corners,
            dr.opaque(mi.UInt32, self._leaves),
        ).numpy()
        nearest = self._corners[best]
        found = np.einsum("nk,nkd->nd", closest_on_triangles(points, nearest), nearest)
        return np.linalg.norm(found - points, axis=1), found, self._face[best]


def nearest_reference(
    points: np.ndarray, vertices: np.ndarray, faces: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The result of `TriangleTree.nearest`, by trying every triangle for every point."""
    corners = np.asarray(vertices, np.float64)[np.asarray(faces, np.int64)]
    distances, closest, indices = [], [], []
    for point in np.asarray(points, np.float64):
        found = np.einsum("tk,tkd->td", closest_on_triangles(point[None], corners), corners)
        distance = np.linalg.norm(found - point, axis=1)
        distances.append(distance.min())
        closest.append(found[distance.argmin()])
        indices.append(distance.argmin())
    return np.array(distances), np.array(closest), np.array(indices)


def face_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Unit normals [T, 3] by the winding; 0 for triangles without area."""
    corners = vertices[faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return cross / np.maximum(np.linalg.norm(cross, axis=1, keepdims=True), 1e-30)


@dr.syntax
def _walk(point, best, lower, upper, corners, leaves):
    """Nearest triangles [P] of points [3, P], from triangles `best` on. Node k has the children 2k and 2k + 1."""
    bound = _squared_distance(point, corners, best)
    node = dr.full(mi.UInt32, 1, dr.width(point))
    while node > 0:
        gap = dr.maximum(dr.gather(mi.Vector3d, lower, node) - point, point - dr.gather(mi.Vector3d, upper, node))
        near = dr.squared_norm(dr.maximum(gap, 0)) < bound
        leaf = node >= leaves
        if near & leaf:
            distance = _squared_distance(point, corners, node - leaves)
            closer = distance < bound
            best = dr.select(closer, node - leaves, best)
            bound = dr.minimum(bound, distance)
        # The next node that is not below this one: up while it is a right child, then to the sibling.
        after = (node + 1) >> dr.tzcnt(node + 1)
        node = dr.select(near & ~leaf, 2 * node, dr.select(after == 1, 0, after))
    return best


def _squared_distance(point, corners, triangle):
    """Of points [3, P] to triangles [P]: to the plane if the foot lies inside, else to the nearest of the edges."""
    a, b, c = (dr.gather(mi.Vector3d, corners, 3 * triangle + k) for k in range(3))
    u, v, w = b - a, c - a, point - a
    uu, uv, vv, wu, wv = dr.dot(u, u), dr.dot(u, v), dr.dot(v, v), dr.dot(w, u), dr.dot(w, v)
    scale = 1 / dr.maximum(uu * vv - uv * uv, 1e-30)
    s, t = (vv * wu - uv * wv) * scale, (uu * wv - uv * wu) * scale
    edge = _squared_to_edge(w, u)
    edge = dr.minimum(edge, _squared_to_edge(w, v))
    edge = dr.minimum(edge, _squared_to_edge(point - b, c - b))
    return dr.select((s >= 0) & (t >= 0) & (s + t <= 1), dr.squared_norm(w - s * u - t * v), edge)


def _squared_to_edge(w, edge):
    along = dr.clip(dr.dot(w, edge) / dr.maximum(dr.squared_norm(edge), 1e-30), 0, 1)
    return dr.squared_norm(w - along * edge)


def _boxes(corners):
    """Lower and upper corners [2L, 3] of the boxes of a tree's nodes, node 0 unused and empty ones inside out, and the
    number L of its leaves, which come last."""
    leaves = 1 << (len(corners) - 1).bit_length()
    lower, upper = np.full((2 * leaves, 3), np.inf), np.full((2 * leaves, 3), -np.inf)
    lower[leaves : leaves + len(corners)] = corners.min(axis=1)
    upper[leaves : leaves + len(corners)] = corners.max(axis=1)
    first = leaves // 2
    while first:
        lower[first : 2 * first] = lower[2 * first : 4 * first].reshape(-1, 2, 3).min(axis=1)
        upper[first : 2 * first] = upper[2 * first : 4 * first].reshape(-1, 2, 3).max(axis=1)
        first //= 2
    return (lower, upper), leaves


def _morton(points):
    """Morton codes [N] of points [N, 3]: the interleaved bits of their places in a grid over all of them."""
    low, size = points.min(axis=0), np.ptp(points, axis=0).max()
    cells = ((points - low) / max(size, 1e-12) * (2**_MORTON_BITS - 1)).astype(np.int64)
    code = np.zeros(len(points), np.int64)
    for bit in range(_MORTON_BITS):
        for axis in range(3):
            code |= ((cells[:, axis] >> bit) & 1) << (3 * bit + axis)
    return code
