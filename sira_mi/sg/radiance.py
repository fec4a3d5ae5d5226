"""Eq. 8: the diffuse and specular radiance that surface points reflect of a light of spherical Gaussians.

Points are tensors `[3, N]`, one column a point: unit normals and unit views, which run from the camera to the point.
"""

from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from sira_mi.fields.columns import from_columns, to_columns
from sira_mi.sg.arrays import Float, TensorXf, Vector3f
from sira_mi.sg.scene_shading import shade_scenes
from sira_mi.sg.shading import irradiance as closed_form_irradiance
from sira_mi.sg.shading import shade
from sira_mi.sg.visibility import Visibility


class Material(NamedTuple):
    """What eq. 8 needs of the surface at N points."""

    diffuse_albedo: TensorXf  # [3, N]
    specular_albedo: TensorXf | None  # [1, N] reflectance at normal incidence; None leaves the specular term out
    roughness: Float
    k_s: TensorXf  # weight of the specular term; a number or [1, 1]


class Radiance(NamedTuple):
    """Radiance [3, N] by the two terms of eq. 8."""

    diffuse: TensorXf
    specular: TensorXf


def reflect(
    material: Material,
    irradiance: TensorXf,
    specular: TensorXf | None,
    visibility: Visibility | None = None,
) -> Radiance:
    """Eq. 8, a/π E + k_s ∫ l f^s (n·ω)₊ dω, of the two integrals [3, N] of the unoccluded light. With `visibility` they
    are reduced to what reaches the points, and one bounce is added, off occluders of the points' own albedo."""
    albedo = material.diffuse_albedo
    if visibility is not None:
        irradiance = irradiance * visibility.diffuse + visibility.bounce_diffuse * albedo
        if specular is not None:
            specular = specular * visibility.specular + visibility.bounce_specular * albedo
    diffuse = albedo * irradiance * (1 / np.pi)
    return Radiance(diffuse, dr.zeros(mi.TensorXf, diffuse.shape) if specular is None else specular * material.k_s)


def closed_form_radiance(
    normals: TensorXf,
    views: TensorXf,
    material: Material,
    lobes: TensorXf,
    visibility: Visibility | None = None,
) -> Radiance:
    """Eq. 8 in closed form at points under the light `lobes` [N_l, 7]; without `visibility` nothing blocks it. A normal
    that faces away from the camera has no specular radiance. Differentiable in every argument."""
    if material.specular_albedo is None:
        irradiance = to_columns(closed_form_irradiance(from_columns(normals, mi.Vector3f), lobes))
        return reflect(material, irradiance, None, visibility)
    point = _shading_points(normals, views, material)
    irradiance, specular = map(to_columns, shade(*point, mi.Float(material.roughness), lobes))
    return reflect(material, irradiance, specular, visibility)


def radiance_of_scenes(
    normals: TensorXf, views: TensorXf, material: Material, lobes: TensorXf, scenes: int
) -> Radiance:
    """`closed_form_radiance` of `scenes` S scenes in one launch, without visibility. Each scene's points are
    consecutive and under its own light, `lobes` [N_l, 7, S]. Normals and views are constants, the roughness a number;
    differentiable in albedos and lobes."""
    point = _shading_points(normals, views, material)
    irradiance, specular = map(to_columns, shade_scenes(*point, material.roughness, lobes, scenes))
    return reflect(material, irradiance, specular)


def _shading_points(normals, views, material) -> tuple[Vector3f, Vector3f, Float]:
    """Normal, direction to the camera and specular albedo as Dr.Jit vectors."""
    return (
        from_columns(normals, mi.Vector3f),
        from_columns(-views, mi.Vector3f),
        from_columns(material.specular_albedo, mi.Float),
    )
