"""The avatar: all networks, latents and lights of one head, as one safetensors file.

A prior is the same thing with zero latents, its mean head, so that every plugin opens either. Networks are flat
parameter vectors (`sira_mi.fields.mlp`). The file's metadata holds the format's name and the architecture as JSON;
every size is checked against the architecture before any array is used.
"""

import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from sira_mi.avatar.architecture import AvatarArchitecture
from sira_mi.avatar.skin_tone import SkinPrior
from sira_mi.conventions import LANDMARKS, LEAST_LANDMARKS
from sira_mi.errors import InputError
from sira_mi.files import check_file, parse_json, write_through

FORMAT = "sira-mi avatar 1"
PRIOR = Path(__file__).with_name("prior.safetensors")
_MAXIMUM_BYTES = 64 << 20
_MAXIMUM_LOBES = 4096
_MAXIMUM_DIRECTIONS = 256
# Networks that an avatar may lack.
OPTIONAL = {"light_refinement"}
# Of a prior that knows how landmarks follow from places in reference space (`sira_mi.avatar.landmark_model`).
LANDMARK_MODEL = {"landmark_placed", "landmark_directions", "landmark_offsets"}
# Of an avatar whose albedo has the detail of a photo (`sira_mi.avatar.detail`).
DETAIL = {"detail", "detail_depth", "detail_camera"}
_MAXIMUM_DETAIL = 4096  # pixels a side


@dataclass(frozen=True)
class Avatar:
    """One head. `tensors` holds, as float32 arrays: every network [parameters] and latent [dimension] of the
    architecture (`light_refinement` may be missing); `lobes` [N_l, 7] (axis, sharpness, RGB amplitude) of the light;
    `landmarks` [468, 3], the face landmarks of the mean head in scene units (NaN where unknown). A prior may also hold
    the tensors of `sira_mi.avatar.landmark_model`, an avatar those of `sira_mi.avatar.detail`."""

    architecture: AvatarArchitecture
    tensors: dict[str, np.ndarray]
    roughness: float = 0.5  # of the specular BRDF, fixed
    k_s: float = 1.0  # weight of the specular BRDF, eq. 8
    k_r: float = 1.0  # weight of the albedo refinement, eq. 11
    skin: SkinPrior | None = None  # None in files of earlier versions

    def skin_prior(self) -> SkinPrior:
        """What the prior expects of skin. Raises InputError where the file does not say."""
        if self.skin is None:
            raise InputError(
                "the prior was made by an earlier version, without its constants of skin: run "
                "`python -m sira_mi.training appearance` again"
            )
        return self.skin

    def with_tensors(self, **tensors: np.ndarray) -> "Avatar":
        """The same avatar with some tensors replaced."""
        return dataclasses.replace(self, tensors={**self.tensors, **tensors})


def save_avatar(path: str | Path, avatar: Avatar) -> None:
    """Writes a safetensors file under a temporary name, then renames it.

    Raises InputError when the file cannot be written."""
    description = {
        "architecture": avatar.architecture.to_dict(),
        "roughness": avatar.roughness,
        "k_s": avatar.k_s,
        "k_r": avatar.k_r,
    }
    if avatar.skin is not None:
        description["skin"] = dataclasses.asdict(avatar.skin)
    tensors = {k: np.ascontiguousarray(v, dtype=np.float32) for k, v in sorted(avatar.tensors.items())}
    data = save(tensors, metadata={"format": FORMAT, "avatar": json.dumps(description, sort_keys=True)})
    data = _sort_header(data)
    write_through(path, lambda file: file.write_bytes(data))


def _sort_header(data: bytes) -> bytes:
    """The same safetensors file, its header in a fixed order: the library writes metadata in an order that varies."""
    size = 8 + int.from_bytes(data[:8], "little")
    header = json.dumps(json.loads(data[8:size]), sort_keys=True, separators=(",", ":")).encode()
    header += b" " * (-len(header) % 8)
    return len(header).to_bytes(8, "little") + header + data[size:]


def load_avatar(path: str | Path | None = None) -> Avatar:
    """Reads an avatar or prior file; without a path, the prior shipped with the package.

    Raises InputError for a file that is missing, damaged, of another kind, or holds values that are not finite."""
    path = check_file(path or PRIOR, "avatar", _MAXIMUM_BYTES)
    try:
        with safe_open(path, framework="numpy") as file:
            metadata = file.metadata() or {}
            if metadata.get("format") != FORMAT:
                raise InputError(f"{path} is not an avatar of this version ({FORMAT}); fit the photo again")
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118  (not a mapping)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"cannot read the avatar {path}: {reason}") from error
    except (SafetensorError, TypeError) as error:
        raise InputError(f"{path} is damaged or not a safetensors file: {error}") from error
    try:
        description = parse_json(metadata["avatar"], f"the description in {path}")
        architecture = AvatarArchitecture.from_dict(description["architecture"], path)
        scalars = {name: float(description[name]) for name in ("roughness", "k_s", "k_r")}
        avatar = Avatar(architecture, tensors, **scalars, skin=_read_skin(description.get("skin")))
        _check(avatar)
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path} is damaged: {error}") from error
    return avatar


def _read_skin(stored: dict | None) -> SkinPrior | None:
    """Raises TypeError or ValueError for anything but the values of a `SkinPrior`."""
    if stored is None:
        return None
    triples: dict[str, Any] = {name: tuple(value) for name, value in stored.items() if isinstance(value, list)}
    return SkinPrior(**{**stored, **triples})


def load_prior(path: str | Path | None = None) -> Avatar:
    """`load_avatar` for a prior to fit with. Raises InputError, too, for one of an earlier version, which does not say
    what it expects of skin, and for an avatar without the landmarks that place it in a photo."""
    prior = load_avatar(path)
    prior.skin_prior()
    landmarks = prior.tensors["landmarks"].astype(np.float64)
    known = landmarks[np.isfinite(landmarks).all(axis=1)]
    if len(known) < LEAST_LANDMARKS or np.linalg.matrix_rank(known - known.mean(axis=0)) < 3:
        raise InputError(
            f"{path} is no prior: it places {len(known)} of {LANDMARKS} landmarks, and at least {LEAST_LANDMARKS} that "
            "span a face are needed"
        )
    return prior


def _check(avatar: Avatar) -> None:
    """Raises ValueError unless every tensor is there, of its due size and type, and finite."""
    architecture, tensors = avatar.architecture, avatar.tensors
    due: dict[str, tuple[int, ...]] = {name: (network.parameters,) for name, network in architecture.networks.items()}
    due |= {name: (size,) for name, size in architecture.latents.items()}
    due |= {"lobes": (*tensors["lobes"].shape[:1], 7), "landmarks": (LANDMARKS, 3)}
    if not 0 < tensors["lobes"].size <= 7 * _MAXIMUM_LOBES:
        raise ValueError(f"between 1 and {_MAXIMUM_LOBES} lobes expected")
    for name in OPTIONAL - set(tensors):
        del due[name]
    if LANDMARK_MODEL & set(tensors):
        count = len(tensors["landmark_directions"])
        if not 0 < count <= _MAXIMUM_DIRECTIONS:
            raise ValueError(f"between 1 and {_MAXIMUM_DIRECTIONS} directions of landmarks expected")
        due |= {"landmark_placed": (LANDMARKS, 3)}
        due |= dict.fromkeys(("landmark_directions", "landmark_offsets"), (count, LANDMARKS, 3))
    if DETAIL & set(tensors):
        sizes = {name: tensors[name].shape[:2] for name in ("detail", "detail_depth")}
        if not all(len(size) == 2 and 0 < min(size) <= max(size) <= _MAXIMUM_DETAIL for size in sizes.values()):
            raise ValueError(f"the detail has 1 to {_MAXIMUM_DETAIL} pixels a side")
        due |= {"detail": (*sizes["detail"], 4), "detail_depth": sizes["detail_depth"], "detail_camera": (3, 4)}
    for name, shape in due.items():
        tensor = tensors[name]
        if tensor.shape != shape or tensor.dtype != np.float32:
            raise ValueError(f"tensor {name} is {tensor.dtype}{list(tensor.shape)}, float32{list(shape)} expected")
        if not np.isfinite(tensor).all() and (name != "landmarks" or np.isinf(tensor).any()):
            raise ValueError(f"tensor {name} has values that are not finite")
    if extra := set(tensors) - set(due):
        raise ValueError(f"unknown tensors {sorted(extra)}")
    if not (0.01 <= avatar.roughness <= 1 and 0 <= avatar.k_s <= 1 and 0 <= avatar.k_r <= 1):
        raise ValueError("roughness lies in [0.01, 1], k_s and k_r in [0, 1]")
