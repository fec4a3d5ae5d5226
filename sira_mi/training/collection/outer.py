"""The outer surface of a person: oriented samples that can be seen from afar, and signed distances to them.

A point belongs to the surface when at least `SIGHTINGS` of `DIRECTIONS` far directions see it, and the inside is
whatever fewer of them reach, so hair, head and body form one solid without hidden pockets.
"""

from dataclasses import dataclass

import mitsuba as mi
import numpy as np
from scipy.spatial import cKDTree

from sira_mi.conventions import DOMAIN_LOWER, DOMAIN_UPPER
from sira_mi.training.collection.render import Part, blocked_along
from sira_mi.training.collection.skin import HAIR
from sira_mi.training.collection.subject import BrokenHead

DIRECTIONS = 64
SIGHTINGS = 3
FACE_RADIUS = 0.95  # scene units around the nose tip
MARGIN = 0.01  # scene units between surface points and the domain's sides


@dataclass(frozen=True)
class Samples:
    """Points on the parts' surfaces with what is interpolated at them."""

    points: np.ndarray  # [N, 3]
    normals: np.ndarray  # [N, 3]
    region: np.ndarray  # [N]
    albedo: np.ndarray  # [N, 3]
    specular: np.ndarray  # [N]
    corners: np.ndarray  # [N, 3, 3] of the triangle that the point lies on

    def take(self, index: np.ndarray) -> "Samples":
        return Samples(*(getattr(self, name)[index] for name in self.__dataclass_fields__))


def far_directions(count: int = DIRECTIONS) -> np.ndarray:
    """Unit directions [count, 3] spread evenly over the sphere (a Fibonacci lattice)."""
    index = np.arange(count) + 0.5
    height = 1 - 2 * index / count
    turn = np.pi * (1 + 5**0.5) * index
    radius = np.sqrt(1 - height**2)
    return np.stack([radius * np.cos(turn), height, radius * np.sin(turn)], axis=1)


def sample_parts(parts: list[Part], count: int, centre: np.ndarray, random: np.random.Generator) -> Samples:
    """About `count` points on the parts inside the domain, half of them within `FACE_RADIUS` of `centre`."""
    lower, upper = np.array(DOMAIN_LOWER) + MARGIN, np.array(DOMAIN_UPPER) - MARGIN
    areas, middles = [], []
    for part in parts:
        corners = part.vertices[part.triangles]
        areas.append(
            0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        )
        middles.append(corners.mean(1))
    area, middle = np.concatenate(areas), np.concatenate(middles)
    area = area * ((middle > lower - 0.1) & (middle < upper + 0.1)).all(1)
    face = np.linalg.norm(middle - centre, axis=1) < FACE_RADIUS
    weight = area * np.where(face, 0.5 / max(area[face].sum(), 1e-9), 0.5 / max(area[~face].sum(), 1e-9))
    chosen = random.choice(len(weight), count, p=weight / weight.sum())
    bounds = np.cumsum([0] + [len(a) for a in areas])
    a, b = random.random((2, count))
    a, b = np.where(a + b > 1, 1 - a, a), np.where(a + b > 1, 1 - b, b)
    bary = np.stack([1 - a - b, a, b], axis=1)
    pieces = []
    for number, part in enumerate(parts):
        mine = (chosen >= bounds[number]) & (chosen < bounds[number + 1])
        triangle = chosen[mine] - bounds[number]
        corner = part.triangles[triangle]

        def at(values, corner=corner, bary=bary[mine]):
            return np.einsum("nk,nk...->n...", bary, values[corner])

        normals = at(part.normals)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
        corners = part.vertices[corner]
        pieces.append((at(part.vertices), normals, part.region[triangle], at(part.albedo), at(part.specular), corners))
    samples = Samples(*(np.concatenate(column) for column in zip(*pieces, strict=True)))
    return samples.take(((samples.points > lower) & (samples.points < upper)).all(1))


def seen_from_afar(scene: "mi.Scene", points: np.ndarray, normals: np.ndarray | None) -> np.ndarray:
    """Whether at least `SIGHTINGS` far directions reach a point, bool [N]; points on a surface are only asked in front
    of it."""
    sightings = np.zeros(len(points), int)
    for direction in far_directions():
        ask = sightings < SIGHTINGS
        if normals is not None:
            ask &= normals @ direction > 0.02
        index = np.flatnonzero(ask)
        if len(index):
            origin = points[index] if normals is None else points[index] + 2e-3 * normals[index]
            sightings[index] += ~blocked_along(scene, origin, direction)
    return sightings >= SIGHTINGS


def smooth_hair_normals(samples: Samples) -> np.ndarray:
    """Normals [N, 3] with those of hair averaged over their neighbours, so that hair is a soft volume."""
    normals = samples.normals.copy()
    hair = np.flatnonzero(samples.region == HAIR)
    if len(hair) > 8:
        _, near = cKDTree(samples.points[hair]).query(samples.points[hair], k=8)
        mean = samples.normals[hair][near].mean(1)
        normals[hair] = mean / np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-9)
    return normals


def point_triangle_distance(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Distances [...] from points [..., 3] to triangles [..., 3, 3] (Ericson 2005, section 5.1.5)."""
    a, b, c = corners[..., 0, :], corners[..., 1, :], corners[..., 2, :]

    def dot(u, v):
        return (u * v).sum(-1)

    ab, ac, ap = b - a, c - a, points - a
    bp, cp = points - b, points - c
    d1, d2, d3, d4, d5, d6 = dot(ab, ap), dot(ac, ap), dot(ab, bp), dot(ac, bp), dot(ab, cp), dot(ac, cp)
    va, vb, vc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2
    tiny = 1e-20
    inner = np.maximum(va + vb + vc, tiny)
    v, w = vb / inner, vc / inner
    on_bc = (va <= 0) & (d4 - d3 >= 0) & (d5 - d6 >= 0)
    t = (d4 - d3) / np.maximum(d4 - d3 + d5 - d6, tiny)
    v, w = np.where(on_bc, 1 - t, v), np.where(on_bc, t, w)
    on_ac = (vb <= 0) & (d2 >= 0) & (d6 <= 0)
    v, w = np.where(on_ac, 0, v), np.where(on_ac, d2 / np.maximum(d2 - d6, tiny), w)
    on_ab = (vc <= 0) & (d1 >= 0) & (d3 <= 0)
    v, w = np.where(on_ab, d1 / np.maximum(d1 - d3, tiny), v), np.where(on_ab, 0, w)
    for at, vv, ww in (
        ((d1 <= 0) & (d2 <= 0), 0, 0),
        ((d3 >= 0) & (d4 <= d3), 1, 0),
        ((d6 >= 0) & (d5 <= d6), 0, 1),
    ):
        v, w = np.where(at, vv, v), np.where(at, ww, w)
    closest = a + v[..., None] * ab + w[..., None] * ac
    return np.linalg.norm(points - closest, axis=-1)


def distance_to_surface(points: np.ndarray, outer: Samples, candidates: int = 8) -> np.ndarray:
    """Distances [Q] from points [Q, 3] to the triangles of the nearest samples of the outer surface."""
    _, near = cKDTree(outer.points).query(points, k=candidates)
    return point_triangle_distance(points[:, None], outer.corners[near]).min(1)


def choose_points(
    wide: Samples, nose: np.ndarray, count: int, face_share: float, random: np.random.Generator
) -> Samples:
    """`count` of the outer samples, `face_share` of them within `FACE_RADIUS` of the nose tip."""
    face = np.linalg.norm(wide.points - nose, axis=1) < FACE_RADIUS
    inside, outside = np.flatnonzero(face), np.flatnonzero(~face)
    wanted = round(face_share * count)
    wanted = int(np.clip(wanted, count - len(outside), len(inside)))
    if count - wanted > len(outside) or wanted < 0:
        raise BrokenHead(f"only {len(wide.points)} visible surface points")
    chosen = np.concatenate(
        [random.choice(inside, wanted, replace=False), random.choice(outside, count - wanted, replace=False)]
    )
    return wide.take(random.permutation(chosen))
