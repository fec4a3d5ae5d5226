"""The picture of the results page: photos beside fitted and true layers."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from sira_mi.files import write_png
from sira_mi.relight.pictures import preview
from studies.portraits.summary import SHIPPED

_TILE = 256  # pixels, side of a picture in the sheet
_SHEET_PORTRAITS = 6


def write_picture(rows: Sequence[dict], benchmark: Path, runs: Path, path: Path) -> None:
    """Draws the first portraits that the shipped method has fitted, from their folders in `runs`."""
    shown = [row["portrait"] for row in rows if row["method"] == SHIPPED and "scores" in row][:_SHEET_PORTRAITS]
    if shown:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_png(path, np.concatenate([_draw_row(benchmark / name, runs / name / SHIPPED) for name in shown]))


def _draw_row(folder: Path, fit: Path) -> np.ndarray:
    with np.load(folder / "truth.npz", allow_pickle=False) as truth:
        names = ("normal", "diffuse_albedo", "specular_albedo")
        true = {name: truth[name] for name in (*names, "mask")}
        turn = truth["world_to_camera"][:3, :3]
        true["normal"] = true["normal"] @ turn.T * [1, -1, -1]
    with np.load(fit / "head.npz", allow_pickle=False) as head:
        own = {name: head[f"image/{name}"] for name in (*names, "final", "mask")}
        own["normal"] = own["normal"] @ head["world_to_camera"][:3, :3].T * [1, -1, -1]
    photo = np.asarray(Image.open(folder / "photo.jpg").convert("RGB")) / 255
    shown = [photo, preview("final", own["final"], own["mask"])]
    for name in names:
        shown += [preview(name, layers[name], layers["mask"]) for layers in (own, true)]
    return np.concatenate([_tile(image) for image in shown], axis=1)


def _tile(image: np.ndarray) -> np.ndarray:
    image = image if image.ndim == 3 else np.repeat(image[..., None], 3, axis=2)
    pixels = Image.fromarray((np.clip(image, 0, 1) * 255 + 0.5).astype(np.uint8))
    return np.asarray(pixels.resize((_TILE, _TILE), Image.Resampling.LANCZOS)) / 255
