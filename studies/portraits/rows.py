"""The rows of the benchmark, as data: what is run for each of its portraits, and what that depends on.

RUNS/ROW/PORTRAIT/row.json       cost of the command, or why it failed
RUNS/ROW/PORTRAIT/log.txt        what it printed
RUNS/ROW/PORTRAIT/avatar         the folder of its fit, if it is one
RUNS/ROW/PORTRAIT/head.npz       the head of a row that has no appearance
RUNS/ROW/PORTRAIT/VIEW.exr       linear radiance of the head in a view of `truth.VIEWS`, at the photo's pixels
RUNS/ROW/PORTRAIT/pictures.json  cost of the pictures that are rendered from the avatar
RUNS/ROW/PORTRAIT/scores.json    the scores
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from sira_mi.avatar.file import PRIOR
from sira_mi.errors import InputError
from studies.cache import fingerprint
from studies.portraits.benchmark import camera_of, photo_of, truth_of
from studies.portraits.methods import METHODS

PAPER = "b.7"  # of the methods: the paper's, as far as it stands here
# The files that a command may take, by the names of `Case.places`.
_INPUTS = ("photo", "camera", "prior", "light_1", "light_2", "truth")


@dataclass(frozen=True)
class Row:
    """One row."""

    name: str  # of its folder
    title: str
    command: tuple[str, ...]  # arguments of Python, with names of `Case.places` in braces
    after: str | None = None  # the row whose folder the command takes as {before}
    has_avatar: bool = True  # its pictures are those that `python -m sira_mi.relight` renders of {row}/avatar


@dataclass(frozen=True)
class Case:
    """A portrait of a benchmark, and where its rows are."""

    benchmark: Path
    runs: Path
    entry: dict  # of `benchmark.json`
    prior: Path = PRIOR
    variant: str = "llvm_ad_rgb"

    @property
    def name(self) -> str:
        return self.entry["name"]

    @property
    def lights(self) -> tuple[Path, ...]:
        """The files of the two environments that the portrait is relit under."""
        return tuple(self.benchmark / "lights" / f"{name}.exr" for name in self.entry["relights"])

    @property
    def truth(self) -> Path:
        """The folder of the portrait's truth."""
        return truth_of(self.benchmark, self.name)

    def folder(self, row: str) -> Path:
        return self.runs / row / self.name

    def places(self, row: Row) -> dict[str, Path | str]:
        """What the braces of a row's command stand for."""
        first, second = self.lights
        return {
            "photo": photo_of(self.benchmark, self.name),
            "camera": camera_of(self.benchmark, self.name),
            "prior": self.prior,
            "light_1": first,
            "light_2": second,
            "truth": self.truth / "truth.npz",
            "variant": self.variant,
            "row": self.folder(row.name),
            "before": self.folder(row.after or ""),
        }

    def fill(self, row: Row) -> list[str]:
        """The arguments of a row's command."""
        return [part.format(**self.places(row)) for part in row.command]

    def key(self, row: Row) -> str:
        """Hash of the command, of the contents of all files that it takes, and of the run that it goes on from. It says
        nothing of the code: after a change to that, throw the row's folder away."""
        places = self.places(row)
        inputs = [Path(places[name]) for name in _INPUTS if f"{{{name}}}" in row.command]
        before = [self.folder(row.after) / "row.json"] if row.after else []
        try:
            return fingerprint(json.dumps(row.command), *inputs, *before)
        except OSError as error:
            raise InputError(f"{error.filename}: {error.strerror}; build the benchmark again") from error


def _fit(*options: str) -> tuple[str, ...]:
    request = ("-m", "sira_mi.fit", "{photo}", "--out", "{row}/avatar", *options)
    return (*request, "--prior", "{prior}", "--variant", "{variant}")


def _method(name: str, after: str | None) -> tuple[str, ...]:
    start = ("--after", "{before}") if after else ()
    request = ("-m", "studies.portraits.fit_by_method", name, "{photo}", "--out", "{row}", *start)
    return (*request, "--prior", "{prior}", "--variant", "{variant}")


def _baseline(name: str, *options: str) -> tuple[str, ...]:
    request = ("-m", "studies.portraits.baselines", name, "{photo}", "--out", "{row}", *options)
    return (*request, "--variant", "{variant}")


def _picture(name: str, *options: str) -> tuple[str, ...]:
    return _baseline(name, "--lights", "{light_1}", "{light_2}", *options)


_NORMALS = ("--head", "{before}")
# Of a draft, by `studies.portraits.ladder`: the rung and what is true in it.
LADDER = {
    "outline": "the outline true",
    "tone": "the tone of the skin true",
    "light": "the light of the photo true",
    "albedo": "the albedo true",
    "shape": "shape, pose and camera true",
    "all": "all of these true",
}


def _rung(name: str) -> Row:
    request = ("-m", "studies.portraits.ladder", name, "--truth", "{truth}", "--fit", "{before}", "--out", "{row}")
    command = (*request, "--lights", "{light_1}", "{light_2}", "--variant", "{variant}")
    return Row(f"true-{name}", f"fit, draft, {LADDER[name]}", command, "draft", False)


ROWS = (
    Row("photo", "the photo unchanged", _picture("photo"), has_avatar=False),
    Row("one-colour", "one colour, normals of a draft", _picture("one-colour", *_NORMALS), "draft", False),
    Row("page-of-code", "page of code, normals of a draft", _picture("page-of-code", *_NORMALS), "draft", False),
    Row(
        "page-of-code-mean-head",
        "page of code, normals of the mean head",
        _picture("page-of-code", *_NORMALS),
        "mean-head",
        False,
    ),
    Row(
        "page-of-code-true-tone",
        "page of code, normals of a draft, true tone of the skin",
        _picture("page-of-code", *_NORMALS, "--truth", "{truth}"),
        "draft",
        False,
    ),
    Row("mean-head", "mean head", _baseline("mean-head", "--prior", "{prior}"), has_avatar=False),
    Row("draft", "fit, draft", _fit("--quality", "draft")),
    Row("standard", "fit, standard", _fit("--quality", "standard")),
    Row("draft-camera", "fit, draft, camera known", _fit("--quality", "draft", "--camera", "{camera}")),
    *map(_rung, LADDER),
    *(
        Row(
            "paper" if method.name == PAPER else method.name,
            method.title,
            _method(method.name, method.after),
            method.after,
        )
        for method in METHODS
    ),
)
BY_NAME = {row.name: row for row in ROWS}
RUNGS = frozenset(f"true-{name}" for name in LADDER)


def select_rows(names: Sequence[str]) -> list[Row]:
    """The rows of these names. Raises InputError for unknown ones."""
    if unknown := set(names) - set(BY_NAME):
        raise InputError(f"unknown rows {', '.join(sorted(unknown))}; known are {', '.join(BY_NAME)}")
    return [BY_NAME[name] for name in names]
