"""Triangle surfaces with textures or colours: refined to even edges, closed downwards, textures read at vertices."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np

from sira_mi.colour import srgb_to_linear
from sira_mi.training.collection.surface import BODY_FLOOR
from sira_mi.training.collection.triangles import connected_pieces, undirected_edges, vertex_normals

TEXTURE_SIDE = 768  # pixels that textures are reduced to
REFINED_TRIANGLES = 600_000  # where refinement stops
SAME_PLACE = 1e-5  # share of the size of a mesh within which vertices are one


@dataclass(frozen=True)
class Surface:
    """A mesh with texture coordinates or colours at its vertices; vertices may repeat along texture seams."""

    vertices: np.ndarray  # [N, 3]
    triangles: np.ndarray  # [T, 3]
    uv: np.ndarray  # [N, 2] texture coordinates, v downwards; unused without texture
    albedo: np.ndarray  # [N, 3] linear, of untextured surfaces
    texture: np.ndarray | None = None  # [H, W, 3] linear

    def colours(self) -> np.ndarray:
        """Linear albedo [N, 3]."""
        return self.albedo if self.texture is None else sample_texture(self.texture, self.uv)


def place_index(vertices: np.ndarray) -> np.ndarray:
    """Index [N] of each vertex among the different places."""
    size = max(float(np.ptp(vertices, axis=0).max()), 1e-30)
    x, y, z = np.rint((vertices - vertices.min(0)) / (SAME_PLACE * size)).astype(np.int64).T
    return np.unique((x << 40) + (y << 20) + z, return_inverse=True)[1].reshape(-1)


def smooth_normals(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Unit normals [N, 3] that are equal where vertices share a place."""
    index = place_index(vertices)
    places = np.zeros((index.max() + 1, 3))
    places[index] = vertices
    return vertex_normals(places, index[triangles])[index]


def decode_texture(image: np.ndarray, side: int = TEXTURE_SIDE) -> np.ndarray:
    """Linear [H, W, 3] of an 8-bit sRGB image, reduced to at most `side` pixels a side."""
    linear = srgb_to_linear(image[..., :3].astype(np.float32) / 255)
    scale = side / max(linear.shape[:2])
    if scale < 1:
        size = (max(1, round(linear.shape[1] * scale)), max(1, round(linear.shape[0] * scale)))
        linear = cv2.resize(linear, size, interpolation=cv2.INTER_AREA)
    return linear


def sample_texture(texture: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Bilinear values [N, 3] of a texture [H, W, 3] that repeats, at coordinates [N, 2] with v downwards."""
    height, width = texture.shape[:2]
    at = (uv % 1.0) * [width, height] - 0.5
    corner = np.floor(at).astype(int)
    fx, fy = (at - corner).T[..., None]
    x, y = corner.T
    x1, y1 = (x + 1) % width, (y + 1) % height
    upper = texture[y % height, x % width] * (1 - fx) + texture[y % height, x1] * fx
    return upper * (1 - fy) + (texture[y1, x % width] * (1 - fx) + texture[y1, x1] * fx) * fy


def refine(surface: Surface, longest: Callable[[np.ndarray], np.ndarray], passes: int = 8) -> Surface:
    """The surface with edges halved until none is longer than `longest(midpoints [E, 3]) -> [E]`. With an edge, the
    longest edge of its triangles is halved (after Rivara 1984), and both sides of a seam are split alike."""
    index = place_index(surface.vertices)
    for _ in range(passes):
        triangles, count = surface.triangles, len(surface.vertices)
        at = np.zeros((index.max() + 1, 3))
        at[index] = surface.vertices
        ends, _, side = undirected_edges(index[triangles])
        a, b = at[ends[:, 0]], at[ends[:, 1]]
        length = np.linalg.norm(a - b, axis=1)
        split = length > longest((a + b) / 2)
        if not split.any() or len(triangles) > REFINED_TRIANGLES:
            break
        farthest = side[np.arange(len(side)), length[side].argmax(1)]
        while True:
            marked = split.sum()
            split[farthest[split[side].any(1)]] = True
            if split.sum() == marked:
                break
        edges, _, edge = undirected_edges(triangles)
        place = np.zeros(len(edges), int)
        place[edge.ravel()] = side.ravel()
        chosen = np.flatnonzero(split[place])
        middle = np.full(len(edges), -1)
        middle[chosen] = count + np.arange(len(chosen))
        index = np.concatenate([index, index.max() + 1 + place[chosen]])
        pick = edges[chosen]
        surface = replace(
            surface,
            **{
                name: np.concatenate([getattr(surface, name), getattr(surface, name)[pick].mean(1)])
                for name in ("vertices", "uv", "albedo")
            },
        )
        surface = replace(surface, triangles=_split(triangles, middle[edge], surface.vertices))
    return surface


def _split(triangles, middle, vertices):
    """Triangles cut at the given vertices [T, 3] on their edges 01, 12, 20; -1 leaves an edge whole."""
    cut = middle >= 0
    number = cut.sum(1)
    # The edges that are cut come first; with two cut edges, the whole one is last.
    first = np.where(number == 1, cut.argmax(1), np.where(number == 2, (~cut).argmax(1) + 1, 0)) % 3
    order = (first[:, None] + np.arange(3)) % 3
    t, m = np.take_along_axis(triangles, order, 1), np.take_along_axis(middle, order, 1)
    columns = {"a": t[:, 0], "b": t[:, 1], "c": t[:, 2], "x": m[:, 0], "y": m[:, 1], "z": m[:, 2]}
    two = number == 2
    across = np.linalg.norm(vertices[columns["a"]] - vertices[columns["y"]], axis=1)
    shorter = across < np.linalg.norm(vertices[columns["c"]] - vertices[columns["x"]], axis=1)

    def pieces(chosen, *corners):
        return [np.stack([columns[name][chosen] for name in names], 1) for names in corners]

    return np.concatenate(
        [
            triangles[number == 0],
            *pieces(number == 1, "axc", "xbc"),
            *pieces(two, "xby"),
            *pieces(two & shorter, "axy", "ayc"),
            *pieces(two & ~shorter, "axc", "xyc"),
            *pieces(number == 3, "axz", "xby", "zyc", "xyz"),
        ]
    )


def close_borders(surface: Surface, lowest: float) -> Surface:
    """The surface, in the project's frame, with its open borders closed. Borders that lie below the height `lowest` are
    extended down to `BODY_FLOOR`, sideways ones (as of arms) bent downwards; holes above are filled with shallow
    cones. Only holes of the largest connected piece are filled."""
    vertices, triangles = surface.vertices, surface.triangles
    index = place_index(vertices)
    ends = np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=-1).reshape(-1, 2)
    _, uses, edge = undirected_edges(index[triangles])
    border = ends[(uses[edge.reshape(-1)] == 1) & (index[ends[:, 0]] != index[ends[:, 1]])]
    if not len(border):
        return surface
    places = index.max() + 1
    piece = connected_pieces(index[ends], places)
    largest = np.bincount(piece[index[triangles[:, 0]]]).argmax()
    group = connected_pieces(index[border], places)[index[border[:, 0]]]
    new_vertices, source, new_triangles = [], [], []
    count = len(vertices)
    for number in np.unique(group):
        rim = border[group == number]
        a, b = vertices[rim[:, 0]], vertices[rim[:, 1]]
        centre = a.mean(0)
        area = -np.cross(a - centre, b - centre).sum(0) / 2  # outwards: the border runs with its triangles
        outward = area / max(np.linalg.norm(area), 1e-12)
        n = len(rim)
        if max(a[:, 1].max(), b[:, 1].max()) < lowest:
            below = [_drop(corner, outward, float(a[:, 1].min())) for corner in (a, b)]
            new_vertices += [*below, below[0].mean(0, keepdims=True)]
            source += [rim[:, 0], rim[:, 1], rim[:1, 0]]
            start, end = count + np.arange(n), count + n + np.arange(n)
            middle = np.full(n, count + 2 * n)
            new_triangles += [np.stack([rim[:, 1], rim[:, 0], start], 1), np.stack([rim[:, 1], start, end], 1)]
            new_triangles.append(np.stack([end, start, middle], 1))
            count += 2 * n + 1
        elif piece[index[rim[0, 0]]] == largest:
            radius = np.linalg.norm(a - centre, axis=1).mean()
            new_vertices.append((centre - 0.6 * radius * outward)[None])
            source.append(rim[:1, 0])
            new_triangles.append(np.stack([rim[:, 1], rim[:, 0], np.full(n, count)], 1))
            count += 1
    if not source:
        return surface
    origin = np.concatenate(source)
    return replace(
        surface,
        vertices=np.concatenate([vertices, *new_vertices]),
        triangles=np.concatenate([triangles, *new_triangles]),
        uv=np.concatenate([surface.uv, surface.uv[origin]]),
        albedo=np.concatenate([surface.albedo, surface.albedo[origin]]),
    )


def _drop(points, outward, bottom):
    """Points of a border moved to the floor; the top of a sideways border is moved farther out."""
    aside = outward * [1, 0, 1]
    on_floor = points + (points[:, 1:2] - bottom) * aside
    on_floor[:, 1] = BODY_FLOOR
    return on_floor
