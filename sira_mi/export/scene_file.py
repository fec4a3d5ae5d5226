"""Scene files: descriptions of `export.scene` as XML for `mi.load_file`."""

import xml.etree.ElementTree as ET
from pathlib import Path

import mitsuba as mi
import numpy as np

from sira_mi.export.scene import Parameter, head, head_scene, sensor
from sira_mi.files import write_through
from sira_mi.portrait.camera import Camera

# Element and labelling attribute of a plugin by its key in a description; other keys are elements themselves.
_PLUGINS = {
    "head": ("shape", "id"),
    "light": ("emitter", "id"),
    "diffuse_albedo": ("texture", "name"),
    "specular_albedo": ("texture", "name"),
}
_COMMENT = """The fitted photo as a scene: the picture of renders/final.

     In Python:
         import sira_mi
         import mitsuba
         mitsuba.set_variant("llvm_ad_rgb")
         scene = mitsuba.load_file("scene.xml", spp=64)
         mitsuba.util.write_bitmap("photo.png", mitsuba.render(scene))

     Parameters of load_file:
         integrator      sira_sg (closed form), path, or another; all but sira_sg ignore the refinement of the light
         hide_emitters   true: black behind the head; false: the environment
         spp             samples a pixel
         width, height   of the picture, pixels; the frame of the photo has their ratio
         avatar          the head's file
         lights          .json (lobes) or .exr (environment)
         refinement      the avatar whose refinement of the light is applied; an empty text under another light
         voxel           of the mesh, units of 100 mm
         baked           albedos of the vertices for path: fast, but without gradients; sira_sg evaluates the networks

     Paths are relative to this file or to the current folder."""
_VALUES = {bool: "boolean", int: "integer", float: "float", str: "string"}


def scene_of_fit(camera: Camera) -> dict:
    """The scene of a fit: the avatar and its light, from files beside the scene file, before the photo's camera."""
    eye = sensor(camera, {"type": "independent", "sample_count": Parameter("spp", 16)})
    eye["film"] |= {"width": Parameter("width", camera.width), "height": Parameter("height", camera.height)}
    shape = head(Parameter("avatar", "avatar.safetensors"), Parameter("voxel", 0.05), Parameter("baked", True))
    light = {
        "type": "sg_envmap",
        "filename": Parameter("lights", "lights.json"),
        "light_refinement": Parameter("refinement", "avatar.safetensors"),
    }
    integrator = {"type": Parameter("integrator", "sira_sg"), "hide_emitters": Parameter("hide_emitters", True)}
    return head_scene(integrator, eye, shape, light)


def scene_xml(description: dict, comment: str) -> str:
    """The XML of a scene's description, whose `Parameter`s become defaults. TypeError for a value without an element
    in scene files, such as a tensor."""
    root, defaults = ET.Element("scene", version="3.0.0"), {}

    def text(value) -> str:
        if isinstance(value, Parameter):
            defaults[value.name] = text(value.default)
            return f"${value.name}"
        return (
            str(value).lower()
            if isinstance(value, bool)
            else f"{value:.9g}"
            if isinstance(value, float)
            else str(value)
        )

    def add(parent: ET.Element, key: str, value) -> None:
        if isinstance(value, dict):
            tag, label = _PLUGINS.get(key, (key, None))
            plugin = ET.SubElement(parent, tag, {"type": text(value["type"])} | ({label: key} if label else {}))
            for name, nested in value.items():
                if name != "type":
                    add(plugin, name, nested)
        elif isinstance(value, mi.ScalarTransform4f):
            matrix = " ".join(f"{v:.9g}" for v in np.array(value.matrix).ravel())
            ET.SubElement(ET.SubElement(parent, "transform", name=key), "matrix", value=matrix)
        else:
            kind = type(value.default if isinstance(value, Parameter) else value)
            if kind not in _VALUES:
                raise TypeError(f"{key}: scene files hold no {kind.__name__}")
            ET.SubElement(parent, _VALUES[kind], name=key, value=text(value))

    for key, value in description.items():
        if key != "type":
            add(root, key, value)
    for place, (name, value) in enumerate(defaults.items()):
        root.insert(place, ET.Element("default", name=name, value=value))
    ET.indent(root, "    ")
    return f'<?xml version="1.0" encoding="utf-8"?>\n<!-- {comment} -->\n{ET.tostring(root, encoding="unicode")}\n'


def write_scene(path: Path, camera: Camera) -> None:
    """`scene.xml` of a fit: opened by `mi.load_file` after `import sira_mi`."""
    text = scene_xml(scene_of_fit(camera), _COMMENT)
    write_through(path, lambda p: p.write_text(text, encoding="utf-8"))
