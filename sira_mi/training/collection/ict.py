"""ICT-FaceKit identities (Li et al. 2020) as heads with the MakeHuman topology.

The file holds a mean neutral head and 100 identity modes of light-stage scans, with eyeballs. Once per file, the
MakeHuman mean adult is registered to the mean: a similarity from landmarks that the portrait network finds on renders,
then `registration.register`, whose last correspondences stay fixed. The head of an identity is the linear step
for the modes' displacements of those correspondences; neck and shoulders beyond the scans follow smoothly, and return
to the MakeHuman body. Nothing of the file is stored.
"""

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from scipy import sparse
from scipy.spatial import cKDTree

from sira_mi.errors import InputError
from sira_mi.training.collection.ict_basis import Basis, mark, read_basis
from sira_mi.training.collection.landmarks import landmark_barycentrics
from sira_mi.training.collection.makehuman import (
    LEFT_EYE,
    RIGHT_EYE,
    Identity,
    between_ears,
    close_mouth,
    identity_vertices,
    load_pack,
)
from sira_mi.training.collection.registration import (
    Level,
    Problem,
    Rows,
    fit_sphere,
    match_rings,
    register,
    stack,
)
from sira_mi.training.collection.similarity import fit_similarity
from sira_mi.training.collection.skin import step
from sira_mi.training.collection.surface import border_loops, eye_spheres, head_topology, refinement
from sira_mi.training.collection.triangles import Places

LARGEST_COEFFICIENT = 2.5  # standard deviations
# The body that carries the heads: a mean adult, arms lowered by 0.4 radians.
MEAN_ADULT = Identity(35.0, 0.5, (1 / 3, 1 / 3, 1 / 3), 0.5, 0.5, 0.4, {})

# Rest-pose heights in decimetres between which the scans take over from the MakeHuman body, and under which the body
# stays where it is.
NECK = (5.62, 5.95)
BODY = (5.3, 4.9)
# Quad rings of the base mesh from the rear pole of an eye socket to the rim of the lids.
LID_RING = 11
SOCKET_RING = 8
LID_SHARE = 1.3  # radii of the eyeball around its centre within which marks give way to the lids' rims
EYE_GAP = 0.003  # scene units that the lids stay clear of the eyeballs

LEVELS = (
    Level(stiffness=1.0, reach=0.4, normal_weight=0.3, pair_weight=1.0, iterations=2),
    Level(stiffness=0.5, reach=0.3, normal_weight=0.25, pair_weight=0.5, iterations=2),
    Level(stiffness=0.25, reach=0.2, normal_weight=0.2, pair_weight=0.2, iterations=3),
    Level(stiffness=0.12, reach=0.15, normal_weight=0.15, pair_weight=0.1, iterations=3),
    Level(stiffness=0.06, reach=0.1, normal_weight=0.1, pair_weight=0.05, iterations=3),
    Level(stiffness=0.035, reach=0.06, normal_weight=0.1, pair_weight=0.03, iterations=4),
)
MARK_AREA, LID_AREA, SOCKET_AREA, BODY_AREA = 0.004, 0.002, 0.0005, 0.01  # square scene units a row stands for


def sample_coefficients(random: np.random.Generator, count: int = 100) -> np.ndarray:
    """Coefficients [count] of a random identity: N(0, 1), clipped at 2.5."""
    return np.clip(random.standard_normal(count), -LARGEST_COEFFICIENT, LARGEST_COEFFICIENT)


def ict_control(path: Path, coefficients: np.ndarray) -> np.ndarray:
    """Base-mesh vertices [19158, 3] of an identity with coefficients [≤ 100], in scene units, origin between its ears,
    arms lowered, mouth closed, eyes behind their lids. The first call for a file takes about ten seconds.

    Raises InputError when the file is missing or malformed, or holds no face."""
    fit = _load_fitted(str(path), _stamp(Path(path)))
    coefficients = np.asarray(coefficients, float).ravel()
    if len(coefficients) > len(fit.modes) or not np.isfinite(coefficients).all():
        raise InputError(f"{path}: an identity takes up to {len(fit.modes)} finite coefficients")
    control = fit.control + np.tensordot(coefficients, fit.modes[: len(coefficients)], 1)
    control = close_mouth(control)
    refined = refinement()[0] @ control
    for part, points, moves, lids in zip((LEFT_EYE, RIGHT_EYE), fit.eyes, fit.eye_modes, _lids(), strict=True):
        centre, radius = fit_sphere(points + np.tensordot(coefficients, moves[: len(coefficients)], 1))
        clearance = np.linalg.norm(refined[lids] - centre, axis=1).min()
        control[part] = _onto_sphere(fit.template[part], centre, min(radius, clearance - EYE_GAP))
    return control - between_ears(control)


@dataclass(frozen=True)
class Fitted:
    """A file on the base mesh."""

    template: np.ndarray  # [19158, 3] the aligned mean adult
    control: np.ndarray  # [19158, 3] the mean identity, eyes not yet placed
    modes: np.ndarray  # [K, 19158, 3] displacement of the base mesh by each mode
    eyes: list[np.ndarray]  # [E, 3] points on the left and the right eyeball of the mean
    eye_modes: list[np.ndarray]  # [K, E, 3] their displacement by each mode


def _stamp(path):
    try:
        status = path.stat()
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}; expected the ICT-FaceKit identity basis") from None
    return status.st_mtime_ns, status.st_size


@lru_cache(maxsize=2)
def _load_fitted(path, stamp):
    return fit_basis(read_basis(Path(path)), path)


def _onto_sphere(eye, centre, radius):
    """The base mesh's eyeball vertices [E, 3], which lie about the middle of their box, moved to a sphere."""
    middle = (eye.min(0) + eye.max(0)) / 2
    return centre + (eye - middle) * radius / np.linalg.norm(eye - middle, axis=1).mean()


@lru_cache(maxsize=1)
def _rings() -> tuple[tuple[np.ndarray, ...], ...]:
    """For the left and the right eye, the quad rings of control vertices around the socket's rear pole up to a few
    beyond the lids' rim, each in the order of the walk around it."""
    pack = load_pack()
    ends = np.stack([pack.quads, np.roll(pack.quads, -1, axis=1)], axis=-1).reshape(-1, 2)
    count = len(pack.vertices)
    edges = sparse.csr_matrix((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), (count, count))
    incidence = sparse.csr_matrix(
        (np.ones(pack.quads.size), (pack.quads.ravel(), np.repeat(np.arange(len(pack.quads)), 4)))
    )
    around = (incidence @ incidence.T).tocsr()
    used = np.unique(pack.quads)
    found = []
    for centre, radius in eye_spheres(pack.vertices):
        pole = used[np.linalg.norm(pack.vertices[used] - centre + [0, 0, radius], axis=1).argmin()]
        rings, seen = [np.array([pole])], {pole}
        while len(rings) <= LID_RING + 3:
            ring = set(around[rings[-1]].indices.tolist()) - seen
            seen |= ring
            rings.append(np.array(sorted(ring)))
        found.append((*rings[:LID_RING], _walk(rings[LID_RING], edges), *rings[LID_RING + 1 :]))
    return tuple(found)


def _walk(ring, edges):
    """A ring's vertices in order, starting from the smallest towards its smaller neighbour."""
    between = edges[ring][:, ring] + edges[ring][:, ring].T
    order, current, last = [0], 0, -1
    while len(order) < len(ring):
        following = [n for n in np.sort(between[current].indices) if n != last and n not in order]
        last, current = current, following[0]
        order.append(current)
    return ring[order]


@lru_cache(maxsize=1)
def _lids() -> tuple[np.ndarray, np.ndarray]:
    """Refined vertices on the rims and fronts of the left and the right eye's lids."""
    used = np.unique(load_pack().quads)
    left, right = (np.searchsorted(used, np.concatenate(rings[LID_RING + 1 : LID_RING + 4])) for rings in _rings())
    return left, right


@lru_cache(maxsize=1)
def _region() -> np.ndarray:
    """Share [M'] of each refined vertex in the registration: none in eye sockets, mouth and body."""
    hidden = load_pack().masks["inside_mouth"].copy()
    for rings in _rings():
        hidden[np.concatenate(rings[:LID_RING])] = 1
    operator, _ = refinement()
    height = operator @ load_pack().vertices[:, 1]
    return step(height, *NECK) * (1 - step(operator @ hidden, 0.05, 0.3))


def fit_basis(basis: Basis, path: str) -> Fitted:
    """Registers the MakeHuman mean adult to the basis; `path` is named in errors."""
    used = np.unique(load_pack().quads)
    template, pairs = _align(basis, path)
    triangles = head_topology()[0]
    refine = refinement()[0][:, used]
    index = np.full(len(template), -1)
    index[used] = np.arange(len(used))
    problem = Problem(
        template=template[used],
        refine=refine,
        quads=index[load_pack().quads],
        triangles=triangles[(triangles < refine.shape[0]).all(1)],
        region=_region(),
        target=basis.mean,
        target_triangles=basis.skin,
        pairs=pairs,
        anchors=stack([*_lid_rows(basis, template, path), *_socket_rows(basis, template), _body_rows(template, basis)]),
    )
    control, solver = register(problem, LEVELS)
    count = len(basis.modes)
    motion = basis.modes.transpose(1, 0, 2).reshape(len(basis.mean), 3 * count).astype(float)
    response = solver.response(motion).reshape(len(used), count, 3).transpose(1, 0, 2)
    carry = _carry(template, used)
    moved = template + carry @ (control - template[used])
    modes = np.stack([(carry @ mode).astype(np.float32) for mode in response])
    eyes = list(basis.eyes)
    return Fitted(template, moved, modes, [basis.mean[e] for e in eyes], [basis.modes[:, e] for e in eyes])


def _align(basis, path):
    """The mean adult [19158, 3] brought to the size and place of the scans, upright as both are, and the rows of the
    landmarks that both have outside the lids."""
    control = identity_vertices(MEAN_ADULT)
    vertices, weights, valid = landmark_barycentrics()
    refined = refinement()[0]
    marks, places, seen = mark(basis, path)
    for eye in basis.eyes:
        centre, radius = fit_sphere(basis.mean[eye])
        seen = seen & (np.linalg.norm(marks - centre, axis=1) > LID_SHARE * radius)
    both = np.flatnonzero(valid & seen)
    matrix = Places(np.arange(len(both)), weights[both]).matrix(vertices[both], refined.shape[0]) @ refined
    own = matrix @ control
    goals = marks[both]
    scale = fit_similarity(own, goals).scale
    template = scale * (control - own.mean(0)) + goals.mean(0)
    source = Places(places.triangles[both], places.weights[both]).matrix(basis.skin, len(basis.mean))
    used = np.unique(load_pack().quads)
    return template, Rows(matrix.tocsr()[:, used], goals, source, np.full(len(both), MARK_AREA))


def _lid_rows(basis, template, path):
    """Rows that put the rims of the lids on the borders of the scans' lids."""
    used = np.unique(load_pack().quads)
    loops = border_loops(basis.skin)
    rows = []
    for eye, rings in zip(basis.eyes, _rings(), strict=True):
        centre, radius = fit_sphere(basis.mean[eye])
        distance = [np.linalg.norm(basis.mean[loop] - centre, axis=1).max() for loop in loops]
        if not loops or min(distance) > 1.5 * radius:
            raise InputError(f"{path}: the skin of the mean has no opening before an eyeball")
        loop = _anticlockwise(loops[int(np.argmin(distance))], basis.mean)
        ring = _anticlockwise(rings[LID_RING], template)
        curve = basis.mean[loop] - basis.mean[loop].mean(0)
        along = np.linalg.svd(curve, full_matrices=False)[2][0]
        pick = sparse.identity(len(basis.mean), format="csr")[loop]
        source = match_rings(template[ring] - template[ring].mean(0), curve, along) @ pick
        matrix = refinement()[0][np.searchsorted(used, ring)][:, used]
        rows.append(Rows(matrix, source @ basis.mean, source, np.full(len(ring), LID_AREA)))
    return rows


def _anticlockwise(loop, vertices):
    """The loop in the order that runs anticlockwise seen from +z."""
    x, y = vertices[loop, 0], vertices[loop, 1]
    return loop if (x * np.roll(y, -1) - y * np.roll(x, -1)).sum() > 0 else loop[::-1]


def _socket_rows(basis, template):
    """Rows that carry the rear of the eye sockets along with the eyeballs."""
    used = np.unique(load_pack().quads)
    rows = []
    for eye, rings, part in zip(basis.eyes, _rings(), (LEFT_EYE, RIGHT_EYE), strict=True):
        socket = np.concatenate(rings[: SOCKET_RING + 1])
        centre, radius = fit_sphere(basis.mean[eye])
        middle = (template[part].min(0) + template[part].max(0)) / 2
        goals = centre + (template[socket] - middle) * radius / np.linalg.norm(template[part] - middle, axis=1).mean()
        matrix = sparse.identity(len(template), format="csr")[socket][:, used]
        average = sparse.csr_matrix((np.full(len(eye), 1 / len(eye)), (np.zeros(len(eye), int), eye)))
        average.resize(1, len(basis.mean))
        source = sparse.vstack([average] * len(socket))
        rows.append(Rows(matrix, goals, source.tocsr(), np.full(len(socket), SOCKET_AREA)))
    return rows


def _body_rows(template, basis):
    """Rows that keep chest, shoulders and arms where they are."""
    used = np.unique(load_pack().quads)
    rest = load_pack().vertices[used]
    share = step(rest[:, 1], *BODY)
    held = np.flatnonzero(share > 0)
    matrix = sparse.identity(len(used), format="csr")[held]
    nothing = sparse.csr_matrix((len(held), len(basis.mean)))
    return Rows(matrix, template[used[held]], nothing, BODY_AREA * share[held])


def _carry(template, used):
    """The matrix [19158, used] that moves the rest of the base mesh (helper geometry, hidden parts) with the nearest of
    the used vertices."""
    rest = np.setdiff1d(np.arange(len(template)), used)
    distance, near = cKDTree(template[used]).query(template[rest], k=8)
    weights = 1 / (distance + 0.02) ** 2
    weights /= weights.sum(1, keepdims=True)
    rows = np.concatenate([used, np.repeat(rest, 8)])
    columns = np.concatenate([np.arange(len(used)), near.ravel()])
    values = np.concatenate([np.ones(len(used)), weights.ravel()])
    return sparse.csr_matrix((values, (rows, columns)), (len(template), len(used)))
