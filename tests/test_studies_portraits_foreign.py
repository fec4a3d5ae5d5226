"""The benchmark `foreign`: its two halves, the plan of its portraits, and the expressions and hair of its heads."""

import sira_mi  # noqa: F401  (before Dr.Jit, which must find LLVM)

# isort: split
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from sira_mi.errors import InputError
from sira_mi.files import write_exr
from sira_mi.training.collection.annotation import mean_control, mean_head
from sira_mi.training.collection.lighting import render_lobes
from sira_mi.training.collection.sources.valid import EYES, ValidSource
from sira_mi.training.collection.subject import BrokenHead
from sira_mi.training.collection.surface import head_surface
from studies.portraits.benchmark_lights import LIGHTS, _lobe
from studies.portraits.benchmark_plan import UNITS_PER_METRE, Identity, name_tone
from studies.portraits.foreign_heads import (
    EXPRESSIONS,
    MORPH_STEPS,
    ROOM,
    STYLES,
    Expression,
    ForeignHeads,
    find_motion,
    fit_base_head,
)
from studies.portraits.foreign_plan import SHOWN, order_identities, plan_half, split_identities

# The data beside the checkout; not part of the project.
DATA = Path(__file__).parents[2] / "shared" / "data"

pytestmark = pytest.mark.usefixtures("variant")


@pytest.fixture(scope="module")
def identities() -> list[Identity]:
    """28 invented heads: two women and two men of each of seven ancestries, of many tones."""
    random = np.random.default_rng(1)
    heads = []
    for number in range(28):
        group = {"ancestry": "abcdefg"[number // 4], "sex": ("female", "male")[number % 2], "age": "adult"}
        luminance = float(random.uniform(0.06, 0.45))
        stem = f"{group['ancestry']}_{number}"
        heads.append(
            Identity("valid", number, number, group, {"luminance": luminance}, name_tone(luminance), True, True, stem)
        )
    return heads


@pytest.fixture(scope="module")
def environments(tmp_path_factory) -> list[Path]:
    folder = tmp_path_factory.mktemp("hdri")
    for number in range(5):
        lobes = [_lobe(0, 90, 0.3, np.ones(3)), _lobe(40 * number, 20, 50.0, np.full(3, 2.0 * number))]
        write_exr(folder / f"light{number}.exr", render_lobes(np.array(lobes), 16))
    return sorted(folder.iterdir())


def test_halves_share_no_identity_and_are_alike(identities):
    """Half of each ancestry and sex in either, whatever the order of the heads; tones within a twentieth."""
    first, second = split_identities(identities)
    assert {i.title for i in first}.isdisjoint(i.title for i in second) and len(first) == len(second) == 14
    groups = [Counter((i.group["ancestry"], i.group["sex"]) for i in half) for half in (first, second)]
    assert groups[0] == groups[1]
    light, dark = (np.mean([i.person["luminance"] for i in half]) for half in (first, second))
    assert abs(light - dark) < 0.05 * light
    assert split_identities(identities[::-1]) == (first, second)


def test_the_first_portraits_of_a_half_are_balanced(identities, environments):
    """Of the first 8 and 16: all lights, both sexes, most ancestries, all tones, a third neutral, yaws on both sides;
    of all: two of each identity, distances and angles within their bounds, half with EXIF, relit under other lights."""
    half = order_identities(split_identities(identities)[1])
    shots = plan_half("report", half, environments, 0)
    assert len(shots) == 28 and Counter(s.identity.title for s in shots) == {i.title: 2 for i in half}
    assert len({s.name for s in shots}) == len({s.seed for s in shots}) == 28
    assert [s.rank for s in shots] == list(range(28)) and {s.half for s in shots} == {"report"}
    for count in (8, 16):
        some = shots[:count]
        assert min(Counter(s.light for s in some)[light] for light in LIGHTS) >= count // 4
        assert abs(Counter(s.identity.group["sex"] for s in some)["female"] - count / 2) <= 1
        assert len({s.identity.group["ancestry"] for s in some}) >= 6
        assert {s.identity.tone for s in some} == {"dark", "medium", "light"}
        assert 0.2 <= Counter(s.expression for s in some)["neutral"] / count <= 0.45
        assert 0.3 < np.mean([s.pose.yaw > 0 for s in some]) < 0.7
    assert {s.expression for s in shots} == set(EXPRESSIONS) == set(SHOWN)
    assert all(abs(s.pose.yaw) <= 45 and abs(s.pose.pitch) <= 15 for s in shots)
    distances = [s.pose.distance / UNITS_PER_METRE for s in shots]
    assert 0.39 < min(distances) < 0.5 and 2.3 < max(distances) < 3.01
    assert Counter(s.exif for s in shots)[True] == 14
    assert all(len(set(s.relights)) == 2 and s.environment not in s.relights for s in shots)
    assert shots == plan_half("report", half, environments, 0)
    assert [s.pose for s in shots] != [s.pose for s in plan_half("choice", half, environments, 0)]


def write_morphs(folder: Path, prefix: str) -> tuple[Path, Path]:
    """An avatar of one skin triangle and two eyes, and its morphs, two of which move the first vertex."""
    sphere = np.random.default_rng(0).standard_normal((40, 3))
    sphere /= 80 * np.linalg.norm(sphere, axis=1, keepdims=True)
    eyes = [sphere + np.array([x, 1.6, 0.1]) for x in (0.03, -0.03)]
    vertices = np.concatenate([np.eye(3), *eyes]).astype(np.float32)
    faces = np.concatenate([np.arange(3)[None], 3 + np.arange(39).reshape(13, 3), 43 + np.arange(39).reshape(13, 3)])
    part = np.repeat([0, 1, 2], [1, 13, 13])
    avatar, morphs = folder / "a.npz", folder / "a_morphs.npz"
    np.savez(avatar, v=vertices, f=faces, part=part, part_names=np.array(["body", *EYES]))
    names = np.array(["Lsmile_h", "Rsmile_h", f"{prefix}t_Open_h"])
    d = np.array([[10, 0, 0], [0, 20, 0], [0, 0, 30]], np.int16)
    np.savez(morphs, names=names, off=np.arange(4), idx=np.array([0, 0, 1]), d=d)
    return avatar, morphs


@pytest.mark.parametrize("prefix", ["", "h_teeth."])
def test_expressions_move_vertices_by_morphs_of_either_naming(prefix, tmp_path):
    """Both sides of a morph, one with its mesh as prefix or without, by their weights in metres; an unknown one is
    named."""
    files = write_morphs(tmp_path, prefix)
    motion = find_motion(*files, Expression({"{side}smile_h": 0.5, "t_Open_h": 2.0}))
    np.testing.assert_allclose(motion[:2] * MORPH_STEPS, [[5, 10, 0], [0, 0, 60]])
    assert not motion[2:].any()
    with pytest.raises(BrokenHead, match=r"a_morphs\.npz does not move it .*Frown"):
        find_motion(*files, Expression({"Frown_h": 1.0}))


def test_eyes_turn_about_their_centres_to_the_heads_left_and_up(tmp_path):
    """A gaze of 20° left and 10° up takes the eye's front point there; the centre stays."""
    avatar, morphs = write_morphs(tmp_path, "")
    motion = find_motion(avatar, morphs, Expression(gaze=(20.0, 10.0)))
    with np.load(avatar) as data:
        eye = data["v"][3:42].astype(float)
    before, after = eye - [0.03, 1.6, 0.1], eye + motion[3:42] - [0.03, 1.6, 0.1]
    left, up = np.radians([20, 10])
    gaze = np.array([np.sin(left) * np.cos(up), np.sin(up), np.cos(left) * np.cos(up)])
    np.testing.assert_allclose(after @ gaze, before[:, 2], atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(after, axis=1), 1 / 80, rtol=1e-4)
    assert not motion[:3].any()


def test_the_base_head_takes_on_the_size_of_a_head():
    """Of the mean head itself, a little larger; of one that is wider, higher and shallower, as much in each axis."""
    head, marks = head_surface(mean_control())[0], mean_head()[0]
    for scale in (np.ones(3), np.array([1.08, 1.05, 0.93])):
        fitted = head_surface(fit_base_head(head * scale, marks * scale))[0]
        for axis, side in ((0, np.max), (1, np.max), (2, np.min)):
            above = head[:, 1] > 0.5
            wanted = side(head[above, axis]) * scale[axis]
            assert side(fitted[above, axis]) == pytest.approx(wanted, abs=0.05 + (ROOM - 1) * abs(wanted))


def test_the_avatars_have_what_expressions_and_hair_name():
    """Every morph of every expression, for every avatar, and hair for those that wear it."""
    heads = ForeignHeads(ValidSource(DATA / "valid"), DATA / "valid_morphs", DATA / "hair")
    if not (DATA / "valid").is_dir():
        pytest.skip(f"no VALID avatars at {DATA / 'valid'}")
    heads.check()
    stems = {path.stem for path in heads.avatars.files()}
    assert set(STYLES) <= stems and len(stems) == 28
    for path in heads.avatars.files()[::9]:
        for variants in EXPRESSIONS.values():
            for expression in variants:
                motion = find_motion(path, DATA / "valid_morphs" / f"{path.stem}_morphs.npz", expression)
                assert np.linalg.norm(motion, axis=1).max() < 0.06
                assert motion.any() == (expression != Expression())


def test_missing_files_are_named(tmp_path):
    heads = ForeignHeads(ValidSource(tmp_path), tmp_path, tmp_path)
    with pytest.raises(InputError, match="no VALID avatars"):
        heads.check()
    for name in ("a.npz", "a.jpg"):
        (tmp_path / name).touch()
    with pytest.raises(InputError, match=r"a_morphs\.npz is missing"):
        heads.check()
