"""Textured head meshes from anywhere: OBJ, PLY, GLB, GLTF, STL and OFF files of a folder, read through trimesh.

The unit, place and orientation of a file are unknown: its face is sought from all axis directions, and the landmarks'
similarity to the mean head is its frame, so every head gets the mean face's size. Colours come from textures or vertex
colours, else the skin is neutral.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import trimesh

from sira_mi.colour import srgb_to_linear
from sira_mi.errors import InputError
from sira_mi.portrait.landmarks import CHIN
from sira_mi.training.collection.annotation import find_face, find_frame, list_axis_turns
from sira_mi.training.collection.regions import (
    choose_edge_lengths,
    classify,
    draw_skin_specular,
    fill_missing_landmarks,
    find_albedo_scale,
    make_plain_part,
    paint_part,
)
from sira_mi.training.collection.similarity import Similarity
from sira_mi.training.collection.subject import BrokenHead, Subject
from sira_mi.training.collection.surface import BODY_FLOOR
from sira_mi.training.collection.textured_surface import (
    Surface,
    close_borders,
    decode_texture,
    place_index,
    refine,
)
from sira_mi.training.collection.triangles import connected_pieces

ENDINGS = (".obj", ".ply", ".glb", ".gltf", ".stl", ".off")
LARGEST_FILE = 256 * 2**20  # bytes
MOST_TRIANGLES = 1_000_000
FEWEST_TRIANGLES = 200
LARGEST_TEXTURE = 8192  # pixels a side
NEUTRAL_SKIN = np.array([0.36, 0.22, 0.16])  # linear albedo of meshes without colour
UNDERSIDE = 0.12  # scene units above the lowest point of a head without lower border that go on down


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

    def title(self, number: int) -> str:
        return f"{self.name}/{self.files()[number].name}"

    def subject(self, number: int, seed: int) -> Subject:
        path = self.files()[number]
        surfaces = read_surfaces(path)
        rough = find_face([make_plain_part(s) for s in _refine_for_search(surfaces)], list_axis_turns())
        surfaces = [refine(replace(s, vertices=rough(s.vertices)), choose_edge_lengths) for s in surfaces]
        still = Similarity(1.0, np.eye(3), np.zeros(3))
        change, landmarks, valid, spread = find_frame([make_plain_part(s) for s in surfaces], still, natural_size=False)
        frame = change.after(rough)
        marks = fill_missing_landmarks(landmarks, valid)
        surfaces = [extend_to_floor(replace(s, vertices=change(s.vertices)), marks[CHIN, 1]) for s in surfaces]
        surfaces = [refine(s, choose_edge_lengths) for s in surfaces]
        everything = np.concatenate([s.vertices for s in surfaces])
        colours = np.concatenate([s.colours() for s in surfaces])
        offsets = np.cumsum([0] + [len(s.vertices) for s in surfaces])
        triangles = np.concatenate([s.triangles + o for s, o in zip(surfaces, offsets, strict=False)])
        region = classify(everything, triangles, colours, marks)
        scale, base = find_albedo_scale(everything, colours, marks), draw_skin_specular(seed)
        parts = [
            paint_part(s, region[start:end], marks, scale, base)
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
        return Subject(self.title(number), parts, landmarks, valid, group, description, self.licence)


def extend_to_floor(surface: Surface, chin: float) -> Surface:
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


def _refine_for_search(surfaces):
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
    return [_orient_outwards(_surface(piece, linear)) for piece in pieces]


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


def _orient_outwards(surface):
    """The surface with each connected piece turned so that it encloses a positive volume."""
    index = place_index(surface.vertices)
    ends = np.stack([surface.triangles, np.roll(surface.triangles, -1, axis=1)], axis=-1).reshape(-1, 2)
    piece = connected_pieces(index[ends], index.max() + 1)[index[surface.triangles[:, 0]]]
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
