"""Hair: MakeHuman hair meshes fitted to a head and turned into one soft, closed volume.

A hair mesh is a stack of open sheets of strands ("cards"). Its fitting file (`.mhclo`) places every hair vertex at the
barycentre of three base-mesh vertices plus an offset scaled by the head's width, height and depth. The sheets are
sampled, thickened by a morphological closing on a voxel grid, and the closed surface of the result is the hair.
"""

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import cv2
import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree
from skimage.measure import marching_cubes

from sira_mi.conventions import DOMAIN_LOWER, DOMAIN_UPPER
from sira_mi.errors import InputError
from sira_mi.training.collection.makehuman import load_pack
from sira_mi.training.collection.triangles import draw_barycentric, triangle_areas

VOXEL = 0.04  # scene units
CLOSING = 0.16  # scene units: gaps between sheets up to twice this are filled
THICKNESS = 0.035  # scene units that the sheets are thickened by on either side
SOFTENING = 0.9  # voxels, Gaussian blur of the distance field
SAMPLE_SPACING = 0.02  # scene units between samples on the sheets
SMALLEST_PIECE = 0.05  # share of the largest connected piece under which a piece is dropped
VERTEX_LIMIT = 200_000


@dataclass(frozen=True)
class HairMesh:
    name: str
    triangles: np.ndarray  # [T, 3] hair vertex indices
    texture: np.ndarray  # [T, 3, 2] texture coordinates of the corners
    anchors: np.ndarray  # [N, 3] base-mesh vertex indices
    weights: np.ndarray  # [N, 3] barycentric weights
    offsets: np.ndarray  # [N, 3] offsets before scaling
    scales: np.ndarray  # [3, 2] base-mesh vertices whose distance measures each axis
    lengths: np.ndarray  # [3] that distance on the head the hair was made for, decimetres
    alpha: np.ndarray | None  # [H, W] opacity in 0..1, or None when the folder has no readable texture


def list_hair(folder: Path) -> list[str]:
    """Names of the hair meshes NAME/NAME.mhclo with NAME/NAME.obj in a folder."""
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder of hair meshes")
    names = [p.name for p in sorted(folder.iterdir()) if (p / f"{p.name}.mhclo").is_file()]
    if not names:
        raise InputError(f"{folder}: no hair found; expected NAME/NAME.mhclo with NAME/NAME.obj")
    return names


@cache
def read_hair(folder: Path, name: str) -> HairMesh:
    """Reads one hair mesh; raises `InputError` on a malformed or inconsistent file."""
    try:
        fitting = (folder / name / f"{name}.mhclo").read_text(encoding="utf-8", errors="replace")
        model = (folder / name / f"{name}.obj").read_text(encoding="utf-8", errors="replace")
    except OSError as error:
        raise InputError(f"{folder / name}: {error.strerror}") from None
    try:
        anchors, weights, offsets, scales, lengths = parse_fitting(fitting)
        count, triangles, texture = parse_model(model)
    except (ValueError, IndexError) as error:
        raise InputError(f"{folder / name}: malformed hair files ({error})") from None
    if count != len(anchors) or not len(triangles):
        raise InputError(f"{folder / name}: {count} vertices in the mesh, {len(anchors)} in the fitting file")
    limit = len(load_pack().vertices)
    if anchors.min() < 0 or anchors.max() >= limit or scales.min() < 0 or scales.max() >= limit:
        raise InputError(f"{folder / name}: the fitting file names vertices outside the base mesh")
    if triangles.min() < 0 or triangles.max() >= count or (lengths <= 0).any():
        raise InputError(f"{folder / name}: malformed hair files")
    return HairMesh(name, triangles, texture, anchors, weights, offsets, scales, lengths, _read_alpha(folder / name))


def _read_alpha(folder: Path) -> np.ndarray | None:
    for path in sorted(folder.glob("*_diffuse.png")):
        image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        if image is not None and image.ndim == 3 and image.shape[2] == 4:
            return image[..., 3].astype(np.float32) / (65535 if image.dtype == np.uint16 else 255)
    return None


def parse_fitting(text: str) -> tuple[np.ndarray, ...]:
    """Anchors [N, 3], weights [N, 3], offsets [N, 3], scale vertices [3, 2] and lengths [3] of an `.mhclo`."""
    scales, rows, reading = {}, [], False
    for line in text.splitlines():
        words = line.split("#")[0].split()
        if not words:
            continue
        if words[0] in ("x_scale", "y_scale", "z_scale"):
            scales["xyz".index(words[0][0])] = (int(words[1]), int(words[2]), float(words[3]))
        elif words[0] == "verts":
            reading = True
        elif reading and len(words) == 9:
            rows.append([float(w) for w in words])
        elif reading and len(words) == 1 and words[0].isdigit():
            rows.append([float(words[0])] * 3 + [1.0, 0, 0, 0, 0, 0])
        elif rows:
            reading = False
        if len(rows) > VERTEX_LIMIT:
            raise ValueError("too many vertices")
    if sorted(scales) != [0, 1, 2] or not rows:
        raise ValueError("no x_scale, y_scale, z_scale or vertex rows")
    table = np.array(rows)
    axes = [scales[axis] for axis in range(3)]
    lengths = np.array([s[2] for s in axes])
    return table[:, :3].astype(int), table[:, 3:6], table[:, 6:9], np.array([s[:2] for s in axes]), lengths


def parse_model(text: str) -> tuple[int, np.ndarray, np.ndarray]:
    """Vertex count, triangles [T, 3] and texture coordinates [T, 3, 2] of an OBJ file."""
    count, coordinates, triangles, texture = 0, [], [], []
    for line in text.splitlines():
        words = line.split()
        if not words:
            continue
        if words[0] == "v":
            count += 1
        elif words[0] == "vt":
            coordinates.append((float(words[1]), float(words[2])))
        elif words[0] == "f":
            corners = [(*w.split("/"), "")[:2] for w in words[1:]]
            for second in range(1, len(corners) - 1):
                chosen = (corners[0], corners[second], corners[second + 1])
                triangles.append([int(c[0]) - 1 for c in chosen])
                texture.append([coordinates[int(c[1]) - 1] if c[1] else (0.0, 0.0) for c in chosen])
        if count > VERTEX_LIMIT or len(triangles) > 4 * VERTEX_LIMIT:
            raise ValueError("too many vertices")
    return count, np.array(triangles, int).reshape(-1, 3), np.array(texture, float).reshape(-1, 3, 2)


def fit_hair(mesh: HairMesh, vertices: np.ndarray) -> np.ndarray:
    """Hair vertices [N, 3] on a head given by its base-mesh vertices [19158, 3]."""
    scale = [abs(vertices[a, i] - vertices[b, i]) for i, (a, b) in enumerate(mesh.scales)] / mesh.lengths
    placed = np.einsum("nk,nkd->nd", mesh.weights, vertices[mesh.anchors])
    return placed + mesh.offsets * scale


def sample_sheets(
    mesh: HairMesh, vertices: np.ndarray, random: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points [S, 3] about `SAMPLE_SPACING` apart on the opaque part of the sheets, the sheet coordinate that runs
    across the strands [S], and the direction of the strands [S, 3]."""
    corners = vertices[mesh.triangles]
    edge_u, edge_v = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = triangle_areas(corners)
    number = random.poisson(area / SAMPLE_SPACING**2) + 1
    triangle = np.repeat(np.arange(len(area)), number)
    bary = draw_barycentric(random, len(triangle))
    points = np.einsum("sk,skd->sd", bary, corners[triangle])
    coordinates = np.einsum("sk,skd->sd", bary, mesh.texture[triangle])
    # Direction in which the texture's v axis runs over each triangle.
    t1, t2 = mesh.texture[:, 1] - mesh.texture[:, 0], mesh.texture[:, 2] - mesh.texture[:, 0]
    strand = edge_v * t1[:, :1] - edge_u * t2[:, :1]
    strand *= np.sign(t1[:, 0] * t2[:, 1] - t1[:, 1] * t2[:, 0])[:, None]
    strand /= np.maximum(np.linalg.norm(strand, axis=1, keepdims=True), 1e-9)
    if mesh.alpha is not None:
        height, width = mesh.alpha.shape
        x = np.clip((coordinates[:, 0] % 1) * width, 0, width - 1).astype(int)
        y = np.clip((1 - coordinates[:, 1] % 1) * height, 0, height - 1).astype(int)
        opaque = mesh.alpha[y, x] > 0.4
        points, coordinates, triangle = points[opaque], coordinates[opaque], triangle[opaque]
    return points, coordinates[:, 0], strand[triangle]


def build_hair_volume(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The closed surface around sheet samples [S, 3]: vertices [N, 3], triangles [T, 3] and outward normals [N, 3]."""
    margin = CLOSING + 4 * VOXEL
    lower = np.maximum(points.min(0), np.array(DOMAIN_LOWER) + 0.02) - margin
    upper = np.minimum(points.max(0), np.array(DOMAIN_UPPER) - 0.02) + margin
    shape = np.ceil((upper - lower) / VOXEL).astype(int) + 1
    cell = np.rint((points - lower) / VOXEL).astype(int)
    inside = ((cell >= 0) & (cell < shape)).all(1)
    filled = np.ones(shape, bool)
    filled[tuple(cell[inside].T)] = False
    reach = CLOSING / VOXEL
    far = ndimage.distance_transform_edt(filled) > reach
    depth = ndimage.distance_transform_edt(~far)
    field = reach - depth - THICKNESS / VOXEL
    field = ndimage.gaussian_filter(np.clip(field, -4, 4), SOFTENING)
    field[[0, -1]] = field[:, [0, -1]] = field[:, :, [0, -1]] = 4
    pieces, count = ndimage.label(field < 0)
    if count > 1:
        sizes = np.bincount(pieces.ravel())
        sizes[0] = 0
        field[np.isin(pieces, np.flatnonzero(sizes < SMALLEST_PIECE * sizes.max())) & (pieces > 0)] = 1
    vertices, triangles, normals, _ = marching_cubes(field.astype(np.float32), 0.0, gradient_direction="ascent")
    vertices = vertices * VOXEL + lower
    corners = vertices[triangles]
    volume = np.einsum("td,td->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))
    if volume < 0:
        triangles = triangles[:, ::-1]
    return vertices, np.ascontiguousarray(triangles), _find_normals(vertices, normals, field, lower)


def _find_normals(vertices, normals, field, lower):
    """Unit normals along the field's gradient, which grows outwards."""
    cell = ((vertices - lower) / VOXEL).T
    gradient = np.stack(
        [ndimage.map_coordinates(part, cell, order=1, mode="nearest") for part in np.gradient(field)], axis=-1
    )
    length = np.linalg.norm(gradient, axis=1, keepdims=True)
    return np.where(length > 1e-6, gradient / np.maximum(length, 1e-6), normals)


def draw_strand_pattern(
    vertices: np.ndarray, points: np.ndarray, across: np.ndarray, random: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Fine and coarse noise [N], each of about unit variance, that varies across the strands of the nearest sheet."""
    _, near = cKDTree(points).query(vertices, k=4)
    cell = (np.abs(across[near]) * 4096).astype(int) % 4096
    patterns = []
    for width in (6, 40):
        stripes = ndimage.gaussian_filter1d(random.standard_normal(4096), width, mode="wrap")
        patterns.append((stripes / stripes.std())[cell].mean(1))
    return patterns[0], patterns[1]
