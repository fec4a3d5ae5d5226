"""Heads of the benchmark `foreign`: VALID avatars with expressions and, on some, other hair.

An avatar's morphs are NAME_morphs.npz: `names`, of which number k moves vertices `idx[off[k]:off[k + 1]]` of NAME.npz
by `d[…] / MORPH_STEPS` metres. Some files prefix a name with its mesh and a point.
"""

import zipfile
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from sira_mi.errors import InputError
from sira_mi.training.collection.annotation import mean_control, mean_head
from sira_mi.training.collection.person import Cut, make_hair
from sira_mi.training.collection.regions import choose_edge_lengths, fill_missing_landmarks
from sira_mi.training.collection.registration import fit_sphere
from sira_mi.training.collection.skin import EYE, HAIR
from sira_mi.training.collection.sources.valid import EYES, Rendition, ValidSource, make_subject, shade_scalp
from sira_mi.training.collection.subject import BrokenHead, Subject
from sira_mi.training.collection.surface import head_surface

MORPH_STEPS = 20_000.0
TEXTURE_SIDE = 1024  # pixels, the avatars' own
# Scene units, longest edges around eyes, brows and mouth and on the rest of the face: colours are kept at vertices, and
# a texel of the avatars' textures is about as large as the first.
FINE_EDGE, FACE_EDGE = 0.012, 0.025
# Middle and half sizes of the fine regions in the project's frame, scene units.
FINE_BOXES = (((0.0, 0.27, 0.8), (0.65, 0.27, 0.45)), ((0.0, -0.47, 0.95), (0.38, 0.22, 0.35)))


@dataclass(frozen=True)
class Expression:
    """Weights of morphs, those with `{side}` for both sides, and where the eyes look."""

    morphs: dict[str, float] = field(default_factory=dict)
    gaze: tuple[float, float] = (0.0, 0.0)  # degrees to the head's own left, and up


def _speak(viseme: str, weight: float = 1.0, teeth: str | None = None) -> Expression:
    return Expression({f"{viseme}_h": weight, f"t_{teeth or viseme}_h": weight})


# Variants of each expression; a portrait has one of them.
EXPRESSIONS: dict[str, tuple[Expression, ...]] = {
    "neutral": (Expression(),),
    "closed_smile": (
        Expression({"{side}smileClose_h": 0.9, "{side}squint_h": 0.2}),
        Expression({"{side}smileClose_h": 0.6, "{side}squint_h": 0.1}),
    ),
    "open_smile": (
        Expression({"{side}smileOpen_h": 1.0, "{side}squint_h": 0.3, "MouthOpen_h": 0.1, "t_MouthOpen_h": 0.1}),
        Expression({"{side}smileOpen_h": 0.8, "{side}squint_h": 0.2, "MouthOpen_h": 0.3, "t_MouthOpen_h": 0.3}),
    ),
    "talking": (_speak("AE_AA"), _speak("AO_a"), _speak("UW_U"), _speak("S"), _speak("Ax_E"), _speak("FV")),
    "eyes_closed": (Expression({"{side}eyeClose_h": 1.0}),),
    "brows": (
        Expression({"{side}squint_h": 0.8, "{side}browDown_h": 0.6}),
        Expression({"{side}browUp_h": 0.9, "{side}eyeOpen_h": 0.3}),
    ),
    "aside": (Expression(gaze=(24.0, 3.0)), Expression(gaze=(-24.0, -4.0)), Expression(gaze=(-15.0, 9.0))),
}


EYE_STRENGTH = 0.3  # specular, of the tear film: a reflectance of 0.024
# MakeHuman's hair on avatars whose own hair is close to the head, or a bun of the same colour.
STYLES = {
    "Black_F_3": "short04",
    "Black_M_1": "afro01",
    "Black_M_2": "short02",
    "MENA_F_1": "bob02",
    "MENA_M_1": "short03",
    "White_F_2": "long01",
    "X_AIAN_F_1": "braid01",
    "X_NHPI_M_1": "short01",
}
BLACK_HAIR = np.array([0.022, 0.017, 0.014])  # albedo of hair on a bald head
FRINGE = 0.5  # scene units, height above which hair may cover the forehead
GLABELLA = 9  # landmark between the brows
ROOM = 1.015  # by which hair is larger than the head beneath it
# Heights and widths at which heads are measured for hair, scene units: over the ears, beside a bun.
OVER_EARS, BESIDE_BUN = (0.45, 0.95), (0.3, 0.65)


@dataclass(frozen=True)
class ForeignHeads:
    """The avatars, and the folders of their morphs and of MakeHuman's hair."""

    avatars: ValidSource
    morphs: Path
    hair: Path

    def check(self) -> None:
        """Raises InputError unless there are avatars, and morphs and hair for them all."""
        self.avatars.count()
        for number in range(len(self.avatars.files())):
            for path in self.files_of(number):
                if not path.is_file():
                    raise InputError(f"{path} is missing; see the folders that --valid, --morphs and --hair name")

    def style_of(self, number: int) -> str:
        """The hair that an avatar wears: MakeHuman's by name, a "wig", or its "own"."""
        path = self.avatars.files()[number]
        return STYLES.get(path.stem) or ("wig" if path.with_name(f"{path.stem}_wig.jpg").is_file() else "own")

    def files_of(self, number: int) -> list[Path]:
        """The files that an avatar is made of."""
        path, style = self.avatars.files()[number], self.style_of(number)
        files = [path, path.with_suffix(".jpg"), self._morphs_of(path)]
        if style == "wig":
            files.append(path.with_name(f"{path.stem}_wig.jpg"))
        elif style != "own":
            files += [self.hair / style / f"{style}.{ending}" for ending in ("mhclo", "obj")]
        return files

    def _morphs_of(self, avatar: Path) -> Path:
        return self.morphs / f"{avatar.stem}_morphs.npz"

    def make_subject(self, number: int, seed: int, expression: str = "neutral", variant: int = 0) -> Subject:
        """An avatar with a variant, counted round, of an expression of `EXPRESSIONS`. Raises InputError when its files
        cannot be used."""
        path, variants = self.avatars.files()[number], EXPRESSIONS[expression]
        try:
            move = find_motion(path, self._morphs_of(path), variants[variant % len(variants)])
            rendition = Rendition(move, teeth=True, texture_side=TEXTURE_SIDE, choose_edges=choose_fine_edges)
            subject = make_subject(path, self.avatars.title(number), seed, self.avatars.licence, rendition)
        except BrokenHead as error:
            raise InputError(f"{path}: {error}; copy the avatar again") from error
        parts = [
            replace(part, specular=np.full(len(part.vertices), EYE_STRENGTH)) if (part.region == EYE).all() else part
            for part in subject.parts
        ]
        subject = replace(subject, parts=parts)
        return put_on_hair(subject, STYLES[path.stem], self.hair, seed) if path.stem in STYLES else subject


def choose_fine_edges(middle: np.ndarray) -> np.ndarray:
    """Longest edge [E] at midpoints [E, 3] in the project's frame."""
    longest = choose_edge_lengths(middle)
    face = (np.abs(middle[:, 0]) < 0.9) & (middle[:, 1] > -1.0) & (middle[:, 2] > 0.2)
    longest = np.where(face, np.minimum(longest, FACE_EDGE), longest)
    for centre, size in FINE_BOXES:
        longest = np.where((np.abs(middle - centre) < size).all(1), FINE_EDGE, longest)
    return longest


def put_on_hair(subject: Subject, style: str, folder: Path, seed: int) -> Subject:
    """The subject with a hair mesh of MakeHuman's in the colour of its own hair."""
    head, marks = subject.parts[0], fill_missing_landmarks(subject.landmarks, subject.landmarks_valid)
    region = np.zeros(len(head.vertices), int)
    region[head.triangles] = head.region[:, None]
    own = head.albedo[region == HAIR]
    colour = np.median(own, axis=0) if len(own) > len(region) // 100 else BLACK_HAIR
    random = np.random.default_rng([seed, 33])
    cut = Cut(style, mirrored=bool(random.random() < 0.5), length=-9.0, fringe=FRINGE, volume=1.0)
    hair = make_hair(cut, folder, fit_base_head(head.vertices, marks), colour, random)
    return replace(subject, parts=[shade_scalp(head, hair, region, marks), *subject.parts[1:], hair])


def fit_base_head(vertices: np.ndarray, landmarks: np.ndarray) -> np.ndarray:
    """Base-mesh vertices [19158, 3] of MakeHuman's mean head, scaled along each axis to the width, height and depth of
    the head of vertices [N, 3] with landmarks [468, 3]."""
    control = mean_control()
    (mean, target), mean_marks = (head_surface(control)[0], vertices), mean_head()[0]
    sides, tops, backs = zip(*(measure_head(head) for head in (mean, target)), strict=True)
    brow, target_brow = mean_marks[GLABELLA], landmarks[GLABELLA]
    scale = ROOM * np.array(
        [
            sides[1] / sides[0],
            (tops[1] - target_brow[1]) / (tops[0] - brow[1]),
            (target_brow[2] - backs[1]) / (brow[2] - backs[0]),
        ]
    )
    fitted = (control - brow) * scale
    fitted[:, 1] = np.where(fitted[:, 1] > 0, fitted[:, 1], control[:, 1] - brow[1])
    return fitted + target_brow * [0, 1, 1] + brow * scale * [1, 0, 0]


def measure_head(vertices: np.ndarray) -> tuple[float, float, float]:
    """Half the width over the ears, the height of the top, and the depth of the back beside a bun, of a head's vertices
    [N, 3]."""
    across, up, _ = np.abs(vertices[:, 0]), vertices[:, 1], vertices[:, 2]
    over_ears = (up > OVER_EARS[0]) & (up < OVER_EARS[1])
    beside = over_ears & (across > BESIDE_BUN[0]) & (across < BESIDE_BUN[1])
    middle = (across < BESIDE_BUN[0]) & (vertices[:, 2] > -0.3) & (vertices[:, 2] < 0.6)
    return float(across[over_ears].max()), float(up[middle].max()), float(vertices[beside, 2].min())


def find_motion(avatar: Path, morphs: Path, expression: Expression) -> np.ndarray:
    """Metres [N, 3] by which an expression moves the vertices of an avatar's file. Raises BrokenHead when the files do
    not have what it takes."""
    try:
        with np.load(avatar, allow_pickle=False) as data:
            vertices, faces, part = (data[name] for name in ("v", "f", "part"))
            parts = [str(name) for name in data["part_names"]]
        with np.load(morphs, allow_pickle=False) as data:
            names = [str(name).rpartition(".")[2] for name in data["names"]]
            off, idx, d = (data[name] for name in ("off", "idx", "d"))
        motion = np.zeros(vertices.shape)
        for pattern, weight in expression.morphs.items():
            for name in {pattern.format(side=side) for side in "LR"}:
                k = names.index(name)
                motion[idx[off[k] : off[k + 1]]] += weight / MORPH_STEPS * d[off[k] : off[k + 1]]
        left, up = expression.gaze
        turn = Rotation.from_euler("YX", [left, -up], degrees=True)
        for name in EYES:
            eye = np.unique(faces[part == parts.index(name)])
            centre, _ = fit_sphere(vertices[eye].astype(float))
            motion[eye] += turn.apply(vertices[eye] - centre) - (vertices[eye] - centre)
    except (OSError, ValueError, KeyError, IndexError, EOFError, zipfile.BadZipFile) as error:
        raise BrokenHead(f"{morphs.name} does not move it ({error})") from None
    return motion
