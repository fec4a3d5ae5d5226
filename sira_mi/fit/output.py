"""Pictures and the report that a fit leaves behind: renders with previews, a contact sheet, `avatar.json`.

Everything is written into one folder by functions that write under a temporary name first."""

from __future__ import annotations

import contextlib
import json
from pathlib import Path

import mitsuba as mi
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from sira_mi.colour import linear_to_srgb
from sira_mi.export.scene import head, head_scene, orbit, sensor, sg_light
from sira_mi.files import write_exr, write_png, write_text
from sira_mi.portrait.camera import Camera
from sira_mi.portrait.portrait import Portrait
from sira_mi.relight.pictures import preview
from sira_mi.sg.layers import split_layers

# Samples a pixel of the closed-form renders.
_SAMPLES = 4
_RADIANCE = ("final", "diffuse", "specular")
# Side of a picture in the contact sheet, pixels.
_TILE = 320
# Layers of the contact sheet.
_LAYER_LABELS = {
    "final": "render",
    "normal": "normal",
    "diffuse_albedo": "diffuse albedo",
    "specular_albedo": "specular albedo",
}
# Text of the contact sheet: its size and margin, pixels.
_LABEL_SIZE, _LABEL_MARGIN = 15, 6
# The second light of the contact sheet: a warm key from the upper left, a cool rim from behind, fill and a dim sky.
SECOND_LIGHT = np.array(
    [
        [-0.75, 0.45, 0.5, 12.0, 4.6, 3.9, 3.1],
        [0.85, 0.3, -0.45, 10.0, 1.6, 2.2, 3.4],
        [0.5, 0.0, 0.85, 2.0, 0.2, 0.2, 0.2],
        [0.0, 1.0, 0.1, 0.6, 0.16, 0.18, 0.22],
    ],
    np.float32,
)


def render_layers(scene: mi.Scene) -> dict[str, np.ndarray]:
    """All layers of an `load_avatar_scene`: [H, W, 3], one-channel ones [H, W]."""
    return split_layers(mi.render(scene, spp=_SAMPLES, seed=mi.UInt32(0)).numpy())


def render_radiance(scene: mi.Scene) -> np.ndarray:
    """The radiance [H, W, 3] of an `load_avatar_scene`, with or without its extra channels."""
    return mi.render(scene, spp=_SAMPLES, seed=mi.UInt32(0)).numpy()[..., :3]


def load_avatar_scene(
    avatar_path: str,
    camera: Camera,
    lobes: np.ndarray,
    voxel: float,
    extra_channels: bool = True,
    in_photo: bool = False,
) -> mi.Scene:
    """The head of an avatar file before a black background, closed-form shading, `lobes` [N_l, 7] as its light; evenly
    spread samples in each pixel, against jagged outlines. `extra_channels` are those of `sira_sg`.
    `in_photo`: the lobes are the avatar's own, and its refinement of that light is in the radiance."""
    refinement = {"light_refinement": avatar_path} if in_photo else {}
    integrator = {"type": "sira_sg", "hide_emitters": True, "aovs": extra_channels, **refinement}
    eye = sensor(camera, {"type": "stratified", "sample_count": _SAMPLES})
    return mi.load_dict(head_scene(integrator, eye, head(avatar_path, voxel), sg_light(lobes)))


def write_renders(folder: Path, layers: dict[str, np.ndarray], exposure: float = 1.0) -> None:
    """Makes `folder` and writes `NAME.exr` with PNG previews, and `mask.png`, into it. Radiance in `layers` is
    `exposure` times that of the files; previews show it as it is."""
    with contextlib.suppress(FileExistsError):
        folder.mkdir()
    for name, image in layers.items():
        if name != "mask":
            write_exr(folder / f"{name}.exr", image / exposure if name in _RADIANCE else image)
        write_png(folder / f"{name}.png", preview(name, image, layers["mask"]))


def crop_camera(camera: Camera, box: tuple[int, int, int, int]) -> Camera:
    """The camera of a tile of the contact sheet: of the part `box` (x0, y0, x1, y1) of the photo's frame."""
    x0, y0, x1, y1 = box
    scale = _TILE / max(x1 - x0, y1 - y0)
    return camera.crop(x0, y0, x1 - x0, y1 - y0).scale(scale, scale)


def label_tile(image: np.ndarray, label: str) -> np.ndarray:
    """Display values [H, W, 3] or [H, W], fitted into a square of the contact sheet, with a label in a corner."""
    pixels = (np.clip(image, 0, 1) * 255 + 0.5).astype(np.uint8)
    scale = _TILE / max(image.shape[:2])
    size = (round(image.shape[1] * scale), round(image.shape[0] * scale))
    canvas = Image.new("RGB", (_TILE, _TILE))
    resized = Image.fromarray(pixels).resize(size, Image.Resampling.LANCZOS)
    canvas.paste(resized, ((_TILE - size[0]) // 2, (_TILE - size[1]) // 2))
    draw, font = ImageDraw.Draw(canvas), ImageFont.load_default(_LABEL_SIZE)
    place = (_LABEL_MARGIN, _TILE - _LABEL_MARGIN)
    left, top, right, bottom = draw.textbbox(place, label, font=font, anchor="ld")
    draw.rectangle((left - 3, top - 2, right + 3, bottom + 2), fill="black")
    draw.text(place, label, fill="white", font=font, anchor="ld")
    return np.asarray(canvas) / 255


def draw_contact_sheet(avatar_path: str, portrait: Portrait, layers: dict[str, np.ndarray], voxel: float) -> np.ndarray:
    """Display values of the sheet, cropped to the head, with labels: photo, mask, render, normals / diffuse albedo,
    specular albedo, the head turned both ways under a second light."""
    box = head_box(np.maximum(layers["mask"], portrait.mask * (layers["mask"] > 0)))
    close = crop_camera(portrait.camera, box)
    x0, y0, x1, y1 = box
    pictures = {"photo": linear_to_srgb(portrait.image), "mask of the photo": portrait.mask}
    for name, label in _LAYER_LABELS.items():
        pictures[label] = preview(name, layers[name], layers["mask"])
    tiles = [label_tile(image[y0:y1, x0:x1], label) for label, image in pictures.items()]
    for yaw in (-30, 30):
        scene = load_avatar_scene(avatar_path, orbit(close, yaw), SECOND_LIGHT, voxel, extra_channels=False)
        tiles.append(label_tile(linear_to_srgb(render_radiance(scene)), f"another light, turned {yaw:+d}°"))
    return np.concatenate([np.concatenate(tiles[:4], axis=1), np.concatenate(tiles[4:], axis=1)], axis=0)


def head_box(mask: np.ndarray) -> tuple[int, int, int, int]:
    """The square (x0, y0, x1, y1) around a mask, with a margin, clipped to the frame; the frame for an empty mask."""
    rows, columns = np.nonzero(mask > 0.5)
    height, width = mask.shape
    if len(rows) == 0:
        return 0, 0, width, height
    centre = (columns.min() + columns.max()) / 2, (rows.min() + rows.max()) / 2
    half = 0.54 * max(np.ptp(columns), np.ptp(rows)) + 2
    x0, x1 = (int(np.clip(centre[0] + s * half, 0, width)) for s in (-1, 1))
    y0, y1 = (int(np.clip(centre[1] + s * half, 0, height)) for s in (-1, 1))
    return x0, y0, x1, y1


def write_report(path: Path, report: dict) -> None:
    """Writes `avatar.json`; null stands for numbers that are not finite, which JSON lacks."""
    finite = json.loads(json.dumps(report), parse_constant=lambda name: None)
    write_text(path, json.dumps(finite, indent=2) + "\n")
