"""Photo files: colour, orientation, profiles, EXIF data, and errors for bad files."""

import base64
import os
import struct
import zlib
from concurrent.futures import ThreadPoolExecutor
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
HEIC = (  # 64 x 64 pixels, in base 85
    "0000SW^{RQXk}?*00000ZE0pPXk}?*ZE0a<00042ZDn*}000000000XXk=`10000000000aA{+700000000000000000000B57=IV*mgE07O"
    "6l0RRC200001dH?|c00000007JY001LtX>Mi!000000RR916=`l}WdZ;I000310BCk&F#rGn01j|zbZr0t000010002iX>f9I0002DX>en20"
    "001ZXm(>m0RwOV0058x000009`FGC{rLC*01pFT0096PKmiN^|NjGU00093kN^M!000939=ZZRVE_RDD?$MQ18@KU0|1Z!00RI30{|YNAb|y"
    "z>PacCZUPz%2mk;B0LTCU0{{p>VgLaE2SfqEa<C#m0000JV{dG7ZewhC0096E00w{n000zeb8uw<00000002M$002M$000nhX?SS>000032n"
    "YxO000+haBX1#00000000310R({p0|Wp70Mu<{VRQfh0LUl-uMXhu&PJVb@;rX{sEeDwHs^45M#E10f77s=!i|@xql=|!pLY=Wo63DZB?VLS"
    "rQBwMIBn-uy3{B}c6Qf+7bOsry7ORFV96KU*gvXaAUEaM1i1&*4YiixuOJloQ-t{SOkv7<R4?lPNxM>PO@W98bk3YI^N)VTbOhqboCwqls%S"
    "zk+PWWAlVmIk2U6KhPi`f=$a5kY5EKEWE+8n4dl{8l4ZD+E#5N6jrcnq=^M>LrB)cz8=uYG~;;igeknj"
)


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


@pytest.mark.parametrize("suffix", ["png", "tif", "ppm", "jp2"])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_all_bits_are_kept(tmp_path, suffix, dtype):
    """Without EXIF data too, which Pillow decodes a PNG to look for."""
    import OpenImageIO as oiio

    rng = np.random.default_rng(8)
    for channels in (1, 3):
        pixels = rng.integers(0, np.iinfo(dtype).max, (40, 50, channels)).astype(dtype)
        path = tmp_path / f"photo.{suffix}"
        output = oiio.ImageOutput.create(str(path))
        output.open(str(path), oiio.ImageSpec(50, 40, channels, oiio.UINT8 if dtype == np.uint8 else oiio.UINT16))
        assert output.write_image(pixels) and output.close()
        expected = np.broadcast_to(srgb_to_linear(pixels / np.iinfo(dtype).max), (40, 50, 3))
        np.testing.assert_allclose(load_photo(path).image, expected, atol=1e-6)


def _profile(curve: bytes, name: str = "test", kind: bytes = b"RGB ") -> bytes:
    """An ICC profile of sRGB's primaries with one curve for all channels."""

    def fixed(*values: float) -> bytes:
        return struct.pack(f">{len(values)}i", *(round(v * 65536) for v in values))

    def xyz(*values: float) -> bytes:
        return b"XYZ \0\0\0\0" + fixed(*values)

    text = name.encode() + b"\0"
    tags = {
        b"desc": b"desc" + bytes(4) + struct.pack(">I", len(text)) + text + bytes(78),
        b"wtpt": xyz(0.9642, 1.0, 0.8249),
    }
    if kind == b"RGB ":
        tags |= {b"rXYZ": xyz(0.43607, 0.22249, 0.01392), b"gXYZ": xyz(0.38515, 0.71687, 0.09708)}
        tags |= {b"bXYZ": xyz(0.14307, 0.06061, 0.71410), b"rTRC": curve, b"gTRC": curve, b"bTRC": curve}
    else:
        tags[b"kTRC"] = curve
    place, table, body = 132 + 12 * len(tags), struct.pack(">I", len(tags)), b""
    for key, data in tags.items():
        data += bytes(-len(data) % 4)
        table += key + struct.pack(">II", place + len(body), len(data))
        body += data
    head = struct.pack(">I4sI4s4s4s12x4s", place + len(body), bytes(4), 0x02400000, b"mntr", kind, b"XYZ ", b"acsp")
    head += bytes(68 - len(head)) + fixed(0.9642, 1, 0.8249)
    return head.ljust(128, b"\0") + table + body


def _parametric(kind: int, *numbers: float) -> bytes:
    fixed = struct.pack(f">{len(numbers)}i", *(round(v * 65536) for v in numbers))
    return b"para" + bytes(4) + struct.pack(">HH", kind, 0) + fixed


LINEAR = b"curv" + bytes(8)
ADOBE = b"curv" + bytes(4) + struct.pack(">IH", 1, 0x0233)
TABLE = b"curv" + bytes(4) + struct.pack(">I1024H", 1024, *(round((i / 1023) ** 1.8 * 65535) for i in range(1024)))
CURVES = {
    "linear": (LINEAR, lambda v: v),
    "gamma": (ADOBE, lambda v: v ** (0x0233 / 256)),
    "table": (TABLE, lambda v: v**1.8),
    "parametric 0": (_parametric(0, 1.8), lambda v: v**1.8),
    "parametric 1": (_parametric(1, 2, 0.9, 0.1), lambda v: (0.9 * v + 0.1) ** 2),
    "parametric 2": (_parametric(2, 2, 0.9, 0.1, -0.01), lambda v: (0.9 * v + 0.1) ** 2 - 0.01),
    "parametric 3": (_parametric(3, 2.4, 1 / 1.055, 0.055 / 1.055, 1 / 12.92, 0.04045), srgb_to_linear),
    "parametric 4": (_parametric(4, 2, 0.8, 0.1, 0.2, 0.1, 0.19, 0), lambda v: (0.8 * v + 0.1) ** 2 + 0.19),
}


@pytest.mark.parametrize("name", CURVES)
@pytest.mark.parametrize("kind", [b"RGB ", b"GRAY"])
def test_profiles_are_taken_by_their_curve(tmp_path, name, kind):
    """At 8 bits by Pillow's colour management, at 16 to the curve's own accuracy, whatever the profile is called."""
    curve, decode = CURVES[name]
    levels = np.linspace(0.15, 0.95, 64)
    for title in ("plain", "Built-in linear sRGB"):
        icc = _profile(curve, title, kind)
        shallow = np.tile((levels * 255).astype(np.uint8), (64, 1))
        picture = Image.fromarray(shallow)
        (picture if kind == b"GRAY" else picture.convert("RGB")).save(tmp_path / "8.png", icc_profile=icc)
        np.testing.assert_allclose(load_photo(tmp_path / "8.png").image[..., 1], decode(shallow / 255.0), atol=0.012)
        deep = np.tile((levels * 65535).astype(np.uint16), (64, 1))
        colours = {"photometric": "minisblack"} if kind == b"GRAY" else {"photometric": "rgb"}
        pixels = deep if kind == b"GRAY" else np.dstack([deep] * 3)
        tifffile.imwrite(tmp_path / "16.tif", pixels, iccprofile=icc, **colours)
        photo = load_photo(tmp_path / "16.tif")
        np.testing.assert_allclose(photo.image[..., 1], decode(deep / 65535.0), atol=2e-4)
        assert not photo.notes


def _png(path: Path, pixels: np.ndarray, *chunks: tuple[bytes, bytes]) -> Path:
    """A PNG of uint8 or uint16 RGB pixels with more chunks."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    height, width, _ = pixels.shape
    rows = b"".join(b"\0" + row.astype(pixels.dtype.newbyteorder(">")).tobytes() for row in pixels)
    data = [(b"IHDR", struct.pack(">IIBBBBB", width, height, 8 * pixels.itemsize, 2, 0, 0, 0)), *chunks]
    data += [(b"IDAT", zlib.compress(rows)), (b"IEND", b"")]
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(chunk(*each) for each in data))
    return path


def _gama(value: float) -> tuple[bytes, bytes]:
    return b"gAMA", struct.pack(">I", round(value * 1e5))


def _chrm(*red_green_blue_white: float) -> tuple[bytes, bytes]:
    *colours, x, y = (round(v * 1e5) for v in red_green_blue_white)
    return b"cHRM", struct.pack(">8I", x, y, *colours)


REC_709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
DISPLAY_P3 = (0.680, 0.320, 0.265, 0.690, 0.150, 0.060, 0.3127, 0.3290)
PNG_CHUNKS = {
    "nothing": ([], "sRGB", srgb_to_linear),
    "linear": ([_gama(1.0)], "sRGB", lambda v: v),
    "gamma 1.8": ([_gama(1 / 1.8)], "sRGB", lambda v: v**1.8),
    "sRGB in the old way": ([_gama(0.45455), _chrm(*REC_709)], "sRGB", srgb_to_linear),
    "sRGB goes before gAMA": ([(b"sRGB", b"\0"), _gama(1.0)], "sRGB", srgb_to_linear),
    "primaries": ([_gama(0.45455), _chrm(*DISPLAY_P3)], "Display P3", srgb_to_linear),
    "cICP goes before all": ([(b"cICP", bytes([12, 13, 0, 1])), _gama(1.0)], "Display P3", srgb_to_linear),
    "cICP of linear Rec.2020": ([(b"cICP", bytes([9, 8, 0, 1]))], "ITU-R BT.2020", lambda v: v),
    "cICP of a power": ([(b"cICP", bytes([1, 4, 0, 1]))], "sRGB", lambda v: v**2.2),
    "cICP of BT.709": ([(b"cICP", bytes([1, 1, 0, 1]))], "sRGB", "ITU-R BT.709"),
}


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("name", PNG_CHUNKS)
def test_png_colour_chunks_are_obeyed(tmp_path, name, dtype):
    import colour

    chunks, space, decode = PNG_CHUNKS[name]
    if decode == "ITU-R BT.709":
        decode = colour.models.oetf_inverse_BT709
    largest = np.iinfo(dtype).max
    pixels = np.random.default_rng(5).integers(largest // 3, largest // 2, (40, 50, 3)).astype(dtype)
    photo = load_photo(_png(tmp_path / "photo.png", pixels, *chunks))
    spaces = colour.RGB_COLOURSPACES
    matrix = colour.matrix_RGB_to_RGB(spaces[space], spaces["sRGB"], "Bradford")
    np.testing.assert_allclose(photo.image, decode(pixels / largest) @ matrix.T, atol=3e-4)
    assert not photo.notes


def test_png_of_video_or_nonsense_is_refused_or_noted(tmp_path):
    grey = np.full((64, 64, 3), 100, np.uint8)
    refused = {"PQ": [9, 16, 0, 1], "HLG": [9, 18, 0, 1], "video": [1, 13, 1, 1], "unusual": [10, 13, 0, 1]}
    for words, code in refused.items():
        with pytest.raises(InputError, match=words) as error:
            load_photo(_png(tmp_path / "video.png", grey, (b"cICP", bytes(code))))
        one_line(error, "video.png")
    noted = [(_gama(0.0001), "gAMA"), (_gama(40), "gAMA"), (_chrm(*[0.3] * 8), "cHRM"), (_chrm(*[0] * 8), "cHRM")]
    for chunk, word in noted:
        photo = load_photo(_png(tmp_path / "odd.png", grey, chunk))
        assert any(word in note for note in photo.notes)
        np.testing.assert_allclose(photo.image, srgb_to_linear(100 / 255), rtol=1e-6)


RGB_TIFF = np.random.default_rng(6).integers(0, 65536, (48, 64, 3)).astype(np.uint16)
ALPHA_TIFF = np.tile(np.linspace(16000, 65535, 64).astype(np.uint16), (48, 1))
TIFFS = {
    "rgb": (RGB_TIFF, {"photometric": "rgb"}),
    "planes": (RGB_TIFF.transpose(2, 0, 1), {"photometric": "rgb", "planarconfig": "separate"}),
    "tiles": (RGB_TIFF, {"photometric": "rgb", "tile": (32, 32)}),
    "predictor": (RGB_TIFF, {"photometric": "rgb", "compression": "zlib", "predictor": True}),
    "big endian": (RGB_TIFF, {"photometric": "rgb", "byteorder": ">"}),
    "unused channel": (np.dstack([RGB_TIFF, ALPHA_TIFF]), {"photometric": "rgb", "extrasamples": ["unspecified"]}),
    "alpha": (np.dstack([RGB_TIFF, ALPHA_TIFF]), {"photometric": "rgb", "extrasamples": ["unassalpha"]}),
    "alpha in planes": (
        np.dstack([RGB_TIFF, ALPHA_TIFF]).transpose(2, 0, 1),
        {"photometric": "rgb", "planarconfig": "separate", "extrasamples": ["unassalpha"]},
    ),
    "black is zero": (RGB_TIFF[..., 0], {"photometric": "minisblack"}),
    "white is zero": (65535 - RGB_TIFF[..., 0], {"photometric": "miniswhite"}),
}


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("name", TIFFS)
def test_tiff_layouts(tmp_path, name, bits):
    pixels, options = TIFFS[name]
    stored = pixels if bits == 16 else (pixels >> 8).astype(np.uint8)
    tifffile.imwrite(tmp_path / "photo.tif", stored, **options)
    photo = load_photo(tmp_path / "photo.tif")
    coded = RGB_TIFF if bits == 16 else RGB_TIFF >> 8
    if pixels.ndim == 2:
        coded = np.repeat(coded[..., :1], 3, 2)
    np.testing.assert_allclose(photo.image, srgb_to_linear(coded / (2.0**bits - 1)), atol=1e-6)
    assert (photo.alpha is not None) == ("unassalpha" in options.get("extrasamples", []))
    if photo.alpha is not None:
        np.testing.assert_allclose(photo.alpha, ALPHA_TIFF / 65535, atol=4e-3)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_premultiplied_tiff_is_divided_by_alpha(tmp_path, dtype):
    largest = np.iinfo(dtype).max
    alpha = np.linspace(0, 1, 64)
    planes = [level * alpha * largest for level in (0.3, 0.5, 0.7)] + [alpha * largest]
    pixels = np.tile(np.stack(planes, -1)[None] + 0.5, (48, 1, 1)).astype(dtype)
    tifffile.imwrite(tmp_path / "cut.tif", pixels, photometric="rgb", extrasamples=["assocalpha"])
    image = load_photo(tmp_path / "cut.tif").image[:, 32:]
    expected = np.broadcast_to(srgb_to_linear(np.array([0.3, 0.5, 0.7])), image.shape)
    np.testing.assert_allclose(image, expected, atol=0.02 if dtype == np.uint8 else 1e-4)


def test_thumbnails_and_pages(tmp_path, astronaut):
    """The picture is read and not its thumbnail; of several pictures the first is read, with a note; camera raw data
    are refused."""
    path = tmp_path / "several.tif"
    for dtype in (np.uint8, np.uint16):
        full = astronaut[:128, :160].astype(dtype) * (257 if dtype == np.uint16 else 1)
        with tifffile.TiffWriter(path) as file:
            file.write(full[::4, ::4], photometric="rgb", subfiletype=1)
            file.write(full, photometric="rgb", subfiletype=0)
        photo = load_photo(path)
        np.testing.assert_allclose(photo.image, srgb_to_linear(astronaut[:128, :160] / 255), atol=1e-6)
        assert photo.full_size == (160, 128) and any("number 2" in note for note in photo.notes)
    small = Image.fromarray(astronaut[:64, :64])
    for suffix in ("tif", "gif", "webp", "png"):
        path = tmp_path / f"pages.{suffix}"
        small.save(path, save_all=True, append_images=[small.rotate(90)])
        assert any("holds 2 pictures" in note for note in load_photo(path).notes), suffix
    with tifffile.TiffWriter(tmp_path / "raw.dng") as file:
        file.write(astronaut[:64, :96], photometric="rgb", subfiletype=1)
    (tmp_path / "raw.cr2").write_bytes(b"II*\0\x10\0\0\0CR\2\0" + bytes(100))
    for name in ("raw.dng", "raw.cr2"):
        with pytest.raises(InputError, match="raw") as error:
            load_photo(tmp_path / name)
        one_line(error, name)


def test_pixels_that_are_not_square_are_noted(tmp_path, astronaut):
    small = Image.fromarray(astronaut[:64, :64])
    for suffix in ("png", "jpg", "tif"):
        small.save(tmp_path / f"wide.{suffix}", dpi=(100, 200))
        assert any("not square" in note for note in load_photo(tmp_path / f"wide.{suffix}").notes)
        small.save(tmp_path / f"square.{suffix}", dpi=(200, 200))
        assert not load_photo(tmp_path / f"square.{suffix}").notes


@pytest.mark.parametrize(
    "size, focal, word",
    [
        ((96, 64), 26, None),
        ((64, 96), 26, None),
        ((4032, 2688), 26, "scaled"),
        ((4032, 3024), None, "cropped"),
        ((3024, 4032), None, "cropped"),
        ((96, 0), 26, None),
    ],
)
def test_exif_of_other_pixels(tmp_path, astronaut, size, focal, word):
    """A focal length in EXIF data belongs to the frame that it was taken with; editors keep it in crops."""
    exif = Image.Exif()
    exif.get_ifd(0x8769).update({0xA405: 26, 0xA002: size[0], 0xA003: size[1]})
    Image.fromarray(astronaut[:64, :96]).save(tmp_path / "photo.jpg", exif=exif)
    photo = load_photo(tmp_path / "photo.jpg")
    assert photo.focal_35mm == focal
    assert [word in note for note in photo.notes] == ([True] if word else [])


def test_phone_formats(tmp_path, astronaut):
    """HEIC and AVIF, within the loss of their compression."""
    y, x = np.mgrid[:64, :64]
    expected = srgb_to_linear(np.dstack([x * 2 + 60, y * 3, np.full_like(x, 90)]) / 255)
    (tmp_path / "photo.heic").write_bytes(base64.b85decode(HEIC))
    photo = load_photo(tmp_path / "photo.heic")
    assert np.abs(photo.image - expected).mean() < 0.01 and not photo.notes
    Image.fromarray(astronaut[:96, :96]).save(tmp_path / "photo.avif", quality=90)
    photo = load_photo(tmp_path / "photo.avif")
    assert np.abs(photo.image - srgb_to_linear(astronaut[:96, :96] / 255)).mean() < 0.02 and not photo.notes


def test_other_formats_are_not_opened(tmp_path, monkeypatch, astronaut):
    """Above all PostScript, for which Pillow starts Ghostscript."""
    from PIL import EpsImagePlugin

    monkeypatch.setattr(EpsImagePlugin, "Ghostscript", lambda *_, **__: pytest.fail("Ghostscript was started"))
    path = tmp_path / "photo.jpg"
    path.write_bytes(
        b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 64 64\n%%EndComments\n0 0 64 64 rectfill\nshowpage\n%%EOF\n"
    )
    with pytest.raises(InputError, match="not an image that can be read"):
        load_photo(path)
    for kind in ("ICO", "SGI", "PCX"):
        Image.fromarray(astronaut[:64, :64]).save(path, format=kind)
        with pytest.raises(InputError, match="not an image that can be read"):
            load_photo(path)


def test_photos_in_threads(tmp_path, astronaut, capfd):
    """Loading swaps nothing of the process for good: what is printed afterwards arrives."""
    small = astronaut[:200, :200]
    Image.fromarray(small).save(tmp_path / "photo.png")
    OpenEXR.File({}, {"RGB": small.astype(np.float32)}).write(str(tmp_path / "photo.exr"))
    limit = Image.MAX_IMAGE_PIXELS
    with ThreadPoolExecutor(4) as pool:
        images = list(pool.map(lambda i: load_photo(tmp_path / ("photo.png", "photo.exr")[i % 2]).image, range(40)))
    for image in images[2:]:
        assert any(np.array_equal(image, first) for first in images[:2])
    print("still here")
    os.write(2, b"and here")
    assert capfd.readouterr() == ("still here\n", "and here")
    assert limit == Image.MAX_IMAGE_PIXELS


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
