"""VALID avatars (MIT, © 2022 Tiffany Do): heads with clothed shoulders, photo textures, eyes and, on some, a wig.

An avatar is NAME.npz (arrays `v` in metres, +y up, +z front; `f`, `uv` with v downwards, `part` of each face with
`part_names`; `eye_l`, `eye_r`) with NAME.jpg and, if it wears a wig, NAME_wig.jpg. NAME is ANCESTRY_SEX_NUMBER, with X_
before it for some. Heads keep their natural size.
"""

import zipfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.spatial import cKDTree

from sira_mi.errors import InputError
from sira_mi.portrait.landmarks import CHIN
from sira_mi.training.collection import hair as hairs
from sira_mi.training.collection import skin
from sira_mi.training.collection.annotation import find_frame, mean_eyes
from sira_mi.training.collection.person import HAIR_SPECULAR, STRAND_RELIEF
from sira_mi.training.collection.regions import (
    choose_edge_lengths,
    classify,
    draw_skin_specular,
    face_mask,
    fill_missing_landmarks,
    find_albedo_scale,
    make_plain_part,
    paint_part,
)
from sira_mi.training.collection.render import Part
from sira_mi.training.collection.similarity import Similarity
from sira_mi.training.collection.sources.meshes import LARGEST_TEXTURE, MOST_TRIANGLES
from sira_mi.training.collection.subject import BrokenHead, Subject
from sira_mi.training.collection.textured_surface import (
    TEXTURE_SIDE,
    Surface,
    close_borders,
    decode_texture,
    refine,
    sample_texture,
)
from sira_mi.training.collection.triangles import draw_barycentric, find_nearest, triangle_areas, vertex_normals

UNITS_PER_METRE = 10.0
LARGEST_ARRAYS = 128 * 2**20  # bytes unpacked
ARRAYS = ("v", "f", "uv", "part", "part_names", "eye_l", "eye_r")
BODY, WIG = "H_DDS_HighRes", "h_wig"
EYES, GLANDS = ("h_L_eye", "h_R_eye"), ("h_L_gland", "h_R_gland")
TEETH = ("h_TeethUp", "h_TeethDown")  # with the tongue
EYE_EDGE = 0.012  # scene units, longest edge of eyes and glands
# Scene units from the middle over which the arms, which are stretched out sideways, start to turn down, and how far.
ARM_START, ARM_END, ARM_TURN = 1.15, 2.05, 0.95
ANCESTRIES = ("AIAN", "Asian", "Black", "Hispanic", "MENA", "NHPI", "White")
SEXES = {"F": "female", "M": "male"}


@dataclass(frozen=True)
class ValidSource:
    folder: Path
    name: str = "valid"
    licence: str = "MIT, © 2022 Tiffany Do (VALID avatars)"

    def files(self) -> list[Path]:
        """The avatars' files, sorted by name."""
        if not self.folder.is_dir():
            raise InputError(f"{self.folder}: no such folder of VALID avatars")
        return sorted(self.folder.glob("*.npz"))

    def count(self) -> int:
        number = len(self.files())
        if not number:
            raise InputError(f"{self.folder}: no VALID avatars found; expected NAME.npz with NAME.jpg")
        return number

    def title(self, number: int) -> str:
        return f"{self.name}/{self.files()[number].stem}"

    def subject(self, number: int, seed: int) -> Subject:
        return make_subject(self.files()[number], self.title(number), seed, self.licence)


@dataclass(frozen=True)
class Rendition:
    """How an avatar is made into a subject."""

    move: np.ndarray | None = None  # [N, 3] metres by which an expression moves the vertices of the avatar's file
    teeth: bool = False  # whether teeth and tongue are parts
    texture_side: int = TEXTURE_SIDE  # pixels that textures are reduced to
    choose_edges: Callable[[np.ndarray], np.ndarray] = choose_edge_lengths  # of the body, as for `refine`


def make_subject(path: Path, name: str, seed: int, licence: str, rendition: Rendition | None = None) -> Subject:
    """The subject of an avatar's file, with a look drawn from `seed`. With an expression, its frame is that of the
    neutral avatar, and its landmarks move with the skin. Raises `BrokenHead` when it cannot be used."""
    rendition = rendition or Rendition()
    random = np.random.default_rng([seed, 31])
    neutral = rendition if rendition.move is None else Rendition()
    surfaces, eyes = read_avatar(path, neutral)
    rough = Similarity(UNITS_PER_METRE, np.eye(3), mean_eyes() - UNITS_PER_METRE * eyes)
    wig = build_wig(place(surfaces[WIG], rough), random) if WIG in surfaces else None
    plain = place(surfaces[BODY], rough)
    body, parts = build_parts(surfaces, rough, neutral)
    still = Similarity(1.0, np.eye(3), np.zeros(3))
    frame, landmarks, valid, spread = find_frame([*parts, *([wig] if wig else [])], still, natural_size=True)
    if rendition.move is not None:
        surfaces, _ = read_avatar(path, rendition)
        body, parts = build_parts(surfaces, rough, rendition)
        moved = frame(place(surfaces[BODY], rough).vertices)
        feet = find_nearest(landmarks, None, frame(plain.vertices), plain.triangles)[0]
        landmarks = np.where(valid[:, None], feet.matrix(plain.triangles, len(moved)) @ moved, 0)
    marks = fill_missing_landmarks(landmarks, valid)

    body = replace(body, vertices=frame(body.vertices))
    colours = body.colours()
    scale, base = find_albedo_scale(body.vertices, colours, marks), draw_skin_specular(seed)
    region = classify(body.vertices, body.triangles, colours, marks)
    head = paint_part(body, region, marks, scale, base)
    others = frame.move(parts[1:])
    others = [replace(part, albedo=np.clip(part.albedo * scale, 0.004, 0.9)) for part in others]
    if wig is not None:
        (wig,) = frame.move([wig])
        wig = replace(wig, albedo=np.clip(wig.albedo * scale, 0.004, 0.9))
        head = shade_scalp(head, wig, region, marks)
        others.append(wig)
    description = {
        "file": path.name,
        "rotation": frame.rotation.tolist(),
        "shift": frame(rough.shift).tolist(),
        "albedo_scale": scale,
        "specular": base,
        "wig": wig is not None,
        "landmark_spread_mm": float(np.nanmedian(spread)),
    }
    return Subject(name, [head, *others], landmarks, valid, find_group(path.stem), description, licence)


def place(surface: Surface, rough: Similarity) -> Surface:
    """A surface of an avatar in the project's frame."""
    return replace(surface, vertices=rough(surface.vertices))


def build_parts(surfaces: dict[str, Surface], rough: Similarity, rendition: Rendition) -> tuple[Surface, list[Part]]:
    """The refined body in the project's frame, and it and the small surfaces as parts without a wig."""
    body = place(surfaces[BODY], rough)
    body = replace(body, vertices=lower_arms(body.vertices))
    body = refine(close_borders(body, mean_eyes()[1] - 1.2), rendition.choose_edges)
    parts = [make_plain_part(body)]
    for name in EYES + GLANDS + (TEETH if rendition.teeth else ()):
        small = place(surfaces[name], rough)
        if name not in TEETH:
            small = refine(small, lambda middle: np.full(len(middle), EYE_EDGE))
        parts.append(make_plain_part(small, skin.EYE if name in EYES else skin.SKIN))
    return body, parts


def find_group(stem: str) -> dict[str, str]:
    """Ancestry, sex and age by an avatar's name."""
    words = stem.removeprefix("X_").split("_")
    ancestry = words[0] if words[0] in ANCESTRIES else "unknown"
    sex = SEXES.get(words[1], "unknown") if len(words) > 1 else "unknown"
    return {"ancestry": ancestry, "sex": sex, "age": "adult"}


def read_avatar(path: Path, rendition: Rendition) -> tuple[dict[str, Surface], np.ndarray]:
    """The surfaces of an avatar by part name, in metres, and the middle [3] between its eyes.

    Raises BrokenHead with the reason when its files are damaged or incomplete."""
    try:
        with zipfile.ZipFile(path) as archive:
            if sum(entry.file_size for entry in archive.infolist()) > LARGEST_ARRAYS:
                raise BrokenHead(f"{path.name} unpacks to more than {LARGEST_ARRAYS // 2**20} MB")
        with np.load(path, allow_pickle=False) as data:
            arrays = {name: data[name] for name in ARRAYS}
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        if isinstance(error, BrokenHead):
            raise
        raise BrokenHead(f"{path.name} cannot be read ({error})") from None
    v, f, uv, part, names = (arrays[name] for name in ARRAYS[:5])
    names = [str(name) for name in names.ravel()]
    if v.ndim != 2 or v.shape[1] != 3 or f.ndim != 2 or f.shape[1] != 3 or uv.shape != (len(v), 2):
        raise BrokenHead("its arrays v, f and uv do not fit together")
    if part.shape != (len(f),) or not len(f) or len(f) > MOST_TRIANGLES:
        raise BrokenHead(f"{len(f)} faces with {part.size} part numbers")
    if f.min() < 0 or f.max() >= len(v) or part.max() >= len(names):
        raise BrokenHead("its faces name vertices or parts that are not there")
    eyes = (arrays["eye_l"] + arrays["eye_r"]) / 2
    if eyes.shape != (3,) or not all(np.isfinite(a).all() for a in (v, uv, eyes)):
        raise BrokenHead("its arrays are not finite")
    needed = (BODY, *EYES, *GLANDS, *(TEETH if rendition.teeth else ()))
    missing = [name for name in needed if name not in names]
    if missing:
        raise BrokenHead(f"it has no part {missing[0]}")
    if rendition.move is not None:
        v = v + rendition.move
    painted = read_texture(path.with_name(f"{path.stem}.jpg"), rendition.texture_side)
    surfaces = {name: _surface(v, f[part == names.index(name)], uv, painted) for name in needed}
    if WIG in names:
        strands = read_texture(path.with_name(f"{path.stem}_wig.jpg"), rendition.texture_side)
        surfaces[WIG] = _surface(v, f[part == names.index(WIG)], uv, strands)
    return surfaces, eyes.astype(float)


def read_texture(path: Path, side: int = TEXTURE_SIDE) -> np.ndarray:
    """Linear [H, W, 3] of an image file, reduced to at most `side` pixels a side. Raises BrokenHead when it cannot be
    read."""
    try:
        with Image.open(path) as image:
            if max(image.size) > LARGEST_TEXTURE:
                raise BrokenHead(f"{path.name} has {image.size[0]}×{image.size[1]} pixels")
            return decode_texture(np.asarray(image.convert("RGB")), side)
    except (OSError, SyntaxError) as error:
        raise BrokenHead(f"{path.name} cannot be read ({error})") from None


def _surface(vertices, triangles, uv, texture):
    if not len(triangles):
        raise BrokenHead("a part has no faces")
    used, corner = np.unique(triangles, return_inverse=True)
    nothing = np.zeros((len(used), 3))
    return Surface(vertices[used].astype(float), corner.reshape(-1, 3), uv[used].astype(float), nothing, texture)


def lower_arms(vertices: np.ndarray) -> np.ndarray:
    """Vertices [N, 3] with both stretched-out arms turned down by up to `ARM_TURN` radians about the shoulders."""
    out = vertices.copy()
    for side in (1, -1):
        across = side * vertices[:, 0]
        arm = vertices[(across > 2.2) & (across < 2.9)]
        if not len(arm):
            continue
        pivot = np.array([(ARM_START + ARM_END) / 2, np.median(arm[:, 1])])
        turn = -ARM_TURN * skin.step(across, ARM_START, ARM_END)
        x, y = across - pivot[0], vertices[:, 1] - pivot[1]
        moved = across > ARM_START
        out[moved, 0] = side * (pivot[0] + np.cos(turn) * x - np.sin(turn) * y)[moved]
        out[moved, 1] = (pivot[1] + np.sin(turn) * x + np.cos(turn) * y)[moved]
    return out


def build_wig(wig: Surface, random: np.random.Generator) -> Part:
    """The closed volume around a wig's sheets, in the project's frame, with the sheets' colours."""
    points, uv = scatter(wig, hairs.SAMPLE_SPACING, random)
    vertices, triangles, normals = hairs.build_hair_volume(points)
    fine, coarse = hairs.draw_strand_pattern(vertices, points, uv[:, 0], random)
    relief = STRAND_RELIEF * (0.7 * fine + coarse)
    vertices = vertices + np.clip(relief, -0.05, 0.05)[:, None] * normals
    near = cKDTree(points).query(vertices, k=3)[1]
    assert wig.texture is not None  # `read_avatar` reads one
    albedo = sample_texture(wig.texture, uv)[near].mean(1) * np.exp(0.12 * fine + 0.1 * coarse)[:, None]
    return Part(
        vertices,
        triangles,
        vertex_normals(vertices, triangles),
        np.clip(albedo, 0.004, 0.9),
        np.full(len(vertices), HAIR_SPECULAR),
        np.full(len(triangles), skin.HAIR),
    )


def scatter(surface: Surface, spacing: float, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Points [S, 3] about `spacing` apart on a surface, and their texture coordinates [S, 2]."""
    corners = surface.vertices[surface.triangles]
    area = triangle_areas(corners)
    triangle = np.repeat(np.arange(len(area)), random.poisson(area / spacing**2) + 1)
    bary = draw_barycentric(random, len(triangle))
    texture = surface.uv[surface.triangles][triangle]
    return np.einsum("sk,skd->sd", bary, corners[triangle]), np.einsum("sk,skd->sd", bary, texture)


def shade_scalp(head: Part, wig: Part, region: np.ndarray, landmarks: np.ndarray) -> Part:
    """The head, with region codes [N] of its vertices, with the wig's colour on the scalp beneath and beside it."""
    distance, near = cKDTree(wig.vertices).query(head.vertices, distance_upper_bound=0.17)
    near = np.minimum(near, len(wig.vertices) - 1)
    covered = skin.step(distance, 0.16, 0.06) * (region != skin.CLOTH) * ~face_mask(head.vertices, landmarks)
    covered *= head.vertices[:, 1] > landmarks[CHIN, 1]
    albedo = head.albedo * (1 - covered[:, None]) + wig.albedo[near] * covered[:, None]
    return replace(head, albedo=albedo)
