"""The detail of the diffuse albedo: a factor by which a photo corrects the albedo of every point that it shows.

It is a picture in the camera of the photo, so that it is as sharp as the photo, whatever the networks and the mesh
resolve. A point takes the factor of the pixel that it is projected to if nothing lies before it, by a depth map.
"""

from collections.abc import Mapping

import drjit as dr
import mitsuba as mi
import numpy as np

from sira_mi.avatar.file import DETAIL

# Distance along the view, scene units, over which a point that the depth map does not show loses its detail.
_DEPTH_TOLERANCE = 0.1


class AlbedoDetail:
    """The detail that the tensors of an avatar hold: `detail` [H, W, 3], the logarithm of the factor; `detail_depth`
    [H, W], scene units along the camera's axis, 0 where the photo shows no head; `detail_camera` [3, 4], from a point
    in the field's coordinates to pixels times depth."""

    def __init__(self, tensors: Mapping[str, np.ndarray]):
        def texture(image, kind):
            return mi.Texture2f(mi.TensorXf(image), filter_mode=kind, wrap_mode=dr.WrapMode.Clamp)

        self.height, self.width = tensors["detail"].shape[:2]
        self.logarithm = texture(tensors["detail"], dr.FilterMode.Linear)
        self.depth = texture(tensors["detail_depth"][..., None], dr.FilterMode.Nearest)
        self.camera = tensors["detail_camera"].astype(float)

    @classmethod
    def of(cls, tensors: Mapping[str, np.ndarray]) -> "AlbedoDetail | None":
        """The detail of an avatar's tensors; None where it has none."""
        return cls(tensors) if set(tensors) >= DETAIL else None

    def factor(self, point) -> list:
        """The factor at a point (Point3f) in the field's coordinates, three Floats; without gradients."""
        point = dr.detach(point)
        x, y, z = (sum(float(m) * c for m, c in zip(row, (*point, 1.0), strict=True)) for row in self.camera)
        before = z > 1e-3
        depth = dr.select(before, z, 1.0)
        place = mi.Point2f(x / (depth * self.width), y / (depth * self.height))
        inside = before & dr.all((place >= 0.0) & (place <= 1.0))
        distance = dr.abs(self.depth.eval(place)[0] - depth)
        weight = dr.select(inside, dr.clip(2.0 - distance / _DEPTH_TOLERANCE, 0.0, 1.0), 0.0)
        return [dr.exp(weight * c) for c in self.logarithm.eval(place)]
