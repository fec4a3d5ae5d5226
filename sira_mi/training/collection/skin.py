"""Procedural appearance: linear diffuse albedo and specular strength at the vertices of head, eyes and clothes.

Regions are painted in rest-pose coordinates of the base mesh (decimetres), which the topology carries to every head.
Skin tone has two axes, melanin and haemoglobin, as exponents of an absorption (after Tsumura et al. 1999).
"""

from functools import cache

import numpy as np
from scipy import sparse

from sira_mi.training.collection.look import Look
from sira_mi.training.collection.makehuman import load_pack
from sira_mi.training.collection.render import point_towards
from sira_mi.training.collection.surface import head_surface, head_topology, refine_attribute
from sira_mi.training.collection.triangles import vertex_normals

SKIN, HAIR, EYE, CLOTH = 0, 1, 2, 3

LIGHT_SKIN = np.array([0.62, 0.42, 0.33])
DARK_SKIN = np.array([0.06, 0.035, 0.025])
# How melanin bends the way from light to dark in log space: medium tones are redder than a straight line.
MELANIN_BEND = np.array([-0.3, 0.0, 0.15])
HAEMOGLOBIN = np.array([0.03, -0.12, -0.07])
REDNESS = np.array([0.02, -0.40, -0.34])
SCLERA = np.array([0.66, 0.60, 0.57])
IRIS_RADIUS = 0.062  # scene units
# Rest-pose eyebrow centre line of the left side: x, y, half height.
BROW = np.array(
    [[0.105, 7.475, 0.030], [0.19, 7.505, 0.040], [0.30, 7.535, 0.037], [0.40, 7.525, 0.027], [0.49, 7.475, 0.012]]
)
# Rest-pose height of the hairline over the azimuth (degrees from the front) around the head's axis at z = 0.4.
HAIRLINE = np.array(
    [[0, 8.02], [25, 8.0], [42, 7.93], [55, 7.62], [75, 7.42], [95, 7.38], [115, 7.0], [140, 6.68], [180, 6.6]]
)


@cache
def rest_surface() -> np.ndarray:
    """Rest-pose positions [M, 3] in decimetres of the vertices of `head_surface`."""
    return refine_attribute(load_pack().vertices)


@cache
def neighbours() -> sparse.csr_matrix:
    """Row-normalised vertex adjacency [M, M] of `head_surface`."""
    triangles, count = head_topology()[0], len(rest_surface())
    ends = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    ends = np.concatenate([ends, ends[:, ::-1]])
    matrix = sparse.csr_matrix((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), (count, count))
    matrix.data[:] = 1
    return sparse.diags(1 / np.maximum(np.asarray(matrix.sum(1)).ravel(), 1)) @ matrix


def step(x: np.ndarray, start: float, end: float) -> np.ndarray:
    """Smooth step from 0 at `start` to 1 at `end` (which may be smaller)."""
    t = np.clip((x - start) / (end - start), 0, 1)
    return t * t * (3 - 2 * t)


def noise(points: np.ndarray, wavelength: float, random: np.random.Generator, terms: int = 24) -> np.ndarray:
    """Smooth noise [N] of unit variance at points [N, 3]: a sum of random plane waves."""
    waves = random.standard_normal((3, terms)) * (2 * np.pi / wavelength)
    return np.sin(points @ waves + random.uniform(0, 2 * np.pi, terms)).sum(1) * np.sqrt(2 / terms)


def cloth_mask(look: Look) -> np.ndarray:
    """Cloth [M] in 0..1 on the vertices of `head_surface`: below a neck line, with a V-neck in front."""
    rest = rest_surface()
    front = step(rest[:, 2], 0.2, 0.7)
    line = 5.58 + 0.45 * np.clip(0.75 - rest[:, 2], -0.3, 1.0) + look.collar
    line = line - look.neck_opening * front * np.clip(1 - np.abs(rest[:, 0]) / 0.55, 0, 1)
    line = line + 1.5 * step(np.abs(rest[:, 0]), 0.85, 1.15)
    height = np.where(rest[:, 1] < 6.35, rest[:, 1], 99.0)
    return step(line - height, -0.035, 0.035)


def dress(vertices: np.ndarray, triangles: np.ndarray, cloth: np.ndarray, look: Look) -> np.ndarray:
    """Vertices [M, 3] with the clothed part smoothed and moved outwards by the cloth's thickness."""
    soft = cloth
    for _ in range(2):
        soft = neighbours() @ soft
    soft = np.minimum(soft, cloth)
    smooth = vertices
    for _ in range(14):
        smooth = smooth + soft[:, None] * 0.6 * (neighbours() @ smooth - smooth)
    return smooth + (soft * look.cloth_thickness)[:, None] * vertex_normals(smooth, triangles)


def scalp_mask(random: np.random.Generator | None = None) -> np.ndarray:
    """Hair-bearing scalp [M] in 0..1; with a generator, the hairline is uneven."""
    rest = rest_surface()
    azimuth = np.degrees(np.arctan2(np.abs(rest[:, 0]), rest[:, 2] - 0.4))
    line = np.interp(azimuth, HAIRLINE[:, 0], HAIRLINE[:, 1])
    if random is not None:
        line = line + 0.03 * noise(rest, 0.5, random)
    ears = refine_attribute(load_pack().masks["ears"])
    return step(rest[:, 1] - line, -0.04, 0.06) * (1 - np.clip(2 * ears, 0, 1))


def brow_mask(look: Look) -> np.ndarray:
    """Eyebrows [M] in 0..1."""
    rest = rest_surface()
    x = np.abs(rest[:, 0])
    centre = np.interp(x, BROW[:, 0], BROW[:, 1])
    half = np.interp(x, BROW[:, 0], BROW[:, 2]) * look.brow_width
    ends = step(x, BROW[0, 0] - 0.03, BROW[0, 0] + 0.02) * step(x, BROW[-1, 0] + 0.02, BROW[-1, 0] - 0.05)
    return ends * step(np.abs(rest[:, 1] - centre), half + 0.014, half - 0.014) * (rest[:, 2] > 1.0)


def beard_mask() -> np.ndarray:
    """Where a beard grows [M], 0..1: moustache, chin, jaw and sideburns, without the lips."""
    rest = rest_surface()
    x, y, z = np.abs(rest[:, 0]), rest[:, 1], rest[:, 2]
    cheek = np.interp(x, [0, 0.28, 0.45, 0.6, 0.72], [6.83, 6.76, 6.66, 6.8, 7.25])
    below_cheek = step(cheek - y, -0.04, 0.07)
    above_throat = step(y, 6.0, 6.22)
    lips = refine_attribute(load_pack().masks["lips"])
    return below_cheek * above_throat * step(z, 0.45, 0.7) * (1 - np.clip(1.6 * lips, 0, 1))


def paint_head(look: Look, cloth: np.ndarray, covered: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Diffuse albedo [M, 3] and specular strength [M] of skin and clothes; `covered` [M] is 1 under modelled hair."""
    random = np.random.default_rng(look.seed)
    rest = rest_surface()
    m = np.clip(look.melanin + 0.03 * noise(rest, 0.6, random) + 0.012 * noise(rest, 0.12, random), 0, 1.1)[:, None]
    absorption = m * np.log(LIGHT_SKIN / DARK_SKIN) + 4 * m * (1 - m) * MELANIN_BEND
    blood = look.haemoglobin + 0.35 * noise(rest, 0.5, random) + 0.15 * noise(rest, 0.15, random)
    skin = LIGHT_SKIN * np.exp(-absorption + blood[:, None] * HAEMOGLOBIN)
    red = look.redness * _redness(rest) * (1 - 0.6 * look.melanin)
    skin = skin * np.exp(red[:, None] * REDNESS)

    if look.freckles:
        skin = skin * (1 - 0.45 * look.freckles * _freckles(rest, random)[:, None] * np.array([0.6, 0.9, 1.0]))
    lids = refine_attribute(load_pack().masks["eyelids"])[:, None]
    skin = skin * np.exp(lids * np.array([-0.12, -0.28, -0.22]))
    skin = _mix(skin, skin * np.array([0.55, 0.32, 0.30]), refine_attribute(load_pack().masks["inside_mouth"]))

    lips = np.clip(1.3 * refine_attribute(load_pack().masks["lips"]), 0, 1)
    lip_colour = skin * np.array([0.88, 0.45, 0.48])
    if look.lipstick is not None:
        lip_colour = 0.25 * lip_colour + 0.75 * np.array(look.lipstick)
    skin = _mix(skin, lip_colour, lips)

    hair = np.array(look.hair_colour)
    if look.stubble:
        beard = beard_mask() * look.stubble * np.clip(0.8 + 0.2 * noise(rest, 0.08, random), 0, 1)
        skin = _mix(skin, hair * 0.8, 0.85 * beard)
    scalp = scalp_mask(random)
    grain = np.clip(0.85 + 0.15 * noise(rest, 0.06, random), 0, 1)
    skin = _mix(skin, hair, np.maximum(scalp * look.scalp * grain, covered))
    brows = brow_mask(look) * look.brow_strength * np.clip(0.85 + 0.25 * noise(rest, 0.05, random), 0, 1)
    skin = _mix(skin, np.minimum(0.8 * np.minimum(hair, 0.22), 0.5 * skin), brows)

    zone = np.exp(-(((rest - [0, 7.05, 1.6]) / [0.14, 0.25, 0.3]) ** 2).sum(1))
    zone = np.maximum(zone, 0.8 * np.exp(-(((rest - [0, 7.75, 1.4]) / [0.4, 0.25, 0.4]) ** 2).sum(1)))
    ears = refine_attribute(load_pack().masks["ears"])
    specular = look.specular + 0.14 * zone + 0.16 * lips - 0.08 * ears + 0.03 * noise(rest, 0.4, random)
    specular = specular - 0.12 * np.maximum(brows, scalp * look.scalp)

    fabric = _fabric(rest, look, random)
    albedo = _mix(skin, fabric, cloth)
    specular = (1 - cloth) * specular + cloth * 0.1
    return np.clip(albedo, 0.004, 0.9), np.clip(specular, 0.02, 1)


def _mix(a, b, weight):
    weight = np.asarray(weight)[:, None]
    return a * (1 - weight) + b * weight


def _redness(rest):
    def blob(centre, size):
        mirrored = np.stack([np.abs(rest[:, 0]), rest[:, 1], rest[:, 2]], 1)
        return np.exp(-(((mirrored - centre) / size) ** 2).sum(1))

    ears = refine_attribute(load_pack().masks["ears"])
    cheeks = blob([0.38, 6.98, 1.25], [0.2, 0.2, 0.35])
    nose = blob([0.0, 6.98, 1.65], [0.14, 0.14, 0.2])
    chin = blob([0.0, 6.35, 1.45], [0.18, 0.12, 0.2])
    return 0.8 * cheeks + 0.7 * nose + 0.35 * chin + 0.6 * ears


def _freckles(rest, random):
    zone = np.exp(-(((rest - [0, 7.08, 1.45]) / [0.45, 0.22, 0.4]) ** 2).sum(1))
    return zone * step(noise(rest, 0.07, random, terms=48), 0.6, 1.6)


def _fabric(rest, look, random):
    shade = np.exp(0.05 * noise(rest, 0.3, random) + 0.04 * noise(rest, 0.06, random))[:, None]
    fabric = np.broadcast_to(np.array(look.cloth_colour), rest.shape)
    if look.shirt_colour is not None:
        width = np.interp(rest[:, 1], [3.7, 5.6], [0.06, 0.38])
        middle = step(width - np.abs(rest[:, 0]), -0.03, 0.03) * (rest[:, 2] > 0.3)
        fabric = _mix(fabric, np.array(look.shirt_colour), middle)
    return fabric * shade


def paint_eye(unit: np.ndarray, radius: float, look: Look) -> tuple[np.ndarray, np.ndarray]:
    """Albedo [N, 3] and specular strength [N] of an eyeball given as unit directions [N, 3]: sclera, iris with a dark
    rim, pupil, all turned towards the gaze."""
    yaw, pitch = look.gaze
    axis = point_towards(yaw, pitch)
    angle = np.arccos(np.clip(unit @ axis, -1, 1))
    rim = np.arcsin(min(IRIS_RADIUS / radius, 0.95))
    turn = np.arctan2(unit[:, 1] - axis[1], unit[:, 0] - axis[0])
    fibres = 1 + 0.15 * np.sin(23 * turn) + 0.1 * np.sin(41 * turn + 1)
    iris = np.array(look.iris_colour) * fibres[:, None] * (1 - 0.65 * step(angle, 0.78 * rim, rim))[:, None]
    albedo = _mix(np.broadcast_to(SCLERA, unit.shape), iris, step(angle, 1.06 * rim, 0.97 * rim))
    albedo = _mix(albedo, np.full(3, 0.004), step(angle, 0.42 * rim, 0.34 * rim))
    return albedo, np.full(len(unit), 0.9)


def dress_head(identity_vertices: np.ndarray, look: Look) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The dressed head: vertices [M, 3], triangles [T, 3] and the cloth mask [M]."""
    vertices, triangles = head_surface(identity_vertices)
    cloth = cloth_mask(look)
    return dress(vertices, triangles, cloth, look), triangles, cloth
