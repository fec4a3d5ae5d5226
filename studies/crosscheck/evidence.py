"""What was measured under one light, kept as JSON and arrays, so that an interrupted run resumes where it was."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np

from sira_mi.avatar.file import PRIOR
from sira_mi.files import write_through
from studies.cache import fingerprint, load_or_compute
from studies.crosscheck.case import Case

# Changes when the meaning of a measurement does.
_VERSION = "2"


@dataclass(frozen=True, eq=False)
class Lit:
    """What was measured under one light."""

    figures: dict  # a JSON object, as in the page's figures
    pictures: dict[str, np.ndarray]  # [H, W, 3], of the sheet: the reference, the closed form, signed differences
    regions: dict[str, np.ndarray]  # masks [H, W]


def key_of(case: Case, settings: object, lobes: np.ndarray) -> str:
    """A hash of everything that the measurements under `lobes` depend on; `settings` is a dataclass."""
    numbers = (case.roughness, case.k_s, case.width, case.height, case.to_world.tolist(), np.asarray(lobes).tolist())
    described = [json.dumps(numbers), str(case.sensor), *map(str, case.others)]
    return fingerprint(_VERSION, str(settings), *described, Path(case.avatar) if case.avatar else PRIOR)


def load_or_measure(folder: Path | None, name: str, key: str, measure: Callable[[], Lit]) -> Lit:
    """The `Lit` that `folder` holds under `key`; otherwise that of `measure()`, which is written there. Without a
    folder it is always measured."""
    if folder is None:
        return measure()
    stem = name.replace(" ", "_").replace("'", "")
    arrays = folder / f"{stem}.npz"

    def compute() -> dict:
        lit = measure()
        folder.mkdir(parents=True, exist_ok=True)
        stored = {f"picture/{name}": picture for name, picture in lit.pictures.items()}
        stored |= {f"region/{name}": mask for name, mask in lit.regions.items()}
        write_through(arrays, lambda file: np.savez_compressed(file, **cast(Any, stored)))
        return lit.figures

    figures = load_or_compute(folder / f"{stem}.json", key, compute, (arrays,))
    with np.load(arrays, allow_pickle=False) as data:
        pictures, regions = (
            {name.removeprefix(kind): data[name] for name in data.files if name.startswith(kind)}
            for kind in ("picture/", "region/")
        )
    return Lit(figures, pictures, regions)
