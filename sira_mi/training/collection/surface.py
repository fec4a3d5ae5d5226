"""From a MakeHuman control mesh to closed, smooth surfaces: Catmull-Clark refinement, body below the cut, eyeballs."""

from functools import cache

import numpy as np
from scipy import sparse

from sira_mi.training.collection.makehuman import LEFT_EYE, RIGHT_EYE, load_pack

# Where the body below the pack's cut ends, in scene units: out of sight of every camera.
BODY_FLOOR = -7.0
EYE_RINGS = 40
EYE_SECTORS = 48


@cache
def refinement() -> tuple[sparse.csr_matrix, np.ndarray]:
    """One Catmull-Clark step over the pack's quads as a matrix [M, 19158] from control vertices to refined ones, and
    the refined quads [4F, 4] (Catmull and Clark 1978; borders as cubic B-splines)."""
    return catmull_clark(load_pack().quads, len(load_pack().vertices))


def catmull_clark(quads: np.ndarray, count: int) -> tuple[sparse.csr_matrix, np.ndarray]:
    """The Catmull-Clark matrix [used + edges + faces, count] of a quad mesh and its refined quads."""
    used, corner = np.unique(quads, return_inverse=True)
    corner = corner.reshape(quads.shape)
    faces = len(quads)
    ends = np.stack([corner, np.roll(corner, -1, axis=1)], axis=-1).reshape(-1, 2)
    edges, edge = np.unique(np.sort(ends, axis=1), axis=0, return_inverse=True)
    edge = edge.reshape(faces, 4)
    owner = np.repeat(np.arange(faces), 4)
    n = len(used)

    def matrix(rows, columns, values, shape):
        return sparse.csr_matrix((np.broadcast_to(values, rows.shape).astype(float), (rows, columns)), shape)

    face_point = matrix(owner, corner.ravel(), 0.25, (faces, n))
    edge_ends = matrix(np.repeat(np.arange(len(edges)), 2), edges.ravel(), 1.0, (len(edges), n))
    edge_faces = matrix(edge.ravel(), owner, 1.0, (len(edges), faces))
    border = np.asarray(edge_faces.sum(1)).ravel() == 1
    inner = sparse.diags((~border).astype(float))
    outer = sparse.diags(border.astype(float))
    edge_point = inner @ (0.25 * edge_ends + 0.25 * edge_faces @ face_point) + outer @ (0.5 * edge_ends)

    vertex_faces = matrix(corner.ravel(), owner, 1.0, (n, faces))
    valence = np.asarray(vertex_faces.sum(1)).ravel()
    vertex_edges = edge_ends.T.tocsr()
    edge_count = np.asarray(vertex_edges.sum(1)).ravel()
    identity = sparse.identity(n, format="csr")
    middle = 0.5 * edge_ends
    smooth = sparse.diags(1 / valence**2) @ (vertex_faces @ face_point)
    smooth = smooth + sparse.diags(2 / (valence * edge_count)) @ (vertex_edges @ middle)
    smooth = smooth + sparse.diags((valence - 3) / valence) @ identity
    on_border = np.asarray(vertex_edges @ border.astype(float)).ravel() > 0
    rim = 0.5 * identity + 0.25 * sparse.diags(1.0 * on_border) @ (vertex_edges @ outer @ middle)
    vertex_point = sparse.diags(1.0 * ~on_border) @ smooth + sparse.diags(1.0 * on_border) @ rim

    pick = matrix(np.arange(n), used, 1.0, (n, count))
    operator = (sparse.vstack([vertex_point, edge_point, face_point]) @ pick).tocsr()
    middle_index = n + edge
    centre = n + len(edges) + np.arange(faces)
    refined = np.stack(
        [corner, middle_index, np.broadcast_to(centre[:, None], (faces, 4)), np.roll(middle_index, 1, axis=1)], axis=-1
    )
    return operator, refined.reshape(-1, 4)


@cache
def head_topology() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Triangles [T, 3] of the closed head (refined body first, then the body's continuation downwards), and for every
    added vertex its source among the refined ones [A] and whether it is a cap's centre [A] bool."""
    operator, quads = refinement()
    triangles = [quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]
    first = operator.shape[0]
    source: list[int] = []
    centre: list[bool] = []
    for loop in border_loops(quads):
        ring = first + len(source) + np.arange(len(loop))
        source += [*loop, loop[0]]
        centre += [*(False for _ in loop), True]
        cap = first + len(source) - 1
        following, ring_following = np.roll(loop, -1), np.roll(ring, -1)
        triangles.append(np.stack([loop, following, ring_following], 1))
        triangles.append(np.stack([loop, ring_following, ring], 1))
        triangles.append(np.stack([ring, ring_following, np.full(len(ring), cap)], 1))
    return np.concatenate(triangles), np.array(source), np.array(centre)


def border_loops(quads: np.ndarray) -> list[np.ndarray]:
    """Closed border loops, each in the order that continues the mesh's orientation outwards."""
    ends = np.stack([quads, np.roll(quads, -1, axis=1)], axis=-1).reshape(-1, 2)
    directed = set(map(tuple, ends.tolist()))
    following = {b: a for a, b in directed if (b, a) not in directed}
    loops = []
    while following:
        start = min(following)
        loop, current = [start], following.pop(start)
        while current != start:
            loop.append(current)
            current = following.pop(current)
        loops.append(np.array(loop))
    return loops


def head_surface(vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The closed head [M, 3] and its triangles [T, 3] from control vertices [19158, 3]; arms and chest go on straight
    down to `BODY_FLOOR`."""
    triangles, source, centre = head_topology()
    refined = refinement()[0] @ vertices
    below = refined[source].copy()
    below[:, 1] = BODY_FLOOR
    start = 0
    for end in np.flatnonzero(centre).tolist():
        below[end] = below[start:end].mean(0)
        start = end + 1
    return np.concatenate([refined, below]), triangles


def refine_attribute(values: np.ndarray) -> np.ndarray:
    """A per-control-vertex attribute [19158, ...] on the vertices of `head_surface`."""
    refined = refinement()[0] @ values
    return np.concatenate([refined, refined[head_topology()[1]]])


def eye_spheres(vertices: np.ndarray) -> list[tuple[np.ndarray, float]]:
    """Centre [3] and radius of the left and the right eyeball in scene units."""
    spheres = []
    for part in (LEFT_EYE, RIGHT_EYE):
        points = vertices[part]
        centre = (points.min(0) + points.max(0)) / 2
        spheres.append((centre, float(np.linalg.norm(points - centre, axis=1).mean())))
    return spheres


@cache
def unit_eye() -> tuple[np.ndarray, np.ndarray]:
    """A unit sphere with its pole at +z: vertices [N, 3], finer near the pole, and triangles [T, 3]."""
    polar = np.pi * (np.arange(1, EYE_RINGS) / EYE_RINGS) ** 1.6
    turn = 2 * np.pi * np.arange(EYE_SECTORS) / EYE_SECTORS
    rings = np.stack(
        [
            np.sin(polar)[:, None] * np.cos(turn),
            np.sin(polar)[:, None] * np.sin(turn),
            np.broadcast_to(np.cos(polar)[:, None], (len(polar), EYE_SECTORS)),
        ],
        axis=-1,
    ).reshape(-1, 3)
    vertices = np.concatenate([rings, [[0, 0, 1], [0, 0, -1]]])
    front, back = len(rings), len(rings) + 1
    sector = np.arange(EYE_SECTORS)
    after = (sector + 1) % EYE_SECTORS
    triangles = [np.stack([np.full(EYE_SECTORS, front), sector, after], 1)]
    for ring in range(len(polar) - 1):
        a, b = ring * EYE_SECTORS, (ring + 1) * EYE_SECTORS
        triangles.append(np.stack([a + sector, b + sector, b + after], 1))
        triangles.append(np.stack([a + sector, b + after, a + after], 1))
    last = (len(polar) - 1) * EYE_SECTORS
    triangles.append(np.stack([np.full(EYE_SECTORS, back), last + after, last + sector], 1))
    return vertices, np.concatenate(triangles)
