"""The pictures of the results page, and the sheet of the stranger's test: photos, true heads and those of rows."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from sira_mi.colour import linear_to_srgb
from sira_mi.files import read_exr, write_through
from sira_mi.sg.lights_io import read_environment
from studies.cache import write_json
from studies.portraits.relit_lights import exposure_of
from studies.portraits.truth import TrueView, load_views

VIEWS = ("relit_1", "turned_left")  # that are shown
PEOPLE = 10  # of the stranger's test
_TILE, _LARGE = 144, 360  # pixels, sides of a picture
_LABELS = 190  # pixels, width of the column of labels
_GAP = 40  # pixels between the heads and the photos of the stranger's test
_JPEG_QUALITY = 90


@dataclass(frozen=True, eq=False)
class Album:
    """The pictures [H, W, 3] of a portrait, display values in [0, 1]."""

    benchmark: Path
    runs: Path
    entry: Mapping  # of `benchmark.json`

    @property
    def photo(self) -> np.ndarray:
        path = self.benchmark / "photos" / f"{self.entry['name']}.jpg"
        return np.asarray(Image.open(path).convert("RGB")) / 255

    @cached_property
    def _true_views(self) -> dict[str, TrueView]:
        return load_views(self.benchmark / "truth" / self.entry["name"])

    @cached_property
    def _exposures(self) -> dict[str, float]:
        lights = {view.light for view in self._true_views.values()}
        return {name: exposure_of(read_environment(self.benchmark / "lights" / f"{name}.exr")) for name in lights}

    def truth(self, view: str) -> np.ndarray:
        return self._expose(self._true_views[view].image, view)

    def row(self, name: str, view: str) -> np.ndarray:
        """A row's picture; white where it has none."""
        path = self.runs / name / self.entry["name"] / f"{view}.exr"
        return self._expose(read_exr(path)[0], view) if path.exists() else np.ones((1, 1, 3))

    def _expose(self, radiance, view):
        return linear_to_srgb(self._exposures[self._true_views[view].light] * radiance)


def draw_rows(albums: Sequence[Album], titles: Mapping[str, str], path: Path) -> None:
    """Writes a sheet: the photos, the true heads relit and turned, and a line for each row of `titles`."""
    blank = np.ones((1, 1, 3))
    lines = {
        "photo": [image for album in albums for image in (album.photo, blank)],
        "truth": [album.truth(view) for album in albums for view in VIEWS],
        **{title: [a.row(name, view) for a in albums for view in VIEWS] for name, title in titles.items()},
    }
    _write_jpeg(path, np.concatenate([_line(images, title, _TILE) for title, images in lines.items()]))


def draw_large(albums: Sequence[Album], row: str, path: Path) -> None:
    """Writes a sheet with a line for each portrait: the photo, and true head and row's, relit and turned."""
    lines = [[a.photo, *(image for view in VIEWS for image in (a.truth(view), a.row(row, view)))] for a in albums]
    _write_jpeg(path, np.concatenate([_line(images, "", _LARGE) for images in lines]))


def draw_strangers(albums: Sequence[Album], row: str, out: Path, seed: int) -> None:
    """Writes `stranger.jpg`, lettered heads of a row, relit and turned, beside numbered photos of the same people in
    another order, and `stranger.json`, the key. A photo is of the person's other portrait where there is one. `albums`
    are all portraits of which the row has pictures; `PEOPLE` people are drawn."""
    random = np.random.default_rng([seed, 71])
    by_person: dict[str, list[Album]] = {}
    for album in albums:
        by_person.setdefault(album.entry["identity"], []).append(album)
    people = random.permutation(sorted(by_person))[:PEOPLE]
    portraits = [[mine[k] for k in random.permutation(len(mine))] for mine in (by_person[name] for name in people)]
    order = random.permutation(len(people))
    letters = [chr(ord("A") + k) for k in range(len(people))]
    heads = [
        _line([own[0].row(row, view) for view in VIEWS], letter, _LARGE // 2)
        for letter, own in zip(letters, portraits, strict=True)
    ]
    photos = [_line([portraits[k][-1].photo], str(place + 1), _LARGE // 2) for place, k in enumerate(order)]
    gap = np.ones((_LARGE // 2 * len(people), _GAP, 3))
    out.mkdir(parents=True, exist_ok=True)
    _write_jpeg(out / "stranger.jpg", np.concatenate([np.concatenate(heads), gap, np.concatenate(photos)], axis=1))
    key = {
        "row": row,
        "seed": seed,
        "heads": {letter: own[0].entry["name"] for letter, own in zip(letters, portraits, strict=True)},
        "photos": {str(place + 1): portraits[k][-1].entry["name"] for place, k in enumerate(order)},
        "pairs": dict(sorted((letters[k], place + 1) for place, k in enumerate(order))),
    }
    write_json(out / "stranger.json", key)


def _line(images: Sequence[np.ndarray], label: str, side: int) -> np.ndarray:
    """Pictures side by side, fitted into squares, after a label if there is one."""
    tiles = [_fit(image, side) for image in images]
    return np.concatenate([_write_label(label, side), *tiles] if label else tiles, axis=1)


def _write_label(label: str, side: int) -> np.ndarray:
    """A white tile with a text, in lines of whole words."""
    width = 40 if len(label) < 3 else _LABELS
    tile = Image.new("RGB", (width, side), "white")
    lines, font = [""], ImageFont.load_default(15)
    for word in label.split():
        longer = f"{lines[-1]} {word}".strip()
        if font.getlength(longer) < width - 12:
            lines[-1] = longer
        else:
            lines.append(word)
    ImageDraw.Draw(tile).multiline_text((6, side // 2), "\n".join(lines), fill="black", font=font, anchor="lm")
    return np.asarray(tile) / 255


def _fit(image: np.ndarray, side: int) -> np.ndarray:
    height, width = image.shape[:2]
    scale = side / max(height, width)
    size = max(1, round(width * scale)), max(1, round(height * scale))
    pixels = Image.fromarray((np.clip(image, 0, 1) * 255 + 0.5).astype(np.uint8))
    tile = Image.new("RGB", (side, side), "white")
    tile.paste(pixels.resize(size, Image.Resampling.LANCZOS), ((side - size[0]) // 2, (side - size[1]) // 2))
    return np.asarray(tile) / 255


def _write_jpeg(path: Path, values: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    picture = Image.fromarray((values * 255 + 0.5).astype(np.uint8))
    write_through(path, lambda file: picture.save(file, format="JPEG", quality=_JPEG_QUALITY))
