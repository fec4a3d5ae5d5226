"""The relief stage: the surface follows the photo's shading (shape from shading). The paper has no such stage.

Silhouette and pose are settled by then, so the deformation network moves the surface along the photo's rays only: the
normals answer to the photo, and a term holds the points where they were."""

import drjit as dr
import mitsuba as mi
import numpy as np

from sira_mi.fields.sdf import normalised, surface
from sira_mi.fields.tracing import differentiable_hit
from sira_mi.fit.settings import FitSettings, Stage
from sira_mi.fit.shaded import base_albedo, photo_points, shade_points
from sira_mi.models import losses
from sira_mi.models.avatar import Avatar, signed_distance_field
from sira_mi.portrait.portrait import Portrait


class ReliefProblem:
    """The losses of the relief stage for one portrait, from the geometry of the avatar at `avatar_path` on."""

    def __init__(self, portrait: Portrait, avatar: Avatar, avatar_path: str, settings: FitSettings):
        self.portrait, self.avatar, self.settings = portrait, avatar, settings
        self.scene = mi.load_dict(
            {"type": "scene", "head": {"type": "neural_sdf", "avatar": avatar_path, "voxel": settings.voxel}}
        )
        self.head = self.scene.shapes()[0]
        self.parameters = mi.traverse(self.scene)

    def start(self, stage: Stage, tensors: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Keeps the surface as it is before the stage, as points [3, N] that the stage may not leave far behind."""
        points = photo_points(self.portrait, self.head, self.settings.shadows)
        return {"relief_anchor": (points.origin + points.t * points.view).astype(np.float32)}

    def refresh(self, tensors: dict[str, np.ndarray]) -> None:
        """Finds the photo's points on the current surface, and what light reaches them."""
        self.parameters["head.deformation"] = mi.Float(tensors["deformation"])
        self.parameters.update()
        self.points = photo_points(self.portrait, self.head, self.settings.shadows)
        self.anchor = tensors["relief_anchor"]
        self._fixed = {name: mi.Float(value) for name, value in tensors.items() if value.ndim == 1}

    def losses(self, tensors: dict, stage: Stage, step: int, rng: np.random.Generator) -> dict:
        weights = self.settings.relief
        current = {**self._fixed, **tensors}
        z_sdf = mi.TensorXf(current["z_sdf"], (len(current["z_sdf"]), 1))
        field = signed_distance_field(self.avatar.architecture, current["deformation"], current["reference"], z_sdf)
        points = self.points[_draw(rng, len(self.points.row), self.settings.pixels)]
        rays = (mi.TensorXf(v) for v in (points.origin, points.view, points.t))
        _, gradient, _, _ = surface(field, differentiable_hit(field, *rays))
        albedo = base_albedo(self.avatar, current, points)
        shading = shade_points(self.avatar, current, stage.k_s[1], points, albedo, normalised(gradient))
        target = mi.TensorXf(np.ascontiguousarray(self.portrait.image[points.row, points.column].T, np.float32))
        anchor = self.anchor[:, _draw(rng, self.anchor.shape[1], self.settings.points)]
        height, _, _, _ = surface(field, mi.TensorXf(np.ascontiguousarray(anchor)))
        return {
            "color": losses.photometric_loss(shading.diffuse + shading.specular, target),
            "anchor": weights.anchor * losses.mean(dr.abs(height)),
            "eikonal": weights.eikonal * losses.eikonal_loss(gradient),
        }


def _draw(rng: np.random.Generator, count: int, wanted: int) -> np.ndarray:
    return np.sort(rng.choice(count, min(wanted, count), replace=False))
