"""What the benchmark consists of: portraits, and who is photographed for them how. Which heads of a collection the
benchmark `own` shows, and how each is photographed: camera and lights."""

import hashlib
import json
import zipfile
from argparse import Namespace
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path

import numpy as np

from sira_mi.conventions import LUMINANCE
from sira_mi.errors import InputError
from sira_mi.training.collection.__main__ import sources_of
from sira_mi.training.collection.skin import CLOTH, HAIR, SKIN
from sira_mi.training.collection.subject import BrokenHead, Source, Subject
from studies.cache import fingerprint
from studies.portraits.benchmark_lights import EXTREMES, LIGHTS, draw_relights
from studies.portraits.benchmark_photo import PhotoSettings, Pose
from studies.priors.shape_measures import manifest_entries

FORMAT = "sira-mi benchmark 2"
# Identities are drawn from the sources in these proportions, as far as there are test heads.
SHARES = {"makehuman": 5, "ict": 4, "valid": 3, "meshes": 3}
LARGEST_YAW = 40.0  # degrees
LARGEST_PITCH = 8.0  # degrees
FOCAL_35MM = (50.0, 85.0)
EXTENT = (4.4, 5.0)  # scene units across the photo at the head
TONES = (0.15, 0.27)  # mean luminance of the skin's albedo between dark, medium and light
UNITS_PER_METRE = 10.0
WORN = 0.01  # share of a head's points from which it has hair, or clothes


@dataclass(frozen=True)
class BenchmarkSettings:
    kind: str = "own"  # heads of a collection; "foreign": VALID avatars, which nothing in a fit has seen
    identities: int = 12
    seed: int = 0
    split: str = "test"  # of the collection; portraits of training heads may tune a fit, never score it
    primary_only: bool = False  # one light of each identity instead of three
    photo: PhotoSettings = field(default_factory=PhotoSettings)


@dataclass(frozen=True)
class Identity:
    """A head."""

    source: str
    number: int  # of the source's heads
    seed: int  # of the subject
    group: dict[str, str]
    person: dict  # the subject's description in the collection; empty for a head that is in none
    tone: str  # of the skin
    hair: bool
    clothes: bool
    stem: str | None = None  # of the file, of a head that has one of its own

    @property
    def label(self) -> str:
        return self.stem or f"{self.number:04d}"

    @property
    def title(self) -> str:
        return f"{self.source}_{self.label}"


@dataclass(frozen=True)
class Shot:
    """One portrait to be rendered."""

    name: str
    identity: Identity
    pose: Pose
    light: str
    extreme: str  # kind of the extreme light
    environment: Path | None  # of the outdoor light and of a busy background
    primary: bool
    seed: int
    relights: tuple[Path, ...] = ()  # the two environments that the head is relit under; none: no views
    half: str = "report"  # "choice": settings may be chosen on it
    rank: int = 0  # in its half, whose first portraits are a balanced set
    expression: str = "neutral"
    variant: int = 0  # of the expression
    hair_style: str = "own"
    crop: str = "shoulders"
    background: str = "plain"  # "busy": an environment in focus; "person": a second person
    exif: bool = True  # whether the photo's file says the focal length
    data: tuple[Path, ...] = ()  # files that the subject and a second person are made of

    def key(self, photo: PhotoSettings) -> str:
        """Hash of everything that the portrait depends on."""
        paths = ("environment", "relights", "data")
        described = {name: value for name, value in asdict(self).items() if name not in paths}
        described["relights"] = [path.stem for path in self.relights]
        seen = self.environment if self.light == "outdoor" or self.background == "busy" else None
        files = [*self.relights, *self.data, *([] if seen is None else [seen])]
        return fingerprint(json.dumps([FORMAT, described, asdict(photo)], sort_keys=True), *files)

    def entry(self) -> dict:
        """What is known of the portrait beforehand, for its entry in `benchmark.json`."""
        return {
            "name": self.name,
            "identity": f"{self.identity.source}/{self.identity.label}",
            "source": self.identity.source,
            "group": self.identity.group,
            "half": self.half,
            "rank": self.rank,
            "light": self.light,
            "relights": [path.stem for path in self.relights],
            "yaw_degrees": self.pose.yaw,
            "pitch_degrees": self.pose.pitch,
            "focal_35mm": self.pose.focal_35mm,
            "exif": self.exif,
            "distance_m": round(self.pose.distance / UNITS_PER_METRE, 3),
            "expression": self.expression,
            "hair": self.identity.hair,
            "hair_style": self.hair_style,
            "crop": self.crop,
            "background": self.background,
            "clothes": self.identity.clothes,
            "tone": self.identity.tone,
            "seed": self.seed,
            "primary": self.primary,
        }


@dataclass(frozen=True)
class Sitting:
    """A head in one pose, under one or more lights. The functions make the subjects, and can be sent to workers."""

    make: Callable[[], Subject]
    shots: list[Shot]
    make_beside: Callable[[], Subject] | None = None  # the second person in the background


def plan_own(
    collection: Path, sources: tuple[Source, ...], hdri: Path | None, settings: BenchmarkSettings
) -> list[Sitting]:
    """The portraits of the heads of a collection that are of the given sources. Raises InputError when there are none,
    and when the heads are to be relit (those of the test split) and `hdri` has too few environments."""
    by_name = {source.name: source for source in sources}
    heads = [head for head in heads_of(collection, settings.split) if head.source in by_name]
    if not heads:
        raise InputError(
            f"{collection} has no {settings.split} heads of {', '.join(by_name)}; build a larger collection"
        )
    environments = list_environments(hdri)
    chosen = choose_identities(heads, settings.identities, settings.seed)
    return [
        Sitting(partial(rebuild_subject, by_name[mine[0].identity.source], mine[0].identity), mine)
        for mine in plan(chosen, environments, settings)
    ]


def list_environments(folder: Path | None) -> list[Path]:
    """The .exr files of a folder, sorted by name; none without a folder. Raises InputError for one without such
    files."""
    found = [] if folder is None else sorted(folder.glob("*.exr"))
    if folder is not None and not found:
        raise InputError(f"{folder}: no .exr environment maps found")
    return found


def rebuild_subject(source: Source, identity: Identity) -> Subject:
    """The subject of a head. Raises InputError unless it is the one of the collection."""
    try:
        subject = source.subject(identity.number, identity.seed)
    except (BrokenHead, IndexError) as error:
        raise InputError(f"{identity.title} cannot be made again: {error}; name the data it was built with") from error
    if json.loads(json.dumps(subject.description)) != identity.person:
        raise InputError(f"{identity.title} is not the collection's: name the data that it was built with (--hair, …)")
    return subject


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
        tone=name_tone(tone),
        hair=bool((region == HAIR).mean() > WORN),
        clothes=bool((region == CLOTH).mean() > WORN),
    )


def name_tone(luminance: float) -> str:
    """The tone of skin by the mean luminance of its albedo."""
    return "dark" if luminance < TONES[0] else "medium" if luminance < TONES[1] else "light"


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
        head = find_rarest(mine, seen)
        chosen.append(head)
        left.remove(head)
        taken[source] += 1
        seen.update(traits_of(head))
    return sorted(chosen, key=lambda head: (list(SHARES).index(head.source), head.number))


def find_rarest(heads: list[Identity], seen: Counter[tuple]) -> Identity:
    """The head whose traits have been seen least often; the first of equals."""
    return min(heads, key=lambda head: sum(seen[trait] for trait in traits_of(head)) / len(traits_of(head)))


def traits_of(head: Identity) -> list[tuple]:
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
    taken = [
        environments[(i // len(LIGHTS) + 2 * i) % len(environments)] if environments else None for i in range(count)
    ]
    relit = settings.split == "test"
    relights = draw_relights(environments, taken, settings.seed) if relit else [()] * count
    shots = []
    for i, head in enumerate(heads):
        random = np.random.default_rng([settings.seed, 42, i])
        pose = Pose(
            yaw=round(float(yaws[(first + 5 * i) % count]), 2),
            pitch=round(float(random.uniform(-LARGEST_PITCH, LARGEST_PITCH)), 2),
            focal_35mm=round(float(focals[(first + 7 * i) % count]), 2),
            extent=round(float(random.uniform(*EXTENT)), 3),
        )
        hair = head.person.get("hair")
        style = str(hair["name"]) if isinstance(hair, dict) else "own" if head.hair else "none"
        shots.append(
            [
                Shot(
                    name=f"{head.title}_{light}",
                    identity=head,
                    pose=pose,
                    light=light,
                    extreme=EXTREMES[i // len(LIGHTS) % len(EXTREMES)],
                    environment=taken[i],
                    primary=k == i % len(LIGHTS),
                    seed=draw_seed(settings.seed, head.title, light),
                    relights=relights[i],
                    rank=i,
                    hair_style=style,
                )
                for k, light in enumerate(LIGHTS)
                if k == i % len(LIGHTS) or not settings.primary_only
            ]
        )
    return shots


def draw_seed(*parts: object) -> int:
    """A seed of 32 bits by a hash of names and numbers."""
    return int.from_bytes(hashlib.sha256("/".join(str(part) for part in parts).encode()).digest()[:4])
