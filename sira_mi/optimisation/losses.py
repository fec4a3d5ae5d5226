"""Losses of the statistical models and of the fit, on tensors `[rows, N]`, one column a point."""

from functools import reduce
from operator import add

import drjit as dr
import mitsuba as mi

from sira_mi.fields.columns import in_three


def norm(v, epsilon: float = 1e-8):
    """Length [1, N] of the columns of v [rows, N]; smooth at zero."""
    return dr.sqrt(dr.sum(v * v, axis=0) + epsilon)


def mean(v):
    """Mean over all entries, a scalar tensor."""
    return dr.mean(v, axis=None)


def surface_loss(distance):
    """L_Surf of eq. 7: mean |f| at surface points [1, N]."""
    return mean(dr.abs(distance))


def eikonal_loss(gradient):
    """L_Eik of eq. 7: mean (‖∇f‖ − 1)², gradient [3, N]."""
    deviation = norm(gradient) - 1.0
    return mean(deviation * deviation)


def normal_loss(gradient, normal):
    """Mean ‖∇f − n‖ at surface points (IGR, Gropp et al. 2020), both [3, N]."""
    return mean(norm(gradient - normal))


def distance_loss(distance, target, softening: float = 0.1):
    """Mean |f − d| / (softening + |d|) at points of known signed distance d [1, N], so that the same relative error
    counts the same near and far; `softening` in scene units."""
    return mean(dr.abs(distance - target) / (softening + dr.abs(target)))


def deformation_loss(delta, scenes: int):
    """L_Def, eq. 5, averaged over scenes: δ [3, S·n], the points of one scene consecutive."""
    per_scene: mi.TensorXf = dr.sum(dr.reshape(delta, (3, scenes, -1)), axis=2)
    n = delta.shape[1] // scenes
    return mean(norm(delta)) + mean(norm(per_scene)) / n


def landmark_loss(x_ref, scenes: int):
    """L_Lm: mean over landmarks of the squared distances between the scenes' landmarks in reference space [3, S·L],
    the landmarks of one scene consecutive. The mean over pairs is twice the variance over scenes."""
    x: mi.TensorXf = dr.reshape(x_ref, (3, scenes, -1))
    square = dr.sum(x * x, axis=1) / scenes
    centre = dr.sum(x, axis=1) / scenes
    return 2.0 * mean(dr.sum(square - centre * centre, axis=0))


def embedding_loss(*latents):
    """L_Emb of eqs 7 and 10: mean over scenes of the sum of ‖z‖² over `latents` [dim, S]."""
    return reduce(add, (mean(dr.sum(z * z, axis=0)) for z in latents))


def smoothness_loss(values, moved):
    """L_Reg of eq. 10: mean absolute difference of a field's values at points and at points moved a little, both
    [rows, N]."""
    return mean(dr.abs(values - moved))


def white_light_loss(amplitude):
    """Mean squared log-chroma of the amplitudes [N_l, 3] or [N_l, 3, S] of a light's lobes: 0 for grey light."""
    logarithm = dr.log(amplitude)
    grey: mi.TensorXf = dr.reshape(dr.mean(logarithm, axis=1), (logarithm.shape[0], 1, *logarithm.shape[2:]))
    chroma = logarithm - in_three(grey, axis=1)
    return mean(chroma * chroma)


def squared_norm(*latents):
    """The sum of ‖z‖² over `latents` [dim] of one head."""
    return reduce(add, (dr.sum(z * z, axis=None) for z in latents))


def display(radiance):
    """Linear radiance -> a display-like scale (square root), on which photometric errors are measured so that dark
    hair counts as bright skin does."""
    return dr.sqrt(dr.maximum(radiance, 0.0) + 1e-4)


def photometric_loss(radiance, target):
    """L_Col of eqs 6 and 10 and L_RGB of section 3.2.2: mean absolute difference of the `display` values [3, N]."""
    return mean(dr.abs(display(radiance) - display(target)))
