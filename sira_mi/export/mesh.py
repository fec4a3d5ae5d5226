"""Mesh files of a head."""

from pathlib import Path
from typing import Any

import numpy as np

from sira_mi.colour import linear_to_srgb
from sira_mi.conventions import MILLIMETRES_PER_UNIT
from sira_mi.fields.columns import evaluate_in_chunks, unit_columns
from sira_mi.fields.sdf import surface
from sira_mi.files import write_through


def write_mesh(path: Path, shape) -> None:
    """A PLY of a `neural_sdf` in metres (+y up, facing +z), with the field's normals and, as vertex colours, the sRGB
    diffuse albedo."""
    import trimesh  # takes seconds

    vertices = shape.vertices()
    field, texture = shape.field(), shape.bsdf().diffuse_albedo

    def columns(x):
        _, gradient, x_ref, gamma = surface(field, x)
        return gradient, texture.evaluate_columns(x, x_ref, gamma)

    gradient, albedo = evaluate_in_chunks(columns, vertices)
    mesh = trimesh.Trimesh(
        vertices.T * (MILLIMETRES_PER_UNIT / 1000),
        shape.faces(),
        vertex_normals=unit_columns(gradient).T,
        vertex_colors=(linear_to_srgb(np.clip(albedo.T, 0, 1)) * 255 + 0.5).astype(np.uint8),
        process=False,
    )
    data: Any = mesh.export(file_type="ply", vertex_normal=True)  # bytes, of all that trimesh may return
    write_through(path, lambda p: p.write_bytes(data))
