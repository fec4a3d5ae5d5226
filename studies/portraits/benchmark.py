"""The benchmark of portraits with known truth: building its folder and reading it.

BENCH/benchmark.json            format, kind, settings, what `TRUTH` and `VIEW` hold, portraits
BENCH/photos/NAME.jpg           all that a fit sees
BENCH/photos/NAME.camera.json   the photo's camera, for fits that are given it
BENCH/lights/LIGHT.exr          the environments that heads are relit under
BENCH/truth/NAME/truth.npz      what only the scores use, `TRUTH`
BENCH/truth/NAME/views.npz      the head relit and turned, `VIEW` for each of `truth.VIEWS`; not of training heads
BENCH/truth/NAME/portrait.json  the portrait's entry, and the key of its settings
"""

import json
import multiprocessing
import os
import shutil
import time
from collections.abc import Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path

import mitsuba as mi
import numpy as np
from PIL import Image
from tqdm import tqdm

from sira_mi.colour import linear_to_srgb
from sira_mi.conventions import LUMINANCE, MILLIMETRES_PER_UNIT
from sira_mi.errors import InputError
from sira_mi.files import write_text, write_through
from sira_mi.portrait.camera import Camera, yaw_rotation
from sira_mi.portrait.landmarks import CHIN, NOSE_TIP
from sira_mi.sg.lights_io import read_environment
from sira_mi.training.collection.build import VARIANT
from sira_mi.training.collection.regions import fill_missing_landmarks
from sira_mi.training.collection.render import find_exposure
from sira_mi.training.collection.similarity import Similarity
from sira_mi.training.collection.skin import CLOTH, EYE, SKIN
from sira_mi.training.collection.subject import Subject
from studies.cache import write_json
from studies.measures import FACE_RADIUS
from studies.portraits.benchmark_lights import BRIGHTEST, BUSY_VIEW, backdrop, busy_backdrop, light_map
from studies.portraits.benchmark_photo import NOTHING, PhotoSettings, View, draw_roughness, portrait_camera
from studies.portraits.benchmark_plan import FORMAT, BenchmarkSettings, Shot, Sitting
from studies.portraits.truth import VIEWS

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

VIEW = {
    "image": "[H, W, 3] f2, linear radiance under the environment as it is, black off the person (premultiplied)",
    "mask": "[H, W] u1, coverage of the person times 255",
    "region": "[H, W] u1, as in `truth.npz`",
    "face": "[H, W] bool, skin and eyes within 95 mm of the nose tip",
}

# Mean luminance of a head of albedo `USUAL_ALBEDO` in the photo, by light.
MEAN_LUMINANCE = {"studio": 0.3, "outdoor": 0.3, "extreme": 0.2}
USUAL_ALBEDO = 0.3
# Share of the person's pixels that exposure leaves below white in every channel, by light.
UNCLIPPED = {"studio": 0.995, "outdoor": 0.995, "extreme": 0.97}
FOCAL_TAG, EXIF_IFD = 0xA405, 0x8769
LARGEST_HALF = 60_000.0  # radiance that a half-precision number holds
# A second person: scene units behind the first, place aside as a share of half the photo's width, scene units taller,
# degrees turned.
BEHIND, ASIDE, TALLER, TURNED = (1.5, 6.0), (0.55, 0.9), (-0.6, 0.4), (-50.0, 50.0)


def build_benchmark(sittings: Sequence[Sitting], out: Path, settings: BenchmarkSettings, workers: int) -> list[dict]:
    """Renders the portraits that `out` does not hold yet and returns the entries of `benchmark.json`, which is written
    last."""
    try:
        for name in ("photos", "lights", "truth"):
            (out / name).mkdir(parents=True, exist_ok=True)
        for path in {path for sitting in sittings for shot in sitting.shots for path in shot.relights}:
            shutil.copyfile(path, out / "lights" / path.name)
    except OSError as error:
        raise InputError(f"{out}: cannot be written ({error.strerror}); choose another --out") from None
    work = partial(take_portraits, out=out, photo=settings.photo)
    bar = partial(tqdm, total=len(sittings), unit="head", dynamic_ncols=True)
    if workers > 1:
        threads = max(1, (os.cpu_count() or 1) // workers)
        with multiprocessing.get_context("spawn").Pool(workers, _limit_threads, (threads,)) as pool:
            entries = [entry for some in bar(pool.imap(work, sittings)) for entry in some]
    else:
        entries = [entry for some in bar(map(work, sittings)) for entry in some]
    described = {"format": FORMAT, "kind": settings.kind, "settings": asdict(settings), "truth": TRUTH, "views": VIEW}
    write_json(out / "benchmark.json", described | {"portraits": entries})
    return entries


def _limit_threads(count: int) -> None:
    import drjit as dr

    dr.set_thread_count(count)


def take_portraits(sitting: Sitting, out: Path, photo: PhotoSettings) -> list[dict]:
    """Entries of the portraits of one sitting; those that are not in `out` under the same key are rendered now."""
    shots = sitting.shots
    found = {shot.name: read_entry(out, shot, shot.key(photo)) for shot in shots}
    entries = {name: entry for name, entry in found.items() if entry is not None}
    if len(entries) == len(shots):
        return list(entries.values())
    if mi.variant() != VARIANT:
        mi.set_variant(VARIANT)
    started = time.process_time()
    subject = sitting.make()
    beside = None if sitting.make_beside is None else sitting.make_beside()
    camera = portrait_camera(subject.parts, shots[0].pose, photo.size)
    roughness = draw_roughness(np.random.default_rng([shots[0].identity.seed, 51]))
    view = View(subject.parts, roughness, *camera, photo)
    for shot in shots:
        if shot.name not in entries:
            image, arrays = portrait(view, subject, shot, beside)
            views = take_views(view, subject, shot)
            seconds, started = time.process_time() - started, time.process_time()
            by_code = {"roughness": {str(code): value for code, value in roughness.items()}}
            entry = shot.entry() | by_code | measure_portrait(arrays, view) | {"core_seconds": round(seconds, 1)}
            write_portrait(out, image, arrays, views, shot, entry, photo)
            entries[shot.name] = entry
    return [entries[shot.name] for shot in shots]


def portrait(
    view: View, subject: Subject, shot: Shot, beside: Subject | None = None
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """The photo [H, W, 3], linear and exposed, and the arrays of `TRUTH`. `beside` is the second person."""
    random = np.random.default_rng([shot.seed, 52])
    light = light_map(shot.light, random, shot.pose.yaw, shot.environment, shot.extreme)
    radiance, mask = view.photograph(light, shot.seed)
    irradiance, shadow = view.shading(shot.seed + 1)
    covered = mask > 0
    albedos = {name: view.truth[name] for name in ("diffuse_albedo", "specular_albedo")}
    truth = view.truth | {name: (values.T * covered.T).T for name, values in albedos.items()}
    scale = exposure_of(radiance, mask, truth, subject.landmarks[CHIN], shot.light)
    if shot.background == "busy" and shot.environment is not None:
        behind = busy_backdrop(random, shot.environment, view.directions(BUSY_VIEW))
    else:
        behind = backdrop(shot.light, random, light, view.directions())
        behind = behind * scale if shot.light == "outdoor" else behind
    behind = np.minimum(behind, BRIGHTEST)
    if beside is not None:
        other, other_mask = photograph_beside(view, beside, shot, light)
        behind = other * scale + (1 - other_mask[..., None]) * behind
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


def photograph_beside(view: View, beside: Subject, shot: Shot, light: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Radiance [H, W, 3] and coverage [H, W] of a second person, who stands behind the first and to one side, under the
    same light; neither shadows the other."""
    random = np.random.default_rng([shot.seed, 53])
    right, _, forward = view.world_to_camera[:3, :3]
    depth = random.uniform(*BEHIND)
    width = shot.pose.extent / 2 * (1 + depth / shot.pose.distance)
    shift = depth * forward * [1, 0, 1] + random.choice([-1, 1]) * random.uniform(*ASIDE) * width * right
    shift[1] = random.uniform(*TALLER)
    facing = shot.pose.yaw + random.uniform(*TURNED)
    parts = Similarity(1.0, yaw_rotation(facing), shift).move(beside.parts)
    other = View(parts, draw_roughness(random), view.K, view.world_to_camera, view.settings)
    return other.photograph(light, shot.seed + 7, view.settings.view_samples)


def take_views(view: View, subject: Subject, shot: Shot) -> dict[str, np.ndarray]:
    """The arrays of `VIEW` for each view of the head relit and turned; none for a head that is not relit."""
    arrays = {}
    nose = fill_missing_landmarks(subject.landmarks, subject.landmarks_valid)[NOSE_TIP]
    lights = [read_environment(path) for path in shot.relights]
    for number, (name, (light, degrees)) in enumerate(VIEWS.items() if lights else ()):
        turned = view.turn(degrees)
        radiance, mask = turned.photograph(lights[light], shot.seed + 2 + number, view.settings.view_samples)
        arrays[f"{name}_image"] = np.minimum(radiance, LARGEST_HALF).astype(np.float16)
        arrays[f"{name}_mask"] = np.rint(255 * mask).astype(np.uint8)
        arrays[f"{name}_region"] = turned.region
        arrays[f"{name}_face"] = find_face(turned, nose)
    return arrays


def find_face(view: View, nose: np.ndarray) -> np.ndarray:
    """The pixels [H, W] of skin and eyes within `FACE_RADIUS` of the nose tip [3]."""
    near = np.linalg.norm(view.position - nose, axis=-1) * MILLIMETRES_PER_UNIT < FACE_RADIUS
    return near & np.isin(view.region, (SKIN, EYE))


def measure_portrait(arrays: dict[str, np.ndarray], view: View) -> dict[str, float]:
    """Share of the person's pixels with a channel above white, and mean luminance of the albedo of the face's skin."""
    clipped = (arrays["image"][arrays["mask"] > 0.5] > 1).any(axis=-1).mean()
    nose = fill_missing_landmarks(arrays["landmarks"], arrays["landmarks_valid"])[NOSE_TIP]
    skin = find_face(view, nose) & (view.region == SKIN)
    albedo = arrays["diffuse_albedo"][skin] @ np.array(LUMINANCE)
    return {"clipped": round(float(clipped), 4), "skin_luminance": round(float(albedo.mean()), 4)}


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


def photo_of(benchmark: Path, name: str) -> Path:
    """The photo of a portrait."""
    return benchmark / "photos" / f"{name}.jpg"


def camera_of(benchmark: Path, name: str) -> Path:
    """The file of the camera of a portrait's photo."""
    return benchmark / "photos" / f"{name}.camera.json"


def truth_of(benchmark: Path, name: str) -> Path:
    """The folder of the truth of a portrait."""
    return benchmark / "truth" / name


def write_portrait(
    out: Path, image: np.ndarray, arrays: dict, views: dict, shot: Shot, entry: dict, photo: PhotoSettings
) -> None:
    """Writes the portrait's photo, camera and truth, `portrait.json` last."""
    folder = truth_of(out, shot.name)
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: cannot be created ({error.strerror})") from None
    (folder / "portrait.json").unlink(missing_ok=True)
    picture = Image.fromarray((np.clip(linear_to_srgb(image), 0, 1) * 255 + 0.5).astype(np.uint8))
    exif = Image.Exif()
    if shot.exif:
        exif.get_ifd(EXIF_IFD)[FOCAL_TAG] = round(shot.pose.focal_35mm)
    coding = {"quality": photo.jpeg_quality, "subsampling": photo.jpeg_subsampling, "exif": exif}
    write_through(photo_of(out, shot.name), lambda file: picture.save(file, format="JPEG", **coding))
    camera = Camera(arrays["K"].astype(float), arrays["world_to_camera"].astype(float), photo.size, photo.size)
    write_text(camera_of(out, shot.name), camera.to_json())

    def save(file: Path, content: dict) -> None:
        with file.open("wb") as opened:
            np.savez_compressed(opened, **content)

    write_through(folder / "truth.npz", partial(save, content=arrays))
    if views:
        write_through(folder / "views.npz", partial(save, content=views))
    write_json(folder / "portrait.json", {"key": shot.key(photo), "entry": entry})


def files_of(benchmark: Path, name: str, views: bool) -> list[Path]:
    """The files of a portrait."""
    folder = truth_of(benchmark, name)
    files = [photo_of(benchmark, name), camera_of(benchmark, name), folder / "truth.npz"]
    return [*files, folder / "views.npz"] if views else files


def read_entry(out: Path, shot: Shot, key: str) -> dict | None:
    """The entry of a complete portrait built under `key`, else None."""
    try:
        stored = json.loads((truth_of(out, shot.name) / "portrait.json").read_text(encoding="utf-8"))
        complete = stored["key"] == key and all(
            path.is_file() for path in files_of(out, shot.name, bool(shot.relights))
        )
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
        named = [(entry["name"], entry["relights"]) for entry in entries]
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{path}: no benchmark ({error}); run python -m studies.portraits build") from error
    if shown != split:
        raise InputError(f"{folder} shows {shown} heads, not {split} heads; build one with --split {split}")
    for name, lights in named:
        if wrong := [text for text in (name, *lights) if Path(text).name != text]:
            raise InputError(f"{path}: {wrong[0]!r} is not the name of a portrait or light")
        files = [*files_of(folder, name, bool(lights)), *(folder / "lights" / f"{light}.exr" for light in lights)]
        for file in files:
            if not file.is_file():
                raise InputError(f"{file} is missing; run python -m studies.portraits build again")
    return entries
