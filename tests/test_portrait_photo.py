"""Photo files: colour, orientation, profiles, EXIF data, and errors for bad files."""

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import OpenEXR
import pytest
import tifffile
from conftest import one_line
from PIL import Image, ImageCms, ImageOps

from sira_mi.colour import linear_to_srgb, srgb_to_linear
from sira_mi.errors import InputError
from sira_mi.portrait.load import load_photo
from sira_mi.portrait.portrait import PortraitSettings

SETTINGS = PortraitSettings(working_size=512)
ORIENTATION = 0x0112


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
    assert photo.alpha is not None
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


@pytest.mark.slow
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


ACES_AP0 = (0.7347, 0.2653, 0.0, 1.0, 0.0001, -0.077, 0.32168, 0.33767)
REC_2020 = (0.708, 0.292, 0.170, 0.797, 0.131, 0.046, 0.3127, 0.3290)


@pytest.mark.parametrize("name, chromaticities", [("ACES2065-1", ACES_AP0), ("ITU-R BT.2020", REC_2020)])
def test_exr_chromaticities_are_converted(tmp_path, name, chromaticities):
    import colour

    pixels = np.random.default_rng(2).uniform(0.3, 0.5, (40, 50, 3)).astype(np.float32)
    OpenEXR.File({"chromaticities": chromaticities}, {"RGB": pixels}).write(str(tmp_path / "wide.exr"))
    spaces = colour.RGB_COLOURSPACES
    matrix = colour.matrix_RGB_to_RGB(spaces[name], spaces["sRGB"], "Bradford")
    np.testing.assert_allclose(load_photo(tmp_path / "wide.exr").image, np.maximum(pixels @ matrix.T, 0), atol=1e-3)


def _exr_parts(**channels: dict[str, np.ndarray]) -> OpenEXR.File:
    return OpenEXR.File(
        [OpenEXR.Part({"name": n, "type": OpenEXR.scanlineimage}, planes) for n, planes in channels.items()]
    )


def test_exr_part_with_the_picture_is_read(tmp_path):
    path = tmp_path / "several.exr"
    depth, picture = {"Z": np.ones((64, 64), np.float32)}, {"RGB": np.full((64, 64, 3), 0.4, np.float32)}
    for parts in ({"a": depth, "b": picture}, {"a": picture, "b": depth}, {"a": {"Y": depth["Z"]}, "b": picture}):
        _exr_parts(**parts).write(str(path))
        np.testing.assert_allclose(load_photo(path).image, 0.4)
    _exr_parts(a={"Z": np.ones((64, 64), np.float32)}, b={"A": np.ones((64, 64), np.float32)}).write(str(path))
    with pytest.raises(InputError, match="no part has channels R, G, B or Y, only A, Z"):
        load_photo(path)


def test_exr_fills_its_display_window(tmp_path):
    """Pixels outside of the data window are black and transparent; those outside of the display window are cut off."""
    corner = np.array
    header = {"displayWindow": (corner([10, 20], np.int32), corner([109, 99], np.int32))}
    ramp = np.arange(60 * 70, dtype=np.float32).reshape(60, 70)
    path = tmp_path / "window.exr"
    for left, top in ((30, 25), (0, 0), (90, 70), (500, 500)):
        window = (corner([left, top], np.int32), corner([left + 69, top + 59], np.int32))
        OpenEXR.File({**header, "dataWindow": window}, {c: ramp for c in "RGB"}).write(str(path))
        expected = np.zeros((1000, 1000))
        expected[top : top + 60, left : left + 70] = ramp
        np.testing.assert_array_equal(load_photo(path).image[..., 1], expected[20:100, 10:110])


def test_exr_colours_are_divided_by_alpha(tmp_path):
    alpha = np.tile(np.linspace(0, 1, 64, dtype=np.float32), (64, 1))
    pixels = np.dstack([0.3 * alpha, 0.5 * alpha, 0.7 * alpha, alpha])
    OpenEXR.File({}, {"RGBA": pixels}).write(str(tmp_path / "cut.exr"))
    photo = load_photo(tmp_path / "cut.exr")
    np.testing.assert_allclose(photo.image[:, 1:], np.broadcast_to([0.3, 0.5, 0.7], (64, 63, 3)), rtol=1e-5)
    np.testing.assert_array_equal(photo.alpha, alpha)


def test_exr_that_cannot_be_taken_as_it_says_is_refused(tmp_path):
    """Anamorphic pixels, primaries of no RGB space, and more pixels than fit; the latter before they are decoded."""
    path = tmp_path / "odd.exr"
    grey = np.full((128, 64, 3), 0.3, np.float32)
    for header, words in (
        ({"pixelAspectRatio": 2.0}, "not square"),
        ({"chromaticities": (0.3, 0.3, 0.3, 0.3, 0.3, 0.3, 0.3, 0.3)}, "no RGB space"),
        ({"displayWindow": (np.array([0, 0], np.int32), np.array([15999, 7999], np.int32))}, "128 megapixels"),
    ):
        OpenEXR.File(header, {"RGB": grey}).write(str(path))
        with pytest.raises(InputError, match=words) as error:
            load_photo(path)
        one_line(error, str(path))


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
