"""The portraits of the benchmark `foreign`: VALID avatars, which nothing in a fit has seen, and how they are taken.

Two halves by identity: settings are chosen on the first, "choice", and reported on the second, "report". In each, the
portraits have a rank; the first 8 and the first 16 of a half are balanced in ancestry, sex, tone, expression, light,
crop and pose. Numbers follow Halton sequences, and choices come in shuffled rounds, so that every beginning is spread.
"""

from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np
from scipy.stats.qmc import Halton

from sira_mi.conventions import LUMINANCE
from sira_mi.errors import InputError
from sira_mi.training.collection.sources.valid import ValidSource, find_group, read_texture
from sira_mi.training.collection.subject import BrokenHead
from studies.portraits.benchmark_lights import EXTREMES, LIGHTS, draw_relights
from studies.portraits.benchmark_photo import PhotoSettings, Pose, find_focal
from studies.portraits.benchmark_plan import (
    UNITS_PER_METRE,
    BenchmarkSettings,
    Identity,
    Shot,
    Sitting,
    draw_seed,
    find_rarest,
    list_environments,
    name_tone,
    traits_of,
)
from studies.portraits.foreign_heads import ForeignHeads

Item = TypeVar("Item")

# All avatars; photos as phones store them.
FOREIGN = BenchmarkSettings(
    "foreign", identities=28, photo=PhotoSettings(shading_samples=16, jpeg_quality=85, jpeg_subsampling=2)
)
HALVES = ("choice", "report")
TAKES = 2  # portraits of each identity
LARGEST_YAW, LARGEST_PITCH = 45.0, 15.0  # degrees
DISTANCE = (0.4, 3.0)  # m, from the camera to the head
# A third of the portraits is neutral.
SHOWN = ("neutral", "open_smile", "aside", "neutral", "talking", "closed_smile", "neutral", "eyes_closed", "brows")
BACKGROUNDS = ("plain", "busy", "plain", "busy", "person")
# The cheeks in the texture's layout, which all avatars share, as shares of its sides.
CHEEK_ROWS, CHEEK_COLUMNS = (0.25, 0.285), ((0.24, 0.28), (0.38, 0.42))


@dataclass(frozen=True)
class Crop:
    """What a photo shows."""

    name: str
    extent: tuple[float, float]  # scene units across
    height: tuple[float, float] | None  # of its middle, scene units; None for what shows the hair from its top down
    nearest: float = 0.0  # m, from which distance it is taken


CROPS = (
    Crop("shoulders", (4.4, 5.2), None),
    Crop("head", (3.2, 3.8), None),
    Crop("half", (5.2, 5.6), None, nearest=0.8),
    Crop("face", (2.3, 2.7), (-0.2, 0.05)),
)


def plan_foreign(valid: Path, morphs: Path, hair: Path, hdri: Path, settings: BenchmarkSettings) -> list[Sitting]:
    """The portraits by rank, the halves in turns. Raises InputError for folders without avatars, their morphs or hair,
    or with too few environments."""
    heads = ForeignHeads(ValidSource(valid), morphs, hair)
    heads.check()
    environments = list_environments(hdri)
    halves = [order_identities(half) for half in split_identities(list_identities(heads.avatars))]
    numbers = {name: -(-(settings.identities - k) // 2) for k, name in enumerate(HALVES)}
    shots = [
        shot
        for name, half in zip(HALVES, halves, strict=True)
        for shot in plan_half(name, half, environments, settings.seed)
        if shot.identity in half[: numbers[name]]
    ]
    shots.sort(key=lambda shot: (shot.rank, shot.half))
    members = dict(zip(HALVES, halves, strict=True))
    return [make_sitting(heads, shot, members[shot.half]) for shot in shots]


def make_sitting(heads: ForeignHeads, shot: Shot, half: Sequence[Identity]) -> Sitting:
    """The sitting of a portrait; a second person comes from the same half."""
    me = shot.identity
    make, make_beside = partial(heads.make_subject, me.number, me.seed, shot.expression, shot.variant), None
    data = heads.files_of(me.number)
    if shot.background == "person":
        other = half[(half.index(me) + 3) % len(half)]
        make_beside = partial(heads.make_subject, other.number, other.seed)
        data += heads.files_of(other.number)
    style = heads.style_of(me.number)
    return Sitting(make, [replace(shot, data=tuple(data), hair_style=style)], make_beside)


def list_identities(source: ValidSource) -> list[Identity]:
    """The avatars of a folder. Raises InputError for one whose texture cannot be read."""
    identities = []
    for number, path in enumerate(source.files()):
        try:
            texture = read_texture(path.with_suffix(".jpg"))
        except BrokenHead as error:
            raise InputError(f"{path}: {error}; copy the avatar again") from None
        height, width = texture.shape[:2]
        rows = slice(*(round(share * height) for share in CHEEK_ROWS))
        cheeks = [texture[rows, round(left * width) : round(right * width)] for left, right in CHEEK_COLUMNS]
        luminance = float(np.median(np.stack(cheeks) @ np.array(LUMINANCE)))
        identities.append(
            Identity(
                source=source.name,
                number=number,
                seed=draw_seed("foreign", path.stem),
                group=find_group(path.stem),
                person={"luminance": luminance},
                tone=name_tone(luminance),
                hair=True,
                clothes=True,
                stem=path.stem,
            )
        )
    return identities


def split_identities(identities: Sequence[Identity]) -> tuple[list[Identity], list[Identity]]:
    """The identities of both halves: of each ancestry and sex as many in either, and their tones alike."""
    groups = defaultdict(list)
    for identity in sorted(identities, key=lambda identity: (identity.person["luminance"], identity.title)):
        groups[identity.group["ancestry"], identity.group["sex"]].append(identity)
    halves: tuple[list[Identity], list[Identity]] = ([], [])
    lead = 0.0  # by how much the first half is lighter
    for _, group in sorted(groups.items()):
        for k in range(0, len(group) - 1, 2):
            darker, lighter = group[k : k + 2]
            for half, identity in zip(halves, (darker, lighter) if lead > 0 else (lighter, darker), strict=True):
                half.append(identity)
            lead += halves[0][-1].person["luminance"] - halves[1][-1].person["luminance"]
        if len(group) % 2:
            min(halves, key=len).append(group[-1])
    return halves


def order_identities(identities: Sequence[Identity]) -> list[Identity]:
    """The identities in an order whose every beginning is balanced: one after the other the one whose traits have been
    rarest so far."""
    left, seen, ordered = list(identities), Counter[tuple](), []
    while left:
        found = find_rarest(left, seen)
        left.remove(found)
        seen.update(traits_of(found))
        ordered.append(found)
    return ordered


def plan_half(name: str, identities: Sequence[Identity], environments: list[Path], seed: int) -> list[Shot]:
    """The portraits of one half by rank: one of each identity, then the second of each."""
    random = np.random.default_rng([seed, 61, HALVES.index(name)])
    count = TAKES * len(identities)
    places = Halton(3, seed=random).random(count)
    expressions, lights, extremes, backgrounds = (
        spread(names, count, random) for names in (SHOWN, LIGHTS, EXTREMES, BACKGROUNDS)
    )
    for rank in range(len(identities), count - 1):
        if expressions[rank] == expressions[rank - len(identities)]:
            expressions[rank : rank + 2] = expressions[rank + 1], expressions[rank]
    crops, exif = spread(CROPS, count, random), spread((True, False), count, random)
    taken = spread(environments, count, random)
    relights = draw_relights(environments, taken, draw_seed(seed, name))
    shots = []
    shown = Counter[str]()
    for rank in range(count):
        identity, take = identities[rank % len(identities)], rank // len(identities)
        distance = float(DISTANCE[0] * (DISTANCE[1] / DISTANCE[0]) ** places[rank, 2])
        crop = crops[rank] if distance > crops[rank].nearest else CROPS[0]
        expression = expressions[rank]
        title = f"{identity.stem}_{take + 1}_{expression}"
        shots.append(
            Shot(
                name=title,
                identity=identity,
                pose=draw_pose(places[rank], distance, crop, random),
                light=lights[rank],
                extreme=extremes[rank],
                environment=taken[rank],
                primary=take == 0,
                seed=draw_seed(seed, title),
                relights=relights[rank],
                half=name,
                rank=rank,
                expression=expression,
                variant=shown[expression] + 3 * HALVES.index(name),
                crop=crop.name,
                background=backgrounds[rank],
                exif=exif[rank],
            )
        )
        shown[expression] += 1
    return shots


def draw_pose(place: np.ndarray, distance: float, crop: Crop, random: np.random.Generator) -> Pose:
    """A pose of two numbers [..] in 0..1, at a distance in m."""
    extent = float(random.uniform(*crop.extent))
    height = None if crop.height is None else round(float(random.uniform(*crop.height)), 3)
    return Pose(
        yaw=round(float(LARGEST_YAW * (2 * place[0] - 1)), 2),
        pitch=round(float(LARGEST_PITCH * (2 * place[1] - 1)), 2),
        focal_35mm=round(find_focal(distance * UNITS_PER_METRE, extent), 2),
        extent=round(extent, 3),
        height=height,
        aside=round(float(random.uniform(-0.06, 0.06) * extent), 3),
    )


def spread(values: Sequence[Item], count: int, random: np.random.Generator) -> list[Item]:
    """`count` of the values in rounds, each a new order of them all."""
    rounds = [random.permutation(len(values)) for _ in range(-(-count // len(values)))]
    return [values[k] for k in np.concatenate(rounds)[:count]]
