"""A whole fit: photo -> portrait -> geometry -> appearance -> avatar folder."""

import contextlib
import hashlib
import json
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path

import mitsuba as mi
import numpy as np
import skimage.data

import sira_mi
from sira_mi.avatar.file import PRIOR, Avatar, load_prior, save_avatar
from sira_mi.decisions import explain
from sira_mi.errors import InputError
from sira_mi.export.mesh import write_mesh
from sira_mi.export.scene_file import write_scene
from sira_mi.files import check_outputs, hold_folder, write_exr, write_png
from sira_mi.fit import output
from sira_mi.fit.driver import Progress, load_progress, run_stages, save_progress
from sira_mi.fit.measure import measure_fit
from sira_mi.fit.memory import peak_memory
from sira_mi.fit.polish import measure_polish
from sira_mi.fit.rays import find_modelled_pixels
from sira_mi.fit.settings import QUALITIES, polish_stage
from sira_mi.fit.shaded import decode_lobes
from sira_mi.fit.stage import FitSettings, FitTask
from sira_mi.fit.state import initial_state
from sira_mi.interrupts import INTERRUPTED
from sira_mi.portrait.portrait import Portrait, PortraitSettings, make_portrait
from sira_mi.relight.pictures import preview, psnr_inside
from sira_mi.sg.fit_environment import render_environment
from sira_mi.sg.lights_io import write_lights
from sira_mi.sg.lobes import scale_lobes
from sira_mi.variants import set_variant

# Files of an unfinished fit, inside the output folder.
_WORK = ".fit"
# A head of fewer foreground pixels cannot be fitted.
_LEAST_PIXELS = 200
_CHECKPOINT = "checkpoint.safetensors"
# What a fit leaves in its output folder.
_OUTPUTS = (
    "avatar.json",
    "avatar.safetensors",
    "contact.png",
    "input.png",
    "lights.exr",
    "lights.json",
    "mesh.ply",
    "renders",
    "scene.xml",
)


@dataclass(frozen=True)
class FitRequest:
    """What the command line asks for; paths or None."""

    photo: Path | None
    out: Path
    quality: str = "standard"
    seed: int = 0
    example: bool = False  # the portrait of scikit-image instead of `photo`
    resume: bool = False
    mask: Path | None = None
    camera: Path | None = None
    face: int | None = None
    prior: Path | None = None
    polish: bool = False  # path traced, after all other stages
    explain: bool = False  # print what the stages leave out, with its measured error and time
    keep_all: bool = False  # leave nothing out
    variant: str = "llvm_ad_rgb"


def fit_photo(request: FitRequest) -> int:
    """Fits an avatar and writes its folder; returns the exit code, 130 after an interrupt that left an avatar.

    Raises InputError for anything wrong with the photo, the options or the output folder."""
    started = time.monotonic()
    set_variant(request.variant)
    check_folder(request)
    work = request.out / _WORK
    with hold_folder(work):
        complete = _fit_in_folder(request, work, started)
    if complete:
        with contextlib.suppress(OSError):  # another fit may have begun
            work.rmdir()
    return 0 if complete else INTERRUPTED


def _fit_in_folder(request: FitRequest, work: Path, started: float) -> bool:
    """Fits and writes the folder; returns whether the fit is complete."""
    if note := describe_start(request.out, request.resume):
        print(f"note: {note}", file=sys.stderr)
    task = prepare_fit(request, work)
    seconds_portrait = time.monotonic() - started

    progress, complete = run_fit(request, task)
    avatar = assemble_avatar(task.prior, progress, task.settings, task.portrait.exposure)
    save_avatar(request.out / "avatar.safetensors", avatar)
    report = {
        "quality": request.quality,
        "seed": request.seed,
        "complete": complete,
        "seconds": {"portrait": round(seconds_portrait, 2), **{k: round(v, 2) for k, v in progress.seconds.items()}},
        "losses": progress.losses,
        "settings": task.settings.describe(),
        "notes": [*task.portrait.notes, *progress.notes],
        "versions": {"sira_mi": sira_mi.__version__, **{p: version(p) for p in ("mitsuba", "drjit", "numpy")}},
    }
    if request.explain and complete:
        print("measuring what the stages leave out", file=sys.stderr)
        task.plan = measure_fit(task, progress.state)
        print(explain(task.plan), file=sys.stderr)
    report["plan"] = task.plan.report()
    if request.polish and complete:
        print("measuring the polish by path tracing", file=sys.stderr)
        report["polish"] = measure_polish(task, polish_stage(), progress.state)
    write_folder(request.out, task.pose_portrait(progress.state), avatar, task.settings, report, started)
    if complete:
        for file in (work / _CHECKPOINT, task.avatar_file):
            file.unlink(missing_ok=True)
    return complete


def check_folder(request: FitRequest) -> None:
    """Raises InputError when the fit would overwrite one of its inputs, or files in the output folder that are of no
    fit."""
    out, inputs = request.out, (request.photo, request.mask, request.camera, request.prior)
    files = [out / name for name in _OUTPUTS if name != "renders"]
    check_outputs([*files, *(out / "renders" / path.name for path in inputs if path is not None)], inputs)
    there = [name for name in _OUTPUTS if (out / name).exists()]
    if there and "avatar.json" not in there and not (out / _WORK).is_dir():
        raise InputError(
            f"{out} is no folder of a fit and has files that would be overwritten: {', '.join(there)}; choose another "
            "--out"
        )


def describe_start(out: Path, resume: bool) -> str | None:
    """What the user should know about where a fit starts, None where that is plain."""
    checkpoint = (out / _WORK / _CHECKPOINT).exists()
    if resume and not checkpoint:
        return f"{out} has no checkpoint to resume from; the fit starts at its beginning"
    if checkpoint and not resume:
        return f"{out} has the checkpoint of an unfinished fit; this fit starts anew and will replace it (see --resume)"
    return None


def prepare_fit(request: FitRequest, work: Path) -> FitTask:
    """Settings, prior and portrait of a request; `work` is for its files in between. Raises InputError."""
    settings = QUALITIES[request.quality]
    if request.camera is not None:
        settings = settings.hold("pose")
    if request.polish:
        settings = replace(settings, stages=(*settings.stages, polish_stage()))
    prior_path = request.prior or PRIOR
    prior = load_prior(prior_path)
    portrait = read_portrait(request, settings, prior)
    for note in portrait.notes:
        print(f"note: {note}", file=sys.stderr)
    plan = settings.plan().keep_all() if request.keep_all else settings.plan()
    return FitTask(portrait, prior, prior_path, settings, work, plan)


def run_fit(request: FitRequest, task: FitTask) -> tuple[Progress, bool]:
    """Runs the stages from their start, or from the checkpoint where the request says so. Returns the progress, and
    whether they are complete: after an interrupt they are not, and an unfinished polish is undone."""
    checkpoint = task.folder / _CHECKPOINT
    identity = identify(task, request.seed)
    if request.resume and checkpoint.exists():
        progress = load_progress(checkpoint, identity)
        print(f"note: going on at stage {progress.stage + 1}, step {progress.step}", file=sys.stderr)
    else:
        progress = Progress(initial_state(task.prior, request.seed))
    try:
        fit_portrait(task, progress, request.seed, lambda p: save_progress(checkpoint, p, identity))
    except KeyboardInterrupt:
        print("interrupted: writing what there is; --resume goes on", file=sys.stderr)
        progress.state = progress.state.before_polish()
        return progress, False
    return progress, True


def fit_portrait(
    task: FitTask, progress: Progress, seed: int, checkpoint: Callable[[Progress], None] = lambda progress: None
) -> None:
    """Runs the stages from where `progress` stands, which follows. Raises InputError when the fit diverges."""
    settings = task.settings
    run_stages(
        settings.stages, lambda stage, state: stage.problem(task, state), progress, settings.block, seed, checkpoint
    )


def read_portrait(request: FitRequest, settings: FitSettings, prior: Avatar) -> Portrait:
    """The portrait front end on the request's photo. Raises InputError when it cannot be used, and when the head would
    not be in the picture of the camera given."""
    with tempfile.TemporaryDirectory() as folder:
        photo = request.photo
        if photo is None:
            photo = Path(folder) / "astronaut.png"
            write_png(photo, skimage.data.astronaut() / 255)
        portrait = make_portrait(
            photo,
            PortraitSettings(working_size=settings.working_size),
            prior.tensors["landmarks"],
            mask_path=request.mask,
            camera_path=request.camera,
            face=request.face,
        )
    if (find_modelled_pixels(portrait.camera) & (portrait.mask > 0.5)).sum() < _LEAST_PIXELS:
        raise InputError("the camera does not see the head inside the mask; check --camera and --mask")
    return portrait


def identify(task: FitTask, seed: int) -> str:
    """A digest of all that a fit depends on, the package's version and the variant included; a checkpoint goes on only
    with the same."""
    portrait, digest = task.portrait, hashlib.sha256()
    for array in (
        portrait.image,
        portrait.image if portrait.sharp is None else portrait.sharp,
        portrait.mask,
        portrait.landmarks,
        portrait.head_landmarks,
        portrait.camera.K,
        portrait.camera.world_to_camera,
    ):
        digest.update(np.ascontiguousarray(array).tobytes())
    described = [task.settings.describe(), seed, sira_mi.__version__, mi.variant()]
    digest.update(json.dumps(described, sort_keys=True).encode())
    digest.update(task.prior_path.read_bytes())
    return digest.hexdigest()


def assemble_avatar(prior: Avatar, progress: Progress, settings: FitSettings, exposure: float = 1.0) -> Avatar:
    """The avatar at the fit's last parameters, its light decoded to lobes, in the unit of a photo that was fitted at
    `exposure`; k_s and k_r are those of the last stage that was reached."""
    parameters = progress.state.avatar
    lobes = decode_lobes(prior, {k: mi.Float(parameters[k]) for k in ("illumination", "z_l")}).numpy()
    lobes = scale_lobes(lobes, 1 / exposure)
    reached = settings.stages[min(progress.stage, len(settings.stages) - 1)]
    return replace(prior.with_tensors(**parameters, lobes=lobes), k_s=reached.k_s[1], k_r=reached.k_r)


def write_folder(
    out: Path, portrait: Portrait, avatar: Avatar, settings: FitSettings, report: dict, started: float
) -> None:
    """Completes the report and writes everything that a fit leaves behind beside the avatar file. The camera of
    `portrait` sees the head unmoved."""
    begun = time.monotonic()
    print("rendering and writing the folder", file=sys.stderr)
    avatar_path = out / "avatar.safetensors"
    lobes = avatar.tensors["lobes"]
    write_lights(out / "lights.json", lobes)
    write_exr(out / "lights.exr", render_environment(lobes, 128))
    write_scene(out / "scene.xml", portrait.camera)

    exposed = scale_lobes(lobes, portrait.exposure)
    scene = output.load_avatar_scene(str(avatar_path), portrait.camera, exposed, settings.final_voxel, in_photo=True)
    write_mesh(out / "mesh.ply", scene.shapes()[0])
    layers = output.render_layers(scene)
    output.write_renders(out / "renders", layers, portrait.exposure)
    write_png(out / "input.png", preview("final", portrait.image, portrait.mask))
    write_png(out / "contact.png", output.draw_contact_sheet(str(avatar_path), portrait, layers, settings.voxel))

    inside = portrait.mask * (layers["mask"] > 0.99)
    report["psnr_inside_mask_db"] = round(psnr_inside(layers["final"], portrait.image, inside), 2)
    report["camera"] = portrait.camera.to_dict()
    report["window"] = portrait.window
    report["exposure"] = portrait.exposure
    report["seconds"]["output"] = round(time.monotonic() - begun, 2)
    report["seconds"]["total"] = round(time.monotonic() - started, 2)
    report["peak_memory_megabytes"] = round(peak_memory() / 2**20)
    output.write_report(out / "avatar.json", report)
    print(
        f"{out}: {report['psnr_inside_mask_db']:.1f} dB inside the mask, {report['seconds']['total']:.0f} s, "
        f"{report['peak_memory_megabytes']} MB",
        file=sys.stderr,
    )
