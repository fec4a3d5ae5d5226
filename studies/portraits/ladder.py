"""`python -m studies.portraits.ladder RUNG …`: the pictures of a fit in which one estimated thing is replaced by
its truth.

`outline` fills what the fit's pictures miss of the head with the true pictures. `tone` scales the fit's albedo to the
true mean luminance of the skin, `light` divides the photo by the true shading in place of the fit's (its colour stays
the fit's), `albedo` takes the true diffuse albedo; each shows the fit's head. `shape` shows the true head, before the
true camera, in the fit's albedo, and `all` in the true one: the ceiling of this renderer. These two have no specular
term but a reflectance at normal incidence of skin everywhere. Camera and pose are the row `draft-camera`.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import map_coordinates

from sira_mi.avatar.decoders import SKIN_SPECULAR
from sira_mi.avatar.file import Avatar, load_avatar, save_avatar
from sira_mi.conventions import LUMINANCE
from sira_mi.errors import CommandParser, InputError, run_command
from sira_mi.export.scene import orbit, sensor
from sira_mi.files import read_exr, write_exr
from sira_mi.portrait.camera import yaw_rotation
from sira_mi.portrait.portrait import area_resample
from sira_mi.relight.subject import Light
from sira_mi.sg.lights_io import read_environment
from sira_mi.training.collection.render import Part, build_mesh
from sira_mi.training.collection.skin import SKIN
from sira_mi.training.collection.textured_surface import smooth_normals
from studies.portraits.photo_frame import PhotoFrame, read_frame
from studies.portraits.truth import VIEWS, Truth, load_truth, load_views

SAMPLES = 64  # a pixel, as of the rows
_HIGHEST_ALBEDO, _DARK = 0.95, 1e-3
ROUGHNESS = 0.5

Pictures = dict[str, np.ndarray]  # linear radiance [H, W, 3] by view


@dataclass(frozen=True, eq=False)
class Fitted:
    """A portrait, its truth, and the row of its fit."""

    truth: Truth
    truth_folder: Path
    row: Path
    lights: tuple[Path, ...]
    variant: str

    @property
    def avatar(self) -> Avatar:
        return load_avatar(self.row / "avatar" / "avatar.safetensors")

    @property
    def frame(self) -> PhotoFrame:
        return read_frame(self.row / "avatar")

    def in_detail(self, picture: np.ndarray) -> np.ndarray:
        """A picture [H, W, ...] of the photo at the pixels of the fit's detail."""
        height, width = self.avatar.tensors["detail"].shape[:2]
        x0, y0, x1, y1 = self.frame.window
        return area_resample(picture, (x0, y0), (width / (x1 - x0), height / (y1 - y0)), (width, height))


def fill_outline(fitted: Fitted) -> Pictures:
    """The fit's pictures, with the true ones where they are black inside the true mask."""
    pictures = {}
    for name, view in load_views(fitted.truth_folder).items():
        picture = read_exr(fitted.row / f"{name}.exr")[0]
        missed = (view.mask > 0.5) & ~picture.any(axis=2)
        pictures[name] = np.where(missed[..., None], view.image, picture)
    return pictures


def scale_tone(fitted: Fitted) -> Avatar:
    """The fit's avatar, its albedo scaled so that skin has the true mean luminance."""
    avatar, truth = fitted.avatar, fitted.truth
    detail = avatar.tensors["detail"]
    skin = fitted.in_detail(((truth.region == SKIN) & (truth.mask > 0.5)).astype(np.float32)) > 0.99
    skin &= detail[..., 3] > 0.99
    if not skin.any():
        raise InputError("the fit and the truth share no skin")
    true, own = (a[skin][:, :3].mean(axis=0) @ np.array(LUMINANCE) for a in (_true_albedo(fitted), detail))
    return replace_albedo(avatar, detail[..., :3] * (true / own), np.log(true / own))


def divide_by_true_shading(fitted: Fitted) -> Avatar:
    """The fit's avatar, the luminance of its albedo that of the photo over the true shading."""
    avatar, truth = fitted.avatar, fitted.truth
    own = avatar.tensors["detail"][..., :3]
    luminance = fitted.in_detail(truth.image @ np.array(LUMINANCE) / np.maximum(truth.shading, _DARK))
    return replace_albedo(avatar, own * (luminance / np.maximum(own @ np.array(LUMINANCE), _DARK))[..., None], 0.0)


def take_true_albedo(fitted: Fitted) -> Avatar:
    return replace_albedo(fitted.avatar, _true_albedo(fitted), 0.0)


def replace_albedo(avatar: Avatar, albedo: np.ndarray, shift: float) -> Avatar:
    """The avatar with another albedo [h, w, 3] of its detail where the new one is not black; the logits of the
    networks' albedo are shifted."""
    detail, network = avatar.tensors["detail"].copy(), avatar.tensors["diffuse_albedo"].copy()
    known = albedo.any(axis=2)
    detail[known, :3] = np.clip(albedo[known], 0, _HIGHEST_ALBEDO)
    network[-3:] += np.float32(shift)
    return avatar.with_tensors(detail=detail, diffuse_albedo=network)


def _true_albedo(fitted: Fitted) -> np.ndarray:
    return fitted.in_detail(fitted.truth.diffuse_albedo)


def relight_avatar(fitted: Fitted, avatar: Avatar) -> Pictures:
    """The views of an avatar, by the user's command, at the photo's pixels."""
    from sira_mi.relight.__main__ import main as relight

    height, width = fitted.truth.mask.shape
    pictures = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        save_avatar(folder / "avatar.safetensors", avatar)
        shutil.copy(fitted.row / "avatar" / "avatar.json", folder)
        for view, (light, yaw) in VIEWS.items():
            arguments = [name, "--lights", str(fitted.lights[light]), "--yaw", str(yaw), "--view", "photo"]
            arguments += ["--integrator", "path", "--spp", str(SAMPLES), "--size", str(fitted.frame.longer_side)]
            relight([*arguments, "--out", str(folder / f"{view}.exr"), "--variant", fitted.variant])
            pictures[view] = fitted.frame.lay_on_photo(read_exr(folder / f"{view}.exr")[0], width, height)
    return pictures


def show_true_head(fitted: Fitted, albedo: np.ndarray, samples: int = SAMPLES) -> Pictures:
    """The views of the true head, path traced with the BRDF of the avatars, in an `albedo` [H, W, 3] at the photo's
    pixels; what the photo does not show has the mean of its region."""
    import mitsuba as mi

    from studies.portraits.visible_surface import is_seen_by_camera, ray_scene

    truth = fitted.truth
    normals = smooth_normals(truth.vertices, truth.faces)
    seen = is_seen_by_camera(ray_scene(truth.vertices, truth.faces), truth.camera, truth.vertices, normals)
    colours = paint_vertices(truth, albedo, seen)
    strength = np.full(len(colours), SKIN_SPECULAR / 0.08)
    props: Any = mi.Properties()
    props["bsdf"] = mi.load_dict(
        {
            "type": "sira_bsdf",
            "diffuse_albedo": {"type": "mesh_attribute", "name": "vertex_albedo"},
            "specular_albedo": {"type": "uniform", "value": SKIN_SPECULAR},
            "roughness": ROUGHNESS,
        }
    )
    mesh = build_mesh("head", Part(truth.vertices, truth.faces, normals, colours, strength, truth.face_region), props)
    pictures = {}
    for view, (light, yaw) in VIEWS.items():
        emitter = Light(None, read_environment(fitted.lights[light])).emitter(yaw_rotation(-yaw))
        scene = {
            "type": "scene",
            "integrator": {"type": "path", "hide_emitters": True},
            "sensor": sensor(orbit(truth.camera, yaw)),
            "head": mesh,
            "light": emitter,
        }
        pictures[view] = mi.render(mi.load_dict(scene), spp=samples, seed=mi.UInt32(0)).numpy()[..., :3]
    return pictures


def paint_vertices(truth: Truth, albedo: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Colours [N, 3] of the true head's vertices: of the pixel of an `albedo` [H, W, 3] that shows a vertex, if it is
    `seen` [N] and its pixel inside the mask, else the mean over the vertices that are, of its region or of all."""
    pixel = truth.camera.project(truth.vertices)[:, ::-1].T - 0.5
    inside = map_coordinates(truth.mask, pixel, order=0) > 0.5
    known = seen & inside
    colours = np.stack([map_coordinates(albedo[..., c], pixel, order=1) for c in range(3)], axis=1)
    region = np.zeros(len(truth.vertices), int)
    region[truth.faces.ravel()] = np.repeat(truth.face_region, 3)
    if not known.any():
        raise InputError("the photo shows no vertex of the true head")
    for code in np.unique(region):
        own = region == code
        source = own & known if (own & known).any() else known
        colours[own & ~known] = colours[source].mean(axis=0)
    return np.clip(colours, 0, _HIGHEST_ALBEDO)


def _show_in_fits_albedo(fitted: Fitted) -> Pictures:
    height, width = fitted.truth.mask.shape
    detail = fitted.frame.lay_on_photo(fitted.avatar.tensors["detail"][..., :3], width, height)
    return show_true_head(fitted, detail)


RUNGS: dict[str, Callable[[Fitted], Pictures]] = {
    "outline": fill_outline,
    "tone": lambda fitted: relight_avatar(fitted, scale_tone(fitted)),
    "light": lambda fitted: relight_avatar(fitted, divide_by_true_shading(fitted)),
    "albedo": lambda fitted: relight_avatar(fitted, take_true_albedo(fitted)),
    "shape": _show_in_fits_albedo,
    "all": lambda fitted: show_true_head(fitted, fitted.truth.diffuse_albedo),
}


def main() -> None:
    parser = CommandParser(prog="python -m studies.portraits.ladder", description="A fit with one thing true.")
    parser.add_argument("rung", choices=RUNGS)
    parser.add_argument("--truth", type=Path, required=True, metavar="NPZ", help="truth.npz of the portrait")
    parser.add_argument("--fit", type=Path, required=True, help="folder of the row of its fit")
    parser.add_argument("--lights", type=Path, nargs=2, required=True, metavar="EXR", help="of the portrait's views")
    parser.add_argument("--out", type=Path, required=True, help="folder of the row")
    parser.add_argument("--variant", default="llvm_ad_rgb", help="Mitsuba variant")
    arguments = parser.parse_args()

    from sira_mi.variants import set_variant

    set_variant(arguments.variant)
    truth = load_truth(arguments.truth)
    fitted = Fitted(truth, arguments.truth.parent, arguments.fit, tuple(arguments.lights), arguments.variant)
    for view, picture in RUNGS[arguments.rung](fitted).items():
        write_exr(arguments.out / f"{view}.exr", picture.astype(np.float32))


if __name__ == "__main__":
    run_command(main)
