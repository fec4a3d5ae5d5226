"""The surface points of a picture, on the field or on its mesh, with everything that shading needs. Closed forms and
direct light are evaluated at the same points, so that they differ by nothing else."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from sira_mi.fields.columns import evaluate_in_chunks, gather_columns, normalise
from sira_mi.fields.sdf import surface
from sira_mi.fields.tracing import on_ray
from sira_mi.plugins.neural_sdf import NeuralSDF, trace_head
from sira_mi.plugins.sira_sg import rotation_of, scale_of
from sira_mi.relight.surface import albedo_textures, evaluate_albedos
from sira_mi.sg.visibility import SHADOW_OFFSET
from studies.crosscheck.case import Case
from studies.stability.fields64 import Field64


@dataclass(frozen=True, eq=False)
class Points:
    """Surface points of N rays that hit the head, in the field's coordinates."""

    shape: tuple[int, int]  # height and width of the picture
    samples: int  # rays a pixel
    ray: np.ndarray  # [N] index of the ray; the pixel's is that over `samples`
    x: np.ndarray  # [3, N]
    normal: np.ndarray  # [3, N] unit, for shading
    facing: np.ndarray  # [3, N] unit, of the surface itself
    view: np.ndarray  # [3, N] unit, away from the surface
    diffuse: np.ndarray  # [3, N] albedo, of the networks
    specular: np.ndarray  # [1, N]
    baked_diffuse: np.ndarray | None  # [3, N] interpolated between vertices; None on the field
    baked_specular: np.ndarray | None  # [1, N]
    lift: float  # where shadow rays start: scene units above the surface,
    advance: float  # and along themselves

    def picture(self, values: np.ndarray) -> np.ndarray:
        """Values [C, N] at the points averaged into pixels [H, W, C], 0 where a ray misses the head."""
        height, width = self.shape
        pixel = self.ray // self.samples
        sums = [np.bincount(pixel, weights=row, minlength=height * width) for row in values]
        return np.stack(sums, axis=-1).reshape(height, width, -1) / self.samples

    def baked(self) -> tuple[np.ndarray, np.ndarray]:
        """Diffuse and specular albedo by interpolation between vertices."""
        if self.baked_diffuse is None or self.baked_specular is None:
            raise ValueError("points on the field have no baked albedos")
        return self.baked_diffuse, self.baked_specular


def primary_rays(case: Case, scene: mi.Scene, side: int, seed: int) -> mi.Ray3f:
    """side² rays through jittered cells of every pixel, those of a pixel consecutive."""
    rng = np.random.default_rng([seed, 1])
    count = case.width * case.height * side * side
    index = np.arange(count)
    pixel, cell = index // (side * side), index % (side * side)
    u = (pixel % case.width + (cell % side + rng.random(count)) / side) / case.width
    v = (pixel // case.width + (cell // side + rng.random(count)) / side) / case.height
    position = mi.Point2f(u.astype(np.float32), v.astype(np.float32))
    ray, _ = scene.sensors()[0].sample_ray(0.0, 0.5, position, mi.Point2f(0.5))
    return mi.Ray3f(ray)


def field_points(case: Case, scene: mi.Scene, head: NeuralSDF, side: int, seed: int) -> Points:
    """The exact hits on the field, as `sira_sg` finds them."""
    ray = primary_rays(case, scene, side, seed)
    t, hit = trace_head(scene, head, ray, mi.Bool(True))
    index: Any = dr.compress(hit)
    local = head.to_local @ ray
    origin, direction, parameter = (gather_columns(v, index) for v in (local.o, local.d, t))
    x = on_ray(origin, direction, parameter).numpy()
    field, textures = head.field(), albedo_textures(head)

    def columns(x, direction):
        _, gradient, x_ref, gamma = surface(field, x)
        albedos = (texture.evaluate_columns(x, x_ref, gamma) for texture in textures)
        return (normalise(gradient), -normalise(direction), *albedos)

    normal, view, diffuse, specular = evaluate_in_chunks(columns, x, direction.numpy())
    lift = SHADOW_OFFSET * head.voxel * scale_of(head.to_world)
    return Points(
        shape=(case.height, case.width),
        samples=side * side,
        ray=index.numpy(),
        x=x,
        normal=normal,
        facing=normal,
        view=view,
        diffuse=diffuse,
        specular=specular,
        baked_diffuse=None,
        baked_specular=None,
        lift=lift,
        advance=lift,
    )


def mesh_points(case: Case, scene: mi.Scene, head: NeuralSDF, side: int, seed: int) -> Points:
    """The hits on the mesh with its interpolated normals, as Mitsuba's integrators find them."""
    ray = primary_rays(case, scene, side, seed)
    si = scene.ray_intersect(ray)
    diffuse_texture, specular_texture = albedo_textures(head)
    baked_diffuse, baked_specular = diffuse_texture.eval_3(si), specular_texture.eval_1(si)
    hit = si.is_valid() & (si.shape == mi.ShapePtr(head))
    dr.eval(si, hit, baked_diffuse, baked_specular)
    index: Any = dr.compress(hit)
    inverse = rotation_of(head.to_world).T
    x = gather_columns(head.to_local @ si.p, index).numpy()
    diffuse, specular = evaluate_albedos(head, x)
    normal, facing, view = (inverse @ gather_columns(v, index).numpy() for v in (si.sh_frame.n, si.n, -ray.d))
    return Points(
        shape=(case.height, case.width),
        samples=side * side,
        ray=index.numpy(),
        x=x,
        normal=normal,
        facing=facing,
        view=view,
        diffuse=diffuse,
        specular=specular,
        baked_diffuse=gather_columns(baked_diffuse, index).numpy(),
        baked_specular=gather_columns(baked_specular, index).numpy(),
        lift=float(mi.math.RayEpsilon) * (1 + float(np.abs(x).max())),
        advance=0.0,
    )


def in_double(points: Points, head: NeuralSDF) -> tuple[np.ndarray, np.ndarray]:
    """Points of the field [3, N] and their unit normals, both in float64: one more Newton step from the hits in single
    precision, along the rays."""
    field = Field64.of(head.field())
    x, along = points.x.astype(np.float64), -points.view.astype(np.float64)
    parts = []
    for start in range(0, x.shape[1], 1 << 14):
        here, v = x[:, start : start + (1 << 14)], along[:, start : start + (1 << 14)]
        slope = (field.gradient(here) * v).sum(axis=0)
        step = np.where(np.abs(slope) > 0.02, -field.value(here) / np.where(slope == 0, 1, slope), 0)
        here = here + np.clip(step, -1e-3, 1e-3) * v
        gradient = field.gradient(here)
        parts.append(np.concatenate([here, gradient / np.linalg.norm(gradient, axis=0)]))
    joined = np.concatenate(parts, axis=1) if parts else np.zeros((6, 0))
    return joined[:3], joined[3:]
