"""Small pictures of a model while it trains, and of the heads that it spans.

A head is drawn orthographically, turned a little to its side: the field is extracted on a coarse grid, rays cross that
grid, and one Newton step on the field itself places and shades the hits.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import mitsuba as mi
import numpy as np
from scipy.ndimage import affine_transform

from sira_mi.avatar.architecture import AvatarArchitecture
from sira_mi.avatar.decoders import diffuse_albedo, illumination, specular_albedo
from sira_mi.avatar.shape import HeadShape, head_of
from sira_mi.conventions import DOMAIN_LOWER, DOMAIN_UPPER
from sira_mi.fields.columns import evaluate_in_chunks, unit_columns
from sira_mi.fields.extraction import EmptySurfaceError, ExtractedSurface, extract
from sira_mi.fields.mlp import layers
from sira_mi.fields.sdf import SdfField, signed_distance, surface
from sira_mi.files import write_png
from sira_mi.portrait.camera import yaw_rotation
from sira_mi.sg.radiance import Material, closed_form_radiance
from sira_mi.training.scenes import TrainingScene
from sira_mi.training.shape_model import ShapeModel

TILE = (128, 96)  # pixels, rows and columns
YAW = 30.0  # degrees, the head's turn to its left
_VIEW_HEIGHT, _VIEW_TOP = 3.4, 1.7  # of a tile, scene units
_DEPTH = 2.8  # half the depth that rays cross, scene units
_VOXEL = 0.1  # of the grid that rays cross, scene units
_KEY_LIGHT = np.array([-0.45, 0.45, 0.77], np.float32)  # unit, in view coordinates
_BACKGROUND = 1.0


def _shade(normals: np.ndarray, view: np.ndarray) -> np.ndarray:
    """Grey of unit normals [3, N] under a light from the upper left and an even one."""
    return 0.2 + 0.75 * np.clip(_KEY_LIGHT @ (view @ normals), 0, 1)


def _crossings(grid: np.ndarray, spacing: float, view: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where the rays of a tile first enter the grid's solid: the pixels [H, W] bool that do, and their points [3, M]
    in the world."""
    height, width = TILE
    pixel, step = _VIEW_HEIGHT / height, 0.5 * spacing
    samples = int(2 * _DEPTH / step)
    corner = np.array([-0.5 * pixel * (width - 1), _VIEW_TOP - 0.5 * pixel, _DEPTH])
    axes = np.array([[0, pixel, 0], [-pixel, 0, 0], [0, 0, -step]])  # view coordinates of (row, column, sample)
    to_grid = view.T @ axes / spacing
    offset = (view.T @ corner - np.array(DOMAIN_LOWER)) / spacing
    values = affine_transform(grid, to_grid, offset, (height, width, samples), order=1, mode="constant", cval=spacing)
    inside = values <= 0
    hit = inside.any(axis=2)
    row, column = np.nonzero(hit)
    last = np.maximum(inside.argmax(axis=2)[hit], 1)
    after, before = values[row, column, last], values[row, column, last - 1]
    depth = last - np.clip(after / np.minimum(after - before, -1e-9), 0, 1)
    return hit, view.T @ (axes @ np.stack([row, column, depth]) + corner[:, None])


def _pad(points: np.ndarray, multiple: int = 2048) -> np.ndarray:
    """Points [3, M] with the last repeated up to a multiple, so that few kernels serve all pictures."""
    return np.pad(points, ((0, 0), (0, -points.shape[1] % multiple)), mode="edge").astype(np.float32)


def blank_tile() -> np.ndarray:
    """A tile [H, W, 3] of plain background."""
    return np.full((*TILE, 3), _BACKGROUND, np.float32)


def extract_surface(field: SdfField, voxel: float = _VOXEL) -> ExtractedSurface:
    """The field's zero level set on a grid of spacing `voxel`, scene units. Raises EmptySurfaceError."""
    return extract(lambda p: evaluate_in_chunks(lambda x: signed_distance(field, x), p)[0][0], voxel)


def head_tile(field: SdfField, extracted: ExtractedSurface | None = None, yaw: float = YAW) -> np.ndarray:
    """A shaded picture [H, W, 3] of a field's surface, display values in 0..1; plain background where there is none.
    `extracted` is the field's surface if it is known already."""
    tile, view = blank_tile(), yaw_rotation(yaw)
    try:
        extracted = extracted or extract_surface(field)
    except EmptySurfaceError:
        return tile
    hit, points = _crossings(extracted.grid, extracted.spacing, view)
    count = points.shape[1]
    if count == 0:
        return tile
    f, gradient = evaluate_in_chunks(lambda x: surface(field, x)[:2], _pad(points))
    ray = -view[2][:, None]
    slope = np.minimum((ray * gradient).sum(axis=0), -0.1)
    moved = points + ray * np.clip(-f[0] / slope, -_VOXEL, _VOXEL)[:count]
    (gradient,) = evaluate_in_chunks(lambda x: surface(field, x)[1], _pad(moved))
    normals = unit_columns(gradient[:, :count])
    closing = (moved <= np.array(DOMAIN_LOWER)[:, None] + 0.02) | (moved >= np.array(DOMAIN_UPPER)[:, None] - 0.02)
    grey = np.where(closing.any(axis=0), 0.5, _shade(normals, view))
    tile[hit] = grey[:, None]
    return tile


def splat(points: np.ndarray, normals: np.ndarray, values: np.ndarray, yaw: float = YAW) -> np.ndarray:
    """Points [P, 3] with normals [P, 3] towards the camera, painted three pixels wide, the nearest in front, with
    display values [P, 3]: a tile [H, W, 3]."""
    height, width = TILE
    view, pixel = yaw_rotation(yaw), _VIEW_HEIGHT / TILE[0]
    front = np.flatnonzero(normals @ view[2] > 0.05)
    x, y, z = view @ points[front].T
    order = np.argsort(z, kind="stable")
    column = np.floor(x[order] / pixel + width / 2).astype(int)
    row = np.floor((_VIEW_TOP - y[order]) / pixel).astype(int)
    depth, tile = np.full(TILE, -np.inf), blank_tile()
    for i in (-1, 0, 1):
        for j in (-1, 0, 1):
            within = (row + i >= 0) & (row + i < height) & (column + j >= 0) & (column + j < width)
            place, mine = (row[within] + i, column[within] + j), order[within]
            layer, colors = np.full(TILE, -np.inf), blank_tile()
            layer[place], colors[place] = z[mine], values[front[mine]]
            nearer = layer > depth
            depth[nearer], tile[nearer] = layer[nearer], colors[nearer]
    return tile


def scan_tile(points: np.ndarray, normals: np.ndarray, yaw: float = YAW) -> np.ndarray:
    """A scan's points [P, 3] shaded as `head_tile` shades, by their normals [P, 3]."""
    return splat(points, normals, np.repeat(_shade(normals.T, yaw_rotation(yaw))[:, None], 3, axis=1), yaw)


def sheet(rows: list[list[np.ndarray]]) -> np.ndarray:
    """Tiles in rows, shorter rows filled up with background: [rows·H, columns·W, 3]."""
    columns = max(len(row) for row in rows)
    return np.concatenate(
        [np.concatenate([*row, *[blank_tile()] * (columns - len(row))], axis=1) for row in rows], axis=0
    )


def shape_picture(
    path: Path,
    architecture: AvatarArchitecture,
    parameters: Mapping[str, np.ndarray],
    scenes: list[TrainingScene],
    seed: int = 0,
) -> None:
    """Writes the state of a SA-SM: above, the mean head, the first two latent directions at −2σ and +2σ and a random
    sample; below, three scenes beside the heads of their latents."""
    model = ShapeModel.of_training(architecture, parameters)
    directions = np.eye(model.bases["z_sdf"].shape[1], dtype=np.float32)[:2]
    random = np.random.default_rng([seed, 6]).standard_normal(directions.shape[1])
    heads = [0 * random, *(sign * 2 * d for d in directions for sign in (-1, 1)), random]
    above = [head_tile(model.field(model.latent("z_sdf", w))) for w in heads]
    below = []
    for k in np.unique(np.linspace(0, len(scenes) - 1, 3).round().astype(int)):
        below += [
            scan_tile(scenes[k].points, scenes[k].normals),
            head_tile(HeadShape(architecture).field(head_of(parameters, k))),
        ]
    write_png(path, sheet([above, below]))


class AppearancePicture:
    """Albedo, specular albedo and relighting of a few training scenes, painted on their points.

    The frozen deformation is evaluated at the points once, when the object is made."""

    def __init__(
        self,
        architecture: AvatarArchitecture,
        shape: Mapping[str, np.ndarray],
        scenes: list[TrainingScene],
        roughness: float,
    ):
        """`shape` are the parameters of the SA-SM."""
        self.architecture, self.roughness = architecture, roughness
        self.chosen = np.unique(np.linspace(0, len(scenes) - 1, 3).round().astype(int))
        self.points, self.frozen = [scenes[k].points for k in self.chosen], []
        for k, points in zip(self.chosen, self.points, strict=True):
            field = HeadShape(architecture).field(head_of(shape, k))
            _, gradient, x_ref, gamma = evaluate_in_chunks(lambda x, field=field: surface(field, x), points.T)
            self.frozen.append((unit_columns(gradient), x_ref, gamma))

    def write(self, path: Path, parameters: dict[str, np.ndarray]) -> None:
        """Writes one row a scene: albedo, specular albedo (eight times as bright), under its own light, under that of
        the next scene."""
        column = {name: parameters[name][:, self.chosen] for name in ("z_a", "z_s", "z_l")}
        networks = self.architecture.networks
        lobes = illumination(layers(networks["illumination"], parameters["illumination"]), mi.TensorXf(column["z_l"]))
        rows = []
        for k, (points, frozen) in enumerate(zip(self.points, self.frozen, strict=True)):
            diffuse = layers(networks["diffuse_albedo"], parameters["diffuse_albedo"], column["z_a"][:, k])
            specular = layers(networks["specular_albedo"], parameters["specular_albedo"], column["z_s"][:, k])
            lights = [lobes[:, :, k], lobes[:, :, (k + 1) % len(self.points)]]
            away = -yaw_rotation(YAW)[2].astype(np.float32)

            def colors(normals, x_ref, gamma, diffuse=diffuse, specular=specular, lights=lights, away=away):
                albedo = diffuse_albedo(diffuse, self.architecture.albedo_octaves, x_ref, gamma)
                shine = specular_albedo(specular, self.architecture.specular_octaves, x_ref)
                views = mi.TensorXf(np.repeat(away[:, None], x_ref.shape[1], axis=1))
                material = Material(albedo, shine, self.roughness, 1.0)
                lit = [closed_form_radiance(normals, views, material, light) for light in lights]
                return albedo, shine, *(a + b for a, b in lit)

            albedo, shine, *lit = evaluate_in_chunks(colors, *frozen)
            shine = np.repeat(8 * shine, 3, axis=0)
            rows.append([splat(points, frozen[0].T, np.sqrt(np.clip(v, 0, 1)).T) for v in (albedo, shine, *lit)])
        write_png(path, sheet(rows))
