"""Makes the rows of a benchmark: runs their commands and renders their pictures, portrait by portrait.

Results are kept on disk. What has failed is kept too, with its error.
"""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from sira_mi.files import read_exr, write_exr
from sira_mi.interrupts import INTERRUPTED
from sira_mi.portrait.load import load_photo
from studies.cache import fingerprint, load_or_compute, write_json
from studies.portraits.photo_frame import read_frame
from studies.portraits.rows import BY_NAME, Case, Row
from studies.portraits.truth import VIEWS

SAMPLES = 64  # a pixel, of relit pictures


def make_rows(cases: Sequence[Case], rows: Sequence[Row], workers: int) -> Iterator[dict]:
    """Yields what `make_row` returns for each portrait and row as it is done, `workers` portraits at a time."""
    with ThreadPoolExecutor(workers) as pool:  # of threads: the work is done by processes
        try:
            done = pool.map(lambda case: [make_row(case, row) for row in rows], cases)
            for results in done:
                yield from results
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


def make_row(case: Case, row: Row) -> dict:
    """One row of a portrait, made now as far as it is not on disk: `portrait` and `row`, their names, and what
    `run_row` returns; `relight_cpu_seconds` of the pictures, whose `error` becomes the row's."""
    result = run_row(case, row)
    if row.has_avatar and "error" not in result:
        folder = case.folder(row.name)
        pictures = tuple(folder / f"{view}.exr" for view in VIEWS)
        key = fingerprint(str(SAMPLES), folder / "row.json", *case.lights)
        rendered = load_or_compute(folder / "pictures.json", key, lambda: relight(case, row), pictures)
        if "error" in rendered:
            write_json(folder / "row.json", {**read_row(folder), **rendered})
        result |= rendered
    return {"portrait": case.name, "row": row.name, **result}


def run_row(case: Case, row: Row) -> dict:
    """Runs the command of a row unless its result is on disk, after that of the row which it goes on from. Returns
    `cpu_seconds`, `wall_seconds` and `peak_memory_megabytes` of all of these commands, or the `error`."""
    before = {} if row.after is None else run_row(case, BY_NAME[row.after])
    folder, key = case.folder(row.name), case.key(row)
    result = read_row(folder)
    if result.get("key") != key:
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        failed = {"error": f"{row.after}: {before['error']}"} if "error" in before else None
        cost: dict = failed or run_measured(case.fill(row), folder / "log.txt")
        for name, join in (("cpu_seconds", sum), ("wall_seconds", sum), ("peak_memory_megabytes", max)):
            if name in before and name in cost:
                cost[name] = join((before[name], cost[name]))
        result = {"key": key, **cost}
        write_json(folder / "row.json", result)
    return {name: value for name, value in result.items() if name != "key"}


def read_row(folder: Path) -> dict:
    """What `row.json` says in the folder of a row; nothing where there is none."""
    try:
        stored = json.loads((folder / "row.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return stored if isinstance(stored, dict) else {}


def relight(case: Case, row: Row) -> dict:
    """Renders the views of a row's avatar: `relight_cpu_seconds`, or the `error`."""
    folder, seconds = case.folder(row.name), 0.0
    frame = read_frame(folder / "avatar")
    height, width = load_photo(case.places(row)["photo"]).image.shape[:2]
    for view, (light, yaw) in VIEWS.items():
        picture = folder / f"{view}.exr"
        command = ["-m", "sira_mi.relight", str(folder / "avatar"), "--lights", str(case.lights[light])]
        command += ["--integrator", "path", "--spp", str(SAMPLES), "--view", "photo", "--size", str(frame.longer_side)]
        command += ["--yaw", str(yaw), "--out", str(picture), "--variant", case.variant]
        cost = run_measured(command, folder / "relight.txt")
        if "error" in cost:
            return {"error": f"{view}: {cost['error']}"}
        write_exr(picture, frame.lay_on_photo(read_exr(picture)[0], width, height))
        seconds += cost["cpu_seconds"]
    return {"relight_cpu_seconds": round(seconds, 1)}


def run_measured(arguments: Sequence[str], log: Path) -> dict:
    """Runs Python with `arguments`, its output into `log`: `cpu_seconds` of all its cores, `wall_seconds` and
    `peak_memory_megabytes`, and its last line as the `error` when it fails. Raises KeyboardInterrupt when it was
    interrupted."""
    started = time.monotonic()
    with log.open("wb") as output:
        process = subprocess.Popen(
            [sys.executable, *arguments], stdin=subprocess.DEVNULL, stdout=output, stderr=subprocess.STDOUT
        )
        _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode in (INTERRUPTED, -signal.SIGINT):
        raise KeyboardInterrupt
    cost: dict = {
        "cpu_seconds": round(usage.ru_utime + usage.ru_stime, 1),
        "wall_seconds": round(time.monotonic() - started, 1),
        "peak_memory_megabytes": round(usage.ru_maxrss / 1024),
    }
    if process.returncode != 0:
        lines = log.read_text(encoding="utf-8", errors="replace").split("\n")
        last = next((line for line in reversed(lines) if line.strip()), "it printed nothing")
        cost["error"] = f"exit code {process.returncode}: {last.strip().removeprefix('error: ')}"
    return cost
