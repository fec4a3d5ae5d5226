"""Fits a portrait by one method and writes the files for scores and for methods that continue from it.

A fit gets the photo only. It writes `avatar.safetensors`, `tensors.safetensors` (the start of later methods) and
`head.npz` (mesh, landmarks, camera and pictures).
"""

import tempfile
import time
from pathlib import Path

import mitsuba as mi
import numpy as np
from PIL import Image

from sira_mi.avatar.file import Avatar, load_avatar, save_avatar
from sira_mi.avatar.landmark_model import landmarks_of
from sira_mi.errors import InputError
from sira_mi.files import write_through
from sira_mi.fit import output
from sira_mi.fit.driver import Progress
from sira_mi.fit.fit import assemble_avatar, fit_portrait
from sira_mi.fit.shaded import find_surface_points
from sira_mi.fit.stage import FitSettings
from sira_mi.fit.state import FitState, initial_state
from sira_mi.optimisation.adam import read_arrays, write_arrays
from sira_mi.portrait.camera import Camera
from sira_mi.portrait.portrait import PortraitSettings, make_portrait
from studies.portraits.fit_job import Job
from studies.portraits.methods import BY_NAME, Method


def fit_and_write(job: Job) -> dict:
    """Fits and writes all files of `job`; returns `seconds` by stage, last `losses` and `notes`. Raises InputError."""
    method: Method = BY_NAME[job.method]
    settings = method.settings(job.settings)
    prior = load_avatar(job.prior)
    started = time.monotonic()
    portrait = make_portrait(
        job.photo, PortraitSettings(working_size=settings.working_size), prior.tensors["landmarks"]
    )
    seconds = {"portrait": round(time.monotonic() - started, 2)}
    if job.before is None:
        state = initial_state(prior, job.seed)
    else:
        state = FitState.from_arrays(read_arrays(job.before / "tensors.safetensors")[0])
    progress = Progress(method.start(prior, state, job.seed))
    with tempfile.TemporaryDirectory() as work:
        task = method.task(portrait, prior, job.prior, settings, Path(work), settings.plan())
        fit_portrait(task, progress, job.seed)
    write_arrays(job.out / "tensors.safetensors", progress.state.arrays(), {})
    avatar = assemble_avatar(prior, progress, settings)
    save_avatar(job.out / "avatar.safetensors", avatar)
    camera = _photo_camera(job.photo, task.pose_portrait(progress.state).camera)
    _write_head(job.out, method, prior, camera, settings)
    return {
        "seconds": {**seconds, **{k: round(v, 2) for k, v in progress.seconds.items()}},
        "losses": progress.losses,
        "notes": [*portrait.notes, *progress.notes],
    }


def _photo_camera(photo: Path, camera: Camera) -> Camera:
    """The camera of the whole photo from that of the working image. Raises InputError where that is a part of it."""
    width, height = Image.open(photo).size
    if camera.width * height != camera.height * width:
        raise InputError(f"{photo} is cropped to its face before a fit; the benchmark needs photos that are not")
    return camera.scale(width / camera.width, height / camera.height, width, height)


def _write_head(out: Path, method: Method, prior: Avatar, camera: Camera, settings: FitSettings) -> None:
    """Writes `head.npz`, the input of the scores."""
    path = out / "avatar.safetensors"
    avatar = load_avatar(path)
    if method.after is None:
        head = mi.load_dict({"type": "neural_sdf", "avatar": str(path), "voxel": settings.final_voxel})
        pictures = _geometry_pictures(camera, head)
    else:
        scene = output.load_avatar_scene(
            str(path), camera, avatar.tensors["lobes"], settings.final_voxel, in_photo=True
        )
        head = scene.shapes()[0]
        pictures = output.render_layers(scene)
    arrays = {
        "vertices": head.vertices().T,
        "faces": head.faces(),
        "landmarks": landmarks_of(prior, head.field()),
        "K": camera.K,
        "world_to_camera": camera.world_to_camera,
        **{f"image/{name}": image.astype(np.float32) for name, image in pictures.items()},
    }
    write_through(out / "head.npz", lambda file: np.savez_compressed(file, **arrays))


def _geometry_pictures(camera: Camera, head) -> dict[str, np.ndarray]:
    """Normals [H, W, 3] and mask [H, W] at the pixel centres."""
    seen = find_surface_points(camera, head)
    mask = np.zeros((camera.height, camera.width), np.float32)
    normal = np.zeros((*mask.shape, 3), np.float32)
    mask[seen.row, seen.column] = 1
    normal[seen.row, seen.column] = seen.normal.T
    return {"normal": normal, "mask": mask}
