"""Slow references that the fast implementations are compared with: networks and the field in NumPy and float64, hits by
bisection, shading lobe by lobe."""

import drjit as dr
import mitsuba as mi
import numpy as np

from sira_mi.avatar.shape import HeadShape
from sira_mi.fields.sdf import SdfField, signed_distance
from sira_mi.fields.tracing import on_ray
from sira_mi.sg.lobes import lobe_count, unpack_lobe
from sira_mi.sg.shading import diffuse_irradiance, specular_radiance


def head_field(avatar, **replaced) -> SdfField:
    """The avatar's field, with some parameters of its shape replaced by Floats."""
    return HeadShape(avatar.architecture).field(avatar.tensors | replaced)


def points_near_surface(count: int, seed: int = 3) -> np.ndarray:
    """[3, count] float32 points of a shell about the head's surface."""
    rng = np.random.default_rng(seed)
    x = rng.standard_normal((3, count))
    return (x / np.linalg.norm(x, axis=0) * rng.uniform(0.9, 1.9, count)).astype(np.float32)


def in_double(architecture, parameters: np.ndarray, latent: np.ndarray | None, h: np.ndarray) -> np.ndarray:
    """The network in NumPy and float64, written from its definition."""
    offset = 0
    for k, (weight, bias, shift) in enumerate(architecture.shapes()):
        sizes = [a * b for a, b in (weight, bias, shift)]
        w, b, z = np.split(parameters[offset : offset + sum(sizes)].astype(np.float64), np.cumsum(sizes)[:2])
        offset += sum(sizes)
        h = w.reshape(weight) @ h + b[:, None]
        if shift[1] and latent is not None:
            h = h + z.reshape(shift) @ latent.astype(np.float64)[:, None]
        if k < architecture.depth:
            h = np.logaddexp(0, 100 * h) / 100
    assert offset == len(parameters)
    return h


def encoded_in_double(x: np.ndarray, octaves: int) -> np.ndarray:
    phases = [2.0**k * c for k in range(octaves) for c in x]
    return np.stack([*x, *np.sin(phases), *np.cos(phases)]) if octaves else x


def field_in_double(avatar, x: np.ndarray) -> np.ndarray:
    """Signed distances [N] in float64."""
    networks, t, octaves = avatar.architecture.networks, avatar.tensors, avatar.architecture.sdf_octaves
    delta = in_double(networks["deformation"], t["deformation"], t["z_sdf"], encoded_in_double(x, octaves))[:3]
    return in_double(networks["reference"], t["reference"], None, encoded_in_double(x + delta, octaves))[0]


def find_hits_by_bisection(field: SdfField, origin, direction, t_outside, t_inside, iterations: int = 40):
    """Ray parameters [1, N] of hits, by bisection between a parameter outside and one inside the surface [1, N]."""
    with dr.suspend_grad():
        for _ in range(iterations):
            middle = 0.5 * (t_outside + t_inside)
            outside = signed_distance(field, on_ray(origin, direction, middle)) > 0
            t_outside = dr.select(outside, middle, t_outside)
            t_inside = dr.select(outside, t_inside, middle)
            dr.eval(t_outside, t_inside)
        return 0.5 * (t_outside + t_inside)


def shade_lobe_by_lobe(normal, view, specular_albedo, roughness, lobes):
    """`sira_mi.sg.shading.shade` by a Python loop over the lobes, differentiated by Dr.Jit."""
    irradiance, specular = mi.Color3f(0.0), mi.Color3f(0.0)
    for index in range(lobe_count(lobes)):
        lobe = unpack_lobe(lobes.array, index)
        irradiance += diffuse_irradiance(normal, *lobe)
        specular += specular_radiance(normal, view, specular_albedo, roughness, *lobe)
    return irradiance, specular
