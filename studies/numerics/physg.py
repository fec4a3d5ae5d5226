"""PhySG's closed form of the specular term (Zhang et al. 2021), with one cosine integral instead of a two-term cosine:
the baseline that `sira_mi.sg.specular` improves on."""

import math

import drjit as dr

from sira_mi.sg import brdf
from sira_mi.sg.arrays import Color3f, Float, Vector3f
from sira_mi.sg.integrals import cosine_integral, product

# A view direction lower than this cosine is shaded as if at it: the warped sharpness is λ/(4 n·v).
_MINIMUM_VIEW_COSINE = 1e-3


def specular_lobe(normal: Vector3f, view: Vector3f, roughness: Float) -> tuple[Vector3f, Float, Float]:
    """PhySG's warped distribution as a lobe of light directions: mirror axis, sharpness λ/(4 n·v), 1/(πr⁴)."""
    cosine = dr.maximum(dr.dot(normal, view), _MINIMUM_VIEW_COSINE)
    sharpness = brdf.distribution_sharpness(roughness)
    mirror = dr.normalize(2.0 * cosine * normal - view)
    return mirror, sharpness / (4.0 * cosine), sharpness * (0.5 / math.pi)


def specular_radiance(
    normal: Vector3f,
    view: Vector3f,
    specular_albedo: Float,
    roughness: Float,
    axis: Vector3f,
    sharpness: Float,
    amplitude: Color3f,
) -> Color3f:
    """∫ G f^s (ω·n)₊ dω of one light lobe `[..., 3]`: one warped lobe, Fresnel and masking at the mirror direction."""
    cosine = dr.dot(normal, view)
    lobe_axis, lobe_sharpness, lobe_amplitude = specular_lobe(normal, view, roughness)
    joint_axis, joint_sharpness, log_amplitude = product(lobe_axis, lobe_sharpness, axis, sharpness)
    integral = dr.exp(log_amplitude) * cosine_integral(dr.dot(normal, joint_axis), joint_sharpness)
    cos_mirror = dr.maximum(cosine, _MINIMUM_VIEW_COSINE)
    moment = dr.square(brdf.masking(cos_mirror, roughness)) * brdf.fresnel(specular_albedo, cos_mirror)
    return amplitude * dr.select(cosine > 0.0, 0.25 * lobe_amplitude * moment * integral, 0.0)
