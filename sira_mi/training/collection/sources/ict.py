"""ICT-FaceKit identities (MIT, © 2020 USC ICT) on the MakeHuman topology, with painted skin, eyes, clothes and hair."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sira_mi.training.collection.ict import ict_control, sample_coefficients
from sira_mi.training.collection.landmarks import mesh_landmarks
from sira_mi.training.collection.look import Traits
from sira_mi.training.collection.person import dress
from sira_mi.training.collection.subject import Subject


@dataclass(frozen=True)
class IctSource:
    path: Path  # npz of the mean, the identity modes and the triangles
    heads: int
    hair: Path | None  # folder of MakeHuman hair meshes
    name: str = "ict"
    licence: str = "MIT, © 2020 USC ICT (ICT-FaceKit identities); CC0-1.0 hair; procedural appearance"

    def count(self) -> int:
        return self.heads

    def title(self, number: int) -> str:
        return f"{self.name}/{number:04d}"

    def subject(self, number: int, seed: int) -> Subject:
        random = np.random.default_rng([seed, 11])
        coefficients = sample_coefficients(random)
        # The modes are not labelled: the look is drawn independently of the shape.
        traits = Traits(
            years=float(random.uniform(20, 60)),
            male=float(random.random()),
            ancestry=tuple(float(a) for a in random.dirichlet((0.4, 0.4, 0.4))),
        )
        person = dress(ict_control(self.path, coefficients), traits, random, self.hair)
        landmarks, valid = mesh_landmarks(person.head)
        return Subject(
            self.title(number),
            person.parts,
            landmarks,
            valid,
            {"ancestry": "unknown", "sex": "unknown", "age": "unknown"},
            person.description() | {"coefficients": [round(float(c), 4) for c in coefficients]},
            self.licence,
        )
