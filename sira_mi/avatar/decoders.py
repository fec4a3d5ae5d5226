"""The decoders of appearance: rendering function (eq. 4), albedos (eqs 9a, 9b, 11) and illumination.

Tensors are `[rows, N]`, one column a surface point; the `_cooperative` forms take and return lists of Floats and serve
symbolic code. Radiance is linear; albedos lie in [0, 1].
"""

import drjit as dr
import mitsuba as mi
import numpy as np

from sira_mi.fields.columns import in_three
from sira_mi.fields.directions import fibonacci_directions
from sira_mi.fields.encoding import encode, encode_cooperative
from sira_mi.fields.mlp import evaluate, evaluate_cooperative

# Bounds of the illumination decoder: log-sharpness and log-amplitude of a lobe, and its initial sharpness.
LOG_SHARPNESS = (-1.0, 5.5)
LOG_AMPLITUDE = (-9.0, 7.0)
INITIAL_SHARPNESS = 8.0
# Where the specular decoder starts: the logit of skin's reflectance at normal incidence, 0.08 × FLARE's 0.375.
SKIN_SPECULAR = 0.03
_SPECULAR_LOGIT = float(np.log(SKIN_SPECULAR / (1 - SKIN_SPECULAR)))


def _logistic(a):
    return dr.rcp(1.0 + dr.exp(-a))


def render_radiance(network: list[tuple], octaves: int, x_ref, normal, view, gamma):
    """Eq. 4, r(x_ref, n, v, γ) [3, N]: `normal` and `view` (the unit direction in which the ray travels) are [3, N],
    γ is [N_γ, N]. The output is exponential, hence positive and unbounded."""
    h = evaluate(network, dr.concat([encode(x_ref, octaves), normal, view, gamma], axis=0))
    return dr.exp(dr.minimum(h, 4.0))


def diffuse_albedo(network: list[tuple], octaves: int, x_ref, gamma):
    """Eq. 9a: base diffuse albedo [3, N]."""
    return _logistic(evaluate(network, dr.concat([encode(x_ref, octaves), gamma], axis=0)))


def specular_albedo(network: list[tuple], octaves: int, x_ref):
    """Eq. 9b: monochrome specular albedo [1, N], the reflectance at normal incidence."""
    return _logistic(evaluate(network, encode(x_ref, octaves)) + _SPECULAR_LOGIT)


def albedo_refinement(network: list[tuple], octaves: int, x_ref, gamma):
    """The refinement field a^r [3, N] of eq. 11, in [-1, 1]."""
    return dr.tanh(evaluate(network, dr.concat([encode(x_ref, octaves), gamma], axis=0)))


def refine_albedo(base, refinement, k_r):
    """Eq. 11, a + k_r a^r, kept within [0, 1]."""
    return dr.minimum(dr.maximum(base + k_r * refinement, 0.0), 1.0)


def light_refinement(network: list[tuple], octaves: int, x_ref, gamma):
    """The logarithm [3, N], in [-4, 4], of the factor that the light in the photo has over that of eq. 8."""
    return 4.0 * dr.tanh(0.25 * evaluate(network, dr.concat([encode(x_ref, octaves), gamma], axis=0)))


def diffuse_albedo_cooperative(packed, octaves: int, x_ref: list, gamma: list) -> list:
    """`diffuse_albedo` in symbolic code."""
    return [_logistic(mi.Float(a)) for a in evaluate_cooperative(packed, encode_cooperative(x_ref, octaves) + gamma)]


def specular_albedo_cooperative(packed, octaves: int, x_ref: list) -> list:
    """`specular_albedo` in symbolic code."""
    outputs = evaluate_cooperative(packed, encode_cooperative(x_ref, octaves))
    return [_logistic(mi.Float(a) + _SPECULAR_LOGIT) for a in outputs]


def albedo_refinement_cooperative(packed, octaves: int, x_ref: list, gamma: list) -> list:
    """`albedo_refinement` in symbolic code."""
    return [dr.tanh(mi.Float(a)) for a in evaluate_cooperative(packed, encode_cooperative(x_ref, octaves) + gamma)]


def illumination(network: list[tuple], latent):
    """Illumination decoder: z_l [dim, S] -> lobes [N_l, 7, S] (axis, sharpness, RGB amplitude). The network moves axes
    away from an even spread; sharpness and amplitude are exponentials of bounded numbers, so every light is finite."""
    h = evaluate(network, latent)
    count, scenes = h.shape[0] // 7, h.shape[1]
    h = dr.reshape(h, (count, 7, scenes))
    base = mi.TensorXf(np.repeat(fibonacci_directions(count).astype(np.float32)[:, :, None], scenes, axis=2))
    axis = base + h[:, 0:3, :]
    square = axis * axis
    length = dr.sqrt(square[:, 0:1, :] + square[:, 1:2, :] + square[:, 2:3, :] + 1e-8)
    axis = axis / in_three(length, axis=1)
    sharpness = dr.exp(_bound(h[:, 3:4, :] + float(np.log(INITIAL_SHARPNESS)), *LOG_SHARPNESS))
    amplitude = dr.exp(_bound(h[:, 4:7, :] - 1.0, *LOG_AMPLITUDE))
    return dr.concat([axis, sharpness, amplitude], axis=1)


def _bound(a, lower: float, upper: float):
    """Smooth clamp that is close to the identity in the middle of its range."""
    centre, half = 0.5 * (lower + upper), 0.5 * (upper - lower)
    return centre + half * dr.tanh((a - centre) / half)
