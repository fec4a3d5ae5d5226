"""The figures behind the pages of `docs/`: JSON files under `docs/data/`, each with the revision that was measured."""

import json
import subprocess
from datetime import datetime, timezone
from pathlib import Path

from sira_mi.errors import InputError
from studies.cache import write_json


def write_figures(path: Path, figures: dict) -> dict:
    """Writes figures preceded by `measured`, today's date and the revision; returns what was written."""
    dated = {"measured": {"revision": current_revision(), "date": f"{datetime.now(timezone.utc):%Y-%m-%d}"}, **figures}
    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(path, dated)
    return dated


def read_figures(path: Path) -> dict:
    """The figures of a file by `write_figures`. Raises InputError when it is missing or damaged."""
    try:
        figures = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(figures["measured"], dict):
            raise ValueError("no record of when it was measured")
        return figures
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path} holds no figures of a study: {error}; measure them first") from error


def current_revision() -> str:
    """The checkout's revision, with `-dirty` when files are changed; `unknown` outside a Git checkout."""
    command = ["git", "describe", "--always", "--dirty", "--exclude=*"]
    try:
        found = subprocess.run(command, cwd=Path(__file__).parent, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return found.stdout.strip()
