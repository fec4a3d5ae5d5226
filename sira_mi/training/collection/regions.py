"""Regions of a textured head: skin, hair, eyes and cloth, classified by position and colour, and the parts made of
them."""

from collections.abc import Sequence

import numpy as np
from scipy import sparse
from scipy.spatial import cKDTree
from skimage.color import rgb2lab
from skimage.measure import points_in_poly

from sira_mi.colour import linear_to_srgb
from sira_mi.conventions import DOMAIN_LOWER, DOMAIN_UPPER, LUMINANCE
from sira_mi.portrait.landmarks import CHEEKS, CHIN, LIP_BORDER, NOSE_UNDERSIDE, OVAL
from sira_mi.training.collection import skin
from sira_mi.training.collection.annotation import mean_head
from sira_mi.training.collection.render import Part
from sira_mi.training.collection.textured_surface import Surface, place_index, smooth_normals

FACE_EDGE, HEAD_EDGE, BODY_EDGE = 0.03, 0.045, 0.07  # scene units, longest edge on the face, the head and below
_LIP_MIDDLES = (13, 14, 82, 312)
LIGHTNESS_WEIGHT = 0.6  # of L* beside a* and b* in colour distances
BALD = 12.0  # colour distance between crown and cheeks below which no hair is painted on the scalp
SPECULAR = {skin.HAIR: 0.3, skin.CLOTH: 0.1, skin.EYE: 0.9}


def choose_edge_lengths(middle: np.ndarray) -> np.ndarray:
    """Longest edge [E] at midpoints [E, 3] in the project's frame; what no camera sees is not refined."""
    longest = np.where(middle[:, 1] > -1.3, np.where(middle[:, 2] > 0.3, FACE_EDGE, HEAD_EDGE), BODY_EDGE)
    outside = ((middle < np.array(DOMAIN_LOWER) - 0.3) | (middle > np.array(DOMAIN_UPPER) + 0.3)).any(1)
    return np.where(outside, np.inf, longest)


def face_mask(points: np.ndarray, landmarks: np.ndarray) -> np.ndarray:
    """Whether points [N, 3] belong to the face: in front, inside the oval of the landmarks [468, 3] seen from there."""
    oval = landmarks[list(OVAL)]
    return (points[:, 2] > oval[:, 2].min() - 0.1) & points_in_poly(points[:, :2], oval[:, :2])


def fill_missing_landmarks(landmarks: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Landmarks [468, 3], those that are not valid replaced by the mean head's."""
    return np.where(valid[:, None], landmarks, mean_head()[0])


def convert_to_lab(albedo: np.ndarray) -> np.ndarray:
    """CIE L*a*b* [N, 3] of linear colours, lightness reduced, so that shading baked into a texture has less weight."""
    return rgb2lab(linear_to_srgb(albedo)) * [LIGHTNESS_WEIGHT, 1, 1]


def classify(vertices: np.ndarray, triangles: np.ndarray, albedo: np.ndarray, landmarks: np.ndarray) -> np.ndarray:
    """Region code [N] of a textured head and body in the project's frame, from positions and colours: hair is around
    the face and closer in colour to the crown than to the cheeks; cloth is below the chin and differs from the
    cheeks."""
    colour = convert_to_lab(albedo)
    face = face_mask(vertices, landmarks)
    chin = landmarks[CHIN, 1]
    cheeks = np.median(colour[find_near_landmarks(vertices, landmarks, CHEEKS, 0.12)], axis=0)
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


def find_near_landmarks(
    vertices: np.ndarray, landmarks: np.ndarray, chosen: Sequence[int], radius: float
) -> np.ndarray:
    """Indices of the vertices within a radius of the chosen landmarks, at least the nearest one of each."""
    tree = cKDTree(landmarks[list(chosen)])
    inside = np.flatnonzero(tree.query(vertices, distance_upper_bound=radius)[0] < radius)
    return np.union1d(inside, cKDTree(vertices).query(landmarks[list(chosen)])[1])


def find_albedo_scale(vertices: np.ndarray, albedo: np.ndarray, landmarks: np.ndarray) -> float:
    """The factor that brings the cheeks' luminance into the range of measured skin; 1 inside it."""
    weights = np.array(LUMINANCE)
    lightness = float(np.median(albedo[find_near_landmarks(vertices, landmarks, CHEEKS, 0.12)] @ weights))
    low, high = float(skin.DARK_SKIN @ weights), float(skin.LIGHT_SKIN @ weights)
    return float(np.clip(lightness, low, high) / max(lightness, 1e-3))


def paint_specular(vertices: np.ndarray, region: np.ndarray, landmarks: np.ndarray, base: float) -> np.ndarray:
    """Specular strength [N]: skin has `base`, more on lips, nose and forehead; hair, cloth and eyes have their own."""
    distance = cKDTree(landmarks[[*LIP_BORDER, *_LIP_MIDDLES]]).query(vertices)[0]
    lips = np.exp(-((distance / 0.06) ** 2))
    nose = np.exp(-(((vertices - landmarks[NOSE_UNDERSIDE] - [0, 0.15, 0]) / [0.16, 0.28, 0.35]) ** 2).sum(1))
    strength = base + 0.16 * lips + 0.14 * nose
    for code, value in SPECULAR.items():
        strength[region == code] = value
    return np.clip(strength, 0.02, 1)


def paint_part(surface: Surface, region: np.ndarray, landmarks: np.ndarray, scale: float, base: float) -> Part:
    """A part of a surface in the project's frame with the region codes [N] of its vertices."""
    codes = np.sort(region[surface.triangles], axis=1)[:, 1]
    return Part(
        surface.vertices,
        surface.triangles,
        smooth_normals(surface.vertices, surface.triangles),
        np.clip(surface.colours() * scale, 0.004, 0.9),
        paint_specular(surface.vertices, region, landmarks, base),
        codes,
    )


def make_plain_part(surface: Surface, code: int = skin.SKIN) -> Part:
    """A part of one region, with its specular strength or that of skin."""
    return Part(
        surface.vertices,
        surface.triangles,
        smooth_normals(surface.vertices, surface.triangles),
        np.clip(surface.colours(), 0.004, 0.9),
        np.full(len(surface.vertices), SPECULAR.get(code, 0.4)),
        np.full(len(surface.triangles), code),
    )


def draw_skin_specular(seed: int) -> float:
    """A person's base specular strength of skin (FLARE: 0.375 ± 0.166, of one person's parts less)."""
    return float(np.clip(np.random.default_rng([seed, 21]).normal(0.375, 0.09), 0.15, 0.65))
