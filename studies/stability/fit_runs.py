"""One fit of a spoilt portrait, in a process of its own, and how far its avatar is from the truth."""

import json
import multiprocessing
import os
import tempfile
import time
from dataclasses import asdict, dataclass
from importlib.util import find_spec
from pathlib import Path

import mitsuba as mi
import numpy as np

from sira_mi.avatar.file import PRIOR
from sira_mi.errors import InputError
from sira_mi.files import write_png, write_through
from studies.cache import fingerprint, load_or_compute
from studies.stability.fit_cases import CASES, Case, Fed
from studies.stability.rows import non_finite

# A fit is repeated when any module of these packages has changed, or how it is fed and scored.
_DEPENDS_ON = ("fields", "fit", "models", "plan", "plugins", "portrait", "sg")
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

    @property
    def the_case(self) -> Case:
        return next(case for case in CASES if case.name == self.case)


def fitted(fit: Fit, work: Path) -> dict:
    """What came of a fit, run now unless `work` holds it: `refused`, the message of its InputError; or `crashed`, the
    exit code; or `notes`, `face_mm`, `psnr_db`, `non_finite`, `closed` and `core_seconds`. A picture and what the fit
    printed stay in `work`."""
    code = [path for name in _DEPENDS_ON for path in _modules(name)] + sorted(Path(__file__).parent.glob("fit_*.py"))
    described = json.dumps([fit.case, fit.the_case.view, asdict(fit.the_case.settings), fit.seed, fit.variant])
    key = fingerprint(described, fit.truth / "truth.npz", PRIOR, *code)
    path = work / "fits" / f"{fit.case.replace(' ', '_')}_{fit.seed}.json"
    try:
        return load_or_compute(path, key, lambda: _in_process(fit, path))
    except CrashedError as error:
        return {"crashed": error.args[0]}


def _modules(package: str) -> list[Path]:
    (folder,) = find_spec(f"sira_mi.{package}").submodule_search_locations
    return sorted(Path(folder).glob("*.py"))


def _in_process(fit: Fit, path: Path) -> dict:
    """Runs `_fit` elsewhere, so that a crash ends nothing else. Raises CrashedError with the exit code."""
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
    fed = fit.the_case.spoil(truth)
    try:
        result = _scores(fit, fed, truth, path.with_suffix(".png"), folder)
    except InputError as error:
        result = {"refused": str(error).replace(f"{folder}{os.sep}", "")}
    text = json.dumps({**result, "core_seconds": round(time.process_time(), 1)})
    write_through(folder / "result.json", lambda file: file.write_text(text, encoding="utf-8"))


def _scores(fit: Fit, fed: Fed, truth, picture: Path, folder: Path) -> dict:
    """How whole the fitted avatar is, the face's mean error in mm after alignment (H3DS), and the PSNR in dB of its
    picture against the photo that it was fed, inside the true mask."""
    import trimesh

    from sira_mi.avatar.file import load_avatar, save_avatar
    from sira_mi.avatar.landmark_model import landmarks_of
    from sira_mi.fit import output
    from sira_mi.fit.driver import Progress
    from sira_mi.fit.fit import FitRequest, finished_avatar, fit_portrait, initial_tensors, read_portrait, with_pose
    from sira_mi.fit.settings import without
    from sira_mi.portrait.camera import Camera
    from sira_mi.portrait.load import linear_to_srgb
    from sira_mi.portrait.portrait import area_resample
    from sira_mi.relight.pictures import psnr_inside
    from studies.portraits.geometry_scores import GeometrySettings, PredictedHead, score_geometry

    settings = fit.the_case.settings
    if fed.camera is not None:
        settings = without(settings, "pose")
    prior = load_avatar(PRIOR)
    portrait = read_portrait(FitRequest(**fed.write(folder), out=folder), settings, prior)
    progress = Progress(initial_tensors(prior, fit.seed))
    fit_portrait(portrait, PRIOR, settings, fit.seed, folder, progress)
    avatar = finished_avatar(prior, progress, settings)
    save_avatar(folder / "avatar.safetensors", avatar)

    camera = with_pose(portrait, progress.tensors).camera
    lobes = avatar.tensors["lobes"]
    scene = output.avatar_scene(str(folder / "avatar.safetensors"), camera, lobes, settings.final_voxel, in_photo=True)
    layers, head = output.render_layers(scene), scene.shapes()[0]
    shown = (linear_to_srgb(portrait.image), linear_to_srgb(layers["final"]), 0.5 + 0.5 * layers["normal"])
    write_png(picture, np.concatenate(shown, axis=1))

    vertices, faces = head.vertices().T, mi.traverse(head)["faces"].numpy().reshape(-1, 3)
    landmarks = landmarks_of(prior, head.field())
    height, width = truth.mask.shape
    scale = camera.width / width, camera.height / height
    inside = truth.mask[::-1, ::-1] if fed.turned else truth.mask
    inside = area_resample(inside, (0, 0), scale, (camera.width, camera.height)) * (layers["mask"] > 0.99)
    camera = camera.scaled(1 / scale[0], 1 / scale[1], width, height)
    if fed.turned:
        camera = Camera(camera.K, np.diag([-1.0, -1.0, 1.0, 1.0]) @ camera.world_to_camera, width, height)
    sampling = GeometrySettings(samples=_GEOMETRY_SAMPLES, icp_points=2000)
    scores = score_geometry(PredictedHead(vertices, faces, landmarks, camera), truth, settings=sampling)
    tensors = [value for name, value in avatar.tensors.items() if name != "landmarks"]
    return {
        "notes": progress.notes,
        "face_mm": scores["h3ds_face_mean"],
        "psnr_db": psnr_inside(layers["final"], portrait.image, inside),
        "non_finite": non_finite(*tensors, *layers.values(), vertices),
        "closed": bool(trimesh.Trimesh(vertices, faces, process=False).is_watertight),
    }
