"""The detail of the diffuse albedo: the albedo of every point that a photo shows, as sharp as the photo.

It is a picture in the camera of the photo, so that neither networks nor the mesh limit it. A point takes the albedo of
the pixel that it is projected to, unless something lies before it, by a depth map.
"""

from collections.abc import Mapping
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from sira_mi.avatar.file import DETAIL

# Distance along the view, scene units, over which a point that the depth map does not show loses its detail.
_DEPTH_TOLERANCE = 0.1


class AlbedoDetail:
    """The detail that the tensors of an avatar hold: `detail` [H, W, 4], an albedo and how far it replaces the
    networks' (0 to 1); `detail_depth` [h, w], scene units along the camera's axis, 0 where the photo shows no head;
    `detail_camera` [3, 4], from a point in the field's coordinates to its place in the pictures (0 to 1) times its
    depth."""

    def __init__(self, tensors: Mapping[str, np.ndarray]):
        make: Any = mi.Texture2f  # the stubs call it an object

        def texture(image, kind):
            return make(mi.TensorXf(image), filter_mode=kind, wrap_mode=dr.WrapMode.Clamp)

        self.albedo = texture(tensors["detail"], dr.FilterMode.Linear)
        self.depth = texture(tensors["detail_depth"][..., None], dr.FilterMode.Nearest)
        self.camera = tensors["detail_camera"].astype(float)

    @classmethod
    def of(cls, tensors: Mapping[str, np.ndarray]) -> "AlbedoDetail | None":
        """The detail of an avatar's tensors; None where it has none."""
        return cls(tensors) if set(tensors) >= DETAIL else None

    def blend(self, albedo: list, point) -> list:
        """A diffuse albedo (three Floats) with the detail at a point (Point3f) in the field's coordinates. The detail
        has no gradients."""
        point = dr.detach(point)
        x, y, z = (sum(float(m) * c for m, c in zip(row, (*point, 1.0), strict=True)) for row in self.camera)
        before = z > 1e-3
        depth = dr.select(before, z, 1.0)
        place = mi.Point2f(x / depth, y / depth)
        inside = before & dr.all((place >= 0.0) & (place <= 1.0))
        *detail, weight = self.albedo.eval(place)
        distance = dr.abs(self.depth.eval(place)[0] - depth)
        weight = dr.select(inside, weight * dr.clip(2.0 - distance / _DEPTH_TOLERANCE, 0.0, 1.0), 0.0)
        return [dr.lerp(a, d, weight) for a, d in zip(albedo, detail, strict=True)]
