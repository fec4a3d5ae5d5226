"""ICT-FaceKit identities on the MakeHuman topology, on a made-up basis file: another MakeHuman head, warped and cut
open as the scans are, with known modes. And the pure registration functions against references."""

import sira_mi  # noqa: F401  (before Dr.Jit, which must find LLVM)

# isort: split
import numpy as np
import pytest
import trimesh

from sira_mi.conventions import MILLIMETRES_PER_UNIT
from sira_mi.errors import InputError
from sira_mi.training.collection import ict, registration
from sira_mi.training.collection import triangles as triangle_meshes
from sira_mi.training.collection.ict import ict_control, sample_coefficients
from sira_mi.training.collection.makehuman import BODY_VERTICES, LEFT_EYE, Identity, identity_vertices, load_pack
from sira_mi.training.collection.similarity import fit_similarity
from sira_mi.training.collection.skin import rest_surface
from sira_mi.training.collection.surface import eye_spheres, head_surface, refine_attribute, refinement, unit_eye

WOMAN = Identity(25.0, 0.2, (0.1, 0.7, 0.2), 0.4, 0.6, 0.4, {"head/head-oval": 0.4, "nose/nose-scale-horiz-incr": 0.3})
COEFFICIENTS = np.array([1.5, -2.0, 1.0])


def waves(points: np.ndarray, amplitude: float, seed: int) -> np.ndarray:
    """A smooth displacement [N, 3] of points [N, 3], root mean square near `amplitude`, wavelengths near 2 units."""
    random = np.random.default_rng(seed)
    directions = random.standard_normal((3, 6)) * np.pi / 2
    shares = random.standard_normal((6, 3)) * amplitude / np.sqrt(3)
    return np.sin(points @ directions + random.uniform(0, 2 * np.pi, 6)) @ shares


@pytest.fixture(scope="module")
def made_up(tmp_path_factory) -> dict:
    """A file like ICT-FaceKit's and what is known about it: `places` of all head vertices, `kept` skin triangles."""
    control = identity_vertices(WOMAN)
    head, triangles = head_surface(control)
    quads = load_pack().quads
    hidden = load_pack().masks["inside_mouth"] > 0.5
    for rings in ict._rings():
        hidden[np.concatenate(rings[: ict.LID_RING + 1])] = True
    open_quads = ~hidden[quads].all(1)
    open_quads &= load_pack().vertices[quads, 1].min(1) > 5.35
    # Every quad is refined into four, each of which is two triangles.
    kept = np.concatenate([np.repeat(open_quads, 4)] * 2)
    kept = triangles[: len(kept)][kept]
    pieces = trimesh.Trimesh(head, kept, process=False).split(only_watertight=False, repair=False)
    skin = max(pieces, key=lambda piece: len(piece.faces))
    vertices, faces = np.asarray(skin.vertices), np.asarray(skin.faces)
    spheres, unit, around = eye_spheres(control), *unit_eye()
    for centre, radius in spheres:
        faces = np.concatenate([faces, around + len(vertices)])
        vertices = np.concatenate([vertices, centre + 0.98 * radius * unit])

    def mode(points, seed):
        return waves(points, 0.02, seed)

    def mean(points):
        return points + waves(points, 0.04, 0) + [0.05, 0.2, -0.1]

    path = tmp_path_factory.mktemp("ict") / "basis.npz"
    arrays = {
        "mean": (10 * mean(vertices)).astype(np.float32),
        "basis": np.stack([10 * mode(vertices, seed) for seed in (1, 2, 3)]).astype(np.float32),
        "tris": faces,
    }
    np.savez(path, **arrays)
    return {"path": path, "arrays": arrays, "head": head, "mean": mean, "mode": mode, "skin": len(skin.vertices)}


@pytest.fixture(scope="module")
def heads(made_up) -> dict:
    """Registered heads [19158, 3] of the mean and of `COEFFICIENTS`."""
    return {"mean": ict_control(made_up["path"], np.zeros(0)), "moved": ict_control(made_up["path"], COEFFICIENTS)}


def face_mask() -> np.ndarray:
    """Head vertices on the face, outside mouth and sockets."""
    rest, region = rest_surface(), np.zeros(len(rest_surface()))
    region[: len(ict._region())] = ict._region()
    return (rest[:, 2] > 0.7) & (rest[:, 1] > 6.3) & (region > 0.99)


def truth(made_up, coefficients) -> np.ndarray:
    """Where the vertices [M, 3] of the made-up identity lie in the file's frame, scene units."""
    head = made_up["head"]
    return made_up["mean"](head) + sum(c * made_up["mode"](head, 1 + k) for k, c in enumerate(coefficients))


def file_frame(control, expected) -> np.ndarray:
    """The head [M, 3] of control vertices, moved to where the expected face [M, 3] is on average."""
    head = head_surface(control)[0]
    face = face_mask()
    return head + (expected - head)[face].mean(0)


def surface_distance(points, vertices, triangles) -> np.ndarray:
    """Distances [N] in mm."""
    _, found, _ = triangle_meshes.find_nearest(points, None, vertices, triangles, candidates=24)
    return np.linalg.norm(found - points, axis=1) * MILLIMETRES_PER_UNIT


@pytest.mark.slow
@pytest.mark.parametrize("name", ["mean", "moved"])
def test_registered_surface_lies_on_the_identity(made_up, heads, name):
    """The refined face is on the file's surface in both directions, which the same head with other coefficients is not,
    and its vertices are where the same vertices of the made-up head are."""
    coefficients = COEFFICIENTS if name == "moved" else np.zeros(3)
    expected = truth(made_up, coefficients)
    triangles, face = head_surface(heads[name])[1], face_mask()
    head = file_frame(heads[name], expected)
    assert np.median(surface_distance(head[face], expected, triangles)) < 0.2
    assert np.percentile(surface_distance(head[face], expected, triangles), 95) < 1.0
    assert np.median(surface_distance(expected[face], head, triangles)) < 0.2
    assert np.median(np.linalg.norm((head - expected)[face], axis=1)) * MILLIMETRES_PER_UNIT < 3.0
    other = heads["mean" if name == "moved" else "moved"]
    assert np.median(surface_distance(file_frame(other, expected)[face], expected, triangles)) > 0.5


@pytest.mark.slow
def test_coefficients_move_the_surface_as_the_modes_say(made_up, heads):
    """Motion of face vertices against the modes' displacement at these places; the frame is that between the ears."""
    face = face_mask()
    motion = (head_surface(heads["moved"])[0] - head_surface(heads["mean"])[0])[face]
    expected = (truth(made_up, COEFFICIENTS) - truth(made_up, np.zeros(3)))[face]
    motion, expected = motion - motion.mean(0), expected - expected.mean(0)
    assert np.linalg.norm(motion - expected) < 0.15 * np.linalg.norm(expected)


@pytest.mark.slow
def test_shoulders_stay(heads):
    """Identities differ above the shoulders only, up to the origin's shift."""
    low = np.flatnonzero(load_pack().vertices[:BODY_VERTICES, 1] < ict.BODY[1])
    motion = (heads["moved"] - heads["mean"])[low]
    assert np.ptp(motion, axis=0).max() * MILLIMETRES_PER_UNIT < 0.5


@pytest.mark.slow
def test_eyes_sit_behind_the_lids(made_up, heads):
    """Eyeballs are the file's, and no lid is behind their surface. The warp leaves no perfect balls and bends the lids
    towards them, so that they are scaled down more than those of scans."""
    expected = truth(made_up, COEFFICIENTS)
    shift = (expected - head_surface(heads["moved"])[0])[face_mask()].mean(0)
    vertices = (made_up["arrays"]["mean"] + np.tensordot(COEFFICIENTS, made_up["arrays"]["basis"], 1)) / 10
    count = len(unit_eye()[0])
    refined = refinement()[0] @ heads["moved"]
    for k, (centre, radius) in enumerate(eye_spheres(heads["moved"])):
        start = made_up["skin"] + k * count
        ball, size = registration.fit_sphere(vertices[start : start + count])
        assert np.linalg.norm(centre + shift - ball) * MILLIMETRES_PER_UNIT < 2.0
        assert 0.85 * size < radius < 1.01 * size
        assert np.linalg.norm(refined[ict._lids()[k]] - centre, axis=1).min() > radius
    assert heads["moved"][LEFT_EYE][:, 0].min() > 0


@pytest.mark.slow
def test_head_is_in_the_projects_frame(heads):
    """Origin between the ears, face along +z, and all control vertices finite and within reach of the head."""
    ears = load_pack().masks["ears"] > 0.5
    for control in heads.values():
        assert control.shape == load_pack().vertices.shape
        assert np.isfinite(control).all()
        sides = [control[ears & (load_pack().vertices[:, 0] * side > 0)].mean(0) for side in (1, -1)]
        assert np.abs(sum(sides)).max() < 1e-9
        nose = refine_attribute(control)[face_mask()]
        assert nose[nose[:, 2].argmax(), 2] > 1.0


def corrupt(arrays: dict, kind: str) -> dict:
    arrays = {name: values.copy() for name, values in arrays.items()}
    if kind == "an array is missing":
        del arrays["basis"]
    elif kind == "shapes disagree":
        arrays["basis"] = arrays["basis"][:, :-1]
    elif kind == "index out of range":
        arrays["tris"][5, 1] = len(arrays["mean"])
    elif kind == "negative index":
        arrays["tris"][5, 1] = -1
    elif kind == "indices are not integers":
        arrays["tris"] = arrays["tris"].astype(float)
    elif kind == "not finite":
        arrays["mean"][7, 2] = np.nan
    elif kind == "modes not finite":
        arrays["basis"][1, 7, 2] = np.inf
    elif kind == "metres":
        arrays["mean"] /= 100
    elif kind == "modes far too large":
        arrays["basis"] *= 1e4
    elif kind == "no eyeballs":
        arrays["tris"] = arrays["tris"][: -len(unit_eye()[1])]
    elif kind == "pickled":
        arrays["mean"] = np.array([{}], object)
    return arrays


@pytest.mark.parametrize(
    "kind",
    [
        "an array is missing",
        "shapes disagree",
        "index out of range",
        "negative index",
        "indices are not integers",
        "not finite",
        "modes not finite",
        "metres",
        "modes far too large",
        "no eyeballs",
        "pickled",
    ],
)
def test_broken_arrays_are_refused_in_one_line(made_up, tmp_path, kind):
    path = tmp_path / "broken.npz"
    np.savez(path, **corrupt(made_up["arrays"], kind))
    with pytest.raises(InputError) as caught:
        ict_control(path, np.zeros(3))
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize("content", [None, b"", b"PK\x03\x04 not a zip", b"mean basis tris"])
def test_files_that_are_no_npz_are_refused_in_one_line(tmp_path, content):
    path = tmp_path / "basis.npz"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError) as caught:
        ict_control(path, np.zeros(3))
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)


def test_truncated_file_is_refused(made_up, tmp_path):
    path = tmp_path / "short.npz"
    path.write_bytes(made_up["path"].read_bytes()[:-5000])
    with pytest.raises(InputError, match=r"short\.npz"):
        ict_control(path, np.zeros(3))


@pytest.mark.slow
@pytest.mark.parametrize("coefficients", [np.zeros(4), [0.0, np.nan]])
def test_unfit_coefficients_are_refused(made_up, heads, coefficients):
    with pytest.raises(InputError, match="up to 3 finite coefficients"):
        ict_control(made_up["path"], coefficients)


def test_coefficients_are_repeatable_and_clipped():
    drawn = sample_coefficients(np.random.default_rng(5), 20_000)
    assert (drawn == sample_coefficients(np.random.default_rng(5), 20_000)).all()
    assert np.abs(drawn).max() == 2.5
    assert abs(drawn.std() - 1) < 0.03


def test_closest_points_agree_with_trimesh():
    """`closest_on_triangles` against trimesh's implementation after Ericson, in front of faces, edges and corners."""
    random = np.random.default_rng(0)
    corners = random.standard_normal((2000, 3, 3))
    points = 2 * random.standard_normal((2000, 3))
    weights = triangle_meshes.closest_on_triangles(points, corners)
    found = np.einsum("nk,nkd->nd", weights, corners)
    assert (weights >= 0).all()
    np.testing.assert_allclose(weights.sum(1), 1, atol=1e-12)
    np.testing.assert_allclose(found, trimesh.triangles.closest_point(corners, points), atol=1e-9)


def test_similarity_is_recovered():
    random = np.random.default_rng(1)
    points = random.standard_normal((40, 3))
    rotation = np.linalg.qr(random.standard_normal((3, 3)))[0]
    rotation *= np.sign(np.linalg.det(rotation))
    found = fit_similarity(points, 0.7 * points @ rotation.T + [1, -2, 3])
    assert abs(found.scale - 0.7) < 1e-12
    np.testing.assert_allclose(found.rotation, rotation, atol=1e-12)
    np.testing.assert_allclose(found.shift, [1, -2, 3], atol=1e-12)


def test_biharmonic_energy_is_the_squared_laplacians_integral():
    """On an uneven planar mesh: sin²πx sin²πy, flat at the border, whose energy over the unit square is 2π⁴."""
    random, n = np.random.default_rng(2), 32
    x, y = np.meshgrid(np.linspace(0, 1, n), np.linspace(0, 1, n), indexing="ij")
    points = np.stack([x.ravel(), y.ravel(), np.zeros(n * n)], 1)
    inner = (np.abs(points[:, :2] - 0.5) < 0.499).all(1)
    points[inner, :2] += random.uniform(-0.1, 0.1, (inner.sum(), 2)) / n
    k = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    energy = registration.biharmonic(points, np.stack([k, k + n, k + n + 1, k + 1], 1))
    bump = (np.sin(np.pi * points[:, :2]) ** 2).prod(1)
    assert abs(bump @ (energy @ bump) / (2 * np.pi**4) - 1) < 0.02
    assert abs(energy @ np.ones(n * n)).max() < 1e-6


def test_rings_are_matched_by_arc_length():
    """Two unevenly sampled circles: every point is sent to its own angle, from extremes to extremes."""
    random = np.random.default_rng(3)

    def circle(count):
        angle = np.sort(np.concatenate([[0, np.pi], random.uniform(0, 2 * np.pi, count)]))
        return angle, np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1)

    (_, coarse), (_, fine) = circle(20), circle(400)
    found = registration.match_rings(coarse, np.roll(fine, 57, axis=0), np.array([1.0, 0, 0])) @ np.roll(
        fine, 57, axis=0
    )
    assert np.linalg.norm(found - coarse, axis=1).max() < 0.03
