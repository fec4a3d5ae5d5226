"""A small smooth head for the tests of fields, plugins and models, the comparison of gradients with differences, and a
face for those of the portrait."""

import sira_mi  # noqa: F401  (before Dr.Jit, which must find LLVM)

# isort: split
import dataclasses
import signal

import cv2
import mitsuba as mi
import numpy as np
import pytest
import skimage.data

from sira_mi.avatar.architecture import AvatarArchitecture
from sira_mi.avatar.file import Avatar, save_avatar
from sira_mi.avatar.skin_tone import SkinPrior
from sira_mi.conventions import LANDMARKS
from sira_mi.fields.mlp import Architecture, initial_parameters
from sira_mi.fit.settings import QUALITIES
from sira_mi.fit.stage import FitSettings
from sira_mi.portrait.camera import Camera
from sira_mi.portrait.face import find_faces

mi.set_variant("llvm_ad_rgb")

# A runner in the background has Ctrl-C ignored, and its children would too: the tests of interrupts need it.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

SMALL = AvatarArchitecture(
    features=4,
    sdf_octaves=2,
    sdf_width=32,
    sdf_depth=3,
    sdf_latent=6,
    rendering_octaves=2,
    rendering_width=16,
    rendering_depth=2,
    rendering_latent=4,
    albedo_octaves=2,
    albedo_width=16,
    albedo_depth=2,
    albedo_latent=4,
    specular_octaves=1,
    specular_width=16,
    specular_depth=2,
    specular_latent=3,
    refinement_octaves=3,
    refinement_width=16,
    refinement_depth=2,
    lobes=8,
    illumination_width=16,
    illumination_depth=2,
    illumination_latent=4,
)


@pytest.fixture(scope="module")
def variant():
    """The variant of these tests, and afterwards the one that was set before."""
    previous = mi.variant()
    mi.set_variant("llvm_ad_rgb")
    yield
    if previous:
        mi.set_variant(previous)


def tiny_fit(steps: int) -> FitSettings:
    """A fit of `steps` steps a stage: every stage and every file is real, only too short to look good."""
    stages = tuple(dataclasses.replace(s, steps=steps if s.steps else 0) for s in QUALITIES["standard"].stages)
    sizes = {"working_size": 128, "rays": 256, "points": 64, "pixels": 256, "voxel": 0.16, "final_voxel": 0.12}
    return FitSettings("tiny", **sizes, stages=stages, block=3)


def even_directions(count: int) -> np.ndarray:
    """`count` unit vectors [count, 3] spread evenly over the sphere; of the fixtures alone, so that these stay as they
    are."""
    k = np.arange(count) + 0.5
    y = 1 - 2 * k / count
    azimuth = np.pi * (1 + np.sqrt(5)) * k
    radius = np.sqrt(1 - y * y)
    return np.stack([radius * np.cos(azimuth), y, radius * np.sin(azimuth)], axis=1).astype(np.float32)


def smooth_sphere(architecture: Architecture, rng: np.random.Generator, radius: float) -> np.ndarray:
    """Flat parameters of a smooth field close to |x| − radius: even directions far within the bend of the softplus,
    then layers close to the identity. (The geometric initialisation is a coarse sphere when its layers are narrow.)"""
    first, lift = 0.04, 0.1
    parts = []
    for k, (weight, bias, latent) in enumerate(architecture.shapes()):
        matrix, offset = np.zeros(weight), np.zeros(bias)
        if k == 0:
            matrix[:, :3] = first * even_directions(weight[0])
        elif k < architecture.depth:
            matrix = np.eye(weight[0]) + 0.02 * rng.standard_normal(weight)
            offset += lift if k == 1 else 0
        else:
            matrix += 1 / weight[1]
        parts.append((matrix, offset, np.zeros(latent)))

    def average(r):
        h = np.zeros((architecture.inputs, 1))
        h[:3, 0] = r * np.array([0.3, 0.5, np.sqrt(1 - 0.34)])
        for k, (matrix, offset, _) in enumerate(parts):
            h = matrix @ h + offset
            h = np.logaddexp(0, 100 * h) / 100 if k < architecture.depth else h
        return h.item()

    slope = (average(1.05 * radius) - average(0.95 * radius)) / (0.1 * radius)
    matrix, offset, latent = parts[-1]
    parts[-1] = (matrix / slope, offset - average(radius) / slope, latent)
    return np.concatenate([piece.ravel() for part in parts for piece in part])


def small_avatar(seed: int = 1) -> Avatar:
    """A smooth blob of about 1.4 units' radius: a sphere as reference, slightly deformed, under eight lobes."""
    rng = np.random.default_rng(seed)
    networks = SMALL.networks
    deformation = initial_parameters(networks["deformation"], rng, output_scale=0.3)
    deformation[: SMALL.sdf_width * networks["deformation"].inputs] *= 0.1
    tensors = {
        "deformation": deformation,
        "reference": smooth_sphere(networks["reference"], rng, 1.4),
        "rendering": initial_parameters(networks["rendering"], rng, output_scale=0.3),
        "diffuse_albedo": initial_parameters(networks["diffuse_albedo"], rng),
        "specular_albedo": initial_parameters(networks["specular_albedo"], rng),
        "albedo_refinement": initial_parameters(networks["albedo_refinement"], rng, output_scale=0.3),
        "illumination": initial_parameters(networks["illumination"], rng, output_scale=0.1),
        **{name: 0.3 * rng.standard_normal(size) for name, size in SMALL.latents.items()},
        "landmarks": np.full((LANDMARKS, 3), np.nan),
    }
    sharpness = rng.uniform(2, 20, (SMALL.lobes, 1))
    amplitude = rng.uniform(0.2, 1.0, (SMALL.lobes, 3))
    tensors["lobes"] = np.concatenate([even_directions(SMALL.lobes), sharpness, amplitude], axis=1)
    tensors = {name: value.astype(np.float32) for name, value in tensors.items()}
    return Avatar(SMALL, tensors, skin=SkinPrior(radiance=0.286, deviations=(0.6, 0.08)))


@pytest.fixture(scope="session")
def avatar() -> Avatar:
    return small_avatar()


@pytest.fixture(scope="session")
def avatar_path(avatar, tmp_path_factory) -> str:
    path = tmp_path_factory.mktemp("avatar") / "avatar.safetensors"
    save_avatar(path, avatar)
    return str(path)


def slopes(loss, value: np.ndarray, gradient: np.ndarray, change: float, seed: int = 0) -> tuple[float, float]:
    """(AD, central difference) of `loss` along a direction that weighs the entries of `gradient` at random and has a
    random part. The step is such that by AD the loss changes by the share `change` of itself either way, and the value
    by at most 3%."""
    rng = np.random.default_rng(seed)
    weighted = gradient * rng.uniform(0, 2, gradient.shape)
    noise = rng.standard_normal(gradient.shape)
    direction = weighted / np.linalg.norm(weighted) + 0.5 * noise / np.linalg.norm(noise)
    slope = float((gradient * direction).sum())
    step = min(change * abs(loss(value)) / abs(slope), 0.03 * float(np.linalg.norm(value)))
    ahead, behind = (loss((value + sign * step * direction).astype(np.float32)) for sign in (1, -1))
    return slope, float(ahead - behind) / (2 * step)


def camera(focal: float, size: int = 32) -> Camera:
    """A camera five units before the head, looking at it; `focal` in pixels."""
    k = np.array([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1.0]])
    world_to_camera = np.array([[1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 5], [0, 0, 0, 1]])
    return Camera(k, world_to_camera, size, size)


@pytest.fixture(scope="session")
def astronaut():
    return skimage.data.astronaut()


@pytest.fixture(scope="session")
def face(astronaut):
    return find_faces(astronaut)[0]


@pytest.fixture(scope="session")
def head(face):
    """A head's landmarks [468, 3] in world units, back-projected from the network's relative depth."""
    eyes = face.landmarks[[33, 263]]
    scale = 0.9 / np.linalg.norm(eyes[1] - eyes[0])
    flat = (face.landmarks - eyes.mean(axis=0)) * scale
    return np.column_stack([flat[:, 0], -flat[:, 1], 0.8 - face.depth * scale])


def one_line(error: pytest.ExceptionInfo, *words: str) -> None:
    message = str(error.value)
    assert "\n" not in message and len(message) < 700
    for word in words:
        assert word in message


def a_camera(head=None, yaw=20.0, pitch=-8.0, roll=5.0, distance=9.0, focal=900.0, size=(640, 800)) -> Camera:
    turn = cv2.Rodrigues(np.radians([0, yaw, 0]))[0] @ cv2.Rodrigues(np.radians([pitch, 0, roll]))[0]
    pose = np.eye(4)
    pose[:3, :3] = np.diag([1.0, -1.0, -1.0]) @ turn
    pose[:3, 3] = (0.4, -0.7, distance)
    K = np.array([[focal, 0, size[0] / 2], [0, focal, size[1] / 2], [0, 0, 1.0]])
    return Camera(K, pose, *size)
