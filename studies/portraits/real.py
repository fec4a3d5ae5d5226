"""Photos without truth, to look at: each is fitted, relit and turned by the user's commands, and shown in one sheet."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from sira_mi.errors import InputError
from sira_mi.files import write_png
from sira_mi.fit.output import label_tile
from studies.portraits.make_rows import run_measured

EXAMPLE = "example"  # the portrait of scikit-image, which a fit has at hand
_LAYERS = {
    "input": "input.png",
    "mask": "renders/mask.png",
    "final": "renders/final.png",
    "normals": "renders/normal.png",
    "albedo": "renders/diffuse_albedo.png",
}
_SIZE, _SAMPLES = 320, 64  # pixels and samples a pixel of the relit pictures
_COLUMNS = 5


@dataclass(frozen=True)
class RealSettings:
    """How photos are fitted and shown."""

    lights: tuple[Path, Path]  # .exr environments or .json lobes; heads are turned under the first
    quality: str = "draft"
    prior: Path | None = None
    variant: str = "llvm_ad_rgb"


def show_photo(photo: Path | None, out: Path, settings: RealSettings) -> Path:
    """Writes `out/NAME.png`, the sheet of a photo (None: of `EXAMPLE`), and `out/NAME`, its avatar and pictures;
    returns the sheet's path. An avatar that is there is used. Raises InputError when a command fails."""
    name = EXAMPLE if photo is None else photo.stem
    folder = out / name
    folder.mkdir(parents=True, exist_ok=True)
    avatar = folder / "avatar"
    if not (avatar / "avatar.json").exists():
        options = ["--quality", settings.quality, *(["--prior", str(settings.prior)] if settings.prior else [])]
        _run(
            ["sira_mi.fit", "--example" if photo is None else str(photo), "--out", str(avatar), *options],
            folder,
            settings,
        )
    first, second = settings.lights
    views = {
        "turned to its left": (first, 30),
        "turned to its right": (first, -30),
        f"under {first.stem}": (first, 0),
        f"under {second.stem}": (second, 0),
    }
    pictures = {title: avatar / file for title, file in _LAYERS.items()}
    for number, (title, (light, yaw)) in enumerate(views.items()):
        pictures[title] = folder / f"view_{number}.png"
        options = ["--lights", str(light), "--yaw", str(yaw), "--size", str(_SIZE), "--spp", str(_SAMPLES)]
        _run(["sira_mi.relight", str(avatar), *options, "--out", str(pictures[title])], folder, settings)
    sheet = out / f"{name}.png"
    write_png(sheet, draw_sheet(pictures))
    return sheet


def draw_sheet(pictures: dict[str, Path]) -> np.ndarray:
    """Display values [H, W, 3] of image files in rows, labelled by their keys."""
    tiles = [label_tile(np.asarray(Image.open(path).convert("RGB")) / 255, title) for title, path in pictures.items()]
    tiles += [np.zeros_like(tiles[0])] * (-len(tiles) % _COLUMNS)
    rows = [np.concatenate(tiles[k : k + _COLUMNS], axis=1) for k in range(0, len(tiles), _COLUMNS)]
    return np.concatenate(rows)


def _run(command: Sequence[str], folder: Path, settings: RealSettings) -> None:
    cost = run_measured(["-m", *command, "--variant", settings.variant], folder / "log.txt")
    if "error" in cost:
        raise InputError(f"{folder.name}: {cost['error']}")
