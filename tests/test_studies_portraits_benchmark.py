"""The benchmark of portraits: the choice of heads and poses, the truth behind a photo, and the folder."""

import sira_mi  # noqa: F401  (before Dr.Jit, which must find LLVM)

# isort: split
import json
from dataclasses import replace
from pathlib import Path

import drjit as dr
import numpy as np
import pytest
import trimesh

from sira_mi.colour import linear_to_srgb
from sira_mi.conventions import LUMINANCE
from sira_mi.errors import InputError
from sira_mi.files import write_exr
from sira_mi.portrait.camera import Camera, convert_exif_focal, yaw_rotation
from sira_mi.portrait.load import load_photo
from sira_mi.training.collection import skin
from sira_mi.training.collection.lighting import map_directions, render_lobes
from sira_mi.training.collection.render import Part, RenderSettings, build_scene, project, render_views
from sira_mi.training.collection.similarity import Similarity
from sira_mi.training.collection.sources.makehuman import MakeHumanSource
from studies.portraits import benchmark
from studies.portraits.benchmark_lights import HARD, LIGHTS, _lobe, light_map, look_up
from studies.portraits.benchmark_photo import PhotoSettings, Pose, View, find_focal, level_parts, portrait_camera
from studies.portraits.benchmark_plan import (
    BenchmarkSettings,
    Identity,
    choose_identities,
    heads_of,
    plan,
    plan_own,
    rebuild_subject,
    select_sources,
)
from studies.portraits.truth import VIEWS, load_truth, load_views

TINY = PhotoSettings(size=48, samples=16, view_samples=4, depth=3, shading_samples=64)
EVEN = {code: 0.5 for code in range(4)}
NUMBER, SEED = 7, 4711


pytestmark = pytest.mark.usefixtures("variant")


def ball(radius: float, centre: tuple, albedo: tuple, specular: float, code: int) -> Part:
    mesh = trimesh.creation.icosphere(subdivisions=5)
    unit, count = np.asarray(mesh.vertices), len(mesh.vertices)
    return Part(
        radius * unit + centre,
        np.asarray(mesh.faces),
        unit,
        np.tile(albedo, (count, 1)),
        np.full(count, specular),
        np.full(len(mesh.faces), code),
    )


@pytest.fixture(scope="module")
def sphere():
    return ball(1.2, (0, 0, 0), (0.5, 0.3, 0.2), 0.5, skin.HAIR)


def view_of(parts: list[Part], roughness=EVEN, settings=TINY) -> View:
    return View(parts, roughness, *portrait_camera(parts, Pose(20, 10, 60, 4.0), settings.size), settings)


def identities() -> list[Identity]:
    """58 invented test heads of three sources."""
    random = np.random.default_rng(3)
    heads = []
    for source, count in (("makehuman", 37), ("ict", 18), ("valid", 3)):
        for number in range(count):
            known = source != "ict"
            group = {
                "ancestry": str(random.choice(["a", "b", "c", "d"], p=[0.7, 0.1, 0.1, 0.1])) if known else "unknown",
                "sex": str(random.choice(["male", "female"], p=[0.8, 0.2])) if known else "unknown",
                "age": str(random.choice(["young", "old"])) if known else "unknown",
            }
            hair = bool(random.random() < 0.7)
            tone = str(random.choice(["dark", "medium", "light"]))
            heads.append(Identity(source, 8 * number + 7, number, group, {"wig": hair}, tone, hair, True))
    return heads


def test_heads_are_chosen_by_a_rule_from_all_sources():
    """5, 4 and 3 of the sources; half with hair; several ancestries, every sex, age and tone; in any order of heads."""
    heads = identities()
    chosen = choose_identities(heads, 12, 0)
    assert [head.source for head in chosen] == ["makehuman"] * 5 + ["ict"] * 4 + ["valid"] * 3
    assert sum(head.hair for head in chosen) >= 6
    assert {head.tone for head in chosen} == {"dark", "medium", "light"}
    groups = [head.group for head in chosen if head.source == "makehuman"]
    assert len({g["ancestry"] for g in groups}) >= 3
    assert {g["sex"] for g in groups} == {"male", "female"} and {g["age"] for g in groups} == {"young", "old"}
    shuffled = [heads[k] for k in np.random.default_rng(0).permutation(len(heads))]
    assert choose_identities(shuffled, 12, 0) == chosen
    assert choose_identities(heads, 12, 1) != chosen
    assert len(choose_identities(heads[-5:], 12, 0)) == 5


@pytest.fixture(scope="module")
def environments(tmp_path_factory) -> list[Path]:
    """Four environment maps: two even ones, and two with a lamp."""
    folder = tmp_path_factory.mktemp("hdri")
    for number in range(4):
        lobes = [_lobe(0, 90, 0.3, np.ones(3)), _lobe(40 * number, 20, 50.0, np.full(3, 5.0 * (number > 1)))]
        write_exr(folder / f"light{number}.exr", render_lobes(np.array(lobes), 16))
    return sorted(folder.iterdir())


def test_the_plan_spreads_poses_and_lights(environments):
    """Three lights of each head in one pose; yaws evenly in -40..40 overall and among the primary portraits of each
    light; four primary portraits a light; no seed twice. Each is relit under an even light and under a lamp, in turns
    first, and never under its own environment."""
    heads = choose_identities(identities(), 12, 0)
    shots = plan(heads, environments, BenchmarkSettings())
    assert all([shot.light for shot in mine] == list(LIGHTS) for mine in shots)
    assert all(len({shot.pose for shot in mine}) == 1 for mine in shots)
    yaws = sorted(mine[0].pose.yaw for mine in shots)
    np.testing.assert_allclose(yaws, np.linspace(-40, 40, 12), atol=0.01)
    primary = [shot for mine in shots for shot in mine if shot.primary]
    assert len(primary) == 12 and len({shot.seed for mine in shots for shot in mine}) == 36
    for light in LIGHTS:
        of_light = [shot for shot in primary if shot.light == light]
        assert len(of_light) == 4 and len({shot.identity.source for shot in of_light}) >= 2
        assert np.diff(sorted(shot.pose.yaw for shot in of_light)).min() > 20
    assert len({shot.environment for shot in primary if shot.light == "outdoor"}) == 4
    assert all(50 <= shot.pose.focal_35mm <= 85 and abs(shot.pose.pitch) <= 8 for shot in primary)
    only = plan(heads, environments, BenchmarkSettings(primary_only=True))
    assert [mine[0] for mine in only] == primary
    for number, (shot, *_) in enumerate(shots):
        first, second = (environments.index(path) for path in shot.relights)
        assert shot.environment not in shot.relights and (first > 1) != (second > 1) and (first > 1) == number % 2
    assert not any(mine[0].relights for mine in plan(heads, [], BenchmarkSettings(split="train")))
    with pytest.raises(InputError, match="3 environment maps: relighting takes 4"):
        plan(heads, environments[:3], BenchmarkSettings())


def test_the_camera_has_the_focal_length_of_its_exif_tag_and_shows_the_hair(sphere):
    """The focal length in pixels is what the portrait front end reads from EXIF; the highest point is in the picture,
    and the head's middle in the middle column."""
    K, pose = portrait_camera([sphere], Pose(-40, 8, 62.0, 4.6), 512)
    assert K[0, 0] == pytest.approx(convert_exif_focal(62.0, 512, 512), rel=1e-6)
    assert K[0, 2] == K[1, 2] == 256
    pixels, depth = project(np.array([[0, 1.2, 0], [0.0, 0, 0]]), K, pose)
    assert 10 < pixels[0, 1] < 80 and abs(pixels[1, 0] - 256) < 1e-6
    assert (depth > 0).all()
    camera = -pose[:3, :3].T @ pose[:3, 3]
    assert np.degrees(np.arctan2(camera[0], camera[2])) == pytest.approx(-40, abs=0.01)


def test_a_pose_says_distance_and_place_of_the_head(sphere):
    """4 units away, with 3 across the photo and the middle 0.5 units right of and 0.2 above the head: the head is at
    that depth, half of a third left of the middle, and below it."""
    pose = Pose(0, 0, find_focal(4.0, 3.0), 3.0, height=0.2, aside=0.5)
    assert pose.distance == pytest.approx(4)
    pixels, depth = project(np.zeros((1, 3)), *portrait_camera([sphere], pose, 300))
    assert depth[0] == pytest.approx(4)
    np.testing.assert_allclose(pixels[0], [100, 170])


def test_truth_of_a_sphere_under_even_light(sphere):
    """A convex body under radiance 1 from everywhere: irradiance / pi is 1, nothing is shadowed; mask, normals, region,
    albedo and reflectance are the sphere's own."""
    view = view_of([sphere])
    radiance, mask = view.photograph(np.ones((4, 8, 3)), 1)
    irradiance, shadow = view.shading(2)
    truth = view.truth
    inside = truth["region"] != 255
    assert set(np.unique(truth["region"])) == {skin.HAIR, 255}
    np.testing.assert_allclose(irradiance[inside], 1, atol=0.1)
    np.testing.assert_allclose(irradiance[inside].mean(), 1, atol=0.005)
    assert shadow[inside].min() > 0.9 and not shadow[~inside].any() and not irradiance[~inside].any()
    position, pose = -view.world_to_camera[:3, :3].T @ view.world_to_camera[:3, 3], view.world_to_camera
    way, centre = view.directions(), position
    along = -(way @ centre)
    hit = centre + (along - np.sqrt(np.maximum(along**2 - centre @ centre + 1.44, 0)))[..., None] * way
    rim = np.linalg.norm(np.cross(way, centre), axis=-1)
    sure = rim < 1.15
    np.testing.assert_allclose(truth["normal"][sure], hit[sure] / 1.2, atol=0.01)
    assert inside[sure].all() and not inside[rim > 1.25].any()
    assert mask[sure].min() == 1 and mask[rim > 1.3].max() == 0
    K = view.K[0, 0]
    tangent = np.arcsin(1.2 / np.linalg.norm(pose[:3, 3]))
    assert mask.sum() == pytest.approx(np.pi * (K * np.tan(tangent)) ** 2, rel=0.05)
    np.testing.assert_allclose(truth["diffuse_albedo"][inside], np.tile([0.5, 0.3, 0.2], (inside.sum(), 1)), atol=1e-4)
    np.testing.assert_allclose(truth["specular_albedo"][inside], 0.04, atol=1e-5)
    np.testing.assert_allclose((radiance[sure] / [0.5, 0.3, 0.2])[:, 0].mean(), 1.05, atol=0.12)


def test_shading_of_an_uneven_environment_against_quadrature(sphere):
    """On a convex body, irradiance / pi under a map with a hard lobe over dim light is the map's sum over solid angle
    times cosine, and nothing is shadowed, though the photo's light sampling leaves out what is dim."""
    view = view_of([sphere])
    lobes = [_lobe(50, 10, HARD, np.ones(3)), _lobe(-60, 30, 3.0, np.ones(3)), _lobe(0, 90, 0.3, np.full(3, 0.1))]
    light = render_lobes(np.array(lobes))
    view.photograph(light, 1)
    irradiance, shadow = view.shading(2)
    inside = view.truth["region"] != 255
    directions = map_directions(len(light))
    solid = np.sqrt(1 - directions[..., 1] ** 2) * (np.pi / len(light)) ** 2
    cosine = np.maximum(view.truth["normal"][inside] @ directions.reshape(-1, 3).T, 0)
    reference = cosine @ (light[..., 0] * solid).ravel() / np.pi
    np.testing.assert_allclose(irradiance[inside][:, 0].mean(), reference.mean(), rtol=0.01)
    assert np.abs(irradiance[inside][:, 0] - reference).mean() < 0.05 * reference.mean()
    assert shadow[inside].min() > 0.8 and shadow[inside].mean() > 0.995


def test_shadow_of_an_occluder_under_a_hard_light():
    """A ball in front of a larger one under a small light behind the camera's shoulder: the umbra's pixels get nothing
    of the direct light, lit ones all of it, and both the photo and the shading are dark in the umbra."""
    parts = [ball(1.2, (0, 0, 0), (0.4, 0.4, 0.4), 0.3, 0), ball(0.3, (0.0, 0.6, 1.9), (0.4, 0.4, 0.4), 0.3, 1)]
    view = View(parts, EVEN, *portrait_camera(parts, Pose(-35, 0, 60, 5.0), 96), replace(TINY, size=96))
    light = render_lobes(np.array([_lobe(0, 17.5, HARD, np.ones(3)), _lobe(0, 90, 0.3, np.full(3, 0.02))]))
    radiance, _ = view.photograph(light, 1)
    irradiance, shadow = view.shading(2)
    normal, skinned = view.truth["normal"], view.truth["region"] == 0
    towards = np.array([0, np.sin(np.radians(17.5)), np.cos(np.radians(17.5))])
    across = np.linalg.norm(np.cross(1.2 * normal - [0.0, 0.6, 1.9], towards), axis=-1)
    facing = skinned & (normal @ towards > 0.3)
    umbra, lit = facing & (across < 0.15), facing & (across > 0.65)
    assert umbra.sum() > 10 and lit.sum() > 300
    assert shadow[umbra].max() < 0.2 and shadow[lit].mean() > 0.97
    np.testing.assert_allclose(irradiance[lit].mean(-1), (normal @ towards)[lit] / np.pi, rtol=0.2, atol=0.02)
    for image in (radiance, irradiance):
        assert image[umbra].mean() < 0.25 * image[lit].mean()


def test_a_turned_view_is_that_of_a_turned_head():
    """A ball with a nose and one dark side, turned by 30° to its left before the same camera under the same light: the
    same picture, mask, regions and face as of parts that are turned by hand; places remain in the head's own frame."""
    parts = [ball(1.2, (0, 0, 0), (0.4, 0.4, 0.4), 0.3, skin.SKIN), ball(0.4, (0.4, 0.3, 1.1), (0.1, 0.3, 0.6), 0.3, 1)]
    turn = yaw_rotation(30)
    by_hand = Similarity(1.0, turn, np.zeros(3)).move(parts)
    camera, light = (
        portrait_camera(parts, Pose(10, 5, 60, 4.0), 48),
        render_lobes(np.array([_lobe(70, 20, 9.0, np.ones(3))])),
    )
    settings = replace(TINY, samples=256)
    view, reference = (View(some, EVEN, *camera, settings) for some in (parts, by_hand))
    turned = view.turn(30)
    nose = np.array([0.4, 0.3, 1.5])
    assert (turned.region == reference.region).all() and (turned.region != view.region).any()
    np.testing.assert_allclose(turned.position @ turn.T, reference.position, atol=1e-4)
    assert (benchmark.find_face(turned, nose) == benchmark.find_face(reference, turn @ nose)).all()
    (radiance, mask), (wanted, wanted_mask) = turned.photograph(light, 1), reference.photograph(light, 1)
    np.testing.assert_allclose(mask, wanted_mask, atol=0.02)
    assert np.abs(radiance - wanted).mean() < 0.02 * wanted.mean()
    assert np.abs(radiance - view.photograph(light, 1)[0]).mean() > 0.2 * wanted.mean()


def test_a_grey_ball_under_an_even_environment_shines_by_its_albedo():
    """Relit by the environment as it is: radiance L times about the albedo, whatever `principled` adds at the rim, and
    half a map as bright is half as bright."""
    grey = [ball(1.2, (0, 0, 0), (0.5, 0.5, 0.5), 0.0, skin.SKIN)]
    view = view_of(grey, EVEN | {skin.SKIN: 1.0}, replace(TINY, samples=64))
    radiance, mask = view.photograph(np.full((8, 16, 3), 2.0), 1)
    inside = mask == 1
    assert radiance[inside].mean() == pytest.approx(1.0, rel=0.1) and not radiance[mask == 0].any()
    half, _ = view.photograph(np.full((8, 16, 3), 1.0), 1)
    np.testing.assert_allclose(half, radiance / 2, rtol=1e-4, atol=1e-6)


@pytest.mark.slow
def test_photo_agrees_with_the_renderer_of_training_scenes(sphere):
    """With one roughness for all regions, `render_views`, which shares no sampling with it, gives the same photo; at
    strength 1 its material is the same `principled`."""
    settings = replace(TINY, size=24, samples=256)
    sphere = replace(sphere, specular=np.ones(len(sphere.vertices)))
    view = view_of([sphere], settings=settings)
    light = light_map("studio", np.random.default_rng(0), 0.0, None, "side")
    radiance, mask = view.photograph(light, 1)
    reference = RenderSettings(size=24, samples=1024, depth=3)
    images, coverage = render_views(
        build_scene([sphere], light, reference), view.K[None], view.world_to_camera[None], reference, 5
    )
    np.testing.assert_allclose(mask, coverage[0], atol=0.08)
    np.testing.assert_allclose(radiance.mean(), images[0].mean(), rtol=0.01)
    assert np.abs(radiance - images[0]).mean() < 0.03 * images[0][coverage[0] > 0.5].mean()


def test_specular_strength_is_kept_in_levels(sphere):
    """A part whose strength varies falls into pieces of one strength each; the truth's reflectance is that of the
    material, next to the part's own; nothing is lost of the surface."""
    varied = replace(sphere, specular=0.2 + 0.5 * (sphere.normals[:, 0] > 0) + 0.1 * sphere.normals[:, 1])
    pieces = level_parts(varied, TINY.specular_step)
    assert sum(len(part.triangles) for part, _ in pieces) == len(varied.triangles)
    for part, strength in pieces:
        assert (part.specular == strength).all() and part.triangles.max() < len(part.vertices)
    truth = view_of([varied]).truth
    inside = truth["region"] != 255
    normal = truth["normal"][inside]
    wanted = 0.08 * (0.2 + 0.5 * (normal[:, 0] > 0) + 0.1 * normal[:, 1])
    away = np.abs(normal[:, 0]) > 0.1
    assert np.abs(truth["specular_albedo"][inside] - wanted)[away].max() < 0.08 * 0.03 + 1e-3
    corners = [part.vertices[part.triangles].sum((1, 2)) for part, _ in pieces]
    np.testing.assert_allclose(
        np.sort(np.concatenate(corners)), np.sort(varied.vertices[varied.triangles].sum((1, 2))), atol=1e-9
    )


def test_roughness_of_each_region_enters_the_photo(sphere):
    """The same ball is another photo when its own region's roughness changes, the same when another region's does."""
    light = render_lobes(np.array([_lobe(40, 20, 200.0, np.ones(3))]))
    first, other, unused = (
        view_of([sphere], EVEN | change).photograph(light, 1)[0] for change in ({}, {skin.HAIR: 0.1}, {skin.CLOTH: 0.1})
    )
    assert np.abs(other - first).max() > 0.1 * first.max()
    assert (unused == first).all()


def test_photos_repeat_whatever_the_threads(sphere):
    """Bit for bit, with one thread and with several; another seed or another number for the noise gives other noise."""
    view = view_of([sphere])
    light = light_map("extreme", np.random.default_rng(0), 0.0, None, "coloured")
    first = view.photograph(light, 3)[0], *view.shading(4)
    threads = dr.thread_count()
    dr.set_thread_count(1)
    try:
        again = view.photograph(light, 3)[0], *view.shading(4)
    finally:
        dr.set_thread_count(threads)
    assert all((a == b).all() for a, b in zip(first, again, strict=True))
    other = view_of([sphere], settings=replace(TINY, noise=1)).photograph(light, 3)[0]
    for image in (view.photograph(light, 4)[0], other):
        assert (image != first[0]).any() and image.mean() == pytest.approx(first[0].mean(), rel=0.1)


def test_lights_are_what_they_say():
    """A lobe gives a facing plate the irradiance it was made for; the extreme lights come from their side; a map is
    looked up where its pixels are."""
    directions = map_directions(256)
    sines = np.sqrt(1 - directions[..., 1] ** 2) * (np.pi / 256) ** 2
    for sharpness in (12.0, HARD):
        towards = _lobe(30, 20, sharpness, np.ones(3))[:3]
        image = render_lobes(_lobe(30, 20, sharpness, np.ones(3))[None], 256)
        irradiance = (image[..., 0] * np.maximum(directions @ towards, 0) * sines).sum()
        assert irradiance == pytest.approx(1, rel=1.2 / sharpness + 0.01)
    for seed in range(5):
        for kind, front in (("side", True), ("back", False), ("coloured", True)):
            image = light_map("extreme", np.random.default_rng(seed), 0.0, None, kind)
            luminance = image @ np.array(LUMINANCE)
            brightest = map_directions(len(image))[np.unravel_index(luminance.argmax(), luminance.shape)]
            assert (brightest[2] > 0) == front and luminance.max() > 50 * np.median(luminance)
    image = np.random.default_rng(0).random((16, 32, 3))
    image[[0, -1]] = image[[0, -1], :1]  # at a pole all columns are one direction
    np.testing.assert_allclose(look_up(image, map_directions(16)), image, atol=1e-9)


def test_exposure_follows_the_albedo_half_way_and_spares_highlights():
    """A head of four times the albedo is twice as bright; a glint on it is kept below white in the studio."""
    truth = {
        "region": np.zeros((10, 10), np.uint8),
        "K": np.array([[10, 0, 5], [0, 10, 5], [0, 0, 1.0]]),
        "world_to_camera": np.eye(4),
    }
    mask, chin = np.ones((10, 10)), np.array([0, 0.4, 1.0])
    means = []
    for albedo in (0.1, 0.4):
        truth["diffuse_albedo"] = np.full((10, 10, 3), albedo)
        radiance = np.full((10, 10, 3), 7.0)
        radiance[9:] = 1.0  # below the chin: does not count
        means.append(7 * benchmark.exposure_of(radiance, mask, truth, chin, "studio"))
    assert means[1] == pytest.approx(2 * means[0]) and means[0] == pytest.approx(0.3 * np.sqrt(1 / 3))
    radiance[:2] = 100.0
    assert 100 * benchmark.exposure_of(radiance, mask, truth, chin, "studio") <= 1
    assert 100 * benchmark.exposure_of(radiance, mask, truth, chin, "extreme") <= 1


def write_scene(folder: Path, source: str, number: int, seed: int, person: dict, group: dict) -> dict:
    """A scene file of what the benchmark reads of one, and its manifest entry."""
    name = f"{source}_{number:04d}.npz"
    info = {"name": f"{source}/{number:04d}", "seed": seed, "group": group, "person": person}
    region = np.array([skin.SKIN] * 90 + [skin.CLOTH] * 10)
    np.savez(folder / name, info=np.array(json.dumps(info)), region=region, albedo=np.full((100, 3), 0.4))
    return {"file": name, "source": source, "number": number, "seed": seed, "split": "test", "group": group}


@pytest.fixture(scope="module")
def collection(tmp_path_factory):
    """A collection of one MakeHuman test head and one of a source that is not there."""
    folder = tmp_path_factory.mktemp("collection")
    source = MakeHumanSource(8, None)
    subject = source.subject(NUMBER, SEED)
    group = subject.group
    entries = [
        write_scene(folder, "makehuman", NUMBER, SEED, subject.description, group),
        write_scene(folder, "valid", 7, 1, {}, group),
    ]
    settings = {"sources": {"makehuman": 8, "valid": 8}}
    (folder / "manifest.json").write_text(json.dumps({"settings": settings, "scenes": entries}))
    return folder


@pytest.fixture(scope="module")
def built(collection, environments, tmp_path_factory):
    """The benchmark of the MakeHuman head, its settings, sittings and entries."""
    folder = tmp_path_factory.mktemp("benchmark")
    settings = BenchmarkSettings(photo=replace(TINY, samples=4, shading_samples=4))
    sittings = plan_own(collection, (MakeHumanSource(8, None),), environments[0].parent, settings)
    return folder, settings, sittings, benchmark.build_benchmark(sittings, folder, settings, 1)


@pytest.mark.slow
def test_a_benchmark_holds_photos_and_truth(built):
    """Three portraits with the files and arrays of the contract: the photo is the truth's image in sRGB, it carries its
    focal length, the truth passes the evaluation's own checks, and the head is in the picture."""
    folder, settings, _, entries = built
    photos = folder / "photos"
    names = [entry["name"] for entry in entries]
    assert sorted(path.name for path in photos.iterdir()) == sorted(
        [f"{name}.jpg" for name in names] + [f"{name}.camera.json" for name in names]
    )
    assert benchmark.read_benchmark(folder) == entries
    with pytest.raises(InputError, match="shows test heads"):
        benchmark.read_benchmark(folder, "train")
    assert [entry["light"] for entry in entries] == list(LIGHTS)
    assert [entry["primary"] for entry in entries] == [True, False, False]
    for entry in entries:
        assert entry["name"] == f"makehuman_0007_{entry['light']}" and entry["identity"] == "makehuman/0007"
        assert entry["clothes"] and not entry["hair"] and entry["clipped"] < 0.2
        truth_folder = folder / "truth" / entry["name"]
        photo = load_photo(photos / f"{entry['name']}.jpg")
        assert photo.focal_35mm == round(entry["focal_35mm"])
        with np.load(truth_folder / "truth.npz", allow_pickle=False) as data:
            arrays = {name: data[name] for name in data.files}
        assert list(arrays) == list(benchmark.TRUTH)
        for name, text in benchmark.TRUTH.items():
            kind = text.split("] ")[1].split(",")[0].split(" ")[0]
            assert arrays[name].dtype == {"f4": "f4", "u1": "u1", "i4": "i4", "bool": "?"}[kind], name
        truth = load_truth(truth_folder / "truth.npz")
        assert np.abs(linear_to_srgb(np.clip(truth.image, 0, 1)) - linear_to_srgb(photo.image)).mean() < 0.02
        assert truth.mask[24, 24] == 1 and 0.2 < truth.mask.mean() < 0.9 and not truth.mask[:2].any()
        off = truth.region == 255
        for name in ("diffuse_albedo", "shading", "shadow", "normal"):
            assert not getattr(truth, name)[off & (truth.mask == 0)].any(), name
        pixels, _ = project(
            truth.landmarks[np.isfinite(truth.landmarks).all(1)], arrays["K"], arrays["world_to_camera"]
        )
        assert ((pixels > 0) & (pixels < settings.photo.size)).all()
        assert {0, 2, 3} <= set(np.unique(truth.face_region))
        camera = Camera.from_json((photos / f"{entry['name']}.camera.json").read_text())
        np.testing.assert_array_equal(camera.project(truth.vertices), truth.camera.project(truth.vertices))
        views = load_views(truth_folder)
        assert list(views) == list(VIEWS) and all(
            (folder / "lights" / f"{v.light}.exr").is_file() for v in views.values()
        )
        for view in views.values():
            assert view.image[view.mask == 1].mean() > 0.01 and not view.image[view.mask == 0].any()
            assert set(np.unique(view.region[view.face])) <= {skin.SKIN, skin.EYE}
        np.testing.assert_allclose(views["relit_1"].mask, truth.mask, atol=0.6)
        assert np.abs(views["turned_left"].mask - truth.mask).max() > 0.6


@pytest.mark.slow
def test_portraits_that_are_there_are_kept(built, monkeypatch):
    """A second build takes nothing; a portrait whose photo is gone is taken again, to the same bits; other settings
    take all anew."""
    folder, settings, sittings, entries = built
    taken = []
    original = benchmark.portrait

    def spy(view, subject, shot, beside):
        taken.append(shot.name)
        return original(view, subject, shot, beside)

    monkeypatch.setattr(benchmark, "portrait", spy)
    assert benchmark.build_benchmark(sittings, folder, settings, 1) == entries
    assert not taken
    photo = folder / "photos" / f"{entries[1]['name']}.jpg"
    before = photo.read_bytes()
    photo.unlink()
    with pytest.raises(InputError, match="is missing"):
        benchmark.read_benchmark(folder)
    benchmark.build_benchmark(sittings, folder, settings, 1)
    assert taken == [entries[1]["name"]] and photo.read_bytes() == before
    finer = replace(settings.photo, samples=16)
    shots = sittings[0].shots
    assert all(benchmark.read_entry(folder, shot, shot.key(settings.photo)) for shot in shots)
    assert not any(benchmark.read_entry(folder, shot, shot.key(finer)) for shot in shots)


def test_what_is_missing_or_wrong_is_said_in_one_line(collection, tmp_path):
    """Sources without data, unknown sources, a head that the data do not give again, no maps, damaged files."""
    none = dict.fromkeys(("hair", "ict", "valid", "meshes"))
    with pytest.raises(InputError, match="give its data by --valid"):
        select_sources(collection, "test", None, none)
    with pytest.raises(InputError, match="no test heads of ict"):
        select_sources(collection, "test", ["ict"], none)
    assert [source.name for source in select_sources(collection, "test", ["makehuman"], none)] == ["makehuman"]
    assert heads_of(collection, "train") == []
    with pytest.raises(InputError, match="no train heads of makehuman"):
        plan_own(collection, (MakeHumanSource(8, None),), None, BenchmarkSettings(split="train"))
    head = heads_of(collection, "test")[0]
    with pytest.raises(InputError, match="is not the collection's"):
        rebuild_subject(MakeHumanSource(8, None), replace(head, person={"other": 1}))
    with pytest.raises(InputError, match=r"no \.exr"):
        plan_own(collection, (MakeHumanSource(8, None),), tmp_path, BenchmarkSettings())
    with pytest.raises(InputError, match="no benchmark"):
        benchmark.read_benchmark(tmp_path)
    for text in (
        "[]",
        '{"format": "other"}',
        '{"format": "sira-mi benchmark 2", "portraits": [{"name": "../x", "relights": []}]}',
    ):
        (tmp_path / "benchmark.json").write_text(text)
        with pytest.raises(InputError, match=r"benchmark\.json"):
            benchmark.read_benchmark(tmp_path)
