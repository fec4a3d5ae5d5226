"""Training scenes: the arrays of a collection that the statistical models may see.

Albedo truth is in the scene files too, but is not loaded here: training never sees it. Nor does it see the views
`HELD_OUT_VIEWS`, on which renderings are compared.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from zipfile import BadZipFile

import numpy as np

from sira_mi.conventions import HELD_OUT_VIEWS
from sira_mi.errors import InputError
from sira_mi.files import read_json

_MAXIMUM_MANIFEST_BYTES = 64 << 20
_ARRAYS = (
    "points",
    "normals",
    "region",
    "volume",
    "volume_distance",
    "landmarks",
    "landmarks_valid",
    "visible",
    "colors",
    "world_to_camera",
)


@dataclass(frozen=True)
class TrainingScene:
    """One head scan with its views; coordinates in scene units, colours linear."""

    points: np.ndarray  # [P, 3] on the visible surface
    normals: np.ndarray  # [P, 3] unit
    region: np.ndarray  # [P] uint8: 0 skin, 1 hair, 2 eye, 3 cloth
    volume: np.ndarray  # [Q, 3] points of known signed distance
    volume_distance: np.ndarray  # [Q], positive outside
    landmarks: np.ndarray  # [468, 3], NaN where unknown
    sample_point: np.ndarray  # [C] index of the point that observation c belongs to
    sample_view: np.ndarray  # [C] index of the view that saw it
    sample_color: np.ndarray  # [C, 3] linear radiance
    camera_centres: np.ndarray  # [V, 3]

    def views(self, samples: np.ndarray) -> np.ndarray:
        """Unit directions [n, 3] from the camera to the point, for observations `samples` [n]."""
        v = self.points[self.sample_point[samples]] - self.camera_centres[self.sample_view[samples]]
        return v / np.linalg.norm(v, axis=1, keepdims=True)


def load_scene(path: Path) -> TrainingScene:
    """Reads one scene of a collection. Raises InputError for a file that is not one."""
    try:
        with np.load(path, allow_pickle=False) as file:
            data = {name: file[name] for name in _ARRAYS}
    except (OSError, KeyError, ValueError, EOFError, BadZipFile) as error:
        raise InputError(f"{path} is not a scene of a collection: {error}") from error
    rotation, translation = data["world_to_camera"][:, :3, :3], data["world_to_camera"][:, :3, 3]
    usable = data["visible"] & np.isfinite(data["colors"]).all(axis=2)
    usable[:, np.isin(np.arange(usable.shape[1]), HELD_OUT_VIEWS)] = False
    point, view = np.nonzero(usable)
    return TrainingScene(
        points=data["points"].astype(np.float32),
        normals=data["normals"].astype(np.float32),
        region=data["region"].astype(np.uint8),
        volume=data["volume"].astype(np.float32),
        volume_distance=data["volume_distance"].astype(np.float32),
        landmarks=np.where(data["landmarks_valid"][:, None], data["landmarks"], np.nan).astype(np.float32),
        sample_point=point.astype(np.int32),
        sample_view=view.astype(np.uint8),
        sample_color=data["colors"][point, view].astype(np.float32),
        camera_centres=(-np.einsum("vji,vj->vi", rotation, translation)).astype(np.float32),
    )


def load_training_scenes(folder: Path, sources: Sequence[str] = ()) -> list[TrainingScene]:
    """The scenes of the manifest's training split, of `sources` where these are named. Raises InputError for a source
    that has none, and when there are fewer than two scenes."""
    try:
        manifest = read_json(folder / "manifest.json", "manifest of a collection", _MAXIMUM_MANIFEST_BYTES)
        scenes = [scene for scene in manifest["scenes"] if scene["split"] == "train" and "error" not in scene]
        files = [(str(scene["file"]), scene.get("source")) for scene in scenes]
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(
            f"{folder} is not a collection: {error}; build one with python -m sira_mi.training.collection"
        ) from error
    known = sorted({str(source) for _, source in files})
    if unknown := set(sources) - set(known):
        raise InputError(
            f"{folder} has no training scenes of {', '.join(sorted(unknown))}; its sources are {', '.join(known)}"
        )
    names = [Path(file).name for file, source in files if not sources or source in sources]
    if len(names) < 2:
        raise InputError(f"{folder} has {len(names)} training scenes; at least two are needed")
    return [load_scene(folder / name) for name in names]
