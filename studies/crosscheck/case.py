"""The scene of a cross-check: a head, the shapes around it, and a sensor."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import cast

import mitsuba as mi
import numpy as np

from sira_mi.avatar.file import load_avatar
from sira_mi.errors import InputError
from sira_mi.export import scene as scenes
from sira_mi.fields.columns import to_array
from sira_mi.plugins import neural_albedo, neural_sdf, sg_envmap, sira_bsdf  # reloaded with the variant
from sira_mi.relight.subject import PORTRAIT_CAMERA, read_subject


@dataclass(frozen=True, eq=False)
class Case:
    """A head before a sensor, without a light."""

    name: str  # for the page
    avatar: str  # path of the avatar file; empty for the shipped prior
    roughness: float
    k_s: float
    sensor: dict  # for `mi.load_dict`
    width: int  # pixels
    height: int  # pixels
    to_world: np.ndarray = field(default_factory=lambda: np.eye(4))  # [4, 4] of the head
    others: tuple = ()  # further shapes of the scene
    lobes: np.ndarray | None = None  # [N_l, 7] of the scene's own light, in world coordinates

    def head(self, voxel: float, baked: bool = True) -> neural_sdf.NeuralSDF:
        """The head as a shape whose mesh has the spacing `voxel`, scene units. Albedos are `baked` at the vertices, or
        evaluated by the networks at every hit."""
        description = scenes.head(self.avatar, voxel, baked, to_world=mi.ScalarTransform4f(self.to_world))
        bsdf = description["bsdf"]
        bsdf["roughness"], bsdf["k_s"] = self.roughness, self.k_s
        return cast(neural_sdf.NeuralSDF, mi.load_dict(description))

    def scene(self, head: mi.Shape, lobes: np.ndarray, light: dict | None = None, even: bool = False) -> mi.Scene:
        """The head under `lobes` [N_l, 7], or under the emitter that `light` describes. The sampler is independent, or
        stratified with `even`."""
        light = light or {"type": "sg_envmap", "lobes": to_array(lobes)}
        others = {f"other_{k}": shape for k, shape in enumerate(self.others)}
        sensor = {**self.sensor, "sampler": {"type": "stratified" if even else "independent"}}
        return cast(mi.Scene, mi.load_dict({"type": "scene", "sensor": sensor, "head": head, "light": light, **others}))


def load_case(path: Path | None, size: int) -> Case:
    """The case of an output folder of a fit, an `avatar.safetensors`, or a scene file; without one, of the mean head of
    the shipped prior. The longer side of the picture gets `size` pixels.

    Raises InputError for anything else."""
    if path is None:
        avatar, camera = load_avatar(), PORTRAIT_CAMERA
        camera = camera.scale(size / camera.width, size / camera.height, size, size)
        name, file = "the mean head of the shipped prior", ""
    elif path.suffix.lower() == ".xml":
        return _case_of_scene(path, size)
    else:
        subject = read_subject(path, size)
        avatar, camera, name, file = subject.avatar, subject.camera, f"`{path.name}`", str(subject.path.absolute())
    return Case(name, file, avatar.roughness, avatar.k_s, scenes.sensor(camera), camera.width, camera.height)


def _case_of_scene(path: Path, size: int) -> Case:
    if not path.is_file():
        raise InputError(f"{path} does not exist; give a scene file, an output folder of a fit or an avatar")
    try:
        scene = mi.load_file(str(path), optimize=False)
    except (RuntimeError, ValueError) as error:
        raise InputError(f"{path}: Mitsuba cannot load it: {str(error).splitlines()[-1].strip()}") from error
    heads = [shape for shape in scene.shapes() if isinstance(shape, neural_sdf.NeuralSDF)]
    if len(heads) != 1:
        raise InputError(f"{path} holds {len(heads)} neural_sdf; a cross-check needs exactly one")
    head, bsdf, light = heads[0], heads[0].bsdf(), scene.environment()
    if not isinstance(bsdf, sira_bsdf.SiraBSDF):
        raise InputError(f"{path}: the material of the neural_sdf is not a sira_bsdf, which both sides need")
    if not all(
        isinstance(texture, neural_albedo.NeuralAlbedo) for texture in (bsdf.diffuse_albedo, bsdf.specular_albedo)
    ):
        raise InputError(f"{path}: both albedos of the sira_bsdf must be neural_albedo textures")
    if not isinstance(light, sg_envmap.SGEnvmap) or len(scene.emitters()) != 1:
        raise InputError(f"{path}: the light must be one sg_envmap and nothing else; closed forms need that")
    if not scene.sensors():
        raise InputError(f"{path} holds no sensor; add a perspective one")
    sensor, width, height = _sensor(path, scene.sensors()[0], size)
    others = tuple(shape for shape in scene.shapes() if shape is not head)
    to_world = np.array(head.to_world.matrix.numpy(), np.float64).reshape(4, 4)
    roughness, k_s = (float(np.ravel(value.numpy())[0]) for value in (bsdf.roughness, bsdf.k_s))
    avatar = str(Path(head.avatar_path).absolute()) if head.avatar_path else ""
    lobes = _world_lobes(light)
    return Case(f"`{path.name}`", avatar, roughness, k_s, sensor, width, height, to_world, others, lobes)


def _sensor(path: Path, sensor: mi.Sensor, size: int) -> tuple[dict, int, int]:
    """The sensor's description with a film whose longer side has `size` pixels, and that film's width and height."""
    if sensor.class_name() != "PerspectiveCamera":
        raise InputError(f"{path}: the sensor is a {sensor.class_name()}; give a perspective one")
    width, height = (int(side) for side in sensor.film().size())
    scale = size / max(width, height)
    width, height = (max(1, round(side * scale)) for side in (width, height))
    params = mi.traverse(sensor)
    number = {name: float(np.ravel(params[name])[0]) for name in ("x_fov", "near_clip", "far_clip")}
    offset = {f"principal_point_offset_{c}": float(np.ravel(params[f"principal_point_offset_{c}"])[0]) for c in "xy"}
    description = {
        "type": "perspective",
        "fov_axis": "x",
        "fov": number["x_fov"],
        "near_clip": number["near_clip"],
        "far_clip": number["far_clip"],
        **offset,
        "to_world": mi.ScalarTransform4f(np.array(params["to_world"].matrix.numpy()).reshape(4, 4).tolist()),
        "film": scenes.film(width, height),
    }
    return description, width, height


def _world_lobes(light: sg_envmap.SGEnvmap) -> np.ndarray:
    lobes = np.array(light.lobes.numpy(), np.float32).reshape(-1, 7)
    rotation = np.array(light.rotation.matrix.numpy(), np.float64).reshape(4, 4)[:3, :3]
    lobes[:, :3] = lobes[:, :3] @ rotation.T
    lobes[:, 4:] *= float(np.ravel(light.scale.numpy())[0])
    return lobes
