"""Avatar files: a written avatar reads back, and every kind of damage ends in one clear line."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from conftest import SMALL
from safetensors.numpy import save

from sira_mi.avatar.architecture import AvatarArchitecture
from sira_mi.avatar.file import FORMAT, load_avatar, load_prior, save_avatar
from sira_mi.avatar.skin_tone import SkinPrior
from sira_mi.conventions import LANDMARKS
from sira_mi.errors import InputError


def description(**changes) -> dict:
    values = {"architecture": dataclasses.asdict(SMALL), "roughness": 0.5, "k_s": 1.0, "k_r": 1.0}
    return {**values, **changes}


def write(path, tensors, text=None, format=FORMAT):
    metadata = {"format": format, "avatar": json.dumps(description()) if text is None else text}
    path.write_bytes(save(tensors, metadata=metadata))
    return path


def complaint(path) -> str:
    with pytest.raises(InputError) as caught:
        load_avatar(path)
    message = str(caught.value)
    assert "\n" not in message and str(path) in message and len(message) < 400
    return message


def test_round_trip(avatar, tmp_path):
    path = tmp_path / "kopf ä b.safetensors"
    save_avatar(path, dataclasses.replace(avatar, roughness=0.3, k_s=0.25, k_r=0.0))
    back = load_avatar(path)
    assert (back.architecture, back.roughness, back.k_s, back.k_r) == (avatar.architecture, 0.3, 0.25, 0.0)
    assert set(back.tensors) == set(avatar.tensors)
    for name, value in avatar.tensors.items():
        np.testing.assert_array_equal(back.tensors[name], value)
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def test_what_a_prior_expects_of_skin_comes_back(avatar, tmp_path):
    """A file of an earlier version opens without it, but is no prior to fit with."""
    skin = SkinPrior(radiance=0.3, deviations=(0.5, 0.1), mean=(-1.0, -2.0, -3.0), axis=(0.1, 0.2, 0.7))
    avatar = avatar.with_tensors(landmarks=np.random.default_rng(0).random((LANDMARKS, 3)))
    save_avatar(tmp_path / "a", dataclasses.replace(avatar, skin=skin))
    assert load_avatar(tmp_path / "a").skin == load_prior(tmp_path / "a").skin == skin
    save_avatar(tmp_path / "a", dataclasses.replace(avatar, skin=None))
    assert load_avatar(tmp_path / "a").skin is None
    with pytest.raises(InputError, match=r"earlier version.*python -m sira_mi\.training appearance") as caught:
        load_prior(tmp_path / "a")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("known", ["none", "five", "one place", "a plane"])
def test_a_prior_without_landmarks_is_refused(avatar, tmp_path, known):
    """Landmarks that determine no pose: too few, or in places that span no space. The file is an avatar."""
    landmarks = np.random.default_rng(0).random((LANDMARKS, 3))
    if known in ("none", "five"):
        landmarks[{"none": 0, "five": 5}[known] :] = np.nan
    else:
        landmarks[:, {"one place": 0, "a plane": 2}[known] :] = 0.5
    prior = load_prior()
    save_avatar(tmp_path / "a", dataclasses.replace(avatar.with_tensors(landmarks=landmarks), skin=prior.skin))
    assert load_avatar(tmp_path / "a").skin == prior.skin
    with pytest.raises(InputError, match="is no prior") as caught:
        load_prior(tmp_path / "a")
    assert "\n" not in str(caught.value) and str(tmp_path / "a") in str(caught.value)


def test_a_refined_light_comes_back_and_may_be_missing(avatar, tmp_path):
    """A prior has none; one of another size is refused."""
    network = avatar.architecture.networks["light_refinement"]
    assert "light_refinement" not in avatar.tensors
    refined = avatar.with_tensors(light_refinement=np.arange(network.parameters, dtype=np.float32))
    save_avatar(tmp_path / "a", refined)
    back = load_avatar(tmp_path / "a").tensors["light_refinement"]
    np.testing.assert_array_equal(back, refined.tensors["light_refinement"])
    save_avatar(tmp_path / "a", avatar.with_tensors(light_refinement=np.zeros(3, np.float32)))
    assert "light_refinement" in complaint(tmp_path / "a")


def test_the_same_avatar_is_the_same_bytes(avatar, tmp_path):
    shuffled = dataclasses.replace(avatar, tensors=dict(reversed(avatar.tensors.items())))
    save_avatar(tmp_path / "a", avatar)
    save_avatar(tmp_path / "b", shuffled)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_with_tensors_leaves_the_original_alone(avatar):
    other = avatar.with_tensors(z_sdf=np.zeros(6, np.float32))
    assert other.tensors["z_sdf"].sum() == 0 != avatar.tensors["z_sdf"].sum()


@pytest.mark.parametrize("share", [0.0, 0.001, 0.5, 0.999])
def test_truncated_files(avatar_path, tmp_path, share):
    data = Path(avatar_path).read_bytes()
    path = tmp_path / "cut.safetensors"
    path.write_bytes(data[: int(share * len(data))])
    complaint(path)


@pytest.mark.parametrize(
    "data", [b"not a tensor file at all", b"\xff" * 64, b"\x89PNG\r\n\x1a\n" + bytes(200), bytes(8)]
)
def test_files_of_other_kinds(tmp_path, data):
    path = tmp_path / "photo.png"
    path.write_bytes(data)
    complaint(path)


def test_a_head_without_deformation_is_refused_and_an_older_file_opens(avatar, tmp_path):
    """Earlier versions had both, and say `deforms` of either; the format still does."""
    sizes = dataclasses.asdict(SMALL)
    for stored in (sizes, {**sizes, "deforms": True}):
        text = json.dumps(description(architecture=stored))
        assert load_avatar(write(tmp_path / "a", avatar.tensors, text)).architecture == SMALL
    text = json.dumps(description(architecture={**sizes, "deforms": False}))
    assert "without a deformation" in complaint(write(tmp_path / "a", avatar.tensors, text))
    assert SMALL.to_dict() == {**sizes, "deforms": True}


def test_a_missing_file_and_a_folder(tmp_path):
    assert "no such avatar file" in complaint(tmp_path / "none.safetensors")
    complaint(tmp_path)


def test_a_path_that_no_file_can_have():
    with pytest.raises(InputError):
        load_avatar("a\0b")


def test_safetensors_of_another_program(avatar, tmp_path):
    assert "not an avatar" in complaint(write(tmp_path / "a", avatar.tensors, format="diffusion model"))
    (tmp_path / "b").write_bytes(save(avatar.tensors))
    assert "not an avatar" in complaint(tmp_path / "b")


@pytest.mark.parametrize(
    "text",
    [
        "",
        "{",
        "[]",
        "null",
        "7",
        '"text"',
        "[" * 100_000,
        json.dumps({"architecture": None}),
        json.dumps(description(architecture=[1, 2])),
        json.dumps(description(architecture={"unknown": 3})),
        json.dumps(description(architecture={**dataclasses.asdict(SMALL), "sdf_width": 10**9})),
        json.dumps(description(architecture={**dataclasses.asdict(SMALL), "sdf_width": 4096, "sdf_depth": 4096})),
        json.dumps(description(architecture={**dataclasses.asdict(SMALL), "sdf_width": -4})),
        json.dumps(description(architecture={**dataclasses.asdict(SMALL), "sdf_width": 32.0})),
        json.dumps(description(architecture={**dataclasses.asdict(SMALL), "sdf_width": "32"})),
        json.dumps(description(architecture={**dataclasses.asdict(SMALL), "sdf_octaves": 4096})),
        json.dumps(description(roughness=0.0)),
        json.dumps(description(roughness=float("nan"))),
        json.dumps(description(k_s=2)),
        json.dumps(description(k_r="much")),
        json.dumps(description(k_r=[1])),
        json.dumps(description(skin=[1])),
        json.dumps(description(skin={"radiance": 0.3})),
        json.dumps(description(skin={"radiance": 0.3, "deviations": [0.6]})),
        json.dumps(description(skin={"radiance": 0.0, "deviations": [0.6, 0.08]})),
        json.dumps(description(skin={"radiance": "much", "deviations": [0.6, 0.08]})),
        json.dumps(description(skin={"radiance": 0.3, "deviations": [0.6, 0.08], "mean": 7})),
        json.dumps({k: v for k, v in description().items() if k != "k_s"}),
        '{"roughness": ' + "9" * 5000 + "}",
    ],
)
def test_damaged_descriptions(avatar, tmp_path, text):
    complaint(write(tmp_path / "a.safetensors", avatar.tensors, text))


def test_a_file_without_a_description(avatar, tmp_path):
    path = tmp_path / "a.safetensors"
    path.write_bytes(save(avatar.tensors, metadata={"format": FORMAT}))
    complaint(path)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("reference", None),
        ("z_l", None),
        ("lobes", None),
        ("landmarks", None),
        ("extra", np.zeros(3, np.float32)),
        ("deformation", np.zeros(5, np.float32)),
        ("z_sdf", np.zeros((6, 1), np.float32)),
        ("z_sdf", np.zeros(6, np.float64)),
        ("z_sdf", np.zeros(6, np.int32)),
        ("z_sdf", np.zeros(6, np.float16)),
        ("z_sdf", np.full(6, np.nan, np.float32)),
        ("z_sdf", np.full(6, np.inf, np.float32)),
        ("lobes", np.zeros((0, 7), np.float32)),
        ("lobes", np.array(1.0, np.float32)),
        ("lobes", np.zeros(7, np.float32)),
        ("lobes", np.zeros((4, 6), np.float32)),
        ("lobes", np.zeros((5000, 7), np.float32)),
        ("landmarks", np.zeros((5, 3), np.float32)),
        ("landmarks", np.full((LANDMARKS, 3), np.inf, np.float32)),
    ],
)
def test_wrong_tensors(avatar, tmp_path, name, value):
    tensors = {k: v for k, v in avatar.tensors.items() if k != name}
    if value is not None:
        tensors[name] = value
    assert name in complaint(write(tmp_path / "a.safetensors", tensors)) or name == "lobes"


def test_a_tensor_type_that_numpy_lacks(avatar, tmp_path):
    """bfloat16, as other programs write it."""
    path = write(tmp_path / "a.safetensors", {**avatar.tensors, "z_sdf": np.zeros(6, np.float16)})
    path.write_bytes(path.read_bytes().replace(b'"F16"', b'"BF16"', 1).replace(b"  ", b" ", 1))
    complaint(path)


def test_unknown_landmarks_may_be_missing_values(avatar, tmp_path):
    path = tmp_path / "a.safetensors"
    save_avatar(path, avatar)
    assert np.isnan(load_avatar(path).tensors["landmarks"]).all()


def test_nothing_is_half_written(avatar, tmp_path):
    """Where the target is a folder, or lies in none."""
    target = tmp_path / "avatar.safetensors"
    target.mkdir()
    for path in (target, tmp_path / "missing" / "avatar.safetensors"):
        with pytest.raises(InputError) as caught:
            save_avatar(path, avatar)
        assert "\n" not in str(caught.value)
    assert [p.name for p in tmp_path.iterdir()] == [target.name] and not list(target.iterdir())


def test_an_older_file_survives_a_write_that_fails(avatar, tmp_path, monkeypatch):
    path = tmp_path / "avatar.safetensors"
    save_avatar(path, avatar)
    before = path.read_bytes()

    def full(self, data):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("pathlib.Path.write_bytes", full)
    with pytest.raises(InputError, match="No space left"):
        save_avatar(path, avatar.with_tensors(z_sdf=np.ones(6, np.float32)))
    assert path.read_bytes() == before and len(list(tmp_path.iterdir())) == 1


def test_sizes_are_checked_where_they_are_made():
    for wrong in ({"features": 0}, {"lobes": 5000}, {"sdf_width": 2.5}):
        with pytest.raises(ValueError, match="whole number"):
            AvatarArchitecture(**wrong)
