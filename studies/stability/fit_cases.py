"""What fits are fed to try their stability: portraits spoilt one way each, and what must come of them."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.ndimage import binary_dilation, binary_erosion

from sira_mi.files import write_png, write_through
from sira_mi.fit.settings import QUALITIES, FitSettings
from sira_mi.portrait.camera import Camera
from sira_mi.portrait.load import linear_to_srgb
from studies.portraits.benchmark import EXIF_IFD, FOCAL_TAG, JPEG_QUALITY
from studies.portraits.truth import Truth
from studies.stability.fit_truth import FOCAL_35MM

# A fit by all stages that takes half a minute, long enough for them to settle.
_STEPS = {
    "latents": 30,
    "networks": 45,
    "details": 25,
    "light": 20,
    "albedo": 20,
    "speculars": 20,
    "shading": 20,
    "refinement": 70,
}
SETTINGS = replace(
    QUALITIES["draft"],
    quality="stability",
    working_size=160,
    rays=400,
    points=128,
    pixels=1024,
    voxel=0.12,
    final_voxel=0.1,
    block=10,
    stages=tuple((kind, replace(stage, steps=_STEPS[stage.name])) for kind, stage in QUALITIES["standard"].stages),
)
REACH = 10  # pixels of the photo by which masks are eroded and dilated
_HOLES, _HOLE_RADIUS = 12, 18  # number, and pixels

FITTED, REFUSED, EITHER = "fitted", "refused", "either"


@dataclass(frozen=True, eq=False)
class Fed:
    """What one fit is given."""

    photo: np.ndarray  # [H, W, 3] linear
    focal_35mm: float | None = FOCAL_35MM  # mm, in the photo's EXIF data
    mask: np.ndarray | None = None  # [H, W] bool
    camera: Camera | None = None
    turned: bool = False  # upside down, photo and mask

    def write(self, folder: Path) -> dict[str, Path | None]:
        """Writes the files into `folder`; their paths by the names of a fit's options."""
        paths: dict[str, Path | None] = {"photo": folder / "photo.jpg", "mask": None, "camera": None}
        picture = Image.fromarray((linear_to_srgb(self.photo) * 255 + 0.5).astype(np.uint8))
        exif = Image.Exif()
        if self.focal_35mm is not None:
            exif.get_ifd(EXIF_IFD)[FOCAL_TAG] = round(self.focal_35mm)
        write_through(
            paths["photo"], lambda file: picture.save(file, "JPEG", quality=JPEG_QUALITY, subsampling=0, exif=exif)
        )
        if self.mask is not None:
            paths["mask"] = folder / "mask.png"
            write_png(paths["mask"], self.mask.astype(np.float32))
        if self.camera is not None:
            paths["camera"] = folder / "camera.json"
            paths["camera"].write_text(self.camera.to_json(), encoding="utf-8")
        return paths


@dataclass(frozen=True)
class Case:
    """One spoilt portrait."""

    name: str
    fed: str  # in words
    spoil: Callable[[Truth], Fed]
    expected: str = FITTED  # or REFUSED: one clear line; or EITHER
    says: str = ""  # words that the line, or a note, must hold
    face: float = np.inf  # mm, bound of the face's error
    lost: float = np.inf  # dB, bound of what the picture loses against the undisturbed fit
    view: str = "front"  # of `YAWS`
    rates: float = 1.0  # times the learning rates

    @property
    def settings(self) -> FitSettings:
        """Those of its fit."""
        stages = tuple(
            (kind, replace(stage, rates={name: self.rates * rate for name, rate in stage.rates.items()}))
            for kind, stage in SETTINGS.stages
        )
        return replace(SETTINGS, stages=stages)


def _even(value: float, known: bool) -> Callable[[Truth], Fed]:
    def spoil(truth: Truth) -> Fed:
        photo = np.full_like(truth.image, value)
        return Fed(photo, mask=truth.mask > 0.5, camera=truth.camera) if known else Fed(photo)

    return spoil


def _half_saturated(truth: Truth) -> Fed:
    return Fed(truth.image / np.median(truth.image[truth.mask > 0.5].max(axis=-1)))


def _under_red(truth: Truth) -> Fed:
    return Fed(truth.image * np.array([1.0, 0.0, 0.0], np.float32))


def _smaller(factor: int) -> Callable[[Truth], Fed]:
    def spoil(truth: Truth) -> Fed:
        height, width = truth.mask.shape
        return Fed(truth.image.reshape(height // factor, factor, width // factor, factor, 3).mean(axis=(1, 3)))

    return spoil


def _upside_down(known: bool) -> Callable[[Truth], Fed]:
    def spoil(truth: Truth) -> Fed:
        mask = truth.mask[::-1, ::-1] > 0.5 if known else None
        return Fed(truth.image[::-1, ::-1], mask=mask, turned=True)

    return spoil


def _with_holes(truth: Truth) -> Fed:
    """Round holes about random places of the person."""
    mask = truth.mask > 0.5
    rows, columns = np.nonzero(mask)
    y, x = np.mgrid[: mask.shape[0], : mask.shape[1]]
    holes = np.zeros_like(mask)
    for k in np.random.default_rng(0).integers(len(rows), size=_HOLES):
        holes |= (y - rows[k]) ** 2 + (x - columns[k]) ** 2 < _HOLE_RADIUS**2
    return Fed(truth.image, mask=mask & ~holes)


def _moved_outline(change: Callable) -> Callable[[Truth], Fed]:
    y, x = np.mgrid[-REACH : REACH + 1, -REACH : REACH + 1]
    return lambda truth: Fed(truth.image, mask=change(truth.mask > 0.5, x**2 + y**2 <= REACH**2))


def _focal_length(factor: float) -> Callable[[Truth], Fed]:
    return lambda truth: Fed(truth.image, focal_35mm=factor * FOCAL_35MM)


def _as_it_is(truth: Truth) -> Fed:
    return Fed(truth.image)


UNDISTURBED = Case("undisturbed", "The photo as it is.", _as_it_is, face=3.0)
CASES = (
    UNDISTURBED,
    Case("black photo", "Every pixel is 0.", _even(0.0, known=False), REFUSED, "no face found"),
    Case("white photo", "Every pixel is 1.", _even(1.0, known=False), REFUSED, "no face found"),
    Case("black photo, mask and camera given", "The outline is true.", _even(0.0, known=True), face=3.0),
    Case("white photo, mask and camera given", "The outline is true.", _even(1.0, known=True), face=3.0),
    Case("half-saturated", "Half of the person's pixels are clipped.", _half_saturated, face=3.0, lost=2.0),
    Case("single-coloured light", "Under light without green and blue.", _under_red, face=3.0, lost=2.0),
    Case("16 pixels", "The photo at 16 by 16 pixels.", _smaller(32), REFUSED, "16x16 pixels"),
    Case("a face of 24 pixels", "The photo at 64 by 64 pixels.", _smaller(8), EITHER, face=3.0, lost=2.0),
    Case("head turned by 50°", "Otherwise the same photo.", _as_it_is, face=3.0, lost=2.0, view="turned"),
    Case("profile", "The head turned by 85°.", _as_it_is, REFUSED, "no face found", view="profile"),
    Case("upside down", "The photo turned by 180°.", _upside_down(known=False), REFUSED, "upside down"),
    Case("upside down, mask given", "Photo and mask turned by 180°.", _upside_down(known=True), face=3.0, lost=2.0),
    Case("mask with holes", f"{_HOLES} holes of {2 * _HOLE_RADIUS} pixels.", _with_holes, face=3.0, lost=2.0),
    Case("mask eroded", f"By {REACH} pixels.", _moved_outline(binary_erosion), face=3.0, lost=2.0),
    Case("mask dilated", f"By {REACH} pixels.", _moved_outline(binary_dilation), face=3.0, lost=2.0),
    Case("focal length halved", "In the EXIF data.", _focal_length(0.5), face=3.0, lost=2.0),
    Case("focal length times 1.5", "In the EXIF data.", _focal_length(1.5), face=3.0, lost=2.0),
    Case("learning rates times 10", "All of them.", _as_it_is, says="diverged", face=3.0, lost=3.0, rates=10.0),
    Case("learning rates times 1000", "All of them.", _as_it_is, says="diverged", face=3.0, lost=10.0, rates=1000.0),
)  # fmt: skip
