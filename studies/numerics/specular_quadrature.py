"""∫ exp(λ(ω·ξ − 1)) f^s (ω·n)₊ dω by quadrature in double precision, many integrals in one launch, with f^s of
`sira_mi/sg/brdf.py` written anew; `fit_specular_table` and `sg_accuracy` use it. The nodes follow the sharper of the
two factors."""

import sira_mi  # noqa: F401  (before Dr.Jit, which must find LLVM)

# isort: split
import math

import drjit as dr
import numpy as np
from drjit.llvm.ad import Array2f64, Array3f64, Float64, UInt32

GOLDEN_ANGLE = np.pi * (3.0 - np.sqrt(5.0))
# Lanes that share one integral, and integrals of one launch.
LANES, LAUNCH = 16, 20000
# The nodes reach to exp(−36) = 2e-16 of the peak.
REACH = 36.0


def views(cosines: np.ndarray) -> np.ndarray:
    """Views [..., 3] in the plane y = 0 for n = z."""
    return np.stack([np.sqrt(1.0 - cosines**2), np.zeros_like(cosines), cosines], axis=-1)


def light_directions(view_cosine: float, roughness: float, count: int) -> np.ndarray:
    """Axes [count, 3]: half of them a Fibonacci lattice, half the view reflected about a spiral of half vectors that
    follow the normal distribution."""
    spiral = np.arange(count // 2)
    azimuth, z = GOLDEN_ANGLE * spiral, 1.0 - 2.0 * (spiral + 0.5) / len(spiral)
    rim = np.sqrt(1.0 - z * z)
    even = np.stack([rim * np.cos(azimuth), rim * np.sin(azimuth), z], axis=1)
    sharpness, view = 2.0 / roughness**4, views(np.asarray(view_cosine))
    gap = -np.log1p((spiral + 0.5) / len(spiral) * np.expm1(-sharpness)) / sharpness
    sine = np.sqrt(gap * (2.0 - gap))
    half = np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), 1.0 - gap], axis=1)
    return np.concatenate([even, 2.0 * (half @ view)[:, None] * half - view])


def _radial_node(index, sharpness, nodes, weights):
    """1 − cos of a node's angle from the axis and its weight per azimuth node, for exp(λ(z − 1)) over z > 0."""
    count = len(nodes)
    limit = dr.sqrt(dr.minimum(sharpness, REACH))
    t = dr.gather(Float64, nodes, index) * limit
    weight = dr.exp(-t * t) * 2.0 * t * dr.gather(Float64, weights, index) * limit / sharpness
    return t * t / sharpness, weight * (math.pi / count)


def _launch(view_cosine, roughness, sharpness, axes, nodes, follow_light):
    x, weights = np.polynomial.legendre.leggauss(nodes)
    radius_nodes, radius_weights = Float64(0.5 * (x + 1.0)), Float64(0.5 * weights)
    lane = dr.arange(UInt32, len(sharpness) * LANES)
    item, part = lane // LANES, lane % LANES
    c, r, lobe = (dr.gather(Float64, Float64(v), item) for v in (view_cosine, roughness, sharpness))
    axis = Array3f64(*(dr.gather(Float64, Float64(np.ascontiguousarray(v)), item) for v in axes.T))
    other = dr.select(dr.abs(axis.z) < 0.9, Array3f64(0, 0, 1), Array3f64(1, 0, 0))
    tangent = dr.normalize(dr.cross(axis, other))
    bitangent = dr.cross(axis, tangent)
    view = Array3f64(dr.sqrt(1.0 - c * c), 0, c)
    distribution, k = 2.0 / dr.square(dr.square(r)), dr.square(r + 1.0) / 8.0
    dr.eval(c, r, lobe, axis, tangent, bitangent, view, distribution, k)

    def masked_cosine(z):
        # G / ((n·l)(n·v)) times n·l.
        z = dr.maximum(z, 0.0)
        return z / ((z * (1.0 - k) + k) * (c * (1.0 - k) + k))

    def fresnel(cosine):
        return dr.exp2(-(5.55473 * cosine + 6.8316) * cosine)

    def reflectance(light):
        half = dr.normalize(light + view)
        gap = 0.5 * dr.squared_norm(half - Array3f64(0, 0, 1))
        white = distribution * (0.125 / math.pi) * dr.exp(-distribution * gap) * masked_cosine(light.z)
        return white, white * fresnel(dr.dot(half, view))

    def at_light_node(weight, sine, cosine):
        across, along = sine.x * tangent + sine.y * bitangent, cosine * axis
        near, far = reflectance(across + along), reflectance(across - along)
        opposite = dr.exp(-2.0 * lobe * cosine)
        return tuple(weight * (a + b * opposite) for a, b in zip(near, far, strict=True))

    def at_half_node(weight, sine, cosine):
        half = Array3f64(sine.x, sine.y, cosine)
        cos_half = dr.dot(half, view)
        light = 2.0 * cos_half * half - view
        # dω = 4 (v·h) dh.
        white = weight * distribution * (0.5 / math.pi) * dr.maximum(cos_half, 0.0) * masked_cosine(light.z)
        white *= dr.exp(-0.5 * lobe * dr.squared_norm(light - axis))
        return white, white * fresnel(cos_half)

    def body(index, white, grazing):
        node = index * LANES + part
        gap, weight = _radial_node(
            node // (2 * nodes), lobe if follow_light else distribution, radius_nodes, radius_weights
        )
        azimuth = (Float64(node % (2 * nodes)) + 0.5) * (math.pi / nodes)
        sin_phi, cos_phi = dr.sincos(azimuth)
        radius = dr.sqrt(gap * (2.0 - gap))
        sine = Array2f64(radius * cos_phi, radius * sin_phi)
        values = (at_light_node if follow_light else at_half_node)(weight, sine, 1.0 - gap)
        return index + 1, white + values[0], grazing + values[1]

    steps = dr.opaque(UInt32, 2 * nodes * nodes // LANES)
    _, *sums = dr.while_loop((UInt32(0), Float64(0), Float64(0)), lambda index, *_: index < steps, body)
    return np.stack([dr.block_sum(value, LANES).numpy() for value in sums])


def integrals(
    view_cosine: np.ndarray, roughness: np.ndarray, sharpness: np.ndarray, axes: np.ndarray, nodes: int
) -> np.ndarray:
    """The integrals [2, N] for F = 1 and F = P, n = z, views of `views` and light lobes of [N] sharpnesses and [N, 3]
    axes, with `nodes` nodes along a radius, a multiple of 8, and twice as many around."""
    result = np.empty((2, len(sharpness)))
    # A light as sharp as the reflectance across its plane still varies less than the normal distribution. Seen at
    # grazing angles, the reflectance is narrower across the plane, by about the mean cosine of view and half vectors.
    follow_light = sharpness > 3.0 / (roughness**4 * np.sqrt(view_cosine**2 + 0.2 * roughness**4))
    for flag in (False, True):
        chosen = np.flatnonzero(follow_light == flag)
        for part in np.split(chosen, range(LAUNCH, len(chosen), LAUNCH)):
            if len(part):
                point = view_cosine[part], roughness[part]
                result[:, part] = _launch(*point, sharpness[part], axes[part], nodes, flag)
    return result


def grid_integrals(cosines, roughnesses, sharpnesses, directions: int, nodes: int) -> tuple[np.ndarray, np.ndarray]:
    """Axes [C, R, D, 3] of `light_directions` and integrals [2, C, R, L, D] over a grid of the first three."""
    axes = np.array([[light_directions(c, r, directions) for r in roughnesses] for c in cosines])
    shape = len(cosines), len(roughnesses), len(sharpnesses), directions
    c, r, lobe, _ = (
        x.ravel() for x in np.meshgrid(cosines, roughnesses, sharpnesses, range(directions), indexing="ij")
    )
    many = np.broadcast_to(axes[:, :, None], (*shape, 3)).reshape(-1, 3)
    return axes, integrals(c, r, lobe, many, nodes).reshape(2, *shape)
