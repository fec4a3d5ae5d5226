"""The shading stage: shape from shading. The paper has no such stage.

Once light and albedo are known, eq. 8 says how bright each slope of the surface is. The stage goes on with the losses
of the geometry stages, eq. 8's colour in place of the learned radiance's: latents and deformation network of the shape
answer to it, while light, albedo and camera stay. The albedo is a function of the reference space and moves with the
surface."""

import mitsuba as mi
import numpy as np

from sira_mi.avatar.decoders import diffuse_albedo
from sira_mi.avatar.file import Avatar
from sira_mi.fields.columns import normalise
from sira_mi.fields.sdf import SdfField, surface
from sira_mi.fields.tracing import differentiable_hit
from sira_mi.fit.geometry import GeometryProblem
from sira_mi.fit.settings import FitSettings, Stage
from sira_mi.fit.shaded import decoder, photo_points, shade_points
from sira_mi.optimisation import losses
from sira_mi.portrait.portrait import Portrait, halve


class ShadingProblem(GeometryProblem):
    """The losses of the shading stage for one portrait whose camera sees the head unmoved (`with_pose`). Eq. 8's colour
    is compared at half the portrait's size: slopes are smooth, and points and their light are traced in every block."""

    def __init__(self, portrait: Portrait, avatar: Avatar, avatar_path: str, settings: FitSettings):
        super().__init__(portrait, avatar, avatar_path, settings)
        self.photo = halve(portrait)

    def refresh(self, tensors: dict[str, np.ndarray]) -> None:
        """Finds the photo's points on the current surface too, and what light reaches them. Raises
        EmptySurfaceError."""
        super().refresh(tensors | {"pose": np.zeros(6, np.float32)})
        self.points = photo_points(self.photo, self.head, self.settings.shadows)
        self._fixed |= {name: mi.Float(v) for name, v in tensors.items() if v.ndim == 1 and name not in self._fixed}

    def losses(self, tensors: dict, stage: Stage, step: int, rng: np.random.Generator) -> dict:
        current = {**self._fixed, **tensors}
        field = self._field(current)
        terms = self._losses_of(field, tensors, stage, step, rng)
        terms["color"] = self.settings.geometry.shading * self._shading_loss(field, current, stage, rng)
        return terms

    def _shading_loss(self, field: SdfField, current: dict, stage: Stage, rng: np.random.Generator):
        """Photometric loss of eq. 8 on pixels drawn from the photo: by the surface's places and normals, which carry
        the derivative, and the light that reaches the points where they were at the last refresh."""
        count = len(self.points.row)
        points = self.points[np.sort(rng.choice(count, min(self.settings.rays, count), replace=False))]
        rays = (mi.TensorXf(v) for v in (points.origin, points.view, points.t))
        _, gradient, x_ref, gamma = surface(field, differentiable_hit(field, *rays))
        network = decoder(self.avatar, "diffuse_albedo", current, "z_a")
        albedo = diffuse_albedo(network, self.avatar.architecture.albedo_octaves, x_ref, gamma)
        shading = shade_points(self.avatar, current, stage.k_s[1], points, albedo, normalise(gradient))
        target = np.ascontiguousarray(self.photo.image[points.row, points.column].T, np.float32)
        return losses.photometric_loss(shading.diffuse + shading.specular, mi.TensorXf(target))
