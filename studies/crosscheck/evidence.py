"""What was measured under one light, kept as JSON and arrays, so that an interrupted run goes on where it was."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sira_mi.avatar.file import PRIOR
from sira_mi.files import write_through
from studies.cache import fingerprint, load_or_compute
from studies.crosscheck.case import Case
from studies.crosscheck.causes import Row
from studies.crosscheck.curves import Limit, Point
from studies.crosscheck.images import Estimate

# Changes when the meaning of a measurement does.
_VERSION = "1"


@dataclass(frozen=True, eq=False)
class Lit:
    """What was measured under one light."""

    light: str
    reference: Estimate
    level: float  # mean radiance of the reference inside the head
    regions: dict[str, np.ndarray]  # masks [H, W]
    rows: list[Row]
    pictures: dict[str, np.ndarray]  # [H, W, 3], of the sheet: the reference, the closed form, signed differences
    points: list[Point]
    limits: list[Limit]
    agreement: float  # of `sira_sg` with the same form at this package's own points, relative root mean square
    seconds: float  # wall time of all this
    launches: int  # of at most two million rays
    non_finite: int  # of them that had NaN or infinite pixels and were made again


def key_of(case: Case, settings, lobes: np.ndarray) -> str:
    """A hash of all that the measurements under `lobes` depend on; `settings` is a dataclass."""
    numbers = (case.roughness, case.k_s, case.width, case.height, case.to_world.tolist(), np.asarray(lobes).tolist())
    described = [json.dumps(numbers), str(case.sensor), *map(str, case.others)]
    return fingerprint(_VERSION, str(settings), *described, Path(case.avatar) if case.avatar else PRIOR)


def kept(folder: Path | None, name: str, key: str, compute: Callable[[], Lit]) -> Lit:
    """The `Lit` that `folder` holds under `key`, otherwise that of `compute()`, which is kept there; without a folder
    just the latter."""
    if folder is None:
        return compute()
    stem = name.replace(" ", "_").replace("'", "")
    arrays = folder / f"{stem}.npz"

    def measured() -> dict:
        lit = compute()
        folder.mkdir(parents=True, exist_ok=True)
        stored = {"halves": lit.reference.halves}
        stored |= {f"region/{k}": v for k, v in lit.regions.items()}
        stored |= {f"picture/{k}": v for k, v in lit.pictures.items()}
        write_through(arrays, lambda file: np.savez_compressed(file, **stored))
        numbers = {
            field.name: getattr(lit.reference, field.name)
            for field in dataclasses.fields(Estimate)
            if field.name != "halves"
        }
        lists = {n: [dataclasses.asdict(r) for r in getattr(lit, n)] for n in ("rows", "points", "limits")}
        scalars = {n: getattr(lit, n) for n in ("light", "level", "agreement", "seconds", "launches", "non_finite")}
        return {**scalars, "reference": numbers, **lists}

    stored = load_or_compute(folder / f"{stem}.json", key, measured, (arrays,))
    with np.load(arrays, allow_pickle=False) as data:
        parts = {
            kind: {name.removeprefix(kind): data[name] for name in data.files if name.startswith(kind)}
            for kind in ("region/", "picture/")
        }
        reference = Estimate(halves=data["halves"], **stored["reference"])
    return Lit(
        stored["light"],
        reference,
        stored["level"],
        parts["region/"],
        [Row(**row) for row in stored["rows"]],
        parts["picture/"],
        [Point(**point) for point in stored["points"]],
        [Limit(**limit) for limit in stored["limits"]],
        stored["agreement"],
        stored["seconds"],
        stored["launches"],
        stored["non_finite"],
    )
