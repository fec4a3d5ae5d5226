"""One fit of a portrait by a method: its inputs, what its result depends on, and the result that is on disk."""

import json
from dataclasses import dataclass
from pathlib import Path

from sira_mi.fit.stage import FitSettings
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
    before: Path | None  # folder of the fit that it continues from
    seed: int = 0
    variant: str = "llvm_ad_rgb"

    def key(self) -> str:
        """Hash of everything that the result depends on."""
        settings = BY_NAME[self.method].settings(self.settings)
        described = json.dumps([self.method, self.seed, settings.describe()])
        before = [self.before / "fit.json"] if self.before else []
        return fingerprint(described, self.photo, self.prior, *before)

    def result(self) -> dict | None:
        """`fit.json` if this very fit is done, else None."""
        try:
            stored = json.loads((self.out / "fit.json").read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return None
        return stored if stored.get("key") == self.key() else None
