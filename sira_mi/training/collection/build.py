"""Builds a folder of scenes: resumable, parallel, with a manifest of seeds, split, licences and errors."""

import hashlib
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

from sira_mi.errors import InputError
from sira_mi.files import write_through
from sira_mi.training.collection.scene import LAYOUT, SceneSettings, make_scene, save_scene
from sira_mi.training.collection.subject import BrokenHead, Source

VARIANT = "llvm_ad_rgb"
# Of every source, each identity whose number leaves this remainder is a test identity, whatever the count.
TEST_EVERY, TEST_REMAINDER = 8, 7


@dataclass(frozen=True)
class BuildSettings:
    sources: tuple[Source, ...]
    seed: int  # of the collection
    hdri: Path | None  # folder of .exr environment maps; without it lights are SGs, sun and sky
    workers: int  # processes


def scene_name(source: Source, number: int) -> str:
    return f"{source.name}_{number:04d}.npz"


def scene_seed(settings: BuildSettings, source: Source, number: int) -> int:
    """A seed that depends on the collection's, the source and the identity's number only."""
    text = f"{settings.seed}/{source.name}/{number}"
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:4], "little")


def choose_split(number: int) -> str:
    """`test` for one identity in `TEST_EVERY` of each source, else `train`."""
    return "test" if number % TEST_EVERY == TEST_REMAINDER else "train"


def read_finished_info(path: Path) -> dict | None:
    """`info` of a scene file that holds every array of the layout, else None."""
    try:
        with np.load(path, allow_pickle=False) as data:
            return json.loads(str(data["info"])) if set(LAYOUT) <= set(data.files) else None
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None


def build_one(task: tuple[Source, int], out: Path, settings: BuildSettings, scene_settings: SceneSettings) -> dict:
    """Makes one scene unless a complete one of the same identity and seed is there; returns its manifest entry, with
    `error` when it failed."""
    source, number = task
    path, seed = out / scene_name(source, number), scene_seed(settings, source, number)
    entry = {"file": path.name, "source": source.name, "number": number, "seed": seed, "split": choose_split(number)}
    info = read_finished_info(path)
    if info is not None and (info.get("name"), info.get("seed")) == (source.title(number), seed):
        return entry | _of_info(info)
    if mi.variant() != VARIANT:
        mi.set_variant(VARIANT)
    maps = sorted(settings.hdri.glob("*.exr")) if settings.hdri else []
    start = time.process_time()
    try:
        scene = make_scene(source.subject(number, seed), seed, maps, scene_settings)
        save_scene(path, scene)
    except InputError:
        raise
    except BrokenHead as error:
        return entry | {"licence": source.licence, "error": str(error)}
    except Exception as error:
        return entry | {"licence": source.licence, "error": f"{type(error).__name__}: {error}"}
    return entry | _of_info(json.loads(str(scene["info"]))) | {"core_seconds": round(time.process_time() - start, 2)}


def _of_info(info: dict) -> dict:
    return {key: info[key] for key in ("name", "group", "licence")}


def build(out: Path, settings: BuildSettings, scene_settings: SceneSettings | None = None) -> dict:
    """Builds all scenes and returns the manifest, which is also written to `manifest.json`."""
    scene_settings = scene_settings or SceneSettings()
    tasks = [(source, number) for source in settings.sources for number in range(source.count())]
    if not tasks:
        raise InputError("no heads to build; give --count or a source")
    if settings.hdri is not None and not any(settings.hdri.glob("*.exr")):
        raise InputError(f"{settings.hdri}: no .exr environment maps found")
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{out}: cannot be created ({error.strerror})") from None
    for stale in out.glob(".*.tmp"):
        stale.unlink()
    work = partial(build_one, out=out, settings=settings, scene_settings=scene_settings)
    bar = partial(tqdm, total=len(tasks), unit="scene", dynamic_ncols=True)
    if settings.workers > 1:
        context = multiprocessing.get_context("spawn")
        threads = max(1, (os.cpu_count() or 1) // settings.workers)
        with context.Pool(settings.workers, initializer=_limit_threads, initargs=(threads,)) as pool:
            entries = list(bar(pool.imap(work, tasks)))
    else:
        entries = list(bar(map(work, tasks)))
    manifest = {
        "format": "sira-mi collection 2",
        "layout": LAYOUT,
        "settings": {
            "seed": settings.seed,
            "hdri": settings.hdri and settings.hdri.name,
            "sources": {source.name: source.count() for source in settings.sources},
            "scene": asdict(scene_settings),
        },
        "counts": {
            "train": sum(e["split"] == "train" and "error" not in e for e in entries),
            "test": sum(e["split"] == "test" and "error" not in e for e in entries),
            "failed": sum("error" in e for e in entries),
        },
        "scenes": entries,
    }
    write_through(out / "manifest.json", lambda file: file.write_text(json.dumps(manifest, indent=1), encoding="utf-8"))
    return manifest


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
