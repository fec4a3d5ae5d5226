"""A whole fit: photo -> portrait -> geometry -> appearance -> avatar folder."""

import contextlib
import hashlib
import json
import resource
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import partial
from importlib.metadata import version
from pathlib import Path

import mitsuba as mi
import numpy as np

import sira_mi
from sira_mi.avatar.file import LANDMARK_MODEL, OPTIONAL, PRIOR, Avatar, load_prior, save_avatar
from sira_mi.decisions import Plan, explain
from sira_mi.errors import InputError
from sira_mi.export.mesh import write_mesh
from sira_mi.export.scene import orbit
from sira_mi.export.scene_file import write_scene
from sira_mi.files import write_exr, write_png, write_through
from sira_mi.fit import output
from sira_mi.fit.driver import Progress, load_progress, run_stages, save_progress
from sira_mi.fit.leave_out import plan_fit
from sira_mi.fit.rays import modelled_pixels
from sira_mi.fit.settings import (
    APPEARANCE,
    GEOMETRY,
    POLISH,
    QUALITIES,
    SHADING,
    FitSettings,
    polish_stage,
    without,
)
from sira_mi.portrait.load import linear_to_srgb
from sira_mi.portrait.portrait import Portrait, PortraitSettings, make_portrait
from sira_mi.relight.pictures import preview, psnr_inside
from sira_mi.sg.fit_environment import render_environment
from sira_mi.sg.lights_io import write_lights
from sira_mi.variants import set_variant

# Files of an unfinished fit, inside the output folder.
_WORK = ".fit"
# A head of fewer foreground pixels cannot be fitted.
_LEAST_PIXELS = 200


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
    from sira_mi.fit.polish import before_polish, polish_gain

    settings = QUALITIES[request.quality]
    if request.camera is not None:
        settings = without(settings, "pose")
    if request.polish:
        settings = replace(settings, stages=(*settings.stages, polish_stage()))
    plan = plan_fit(settings).keep_all() if request.keep_all else plan_fit(settings)
    prior_path = request.prior or PRIOR
    prior = load_prior(prior_path)
    portrait = read_portrait(request, settings, prior)
    for note in portrait.notes:
        print(f"note: {note}", file=sys.stderr)
    work = prepare_folder(request.out)
    seconds_portrait = time.monotonic() - started

    identity = identify(portrait, settings, request.seed, prior_path)
    checkpoint = work / "checkpoint.safetensors"
    if request.resume and checkpoint.exists():
        progress = load_progress(checkpoint, identity)
        print(f"note: going on at stage {progress.stage + 1}, step {progress.step}", file=sys.stderr)
    else:
        progress = Progress(initial_tensors(prior, request.seed))

    interrupted = False
    try:
        fit_portrait(
            portrait,
            prior_path,
            settings,
            request.seed,
            work,
            progress,
            lambda p: save_progress(checkpoint, p, identity),
            plan,
        )
    except KeyboardInterrupt:
        interrupted = True
        progress.tensors = before_polish(progress.tensors)
        print("interrupted: writing what there is; --resume goes on from the last checkpoint", file=sys.stderr)

    avatar = finished_avatar(prior, progress, settings)
    report = {
        "quality": request.quality,
        "seed": request.seed,
        "complete": not interrupted,
        "seconds": {"portrait": round(seconds_portrait, 2), **{k: round(v, 2) for k, v in progress.seconds.items()}},
        "losses": progress.losses,
        "settings": asdict(settings),
        "notes": [*portrait.notes, *progress.notes],
        "versions": {"sira_mi": sira_mi.__version__, **{p: version(p) for p in ("mitsuba", "drjit", "numpy")}},
    }
    if request.explain and not interrupted:
        from sira_mi.fit.measure import measured_fit

        problem = stage_problems(portrait, prior, prior_path, work, settings)[APPEARANCE](progress.tensors)
        plan = measured_fit(plan, problem, settings, progress.tensors)
        print(explain(plan), file=sys.stderr)
    report["plan"] = plan.report()
    posed = with_pose(portrait, progress.tensors)
    if request.polish and not interrupted:
        report["polish"] = polish_gain(posed, prior, progress.tensors, work / "geometry.safetensors", settings)
    write_folder(request.out, posed, avatar, settings, report, started)
    if not interrupted:
        for file in work.iterdir():
            file.unlink()
        work.rmdir()
    return 130 if interrupted else 0


def fit_portrait(
    portrait: Portrait,
    prior_path: Path,
    settings: FitSettings,
    seed: int,
    work: Path,
    progress: Progress,
    checkpoint: Callable[[Progress], None] = lambda progress: None,
    plan: Plan | None = None,
) -> None:
    """Runs the stages of `settings` from where `progress` stands, which follows; `work` is a folder for files in
    between, `plan` what is left out (default: that of `plan_fit`). Raises InputError when the fit diverges."""
    problems = stage_problems(portrait, load_prior(prior_path), prior_path, work, settings, plan)
    run_stages([(problems[kind], stage) for kind, stage in settings.stages], progress, settings.block, seed, checkpoint)


def prepare_folder(out: Path) -> Path:
    """Makes the output folder and its work folder, and checks that files can be written there."""
    work = out / _WORK
    try:
        work.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot make the output folder {out}: {error.strerror}; choose another --out") from error
    write_through(work / "probe", lambda file: file.write_bytes(b"0"))
    (work / "probe").unlink()
    return work


def read_portrait(request: FitRequest, settings: FitSettings, prior: Avatar) -> Portrait:
    """The portrait front end on the request's photo. Raises InputError when it cannot be used, and when the head would
    not be in the picture of the camera given."""
    with tempfile.TemporaryDirectory() as folder:
        photo = request.photo
        if request.example:
            import skimage.data

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
    if (modelled_pixels(portrait.camera) & (portrait.mask > 0.5)).sum() < _LEAST_PIXELS:
        raise InputError("the camera does not see the head inside the mask; check --camera and --mask")
    return portrait


def identify(portrait, settings: FitSettings, seed: int, prior_path: Path) -> str:
    """A digest of all that a fit depends on; a checkpoint goes on only with the same."""
    digest = hashlib.sha256()
    for array in (
        portrait.image,
        portrait.mask,
        portrait.landmarks,
        portrait.head_landmarks,
        portrait.camera.K,
        portrait.camera.world_to_camera,
    ):
        digest.update(np.ascontiguousarray(array).tobytes())
    digest.update(json.dumps(asdict(settings), sort_keys=True).encode())
    digest.update(str(seed).encode())
    digest.update(prior_path.read_bytes())
    return digest.hexdigest()


def initial_tensors(prior: Avatar, seed: int) -> dict[str, np.ndarray]:
    """The prior's tensors, latents drawn with small variance about the mean (section 3.2.1)."""
    rng = np.random.default_rng([seed, 1 << 20])
    tensors = {name: values for name, values in prior.tensors.items() if name not in {"landmarks", *LANDMARK_MODEL}}
    for name in ("z_sdf", "z_r", "z_a", "z_s"):
        tensors[name] = (tensors[name] + 0.01 * rng.standard_normal(tensors[name].shape)).astype(np.float32)
    tensors["pose"] = np.zeros(6, np.float32)
    return tensors


def with_pose(portrait: Portrait, tensors: dict[str, np.ndarray]) -> Portrait:
    """The portrait whose camera sees the unmoved head as the fit's `pose` has it."""
    from sira_mi.fit.geometry import moved_camera

    return replace(portrait, camera=moved_camera(portrait.camera, tensors["pose"]))


def stage_problems(
    portrait, prior: Avatar, prior_path: Path, work: Path, settings: FitSettings, plan: Plan | None = None
) -> dict:
    """Per kind of stage a function from the current tensors to the stage's problem. A problem is made from the geometry
    at hand when the kind changes, and serves the stages of its kind that follow each other."""
    from sira_mi.fit.appearance import AppearanceProblem
    from sira_mi.fit.geometry import GeometryProblem
    from sira_mi.fit.polish import PolishProblem
    from sira_mi.fit.shading import ShadingProblem

    made: dict[str, object] = {}

    def of_kind(kind: str, make: Callable[[dict], object]) -> Callable[[dict], object]:
        def problem(tensors):
            if kind not in made:
                made.clear()
                made[kind] = make(tensors)
            return made[kind]

        return problem

    def on_fitted(problem: Callable) -> Callable[[dict], object]:
        def make(tensors):
            path = work / "geometry.safetensors"
            save_avatar(path, prior.replaced(**avatar_tensors(tensors, prior)))
            return problem(with_pose(portrait, tensors), prior, str(path), settings)

        return make

    return {
        GEOMETRY: of_kind(GEOMETRY, lambda tensors: GeometryProblem(portrait, prior, str(prior_path), settings)),
        APPEARANCE: of_kind(APPEARANCE, on_fitted(partial(AppearanceProblem, plan=plan))),
        SHADING: of_kind(SHADING, on_fitted(ShadingProblem)),
        POLISH: of_kind(POLISH, on_fitted(PolishProblem)),
    }


def avatar_tensors(tensors: dict[str, np.ndarray], prior: Avatar) -> dict[str, np.ndarray]:
    """Those of a fit's tensors that are kept in its avatar."""
    return {name: value for name, value in tensors.items() if name in (*prior.tensors, *OPTIONAL)}


def finished_avatar(prior: Avatar, progress: Progress, settings: FitSettings) -> Avatar:
    """The avatar at the fit's last parameters, its light decoded to lobes; k_s and k_r are those of the stages that
    were reached."""
    from sira_mi.fit.shaded import decode_lobes

    tensors = avatar_tensors(progress.tensors, prior)
    floats = {k: mi.Float(tensors[k]) for k in ("illumination", "z_l")}
    tensors["lobes"] = decode_lobes(prior, floats).numpy()
    reached = [stage for _, stage in settings.stages[: progress.stage + 1]]
    k_s = reached[-1].k_s[1] if progress.stage < len(settings.stages) else settings.stages[-1][1].k_s[1]
    return replace(prior.replaced(**tensors), k_s=k_s, k_r=reached[-1].k_r)


def write_folder(out: Path, portrait, avatar: Avatar, settings: FitSettings, report: dict, started: float) -> None:
    """Writes everything that a fit leaves behind."""
    begun = time.monotonic()
    avatar_path = out / "avatar.safetensors"
    save_avatar(avatar_path, avatar)
    lobes = avatar.tensors["lobes"]
    write_lights(out / "lights.json", lobes)
    write_exr(out / "lights.exr", render_environment(lobes, 128))
    write_png(out / "input.png", preview("final", portrait.image, portrait.mask))
    write_scene(out / "scene.xml", portrait.camera)

    scene = output.avatar_scene(str(avatar_path), portrait.camera, lobes, settings.final_voxel, in_photo=True)
    layers = output.render_layers(scene)
    with contextlib.suppress(FileExistsError):
        (out / "renders").mkdir()
    output.write_renders(out / "renders", layers)
    write_mesh(out / "mesh.ply", scene.shapes()[0])

    box = output.head_box(np.maximum(layers["mask"], portrait.mask * (layers["mask"] > 0)))
    close = output.box_camera(portrait.camera, box)
    turned = []
    for yaw in (-30, 30):
        camera = orbit(close, yaw)
        view = output.avatar_scene(str(avatar_path), camera, output.SECOND_LIGHT, settings.voxel, extra_channels=False)
        turned.append(linear_to_srgb(output.render_radiance(view)))
    write_png(out / "contact.png", output.contact_sheet(portrait.image, portrait.mask, layers, turned, box))

    inside = portrait.mask * (layers["mask"] > 0.99)
    report["psnr_inside_mask_db"] = round(psnr_inside(layers["final"], portrait.image, inside), 2)
    eq_8 = layers["diffuse"] + layers["specular"]
    report["psnr_of_unrefined_light_db"] = round(psnr_inside(eq_8, portrait.image, inside), 2)
    report["camera"] = portrait.camera.to_dict()
    report["seconds"]["output"] = round(time.monotonic() - begun, 2)
    report["seconds"]["total"] = round(time.monotonic() - started, 2)
    report["peak_memory_megabytes"] = round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
    output.write_report(out / "avatar.json", report)
    print(
        f"{out}: {report['psnr_inside_mask_db']:.1f} dB inside the mask, {report['seconds']['total']:.0f} s, "
        f"{report['peak_memory_megabytes']} MB",
        file=sys.stderr,
    )
