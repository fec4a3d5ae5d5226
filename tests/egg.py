"""An egg with a nose: a head whose truth is known, and the camera that looks at it."""

import dataclasses
import json

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from sira_mi.portrait.camera import Camera
from studies.portraits.alignment import SIX_LANDMARKS
from studies.portraits.truth import VIEWS, Truth
from studies.portraits.visible_surface import mesh_images

SKIN, HAIR, CLOTH, NOTHING = 0, 1, 3, 255
SIZE = 64


def head_like(radius=1.0, level: int = 4) -> tuple[np.ndarray, np.ndarray]:
    """An egg with a nose at +z and no symmetry, `radius` scene units (or a function of unit directions)."""
    ball = trimesh.creation.icosphere(subdivisions=level)
    way = ball.vertices
    shape = 1 + 0.12 * way[:, 1] + 0.05 * way[:, 0] * way[:, 2] - 0.1 * way[:, 0] ** 2
    shape += 0.2 * np.exp(-((way - [0, -0.1, 0.995]) ** 2).sum(1) / 0.03)
    size = radius(way) if callable(radius) else radius
    return way * (shape * size)[:, None], np.asarray(ball.faces)


def landmarks_on(vertices: np.ndarray) -> np.ndarray:
    """The six landmarks where a face would have them, on the front of a mesh, NaN elsewhere."""
    places = [(-0.2, 0.2), (0.2, 0.2), (0.0, -0.1), (0.0, -0.2), (-0.25, -0.45), (0.25, -0.45)]
    result = np.full((468, 3), np.nan)
    way = vertices / np.linalg.norm(vertices, axis=1, keepdims=True)
    for landmark, (x, y) in zip(SIX_LANDMARKS, places, strict=True):
        result[landmark] = vertices[np.argmax(way @ np.array([x, y, np.sqrt(1 - x * x - y * y)]))]
    return result


def turned_camera(yaw: float = 25.0, distance: float = 8.0) -> Camera:
    """A camera looking at the origin, turned about the vertical."""
    rotation = np.diag([1.0, -1, -1]) @ Rotation.from_euler("y", -yaw, degrees=True).as_matrix()
    pose = np.eye(4)
    pose[:3, :3], pose[2, 3] = rotation, distance
    focal = 0.4 * SIZE * distance
    return Camera(np.array([[focal, 0, SIZE / 2], [0, focal, SIZE / 2], [0, 0, 1]]), pose, SIZE, SIZE)


def truth_of(vertices, faces, face_region=None, landmarks=None, camera=None) -> Truth:
    """A truth whose images but normals and masks are made up."""
    camera = camera or turned_camera()
    images = mesh_images(vertices, faces, camera)
    rng = np.random.default_rng(3)
    inside = images.mask[..., None]
    albedo = np.where(inside, rng.uniform(0.2, 0.6, (SIZE, SIZE, 3)), 0).astype(np.float32)
    shading = np.where(images.mask, rng.uniform(0.3, 1.2, (SIZE, SIZE)), 0).astype(np.float32)
    return Truth(
        camera=camera,
        image=albedo * shading[..., None],
        mask=images.mask.astype(np.float32),
        region=np.where(images.mask, SKIN, NOTHING).astype(np.uint8),
        diffuse_albedo=albedo,
        specular_albedo=np.where(images.mask, rng.uniform(0.02, 0.05, images.mask.shape), 0).astype(np.float32),
        normal=images.normal.astype(np.float32),
        shading=shading,
        shadow=np.where(images.mask, rng.uniform(0, 1, images.mask.shape), 0).astype(np.float32),
        vertices=vertices,
        faces=faces,
        face_region=np.zeros(len(faces), np.uint8) if face_region is None else face_region,
        landmarks=landmarks_on(vertices) if landmarks is None else landmarks,
    )


def write_truth(path, truth: Truth, **changes):
    """Writes `truth.npz`; an array is left out for None."""
    arrays = {field.name: getattr(truth, field.name) for field in dataclasses.fields(truth) if field.name != "camera"}
    arrays |= {"K": truth.camera.K, "world_to_camera": truth.camera.world_to_camera}
    arrays["landmarks_valid"] = np.isfinite(truth.landmarks).all(axis=1)
    arrays["landmarks"] = np.nan_to_num(truth.landmarks).astype(np.float32)
    arrays["faces"] = truth.faces.astype(np.int32)
    arrays |= changes
    np.savez(path, **{name: value for name, value in arrays.items() if value is not None})
    return path


def write_views(folder, truth: Truth, **changes):
    """Writes the views of a portrait, all like its photo at half the radiance; an array is left out for None."""
    one = {
        "image": (0.5 * truth.image).astype(np.float16),
        "mask": (255 * truth.mask).astype(np.uint8),
        "region": truth.region,
        "face": truth.region == SKIN,
    }
    arrays = {f"{view}_{name}": array for view in VIEWS for name, array in one.items()} | changes
    folder.mkdir(exist_ok=True)
    np.savez(folder / "views.npz", **{name: array for name, array in arrays.items() if array is not None})
    (folder / "portrait.json").write_text(json.dumps({"key": "", "entry": {"relights": ["noon", "lamp"]}}))
    return folder
