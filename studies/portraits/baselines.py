"""`python -m studies.portraits.baselines photo|one-colour|page-of-code|mean-head …`: the pictures and the head of the
benchmark's baselines, at the pixels of the photo.

`photo` leaves the photo as it is. `one-colour` lights a head of one skin colour, `page-of-code` relights the photo by
`studies.portraits.page_of_code`; both take their normals from the folder of a row with a head. `mean-head` writes the
prior's mean head before the camera that the photo's landmarks give.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import trimesh

from sira_mi.conventions import MILLIMETRES_PER_UNIT
from sira_mi.errors import CommandParser, InputError, run_command
from sira_mi.export.scene import orbit
from sira_mi.files import write_exr, write_through
from sira_mi.portrait.camera import Camera, yaw_rotation
from sira_mi.portrait.load import load_photo
from sira_mi.sg.lights_io import read_environment
from sira_mi.training.collection.skin import SKIN
from studies.measures import SHOULDERS
from studies.portraits.page_of_code import MEAN_SKIN, divide_by_shading, shade
from studies.portraits.photo_frame import PhotoFrame, read_frame
from studies.portraits.relit_lights import exposure_of
from studies.portraits.truth import VIEWS, load_truth

if TYPE_CHECKING:
    from studies.portraits.visible_surface import MeshImages

# Views that the photo itself shows the head in.
UNTURNED = {view: light for view, (light, yaw) in VIEWS.items() if yaw == 0}

MIDDLE = 60.0  # mm around the nose: from the brows to the chin, where a face is mostly skin


@dataclass(frozen=True, eq=False)
class Head:
    """A head before the camera of a photo."""

    vertices: np.ndarray  # [N, 3] scene units
    faces: np.ndarray  # [T, 3]
    camera: Camera  # at the photo's pixels

    @property
    def nose(self) -> np.ndarray:
        """The foremost vertex above the shoulders, [3]."""
        above = self.vertices[self.vertices[:, 1] > SHOULDERS]
        return above[np.argmax(above[:, 2])]

    def draw(self, yaw_degrees: float = 0.0) -> MeshImages:
        """Mask and normals of the head turned to its left."""
        from studies.portraits.visible_surface import MeshImages, mesh_images

        seen = mesh_images(self.vertices, self.faces, orbit(self.camera, yaw_degrees))
        turn = yaw_rotation(yaw_degrees).T
        return MeshImages(seen.mask, seen.position @ turn, seen.normal @ turn)


def read_head(row: Path, width: int, height: int) -> Head:
    """The head that a row left in its folder, before the camera of its photo. Raises InputError when there is none."""
    try:
        if (row / "head.npz").exists():
            with np.load(row / "head.npz", allow_pickle=False) as data:
                camera = Camera(data["K"], data["world_to_camera"], width, height)
                return Head(data["vertices"], data["faces"], camera)
        camera = read_frame(row / "avatar").camera_of_photo(width, height)
        mesh = trimesh.load_mesh(row / "avatar" / "mesh.ply", process=False)
        return Head(np.asarray(mesh.vertices) * (1000 / MILLIMETRES_PER_UNIT), np.asarray(mesh.faces), camera)
    except (OSError, KeyError, ValueError) as error:
        raise InputError(f"{row} holds no head ({error}); make that row again") from error


def expose_photo(photo: np.ndarray, environments: list[np.ndarray]) -> dict[str, np.ndarray]:
    """For each view that is not turned, the linear photo [H, W, 3] as radiance that the view's exposure brings back."""
    return {view: photo / exposure_of(environments[light]) for view, light in UNTURNED.items()}


def shade_one_colour(head: Head, environments: list[np.ndarray]) -> dict[str, np.ndarray]:
    """For each view, a head of the mean colour of skin."""
    result = {}
    for view, (light, yaw) in VIEWS.items():
        seen = head.draw(yaw)
        result[view] = shade(MEAN_SKIN, seen.normal, seen.mask, environments[light])
    return result


def relight_photo(
    photo: np.ndarray, head: Head, environments: list[np.ndarray], colour: np.ndarray
) -> dict[str, np.ndarray]:
    """For each view that is not turned, the photo over its shading, times that of the view's light."""
    seen = head.draw()
    face = np.linalg.norm(seen.position - head.nose, axis=2) * MILLIMETRES_PER_UNIT < MIDDLE
    if not face.any():
        raise InputError("the photo does not show the middle of the face of the head")
    albedo = divide_by_shading(photo, seen.normal, seen.mask, face, colour)
    return {view: shade(albedo, seen.normal, seen.mask, environments[light]) for view, light in UNTURNED.items()}


def measure_skin_colour(truth: Path) -> np.ndarray:
    """The mean albedo [3] of the skin that a portrait shows, by its `truth.npz`."""
    true = load_truth(truth)
    skin = (true.region == SKIN) & (true.mask > 0.5)
    if not skin.any():
        raise InputError(f"{truth} shows no skin")
    return true.diffuse_albedo[skin].mean(axis=0)


def write_mean_head(photo: Path, prior_path: Path, out: Path) -> None:
    """Writes `out/head.npz`: the prior's mean head, its landmarks and the camera that the photo's landmarks give."""
    import mitsuba as mi

    from sira_mi.avatar.file import load_prior
    from sira_mi.portrait.portrait import PortraitSettings, make_portrait

    prior = load_prior(prior_path)
    portrait = make_portrait(photo, PortraitSettings(), prior.tensors["landmarks"])
    height, width = load_photo(photo).image.shape[:2]
    camera = PhotoFrame(portrait.camera, portrait.window or ()).camera_of_photo(width, height)
    shape = mi.load_dict({"type": "neural_sdf", "avatar": str(prior_path), "voxel": 0.05})
    arrays = {
        "vertices": shape.vertices().T,
        "faces": shape.faces(),
        "landmarks": prior.tensors["landmarks"],
        "K": camera.K,
        "world_to_camera": camera.world_to_camera,
    }
    write_through(out / "head.npz", lambda file: np.savez_compressed(file, **arrays))


def _draw(arguments: argparse.Namespace) -> dict[str, np.ndarray]:
    photo = load_photo(arguments.photo).image
    environments = [read_environment(path) for path in arguments.lights]
    if arguments.baseline == "photo":
        return expose_photo(photo, environments)
    head = read_head(arguments.head, photo.shape[1], photo.shape[0])
    if arguments.baseline == "one-colour":
        return shade_one_colour(head, environments)
    colour = MEAN_SKIN if arguments.truth is None else measure_skin_colour(arguments.truth)
    return relight_photo(photo, head, environments, colour)


def main() -> None:
    parser = CommandParser(prog="python -m studies.portraits.baselines", description="Baselines of the benchmark.")
    commands = parser.add_subparsers(dest="baseline", required=True)
    photo, one, page, mean = (
        commands.add_parser(name) for name in ("photo", "one-colour", "page-of-code", "mean-head")
    )
    for command in (photo, one, page, mean):
        command.add_argument("photo", type=Path)
        command.add_argument("--out", type=Path, required=True, help="folder of the row")
        command.add_argument("--variant", default="llvm_ad_rgb", help="Mitsuba variant")
    for command in (photo, one, page):
        command.add_argument(
            "--lights", type=Path, nargs=2, required=True, metavar="EXR", help="of the portrait's views"
        )
    for command in (one, page):
        command.add_argument("--head", type=Path, required=True, help="folder of the row whose head has the normals")
    page.add_argument("--truth", type=Path, metavar="NPZ", help="whose skin colour is taken instead of the mean one")
    mean.add_argument("--prior", type=Path, required=True)
    arguments = parser.parse_args()

    from sira_mi.variants import set_variant

    set_variant(arguments.variant)
    if arguments.baseline == "mean-head":
        write_mean_head(arguments.photo, arguments.prior, arguments.out)
        return
    for view, picture in _draw(arguments).items():
        write_exr(arguments.out / f"{view}.exr", picture)


if __name__ == "__main__":
    run_command(main)
