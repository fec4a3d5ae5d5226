"""Eq. 8 on columns of surface points: diffuse and specular radiance of albedos, normals and views under lobes."""

import mitsuba as mi
import numpy as np

from sira_mi.fields.columns import from_columns, to_columns
from sira_mi.sg.shading import irradiance as irradiance_of
from sira_mi.sg.shading import shade
from sira_mi.sg.visibility import received


def physical_radiance(albedo, specular, normals, views, roughness, k_s, lobes, arrival=None):
    """Eq. 8 in closed form: diffuse and specular radiance [3, N] of surface points under `lobes` [N_l, 7], with shadows
    and a bounce off surfaces of the same albedo if `arrival` (of `sg.visibility`) is given.

    `albedo` [3, N], `specular` [1, N], `roughness` and `k_s` numbers or [1, 1], unit `normals` [3, N], `views` [3, N]
    from the camera to the point. Where a normal faces away from the camera there is no specular radiance."""
    irradiance, specular_radiance = shade(
        from_columns(normals, mi.Vector3f),
        from_columns(-views, mi.Vector3f),
        from_columns(specular, mi.Float),
        mi.Float(roughness),
        lobes,
    )
    irradiance, specular_radiance = to_columns(irradiance), to_columns(specular_radiance)
    if arrival is not None:
        irradiance, specular_radiance = received(irradiance, specular_radiance, arrival, albedo)
    return albedo * irradiance * (1 / np.pi), specular_radiance * k_s


def diffuse_radiance(albedo, normals, lobes, arrival=None):
    """The diffuse part of `physical_radiance` [3, N]; `arrival` is that of `sg.visibility.diffuse_arrival`."""
    irradiance = to_columns(irradiance_of(from_columns(normals, mi.Vector3f), lobes))
    if arrival is not None:
        share, bounced = arrival
        irradiance = irradiance * share + bounced * albedo
    return albedo * irradiance * (1 / np.pi)
