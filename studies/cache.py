"""Results of measurements as JSON files, measured again only when what they depend on has changed."""

import hashlib
import json
from collections.abc import Callable
from pathlib import Path

from sira_mi.files import write_through


def fingerprint(*parts: Path | str) -> str:
    """A short hash of texts and of the contents of files."""
    digest = hashlib.sha256()
    for part in parts:
        digest.update(part.read_bytes() if isinstance(part, Path) else part.encode())
        digest.update(b"\0")
    return digest.hexdigest()[:16]


def cached(path: Path, key: str, compute: Callable[[], dict], files: tuple[Path, ...] = ()) -> dict:
    """The result that `path` holds under `key`; otherwise that of `compute()`, which is written there. `files` are
    further files that `compute` writes: if one is missing, it is called again."""
    stored = read(path)
    if stored is not None and stored.get("key") == key and all(file.exists() for file in files):
        return stored["result"]
    result = compute()
    path.parent.mkdir(parents=True, exist_ok=True)
    text = json.dumps({"key": key, "result": result}, indent=1)
    write_through(path, lambda file: file.write_text(text, encoding="utf-8"))
    return json.loads(text)["result"]


def read(path: Path) -> dict | None:
    """`{"key": ..., "result": ...}` of a file by `cached`; None when there is none or it is damaged."""
    try:
        stored = json.loads(path.read_text(encoding="utf-8"))
        return stored if isinstance(stored["result"], dict) else None
    except (OSError, ValueError, KeyError, TypeError):
        return None
