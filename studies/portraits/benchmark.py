"""The fixed benchmark of portraits with known truth: building its folder and reading it.

DIR/benchmark.json              format, settings, portraits
DIR/NAME/photo.jpg              what a fit sees
DIR/NAME/truth.npz              what only the scores use, `TRUTH`
DIR/NAME/portrait.json          the portrait's entry, and the key of its settings
"""

import json
import multiprocessing
import os
import time
from dataclasses import asdict
from functools import partial
from pathlib import Path

import mitsuba as mi
import numpy as np
from PIL import Image
from tqdm import tqdm

from sira_mi.colour import linear_to_srgb
from sira_mi.conventions import LUMINANCE
from sira_mi.errors import InputError
from sira_mi.files import write_through
from sira_mi.portrait.landmarks import CHIN
from sira_mi.training.collection.build import VARIANT
from sira_mi.training.collection.render import find_exposure
from sira_mi.training.collection.skin import CLOTH
from sira_mi.training.collection.subject import BrokenHead, Source, Subject
from studies.cache import write_json
from studies.portraits.benchmark_lights import BRIGHTEST, backdrop, light_map
from studies.portraits.benchmark_photo import NOTHING, PhotoSettings, View, draw_roughness, portrait_camera
from studies.portraits.benchmark_plan import (
    FORMAT,
    BenchmarkSettings,
    Identity,
    Shot,
    choose_identities,
    heads_of,
    plan,
)

TRUTH = {
    "K": "[3, 3] f4, pixels",
    "world_to_camera": "[4, 4] f4, OpenCV; the world is the subject's own frame, scene units",
    "image": "[H, W, 3] f4, linear radiance, exposed as in the photo, with what is behind the person",
    "mask": "[H, W] f4, coverage of the person in 0..1",
    "region": "[H, W] u1, of the first hit at the pixel centre: 0 skin, 1 hair, 2 eye, 3 cloth, 255 nothing",
    "diffuse_albedo": "[H, W, 3] f4, linear; 0 off the person",
    "specular_albedo": "[H, W] f4, reflectance at normal incidence; 0 off the person",
    "normal": "[H, W, 3] f4, unit, of the first hit at the pixel centre; 0 off the person",
    "shading": "[H, W] f4, luminance of the diffusely reflected light over that of the albedo; 0 off the person",
    "shadow": "[H, W] f4, share of the unoccluded direct diffuse irradiance that arrives; 0 off the person",
    "vertices": "[N, 3] f4, of a triangle soup of all surfaces, hidden ones among them",
    "faces": "[T, 3] i4",
    "face_region": "[T] u1, codes as in `region`",
    "landmarks": "[468, 3] f4, scene units",
    "landmarks_valid": "[468] bool",
}

# Mean luminance of a head of albedo `USUAL_ALBEDO` in the photo, by light.
MEAN_LUMINANCE = {"studio": 0.3, "outdoor": 0.3, "extreme": 0.2}
USUAL_ALBEDO = 0.3
# Share of the person's pixels that exposure leaves below white in every channel, by light.
UNCLIPPED = {"studio": 0.995, "outdoor": 0.995, "extreme": 0.97}
JPEG_QUALITY = 95
FOCAL_TAG, EXIF_IFD = 0xA405, 0x8769


def build_benchmark(
    collection: Path,
    out: Path,
    sources: tuple[Source, ...],
    hdri: Path | None,
    workers: int,
    settings: BenchmarkSettings | None = None,
) -> list[dict]:
    """Renders the portraits that `out` does not hold yet and returns the entries of `benchmark.json`, which is written
    last. Only heads of the given sources are used. Raises InputError when a source's data are not those that the
    collection was built with."""
    settings = settings or BenchmarkSettings()
    by_name = {source.name: source for source in sources}
    heads = [head for head in heads_of(collection, settings.split) if head.source in by_name]
    if not heads:
        raise InputError(
            f"{collection} has no {settings.split} heads of {', '.join(by_name)}; build a larger collection"
        )
    environments = sorted(hdri.glob("*.exr")) if hdri is not None else []
    if hdri is not None and not environments:
        raise InputError(f"{hdri}: no .exr environment maps found")
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{out}: cannot be created ({error.strerror})") from None
    shots = plan(choose_identities(heads, settings.identities, settings.seed), environments, settings)
    tasks = [(by_name[mine[0].identity.source], mine) for mine in shots]
    work = partial(take_portraits, out=out, photo=settings.photo)
    bar = partial(tqdm, total=len(tasks), unit="head", dynamic_ncols=True)
    if workers > 1:
        threads = max(1, (os.cpu_count() or 1) // workers)
        with multiprocessing.get_context("spawn").Pool(workers, _limit_threads, (threads,)) as pool:
            entries = [entry for some in bar(pool.imap(work, tasks)) for entry in some]
    else:
        entries = [entry for some in bar(map(work, tasks)) for entry in some]
    write_json(
        out / "benchmark.json",
        {"format": FORMAT, "settings": asdict(settings), "truth": TRUTH, "portraits": entries},
    )
    return entries


def _limit_threads(count: int) -> None:
    import drjit as dr

    dr.set_thread_count(count)


def take_portraits(task: tuple[Source, list[Shot]], out: Path, photo: PhotoSettings) -> list[dict]:
    """Entries of the portraits of one head; those that are not in `out` under the same key are rendered now."""
    source, shots = task
    found = {shot.name: read_entry(out / shot.name, shot.key(photo)) for shot in shots}
    entries = {name: entry for name, entry in found.items() if entry is not None}
    if len(entries) == len(shots):
        return list(entries.values())
    if mi.variant() != VARIANT:
        mi.set_variant(VARIANT)
    started = time.process_time()
    identity, pose = shots[0].identity, shots[0].pose
    subject = rebuild_subject(source, identity)
    camera = portrait_camera(subject.parts, pose.yaw, pose.pitch, pose.focal_35mm, pose.extent, photo.size)
    roughness = draw_roughness(np.random.default_rng([identity.seed, 51]))
    view = View(subject.parts, roughness, *camera, photo)
    for shot in shots:
        if shot.name not in entries:
            image, arrays = portrait(view, subject, shot)
            seconds, started = time.process_time() - started, time.process_time()
            measured = {"clipped": _clipped(arrays), "core_seconds": round(seconds, 1)}
            by_code = {"roughness": {str(code): value for code, value in roughness.items()}}
            entries[shot.name] = shot.entry() | by_code | measured
            write_portrait(out / shot.name, image, arrays, shot, entries[shot.name], shot.key(photo))
    return [entries[shot.name] for shot in shots]


def rebuild_subject(source: Source, identity: Identity) -> Subject:
    """The subject of a head. Raises InputError unless it is the one of the collection."""
    try:
        subject = source.subject(identity.number, identity.seed)
    except (BrokenHead, IndexError) as error:
        raise InputError(f"{identity.title} cannot be made again: {error}; name the data it was built with") from error
    if json.loads(json.dumps(subject.description)) != identity.person:
        raise InputError(f"{identity.title} is not the collection's: name the data that it was built with (--hair, …)")
    return subject


def portrait(view: View, subject: Subject, shot: Shot) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """The photo [H, W, 3], linear and exposed, and the arrays of `TRUTH`."""
    random = np.random.default_rng([shot.seed, 52])
    light = light_map(shot.light, random, shot.pose.yaw, shot.environment, shot.extreme)
    radiance, mask = view.photograph(light, shot.seed)
    irradiance, shadow = view.shading(shot.seed + 1)
    covered = mask > 0
    albedos = {name: view.truth[name] for name in ("diffuse_albedo", "specular_albedo")}
    truth = view.truth | {name: (values.T * covered.T).T for name, values in albedos.items()}
    scale = exposure_of(radiance, mask, truth, subject.landmarks[CHIN], shot.light)
    behind = backdrop(shot.light, random, light, view.directions())
    behind = np.minimum(behind * scale if shot.light == "outdoor" else behind, BRIGHTEST)
    image = radiance * scale + (1 - mask[..., None]) * behind
    weights = np.array(LUMINANCE)
    albedo = truth["diffuse_albedo"]
    diffuse = (albedo * irradiance * scale) @ weights / np.maximum(albedo @ weights, 1e-6)
    arrays = truth | {
        "image": image.astype(np.float32),
        "mask": mask.astype(np.float32),
        "shading": diffuse.astype(np.float32),
        "shadow": np.clip(shadow, 0, 1).astype(np.float32),
        "landmarks": subject.landmarks.astype(np.float32),
        "landmarks_valid": np.asarray(subject.landmarks_valid, bool),
    }
    return image, {name: arrays[name] for name in TRUTH}


def exposure_of(radiance, mask, truth, chin, light) -> float:
    """The camera's exposure: a factor that brings the mean luminance of the head above the `chin` [3] to
    `MEAN_LUMINANCE`, scaled by the root of its albedo over `USUAL_ALBEDO`, but so that at least `UNCLIPPED` of
    the person is below white."""
    weights = np.array(LUMINANCE)
    head = mask * (truth["region"] != CLOTH) * (truth["region"] != NOTHING)
    local = truth["world_to_camera"][:3, :3] @ chin + truth["world_to_camera"][:3, 3]
    row = (truth["K"] @ local)[1] / local[2]
    head[int(np.clip(row, 1, len(mask))) :] = 0
    albedo = (truth["diffuse_albedo"] @ weights * head).sum() / max(head.sum(), 1e-9)
    scale = find_exposure(radiance, head, MEAN_LUMINANCE[light] * np.sqrt(albedo / USUAL_ALBEDO))
    brightest = np.quantile(radiance[mask > 0.5].max(axis=-1), UNCLIPPED[light])
    return float(min(scale, 1 / max(brightest, 1e-9)))


def _clipped(arrays):
    """Share of the person's pixels with a channel above white."""
    return round(float((arrays["image"][arrays["mask"] > 0.5] > 1).any(axis=-1).mean()), 4)


def write_portrait(folder: Path, image: np.ndarray, arrays: dict, shot: Shot, entry: dict, key: str) -> None:
    """Writes the portrait's folder, `portrait.json` last."""
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: cannot be created ({error.strerror})") from None
    (folder / "portrait.json").unlink(missing_ok=True)
    picture = Image.fromarray((np.clip(linear_to_srgb(image), 0, 1) * 255 + 0.5).astype(np.uint8))
    exif = Image.Exif()
    exif.get_ifd(EXIF_IFD)[FOCAL_TAG] = round(shot.pose.focal_35mm)
    write_through(
        folder / "photo.jpg",
        lambda file: picture.save(file, format="JPEG", quality=JPEG_QUALITY, subsampling=0, exif=exif),
    )

    def save(file: Path) -> None:
        with file.open("wb") as opened:
            np.savez_compressed(opened, **arrays)

    write_through(folder / "truth.npz", save)
    write_json(folder / "portrait.json", {"key": key, "entry": entry})


def read_entry(folder: Path, key: str) -> dict | None:
    """The entry of a complete portrait built under `key`, else None."""
    try:
        stored = json.loads((folder / "portrait.json").read_text(encoding="utf-8"))
        complete = stored["key"] == key and all((folder / name).is_file() for name in ("photo.jpg", "truth.npz"))
        return stored["entry"] if complete else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def read_benchmark(folder: Path, split: str = "test") -> list[dict]:
    """The entries of a benchmark's portraits. Raises InputError when it is missing, damaged, incomplete, or of heads of
    another `split`."""
    path = folder / "benchmark.json"
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        if data["format"] != FORMAT:
            raise InputError(f"{path} is of format {data['format']}, not {FORMAT}; build it again")
        shown = data.get("settings", {}).get("split", "test")
        entries = list(data["portraits"])
        names = [entry["name"] for entry in entries]
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{path}: no benchmark ({error}); run python -m studies.portraits build") from error
    if shown != split:
        raise InputError(f"{folder} shows {shown} heads, not {split} heads; build one with --split {split}")
    for name in names:
        if Path(name).name != name:
            raise InputError(f"{path}: {name!r} is not the name of a portrait")
        for file in ("photo.jpg", "truth.npz"):
            if not (folder / name / file).is_file():
                raise InputError(f"{folder / name / file} is missing; run python -m studies.portraits build again")
    return entries
