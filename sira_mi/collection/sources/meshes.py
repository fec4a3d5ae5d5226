"""Textured head meshes from anywhere: OBJ, PLY, GLB, GLTF, STL and OFF files of a folder, read through trimesh.

The unit, place and orientation of a file are unknown: its face is sought from all axis directions, and the landmarks'
similarity to the mean head is its frame, so every head gets the mean face's size. Colours come from textures or vertex
colours, else the skin is neutral. What a textured surface needs to become parts of a scene is here as well.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import trimesh
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from skimage.color import rgb2lab
from skimage.measure import points_in_poly

from sira_mi.collection import skin
from sira_mi.collection.annotation import Similarity, axis_turns, find_face, mean_head, place
from sira_mi.collection.render import Part
from sira_mi.collection.subject import BrokenHead, Subject
from sira_mi.collection.surface import BODY_FLOOR, vertex_normals
from sira_mi.conventions import DOMAIN_LOWER, DOMAIN_UPPER, LUMINANCE
from sira_mi.errors import InputError
from sira_mi.portrait.load import linear_to_srgb, srgb_to_linear

ENDINGS = (".obj", ".ply", ".glb", ".gltf", ".stl", ".off")
LARGEST_FILE = 256 * 2**20  # bytes
MOST_TRIANGLES = 1_000_000
FEWEST_TRIANGLES = 200
LARGEST_TEXTURE = 8192  # pixels a side
TEXTURE_SIDE = 768  # pixels that textures are reduced to
NEUTRAL_SKIN = np.array([0.36, 0.22, 0.16])  # linear albedo of meshes without colour
FACE_EDGE, HEAD_EDGE, BODY_EDGE = 0.03, 0.045, 0.07  # scene units, longest edge on the face, the head and below
REFINED_TRIANGLES = 600_000  # where refinement stops
SAME_PLACE = 1e-5  # share of the size of a mesh within which vertices are one
UNDERSIDE = 0.12  # scene units above the lowest point of a head without lower border that go on down

# Landmark indices.
CHIN, NOSE_TIP = 152, 1
CHEEKS = [50, 280, 205, 425, 101, 330, 151, 36, 266]
LIPS = [61, 146, 91, 181, 84, 17, 314, 405, 321, 375, 291, 409, 270, 269, 267, 0, 37, 39, 40, 185, 13, 14, 82, 312]
OVAL = [10, 338, 297, 332, 284, 251, 389, 356, 454, 323, 361, 288, 397, 365, 379, 378, 400, 377, 152, 148, 176, 149]
OVAL += [150, 136, 172, 58, 132, 93, 234, 127, 162, 21, 54, 103, 67, 109]
LIGHTNESS_WEIGHT = 0.6  # of L* beside a* and b* where colours are told apart
BALD = 12.0  # colour distance between crown and cheeks below which no hair is painted on the scalp
SPECULAR = {skin.HAIR: 0.3, skin.CLOTH: 0.1, skin.EYE: 0.9}


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


def undirected_edges(triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The different edges [E, 2] of triangles [T, 3], the number of uses of each [E], and each triangle's edges 01, 12
    and 20 among them [T, 3]."""
    ends = np.sort(np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=-1).reshape(-1, 2), axis=1)
    key, edge, uses = np.unique((ends[:, 0] << 32) + ends[:, 1], return_inverse=True, return_counts=True)
    return np.stack([key >> 32, key & 0xFFFFFFFF], axis=1), uses, edge.reshape(-1, 3)


def smooth_normals(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Unit normals [N, 3] that are equal where vertices share a place."""
    index = place_index(vertices)
    places = np.zeros((index.max() + 1, 3))
    places[index] = vertices
    return vertex_normals(places, index[triangles])[index]


def decode_texture(image: np.ndarray) -> np.ndarray:
    """Linear [H, W, 3] of an 8-bit sRGB image, reduced to at most `TEXTURE_SIDE` pixels a side."""
    linear = srgb_to_linear(image[..., :3].astype(np.float32) / 255)
    scale = TEXTURE_SIDE / max(linear.shape[:2])
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


def head_edges(middle: np.ndarray) -> np.ndarray:
    """Longest edge [E] at midpoints [E, 3] in the project's frame; there is no need to refine what no camera sees."""
    longest = np.where(middle[:, 1] > -1.3, np.where(middle[:, 2] > 0.3, FACE_EDGE, HEAD_EDGE), BODY_EDGE)
    outside = ((middle < np.array(DOMAIN_LOWER) - 0.3) | (middle > np.array(DOMAIN_UPPER) + 0.3)).any(1)
    return np.where(outside, np.inf, longest)


def close_borders(surface: Surface, lowest: float) -> Surface:
    """The surface, in the project's frame, with its open borders closed. Borders that lie below the height `lowest` go
    on down to `BODY_FLOOR`, those that look aside (as of arms) bent downwards; holes above are filled with shallow
    cones. Only holes of the largest connected piece are filled."""
    vertices, triangles = surface.vertices, surface.triangles
    index = place_index(vertices)
    ends = np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=-1).reshape(-1, 2)
    _, uses, edge = undirected_edges(index[triangles])
    border = ends[(uses[edge.reshape(-1)] == 1) & (index[ends[:, 0]] != index[ends[:, 1]])]
    if not len(border):
        return surface
    places = index.max() + 1
    piece = _pieces(index[ends], places)
    largest = np.bincount(piece[index[triangles[:, 0]]]).argmax()
    group = _pieces(index[border], places)[index[border[:, 0]]]
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
            below = [_dropped(corner, outward, float(a[:, 1].min())) for corner in (a, b)]
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


def _dropped(points, outward, bottom):
    """Points of a border on the floor; the top of a border that looks aside lies farther out there."""
    aside = outward * [1, 0, 1]
    on_floor = points + (points[:, 1:2] - bottom) * aside
    on_floor[:, 1] = BODY_FLOOR
    return on_floor


def _pieces(edges, count):
    graph = sparse.csr_matrix((np.ones(len(edges), bool), (edges[:, 0], edges[:, 1])), (count, count))
    return connected_components(graph, directed=False)[1]


def face_mask(points: np.ndarray, landmarks: np.ndarray) -> np.ndarray:
    """Whether points [N, 3] belong to the face: in front, inside the oval of the landmarks [468, 3] seen from there."""
    oval = landmarks[OVAL]
    return (points[:, 2] > oval[:, 2].min() - 0.1) & points_in_poly(points[:, :2], oval[:, :2])


def complete(landmarks: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Landmarks [468, 3] with the mean head's where there is none."""
    return np.where(valid[:, None], landmarks, mean_head()[0])


def perceptual(albedo: np.ndarray) -> np.ndarray:
    """CIE L*a*b* [N, 3] of linear colours, lightness reduced, so that shading baked into a texture counts less."""
    return rgb2lab(linear_to_srgb(albedo)) * [LIGHTNESS_WEIGHT, 1, 1]


def classify(vertices: np.ndarray, triangles: np.ndarray, albedo: np.ndarray, landmarks: np.ndarray) -> np.ndarray:
    """Region code [N] of a textured head and body in the project's frame, from places and colours: hair is around the
    face and nearer in colour to the crown than to the cheeks; cloth is below the chin and unlike the cheeks."""
    colour = perceptual(albedo)
    face = face_mask(vertices, landmarks)
    chin = landmarks[CHIN, 1]
    cheeks = np.median(colour[near_landmarks(vertices, landmarks, CHEEKS, 0.12)], axis=0)
    above = vertices[:, 1] - np.where(np.abs(vertices[:, 0]) < 1.2, vertices[:, 1], -np.inf).max()
    crown = np.median(colour[(above > -0.3) & (np.abs(vertices[:, 0]) < 1.2)], axis=0)
    hairy = np.zeros(len(vertices), bool)
    way = crown - cheeks
    if np.linalg.norm(way) > BALD:
        hairy = ((colour - cheeks) @ way > 0.45 * (way @ way)) & ~face
        hairy &= (vertices[:, 1] > chin + 0.2) | ((vertices[:, 1] > chin - 0.5) & (vertices[:, 2] < -0.2))
    shoulders = (vertices[:, 1] < chin - 0.7) & (np.abs(vertices[:, 0]) > 0.9) & (vertices[:, 1] > DOMAIN_LOWER[1])
    clothed = np.zeros(len(vertices), bool)
    if shoulders.any():
        fabric = np.median(colour[shoulders], axis=0)
        unlike = np.clip(0.45 * np.linalg.norm(fabric - cheeks), 7, 16)
        clothed = (np.linalg.norm(colour - cheeks, axis=1) > unlike) & ~face & (vertices[:, 1] < chin)
        nearer_crown = np.linalg.norm(colour - crown, axis=1) < np.linalg.norm(colour - fabric, axis=1)
        clothed &= ~(hairy & nearer_crown)
        hairy &= ~clothed
    shares = np.stack([~hairy & ~clothed, hairy, clothed], axis=1).astype(float)
    index = place_index(vertices)
    ends = index[np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=-1).reshape(-1, 2)]
    graph = sparse.csr_matrix((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), (index.max() + 1,) * 2)
    graph = graph + graph.T + sparse.identity(len(graph.indptr) - 1)
    graph = sparse.diags(1 / np.asarray(graph.sum(1)).ravel()) @ graph
    places = np.zeros((index.max() + 1, 3))
    places[index] = shares
    for _ in range(6):
        places = graph @ places
    return np.array([skin.SKIN, skin.HAIR, skin.CLOTH])[places[index].argmax(1)]


def near_landmarks(vertices: np.ndarray, landmarks: np.ndarray, chosen: list[int], radius: float) -> np.ndarray:
    """Indices of the vertices within a radius of the chosen landmarks, at least the nearest one of each."""
    tree = cKDTree(landmarks[chosen])
    inside = np.flatnonzero(tree.query(vertices, distance_upper_bound=radius)[0] < radius)
    return np.union1d(inside, cKDTree(vertices).query(landmarks[chosen])[1])


def albedo_scale(vertices: np.ndarray, albedo: np.ndarray, landmarks: np.ndarray) -> float:
    """The factor that brings the cheeks' luminance into the range of measured skin; 1 inside it."""
    weights = np.array(LUMINANCE)
    lightness = float(np.median(albedo[near_landmarks(vertices, landmarks, CHEEKS, 0.12)] @ weights))
    low, high = float(skin.DARK_SKIN @ weights), float(skin.LIGHT_SKIN @ weights)
    return float(np.clip(lightness, low, high) / max(lightness, 1e-3))


def specular_strength(vertices: np.ndarray, region: np.ndarray, landmarks: np.ndarray, base: float) -> np.ndarray:
    """Specular strength [N]: skin has `base`, more on lips, nose and forehead; hair, cloth and eyes have their own."""
    distance = cKDTree(landmarks[LIPS]).query(vertices)[0]
    lips = np.exp(-((distance / 0.06) ** 2))
    nose = np.exp(-(((vertices - landmarks[NOSE_TIP] - [0, 0.15, 0]) / [0.16, 0.28, 0.35]) ** 2).sum(1))
    strength = base + 0.16 * lips + 0.14 * nose
    for code, value in SPECULAR.items():
        strength[region == code] = value
    return np.clip(strength, 0.02, 1)


def painted_part(surface: Surface, region: np.ndarray, landmarks: np.ndarray, scale: float, base: float) -> Part:
    """A part of a surface in the project's frame with the region codes [N] of its vertices."""
    codes = np.sort(region[surface.triangles], axis=1)[:, 1]
    return Part(
        surface.vertices,
        surface.triangles,
        smooth_normals(surface.vertices, surface.triangles),
        np.clip(surface.colours() * scale, 0.004, 0.9),
        specular_strength(surface.vertices, region, landmarks, base),
        codes,
    )


def plain_part(surface: Surface, code: int = skin.SKIN) -> Part:
    """A part of one region, with its specular strength or that of skin."""
    return Part(
        surface.vertices,
        surface.triangles,
        smooth_normals(surface.vertices, surface.triangles),
        np.clip(surface.colours(), 0.004, 0.9),
        np.full(len(surface.vertices), SPECULAR.get(code, 0.4)),
        np.full(len(surface.triangles), code),
    )


def skin_specular(seed: int) -> float:
    """A person's base specular strength of skin (FLARE: 0.375 ± 0.166, of one person's parts less)."""
    return float(np.clip(np.random.default_rng([seed, 21]).normal(0.375, 0.09), 0.15, 0.65))


@dataclass(frozen=True)
class MeshSource:
    folder: Path
    name: str = "meshes"
    licence: str = "as the folder of meshes states"

    def files(self) -> list[Path]:
        """The mesh files, sorted by name."""
        if not self.folder.is_dir():
            raise InputError(f"{self.folder}: no such folder of meshes")
        return sorted(path for path in self.folder.iterdir() if path.suffix.lower() in ENDINGS and path.is_file())

    def count(self) -> int:
        number = len(self.files())
        if not number:
            raise InputError(f"{self.folder}: no meshes found; expected files ending in {', '.join(ENDINGS)}")
        return number

    def subject(self, number: int, seed: int) -> Subject:
        path = self.files()[number]
        surfaces = read_surfaces(path)
        rough = find_face([plain_part(s) for s in _coarse(surfaces)], axis_turns())
        surfaces = [refine(replace(s, vertices=rough(s.vertices)), head_edges) for s in surfaces]
        still = Similarity(1.0, np.eye(3), np.zeros(3))
        change, landmarks, valid, spread = place([plain_part(s) for s in surfaces], still, natural_size=False)
        frame = change.after(rough)
        marks = complete(landmarks, valid)
        surfaces = [
            refine(grounded(replace(s, vertices=change(s.vertices)), marks[CHIN, 1]), head_edges) for s in surfaces
        ]
        everything = np.concatenate([s.vertices for s in surfaces])
        colours = np.concatenate([s.colours() for s in surfaces])
        offsets = np.cumsum([0] + [len(s.vertices) for s in surfaces])
        triangles = np.concatenate([s.triangles + o for s, o in zip(surfaces, offsets, strict=False)])
        region = classify(everything, triangles, colours, marks)
        scale, base = albedo_scale(everything, colours, marks), skin_specular(seed)
        parts = [
            painted_part(s, region[start:end], marks, scale, base)
            for s, start, end in zip(surfaces, offsets, offsets[1:], strict=False)
        ]
        description = {
            "file": path.name,
            "units_per_file_unit": frame.scale,
            "rotation": frame.rotation.tolist(),
            "shift": frame.shift.tolist(),
            "albedo_scale": scale,
            "specular": base,
            "landmark_spread_mm": float(np.nanmedian(spread)),
        }
        group = {"ancestry": "unknown", "sex": "unknown", "age": "unknown"}
        return Subject(f"{self.name}/{path.name}", parts, landmarks, valid, group, description, self.licence)


def grounded(surface: Surface, chin: float) -> Surface:
    """A surface in the project's frame, closed and continued down to the floor below the chin's height. One without
    lower border has its underside moved there."""
    lowest = float(surface.vertices[:, 1].min())
    if lowest <= BODY_FLOOR or lowest > chin:
        return close_borders(surface, -np.inf)
    closed = close_borders(surface, chin)
    if closed.vertices[:, 1].min() > BODY_FLOOR:
        vertices = closed.vertices.copy()
        vertices[vertices[:, 1] < lowest + UNDERSIDE, 1] = BODY_FLOOR
        closed = replace(closed, vertices=vertices)
    return closed


def _coarse(surfaces):
    """Surfaces fine enough for their textures to show a face."""
    everything = np.concatenate([s.vertices for s in surfaces])
    span = float(np.ptp(everything, axis=0).max())
    return [s if s.texture is None else refine(s, lambda middle: np.full(len(middle), 0.012 * span)) for s in surfaces]


def read_surfaces(path: Path) -> list[Surface]:
    """The surfaces of a mesh file in its own frame, each oriented outwards. Raises BrokenHead with the reason when
    there is nothing to use."""
    if path.stat().st_size > LARGEST_FILE:
        raise BrokenHead(f"larger than {LARGEST_FILE // 2**20} MB")
    try:
        scene = trimesh.load_scene(path, process=False)
        pieces = [piece for piece in scene.dump() if isinstance(piece, trimesh.Trimesh) and len(piece.faces)]
    except Exception as error:
        raise BrokenHead(f"cannot be read ({type(error).__name__}: {str(error)[:120]})") from None
    if not pieces:
        raise BrokenHead("no faces in it")
    total = sum(len(piece.faces) for piece in pieces)
    if total > MOST_TRIANGLES:
        raise BrokenHead(f"{total} triangles; at most {MOST_TRIANGLES} are read")
    if total < FEWEST_TRIANGLES:
        raise BrokenHead(f"only {total} triangles: too few for a head")
    for piece in pieces:
        faces = np.asarray(piece.faces)
        if faces.min() < 0 or faces.max() >= len(piece.vertices):
            raise BrokenHead("its faces name vertices that are not there")
        if not np.isfinite(piece.vertices).all():
            raise BrokenHead("vertices are not finite")
    if float(max(np.ptp(piece.vertices, axis=0).max() for piece in pieces)) < 1e-12:
        raise BrokenHead("all vertices are in one place")
    linear = path.suffix.lower() in (".glb", ".gltf")
    return [_outwards(_surface(piece, linear)) for piece in pieces]


def _surface(piece, linear):
    vertices, triangles = np.asarray(piece.vertices, float), np.asarray(piece.faces, np.int64)
    albedo = np.broadcast_to(NEUTRAL_SKIN, vertices.shape)
    uv = np.zeros((len(vertices), 2))
    texture = None
    visual = piece.visual
    if visual.kind == "texture":
        material = visual.material
        image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
        if image is not None and visual.uv is not None and len(visual.uv) == len(vertices):
            if max(image.size) > LARGEST_TEXTURE:
                raise BrokenHead(f"a texture of {image.size[0]}×{image.size[1]} pixels")
            try:
                texture = decode_texture(np.asarray(image.convert("RGB")))
            except (OSError, ValueError) as error:
                raise BrokenHead(f"its texture cannot be read ({error})") from None
            uv = np.nan_to_num(np.asarray(visual.uv, float), posinf=0, neginf=0) * [1, -1] + [0, 1]
    elif visual.kind in ("vertex", "face"):
        stored = visual.vertex_colors[:, :3] / 255
        albedo = stored if linear else srgb_to_linear(stored)
    return Surface(vertices, triangles, uv, np.asarray(albedo, float), texture)


def _outwards(surface):
    """The surface with each connected piece turned so that it encloses a positive volume."""
    index = place_index(surface.vertices)
    ends = np.stack([surface.triangles, np.roll(surface.triangles, -1, axis=1)], axis=-1).reshape(-1, 2)
    piece = _pieces(index[ends], index.max() + 1)[index[surface.triangles[:, 0]]]
    corners = surface.vertices[surface.triangles]
    count = piece.max() + 1
    weight = np.maximum(np.bincount(piece, minlength=count), 1)
    middle = np.stack([np.bincount(piece, corners.mean(1)[:, k], count) / weight for k in range(3)], axis=1)
    local = corners - middle[piece][:, None]
    volume = np.bincount(piece, np.einsum("td,td->t", local[:, 0], np.cross(local[:, 1], local[:, 2])), count)
    triangles = surface.triangles.copy()
    inwards = volume[piece] < 0
    triangles[inwards] = triangles[inwards][:, ::-1]
    return replace(surface, triangles=triangles)
