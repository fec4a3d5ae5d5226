"""Heads drawn from the vendored MakeHuman pack (CC0): any number of them."""

from dataclasses import dataclass
from pathlib import Path

from sira_mi.training.collection.landmarks import mesh_landmarks
from sira_mi.training.collection.makehuman import ANCESTRIES
from sira_mi.training.collection.person import Person, make_person
from sira_mi.training.collection.subject import Subject

# Share of an ancestry, or of a sex, from which a head counts to its group.
CLEAR_SHARE = 0.6
AGES = ((35.0, "18-35"), (55.0, "35-55"), (float("inf"), "over 55"))


@dataclass(frozen=True)
class MakeHumanSource:
    heads: int
    hair: Path | None  # folder of hair meshes; without it every head is bald or shaven
    name: str = "makehuman"
    licence: str = "CC0-1.0 (MakeHuman base mesh, targets and hair; procedural appearance)"

    def count(self) -> int:
        return self.heads

    def title(self, number: int) -> str:
        return f"{self.name}/{number:04d}"

    def subject(self, number: int, seed: int) -> Subject:
        person = make_person(seed, self.hair)
        landmarks, valid = mesh_landmarks(person.head)
        return Subject(
            self.title(number),
            person.parts,
            landmarks,
            valid,
            find_group(person),
            person.description(),
            self.licence,
        )


def find_group(person: Person) -> dict[str, str]:
    """Ancestry, sex and age band; "mixed" where no share is clear."""
    traits = person.traits
    ancestry = max(range(len(ANCESTRIES)), key=lambda k: traits.ancestry[k])
    male = traits.male
    return {
        "ancestry": ANCESTRIES[ancestry] if traits.ancestry[ancestry] >= CLEAR_SHARE else "mixed",
        "sex": "male" if male >= CLEAR_SHARE else "female" if male <= 1 - CLEAR_SHARE else "mixed",
        "age": next(band for limit, band in AGES if traits.years < limit),
    }
