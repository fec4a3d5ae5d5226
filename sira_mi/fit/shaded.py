"""The photo's surface points and their radiance by eq. 8, shared by the stages that fit light, albedo and shape."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any, TypeVar

import drjit as dr
import mitsuba as mi
import numpy as np

from sira_mi.avatar.decoders import diffuse_albedo, illumination, specular_albedo
from sira_mi.avatar.file import Avatar
from sira_mi.export.scene import sensor
from sira_mi.fields.columns import evaluate_in_chunks, unit_columns
from sira_mi.fields.mlp import layers
from sira_mi.fields.sdf import surface
from sira_mi.portrait.camera import Camera
from sira_mi.portrait.portrait import Portrait
from sira_mi.sg.radiance import Material, closed_form_radiance
from sira_mi.sg.visibility import SHADOW_OFFSET, even_directions, light_visibility, trace_unoccluded

# Directions in which the points' visibility is traced.
DIRECTIONS = 128

# Dr.Jit arrays and tensors by name. Their classes belong to the variant, so that no static type names them.
Arrays = dict[str, Any]
Points = TypeVar("Points", bound="SurfacePoints")


@dataclass(frozen=True)
class SurfacePoints:
    """The points of a head at a camera's pixel centres, N columns."""

    row: np.ndarray  # [N]
    column: np.ndarray  # [N]
    origin: np.ndarray  # [3, N] of the ray, field's coordinates
    view: np.ndarray  # [3, N] unit, from the camera to the point
    t: np.ndarray  # [1, N] ray parameter of the point
    x_ref: np.ndarray  # [3, N]
    gamma: np.ndarray  # [N_γ, N]
    normal: np.ndarray  # [3, N] unit

    def __getitem__(self: Points, index: np.ndarray) -> Points:
        return type(self)(*(np.ascontiguousarray(getattr(self, f.name)[..., index]) for f in fields(self)))


@dataclass(frozen=True)
class PhotoPoints(SurfacePoints):
    """The points inside a photo's mask."""

    unoccluded: np.ndarray  # [K, N] bool: whether nothing blocks each of `even_directions(DIRECTIONS)`


def find_surface_points(camera: Camera, head) -> SurfacePoints:
    """The points of a `neural_sdf` that a camera sees."""
    from sira_mi.plugins.neural_sdf import trace_head  # exists only under a variant

    scene = mi.load_dict({"type": "scene", "sensor": sensor(camera), "head": head})
    index = dr.arange(mi.UInt32, camera.height * camera.width)
    centre = mi.Point2f(
        (mi.Float(index % camera.width) + 0.5) / camera.width, (mi.Float(index // camera.width) + 0.5) / camera.height
    )
    ray, _ = scene.sensors()[0].sample_ray(0.0, 0.5, centre, mi.Point2f(0.5))
    t, hit = trace_head(scene, head, ray, mi.Bool(True))
    chosen = np.flatnonzero(hit.numpy())
    origin, view, t = ray.o.numpy()[:, chosen], ray.d.numpy()[:, chosen], t.numpy()[None, chosen]
    field = head.field()
    x = origin + t * view
    _, gradient, x_ref, gamma = evaluate_in_chunks(lambda p: surface(field, p), x)
    normal = unit_columns(gradient).astype(np.float32)
    return SurfacePoints(chosen // camera.width, chosen % camera.width, origin, view, t, x_ref, gamma, normal)


def find_masked_points(portrait: Portrait, head) -> SurfacePoints:
    """The points of a `neural_sdf` that the portrait shows inside its mask."""
    seen = find_surface_points(portrait.camera, head)
    return seen[np.flatnonzero(portrait.mask[seen.row, seen.column] > 0.5)]


def find_photo_points(portrait: Portrait, head) -> PhotoPoints:
    """The points of a `neural_sdf` that the portrait shows inside its mask, and their visibility."""
    seen = find_masked_points(portrait, head)
    scene = mi.load_dict({"type": "scene", "head": head})
    place = seen.origin + seen.t * seen.view
    axes = even_directions(DIRECTIONS).axis
    unoccluded = trace_unoccluded(scene, place, seen.normal, axes, SHADOW_OFFSET * head.voxel)
    return PhotoPoints(**vars(seen), unoccluded=unoccluded)


def decoder(avatar: Avatar, name: str, parameters: Arrays, latent: str | None = None) -> list[tuple]:
    """Layers of the network `name` at `parameters` (Floats)."""
    z = None if latent is None else parameters[latent]
    return layers(avatar.architecture.networks[name], parameters[name], z)


def decode_lobes(avatar: Avatar, parameters: Arrays) -> Any:
    """The light [N_l, 7] of the illumination decoder at `parameters` (Floats)."""
    z_l = mi.TensorXf(parameters["z_l"], (len(parameters["z_l"]), 1))
    return illumination(decoder(avatar, "illumination", parameters), z_l)[:, :, 0]


@dataclass(frozen=True)
class Shading:
    """Light and radiance of eq. 8 at some points, tensors."""

    lobes: mi.TensorXf  # [N_l, 7]
    diffuse: mi.TensorXf  # [3, N] radiance
    specular: mi.TensorXf  # [3, N] radiance, times k_s


def shade_points(
    avatar: Avatar, parameters: Arrays, k_s: float | None, points: PhotoPoints, albedo, normal=None
) -> Shading:
    """Light and radiance at `points` of diffuse `albedo` [3, N], by the decoders at `parameters` (Floats); a tensor
    `normal` [3, N] replaces the points' own. Shadows are those of the `sira_sg` integrator. With `k_s` None the
    specular term is left out, and 0."""
    view = mi.TensorXf(points.view)
    normal = mi.TensorXf(points.normal) if normal is None else normal
    lobes = decode_lobes(avatar, parameters)
    specular = None
    if k_s is not None:
        network, octaves = decoder(avatar, "specular_albedo", parameters, "z_s"), avatar.architecture.specular_octaves
        specular = specular_albedo(network, octaves, mi.TensorXf(points.x_ref))
    unoccluded, directions = mi.TensorXf(points.unoccluded.astype(np.float32)), even_directions(DIRECTIONS)
    visibility = light_visibility(normal, view, specular, avatar.roughness, lobes, directions, unoccluded)
    material = Material(albedo, specular, avatar.roughness, 0.0 if k_s is None else k_s)
    return Shading(lobes, *closed_form_radiance(normal, view, material, lobes, visibility))


def base_albedo(avatar: Avatar, parameters: Arrays, points: SurfacePoints) -> Any:
    """Base diffuse albedo [3, N] of points, by the decoders at `parameters` (Floats)."""
    network = decoder(avatar, "diffuse_albedo", parameters, "z_a")
    octaves = avatar.architecture.albedo_octaves
    return diffuse_albedo(network, octaves, mi.TensorXf(points.x_ref), mi.TensorXf(points.gamma))
