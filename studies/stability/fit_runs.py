"""One fit of corrupt input, in a process of its own, and the error of its avatar against the truth."""

import importlib
import json
import multiprocessing
import os
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import mitsuba as mi
import numpy as np

from sira_mi.avatar.file import PRIOR
from sira_mi.errors import InputError
from sira_mi.files import write_png
from studies.cache import fingerprint, load_or_compute, write_json
from studies.stability.fit_cases import CASES, Case, CorruptInput
from studies.stability.rows import count_non_finite

if TYPE_CHECKING:
    from studies.portraits.truth import Truth

# A fit is repeated when a module of these packages has changed, its input, or how it is scored.
_DEPENDS_ON = ("avatar", "export", "fields", "fit", "optimisation", "plugins", "portrait", "relight", "sg")
_GEOMETRY_SAMPLES = 4000


class CrashedError(RuntimeError):
    """A fit's process ended without a result."""


@dataclass(frozen=True)
class Fit:
    """One fit."""

    case: str  # name of one of `CASES`
    truth: Path  # folder of the portrait
    variant: str
    seed: int = 0

    def find_case(self) -> Case:
        return next(case for case in CASES if case.name == self.case)


def run_fit(fit: Fit, work: Path) -> dict:
    """The result of a fit, which runs now unless `work` holds it: `refused`, the message of its InputError; or
    `crashed`, the exit code; or `notes`, `face_mm`, `psnr_db`, `non_finite`, `closed` and `core_seconds`. A picture and
    what the fit printed stay in `work`."""
    case = fit.find_case()
    described = json.dumps([fit.case, case.view, case.settings.describe(), fit.seed, fit.variant])
    key = fingerprint(described, fit.truth / "truth.npz", PRIOR, *list_code())
    path = work / "fits" / f"{fit.case.replace(' ', '_')}_{fit.seed}.json"
    try:
        return load_or_compute(path, key, lambda: _run_in_process(fit, path))
    except CrashedError as error:
        return {"crashed": error.args[0]}


def list_code() -> list[Path]:
    """The modules that the result of a fit depends on."""
    packages = [importlib.import_module(f"sira_mi.{name}").__path__[0] for name in _DEPENDS_ON]
    modules = [path for package in packages for path in sorted(Path(package).glob("*.py"))]
    return modules + sorted(Path(__file__).parent.glob("fit_*.py"))


def _run_in_process(fit: Fit, path: Path) -> dict:
    """Runs `_fit` in another process, which may crash. Raises CrashedError with the exit code."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        process = multiprocessing.get_context("spawn").Process(target=_fit, args=(fit, path, Path(folder)))
        process.start()
        process.join()
        try:
            return json.loads((Path(folder) / "result.json").read_text(encoding="utf-8"))
        except (OSError, ValueError):
            raise CrashedError(process.exitcode) from None


def _fit(fit: Fit, path: Path, folder: Path) -> None:
    """Fits and scores; leaves `result.json` in `folder`, and beside `path` a picture and what is printed."""
    with path.with_suffix(".txt").open("w", encoding="utf-8") as printed:
        os.dup2(printed.fileno(), 2)
    mi.set_variant(fit.variant)
    from studies.portraits.truth import load_truth  # its modules need the variant

    truth = load_truth(fit.truth / "truth.npz")
    given = fit.find_case().corrupt(truth)
    try:
        result = _fit_and_score(fit, given, truth, path.with_suffix(".png"), folder)
    except InputError as error:
        result = {"refused": str(error).replace(f"{folder}{os.sep}", "")}
    write_json(folder / "result.json", {**result, "core_seconds": round(time.process_time(), 1)})


def _fit_and_score(fit: Fit, given: CorruptInput, truth: "Truth", picture: Path, folder: Path) -> dict:
    """Whether the fitted avatar is finite and closed, the face's mean error in mm after alignment (H3DS), and the PSNR
    in dB of its picture against the given photo, inside the true mask."""
    import trimesh

    from sira_mi.avatar.file import load_avatar, save_avatar
    from sira_mi.colour import linear_to_srgb
    from sira_mi.fit import output
    from sira_mi.fit.driver import Progress
    from sira_mi.fit.fit import assemble_avatar, fit_portrait, read_portrait
    from sira_mi.fit.stage import FitTask
    from sira_mi.fit.state import initial_state
    from sira_mi.portrait.camera import Camera
    from sira_mi.portrait.portrait import area_resample
    from sira_mi.relight.pictures import psnr_inside
    from studies.head_landmarks import landmarks_of
    from studies.portraits.geometry_scores import GeometrySettings, PredictedHead, score_geometry

    settings = fit.find_case().settings
    if given.camera is not None:
        settings = settings.hold("pose")
    prior = load_avatar(PRIOR)
    portrait = read_portrait(given.write(folder), settings, prior)
    progress = Progress(initial_state(prior, fit.seed))
    task = FitTask(portrait, prior, PRIOR, settings, folder, settings.plan())
    fit_portrait(task, progress, fit.seed)
    avatar = assemble_avatar(prior, progress, settings)
    save_avatar(folder / "avatar.safetensors", avatar)

    camera = task.pose_portrait(progress.state).camera
    lobes = avatar.tensors["lobes"]
    scene = output.load_avatar_scene(
        str(folder / "avatar.safetensors"), camera, lobes, settings.final_voxel, in_photo=True
    )
    layers, head = output.render_layers(scene), scene.shapes()[0]
    shown = (linear_to_srgb(portrait.image), linear_to_srgb(layers["final"]), 0.5 + 0.5 * layers["normal"])
    write_png(picture, np.concatenate(shown, axis=1))

    vertices, faces = head.vertices().T, head.faces()
    landmarks = landmarks_of(prior, head.field())
    height, width = truth.mask.shape
    scale = camera.width / width, camera.height / height
    inside = truth.mask[::-1, ::-1] if given.turned else truth.mask
    inside = area_resample(inside, (0, 0), scale, (camera.width, camera.height)) * (layers["mask"] > 0.99)
    camera = camera.scale(1 / scale[0], 1 / scale[1], width, height)
    if given.turned:
        camera = Camera(camera.K, np.diag([-1.0, -1.0, 1.0, 1.0]) @ camera.world_to_camera, width, height)
    sampling = GeometrySettings(samples=_GEOMETRY_SAMPLES, icp_points=2000)
    scores = score_geometry(PredictedHead(vertices, faces, landmarks, camera), truth, settings=sampling)
    tensors = [value for name, value in avatar.tensors.items() if name != "landmarks"]
    return {
        "notes": progress.notes,
        "face_mm": scores["h3ds_face_mean"],
        "psnr_db": psnr_inside(layers["final"], portrait.image, inside),
        "non_finite": count_non_finite(*tensors, *layers.values(), vertices),
        "closed": bool(trimesh.Trimesh(vertices, faces, process=False).is_watertight),
    }
