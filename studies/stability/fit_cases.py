"""Corrupt input of fits: a portrait corrupted in one way for each case, and what the fit must make of it."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image
from scipy.ndimage import binary_dilation, binary_erosion

from sira_mi.colour import linear_to_srgb
from sira_mi.files import write_png, write_text, write_through
from sira_mi.fit.settings import QUALITIES
from sira_mi.fit.stage import FitSettings
from sira_mi.portrait.camera import Camera
from studies.portraits.benchmark import EXIF_IFD, FOCAL_TAG
from studies.portraits.benchmark_photo import JPEG_QUALITY
from studies.portraits.truth import Truth
from studies.stability.fit_truth import FOCAL_35MM

if TYPE_CHECKING:
    from sira_mi.fit.fit import FitRequest

# A fit by all stages that takes half a minute, long enough for them to settle.
_STEPS = {
    "latents": 30,
    "networks": 45,
    "details": 25,
    "light": 20,
    "albedo": 20,
    "specular": 20,
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
    stages=tuple(replace(s, steps=_STEPS.get(s.name, 0)) for s in QUALITIES["standard"].stages),
)
REACH = 10  # pixels of the photo by which masks are eroded and dilated
_HOLES, _HOLE_RADIUS = 12, 18  # number, and pixels

FITTED, REFUSED, EITHER = "fitted", "refused", "either"


@dataclass(frozen=True, eq=False)
class CorruptInput:
    """The input of one fit."""

    photo: np.ndarray  # [H, W, 3] linear
    focal_35mm: float | None = FOCAL_35MM  # mm, in the photo's EXIF data
    mask: np.ndarray | None = None  # [H, W] bool
    camera: Camera | None = None
    turned: bool = False  # photo and mask are upside down

    def write(self, folder: Path) -> "FitRequest":
        """Writes the files into `folder`, and requests a fit of them there."""
        from sira_mi.fit.fit import FitRequest  # needs the variant

        photo, mask, camera = (folder / name for name in ("photo.jpg", "mask.png", "camera.json"))
        picture = Image.fromarray((linear_to_srgb(self.photo) * 255 + 0.5).astype(np.uint8))
        exif = Image.Exif()
        if self.focal_35mm is not None:
            exif.get_ifd(EXIF_IFD)[FOCAL_TAG] = round(self.focal_35mm)
        write_through(photo, lambda file: picture.save(file, "JPEG", quality=JPEG_QUALITY, subsampling=0, exif=exif))
        if self.mask is not None:
            write_png(mask, self.mask.astype(np.float32))
        if self.camera is not None:
            write_text(camera, self.camera.to_json())
        return FitRequest(
            photo,
            out=folder,
            mask=None if self.mask is None else mask,
            camera=None if self.camera is None else camera,
        )


@dataclass(frozen=True)
class Case:
    """One way to corrupt a portrait."""

    name: str
    description: str
    corrupt: Callable[[Truth], CorruptInput]
    expected: str = FITTED  # or REFUSED: one clear line; or EITHER
    says: str = ""  # words that the line, or a note, must contain
    face: float = np.inf  # mm, bound of the face's error
    lost: float = np.inf  # dB, bound of the PSNR lost against the undisturbed fit
    view: str = "front"  # of `YAWS`
    rates: float = 1.0  # times the learning rates

    @property
    def settings(self) -> FitSettings:
        """The settings of its fit."""
        stages = tuple(
            replace(stage, rates={name: self.rates * rate for name, rate in stage.rates.items()})
            for stage in SETTINGS.stages
        )
        return replace(SETTINGS, stages=stages)


def _make_uniform(value: float, known: bool) -> Callable[[Truth], CorruptInput]:
    def corrupt(truth: Truth) -> CorruptInput:
        photo = np.full_like(truth.image, value)
        return CorruptInput(photo, mask=truth.mask > 0.5, camera=truth.camera) if known else CorruptInput(photo)

    return corrupt


def _saturate_half(truth: Truth) -> CorruptInput:
    return CorruptInput(truth.image / np.median(truth.image[truth.mask > 0.5].max(axis=-1)))


def _light_in_red(truth: Truth) -> CorruptInput:
    return CorruptInput(truth.image * np.array([1.0, 0.0, 0.0], np.float32))


def _shrink(factor: int) -> Callable[[Truth], CorruptInput]:
    def corrupt(truth: Truth) -> CorruptInput:
        height, width = truth.mask.shape
        return CorruptInput(truth.image.reshape(height // factor, factor, width // factor, factor, 3).mean(axis=(1, 3)))

    return corrupt


def _turn_over(known: bool) -> Callable[[Truth], CorruptInput]:
    def corrupt(truth: Truth) -> CorruptInput:
        mask = truth.mask[::-1, ::-1] > 0.5 if known else None
        return CorruptInput(truth.image[::-1, ::-1], mask=mask, turned=True)

    return corrupt


def _cut_holes(truth: Truth) -> CorruptInput:
    """Round holes about random places of the person."""
    mask = truth.mask > 0.5
    rows, columns = np.nonzero(mask)
    y, x = np.mgrid[: mask.shape[0], : mask.shape[1]]
    holes = np.zeros_like(mask)
    for k in np.random.default_rng(0).integers(len(rows), size=_HOLES):
        holes |= (y - rows[k]) ** 2 + (x - columns[k]) ** 2 < _HOLE_RADIUS**2
    return CorruptInput(truth.image, mask=mask & ~holes)


def _move_outline(change: Callable) -> Callable[[Truth], CorruptInput]:
    y, x = np.mgrid[-REACH : REACH + 1, -REACH : REACH + 1]
    return lambda truth: CorruptInput(truth.image, mask=change(truth.mask > 0.5, x**2 + y**2 <= REACH**2))


def _misstate_focal_length(factor: float) -> Callable[[Truth], CorruptInput]:
    return lambda truth: CorruptInput(truth.image, focal_35mm=factor * FOCAL_35MM)


def _leave(truth: Truth) -> CorruptInput:
    return CorruptInput(truth.image)


UNDISTURBED = Case("undisturbed", "The photo as it is.", _leave, face=3.0)
CASES = (
    UNDISTURBED,
    Case("black photo", "Every pixel is 0.", _make_uniform(0.0, known=False), REFUSED, "no face found"),
    Case("white photo", "Every pixel is 1.", _make_uniform(1.0, known=False), REFUSED, "no face found"),
    Case("black photo, mask and camera given", "The outline is true.", _make_uniform(0.0, known=True), face=3.0),
    Case("white photo, mask and camera given", "The outline is true.", _make_uniform(1.0, known=True), face=3.0),
    Case("half-saturated", "Half of the person's pixels are clipped.", _saturate_half, face=3.0, lost=2.0),
    Case("single-coloured light", "Under light without green and blue.", _light_in_red, face=3.0, lost=2.0),
    Case("16 pixels", "The photo at 16 by 16 pixels.", _shrink(32), REFUSED, "16x16 pixels"),
    Case("a face of 24 pixels", "The photo at 64 by 64 pixels.", _shrink(8), EITHER, face=3.0, lost=2.0),
    Case("head turned by 50°", "Otherwise the same photo.", _leave, face=3.0, lost=2.0, view="turned"),
    Case("profile", "The head turned by 85°.", _leave, REFUSED, "no face found", view="profile"),
    Case("upside down", "The photo turned by 180°.", _turn_over(known=False), REFUSED, "upside down"),
    Case("upside down, mask given", "Photo and mask turned by 180°.", _turn_over(known=True), face=3.0, lost=2.0),
    Case("mask with holes", f"{_HOLES} holes of {2 * _HOLE_RADIUS} pixels.", _cut_holes, face=3.0, lost=2.0),
    Case("mask eroded", f"By {REACH} pixels.", _move_outline(binary_erosion), face=3.0, lost=2.0),
    Case("mask dilated", f"By {REACH} pixels.", _move_outline(binary_dilation), face=3.0, lost=2.0),
    Case("focal length halved", "In the EXIF data.", _misstate_focal_length(0.5), face=3.0, lost=2.0),
    Case("focal length times 1.5", "In the EXIF data.", _misstate_focal_length(1.5), face=3.0, lost=2.0),
    Case("learning rates times 10", "All of them.", _leave, says="diverged", face=3.0, lost=3.0, rates=10.0),
    Case("learning rates times 1000", "All of them.", _leave, says="diverged", face=3.0, lost=10.0, rates=1000.0),
)  # fmt: skip
