"""Files of lights: `lights.json` with lobes, and latitude-longitude OpenEXR images in Mitsuba's convention.

{"lobes": [{"axis": [x, y, z], "sharpness": λ, "amplitude": [r, g, b]}, ...]}
"""

import json
from pathlib import Path

import numpy as np

from sira_mi.errors import InputError
from sira_mi.files import check_file, read_exr, read_json, write_through

MAXIMUM_LOBES = 4096
# Width and height of an environment image that is still read.
_MAXIMUM_SIDE = 32768
# Of an environment image: sums over its pixels stay finite in float32.
_MAXIMUM_RADIANCE = 1e28
# Negative light, against the positive, that resampling and lossy compression leave; up to 0.05 in published maps.
_NEGATIVE_SHARE = 0.1
_FIELDS = (("axis", 3), ("sharpness", 1), ("amplitude", 3))


def check_lobes(lobes: np.ndarray, source: str) -> np.ndarray:
    """`lobes` `[N_l, 7]` as float32 with unit axes; InputError names `source` and the first bad entry."""
    lobes = np.asarray(lobes)
    if lobes.ndim != 2 or lobes.shape[1] != 7:
        raise InputError(f"{source}: lobes must have the shape [N_l, 7], not {list(lobes.shape)}")
    if not 1 <= len(lobes) <= MAXIMUM_LOBES:
        raise InputError(f"{source}: {len(lobes)} lobes; there must be 1 to {MAXIMUM_LOBES}")
    lobes = lobes.astype(np.float64)
    with np.errstate(over="ignore"):
        single = lobes.astype(np.float32)
    length = np.linalg.norm(lobes[:, :3], axis=1)
    for fault, bad in (
        ("a value that is not finite", ~np.isfinite(single).all(axis=1)),
        ("an axis of zero length", ~(length > 1e-20)),
        ("a sharpness that is not positive", ~(single[:, 3] > 0.0)),
        ("a negative amplitude", (lobes[:, 4:] < 0.0).any(axis=1)),
    ):
        if bad.any():
            raise InputError(f"{source}: lobe {int(np.argmax(bad))} has {fault}")
    lobes[:, :3] /= length[:, None]
    return lobes.astype(np.float32)


def _numbers(entry, key, count, source):
    value = entry.get(key)
    values = value if count > 1 else [value]
    if not isinstance(values, list) or len(values) != count:
        raise InputError(f'{source}: "{key}" must be {"a number" if count == 1 else f"{count} numbers"}')
    if any(isinstance(x, bool) or not isinstance(x, int | float) for x in values):
        raise InputError(f'{source}: "{key}" must hold numbers')
    return [float(x) for x in values]


def read_lights(path: str | Path) -> np.ndarray:
    """Lobes `[N_l, 7]` (float32, unit axes) of a `lights.json`; InputError for anything else."""
    document = read_json(path, "light")
    entries = document.get("lobes") if isinstance(document, dict) else None
    if not isinstance(entries, list):
        raise InputError(f'{path}: there must be a list "lobes"')
    if not 1 <= len(entries) <= MAXIMUM_LOBES:
        raise InputError(f"{path}: {len(entries)} lobes; there must be 1 to {MAXIMUM_LOBES}")
    rows = []
    for index, entry in enumerate(entries):
        source = f"{path}: lobe {index}"
        if not isinstance(entry, dict):
            raise InputError(f'{source} must be an object with "axis", "sharpness" and "amplitude"')
        rows.append([x for key, count in _FIELDS for x in _numbers(entry, key, count, source)])
    return check_lobes(np.array(rows), str(path))


def write_lights(path: str | Path, lobes: np.ndarray) -> None:
    """Writes a `lights.json` of lobes `[N_l, 7]` atomically; reading it back gives the same float32 values."""
    rows = check_lobes(lobes, str(path)).tolist()
    entries = [{"axis": row[:3], "sharpness": row[3], "amplitude": row[4:]} for row in rows]
    text = ",\n  ".join(json.dumps(entry) for entry in entries)
    write_through(path, lambda file: file.write_text(f'{{"lobes": [\n  {text}\n]}}\n', encoding="utf-8"))


def read_environment(path: str | Path) -> np.ndarray:
    """Radiance `[H, W, 3]` (float32) of a latitude-longitude OpenEXR; slightly negative values become 0.

    Raises InputError unless it is finite, about 2:1 and of positive light."""
    path = check_file(path, "light")

    def check_size(width: int, height: int) -> None:
        if max(height, width) > _MAXIMUM_SIDE or height < 2 or not 1.8 <= width / height <= 2.2:
            raise InputError(f"{path}: {width} × {height} is not a latitude-longitude image, twice as wide as high")

    image, _ = read_exr(path, check_size)
    if image.max() > _MAXIMUM_RADIANCE:
        raise InputError(f"{path}: holds radiance of {image.max():.0e}, more than {_MAXIMUM_RADIANCE:.0e}")
    light = np.maximum(image, 0.0)
    if (light - image).sum(dtype=np.float64) > _NEGATIVE_SHARE * light.sum(dtype=np.float64):
        raise InputError(f"{path}: holds negative radiance; export it again")
    return light
