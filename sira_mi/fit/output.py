"""What a fit leaves behind: avatar, scene, mesh, lights, renders with previews, a report and a contact sheet.

Everything is written into one folder by functions that write under a temporary name first."""

from __future__ import annotations

import json
from pathlib import Path

import mitsuba as mi
import numpy as np
from PIL import Image

from sira_mi.conventions import MILLIMETRES_PER_UNIT
from sira_mi.export.scene import head, principal_point_offset, sensor
from sira_mi.fields.columns import evaluate_in_chunks
from sira_mi.fields.sdf import surface
from sira_mi.files import write_exr, write_png, write_through
from sira_mi.portrait.camera import Camera
from sira_mi.portrait.load import linear_to_srgb
from sira_mi.relight.pictures import preview
from sira_mi.sg.layers import split_layers

# Samples a pixel of the closed-form renders.
_SAMPLES = 4
# Side of a picture in the contact sheet, pixels.
_TILE = 320
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
    """All layers of an `avatar_scene`: [H, W, 3], one-channel ones [H, W]."""
    return split_layers(mi.render(scene, spp=_SAMPLES, seed=0).numpy())


def render_radiance(scene: mi.Scene) -> np.ndarray:
    """The radiance [H, W, 3] of an `avatar_scene`, with or without its extra channels."""
    return mi.render(scene, spp=_SAMPLES, seed=0).numpy()[..., :3]


def avatar_scene(
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
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "sira_sg", "hide_emitters": True, "aovs": extra_channels, **refinement},
            "sensor": sensor(camera, {"type": "stratified", "sample_count": _SAMPLES}),
            "head": head(avatar_path, voxel),
            "light": {"type": "sg_envmap", "lobes": mi.TensorXf(lobes)},
        }
    )


def write_renders(folder: Path, layers: dict[str, np.ndarray]) -> None:
    """`renders/NAME.exr` with PNG previews, and `renders/mask.png`."""
    for name, image in layers.items():
        if name != "mask":
            write_exr(folder / f"{name}.exr", image)
        write_png(folder / f"{name}.png", preview(name, image, layers["mask"]))


def write_mesh(path: Path, shape) -> None:
    """A PLY of a `neural_sdf` in metres (+y up, facing +z), with the field's normals and, as vertex colours, the sRGB
    diffuse albedo."""
    import trimesh

    vertices = shape.vertices()
    field, texture = shape.field(), shape.bsdf().diffuse_albedo

    def columns(x):
        _, gradient, x_ref, gamma = surface(field, x)
        return gradient, texture.evaluate_columns(x_ref, gamma)

    gradient, albedo = evaluate_in_chunks(columns, vertices)
    mesh = trimesh.Trimesh(
        vertices.T * (MILLIMETRES_PER_UNIT / 1000),
        mi.traverse(shape)["faces"].numpy().reshape(-1, 3),
        vertex_normals=(gradient / np.maximum(np.linalg.norm(gradient, axis=0), 1e-6)).T,
        vertex_colors=(linear_to_srgb(np.clip(albedo.T, 0, 1)) * 255 + 0.5).astype(np.uint8),
        process=False,
    )
    write_through(path, lambda p: p.write_bytes(mesh.export(file_type="ply", vertex_normal=True)))


def write_scene(path: Path, camera: Camera) -> None:
    """`scene.xml`: the fitted scene, opened by `mi.load_file` after `import sira_mi`; files are found beside it."""
    x, y = principal_point_offset(camera)
    to_world = mi.ScalarTransform4f(sensor(camera)["to_world"]).matrix
    matrix = " ".join(f"{v:.9g}" for v in np.array(to_world).ravel())
    fov = sensor(camera)["fov"]
    text = f"""<?xml version="1.0" encoding="utf-8"?>
<!-- A head fitted by SIRA for Mitsuba 3: import sira_mi; mitsuba.load_file("scene.xml", integrator="path") -->
<scene version="3.0.0">
    <default name="avatar" value="avatar.safetensors"/>
    <default name="lights" value="lights.json"/>
    <default name="integrator" value="sira_sg"/>
    <default name="width" value="{camera.width}"/>
    <default name="height" value="{camera.height}"/>
    <default name="spp" value="16"/>
    <default name="voxel" value="0.05"/>
    <!-- Albedos interpolated between vertices, without gradients: quick for path, ignored by sira_sg. -->
    <default name="baked" value="true"/>
    <integrator type="$integrator"/>
    <sensor type="perspective">
        <string name="fov_axis" value="x"/>
        <float name="fov" value="{fov:.9g}"/>
        <float name="principal_point_offset_x" value="{x:.9g}"/>
        <float name="principal_point_offset_y" value="{y:.9g}"/>
        <float name="near_clip" value="0.01"/>
        <float name="far_clip" value="1000"/>
        <transform name="to_world"><matrix value="{matrix}"/></transform>
        <sampler type="independent"><integer name="sample_count" value="$spp"/></sampler>
        <film type="hdrfilm">
            <integer name="width" value="$width"/>
            <integer name="height" value="$height"/>
            <string name="pixel_format" value="rgba"/>
            <rfilter type="box"/>
        </film>
    </sensor>
    <shape type="neural_sdf" id="head">
        <string name="avatar" value="$avatar"/>
        <float name="voxel" value="$voxel"/>
        <bsdf type="sira_bsdf">
            <texture type="neural_albedo" name="diffuse_albedo">
                <string name="avatar" value="$avatar"/>
                <string name="kind" value="diffuse"/>
                <boolean name="baked" value="$baked"/>
            </texture>
            <texture type="neural_albedo" name="specular_albedo">
                <string name="avatar" value="$avatar"/>
                <string name="kind" value="specular"/>
                <boolean name="baked" value="$baked"/>
            </texture>
        </bsdf>
    </shape>
    <emitter type="sg_envmap" id="light">
        <string name="filename" value="$lights"/>
    </emitter>
</scene>
"""
    write_through(path, lambda p: p.write_text(text, encoding="utf-8"))


def box_camera(camera: Camera, box: tuple[int, int, int, int]) -> Camera:
    """The camera of a tile of the contact sheet: of the part `box` (x0, y0, x1, y1) of the photo's frame."""
    x0, y0, x1, y1 = box
    scale = _TILE / max(x1 - x0, y1 - y0)
    return camera.cropped(x0, y0, x1 - x0, y1 - y0).scaled(scale, scale)


def _tile(image: np.ndarray) -> np.ndarray:
    """Display values [H, W, 3] or [H, W], fitted into a square of the contact sheet."""
    pixels = (np.clip(image, 0, 1) * 255 + 0.5).astype(np.uint8)
    scale = _TILE / max(image.shape[:2])
    size = (round(image.shape[1] * scale), round(image.shape[0] * scale))
    canvas = Image.new("RGB", (_TILE, _TILE))
    canvas.paste(Image.fromarray(pixels).resize(size, Image.LANCZOS), ((_TILE - size[0]) // 2, (_TILE - size[1]) // 2))
    return np.asarray(canvas) / 255


def contact_sheet(
    photo: np.ndarray, mask: np.ndarray, layers: dict, turned: list[np.ndarray], box: tuple
) -> np.ndarray:
    """Display values of the sheet: photo, mask, final, normals / diffuse albedo, specular albedo, the head turned both
    ways under a second light (display values of `box_camera`). `box` (x0, y0, x1, y1) is the part of the photo's frame
    that is shown."""
    x0, y0, x1, y1 = box
    names = ("final", "normal", "diffuse_albedo", "specular_albedo")
    shown = [preview(name, layers[name], layers["mask"]) for name in names]
    framed = [image[y0:y1, x0:x1] for image in (linear_to_srgb(photo), mask, *shown)]
    rows = framed[:4], [*framed[4:], *turned]
    return np.concatenate([np.concatenate([_tile(i) for i in row], axis=1) for row in rows], axis=0)


def head_box(mask: np.ndarray) -> tuple[int, int, int, int]:
    """The square (x0, y0, x1, y1) of the frame around a mask, with a margin, clipped to the frame."""
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
    """`avatar.json`."""
    write_through(path, lambda p: p.write_text(json.dumps(report, indent=2) + "\n", encoding="utf-8"))
