"""The ways to shade one set of points: PhySG's closed form, this project's with and without visibility and in float64,
and direct light by Monte Carlo with and without shadows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeAlias

import drjit as dr
import mitsuba as mi
import numpy as np

from sira_mi.fields.columns import evaluate_in_chunks, from_columns, to_array, to_columns
from sira_mi.plugins.neural_sdf import NeuralSDF
from sira_mi.plugins.sira_sg import rotation_of, unoccluded_directions
from sira_mi.sg import brdf, shading, visibility
from sira_mi.sg.lobes import lobe_count, unpack_lobe
from sira_mi.sg.radiance import Material, closed_form_radiance, reflect
from sira_mi.sg.sampling import LobeMixture
from studies.crosscheck.points import Points
from studies.numerics.physg import specular_lobe
from studies.stability import double

# Arrays of Dr.Jit, whose stubs know neither their arithmetic between types nor symbolic loops.
Array: TypeAlias = Any

# The cosine as two Gaussians (Meder and Bruederlin 2018, as in PhySG): factor, sharpness, what is taken off.
_COSINE = (32.7080, 0.0315, 31.7003)
# Fractional parts of multiples of these fill the square evenly (Roberts's R2 sequence).
_R2 = (0.7548776662466927, 0.5698402909980532)
# Points whose closed form is evaluated in float64 at once.
_DOUBLE_CHUNK = 1 << 15


def local_lobes(lobes: np.ndarray, head: NeuralSDF) -> np.ndarray:
    """Lobes [N_l, 7] from world coordinates to those of the head's field."""
    turned = np.array(lobes, np.float32)
    turned[:, :3] = turned[:, :3] @ rotation_of(head.to_world)
    return turned


def closed_form(points: Points, lobes: np.ndarray, roughness: float, k_s: float) -> np.ndarray:
    """Radiance [3, N] by this project's closed form, without visibility."""
    light = to_array(lobes)

    def columns(normal, view, diffuse, specular):
        material = Material(diffuse, specular, roughness, mi.TensorXf(k_s, (1, 1)))
        radiance = closed_form_radiance(normal, -view, material, light)
        return radiance.diffuse + radiance.specular

    return evaluate_in_chunks(columns, points.normal, points.view, points.diffuse, points.specular)[0]


def with_visibility(
    points: Points,
    scene: mi.Scene,
    head: NeuralSDF,
    lobes: np.ndarray,
    roughness: float,
    k_s: float,
    bounce: bool = True,
) -> np.ndarray:
    """Radiance [3, N] by the closed form with visibility, as `sira_sg` computes it; `bounce` adds light that occluders
    reflect."""
    light, directions = to_array(lobes), visibility.light_directions(lobes, visibility.DEFAULT_DIRECTIONS)
    factor = 1.0 if bounce else 0.0

    def columns(x, normal, view, diffuse, specular):
        unoccluded = unoccluded_directions(scene, head, x, normal, directions)
        seen = visibility.light_visibility(normal, -view, specular, mi.Float(roughness), light, directions, unoccluded)
        bounces: tuple[Array, Array] = seen.bounce_diffuse, seen.bounce_specular
        seen = visibility.Visibility(seen.diffuse, seen.specular, *(factor * one for one in bounces))
        material = Material(diffuse, specular, roughness, mi.TensorXf(k_s, (1, 1)))
        radiance = closed_form_radiance(normal, -view, material, light, seen)
        return radiance.diffuse + radiance.specular

    return evaluate_in_chunks(columns, points.x, points.normal, points.view, points.diffuse, points.specular)[0]


def _hemisphere_integral(sharpness, cosine):
    """PhySG's integral of a lobe over a hemisphere, its axis at `cosine` from the pole (Meder and Bruederlin 2018)."""
    inverse = dr.rcp(sharpness)
    t = dr.sqrt(sharpness) * (1.6988 + 10.8438 * inverse) * dr.rcp(1 + 6.2201 * inverse + 10.2415 * inverse * inverse)
    a, b = dr.exp(-t), dr.exp(-t * dr.maximum(cosine, 0.0))
    above = (1 - a * b) / (1 - a + b - a * b)
    c = dr.exp(t * dr.minimum(cosine, 0.0))
    below = (c - a) / ((1 - a) * (c + 1))
    step = dr.select(cosine >= 0, above, below)
    low = dr.two_pi * inverse * (dr.exp(-sharpness) - dr.exp(-2 * sharpness))
    high = dr.two_pi * inverse * (1 - dr.exp(-sharpness))
    return low * (1 - step) + high * step


def _physg_cosine_integral(normal, axis, sharpness):
    """∫ exp(λ(ω·ξ − 1)) (ω·n)₊ dω with PhySG's cosine: the difference of two hemisphere integrals."""
    factor, cosine_sharpness, base = _COSINE
    joint = cosine_sharpness * normal + sharpness * axis
    length = dr.maximum(dr.norm(joint), 1e-12)
    peak = factor * dr.exp(length - cosine_sharpness - sharpness)
    first = peak * _hemisphere_integral(length, dr.dot(joint, normal) / length)
    return dr.maximum(first - base * _hemisphere_integral(sharpness, dr.dot(axis, normal)), 0.0)


def physg(points: Points, lobes: np.ndarray, roughness: float, k_s: float) -> np.ndarray:
    """Radiance [3, N] by PhySG's closed form (Zhang et al. 2021), its two-term cosine included, negative light cut."""
    light, rough = to_array(lobes), mi.Float(roughness)

    def columns(normal, view, diffuse, specular):
        n, v, s = from_columns(normal, mi.Vector3f), from_columns(view, mi.Vector3f), from_columns(specular, mi.Float)
        warped: tuple[Array, ...] = specular_lobe(n, v, rough)
        warped_axis, warped_sharpness, warped_amplitude = warped
        cosine: Array = dr.dot(n, v)
        safe: Array = dr.maximum(cosine, 1e-3)
        moment = 0.25 * warped_amplitude * dr.square(brdf.masking(safe, rough)) * brdf.fresnel(s, safe)
        irradiance: Array = mi.Color3f(0.0)
        glossy: Array = mi.Color3f(0.0)
        for index in range(lobe_count(light)):
            lobe: tuple[Array, ...] = unpack_lobe(light.array, index)
            axis, sharpness, amplitude = lobe
            irradiance += amplitude * _physg_cosine_integral(n, axis, sharpness)
            joint = warped_sharpness * warped_axis + sharpness * axis
            length = dr.norm(joint)
            exponent = dr.exp(length - warped_sharpness - sharpness)
            glossy += amplitude * exponent * _physg_cosine_integral(n, joint / length, length)
        glossy = dr.select(cosine > 0, glossy * moment, 0.0)
        material = Material(diffuse, specular, roughness, k_s)
        radiance = reflect(material, to_columns(irradiance), to_columns(glossy))
        return radiance.diffuse + radiance.specular

    return evaluate_in_chunks(columns, points.normal, points.view, points.diffuse, points.specular)[0]


def closed_form_double(
    points: Points, normal: np.ndarray, lobes: np.ndarray, roughness: float, k_s: float
) -> np.ndarray:
    """`closed_form` in float64 under float64 normals [3, N]; the albedos are those of single precision."""
    parts = []
    for start in range(0, normal.shape[1], _DOUBLE_CHUNK):
        piece = slice(start, start + _DOUBLE_CHUNK)
        with double.in_double() as types:
            n, v = (types.Vector3f(np.array(a[:, piece], np.float64)) for a in (normal, points.view))
            s, r = types.Float(points.specular[0, piece].astype(np.float64)), types.Float(roughness)
            irradiance, glossy = types.Color3f(0.0), types.Color3f(0.0)
            for lobe in lobes.astype(np.float64):
                axis = types.Vector3f(lobe[:3] / np.linalg.norm(lobe[:3]))
                sharpness, amplitude = types.Float(lobe[3]), types.Color3f(lobe[4:])
                irradiance += shading.diffuse_irradiance(n, axis, sharpness, amplitude)
                glossy += shading.specular_radiance(n, v, s, r, axis, sharpness, amplitude)
            parts.append(points.diffuse[:, piece] / np.pi * irradiance.numpy() + k_s * glossy.numpy())
    return np.concatenate(parts, axis=1) if parts else np.zeros((3, 0))


@dataclass(frozen=True, eq=False)
class Transport:
    """Direct light at some points without their albedos: irradiance, and specular radiance with F = 1 and F = P."""

    irradiance: np.ndarray  # [3, N]
    white: np.ndarray  # [3, N]
    grazing: np.ndarray  # [3, N]

    def radiance(self, diffuse: np.ndarray, specular: np.ndarray, k_s: float) -> np.ndarray:
        """[3, N] at points of these albedos [3, N] and [1, N]."""
        return diffuse / np.pi * self.irradiance + k_s * (specular * self.white + (1 - specular) * self.grazing)


def direct_light(
    points: Points, scene: mi.Scene, head: NeuralSDF, lobes: np.ndarray, roughness: float, samples: int, seed: int
) -> tuple[Transport, Transport]:
    """Direct light by Monte Carlo with the BRDF itself: (without shadows, with them), from the same directions.

    `samples` directions each are drawn from the light, the cosine and the normal distribution (balance heuristic); even
    sequences, shifted at random for every ray of the picture."""
    mixture: Array = LobeMixture(to_array(lobes))
    directions: tuple[Array, ...] = tuple(mi.Vector3f(_rows(a)) for a in (points.normal, points.facing, points.view))
    normal, facing, view = directions
    x, count = mi.Point3f(_rows(points.x)), points.x.shape[1]
    key: Array = mi.UInt32(points.ray.astype(np.uint32))
    stream: Array = mi.UInt32(seed & 0xFFFFFFFF)
    first, second = mi.sample_tea_32(key, stream)
    shift = mi.Point2f(mi.Float(first), mi.Float(second)) * 2.0**-32
    frame: Array = mi.Frame3f(normal)
    cos_view: Array = dr.dot(normal, view)
    visible = cos_view > 0.0
    rough: Array = mi.Float(roughness)

    def weigh(direction):
        """The contribution of a direction: whether it counts, its weight, and the two factors of specular radiance."""
        cos_light = dr.dot(normal, direction)
        above = visible & (cos_light > 0.0)
        radiance, density = mixture.evaluate(direction)
        half = dr.normalize(dr.select(above, view + direction, normal))
        core = 0.25 * brdf.distribution(0.5 * dr.squared_norm(half - normal), rough)
        core *= brdf.masking(dr.maximum(cos_view, 0.0), rough) * brdf.masking(dr.maximum(cos_light, 0.0), rough)
        density += dr.maximum(cos_light, 0.0) * dr.inv_pi + brdf.reflection_density(normal, view, direction, rough)
        weight = dr.select(above, radiance * cos_light / dr.maximum(density, 1e-12), 0.0)
        return above, weight, core, brdf.fresnel_weight(dr.dot(view, half))

    def body(index, *sums):
        step: Array = mi.Float(index)
        base = shift + step * mi.Point2f(*_R2)
        for k in range(3):
            u = base + k / 3.0
            u -= dr.floor(u)
            if k == 0:
                direction = mixture.sample(u)
            elif k == 1:
                direction = frame.to_world(mi.warp.square_to_cosine_hemisphere(u))
            else:
                direction = mi.reflect(view, frame.to_world(brdf.sample_distribution(u, rough)))
            above, weight, core, fresnel = weigh(direction)
            away = dr.mulsign(mi.Vector3f(facing), dr.dot(facing, direction))
            start = x + points.lift * away + points.advance * direction
            ray = head.to_world @ mi.Ray3f(mi.Point3f(start), direction)
            arrives = above & ~scene.ray_test(ray, above)
            parts = (weight, weight * core, weight * core * fresnel)
            added = (*parts, *(dr.select(arrives, part, 0.0) for part in parts))
            sums = tuple(total + part for total, part in zip(sums, added, strict=True))
        return index + 1, *sums

    with dr.suspend_grad():
        state: Array = (dr.zeros(mi.UInt32, count), *(dr.zeros(mi.Color3f, count) for _ in range(6)))
        loop: Array = body
        sums: Array = dr.while_loop(state, lambda index, *_: index < samples, loop, mode="symbolic")[1:]
        arrays = [part.numpy() / samples for part in sums]
    return Transport(*arrays[:3]), Transport(*arrays[3:])


def _rows(array: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(array, np.float32)
