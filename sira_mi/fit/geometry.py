"""The geometry stages of section 3.2.1: latents first, then the deformation network too; the reference SDF stays as it
is. The head's pose, estimated from landmarks of the mean head, is optimised along, and so is, other than in the paper,
the rendering network from the first stage on.

Colour and mask losses go through the `sira_radiance` integrator, one sample a ray; eikonal, landmark and regularising
terms are evaluated on the field."""

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np

from sira_mi.avatar.file import Avatar
from sira_mi.avatar.landmark_model import LandmarkModel, place_landmarks, reference_landmarks
from sira_mi.avatar.shape import POSE, SHAPE_LATENTS, SHAPE_NETWORKS, SHAPE_PARAMETERS, HeadShape
from sira_mi.conventions import DOMAIN_LOWER, DOMAIN_UPPER
from sira_mi.fields.columns import to_columns
from sira_mi.fields.sdf import SdfField, deform, rigid_motion, surface
from sira_mi.fit.rays import modelled_pixels, pixel_rays, window_around, window_pixels
from sira_mi.fit.settings import FitSettings, Stage
from sira_mi.fit.skin import face_exposure
from sira_mi.optimisation import losses
from sira_mi.portrait.camera import Camera, landmark_weights
from sira_mi.portrait.portrait import Portrait

_PARAMETERS = {name: f"head.{name}" for name in (*SHAPE_PARAMETERS, POSE)}
_PARAMETERS |= {name: f"integrator.{name}" for name in ("z_r", "rendering")}
_STAY_POINTS = 256


class GeometryProblem:
    """The losses of the geometry stages for one portrait, starting from `avatar` (written at `avatar_path`)."""

    def __init__(self, portrait: Portrait, avatar: Avatar, avatar_path: str, settings: FitSettings):
        self.portrait, self.avatar, self.settings = portrait, avatar, settings
        size = round(settings.rays**0.5)
        self.valid = modelled_pixels(portrait.camera)
        self.windows = self._windows(size)
        self.scene = mi.load_dict(self._description(avatar_path))
        self.head = self.scene.shapes()[0]
        self.parameters = mi.traverse(self.scene)
        self.head.remesh_every = 1 << 30
        mask = np.where(self.valid, portrait.mask, 0)
        # An untrained rendering function expects no exposure.
        self.exposure = face_exposure(portrait, avatar) if settings.learned_radiance else 1.0
        self.target = np.concatenate([self.exposure * portrait.image, mask[..., None]], axis=-1).astype(np.float32)
        self.landmarks = self._landmarks(avatar)

    def _windows(self, size: int):
        rows, columns = np.nonzero(self.valid)
        whole = (columns.min(), rows.min(), columns.max(), rows.max())
        known = self.portrait.landmarks[np.isfinite(self.portrait.landmarks).all(axis=1)]
        if len(known) == 0:
            return [window_around(*whole, size)]
        low, high = known.min(axis=0), known.max(axis=0)
        reach = 0.15 * (high - low)
        return [window_around(*whole, size), window_around(*(low - reach), *(high + reach), size)]

    def _description(self, avatar_path: str) -> dict:
        return {
            "type": "scene",
            "integrator": {"type": "sira_radiance", "avatar": avatar_path},
            "head": {"type": "neural_sdf", "avatar": avatar_path, "voxel": self.settings.voxel, "movable": True},
        }

    def _field(self, tensors: dict) -> SdfField:
        return HeadShape(self.avatar.architecture).field(tensors)

    def _landmarks(self, avatar: Avatar) -> dict | None:
        """The landmarks of the mean head [L], those of them that the photo has weighted, the others not."""
        on_head, x_ref = reference_landmarks(avatar)
        pixels = self.portrait.head_landmarks[on_head]
        in_photo = np.isfinite(pixels).all(axis=1)
        if in_photo.sum() < 6:
            return None
        weights = np.where(in_photo, landmark_weights(len(on_head))[on_head], 0).astype(np.float32)
        return {
            "x_ref": mi.TensorXf(np.ascontiguousarray(x_ref)),
            "x": avatar.tensors["landmarks"][on_head].T.astype(np.float32),
            "model": LandmarkModel(avatar),
            "pixels": mi.TensorXf(np.ascontiguousarray(np.nan_to_num(pixels).T, dtype=np.float32)),
            "weights": mi.TensorXf(weights[None] / weights.sum()),
            "face_size": float(np.ptp(pixels[in_photo, 1])),
        }

    def start(self, stage: Stage, tensors: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Before the first stage, the learned radiance is scaled to the photo's exposure."""
        if stage != self.settings.stages[0][1]:
            return {}
        rendering = tensors["rendering"].copy()
        rendering[-3:] -= np.float32(np.log(self.exposure))
        return {"rendering": rendering}

    def refresh(self, tensors: dict[str, np.ndarray]) -> None:
        """Extracts the mesh that rays start from at the current parameters. Raises EmptySurfaceError."""
        self.head.remesh_at_next_update()
        for name, key in _PARAMETERS.items():
            self.parameters[key] = mi.Float(tensors[name])
        self.parameters.set_dirty(_PARAMETERS[POSE])
        self.parameters.update()
        self._fixed = {name: mi.Float(tensors[name]) for name in _PARAMETERS}
        if self.landmarks is not None:
            field = replace(self._field(self._fixed), motion=None)
            self.landmarks["placed"] = place_landmarks(field, self.landmarks["x_ref"], self.landmarks["x"])

    def losses(self, tensors: dict, stage: Stage, step: int, rng: np.random.Generator) -> dict:
        return self._losses_of(self._field({**self._fixed, **tensors}), tensors, stage, step, rng)

    def _losses_of(self, field: SdfField, tensors: dict, stage: Stage, step: int, rng: np.random.Generator) -> dict:
        """The losses of a `field` made once from `tensors`: each further one would add to the parameters' gradient by a
        scatter of its own, and the sum of three varies with the order of threads."""
        weights = self.settings.geometry
        current = {**self._fixed, **tensors}
        color, mask = self._image_losses(tensors, stage, step, rng)
        _, gradient, _, _ = surface(field, self._eikonal_points(rng))
        terms = {
            "color": weights.color * stage.color * color,
            "mask": weights.mask * mask,
            "eikonal": weights.eikonal * losses.eikonal_loss(gradient),
            "embedding": weights.embedding * losses.squared_norm(*(current[name] for name in (*SHAPE_LATENTS, "z_r"))),
        }
        if self.landmarks is not None:
            terms["landmark"] = weights.landmark * stage.landmark * self._landmark_loss(field)
        if "deformation" in tensors:
            terms["stay"] = weights.stay * self._stay_loss(field, current, rng)
        return terms

    def _image_losses(self, tensors: dict, stage: Stage, step: int, rng: np.random.Generator):
        """Photometric loss, at the exposure of the training's photos, and mask loss on the rays of one window."""
        for name, value in tensors.items():
            self.parameters[_PARAMETERS[name]] = value
        self.parameters.update()

        window = self.windows[step % len(self.windows)]
        shift = tuple(int(s) for s in rng.integers(window.stride, size=2))
        columns, rows = (index.ravel() for index in window_pixels(window, shift))
        height, width = self.valid.shape
        inside = (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
        columns, rows = columns[inside], rows[inside]
        usable = self.valid[rows, columns]
        columns, rows = columns[usable], rows[usable]
        target = self.target[rows, columns].T

        origin, direction = pixel_rays(self.portrait.camera, columns, rows)
        ray = mi.Ray3f(mi.Point3f(origin.T), mi.Vector3f(direction.T))
        radiance, hit, (_, closest) = self.scene.integrator().sample(self.scene, None, ray)
        covered = hit.numpy() & (target[3] > 0.5)
        difference = losses.display(self.exposure * to_columns(radiance)) - losses.display(mi.TensorXf(target[:3]))
        weight = mi.TensorXf(np.broadcast_to(covered / (3 * max(covered.sum(), 1)), (3, len(rows))).astype(np.float32))
        color = dr.sum(dr.abs(difference) * weight, axis=None)

        # BCE(σ(−α min f)) / α as in IDR, from the logit −α min f, but over all rays. IDR leaves out those that
        # hit inside the mask; no derivative sees which these are, and the outline comes to rest up to ln 2 / α inside.
        alpha = stage.mask_sharpness
        logit = -alpha * closest
        entropy = dr.maximum(logit, 0.0) + dr.log(1 + dr.exp(-dr.abs(logit))) - logit * mi.Float(target[3])
        return color, dr.sum(entropy) / (alpha * max(len(rows), 1))

    def _eikonal_points(self, rng: np.random.Generator):
        """Half uniform in the domain, half near the mesh; [3, points]."""
        half = self.settings.points // 2
        uniform = rng.uniform(DOMAIN_LOWER, DOMAIN_UPPER, (half, 3))
        vertices = self.head.vertices()
        near = vertices[:, rng.integers(vertices.shape[1], size=half)].T + 0.1 * rng.standard_normal((half, 3))
        return mi.TensorXf(np.ascontiguousarray(np.concatenate([uniform, near]).T, dtype=np.float32))

    def _landmark_loss(self, field: SdfField):
        """Weighted mean reprojection error of the landmarks, in face sizes. One fixed-point step from where they are
        placed carries the derivative."""
        unmoved = replace(field, motion=None)
        x = self.landmarks["placed"]
        x = self.landmarks["model"](x - (deform(unmoved, x)[0] - self.landmarks["x_ref"]))
        camera: Camera = self.portrait.camera
        matrix = camera.K @ camera.world_to_camera[:3]
        in_world = _inverse(field.motion) @ dr.concat([x, dr.full(mi.TensorXf, 1.0, (1, x.shape[1]))], axis=0)
        projected = mi.TensorXf(matrix[:, :3].astype(np.float32)) @ in_world
        projected = projected + mi.TensorXf(matrix[:, 3:].astype(np.float32))
        pixels = projected[0:2, :] / projected[2:3, :]
        offset = (pixels - self.landmarks["pixels"]) / self.landmarks["face_size"]
        length = dr.sqrt(dr.sum(offset * offset, axis=0) + 1e-6)
        return dr.sum(dr.reshape(length, (1, -1)) * self.landmarks["weights"], axis=None)

    def _stay_loss(self, field: SdfField, tensors: dict, rng: np.random.Generator):
        """Mean |δ − δ₀| over random points of the domain, δ₀ the prior's deformation network at the same latent: what
        the photo does not show stays what the prior says."""
        points = rng.uniform(DOMAIN_LOWER, DOMAIN_UPPER, (_STAY_POINTS, 3)).astype(np.float32)
        x = mi.TensorXf(np.ascontiguousarray(points.T))
        prior = {name: self.avatar.tensors[name] for name in SHAPE_NETWORKS}
        prior |= {name: dr.detach(tensors[name]) for name in (*SHAPE_LATENTS, POSE)}
        return losses.mean(dr.abs(deform(field, x)[0] - deform(self._field(prior), x)[0]))


def _inverse(motion):
    """[3, 4] matrix (Rᵀ | −Rᵀ t) of a rigid motion (R | t)."""
    turned = dr.concat([dr.reshape(motion[:, k : k + 1], (1, 3)) for k in range(3)], axis=0)
    return dr.concat([turned, -(turned @ motion[:, 3:4])], axis=1)


def moved_camera(camera: Camera, pose: np.ndarray) -> Camera:
    """The camera that sees an unmoved head as `camera` sees the head moved by a `pose` [6] of the field."""
    motion = np.eye(4)
    motion[:3] = rigid_motion(mi.TensorXf(np.reshape(pose, (6, 1)).astype(np.float32))).numpy()
    u, _, v = np.linalg.svd(motion[:3, :3])
    motion[:3, :3] = u @ v
    return replace(camera, world_to_camera=camera.world_to_camera @ np.linalg.inv(motion))
