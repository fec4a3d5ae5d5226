"""Fits portraits, each fit in a process of its own, and keeps the results on disk.

RUNS/PORTRAIT/METHOD holds what `fit_by_method` writes, and `fit.json`: times and memory, or why the fit failed.
"""

import multiprocessing
import shutil
import time

import mitsuba as mi

from sira_mi.errors import InputError
from sira_mi.fit.memory import peak_memory
from studies.cache import write_json
from studies.portraits.fit_job import Job


def run(job: Job) -> dict:
    """The result of `job`, fitted now unless it is on disk already. A fit that fails has a result too: its `error`."""
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
        from studies.portraits.fit_by_method import fit_and_write  # its plugins need the variant

        result |= fit_and_write(job)
    except InputError as error:
        result["error"] = str(error)
    result["total_seconds"] = round(time.monotonic() - started, 2)
    result["peak_memory_megabytes"] = round(peak_memory() / 2**20)
    write_json(job.out / "fit.json", result)
