"""All scores of one portrait's row: relit and turned pictures, and geometry and appearance of its avatar if there is
one."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from sira_mi.avatar.file import PRIOR, load_avatar
from sira_mi.avatar.shape import HeadShape
from sira_mi.conventions import MILLIMETRES_PER_UNIT
from sira_mi.errors import InputError
from sira_mi.files import read_exr, read_json
from sira_mi.portrait.camera import Camera
from studies.head_landmarks import landmarks_of
from studies.portraits.appearance_scores import PredictedAppearance, score_appearance, score_tone
from studies.portraits.geometry_scores import PredictedHead, TrueSurface, score_geometry, true_surface
from studies.portraits.photo_frame import read_frame
from studies.portraits.relit_scores import score_view
from studies.portraits.truth import VIEWS, TrueView, Truth, load_truth, load_views

VERSION = "1"  # of the scores, for the keys of caches
_LAYERS = ("normal", "final", "diffuse", "specular", "diffuse_albedo", "specular_albedo")
_HEAD = ("vertices", "faces", "landmarks", "K", "world_to_camera")


def score_portrait(
    truth_folder: Path, row_folder: Path, exposures: dict[str, float], prior: Path = PRIOR
) -> dict[str, float]:
    """Scores of RUNS/ROW/NAME (`row_folder`) against BENCH/truth/NAME (`truth_folder`). `exposures` holds
    `relit_lights.exposure_of` by the name of the light, for all lights of the portrait's views; `prior` is the avatar's
    (for its landmarks). A Mitsuba variant must be set.

    `VIEW_SCORE` of `relit_scores.score_view` for every VIEW.exr that is there: linear radiance [H, W, 3] under the
    environment as it is, at the pixels of the truth; its alpha, where it has one, is the coverage, else every pixel
    that is not black is covered. Where the row has failed, views that are not there count as black. Where there is
    `avatar/avatar.json`, also the scores of `geometry_scores.score_geometry`, `appearance_scores.score_appearance` and
    `score_tone`; where there is `head.npz` instead (`vertices`, `faces`, `landmarks`, `K`, `world_to_camera`: a head
    without an appearance), those of its geometry. What is absent has no scores. Raises InputError for files that are
    damaged or of another size than the photo."""
    truth, views = _load_true_portrait(truth_folder)
    failed = has_failed(row_folder)
    scores: dict[str, float] = {}
    for name, view in views.items():
        picture = row_folder / f"{name}.exr"
        if picture.exists():
            radiance, coverage = read_exr(picture)
        elif failed:
            radiance, coverage = np.zeros_like(view.image), None
        else:
            continue
        found = score_view(radiance, view, exposures[view.light], coverage)
        scores |= {f"{name}_{score}": value for score, value in found.items()}
    if (row_folder / "avatar" / "avatar.json").exists():
        head, appearance = read_avatar(row_folder / "avatar", prior, *truth.mask.shape)
        scores |= score_geometry(head, truth, _find_true_surface(truth_folder)) | score_appearance(appearance, truth)
        scores |= score_tone(appearance, truth, views[next(iter(VIEWS))].face)
    elif (row_folder / "head.npz").exists():
        head = _read_head(row_folder / "head.npz", *truth.mask.shape)
        scores |= score_geometry(head, truth, _find_true_surface(truth_folder))
    return scores


def has_failed(row_folder: Path) -> bool:
    """Whether `row.json` or `pictures.json` of a row has an `error`."""
    for name in ("row.json", "pictures.json"):
        if (row_folder / name).exists():
            said = read_json(row_folder / name, "record of a row")
            if "error" in said or "error" in said.get("result", {}):
                return True
    return False


@lru_cache(maxsize=1)
def _load_true_portrait(folder: Path) -> tuple[Truth, dict[str, TrueView]]:
    """Kept for the next row of the same portrait."""
    truth, views = load_truth(folder / "truth.npz"), load_views(folder)
    for name, view in views.items():
        if view.mask.shape != truth.mask.shape:
            raise InputError(f"{folder}: {name} is not of the photo's size; build the benchmark again")
    return truth, views


@lru_cache(maxsize=1)
def _find_true_surface(folder: Path) -> TrueSurface:
    """Kept likewise; pictures alone do not need it."""
    return true_surface(_load_true_portrait(folder)[0])


def read_avatar(folder: Path, prior: Path, height: int, width: int) -> tuple[PredictedHead, PredictedAppearance]:
    """What a fit's folder says about the head and its appearance at the pixels of a photo of that size."""
    import trimesh  # takes seconds

    frame = read_frame(folder)
    try:
        layers = {name: read_exr(folder / "renders" / f"{name}.exr")[0] for name in _LAYERS}
        mask = np.asarray(Image.open(folder / "renders" / "mask.png").convert("L"), np.float32) / 255
        mesh: Any = trimesh.load(folder / "mesh.ply", process=False)
    except (OSError, ValueError) as error:
        raise InputError(f"{folder} is not the folder of a complete fit: {error}; fit the photo again") from error
    layers = {name: frame.lay_on_photo(image, width, height) for name, image in layers.items()}
    mask = frame.lay_on_photo(mask, width, height)
    avatar = load_avatar(folder / "avatar.safetensors")
    head = PredictedHead(
        vertices=np.asarray(mesh.vertices, np.float64) * (1000 / MILLIMETRES_PER_UNIT),
        faces=np.asarray(mesh.faces),
        landmarks=landmarks_of(load_avatar(prior), HeadShape(avatar.architecture).field(avatar.tensors)),
        camera=frame.camera_of_photo(width, height),
        normal=layers["normal"],
        mask=mask,
    )
    return head, PredictedAppearance(
        final=layers["final"],
        diffuse_albedo=layers["diffuse_albedo"],
        specular_albedo=layers["specular_albedo"][..., 0],
        mask=mask,
        shaded=layers["diffuse"] + layers["specular"],
    )


def _read_head(path: Path, height: int, width: int) -> PredictedHead:
    try:
        with np.load(path, allow_pickle=False) as file:
            data = {name: file[name] for name in _HEAD}
    except (OSError, KeyError, ValueError) as error:
        raise InputError(f"{path} is not a head: {error}; run the row again") from error
    camera = Camera(data.pop("K"), data.pop("world_to_camera"), width, height)
    return PredictedHead(camera=camera, **data)
