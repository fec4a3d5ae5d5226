"""Results of measurements as JSON files, computed again only when what they depend on has changed."""

import hashlib
import json
from collections.abc import Callable
from pathlib import Path

from sira_mi.files import write_text


def fingerprint(*parts: Path | str) -> str:
    """A short hash of texts and of the contents of files."""
    digest = hashlib.sha256()
    for part in parts:
        digest.update(part.read_bytes() if isinstance(part, Path) else part.encode())
        digest.update(b"\0")
    return digest.hexdigest()[:16]


def load_or_compute(path: Path, key: str, compute: Callable[[], dict], files: tuple[Path, ...] = ()) -> dict:
    """The result that `path` holds under `key`; otherwise that of `compute()`, which is written there. `files` are
    further files that `compute` writes; when one is missing, it is called again."""
    stored = read(path)
    if stored is not None and stored.get("key") == key and all(file.exists() for file in files):
        return stored["result"]
    result = compute()
    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(path, {"key": key, "result": result})
    return json.loads(json.dumps(result))


def write_json(path: Path, value: dict | list) -> None:
    """Writes a value as JSON. Raises InputError when the place cannot be written."""
    write_text(path, json.dumps(value, indent=1, ensure_ascii=False) + "\n")


def read(path: Path) -> dict | None:
    """`{"key": ..., "result": ...}` of a file by `load_or_compute`; None when there is none or it is damaged."""
    try:
        stored = json.loads(path.read_text(encoding="utf-8"))
        return stored if isinstance(stored["result"], dict) else None
    except (OSError, ValueError, KeyError, TypeError):
        return None
