"""MakeHuman heads (CC0): the pack of shape targets, sampled identities and their vertices in scene units.

The base mesh is in decimetres, which are scene units. A head is the base plus weighted targets: macro targets mix
ancestry, sex, age, muscle and weight as MakeHuman does (weights are products that sum to one), local axes are
normally distributed. Heads keep their natural size; the origin is moved between the ears.
"""

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from sira_mi.errors import InputError

DATA = Path(__file__).with_name("data")
ANCESTRIES = ("african", "asian", "caucasian")
# Standard deviation of each category's axes, in units of a full target.
DEVIATIONS = {
    "head": 0.15,
    "neck": 0.2,
    "nose": 0.25,
    "eyes": 0.25,
    "forehead": 0.25,
    "mouth": 0.3,
    "chin": 0.3,
    "ears": 0.3,
    "cheek": 0.35,
    "eyebrows": 0.35,
    "asym": 0.12,
}
# Share of a left-right pair's deviation that each side draws for itself.
ASYMMETRY = 0.12
# Endings of the two targets of one axis, the negative one first.
OPPOSITES = (
    ("decr", "incr"),
    ("down", "up"),
    ("in", "out"),
    ("backward", "forward"),
    ("compress", "uncompress"),
    ("concave", "convex"),
)
ADULT_YEARS = (18.0, 85.0)
BODY_VERTICES = 13380
LEFT_EYE = slice(14598, 14670)
RIGHT_EYE = slice(14670, 14742)
# Rest-pose shoulder joint (left) and neck base in decimetres, and the range of |x| over which the arm starts to turn.
SHOULDER = (1.677, 5.246, 0.146)
ARM_RANGE = (1.15, 1.95)
# Rest-pose height of the mouth line, and by how much the lips are pressed together so that refinement leaves no slit.
MOUTH_HEIGHT = 6.605
LIP_OVERLAP = 0.018


@dataclass(frozen=True)
class Pack:
    vertices: np.ndarray  # [19158, 3] decimetres, +y up, +z front
    quads: np.ndarray  # [F, 4] vertex indices of head, neck and shoulders
    targets: dict[str, tuple[np.ndarray, np.ndarray]]  # name -> vertex indices [n], displacements [n, 3] decimetres
    masks: dict[str, np.ndarray]  # region name -> [19158] in 0..1


@dataclass(frozen=True)
class Identity:
    years: float  # age, years
    male: float  # 0 female to 1 male
    ancestry: tuple[float, ...]  # shares of `ANCESTRIES`, sum 1
    muscle: float  # 0 to 1, 0.5 average
    weight: float  # 0 to 1, 0.5 average
    arms: float  # how far the arms are lowered from the rest pose, radians
    axes: dict[str, float]  # local target name -> weight in units of a full target


@cache
def load_pack() -> Pack:
    """The pack in `DATA` (see `data/PROVENANCE.md`). Raises InputError when it is missing: a wheel does not hold it."""
    for name in ("mh_head_pack.npz", "mh_regions.npz"):
        if not (DATA / name).is_file():
            raise InputError(
                f"{DATA / name} is missing, as wheels do not hold it; build the collection from a checkout, or copy "
                "this folder from one"
            )
    with np.load(DATA / "mh_head_pack.npz") as data:
        quads = data["F"].astype(np.int64)
        offsets = data["off"]
        targets = {
            str(name): (data_idx.astype(np.int64), data_d.astype(np.float64) / 1000)
            for name, data_idx, data_d in zip(
                data["names"], np.split(data["idx"], offsets[1:-1]), np.split(data["d"], offsets[1:-1]), strict=True
            )
        }
        vertices = data["V"].astype(np.float64)
    with np.load(DATA / "mh_regions.npz") as data:
        masks = {name: data[name].astype(np.float64) / 255 for name in data}
    return Pack(vertices, quads[(quads < BODY_VERTICES).all(1)], targets, masks)


@cache
def axes() -> dict[str, tuple[tuple[str | None, str], ...]]:
    """Local axes by category: each the names of its negative target (None if it has none) and its positive target."""
    names = [name for name in load_pack().targets if not name.startswith("macrodetails/")]
    found: dict[str, list] = {category: [] for category in DEVIATIONS}
    paired: set[str] = set()
    for name in names:
        for negative, positive in (*OPPOSITES, ("l", "r")):
            if (negative, positive) == ("l", "r") and not name.startswith("asym/"):
                continue
            partner = name[: -len(negative)] + positive
            if name.endswith(f"-{negative}") and partner in load_pack().targets:
                found[name.split("/")[0]].append((name, partner))
                paired.update((name, partner))
    for name in names:
        if name not in paired:
            found[name.split("/")[0]].append((None, name))
    return {category: tuple(sorted(pairs, key=lambda pair: pair[1])) for category, pairs in found.items()}


def sample_identity(random: np.random.Generator) -> Identity:
    """An adult drawn from the ranges above."""
    years = float(np.clip(random.gamma(4.0, 6.5) + ADULT_YEARS[0], *ADULT_YEARS))
    male = random.beta(0.35, 0.35)
    ancestry = random.dirichlet((0.4, 0.4, 0.4))
    muscle = np.clip(random.normal(0.5, 0.17), 0, 1)
    weight = np.clip(random.normal(0.55, 0.17), 0, 1)
    weights: dict[str, float] = {}
    for category, pairs in axes().items():
        shared: dict[str, float] = {}
        for negative, positive in pairs:
            deviation = DEVIATIONS[category]
            common = positive.replace("/r-", "/l-")
            if common not in shared:
                shared[common] = random.standard_normal()
            own = random.standard_normal()
            if common != positive or positive.startswith(f"{category}/l-"):
                value = shared[common] * np.sqrt(1 - ASYMMETRY**2) + ASYMMETRY * own
            else:
                value = shared[common]
            value = float(np.clip(value, -2.2, 2.2)) * deviation
            if value > 0:
                weights[positive] = value
            elif negative is not None:
                weights[negative] = -value
    return Identity(
        years,
        float(male),
        tuple(float(a) for a in ancestry),
        float(muscle),
        float(weight),
        float(random.uniform(0.3, 0.5)),
        weights,
    )


def macro_weights(identity: Identity) -> dict[str, float]:
    """Weights of the macro targets. Both families sum to one; MakeHuman's ages 25 and 90 are `young` and `old`."""
    old = float(np.clip((identity.years - 25) / 65, 0, 1))
    ages = {"young": 1 - old, "old": old}
    sexes = {"female": 1 - identity.male, "male": identity.male}
    weights = {}
    for ancestry, a in zip(ANCESTRIES, identity.ancestry, strict=True):
        for sex, s in sexes.items():
            for age, g in ages.items():
                weights[f"macrodetails/{ancestry}-{sex}-{age}"] = a * s * g
    for muscle, m in _thirds(identity.muscle).items():
        for weight, w in _thirds(identity.weight).items():
            for sex, s in sexes.items():
                for age, g in ages.items():
                    weights[f"macrodetails/universal-{sex}-{age}-{muscle}muscle-{weight}weight"] = m * w * s * g
    return weights


def _thirds(value: float) -> dict[str, float]:
    return {"min": max(0.0, 1 - 2 * value), "average": 1 - abs(2 * value - 1), "max": max(0.0, 2 * value - 1)}


def identity_vertices(identity: Identity) -> np.ndarray:
    """The full base mesh [19158, 3] of an identity, in scene units, origin between its ears, arms lowered."""
    pack = load_pack()
    vertices = pack.vertices.copy()
    for name, weight in (*macro_weights(identity).items(), *identity.axes.items()):
        index, displacement = pack.targets[name]
        vertices[index] += weight * displacement
    vertices -= between_ears(vertices)
    return lower_arms(close_mouth(vertices), identity.arms)


def between_ears(vertices: np.ndarray) -> np.ndarray:
    """The point [3] midway between the centroids of the two ears' vertices."""
    pack = load_pack()
    ears = pack.masks["ears"] > 0.5
    sides = [vertices[ears & (pack.vertices[:, 0] * side > 0)].mean(0) for side in (1, -1)]
    return (sides[0] + sides[1]) / 2


@cache
def _mouth() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Touching vertices of the upper and lower lip (pairs), the moved vertices, their share of the motion, and whether
    they belong to the upper lip."""
    pack = load_pack()
    rest = pack.vertices
    corners = rest[pack.quads]
    faces = np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
    normals = np.zeros_like(rest)
    np.add.at(normals, pack.quads, faces[:, None])
    tilt = normals[:, 1] / np.maximum(np.linalg.norm(normals, axis=1), 1e-12)
    touching = (pack.masks["lips"] > 0.5) & (np.abs(rest[:, 1] - MOUTH_HEIGHT) < 0.03)
    upper, lower = np.flatnonzero(touching & (tilt < -0.3)), np.flatnonzero(touching & (tilt > 0.3))
    partner = lower[((rest[upper, None] - rest[lower]) ** 2).sum(-1).argmin(1)]
    line = np.interp(np.abs(rest[:, 0]), *_binned(np.abs(rest[upper, 0]), (rest[upper, 1] + rest[partner, 1]) / 2))
    away = rest[:, 1] - line
    share = np.exp(-((away / 0.07) ** 2)) * _smoothstep((0.31 - np.abs(rest[:, 0])) / 0.07)
    share *= _smoothstep((rest[:, 2] - 1.25) / 0.1)
    share[BODY_VERTICES:] = 0
    moved = np.flatnonzero(share > 1e-3)
    above = away > 0
    above[upper], above[lower] = True, False
    return upper, partner, moved, share[moved], above[moved]


def _binned(x, values):
    edges = np.linspace(0, x.max() + 1e-6, 9)
    cell = np.digitize(x, edges)
    cells = np.unique(cell)
    return np.array([x[cell == c].mean() for c in cells]), np.array([values[cell == c].mean() for c in cells])


def close_mouth(vertices: np.ndarray) -> np.ndarray:
    """Vertices [19158, 3] with the lips brought together: independent lip targets would leave a slit or an overlap."""
    rest = load_pack().vertices
    upper, lower, moved, share, above = _mouth()
    gap = vertices[upper] - vertices[lower] - (rest[upper] - rest[lower])
    gap[:, 1] += LIP_OVERLAP
    kernel = np.exp(-(((rest[moved, None, 0] - rest[upper, 0]) / 0.03) ** 2)) + 1e-9
    local = kernel @ gap / kernel.sum(1, keepdims=True)
    local[:, 0] = 0
    out = vertices.copy()
    out[moved] += np.where(above, -0.5, 0.5)[:, None] * share[:, None] * local
    return out


def lower_arms(vertices: np.ndarray, angle: float) -> np.ndarray:
    """Vertices [19158, 3] with both arms turned down about the shoulder joints by `angle` radians; the turn fades in
    over `ARM_RANGE` of the rest pose's |x|, measured along the arm."""
    rest = load_pack().vertices
    out = vertices.copy()
    for side in (1, -1):
        joint = np.array([side * SHOULDER[0], *SHOULDER[1:]])
        along = np.array([side * 0.64, -0.77, 0.0])
        reach = (rest - joint) @ along + SHOULDER[0]
        aside = np.clip((rest[:, 0] * side - 0.95) / 0.35, 0, 1)
        weight = _smoothstep((reach - ARM_RANGE[0]) / (ARM_RANGE[1] - ARM_RANGE[0])) * _smoothstep(aside)
        weight[BODY_VERTICES:] = 0
        near = np.linalg.norm(rest[:BODY_VERTICES] - joint, axis=1) < 0.75
        pivot = vertices[:BODY_VERTICES][near].mean(0)
        turn = -side * angle * weight
        x, y = vertices[:, 0] - pivot[0], vertices[:, 1] - pivot[1]
        moved = weight > 0
        out[moved, 0] = (pivot[0] + np.cos(turn) * x - np.sin(turn) * y)[moved]
        out[moved, 1] = (pivot[1] + np.sin(turn) * x + np.cos(turn) * y)[moved]
    return out


def _smoothstep(t: np.ndarray) -> np.ndarray:
    t = np.clip(t, 0, 1)
    return t * t * (3 - 2 * t)
