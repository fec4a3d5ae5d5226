"""Protects the portrait front end: photo files, faces, masks and cameras, and what each says about bad input."""

import json
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import OpenEXR
import pytest
import skimage.data
import tifffile
from PIL import Image, ImageCms, ImageOps

from sira_mi.errors import InputError
from sira_mi.portrait import (
    Camera,
    PortraitSettings,
    estimate_camera,
    find_faces,
    linear_to_srgb,
    load_mask,
    load_photo,
    make_portrait,
    person_mask,
    reprojection_error,
    select_face,
    srgb_to_linear,
)
from sira_mi.portrait.face import LANDMARKS
from sira_mi.portrait.mask import guided_filter
from sira_mi.portrait.portrait import area_resample

SETTINGS = PortraitSettings(working_size=512)
ORIENTATION = 0x0112


@pytest.fixture(scope="module")
def astronaut():
    return skimage.data.astronaut()


@pytest.fixture(scope="module")
def face(astronaut):
    return find_faces(astronaut)[0]


@pytest.fixture(scope="module")
def head(face):
    """A head's landmarks [468, 3] in world units, back-projected from the network's relative depth."""
    eyes = face.landmarks[[33, 263]]
    scale = 0.9 / np.linalg.norm(eyes[1] - eyes[0])
    flat = (face.landmarks - eyes.mean(axis=0)) * scale
    return np.column_stack([flat[:, 0], -flat[:, 1], 0.8 - face.depth * scale])


@pytest.fixture(scope="module")
def mask(astronaut, face):
    return person_mask(astronaut, face)


@pytest.fixture
def photo_file(tmp_path, astronaut):
    path = tmp_path / "photo.png"
    Image.fromarray(astronaut).save(path, compress_level=1)
    return path


def one_line(error: pytest.ExceptionInfo, *words: str) -> None:
    message = str(error.value)
    assert "\n" not in message and len(message) < 700
    for word in words:
        assert word in message


# Colour and files


def test_srgb_decode_follows_the_standard(tmp_path):
    ramp = np.arange(256, dtype=np.float64).reshape(16, 16).repeat(2, 0).repeat(2, 1)
    Image.fromarray(ramp.astype(np.uint8)).convert("RGB").save(tmp_path / "ramp.png")
    coded = ramp / 255
    expected = np.where(coded <= 0.04045, coded / 12.92, ((coded + 0.055) / 1.055) ** 2.4)
    image = load_photo(tmp_path / "ramp.png").image
    assert image.dtype == np.float32
    np.testing.assert_allclose(image, expected[..., None].repeat(3, 2), atol=2e-7)
    np.testing.assert_allclose(linear_to_srgb(srgb_to_linear(coded)), coded, atol=1e-6)


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tif"])
def test_exif_orientation_against_pillow(tmp_path, astronaut, orientation, suffix):
    picture = Image.fromarray(astronaut[:140:2, :200:2])
    exif = Image.Exif()
    exif[ORIENTATION] = orientation
    path = tmp_path / f"turned{suffix}"
    picture.save(path, exif=exif, quality=95)
    with Image.open(path) as again:
        again.load()
        expected = np.asarray(ImageOps.exif_transpose(again))
    photo = load_photo(path)
    np.testing.assert_allclose(photo.image, srgb_to_linear(expected / 255.0), atol=1e-6)
    assert photo.stored_size == (100, 70) and photo.orientation == orientation
    assert photo.full_size == ((70, 100) if orientation >= 5 else (100, 70))


@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_16_bits_are_kept_and_oriented(tmp_path, orientation, suffix):
    rng = np.random.default_rng(3)
    pixels = rng.integers(0, 65536, (40, 60, 3), dtype=np.uint16)
    path = tmp_path / f"deep{suffix}"
    cv2.imwrite(str(path), pixels[..., ::-1])
    exif = Image.Exif()
    exif[ORIENTATION] = orientation
    if suffix == ".png":
        data = path.read_bytes()
        chunk = b"eXIf" + exif.tobytes()[6:]
        chunk = struct.pack(">I", len(chunk) - 4) + chunk + struct.pack(">I", zlib.crc32(chunk))
        path.write_bytes(data[:33] + chunk + data[33:])
    else:
        tifffile.imwrite(path, pixels, photometric="rgb", extratags=[(274, "H", 1, orientation, True)])
    expected = np.stack([_transposed(pixels[..., c], orientation) for c in range(3)], -1)
    photo = load_photo(path)
    np.testing.assert_allclose(photo.image, srgb_to_linear(expected / 65535.0), atol=1e-6)
    grey = tmp_path / "grey.png"
    cv2.imwrite(str(grey), pixels[..., 0])
    np.testing.assert_allclose(load_photo(grey).image[..., 1], srgb_to_linear(pixels[..., 0] / 65535.0), atol=1e-6)


def _transposed(plane: np.ndarray, orientation: int) -> np.ndarray:
    return {1: plane, 3: plane[::-1, ::-1], 6: np.rot90(plane, -1), 8: np.rot90(plane, 1)}[orientation]


def test_greyscale_palette_cmyk_and_alpha(tmp_path, astronaut):
    small = Image.fromarray(astronaut[:128, :160])
    expected = srgb_to_linear(np.asarray(small) / 255.0)

    small.convert("L").save(tmp_path / "grey.png")
    grey = load_photo(tmp_path / "grey.png").image
    assert np.ptp(grey, axis=2).max() == 0
    np.testing.assert_allclose(grey[..., 0], srgb_to_linear(np.asarray(small.convert("L")) / 255.0), atol=1e-6)

    small.quantize(64).save(tmp_path / "palette.png")
    assert np.abs(load_photo(tmp_path / "palette.png").image - expected).mean() < 0.03

    small.convert("CMYK").save(tmp_path / "cmyk.jpg", quality=95)
    photo = load_photo(tmp_path / "cmyk.jpg")
    assert np.abs(photo.image - expected).mean() < 0.03
    assert any("CMYK" in note for note in photo.notes)

    cut = small.copy()
    cut.putalpha(Image.fromarray(np.tile(np.arange(160, dtype=np.uint8), (128, 1))))
    cut.save(tmp_path / "alpha.png")
    photo = load_photo(tmp_path / "alpha.png")
    np.testing.assert_allclose(photo.alpha[5], np.arange(160) / 255, atol=1e-6)
    np.testing.assert_allclose(photo.image, expected, atol=1e-6)


def test_colour_profiles(tmp_path, astronaut):
    """A profile with swapped primaries must swap the channels; a broken one must be ignored with a note."""
    small = Image.fromarray(astronaut[:96, :96])
    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    swapped = bytearray(profile)
    tags = {profile[132 + 12 * i : 136 + 12 * i]: 132 + 12 * i for i in range(struct.unpack(">I", profile[128:132])[0])}
    swapped[tags[b"rXYZ"] : tags[b"rXYZ"] + 4], swapped[tags[b"bXYZ"] : tags[b"bXYZ"] + 4] = b"bXYZ", b"rXYZ"
    description = struct.unpack(">II", profile[tags[b"desc"] + 4 : tags[b"desc"] + 12])
    text = bytes(swapped[description[0] : sum(description)])
    swapped[description[0] : sum(description)] = text.replace("sRGB".encode("utf-16-be"), "odd!".encode("utf-16-be"))
    small.save(tmp_path / "swapped.png", icc_profile=bytes(swapped))
    image = load_photo(tmp_path / "swapped.png").image
    np.testing.assert_allclose(image, srgb_to_linear(np.asarray(small)[..., ::-1] / 255.0), atol=0.02)

    small.save(tmp_path / "plain.png", icc_profile=profile)
    plain = load_photo(tmp_path / "plain.png")
    np.testing.assert_allclose(plain.image, srgb_to_linear(np.asarray(small) / 255.0), atol=1e-6)
    assert not plain.notes
    small.save(tmp_path / "broken.jpg", icc_profile=b"not a profile at all" * 10)
    assert any("profile" in note for note in load_photo(tmp_path / "broken.jpg").notes)


def test_focal_length_and_damaged_exif(tmp_path, astronaut):
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA405] = 85
    picture = Image.fromarray(astronaut[:64, :64])
    picture.save(tmp_path / "lens.jpg", exif=exif)
    assert load_photo(tmp_path / "lens.jpg").focal_35mm == 85
    picture.save(tmp_path / "odd.jpg", exif=b"Exif\0\0II*\0\xff\xff\xff\x7f garbage")
    assert load_photo(tmp_path / "odd.jpg").focal_35mm is None


def test_huge_photo_is_averaged_in_linear_light(tmp_path):
    """62 megapixels of black and white columns: their linear mean is one half, their coded mean would be 0.21."""
    columns = np.zeros((7000, 8900), np.uint8)
    columns[:, ::2] = 255
    path = tmp_path / "huge.png"
    Image.fromarray(columns).save(path, compress_level=1)
    photo = load_photo(path)
    assert photo.reduction == 2 and photo.image.shape == (3500, 4450, 3)
    np.testing.assert_allclose(photo.image, 0.5, atol=1e-6)
    assert any("downscaled" in note and "8900x7000" in note for note in photo.notes)


def test_reduction_cuts_the_far_edge_after_orientation(tmp_path):
    pixels = np.zeros((41, 51, 3), np.uint8)
    pixels[0, :], pixels[:, 0] = 255, 255
    for orientation in range(1, 9):
        exif = Image.Exif()
        exif[ORIENTATION] = orientation
        path = tmp_path / f"{orientation}.png"
        Image.fromarray(pixels).save(path, exif=exif)
        full, reduced = load_photo(path), load_photo(path, max_pixels=600)
        assert reduced.reduction == 2
        height, width = reduced.image.shape[:2]
        blocks = full.image[: 2 * height, : 2 * width].reshape(height, 2, width, 2, 3).mean(axis=(1, 3))
        np.testing.assert_allclose(reduced.image, blocks, atol=1e-6)


def test_linear_exr_is_taken_as_it_is(tmp_path):
    pixels = np.random.default_rng(1).gamma(0.5, 3.0, (40, 50, 3)).astype(np.float32)
    pixels[3, 4, 0] = -0.25
    path = tmp_path / "ein Bild — später.exr"
    OpenEXR.File({}, {"RGB": pixels}).write(str(path))
    np.testing.assert_array_equal(load_photo(path).image, np.maximum(pixels, 0))
    for bad in (np.nan, np.inf):
        pixels[7, 7, 1] = bad
        OpenEXR.File({}, {"RGB": pixels}).write(str(path))
        with pytest.raises(InputError) as error:
            load_photo(path)
        one_line(error, "NaN")


def _bad_photos(folder: Path, astronaut: np.ndarray) -> dict[str, Path]:
    good = folder / "good.jpg"
    Image.fromarray(astronaut).save(good)
    deep = folder / "deep.png"
    cv2.imwrite(str(deep), astronaut.astype(np.uint16) * 257)
    exr = folder / "good.exr"
    OpenEXR.File({}, {"RGB": astronaut.astype(np.float32)}).write(str(exr))
    files = {
        "folder": folder,
        "missing": folder / "nowhere.png",
        "endless name": folder / ("a" * 300 + ".png"),
        "empty": folder / "empty.png",
        "text": folder / "text.jpg",
        "tiny": folder / "tiny.png",
        "float": folder / "float.tif",
    }
    files["empty"].write_bytes(b"")
    files["text"].write_text("this is no picture")
    Image.fromarray(astronaut[:20, :200]).save(files["tiny"])
    Image.fromarray(np.ones((64, 64), np.float32)).save(files["float"])
    tiffs = [folder / "plain.tif", folder / "packed.tif", folder / "deep.tif"]
    for path, compression in zip(tiffs, (None, "tiff_lzw"), strict=False):
        Image.fromarray(astronaut).save(path, compression=compression)
    cv2.imwrite(str(tiffs[2]), astronaut.astype(np.uint16) * 257)
    for source in (good, deep, exr, *tiffs):
        data = source.read_bytes()
        for share in (0.02, 0.6):
            files[f"{source.name} {share}"] = folder / f"cut at {share} {source.name}"
            files[f"{source.name} {share}"].write_bytes(data[: int(len(data) * share)])
    header = bytearray(
        b"BM" + struct.pack("<IHHI", 54, 0, 0, 54) + struct.pack("<IiiHHIIiiII", 40, 30000, 30000, 1, 24, *[0] * 6)
    )
    files["gigantic"] = folder / "gigantic.bmp"
    files["gigantic"].write_bytes(bytes(header))
    return files


def test_bad_photos_end_with_one_line(tmp_path, astronaut, capfd):
    """Nothing but the exception's line: the decoders' own complaints must not reach the terminal."""
    for name, path in _bad_photos(tmp_path, astronaut).items():
        with pytest.raises(InputError) as error:
            load_photo(path)
            pytest.fail(f"{name} was accepted")
        one_line(error, str(path))
    assert capfd.readouterr() == ("", "")


# Faces


def test_landmarks_lie_on_the_face(face):
    """Positions read off the public-domain test portrait by eye, to 4 pixels."""
    for index, expected in {33: (192, 101), 263: (259, 103), 1: (223, 129), 152: (221, 177), 61: (202, 139)}.items():
        assert np.abs(face.landmarks[index] - expected).max() < 4, index
    assert face.landmarks.shape == (LANDMARKS, 2) and face.presence > 0.99
    assert face.depth[1] < face.depth[234]


@pytest.mark.parametrize("factor", [0.3, 0.5, 2.0, 3.0])
def test_landmarks_follow_scaling(astronaut, face, factor):
    interpolation = cv2.INTER_AREA if factor < 1 else cv2.INTER_CUBIC
    scaled = cv2.resize(astronaut, None, fx=factor, fy=factor, interpolation=interpolation)
    moved = find_faces(scaled)[0].landmarks / factor
    assert np.linalg.norm(moved - face.landmarks, axis=1).mean() < (0.5 if factor >= 1 else 0.9 / factor)


def test_landmarks_follow_mirroring_shift_and_turn(astronaut, face):
    mirrored = find_faces(np.ascontiguousarray(astronaut[:, ::-1]))[0].landmarks
    for right, left in ((33, 263), (133, 362), (61, 291), (234, 454), (1, 1), (152, 152)):
        assert np.linalg.norm(mirrored[right] - [512 - face.landmarks[left, 0], face.landmarks[left, 1]]) < 3
    shifted = find_faces(np.pad(astronaut, ((60, 0), (30, 200), (0, 0))))[0].landmarks
    assert np.linalg.norm(shifted - face.landmarks - [30, 60], axis=1).mean() < 0.6
    turn = cv2.getRotationMatrix2D((224.5, 119.5), 25, 1.0)
    turned = find_faces(cv2.warpAffine(astronaut, turn, (512, 512), borderMode=cv2.BORDER_REFLECT))[0].landmarks
    expected = (face.landmarks - 0.5) @ turn[:, :2].T + turn[:, 2] + 0.5
    assert np.linalg.norm(turned - expected, axis=1).mean() < 1.0


def test_several_faces_largest_first(astronaut):
    page = np.full((700, 900, 3), 128, np.uint8)
    page[:512, :512] = astronaut
    for x, y, side in ((520, 20, 340), (560, 420, 230)):
        page[y : y + side, x : x + side] = cv2.resize(astronaut, (side, side), interpolation=cv2.INTER_AREA)
    faces = find_faces(page)
    np.testing.assert_allclose([f.size for f in faces], [108, 72, 48.5], rtol=0.06)
    chosen, notes = select_face(faces, None)
    assert chosen is faces[0] and any("3 faces" in note and "--face" in note for note in notes)
    chosen, notes = select_face(faces, 2)
    assert chosen is faces[2] and any("pixels tall" in note for note in notes)
    for index in (3, -1):
        with pytest.raises(InputError) as error:
            select_face(faces, index)
        one_line(error, "--face")


def test_close_up_and_no_face(astronaut, face):
    close = np.ascontiguousarray(astronaut[60:190, 165:285])
    found = find_faces(cv2.resize(close, None, fx=6, fy=6, interpolation=cv2.INTER_CUBIC))
    assert len(found) == 1
    assert np.linalg.norm(found[0].landmarks / 6 + [165, 60] - face.landmarks, axis=1).mean() < 2.5
    assert find_faces(skimage.data.coffee()) == []
    assert find_faces(np.zeros((40, 300, 3), np.uint8)) == []


# Masks


def test_mask_of_the_test_portrait(mask):
    """Hair, face, collar and suit are in; wall, flag and shuttle are out."""
    for x, y in ((225, 30), (165, 80), (288, 90), (225, 110), (140, 170), (225, 220), (120, 300), (300, 300)):
        assert mask[y, x] > 0.95, (x, y)
    for x, y in ((120, 60), (225, 8), (330, 100), (40, 100), (415, 60), (450, 280), (70, 180)):
        assert mask[y, x] < 0.05, (x, y)
    assert mask.dtype == np.float32 and mask.min() == 0 and mask.max() == 1
    assert 0.002 < ((mask > 0.05) & (mask < 0.95)).mean() < 0.012


def test_mask_agrees_with_a_composite(astronaut, mask):
    """The figure pasted onto another background: the mask found there must be the figure that was pasted."""
    alpha = mask[:360, 60:420, None]
    background = cv2.resize(skimage.data.coffee(), (360, 360), interpolation=cv2.INTER_AREA)
    linear = srgb_to_linear(astronaut[:360, 60:420] / 255.0) * alpha + srgb_to_linear(background / 255.0) * (1 - alpha)
    composite = (linear_to_srgb(linear) * 255 + 0.5).astype(np.uint8)
    found = person_mask(composite, find_faces(composite)[0]) > 0.5
    figure = alpha[..., 0] > 0.5
    assert (found & figure).sum() / (found | figure).sum() > 0.95


def test_mask_keeps_only_the_chosen_person(astronaut):
    pair = np.concatenate([astronaut[:300, 80:380], astronaut[:300, 380:512], astronaut[:300, 80:380]], axis=1)
    faces = sorted(find_faces(pair), key=lambda f: f.box[0])
    for person, other in ((0, 1), (1, 0)):
        result = person_mask(pair, faces[person])
        x, y = faces[person].landmarks.mean(axis=0).astype(int)
        assert result[y, x] == 1
        x, y = faces[other].landmarks.mean(axis=0).astype(int)
        assert result[y, x] == 0


def test_guided_filter_against_a_direct_solution():
    rng = np.random.default_rng(5)
    guide, values = rng.random((9, 9, 3)), rng.random((9, 9)).astype(np.float32)
    coefficients = np.zeros((9, 9, 4))
    for y in range(2, 7):
        for x in range(2, 7):
            colours = guide[y - 1 : y + 2, x - 1 : x + 2].reshape(-1, 3)
            targets = values[y - 1 : y + 2, x - 1 : x + 2].ravel()
            covariance = np.cov(colours.T, bias=True) + 0.01 * np.eye(3)
            slope = np.linalg.solve(covariance, ((colours - colours.mean(0)) * targets[:, None]).mean(0))
            coefficients[y, x] = [*slope, targets.mean() - slope @ colours.mean(0)]
    mean = coefficients[3:6, 3:6].mean(axis=(0, 1))
    assert guided_filter(guide, values, 1, 0.01)[4, 4] == pytest.approx(mean[:3] @ guide[4, 4] + mean[3], abs=1e-5)


def test_user_masks(tmp_path, astronaut):
    picture = Image.fromarray(astronaut[:200, :300])
    exif = Image.Exif()
    exif[ORIENTATION] = 6
    picture.save(tmp_path / "photo.jpg", exif=exif)
    photo = load_photo(tmp_path / "photo.jpg")
    stored = np.zeros((200, 300), np.uint8)
    stored[20:90, 40:100] = 255
    stored[100, 100] = 128
    Image.fromarray(stored).save(tmp_path / "stored.png")
    Image.fromarray(np.rot90(stored, -1).copy()).save(tmp_path / "turned.png")
    np.testing.assert_allclose(
        load_mask(tmp_path / "stored.png", photo, 10**7), np.rot90(stored, -1) / 255.0, atol=1e-6
    )
    np.testing.assert_array_equal(
        load_mask(tmp_path / "stored.png", photo, 10**7), load_mask(tmp_path / "turned.png", photo, 10**7)
    )
    Image.fromarray(stored[:150]).save(tmp_path / "wrong.png")
    Image.fromarray(np.full((200, 300), 100, np.uint8)).save(tmp_path / "dark.png")
    (tmp_path / "text.png").write_text("no mask")
    for name, words in {
        "wrong.png": ("300x150", "200x300"),
        "dark.png": ("empty",),
        "text.png": ("not an image",),
        "none.png": ("no such",),
    }.items():
        with pytest.raises(InputError) as error:
            load_mask(tmp_path / name, photo, 10**7)
        one_line(error, *words)


# Cameras


def a_camera(head=None, yaw=20.0, pitch=-8.0, roll=5.0, distance=9.0, focal=900.0, size=(640, 800)) -> Camera:
    turn = cv2.Rodrigues(np.radians([0, yaw, 0]))[0] @ cv2.Rodrigues(np.radians([pitch, 0, roll]))[0]
    pose = np.eye(4)
    pose[:3, :3] = np.diag([1.0, -1.0, -1.0]) @ turn
    pose[:3, 3] = (0.4, -0.7, distance)
    K = np.array([[focal, 0, size[0] / 2], [0, focal, size[1] / 2], [0, 0, 1.0]])
    return Camera(K, pose, *size)


def test_camera_projects_scales_and_crops(head):
    camera = a_camera()
    local = camera.world_to_camera @ np.append(head[5], 1)
    expected = np.array([900 * local[0] / local[2] + 320, 900 * local[1] / local[2] + 400])
    np.testing.assert_allclose(camera.project(head)[5], expected, rtol=1e-12)
    np.testing.assert_allclose(camera.scaled(0.5, 0.25).project(head), camera.project(head) * [0.5, 0.25])
    np.testing.assert_allclose(camera.cropped(30, 40, 100, 90).project(head), camera.project(head) - [30, 40])
    assert camera.scaled(0.5, 0.25).width == 320 and camera.cropped(30, 40, 100, 90).height == 90
    assert np.isnan(camera.project(camera.centre + camera.world_to_camera[2, :3] * -1)).all()


def test_camera_json_round_trip_is_exact():
    camera = a_camera(focal=np.pi * 300)
    again = Camera.from_json(camera.to_json(), size=(640, 800))
    np.testing.assert_array_equal(again.K, camera.K)
    np.testing.assert_array_equal(again.world_to_camera, camera.world_to_camera)
    assert (again.width, again.height) == (640, 800)


def test_malformed_cameras_are_named():
    good = a_camera().to_dict()

    def changed(key, index, value):
        data = json.loads(json.dumps(good))
        data[key][index[0]][index[1]] = value
        return json.dumps(data)

    scaled = json.loads(json.dumps(good))
    scaled["world_to_camera"] = (np.diag([2, 2, 2, 1.0]) @ np.array(good["world_to_camera"])).tolist()
    mirrored = json.loads(json.dumps(good))
    mirrored["world_to_camera"] = (np.diag([-1, 1, 1, 1.0]) @ np.array(good["world_to_camera"])).tolist()
    cases = {
        "{": "not JSON",
        "[" * 100_000: "not JSON",
        "[1, 2]": "object",
        json.dumps({**good, "K": [[1, 2], [3, 4]]}): "K must be 3x3",
        json.dumps({**good, "K": [[1, 2, 3], [4, 5], [6]]}): "K must be 3x3",
        json.dumps({**good, "K": "focal"}): "K must be 3x3",
        json.dumps({k: v for k, v in good.items() if k != "world_to_camera"}): "world_to_camera is missing",
        json.dumps({**good, "width": 640.5}): "width",
        json.dumps({**good, "height": -800}): "height",
        json.dumps({**good, "height": None}): "height",
        json.dumps({**good, "width": 800}): "800x800",
        changed("K", (0, 0), float("nan")): "NaN",
        changed("world_to_camera", (2, 3), float("inf")): "NaN or infinity",
        changed("K", (1, 1), -900.0): "positive",
        changed("K", (0, 1), 3.0): "skew",
        changed("K", (2, 2), 2.0): "K must be [[fx",
        changed("world_to_camera", (3, 3), 2.0): "last row",
        changed("world_to_camera", (0, 0), 0.2): "orthonormal",
        json.dumps(scaled): "orthonormal",
        json.dumps(mirrored): "mirrors",
    }
    for text, words in cases.items():
        with pytest.raises(InputError) as error:
            Camera.from_json(text, "camera.json", (640, 800))
        one_line(error, "camera.json", words)


@pytest.mark.parametrize(
    "yaw, pitch, roll, distance", [(0, 0, 0, 5), (25, -10, 8, 9), (-40, 15, -20, 20), (10, 5, 80, 12)]
)
def test_known_focal_length_gives_pose_and_distance(head, yaw, pitch, roll, distance):
    camera = a_camera(yaw=yaw, pitch=pitch, roll=roll, distance=distance, focal=1500.0)
    pixels = camera.project(head) + np.random.default_rng(4).normal(0, 0.5, (LANDMARKS, 2))
    pixels[7] = np.nan
    found = estimate_camera(pixels, head, 640, 800, 1500.0 * 43.2666 / np.hypot(640, 800))
    assert found.K[0, 0] == pytest.approx(1500.0)
    turn = found.world_to_camera[:3, :3] @ camera.world_to_camera[:3, :3].T
    assert np.degrees(np.arccos((np.trace(turn) - 1) / 2)) < 0.5
    assert np.linalg.norm(found.centre) == pytest.approx(np.linalg.norm(camera.centre), rel=0.02)
    assert reprojection_error(found, pixels, head) < 1.0


def test_unknown_focal_length_stays_near_the_prior_and_fits(head):
    """A head flatter or deeper than the mean imitates another distance: the prior must hold, yet a photo taken from
    near must come out nearer than one from afar."""
    found = {}
    for distance in (6.0, 12.0, 25.0):
        for depth in (0.7, 1.0, 1.4):
            camera = a_camera(yaw=5.0, distance=distance, focal=110.0 * distance)
            pixels = camera.project(head * [1, 1, depth])
            estimate = estimate_camera(pixels, head, 640, 800)
            assert reprojection_error(estimate, pixels, head) < 1.0
            assert estimate.K[0, 0] == estimate.K[1, 1] and tuple(estimate.K[:2, 2]) == (320, 400)
            found[distance, depth] = np.linalg.norm(estimate.centre)
    assert all(8.5 < found[12.0, depth] < 15.0 for depth in (0.7, 1.0, 1.4))
    assert found[12.0, 1.0] == pytest.approx(12.0, rel=0.01)
    assert 5.5 < found[6.0, 1.0] < 8.5 and 12.5 < found[25.0, 1.0] < 26.0


def test_outliers_hardly_move_the_camera(head):
    camera = a_camera(focal=1500.0)
    pixels = camera.project(head)
    pixels[[61, 291, 13, 14, 152, 148]] += 40
    found = estimate_camera(pixels, head, 640, 800, 1500.0 * 43.2666 / np.hypot(640, 800))
    turn = found.world_to_camera[:3, :3] @ camera.world_to_camera[:3, :3].T
    assert np.degrees(np.arccos((np.trace(turn) - 1) / 2)) < 1.0
    with pytest.raises(ValueError, match="6 are needed"):
        estimate_camera(np.full((LANDMARKS, 2), np.nan), head, 640, 800)


# The whole front end


def test_area_resample_keeps_means_and_positions():
    image = np.random.default_rng(8).random((37, 53, 3)).astype(np.float32)
    half = area_resample(image[:36, :52], (0, 0), (0.5, 0.5), (26, 18))
    np.testing.assert_allclose(half, image[:36, :52].reshape(18, 2, 26, 2, 3).mean(axis=(1, 3)), atol=1e-6)
    np.testing.assert_array_equal(area_resample(image, (0, 0), (1, 1), (53, 37)), image)
    np.testing.assert_array_equal(area_resample(image, (5, 3), (1, 1), (20, 10)), image[3:13, 5:25])
    integral = np.concatenate([[0], np.cumsum(image[7, :, 0], dtype=np.float64)])
    edges = np.interp(4.3 + np.arange(18) / 0.37, np.arange(54), integral)
    rows = area_resample(image[7:8, :, 0], (4.3, 0), (0.37, 1.0), (17, 1))
    np.testing.assert_allclose(rows[0], np.diff(edges) * 0.37, atol=1e-5)


def test_portrait_of_the_test_photo(photo_file, head, astronaut, mask):
    portrait = make_portrait(photo_file, SETTINGS, head)
    np.testing.assert_allclose(portrait.image, srgb_to_linear(astronaut / 255.0), atol=1e-6)
    assert portrait.mask.shape == (512, 512) and portrait.landmarks.shape == (LANDMARKS, 2)
    assert np.array_equal(portrait.mask, mask)
    assert reprojection_error(portrait.camera, portrait.landmarks, head) < 2
    assert portrait.camera.world_to_camera[2, 3] > 4
    again = make_portrait(photo_file, SETTINGS, head)
    assert np.array_equal(again.image, portrait.image) and np.array_equal(again.mask, portrait.mask)
    assert np.array_equal(again.landmarks, portrait.landmarks) and np.array_equal(again.camera.K, portrait.camera.K)


def test_small_face_in_a_large_photo_is_cropped(tmp_path, head, astronaut, face):
    page = np.full((900, 1600, 3), 90, np.uint8)
    page[300:812, 900:1412] = astronaut
    Image.fromarray(page).save(tmp_path / "wide.png", compress_level=1)
    portrait = make_portrait(tmp_path / "wide.png", PortraitSettings(working_size=256), head)
    assert max(portrait.image.shape) <= 256 and any("cropped" in note for note in portrait.notes)
    size = np.ptp(portrait.landmarks, axis=0).max()
    assert size > 0.2 * 256
    np.testing.assert_allclose(portrait.camera.K[0, 0], portrait.camera.K[1, 1])
    assert reprojection_error(portrait.camera, portrait.landmarks, head) < 0.03 * size
    relit = find_faces((linear_to_srgb(portrait.image) * 255 + 0.5).astype(np.uint8))[0]
    assert np.linalg.norm(relit.landmarks - portrait.landmarks, axis=1).mean() < 2
    assert portrait.mask[tuple(portrait.landmarks[1].astype(int)[::-1])] == 1


def test_given_camera_is_made_square_and_follows_the_image(tmp_path, photo_file, head, astronaut, face):
    """A camera with K[0][0] != K[1][1]: landmarks and camera must agree in the resampled image."""
    camera = estimate_camera(face.landmarks, head, 512, 512)
    stretched = cv2.resize(astronaut, (1024, 768), interpolation=cv2.INTER_CUBIC)
    Image.fromarray(stretched).save(tmp_path / "stretched.png", compress_level=1)
    (tmp_path / "camera.json").write_text(camera.scaled(2.0, 1.5).to_json())
    portrait = make_portrait(
        tmp_path / "stretched.png", PortraitSettings(working_size=400), head, camera_path=tmp_path / "camera.json"
    )
    assert portrait.camera.K[0, 0] == pytest.approx(portrait.camera.K[1, 1])
    assert portrait.image.shape == (400, 400, 3)
    assert reprojection_error(portrait.camera, portrait.landmarks, head) < 2
    assert not any("away from the face" in note for note in portrait.notes)


def test_no_face_needs_both_mask_and_camera(tmp_path, head):
    coffee = skimage.data.coffee()[:300, :400]
    photo, mask_path, camera_path = (tmp_path / name for name in ("coffee.png", "mask.png", "camera.json"))
    Image.fromarray(coffee).save(photo)
    Image.fromarray(np.pad(np.full((100, 100), 255, np.uint8), ((100, 100), (150, 150)))).save(mask_path)
    camera_path.write_text(a_camera(size=(400, 300)).to_json())
    for given in ({}, {"mask_path": mask_path}, {"camera_path": camera_path}):
        with pytest.raises(InputError) as error:
            make_portrait(photo, SETTINGS, head, **given)
        one_line(error, "no face")
    portrait = make_portrait(photo, SETTINGS, head, mask_path, camera_path)
    assert np.isnan(portrait.landmarks).all() and any("no face" in note for note in portrait.notes)
    assert portrait.mask.sum() == 100 * 100
    camera_path.write_text(a_camera(size=(300, 400)).to_json())
    with pytest.raises(InputError) as error:
        make_portrait(photo, SETTINGS, head, mask_path, camera_path)
    one_line(error, "300x400", "400x300")
    camera_path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError):
        make_portrait(photo, SETTINGS, head, mask_path, camera_path)


def test_photo_alpha_becomes_the_mask(tmp_path, astronaut, head):
    """Also: a path with spaces and non-ASCII letters."""
    alpha = np.zeros((512, 512), np.uint8)
    alpha[20:300, 140:320] = 255
    path = tmp_path / "Bild meiner Großmutter 祖母.png"
    Image.fromarray(np.dstack([astronaut, alpha])).save(path, compress_level=1)
    portrait = make_portrait(path, SETTINGS, head)
    np.testing.assert_array_equal(portrait.mask, alpha / np.float32(255))
    assert any("alpha" in note for note in portrait.notes)


def test_exif_rotated_cmyk_and_dark_exr_photos_give_the_same_face(tmp_path, astronaut, head, face):
    exif = Image.Exif()
    exif[ORIENTATION] = 6
    Image.fromarray(np.rot90(astronaut, 1).copy()).save(tmp_path / "turned.jpg", exif=exif, quality=95)
    Image.fromarray(astronaut).convert("CMYK").save(tmp_path / "cmyk.jpg", quality=95)
    OpenEXR.File({}, {"RGB": srgb_to_linear(astronaut / 255.0) * np.float32(0.02)}).write(str(tmp_path / "dark.exr"))
    Image.fromarray(astronaut).convert("L").save(tmp_path / "grey.jpg", quality=95)
    for name in ("turned.jpg", "cmyk.jpg", "dark.exr", "grey.jpg"):
        portrait = make_portrait(tmp_path / name, PortraitSettings(working_size=256), head)
        assert np.linalg.norm(portrait.landmarks * 2 - face.landmarks, axis=1).mean() < 2.5, name
        assert portrait.mask[20:40, 100:130].mean() > 0.9 and portrait.mask[:60, 180:].mean() < 0.05, name
