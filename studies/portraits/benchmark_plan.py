"""Which heads of a collection the benchmark shows, and how each is photographed: camera and lights."""

import hashlib
import json
import zipfile
from argparse import Namespace
from collections import Counter
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np

from sira_mi.conventions import LUMINANCE
from sira_mi.errors import InputError
from sira_mi.training.collection.__main__ import sources_of
from sira_mi.training.collection.skin import CLOTH, HAIR, SKIN
from sira_mi.training.collection.subject import Source
from studies.cache import fingerprint
from studies.portraits.benchmark_lights import EXTREMES, LIGHTS
from studies.portraits.benchmark_photo import PhotoSettings
from studies.priors.shape_measures import manifest_entries

FORMAT = "sira-mi benchmark 1"
# Identities are drawn from the sources in these proportions, as far as there are test heads.
SHARES = {"makehuman": 5, "ict": 4, "valid": 3, "meshes": 3}
LARGEST_YAW = 40.0  # degrees
LARGEST_PITCH = 8.0  # degrees
FOCAL_35MM = (50.0, 85.0)
EXTENT = (4.4, 5.0)  # scene units across the photo at the head
TONES = (0.15, 0.27)  # mean luminance of the skin's albedo between dark, medium and light
WORN = 0.01  # share of a head's points from which it has hair, or clothes


@dataclass(frozen=True)
class BenchmarkSettings:
    identities: int = 12
    seed: int = 0
    split: str = "test"  # of the collection; portraits of training heads may tune a fit, never score it
    primary_only: bool = False  # one light of each identity instead of three
    photo: PhotoSettings = field(default_factory=PhotoSettings)


@dataclass(frozen=True)
class Identity:
    """A head of a collection."""

    source: str
    number: int
    seed: int  # of the subject
    group: dict[str, str]
    person: dict  # the subject's description
    tone: str  # of the skin
    hair: bool
    clothes: bool

    @property
    def title(self) -> str:
        return f"{self.source}_{self.number:04d}"


@dataclass(frozen=True)
class Pose:
    """How an identity is photographed, the same under each light."""

    yaw: float  # degrees about the head, positive to its left
    pitch: float  # degrees, positive from above
    focal_35mm: float  # mm
    extent: float  # scene units across the photo


@dataclass(frozen=True)
class Shot:
    """One portrait to be rendered."""

    identity: Identity
    pose: Pose
    light: str
    extreme: str  # kind of the extreme light
    environment: Path | None  # of the outdoor light
    primary: bool
    seed: int

    @property
    def name(self) -> str:
        return f"{self.identity.title}_{self.light}"

    def key(self, photo: PhotoSettings) -> str:
        """Hash of everything that the portrait depends on."""
        described = json.dumps([FORMAT, asdict(self) | {"environment": None}, asdict(photo)], sort_keys=True)
        return fingerprint(described, *([self.environment] if self.light == "outdoor" and self.environment else []))

    def entry(self) -> dict:
        """The portrait's entry in `benchmark.json`."""
        return {
            "name": self.name,
            "identity": f"{self.identity.source}/{self.identity.number:04d}",
            "source": self.identity.source,
            "group": self.identity.group,
            "light": self.light,
            "yaw_degrees": self.pose.yaw,
            "pitch_degrees": self.pose.pitch,
            "focal_35mm": self.pose.focal_35mm,
            "hair": self.identity.hair,
            "clothes": self.identity.clothes,
            "tone": self.identity.tone,
            "seed": self.seed,
            "primary": self.primary,
        }


def select_sources(
    collection: Path, split: str, names: list[str] | None, data: dict[str, Path | None]
) -> tuple[Source, ...]:
    """The sources of a collection's heads of `split`, or those of them in `names`, over the data (by the names `hair`,
    `ict`, `valid` and `meshes`) that it was built with. Raises InputError for a name of no source, and when the data of
    a source are not given."""
    present = list(dict.fromkeys(entry["source"] for entry in manifest_entries(collection, split)))
    try:
        counts = json.loads((collection / "manifest.json").read_text(encoding="utf-8"))["settings"]["sources"]
    except (KeyError, TypeError) as error:
        raise InputError(f"{collection}: the manifest does not say how many heads it has; build it again") from error
    wanted = present if names is None else names
    for name in wanted:
        if name not in present:
            raise InputError(f"{collection} has no {split} heads of {name}; it has some of {', '.join(present)}")
        if name in data and data[name] is None:
            raise InputError(f"{collection} has heads of {name}: give its data by --{name}, or choose other --sources")
    described = Namespace(**data, count=counts.get("makehuman", 0), ict_count=counts.get("ict", 0))
    return tuple(source for source in sources_of(described) if source.name in wanted)


def heads_of(collection: Path, split: str) -> list[Identity]:
    """The heads of a collection's `split`, "test" or "train", in the manifest's order. Raises InputError when a scene
    cannot be read."""
    return [_identity(collection, entry) for entry in manifest_entries(collection, split)]


def _identity(collection, entry):
    path = collection / Path(entry["file"]).name
    try:
        with np.load(path, allow_pickle=False) as data:
            info, region, albedo = json.loads(str(data["info"])), data["region"], data["albedo"].astype(float)
        person, group = info["person"], info["group"]
        if info["seed"] != entry["seed"]:
            raise ValueError("another seed than the manifest's")
    except (OSError, ValueError, KeyError, TypeError, zipfile.BadZipFile) as error:
        raise InputError(f"{path}: not a scene of this collection ({error}); build the collection again") from error
    tone = float((albedo[region == SKIN] @ np.array(LUMINANCE)).mean())
    return Identity(
        source=entry["source"],
        number=int(entry["number"]),
        seed=int(entry["seed"]),
        group=group,
        person=person,
        tone="dark" if tone < TONES[0] else "medium" if tone < TONES[1] else "light",
        hair=bool((region == HAIR).mean() > WORN),
        clothes=bool((region == CLOTH).mean() > WORN),
    )


def choose_identities(heads: list[Identity], count: int, seed: int) -> list[Identity]:
    """`count` of the heads, or all if there are fewer: sources in the proportions of `SHARES`, and from each, one after
    the other, the head whose ancestry, sex, age, skin tone and hair are rarest among those chosen before; the seed
    decides between equals. The result is in the order of the sources."""
    rank = {head.title: hashlib.sha256(f"{seed}/{head.title}".encode()).hexdigest() for head in heads}
    left = sorted(heads, key=lambda head: rank[head.title])
    chosen: list[Identity] = []
    seen: Counter[tuple] = Counter()
    taken: Counter[str] = Counter()
    while left and len(chosen) < count:
        sources = sorted({head.source for head in left})
        source = min(sources, key=lambda name: ((taken[name] + 1) / SHARES[name], name))
        mine = [head for head in left if head.source == source]
        head = min(mine, key=lambda head: sum(seen[trait] for trait in _traits(head)) / len(_traits(head)))
        chosen.append(head)
        left.remove(head)
        taken[source] += 1
        seen.update(_traits(head))
    return sorted(chosen, key=lambda head: (list(SHARES).index(head.source), head.number))


def _traits(head):
    """The known traits of a head, by which heads are chosen to differ."""
    hair = head.person.get("hair")
    style = hair["name"] if isinstance(hair, dict) else head.hair
    known = [(name, value) for name, value in head.group.items() if value != "unknown"]
    return [*known, ("tone", head.tone), ("hair", head.hair), ("style", style)]


def plan(heads: list[Identity], environments: list[Path], settings: BenchmarkSettings) -> list[list[Shot]]:
    """The portraits of each head. Yaw and focal length are spread evenly over their ranges, in an order that mixes them
    with the lights; the primary light, the kind of the extreme one and the environments take turns."""
    count = len(heads)
    yaws, focals = np.linspace(-LARGEST_YAW, LARGEST_YAW, count), np.linspace(*FOCAL_35MM, count)
    first = int(np.random.default_rng([settings.seed, 41]).integers(count))
    shots = []
    for i, head in enumerate(heads):
        random = np.random.default_rng([settings.seed, 42, i])
        pose = Pose(
            yaw=round(float(yaws[(first + 5 * i) % count]), 2),
            pitch=round(float(random.uniform(-LARGEST_PITCH, LARGEST_PITCH)), 2),
            focal_35mm=round(float(focals[(first + 7 * i) % count]), 2),
            extent=round(float(random.uniform(*EXTENT)), 3),
        )
        turn = i // len(LIGHTS)
        shots.append(
            [
                Shot(
                    identity=head,
                    pose=pose,
                    light=light,
                    extreme=EXTREMES[turn % len(EXTREMES)],
                    environment=environments[(turn + 2 * i) % len(environments)] if environments else None,
                    primary=k == i % len(LIGHTS),
                    seed=int.from_bytes(hashlib.sha256(f"{settings.seed}/{head.title}/{light}".encode()).digest()[:4]),
                )
                for k, light in enumerate(LIGHTS)
                if k == i % len(LIGHTS) or not settings.primary_only
            ]
        )
    return shots
