"""The portrait front end on a photo: faces, masks, and the whole portrait."""

import cv2
import numpy as np
import OpenEXR
import pytest
import skimage.data
from conftest import a_camera, one_line
from PIL import Image

from sira_mi.colour import linear_to_srgb, srgb_to_linear
from sira_mi.conventions import LANDMARKS
from sira_mi.errors import InputError
from sira_mi.files import write_exr
from sira_mi.portrait.camera import estimate_camera, measure_reprojection_error
from sira_mi.portrait.face import find_faces, select_face
from sira_mi.portrait.load import load_photo
from sira_mi.portrait.mask import guided_filter, load_mask, segment_person
from sira_mi.portrait.portrait import Portrait, PortraitSettings, area_resample, halve, make_portrait

SETTINGS = PortraitSettings(working_size=512)
ORIENTATION = 0x0112


@pytest.fixture(scope="module")
def mask(astronaut, face):
    return segment_person(astronaut, face)


@pytest.fixture
def photo_file(tmp_path, astronaut):
    path = tmp_path / "photo.png"
    Image.fromarray(astronaut).save(path, compress_level=1)
    return path


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


@pytest.mark.slow
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
    found = segment_person(composite, find_faces(composite)[0]) > 0.5
    figure = alpha[..., 0] > 0.5
    assert (found & figure).sum() / (found | figure).sum() > 0.95


@pytest.mark.slow
def test_mask_keeps_only_the_chosen_person(astronaut):
    pair = np.concatenate([astronaut[:300, 80:380], astronaut[:300, 380:512], astronaut[:300, 80:380]], axis=1)
    faces = sorted(find_faces(pair), key=lambda f: f.box[0])
    for person, other in ((0, 1), (1, 0)):
        result = segment_person(pair, faces[person])
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


@pytest.fixture
def head_mask(face):
    """An ellipse around the test portrait's face, bool [512, 512]."""
    rows, columns = np.mgrid[:512, :512]
    left, top, right, bottom = face.box
    return ((columns - (left + right) / 2) / 80) ** 2 + ((rows - (top + bottom) / 2) / 110) ** 2 < 1


def as_cutout(astronaut, mask):
    return np.dstack([astronaut, mask * np.uint8(255)])


def as_premultiplied(astronaut, mask):
    return np.dstack([astronaut * mask[..., None], mask * np.uint8(255)])


def as_grey_cutout(astronaut, mask):
    grey = np.asarray(Image.fromarray(astronaut).convert("L"))
    return np.dstack([grey * mask, mask * np.uint8(255)])


def as_black_on_transparent(astronaut, mask):
    return np.dstack([np.zeros_like(astronaut), mask * np.uint8(255)])


def as_opaque(astronaut, mask):
    white = np.repeat(mask[..., None] * np.uint8(255), 3, axis=2)
    return np.dstack([white, np.full(mask.shape, 255, np.uint8)])


@pytest.mark.parametrize(
    "draw", [as_cutout, as_premultiplied, as_grey_cutout, as_black_on_transparent, as_opaque], ids=lambda f: f.__name__
)
def test_a_cutout_is_a_mask(tmp_path, photo_file, astronaut, head_mask, draw):
    """However dark the person in it is: its alpha counts."""
    picture = draw(astronaut, head_mask)
    Image.fromarray(picture).save(tmp_path / "mask.png", compress_level=1)
    np.testing.assert_array_equal(load_mask(tmp_path / "mask.png", load_photo(photo_file), 10**7), head_mask)


def test_pictures_that_are_no_masks_are_refused(tmp_path, photo_file, astronaut, head_mask):
    photo = load_photo(photo_file)
    cases = {
        "the photo": (astronaut, "picture in colour"),
        "the person on black": (astronaut * head_mask[..., None], "picture in colour"),
        "a red overlay": (np.where(head_mask[..., None], np.uint8([255, 0, 0]), astronaut), "picture in colour"),
        "the photo in grey": (np.asarray(Image.fromarray(astronaut).convert("L")), "mostly grey"),
        "labels": (head_mask.astype(np.uint8), "empty"),
        "nothing": (np.zeros((512, 512), np.uint8), "empty"),
        "transparent": (np.zeros((512, 512, 4), np.uint8), "empty"),
    }
    for name, (picture, words) in cases.items():
        Image.fromarray(picture).save(tmp_path / "mask.png", compress_level=1)
        with pytest.raises(InputError) as error:
            load_mask(tmp_path / "mask.png", photo, 10**7)
        one_line(error, "mask.png", words), name


def test_a_mask_beside_the_face_is_refused(tmp_path, photo_file, head, face, head_mask):
    """Inverted, or another person's, whether the face is found or known by the camera alone; one with a hand before
    the face is taken, and one of the whole photo with a note."""
    camera = estimate_camera(face.landmarks, head, 512, 512)
    (tmp_path / "camera.json").write_text(camera.to_json())
    Image.new("RGB", (512, 512)).save(tmp_path / "black.png")
    half = head_mask & (np.mgrid[:512, :512][1] < face.landmarks[:, 0].mean())
    cases = {"inverted": ~head_mask, "beside": np.roll(head_mask, 250, axis=1), "half": half, "all": head_mask | True}
    for name, mask in cases.items():
        Image.fromarray(mask).save(tmp_path / "mask.png")
        for photo, given in ((photo_file, {}), (tmp_path / "black.png", {"camera_path": tmp_path / "camera.json"})):
            if name in ("inverted", "beside"):
                with pytest.raises(InputError) as error:
                    make_portrait(photo, SETTINGS, head, tmp_path / "mask.png", **given)
                one_line(error, "mask.png", "is it inverted?")
            else:
                portrait = make_portrait(photo, SETTINGS, head, tmp_path / "mask.png", **given)
                np.testing.assert_array_equal(portrait.mask, mask)
                assert any("covers the whole photo" in note for note in portrait.notes) == (name == "all")


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


def test_half_a_portrait_shows_the_same():
    """Odd sizes too: what a pixel pair showed, its half pixel shows, and the camera sees points where they lie now."""
    rng = np.random.default_rng(0)
    camera = a_camera(size=(6, 7), focal=40.0)
    points = rng.uniform(-1, 1, (468, 3))
    mask = np.ones((7, 6), np.float32)
    mask[0, 5] = 0
    image = rng.uniform(size=(7, 6, 3)).astype(np.float32)
    half = halve(Portrait(image, mask, camera.project(points), camera.project(points), camera, ()))
    assert half.image.shape == (3, 3, 3) and half.image.mean() == pytest.approx(image.mean(), rel=1e-5)
    assert half.mask[0, 2] == 0 and half.mask.sum() == 8
    assert np.allclose(half.camera.project(points), half.landmarks) and np.allclose(half.landmarks, half.head_landmarks)
    assert np.allclose(half.landmarks, camera.project(points) * [3 / 6, 3 / 7])


@pytest.mark.slow
def test_portrait_of_the_test_photo(photo_file, head, astronaut, mask):
    portrait = make_portrait(photo_file, SETTINGS, head)
    np.testing.assert_allclose(portrait.image, srgb_to_linear(astronaut / 255.0), atol=1e-6)
    assert portrait.mask.shape == (512, 512) and portrait.landmarks.shape == (LANDMARKS, 2)
    assert np.array_equal(portrait.mask, mask)
    assert measure_reprojection_error(portrait.camera, portrait.head_landmarks, head) < 3
    assert portrait.camera.world_to_camera[2, 3] > 4 and portrait.window == (0, 0, 512, 512)
    again = make_portrait(photo_file, SETTINGS, head)
    assert np.array_equal(again.image, portrait.image) and np.array_equal(again.mask, portrait.mask)
    assert np.array_equal(again.landmarks, portrait.landmarks) and np.array_equal(again.camera.K, portrait.camera.K)


@pytest.mark.slow
def test_small_face_in_a_large_photo_is_cropped(tmp_path, head, astronaut, face):
    page = np.full((900, 1600, 3), 90, np.uint8)
    page[300:812, 900:1412] = astronaut
    Image.fromarray(page).save(tmp_path / "wide.png", compress_level=1)
    portrait = make_portrait(tmp_path / "wide.png", PortraitSettings(working_size=256), head)
    assert max(portrait.image.shape) <= 256 and any("cropped" in note for note in portrait.notes)
    size = np.ptp(portrait.landmarks, axis=0).max()
    assert size > 0.2 * 256
    x0, y0, x1, y1 = portrait.window
    scale = np.array([x1 - x0, y1 - y0]) / portrait.image.shape[1::-1]
    assert np.linalg.norm(portrait.landmarks * scale + [x0, y0] - face.landmarks - [900, 300], axis=1).mean() < 2
    np.testing.assert_allclose(portrait.camera.K[0, 0], portrait.camera.K[1, 1])
    assert measure_reprojection_error(portrait.camera, portrait.head_landmarks, head) < 0.03 * size
    relit = find_faces((linear_to_srgb(portrait.image) * 255 + 0.5).astype(np.uint8))[0]
    assert np.linalg.norm(relit.landmarks - portrait.landmarks, axis=1).mean() < 2
    assert portrait.mask[tuple(portrait.landmarks[1].astype(int)[::-1])] == 1


@pytest.mark.slow
def test_given_camera_is_made_square_and_follows_the_image(tmp_path, photo_file, head, astronaut, face):
    """A camera with K[0][0] != K[1][1]: landmarks and camera must agree in the resampled image."""
    camera = estimate_camera(face.landmarks, head, 512, 512)
    stretched = cv2.resize(astronaut, (1024, 768), interpolation=cv2.INTER_CUBIC)
    Image.fromarray(stretched).save(tmp_path / "stretched.png", compress_level=1)
    (tmp_path / "camera.json").write_text(camera.scale(2.0, 1.5).to_json())
    portrait = make_portrait(
        tmp_path / "stretched.png", PortraitSettings(working_size=400), head, camera_path=tmp_path / "camera.json"
    )
    assert portrait.camera.K[0, 0] == pytest.approx(portrait.camera.K[1, 1])
    assert portrait.image.shape == (400, 400, 3)
    assert measure_reprojection_error(portrait.camera, portrait.landmarks, head) < 2
    assert not any("away from the face" in note for note in portrait.notes)


@pytest.mark.slow
def test_no_face_needs_both_mask_and_camera(tmp_path, head):
    coffee = skimage.data.coffee()[:300, :400]
    photo, mask_path, camera_path = (tmp_path / name for name in ("coffee.png", "mask.png", "camera.json"))
    Image.fromarray(coffee).save(photo)
    Image.fromarray(np.pad(np.full((100, 100), 255, np.uint8), ((20, 180), (200, 100)))).save(mask_path)
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


@pytest.mark.slow
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


@pytest.mark.parametrize("factor", [1024.0, 1000.0, 2.0**-10])
def test_radiance_is_exposed_alike_in_every_unit(tmp_path, astronaut, head, head_mask, factor):
    """The portrait of an EXR is the same in another unit, to the bit where the unit is a power of two; what is coded
    for a display stays as it is."""
    Image.fromarray(head_mask).save(tmp_path / "mask.png")
    linear = srgb_to_linear(astronaut / 255.0).astype(np.float32)
    portraits = []
    for name, image in (("one.exr", linear), ("other.exr", linear * np.float32(factor))):
        write_exr(tmp_path / name, image)
        portraits.append(make_portrait(tmp_path / name, SETTINGS, head, tmp_path / "mask.png"))
    one, other = portraits
    assert other.exposure * factor == pytest.approx(one.exposure, rel=1e-6)
    np.testing.assert_allclose(one.image, linear * one.exposure, rtol=1e-6)
    np.testing.assert_allclose(other.image, one.image, rtol=1e-6)
    if factor != 1000:
        assert np.array_equal(other.image, one.image) and np.array_equal(other.landmarks, one.landmarks)
        assert np.array_equal(other.camera.K, one.camera.K)
    assert any("stores radiance" in note for note in other.notes)


@pytest.mark.slow
def test_exposures_of_coded_and_of_black_photos(tmp_path, astronaut, head, head_mask, face):
    """A dark photo that is coded for a display is not exposed anew, nor is a black one with radiance."""
    Image.fromarray(head_mask).save(tmp_path / "mask.png")
    (tmp_path / "camera.json").write_text(estimate_camera(face.landmarks, head, 512, 512).to_json())
    Image.fromarray(astronaut // 8).save(tmp_path / "dark.png")
    write_exr(tmp_path / "black.exr", np.zeros((512, 512, 3)))
    for name in ("dark.png", "black.exr"):
        given = tmp_path / "mask.png", tmp_path / "camera.json"
        assert make_portrait(tmp_path / name, SETTINGS, head, *given).exposure == 1
