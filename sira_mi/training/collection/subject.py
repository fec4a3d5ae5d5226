"""The person that a source of heads delivers: closed surfaces with materials, landmarks and provenance."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from sira_mi.training.collection.render import Part


@dataclass(frozen=True)
class Subject:
    """A head in the project's frame: scene units of 100 mm, origin between the ears, +y up, +z front."""

    name: str  # unique within the collection, SOURCE/…
    parts: list[Part]
    landmarks: np.ndarray  # [468, 3] scene units
    landmarks_valid: np.ndarray  # [468] bool
    group: dict[str, str]  # "ancestry", "sex" and "age"; "unknown" where the source does not say
    description: dict  # JSON types: all random choices
    licence: str


class BrokenHead(ValueError):
    """A head that cannot be used; its message is the reason, which the manifest lists."""


class Source(Protocol):
    """Identities of one kind. Holds only paths and numbers, so that it can be sent to worker processes."""

    @property
    def name(self) -> str:
        """Name of the source, the first part of its scenes' file names."""

    @property
    def licence(self) -> str:
        """Licence of its heads, one line."""

    def count(self) -> int:
        """Number of identities."""

    def title(self, number: int) -> str:
        """Name of identity `number`, SOURCE/…, that its subject has."""

    def subject(self, number: int, seed: int) -> Subject:
        """Identity `number` with a look drawn from `seed`. Raises `BrokenHead` when it cannot be used."""
