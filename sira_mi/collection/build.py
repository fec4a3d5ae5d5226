"""Builds a folder of scenes: resumable, parallel, with a manifest of seeds, split, licences and errors."""

import json
import multiprocessing
import os
import time
import zipfile
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

import mitsuba as mi
import numpy as np
from tqdm import tqdm

from sira_mi.collection.hair import list_hair
from sira_mi.collection.scene import LAYOUT, LICENCE, SceneSettings, make_scene, save_scene
from sira_mi.errors import InputError

VARIANT = "llvm_ad_rgb"
TEST_SHARE = 0.12


@dataclass(frozen=True)
class BuildSettings:
    count: int  # scenes
    seed: int  # of the first scene; scene i has seed `seed` * 1,000,000 + i
    hair: Path | None  # folder of hair meshes; without it every head is bald or shaven
    hdri: Path | None  # folder of .exr environment maps; without it lights are SGs, sun and sky
    workers: int  # processes


def scene_name(index: int) -> str:
    return f"scene_{index:04d}.npz"


def split_of(index: int, count: int) -> str:
    """`test` for the last `TEST_SHARE` of the identities, else `train`."""
    return "test" if index >= count - round(TEST_SHARE * count) else "train"


def is_complete(path: Path) -> bool:
    """Whether a file holds every array of the layout."""
    try:
        with zipfile.ZipFile(path) as archive:
            return {f"{name}.npy" for name in LAYOUT} <= set(archive.namelist())
    except (OSError, zipfile.BadZipFile):
        return False


def build_one(index: int, out: Path, settings: BuildSettings, scene_settings: SceneSettings) -> dict:
    """Makes one scene unless it is complete; returns its manifest entry, with `error` when it failed."""
    path = out / scene_name(index)
    seed = settings.seed * 1_000_000 + index
    entry = {"file": path.name, "seed": seed, "split": split_of(index, settings.count), "licence": LICENCE}
    if is_complete(path):
        return entry
    if mi.variant() != VARIANT:
        mi.set_variant(VARIANT)
    maps = sorted(settings.hdri.glob("*.exr")) if settings.hdri else []
    start = time.perf_counter()
    try:
        save_scene(path, make_scene(seed, settings.hair, maps, scene_settings))
    except InputError:
        raise
    except Exception as error:
        return entry | {"error": f"{type(error).__name__}: {error}"}
    return entry | {"seconds": round(time.perf_counter() - start, 2)}


def build(out: Path, settings: BuildSettings, scene_settings: SceneSettings | None = None) -> dict:
    """Builds all scenes and returns the manifest, which is also written to `manifest.json`."""
    scene_settings = scene_settings or SceneSettings()
    if settings.count < 1:
        raise InputError("--count must be at least 1")
    if settings.hair is not None:
        list_hair(settings.hair)
    if settings.hdri is not None and not any(settings.hdri.glob("*.exr")):
        raise InputError(f"{settings.hdri}: no .exr environment maps found")
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{out}: cannot be created ({error.strerror})") from None
    for stale in out.glob(".scene_*.tmp"):
        stale.unlink()
    work = partial(build_one, out=out, settings=settings, scene_settings=scene_settings)
    indices = range(settings.count)
    bar = partial(tqdm, total=settings.count, unit="scene", dynamic_ncols=True)
    if settings.workers > 1:
        context = multiprocessing.get_context("spawn")
        threads = max(1, (os.cpu_count() or 1) // settings.workers)
        with context.Pool(settings.workers, initializer=_limit_threads, initargs=(threads,)) as pool:
            entries = list(bar(pool.imap(work, indices)))
    else:
        entries = list(bar(map(work, indices)))
    manifest = {
        "format": "sira-mi collection 1",
        "layout": LAYOUT,
        "settings": json.loads(json.dumps(asdict(settings) | {"scene": asdict(scene_settings)}, default=_plain)),
        "counts": {
            "train": sum(e["split"] == "train" and "error" not in e for e in entries),
            "test": sum(e["split"] == "test" and "error" not in e for e in entries),
            "failed": sum("error" in e for e in entries),
        },
        "scenes": entries,
    }
    temporary = out / ".manifest.json.tmp"
    temporary.write_text(json.dumps(manifest, indent=1), encoding="utf-8")
    temporary.replace(out / "manifest.json")
    return manifest


def _plain(value):
    return value.name if isinstance(value, Path) else str(value)


def _limit_threads(count: int) -> None:
    import drjit as dr

    dr.set_thread_count(count)


def load_scene(path: Path) -> dict[str, np.ndarray]:
    """The arrays of a scene; raises `InputError` when the file is damaged."""
    try:
        with np.load(path, allow_pickle=False) as data:
            return {name: data[name] for name in LAYOUT}
    except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
        raise InputError(f"{path}: not a scene of this collection ({error})") from None
