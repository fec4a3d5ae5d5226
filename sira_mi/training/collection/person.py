"""One synthetic person: look, clothes and hair on a head of the MakeHuman topology, as surfaces with materials."""

from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from sira_mi.training.collection import hair as hairs
from sira_mi.training.collection import skin
from sira_mi.training.collection.look import Look, Traits, sample_look
from sira_mi.training.collection.makehuman import identity_vertices, sample_identity
from sira_mi.training.collection.render import Part
from sira_mi.training.collection.surface import eye_spheres, unit_eye
from sira_mi.training.collection.triangles import vertex_normals

HAIR_SHARE = 0.7
# Styles worn by one sex far more often than by the other, and styles that hide much of the face are drawn less often.
HAIR_ODDS = {
    "afro01": (0.8, 0.8),
    "bob01": (0.1, 0.7),
    "bob02": (0.1, 0.8),
    "braid01": (0.05, 0.9),
    "long01": (0.25, 1.3),
    "ponytail01": (0.25, 1.3),
    "short01": (1.5, 0.3),
    "short02": (1.5, 0.4),
    "short03": (0.8, 1.0),
    "short04": (1.5, 0.3),
}
HAIR_SPECULAR = 0.3
# Scene units by which strands and locks rise and fall on the hair's surface (one standard deviation).
STRAND_RELIEF = 0.009
WAVE_RELIEF = 0.02


@dataclass(frozen=True)
class Cut:
    """A hair mesh and its variation."""

    name: str
    mirrored: bool
    length: float  # scene units: strands below this height are cut off
    fringe: float | None  # scene units: strands over the face below this height are cut off; None leaves them
    volume: float  # factor on the distance from the middle of the head


@dataclass(frozen=True)
class Person:
    traits: Traits
    look: Look
    cut: Cut | None
    control: np.ndarray  # [19158, 3] base-mesh vertices, scene units
    head: np.ndarray  # [M, 3] vertices of the dressed head
    parts: list[Part]  # head, left eye, right eye and, if there is hair, hair

    def description(self) -> dict:
        """JSON types: everything drawn."""
        return {"traits": asdict(self.traits), "look": asdict(self.look), "hair": self.cut and asdict(self.cut)}


def sample_cut(random: np.random.Generator, names: list[str], male: float) -> Cut:
    """A hair mesh and its variation."""
    column = 0 if male > 0.5 else 1
    odds = np.array([HAIR_ODDS.get(name, (1.0, 1.0))[column] for name in names])
    name = str(random.choice(names, p=odds / odds.sum()))
    fringe = float(random.uniform(0.42, 0.62)) if random.random() < 0.85 else None
    length = float(random.choice([-9.0, random.uniform(-2.6, -0.7)], p=[0.5, 0.5]))
    return Cut(name, bool(random.random() < 0.5), length, fringe, float(random.uniform(0.99, 1.06)))


def make_person(seed: int, hair_folder: Path | None) -> Person:
    """The MakeHuman person of a seed."""
    random = np.random.default_rng([seed, 1])
    identity = sample_identity(random)
    traits = Traits(identity.years, identity.male, identity.ancestry)
    return dress(identity_vertices(identity), traits, random, hair_folder)


def dress(control: np.ndarray, traits: Traits, random: np.random.Generator, hair_folder: Path | None) -> Person:
    """A person of control vertices [19158, 3] in scene units, with a look, clothes and, often, hair."""
    cut = None
    wears = random.random() < HAIR_SHARE
    if hair_folder is not None and wears:
        cut = sample_cut(random, hairs.list_hair(hair_folder), traits.male)
    look = sample_look(random, traits, cut is not None)
    head, triangles, cloth = skin.dress_head(control, look)
    volume = None
    covered = np.zeros(len(head))
    if cut is not None and hair_folder is not None:
        volume = make_hair(cut, hair_folder, control, np.array(look.hair_colour), random)
        covered = skin.step(cKDTree(volume.vertices).query(head)[0], 0.16, 0.08) * skin.scalp_mask()
    albedo, specular = skin.paint_head(look, cloth, covered)
    region = np.where(cloth[triangles].mean(1) > 0.5, skin.CLOTH, skin.SKIN)
    parts = [Part(head, triangles, vertex_normals(head, triangles), albedo, specular, region)]
    unit, eye_triangles = unit_eye()
    for centre, radius in eye_spheres(control):
        eye_albedo, eye_specular = skin.paint_eye(unit, radius, look)
        code = np.full(len(eye_triangles), skin.EYE)
        parts.append(Part(centre + radius * unit, eye_triangles, unit, eye_albedo, eye_specular, code))
    if volume is not None:
        parts.append(volume)
    return Person(traits, look, cut, control, head, parts)


def make_hair(cut: Cut, folder: Path, control: np.ndarray, colour: np.ndarray, random: np.random.Generator) -> Part:
    """The hair of a cut, of about a colour [3], on a head given by its base-mesh vertices [19158, 3]."""
    mesh = hairs.read_hair(folder, cut.name)
    fitted = hairs.fit_hair(mesh, control)
    fitted = fitted * [1, cut.volume, cut.volume] if cut.volume < 1 else fitted * cut.volume
    if cut.mirrored:
        fitted = fitted * [-1, 1, 1]
    points, across, _ = hairs.sample_sheets(mesh, fitted, random)
    keep = points[:, 1] > cut.length + 0.06 * np.sin(9 * points[:, 0])
    if cut.fringe is not None:
        over_face = (points[:, 2] > 0.72) & (np.abs(points[:, 0]) < 0.78)
        keep &= ~over_face | (points[:, 1] > cut.fringe + 0.04 * np.sin(7 * points[:, 0]))
    points, across = points[keep], across[keep]
    vertices, triangles, normals = hairs.build_hair_volume(points)
    fine, coarse = hairs.draw_strand_pattern(vertices, points, across, random)
    waves = skin.noise(vertices, random.uniform(0.25, 0.6), random)
    relief = STRAND_RELIEF * (0.7 * fine + coarse) + random.uniform(0.1, 0.7) * WAVE_RELIEF * waves
    vertices = vertices + np.clip(relief, -0.05, 0.05)[:, None] * normals
    normals = vertex_normals(vertices, triangles)
    shade = np.exp(0.22 * fine + 0.2 * coarse + 0.08 * waves)
    albedo = np.clip(colour * shade[:, None], 0.004, 0.9)
    return Part(
        vertices,
        triangles,
        normals,
        albedo,
        np.full(len(vertices), HAIR_SPECULAR),
        np.full(len(triangles), skin.HAIR),
    )
