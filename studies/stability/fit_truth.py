"""Portraits with known truth that anyone can take again: a MakeHuman head of the shipped pack, path traced.

Its number makes it a test head of any collection, and its seed is none of a collection's heads', so that no prior was
trained on it."""

import json
from functools import cache, partial
from pathlib import Path

from sira_mi.training.collection.sources.makehuman import MakeHumanSource
from studies.portraits.benchmark import take_portraits, truth_of
from studies.portraits.benchmark_photo import PhotoSettings, Pose
from studies.portraits.benchmark_plan import Identity, Shot, Sitting, rebuild_subject

NUMBER, SEED = 7, 800_103
FOCAL_35MM = 70.0  # mm
# Name and yaw in degrees of each portrait.
YAWS = {"front": 12.0, "turned": 50.0, "profile": 85.0}
_PHOTO = PhotoSettings(size=512, samples=64, depth=5, shading_samples=4)


@cache
def take_portrait(folder: Path, view: str) -> Path:
    """The folder, inside `folder`, of the truth of the portrait `view` of `YAWS`, which is taken now unless it is there
    already. Raises InputError when it cannot be written."""
    source = MakeHumanSource(NUMBER + 1, None)
    subject = source.subject(NUMBER, SEED)
    person = json.loads(json.dumps(subject.description))
    identity = Identity(source.name, NUMBER, SEED, subject.group, person, "unknown", hair=False, clothes=True)
    pose = Pose(YAWS[view], pitch=2.0, focal_35mm=FOCAL_35MM, extent=4.6)
    title = f"{identity.title}_studio"
    shot = Shot(title, identity, pose, "studio", "side", environment=None, primary=True, seed=SEED)
    out = folder / view
    for name in ("photos", "truth"):
        (out / name).mkdir(parents=True, exist_ok=True)
    take_portraits(Sitting(partial(rebuild_subject, source, identity), [shot]), out, _PHOTO)
    return truth_of(out, shot.name)
