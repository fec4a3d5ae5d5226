"""Fits of the benchmark's portraits by every method, each in a process of its own, kept on disk.

A fit leaves in RUNS/PORTRAIT/METHOD what `fitted_head` writes, and `fit.json`: times, memory, or why it failed.
"""

import json
import multiprocessing
import resource
import shutil
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import mitsuba as mi

from sira_mi.errors import InputError
from sira_mi.files import write_through
from sira_mi.fit.settings import APPEARANCE, GEOMETRY, POLISH, SHADING, FitSettings
from studies.cache import fingerprint
from studies.portraits.methods import BY_NAME


@dataclass(frozen=True)
class Job:
    """One fit."""

    photo: Path
    method: str
    prior: Path
    settings: FitSettings
    out: Path  # RUNS/PORTRAIT/METHOD
    before: Path | None  # folder of the fit that it goes on from
    seed: int = 0
    variant: str = "llvm_ad_rgb"

    def key(self) -> str:
        """What the result depends on; weights of a kind of stages count where the method has such a stage, those of
        the geometry in the shading stage too."""
        settings = BY_NAME[self.method].settings(self.settings)
        kinds = {GEOMETRY if kind == SHADING else kind for kind, _ in settings.stages}
        optional = {GEOMETRY, APPEARANCE, POLISH} - kinds
        used = {name: value for name, value in asdict(settings).items() if name not in optional}
        described = json.dumps([self.method, self.seed, used])
        before = [self.before / "fit.json"] if self.before else []
        return fingerprint(described, self.photo, self.prior, *before)

    def result(self) -> dict | None:
        """`fit.json` if this very fit is done, else None."""
        try:
            stored = json.loads((self.out / "fit.json").read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return None
        return stored if stored.get("key") == self.key() else None


def run(job: Job) -> dict:
    """The result of `job`, fitted now unless it is there already. A fit that fails is a result too: its `error` says
    why."""
    if (stored := job.result()) is not None:
        return stored
    shutil.rmtree(job.out, ignore_errors=True)
    job.out.mkdir(parents=True)
    process = multiprocessing.get_context("spawn").Process(target=_fit, args=(job,))
    process.start()
    process.join()
    result = job.result()
    if result is None:
        raise RuntimeError(f"the process of {job.out} ended with code {process.exitcode}")
    return result


def _fit(job: Job) -> None:
    mi.set_variant(job.variant)
    started = time.monotonic()
    result: dict = {"key": job.key()}
    try:
        from studies.portraits.fitted_head import fit_and_write  # its plugins need the variant

        result |= fit_and_write(job)
    except InputError as error:
        result["error"] = str(error)
    result["total_seconds"] = round(time.monotonic() - started, 2)
    result["peak_memory_megabytes"] = round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
    text = json.dumps(result, indent=1)
    write_through(job.out / "fit.json", lambda file: file.write_text(text, encoding="utf-8"))
