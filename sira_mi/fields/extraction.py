"""The zero level set of a signed distance field as a closed triangle mesh.

The field is evaluated on a coarse grid, then on finer ones, each only where the previous one is close to the surface.
`extract_reference` evaluates the whole fine grid, for tests. Outside the domain box there is no solid, so the mesh is
closed flat along the box.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from sira_mi.conventions import DOMAIN_LOWER, DOMAIN_UPPER

# A cell is refined when |f| at its nearest evaluated corner is below this many cell diagonals; 1 would suffice for an
# exact distance, the margin allows for |∇f| up to 1.6. Fields that are steeper as a whole are refined farther out.
_MARGIN = 1.6
_LEVELS = 3
# |f| at a grid point counts as no less than this many spacings: where the surface runs through a point, its triangles
# would shrink to slivers, on which barycentric coordinates are not a number.
_LEAST_DISTANCE = 1e-3


@dataclass(frozen=True)
class ExtractedSurface:
    """A mesh and the distance grid that it came from: exact near the surface, interpolated away from it."""

    vertices: np.ndarray  # [V, 3] float32, scene units
    faces: np.ndarray  # [F, 3] uint32, outward winding
    on_box: np.ndarray  # [V] bool: the vertex closes the mesh along the domain box and is not on the field's surface
    grid: np.ndarray  # [nx, ny, nz] float32 signed distance; the grid starts at the domain's lower corner
    spacing: float  # of the grid, scene units


class EmptySurfaceError(ValueError):
    """The field has no zero level set inside the domain."""


def _shape(spacing: float) -> list[int]:
    """Points along each axis of the grid that covers the domain; it ends less than one `spacing` beyond it."""
    return [
        int(np.ceil((upper - lower) / spacing - 1e-5)) + 1
        for lower, upper in zip(DOMAIN_LOWER, DOMAIN_UPPER, strict=True)
    ]


def _axes(shape: Sequence[int], spacing: float) -> list[np.ndarray]:
    return [
        np.float32(lower) + np.float32(spacing) * np.arange(n, dtype=np.float32)
        for lower, n in zip(DOMAIN_LOWER, shape, strict=True)
    ]


def _points(axes: list[np.ndarray], index: np.ndarray) -> np.ndarray:
    """Grid points [3, n] at flat indices `index` of the grid spanned by `axes`."""
    parts = np.unravel_index(index, [len(a) for a in axes])
    return np.stack([a[i] for a, i in zip(axes, parts, strict=True)])


def extract(evaluate: Callable[[np.ndarray], np.ndarray], voxel: float) -> ExtractedSurface:
    """Marching cubes on a grid of spacing `voxel` (scene units) over the domain box.

    `evaluate` maps points [3, n] to signed distances [n]. Raises EmptySurfaceError when there is no surface."""
    spacing = voxel * 2**_LEVELS
    shape = _shape(spacing)
    values = evaluate(_points(_axes(shape, spacing), np.arange(np.prod(shape)))).reshape(shape)
    margin = _MARGIN * max(1.0, _typical_slope(values, spacing))
    for _ in range(_LEVELS):
        values, spacing = _refine(evaluate, values, spacing, margin)
    nx, ny, nz = _shape(voxel)
    return _mesh(values[:nx, :ny, :nz], voxel)


def extract_reference(evaluate: Callable[[np.ndarray], np.ndarray], voxel: float) -> ExtractedSurface:
    """`extract` with the field evaluated at every grid point."""
    shape = _shape(voxel)
    values = evaluate(_points(_axes(shape, voxel), np.arange(np.prod(shape)))).reshape(shape)
    return _mesh(values, voxel)


def _typical_slope(values: np.ndarray, spacing: float) -> float:
    """Median length of the gradient on a grid."""
    return float(np.median(np.linalg.norm(np.gradient(values, spacing), axis=0)))


def _refine(evaluate, values: np.ndarray, spacing: float, margin: float) -> tuple[np.ndarray, float]:
    """Halves the spacing: evaluates points within `margin` cell diagonals of the surface, interpolates the others
    linearly."""
    fine = values
    for axis in range(3):
        fine = np.moveaxis(fine, axis, 0)
        middle = 0.5 * (fine[1:] + fine[:-1])
        woven = np.empty((2 * len(fine) - 1, *fine.shape[1:]), np.float32)
        woven[0::2], woven[1::2] = fine, middle
        fine = np.moveaxis(woven, 0, axis)
    new = np.ones(fine.shape, bool)
    new[::2, ::2, ::2] = False
    near = np.flatnonzero((new & (np.abs(fine) < margin * spacing * np.sqrt(3))).ravel())
    spacing /= 2
    axes = _axes(fine.shape, spacing)
    fine = np.ascontiguousarray(fine)
    if len(near):
        fine.ravel()[near] = evaluate(_points(axes, near))
    return fine, spacing


def _mesh(values: np.ndarray, spacing: float) -> ExtractedSurface:
    least = np.float32(_LEAST_DISTANCE * spacing)
    apart = np.copysign(np.maximum(np.abs(values), least), values)
    padded = np.pad(apart, 1, constant_values=least)
    if not (padded.min() < 0 < padded.max()):
        raise EmptySurfaceError("the field has no surface inside the domain")
    from skimage.measure import marching_cubes

    vertices, faces, _, _ = marching_cubes(padded, 0.0, allow_degenerate=False)
    lower = np.array(DOMAIN_LOWER, np.float32)
    upper = lower + np.float32(spacing) * (np.array(values.shape, np.float32) - 1)
    vertices = (vertices.astype(np.float32) - 1) * np.float32(spacing) + lower
    on_box = ((vertices <= lower) | (vertices >= upper)).any(axis=1)
    return ExtractedSurface(np.clip(vertices, lower, upper), faces.astype(np.uint32), on_box, values, spacing)
