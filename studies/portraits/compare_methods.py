"""The benchmark's portraits, fitted by every method and scored against the truth: rows for the results page."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import mitsuba as mi
import numpy as np
from tqdm import tqdm

from sira_mi.avatar.file import PRIOR, load_avatar
from sira_mi.errors import InputError
from sira_mi.fit.settings import QUALITIES
from sira_mi.portrait.camera import Camera
from sira_mi.portrait.portrait import PortraitSettings, make_portrait
from studies.cache import fingerprint, load_or_compute
from studies.portraits.appearance_scores import PredictedAppearance, score_appearance
from studies.portraits.benchmark import photo_of, read_benchmark, truth_of
from studies.portraits.fit_job import Job
from studies.portraits.geometry_scores import PredictedHead, score_geometry, true_surface
from studies.portraits.methods import BY_NAME, METHODS
from studies.portraits.run_fit import run
from studies.portraits.truth import Truth, load_truth

MEAN_HEAD = "mean head"
_VERSION = "1"


@dataclass(frozen=True)
class Comparison:
    """The portraits and methods to compare, and their settings."""

    benchmark: Path
    runs: Path  # folder of the fits
    quality: str = "standard"
    methods: tuple[str, ...] = tuple(method.name for method in METHODS)
    prior: Path = PRIOR
    primary: bool = True  # one portrait of each identity, not all of its lights
    only: tuple[str, ...] = ()  # names of portraits; all when empty
    seed: int = 0
    variant: str = "llvm_ad_rgb"


def compare(comparison: Comparison) -> list[dict]:
    """Fits and scores: rows of `portrait`, `identity`, `light`, `method`, `scores`, and of a fit `seconds` by stage,
    `total_seconds` and `peak_memory_megabytes`, or its `error`. Results on disk are used."""
    methods = _complete(comparison.methods)
    entries = [
        entry
        for entry in read_benchmark(comparison.benchmark)
        if (entry["name"] in comparison.only if comparison.only else entry["primary"] or not comparison.primary)
    ]
    if not entries:
        raise InputError(f"{comparison.benchmark} has no such portraits")
    rows = []
    with tqdm(total=len(entries) * (1 + len(methods)), desc="fits", unit="fit") as bar:
        for entry in entries:
            for row in _portrait_rows(comparison, entry, methods):
                rows.append(row)
                bar.set_postfix_str(f"{row['portrait']} {row['method']}")
                bar.update()
    return rows


def _complete(names: Sequence[str]) -> list[str]:
    """The methods and those that they continue from, in the order of `METHODS`."""
    if unknown := set(names) - set(BY_NAME):
        raise InputError(f"unknown methods {', '.join(sorted(unknown))}; known are {', '.join(BY_NAME)}")
    wanted: set[str] = set()
    for first in names:
        name: str | None = first
        while name is not None and name not in wanted:
            wanted.add(name)
            name = BY_NAME[name].after
    return [method.name for method in METHODS if method.name in wanted]


def _portrait_rows(comparison: Comparison, entry: dict, methods: list[str]):
    photo = photo_of(comparison.benchmark, entry["name"])
    truth_file = truth_of(comparison.benchmark, entry["name"]) / "truth.npz"
    truth = surface = None

    def score(path: Path, key: str, head) -> dict:
        def compute() -> dict:
            nonlocal truth, surface
            truth = truth or load_truth(truth_file)
            surface = surface or true_surface(truth)
            geometry, appearance = head(truth)
            scores = score_geometry(geometry, truth, surface)
            return scores if appearance is None else scores | score_appearance(appearance, truth)

        return load_or_compute(path, fingerprint(_VERSION, key, truth_file), compute)

    described = {"portrait": entry["name"], "identity": entry["identity"], "light": entry["light"]}
    mean = comparison.runs / entry["name"] / "mean_head.json"
    key = fingerprint(comparison.prior, photo)
    scores = score(mean, key, lambda truth: (mean_head(photo, comparison.prior), None))
    yield {**described, "method": MEAN_HEAD, "scores": scores}
    for name in methods:
        method = BY_NAME[name]
        out = comparison.runs / entry["name"] / name
        job = Job(
            photo,
            name,
            comparison.prior,
            QUALITIES[comparison.quality],
            out,
            None if method.after is None else out.with_name(method.after),
            comparison.seed,
            comparison.variant,
        )
        result = run(job)
        row = {**described, "method": name, **{k: v for k, v in result.items() if k not in ("key", "losses")}}
        if "error" not in result:
            read = partial(_read_head, out, method.after is not None)
            row["scores"] = score(out / "scores.json", result["key"], read)
        yield row


def mean_head(photo: Path, prior_path: Path) -> PredictedHead:
    """The baseline: the prior's mean head in the camera estimated from the photo's landmarks."""
    prior = load_avatar(prior_path)
    portrait = make_portrait(photo, PortraitSettings(), prior.tensors["landmarks"])
    head = mi.load_dict({"type": "neural_sdf", "avatar": str(prior_path), "voxel": 0.05})
    faces = head.faces()
    return PredictedHead(head.vertices().T, faces, prior.tensors["landmarks"], portrait.camera)


def _read_head(out: Path, with_appearance: bool, truth: Truth) -> tuple[PredictedHead, PredictedAppearance | None]:
    height, width = truth.mask.shape
    with np.load(out / "head.npz", allow_pickle=False) as data:
        camera = Camera(data["K"], data["world_to_camera"], width, height)
        image = {name.removeprefix("image/"): data[name] for name in data.files if name.startswith("image/")}
        head = PredictedHead(data["vertices"], data["faces"], data["landmarks"], camera, image["normal"], image["mask"])
    if not with_appearance:
        return head, None
    names = ("final", "diffuse_albedo", "specular_albedo", "mask")
    shaded = image["diffuse"] + image["specular"]
    return head, PredictedAppearance(**{name: image[name] for name in names}, shaded=shaded)
