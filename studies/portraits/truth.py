"""The truth of a benchmark portrait, which only the scores use."""

import json
from dataclasses import dataclass
from pathlib import Path
from zipfile import BadZipFile

import numpy as np

from sira_mi.conventions import LANDMARKS
from sira_mi.errors import InputError
from sira_mi.portrait.camera import Camera

_IMAGES = {
    "image": 3,
    "mask": 1,
    "region": 1,
    "diffuse_albedo": 3,
    "specular_albedo": 1,
    "normal": 3,
    "shading": 1,
    "shadow": 1,
}


@dataclass(frozen=True, eq=False)
class Truth:
    """One portrait. Images are at the photo's pixels, row 0 at the top; the world is the subject's own frame, in scene
    units; colours and albedos are linear. Off the person every image is 0 and `region` 255."""

    camera: Camera
    image: np.ndarray  # [H, W, 3] radiance, exposed as in the photo
    mask: np.ndarray  # [H, W] coverage, 0 to 1
    region: np.ndarray  # [H, W] uint8 of the first hit at the pixel's centre: 0 skin, 1 hair, 2 eye, 3 cloth
    diffuse_albedo: np.ndarray  # [H, W, 3]
    specular_albedo: np.ndarray  # [H, W] reflectance at normal incidence
    normal: np.ndarray  # [H, W, 3] unit
    shading: np.ndarray  # [H, W] luminance of the image over that of the diffuse albedo
    shadow: np.ndarray  # [H, W] share of the unoccluded direct diffuse irradiance that arrives
    vertices: np.ndarray  # [N, 3] of a triangle soup of which only the outer surface matters
    faces: np.ndarray  # [T, 3]
    face_region: np.ndarray  # [T] uint8, codes as in `region`
    landmarks: np.ndarray  # [468, 3], NaN where unknown


@dataclass(frozen=True, eq=False)
class TrueView:
    """The head of a portrait under another light, at the photo's pixels, path traced before a black background. Off the
    person `region` is 255."""

    image: np.ndarray  # [H, W, 3] float32, linear radiance under the environment as it is, premultiplied
    mask: np.ndarray  # [H, W] float32, coverage, 0 to 1
    region: np.ndarray  # [H, W] uint8 of the first hit at the pixel's centre, codes as in `Truth.region`
    face: np.ndarray  # [H, W] bool, skin and eyes within 95 mm of the nose tip
    light: str  # name of the environment in the benchmark's `lights`
    yaw: float  # degrees that the head has turned to its own left about the vertical through its origin


# For each view, which of the portrait's two environments lights it, and how far the head has turned, degrees.
VIEWS = {"relit_1": (0, 0.0), "relit_2": (1, 0.0), "turned_left": (0, 30.0), "turned_right": (0, -30.0)}


def load_truth(path: str | Path) -> Truth:
    """Reads a `truth.npz`. Raises InputError that names the first array that is missing, misshapen or not finite."""
    path = Path(path)
    names = ("K", "world_to_camera", *_IMAGES, "vertices", "faces", "face_region", "landmarks", "landmarks_valid")
    try:
        with np.load(path, allow_pickle=False) as file:
            data = {name: file[name] for name in names}
    except (OSError, KeyError, ValueError, EOFError, BadZipFile) as error:
        raise InputError(f"{path} is not the truth of a portrait: {error}; build the benchmark again") from error
    height, width = data["mask"].shape if data["mask"].ndim == 2 else (0, 0)
    if height * width == 0:
        raise InputError(f"{path}: mask must be an image [H, W]")
    shapes = {name: (height, width, 3)[: 2 + (channels > 1)] for name, channels in _IMAGES.items()}
    shapes |= {"vertices": (None, 3), "faces": (None, 3), "face_region": (len(data["faces"]),)}
    shapes |= {"landmarks": (LANDMARKS, 3), "landmarks_valid": (LANDMARKS,)}
    for name, shape in shapes.items():
        check_array(f"{path}: {name}", data[name], shape, finite=name != "landmarks")
    check_mesh(str(path), data["vertices"], data["faces"])
    for name in ("mask", "shadow"):
        if data[name].min() < 0 or data[name].max() > 1 + 1e-4:
            raise InputError(f"{path}: {name} must be within 0 and 1")
    camera = Camera.from_dict(
        {**{key: data[key].tolist() for key in ("K", "world_to_camera")}, "width": width, "height": height}, str(path)
    )
    valid = data["landmarks_valid"].astype(bool)
    landmarks = np.where(valid[:, None], data["landmarks"].astype(np.float64), np.nan)
    if not np.isfinite(landmarks[valid]).all():
        raise InputError(f"{path}: a valid landmark is not finite")
    images = {name: data[name] if name == "region" else data[name].astype(np.float32) for name in _IMAGES}
    return Truth(
        camera=camera,
        vertices=data["vertices"].astype(np.float64),
        faces=data["faces"].astype(np.int64),
        face_region=data["face_region"],
        landmarks=landmarks,
        **images,
    )


def load_views(folder: str | Path) -> dict[str, TrueView]:
    """Reads `views.npz` and `portrait.json` of a portrait's folder: a view for each of `VIEWS`. Raises InputError that
    names the first array that is missing, misshapen or out of range."""
    path = Path(folder) / "views.npz"
    try:
        relights = json.loads((path.with_name("portrait.json")).read_text(encoding="utf-8"))["entry"]["relights"]
        lights = {name: str(relights[light]) for name, (light, _) in VIEWS.items()}
        with np.load(path, allow_pickle=False) as file:
            data = {name: {key: file[f"{name}_{key}"] for key in ("image", "mask", "region", "face")} for name in VIEWS}
    except (OSError, KeyError, IndexError, TypeError, ValueError, EOFError, BadZipFile) as error:
        raise InputError(f"{folder} holds no views of a portrait: {error}; build the benchmark again") from error
    size = data["relit_1"]["mask"].shape
    if len(size) != 2 or 0 in size:
        raise InputError(f"{path}: relit_1_mask must be an image [H, W]")
    result = {}
    for name, arrays in data.items():
        for key, array in arrays.items():
            check_array(f"{path}: {name}_{key}", array, (*size, 3) if key == "image" else size)
        if arrays["image"].min() < 0:
            raise InputError(f"{path}: {name}_image must not be negative")
        for key, kind in (("mask", "u"), ("region", "u"), ("face", "b")):
            if arrays[key].dtype.kind != kind:
                raise InputError(f"{path}: {name}_{key} must be of type {kind}1, not {arrays[key].dtype}")
        result[name] = TrueView(
            image=arrays["image"].astype(np.float32),
            mask=arrays["mask"].astype(np.float32) / 255,
            region=arrays["region"],
            face=arrays["face"],
            light=lights[name],
            yaw=VIEWS[name][1],
        )
    return result


def check_array(name: str, array: np.ndarray, shape: tuple, finite: bool = True) -> None:
    """Raises InputError unless the array has the shape, where None stands for any length, and (`finite`) no NaN or
    infinity."""
    array = np.asarray(array)
    fits = array.ndim == len(shape) and all(n in (None, m) for n, m in zip(shape, array.shape, strict=True))
    if not fits or array.dtype.kind not in "fiub":
        wanted = ", ".join("any" if n is None else str(n) for n in shape)
        raise InputError(f"{name} must be numbers [{wanted}], not {array.dtype} {list(array.shape)}")
    if finite and not np.isfinite(array).all():
        raise InputError(f"{name} contains NaN or infinity")


def check_mesh(name: str, vertices: np.ndarray, faces: np.ndarray) -> None:
    """Raises InputError unless there are triangles and their indices belong to vertices."""
    if np.asarray(faces).dtype.kind not in "iu" or not len(faces):
        raise InputError(f"{name}: faces must be at least one row of whole numbers")
    if np.min(faces) < 0 or np.max(faces) >= len(vertices):
        raise InputError(f"{name}: faces refer to vertices that do not exist (there are {len(vertices)})")
