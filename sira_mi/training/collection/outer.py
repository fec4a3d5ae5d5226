"""The outer surface of a person: oriented samples that can be seen from afar, and signed distances to them.

A point belongs to the surface when at least `SIGHTINGS` of `DIRECTIONS` far directions see it, and the inside is
everything that fewer of them reach. Hair, head and body so form one solid without hidden pockets.
"""

from dataclasses import dataclass

import mitsuba as mi
import numpy as np
from scipy.spatial import cKDTree

from sira_mi.conventions import DOMAIN_LOWER, DOMAIN_UPPER
from sira_mi.training.collection.render import Part, is_blocked_along
from sira_mi.training.collection.skin import HAIR
from sira_mi.training.collection.subject import BrokenHead
from sira_mi.training.collection.triangles import closest_on_triangles, draw_barycentric, triangle_areas

DIRECTIONS = 64
SIGHTINGS = 3
FACE_RADIUS = 0.95  # scene units around the nose tip
MARGIN = 0.01  # scene units between surface points and the domain's sides


@dataclass(frozen=True)
class Samples:
    """Points on the parts' surfaces with the values interpolated there."""

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
        areas.append(triangle_areas(corners))
        middles.append(corners.mean(1))
    area, middle = np.concatenate(areas), np.concatenate(middles)
    area = area * ((middle > lower - 0.1) & (middle < upper + 0.1)).all(1)
    face = np.linalg.norm(middle - centre, axis=1) < FACE_RADIUS
    weight = area * np.where(face, 0.5 / max(area[face].sum(), 1e-9), 0.5 / max(area[~face].sum(), 1e-9))
    chosen = random.choice(len(weight), count, p=weight / weight.sum())
    bounds = np.cumsum([0] + [len(a) for a in areas])
    bary = draw_barycentric(random, count)
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
    inside = (samples.points > lower) & (samples.points < upper)
    return samples.take(np.asarray(inside.all(1)))


def is_seen_from_afar(scene: "mi.Scene", points: np.ndarray, normals: np.ndarray | None) -> np.ndarray:
    """Whether at least `SIGHTINGS` far directions reach a point, bool [N]; with
    normals, only directions in front of the surface count."""
    sightings = np.zeros(len(points), int)
    for direction in far_directions():
        ask = sightings < SIGHTINGS
        if normals is not None:
            ask &= normals @ direction > 0.02
        index = np.flatnonzero(ask)
        if len(index):
            origin = points[index] if normals is None else points[index] + 2e-3 * normals[index]
            sightings[index] += ~is_blocked_along(scene, origin, direction)
    return sightings >= SIGHTINGS


def smooth_hair_normals(samples: Samples) -> np.ndarray:
    """Normals [N, 3]; those of hair are averaged over their neighbours, which makes hair a soft volume."""
    normals = samples.normals.copy()
    hair = np.flatnonzero(samples.region == HAIR)
    if len(hair) > 8:
        _, near = cKDTree(samples.points[hair]).query(samples.points[hair], k=8)
        mean = samples.normals[hair][near].mean(1)
        normals[hair] = mean / np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-9)
    return normals


def distance_to_surface(points: np.ndarray, outer: Samples, candidates: int = 8) -> np.ndarray:
    """Distances [Q] from points [Q, 3] to the triangles of the nearest samples of the outer surface."""
    _, near = cKDTree(outer.points).query(points, k=candidates)
    weights = closest_on_triangles(points[:, None], outer.corners[near])
    closest = np.einsum("nck,nckd->ncd", weights, outer.corners[near])
    return np.linalg.norm(points[:, None] - closest, axis=-1).min(1)


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
