"""A contact sheet of a collection: frontal views, tone mapped to sRGB."""

from pathlib import Path

import numpy as np
from PIL import Image

from sira_mi.colour import linear_to_srgb
from sira_mi.errors import InputError
from sira_mi.training.collection.build import load_scene


def encode_srgb(linear: np.ndarray) -> np.ndarray:
    """8-bit sRGB of linear values, clipped to 0..1."""
    return np.round(255 * linear_to_srgb(linear)).astype(np.uint8)


def make_contact_sheet(folder: Path, count: int = 24, columns: int = 6, views: tuple[int, ...] = (0,)) -> np.ndarray:
    """The chosen views of scenes spread over the folder as one 8-bit image; a scene's views lie below one another."""
    paths = sorted(folder.glob("*.npz"))
    paths = paths[:: max(1, len(paths) // count)][:count]
    if not paths:
        raise InputError(f"{folder}: no scenes found")
    tiles = [np.concatenate(list(load_scene(path)["images"][list(views)]), axis=0) for path in paths]
    tiles += [np.zeros_like(tiles[0])] * (-len(tiles) % columns)
    rows = [np.concatenate(tiles[i : i + columns], axis=1) for i in range(0, len(tiles), columns)]
    return encode_srgb(np.concatenate(rows, axis=0).astype(np.float32))


def write_sheet(folder: Path, out: Path, **choices) -> None:
    """Writes the contact sheet of a collection as PNG."""
    Image.fromarray(make_contact_sheet(folder, **choices)).save(out)
