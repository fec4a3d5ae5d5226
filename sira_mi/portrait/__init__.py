"""The portrait front end: one photo to a linear image, a foreground mask, facial landmarks and a camera."""

from sira_mi.portrait.camera import Camera, estimate_camera, measure_reprojection_error
from sira_mi.portrait.face import Face, find_faces, select_face
from sira_mi.portrait.load import Photo, linear_to_srgb, load_photo, srgb_to_linear
from sira_mi.portrait.mask import load_mask, segment_person
from sira_mi.portrait.portrait import Portrait, PortraitSettings, make_portrait

__all__ = [
    "Camera",
    "Face",
    "Photo",
    "Portrait",
    "PortraitSettings",
    "estimate_camera",
    "find_faces",
    "linear_to_srgb",
    "load_mask",
    "load_photo",
    "make_portrait",
    "measure_reprojection_error",
    "segment_person",
    "select_face",
    "srgb_to_linear",
]
