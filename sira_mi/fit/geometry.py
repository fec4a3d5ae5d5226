"""The geometry stages of section 3.2.1: first the latent codes, then the deformation network too. The reference SDF is
fixed. Two things differ from the paper: the head's pose is optimised too, as its estimate rests on the landmarks of the
mean head, and the rendering network is optimised from the first stage on.

Colour and mask losses go through the `sira_radiance` integrator, one sample a ray; eikonal, landmark and regularising
terms are evaluated on the field."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from sira_mi.avatar.file import Avatar
from sira_mi.avatar.landmark_model import LandmarkModel, place_landmarks, reference_landmarks
from sira_mi.avatar.shape import POSE, SHAPE_LATENTS, SHAPE_NETWORKS, SHAPE_PARAMETERS, HeadShape
from sira_mi.conventions import DOMAIN_LOWER, DOMAIN_UPPER
from sira_mi.fields.columns import to_array, to_columns
from sira_mi.fields.sdf import SdfField, deform, surface
from sira_mi.fit.rays import Window, find_modelled_pixels, pixel_rays, window_around, window_pixels
from sira_mi.fit.shaded import Arrays
from sira_mi.fit.stage import FitSettings, FitTask, Problem, Stage
from sira_mi.fit.state import FitState
from sira_mi.optimisation import losses
from sira_mi.portrait.camera import weigh_landmarks
from sira_mi.portrait.portrait import Portrait

# Where the scene keeps the parameters of the geometry stages.
_SCENE_PARAMETERS = {name: f"head.{name}" for name in (*SHAPE_PARAMETERS, POSE)}
_SCENE_PARAMETERS |= {name: f"integrator.{name}" for name in ("z_r", "rendering")}
# Fewer landmarks than this are not used.
_FEWEST_LANDMARKS = 6
# Points at which the change of the deformation is measured, a step.
_CHANGE_POINTS = 256


@dataclass(frozen=True)
class GeometryWeights:
    """Weights of the losses of section 3.2.1 (IDR: colour 1, mask 100 over a sum of BCE / α, eikonal 0.1)."""

    color: float = 1.0
    mask: float = 4.0  # on a mean over rays, in scene units
    eikonal: float = 0.05
    landmark: float = 0.4  # on reprojection errors in face sizes
    embedding: float = 6e-6  # on ‖z‖², keeps latents where the prior was trained
    deformation_change: float = 0.5  # on mean |δ − δ₀| against the prior's deformation network


@dataclass(frozen=True)
class GeometryStage(Stage):
    """Shape, pose and learned radiance, the deformation network included."""

    mask_sharpness: float = 50.0  # α of the mask loss, per scene unit (IDR: 50 doubling to 1600 on a unit sphere)
    color: float = 1.0  # times the weight of the colour
    landmark: float = 1.0  # times that of the landmarks: the photo itself is the better judge once the head is near
    weights: GeometryWeights = field(default_factory=GeometryWeights)

    def problem(self, task: FitTask, state: FitState) -> Problem:
        return GeometryProblem(self, share_scene(task))


@dataclass(frozen=True)
class LatentStage(GeometryStage):
    """The first geometry stage: the prior's deformation network at other latent codes."""

    def problem(self, task: FitTask, state: FitState) -> Problem:
        return LatentProblem(self, share_scene(task))


@dataclass(frozen=True)
class PhotoLandmarks:
    """The landmarks that the mean head has, L columns, and where the photo shows them."""

    x_ref: Any  # tensor [3, L], reference space
    x: np.ndarray  # [3, L] on the mean head
    model: LandmarkModel
    pixels: Any  # tensor [2, L]; 0 where the photo does not show them
    weights: Any  # tensor [1, L], sum 1; 0 where the photo does not show them
    face_size: float  # height of the face, pixels


def find_landmarks(portrait: Portrait, avatar: Avatar) -> PhotoLandmarks | None:
    """The landmarks of `portrait` on the mean head of `avatar`; None where they are too few."""
    on_head, x_ref = reference_landmarks(avatar)
    pixels = portrait.head_landmarks[on_head]
    in_photo = np.isfinite(pixels).all(axis=1)
    if in_photo.sum() < _FEWEST_LANDMARKS:
        return None
    weights = np.where(in_photo, weigh_landmarks(len(on_head))[on_head], 0).astype(np.float32)
    return PhotoLandmarks(
        x_ref=to_array(x_ref),
        x=avatar.tensors["landmarks"][on_head].T.astype(np.float32),
        model=LandmarkModel(avatar),
        pixels=to_array(np.nan_to_num(pixels).T),
        weights=mi.TensorXf(weights[None] / weights.sum()),
        face_size=float(np.ptp(pixels[in_photo, 1])),
    )


class GeometryScene:
    """A portrait and the head before its camera, starting from `avatar` (written at `avatar_path`). The photo is
    compared at `exposure` times its radiance."""

    def __init__(
        self, portrait: Portrait, avatar: Avatar, avatar_path: str | Path, settings: FitSettings, exposure: float
    ):
        self.portrait, self.avatar, self.settings, self.exposure = portrait, avatar, settings, exposure
        self.valid = find_modelled_pixels(portrait.camera)
        self.windows = self._place_windows(round(settings.rays**0.5))
        path = str(avatar_path)
        self.scene = mi.load_dict(
            {
                "type": "scene",
                "integrator": {"type": "sira_radiance", "avatar": path},
                "head": {"type": "neural_sdf", "avatar": path, "voxel": settings.voxel, "movable": True},
            }
        )
        self.head = self.scene.shapes()[0]
        self.parameters = mi.traverse(self.scene)
        self.head.remesh_every = 1 << 30
        mask = np.where(self.valid, portrait.mask, 0)
        self.target = np.concatenate([exposure * portrait.image, mask[..., None]], axis=-1).astype(np.float32)
        self.landmarks = find_landmarks(portrait, avatar)

    def _place_windows(self, size: int) -> list[Window]:
        """A window of `size`² rays around all modelled pixels, and one around the face where it is known."""
        rows, columns = np.nonzero(self.valid)
        whole = window_around(columns.min(), rows.min(), columns.max(), rows.max(), size)
        known = self.portrait.landmarks[np.isfinite(self.portrait.landmarks).all(axis=1)]
        if len(known) == 0:
            return [whole]
        low, high = known.min(axis=0), known.max(axis=0)
        margin = 0.15 * (high - low)
        (x0, y0), (x1, y1) = low - margin, high + margin
        return [whole, window_around(x0, y0, x1, y1, size)]

    def refresh(self, state: FitState) -> None:
        """Extracts the mesh that rays start from at the parameters of `state`. Raises EmptySurfaceError."""
        self.head.remesh_at_next_update()
        for name, value in state.parameters(_SCENE_PARAMETERS).items():
            self.parameters[_SCENE_PARAMETERS[name]] = mi.Float(value)
        self.parameters.set_dirty(_SCENE_PARAMETERS[POSE])
        self.parameters.update()

    def trace(self, parameters: Arrays, step: int, rng: np.random.Generator) -> tuple[Any, Any, Any, np.ndarray]:
        """Radiance [3, n], hits [n] and closest approach [n] of rays through one window, by the field at `parameters`;
        and the photo's radiance and mask [4, n] there."""
        for name, value in parameters.items():
            self.parameters[_SCENE_PARAMETERS[name]] = value
        self.parameters.update()

        window = self.windows[step % len(self.windows)]
        right, down = (int(s) for s in rng.integers(window.stride, size=2))
        columns, rows = (index.ravel() for index in window_pixels(window, (right, down)))
        height, width = self.valid.shape
        inside = (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
        columns, rows = columns[inside], rows[inside]
        usable = self.valid[rows, columns]
        columns, rows = columns[usable], rows[usable]

        origin, direction = pixel_rays(self.portrait.camera, columns, rows)
        ray = mi.Ray3f(mi.Point3f(origin.T), mi.Vector3f(direction.T))
        radiance, hit, (_, closest) = self.scene.integrator().sample(self.scene, None, ray)
        return radiance, hit, closest, self.target[rows, columns].T


def share_scene(task: FitTask) -> GeometryScene:
    """The scene of the geometry stages, which starts from the prior."""

    def make() -> GeometryScene:
        return GeometryScene(task.portrait, task.prior, task.prior_path, task.settings, task.exposure())

    return task.share(GeometryScene, make)


class GeometryProblem:
    """The losses of a geometry stage."""

    def __init__(self, stage: GeometryStage, scene: GeometryScene):
        self.stage, self.scene = stage, scene

    def start(self, state: FitState) -> FitState:
        return state

    def refresh(self, state: FitState) -> None:
        """Extracts the mesh and finds the landmarks on it. Raises EmptySurfaceError."""
        self.scene.refresh(state)
        self._fixed = {name: mi.Float(value) for name, value in state.parameters(_SCENE_PARAMETERS).items()}
        if (landmarks := self.scene.landmarks) is not None:
            unmoved = replace(self._field(self._fixed), motion=None)
            self._landmarks_at = place_landmarks(unmoved, landmarks.x_ref, landmarks.x)

    def losses(self, parameters: Arrays, step: int, rng: np.random.Generator) -> Arrays:
        # One field for all losses: each further one would add to the parameters' gradient by a scatter of its own, and
        # the sum of three varies with the order of threads.
        return self._losses_of(self._field({**self._fixed, **parameters}), parameters, step, rng)

    def _losses_of(self, shape: SdfField, parameters: Arrays, step: int, rng: np.random.Generator) -> Arrays:
        """The losses of a field made from `parameters`."""
        terms = self._shape_losses(shape, parameters, step, rng)
        change = self._deformation_change(shape, {**self._fixed, **parameters}, rng)
        return {**terms, "deformation_change": self.stage.weights.deformation_change * change}

    def _field(self, parameters: Arrays) -> SdfField:
        return HeadShape(self.scene.avatar.architecture).field(parameters)

    def _shape_losses(self, shape: SdfField, parameters: Arrays, step: int, rng: np.random.Generator) -> Arrays:
        """All losses but that of the deformation's change."""
        stage, weights = self.stage, self.stage.weights
        current = {**self._fixed, **parameters}
        latents = (*SHAPE_LATENTS, "z_r")
        color, mask = self._image_losses(parameters, step, rng)
        _, gradient, _, _ = surface(shape, self._eikonal_points(rng))
        terms = {
            "color": weights.color * stage.color * color,
            "mask": weights.mask * mask,
            "eikonal": weights.eikonal * losses.eikonal_loss(gradient),
            "embedding": weights.embedding * losses.squared_norm(*(current[name] for name in latents)),
        }
        if self.scene.landmarks is not None:
            terms["landmark"] = weights.landmark * stage.landmark * self._landmark_loss(shape, self.scene.landmarks)
        return terms

    def _image_losses(self, parameters: Arrays, step: int, rng: np.random.Generator) -> tuple[Any, Any]:
        """Photometric loss, at the exposure of the training's photos, and mask loss on the rays of one window."""
        radiance, hit, closest, target = self.scene.trace(parameters, step, rng)
        count = target.shape[1]
        covered = hit.numpy() & (target[3] > 0.5)
        shown = losses.display(self.scene.exposure * to_columns(radiance))
        difference = shown - losses.display(mi.TensorXf(target[:3]))
        weight = mi.TensorXf(np.broadcast_to(covered / (3 * max(covered.sum(), 1)), (3, count)).astype(np.float32))
        color = dr.sum(dr.abs(difference) * weight, axis=None)

        # BCE(σ(−α min f)) / α as in IDR, from the logit −α min f, but over all rays. IDR leaves out those that
        # hit inside the mask; no derivative sees which these are, and the outline comes to rest up to ln 2 / α inside.
        alpha = self.stage.mask_sharpness
        logit = -alpha * closest
        entropy = dr.maximum(logit, 0.0) + dr.log(1 + dr.exp(-dr.abs(logit))) - logit * mi.Float(target[3])
        return color, dr.sum(entropy) / (alpha * max(count, 1))

    def _eikonal_points(self, rng: np.random.Generator) -> Any:
        """Half uniform in the domain, half near the mesh; tensor [3, points]."""
        half = self.scene.settings.points // 2
        uniform = rng.uniform(DOMAIN_LOWER, DOMAIN_UPPER, (half, 3))
        vertices = self.scene.head.vertices()
        near = vertices[:, rng.integers(vertices.shape[1], size=half)].T + 0.1 * rng.standard_normal((half, 3))
        return to_array(np.concatenate([uniform, near]).T)

    def _landmark_loss(self, shape: SdfField, landmarks: PhotoLandmarks) -> Any:
        """Weighted mean reprojection error of the landmarks, in face sizes. One fixed-point step from where they were
        found carries the derivative."""
        unmoved = replace(shape, motion=None)
        x = self._landmarks_at
        x = landmarks.model(x - (deform(unmoved, x)[0] - landmarks.x_ref))
        camera = self.scene.portrait.camera
        matrix = camera.K @ camera.world_to_camera[:3]
        in_world = _inverse(shape.motion) @ dr.concat([x, dr.full(mi.TensorXf, 1.0, (1, x.shape[1]))], axis=0)
        projected = mi.TensorXf(matrix[:, :3].astype(np.float32)) @ in_world
        projected = projected + mi.TensorXf(matrix[:, 3:].astype(np.float32))
        pixels = projected[0:2, :] / projected[2:3, :]
        offset = (pixels - landmarks.pixels) / landmarks.face_size
        length = losses.norm(offset, 1e-6)
        return dr.sum(dr.reshape(length, (1, -1)) * landmarks.weights, axis=None)

    def _deformation_change(self, shape: SdfField, parameters: Arrays, rng: np.random.Generator) -> Any:
        """Mean |δ − δ₀| over random points of the domain, δ₀ by the prior's deformation network at the same latent
        code. It keeps what the photo does not show as the prior has it."""
        x = to_array(rng.uniform(DOMAIN_LOWER, DOMAIN_UPPER, (_CHANGE_POINTS, 3)).T)
        prior = {name: self.scene.avatar.tensors[name] for name in SHAPE_NETWORKS}
        prior |= {name: dr.detach(parameters[name]) for name in (*SHAPE_LATENTS, POSE)}
        return losses.mean(dr.abs(deform(shape, x)[0] - deform(self._field(prior), x)[0]))


class LatentProblem(GeometryProblem):
    """The losses of the first geometry stage: the deformation network is the prior's, and has no change."""

    def start(self, state: FitState) -> FitState:
        """Scales the learned radiance to the photo's exposure."""
        rendering = state.avatar["rendering"].copy()
        rendering[-3:] -= np.float32(np.log(self.scene.exposure))
        return state.with_parameters({"rendering": rendering})

    def _losses_of(self, shape: SdfField, parameters: Arrays, step: int, rng: np.random.Generator) -> Arrays:
        return self._shape_losses(shape, parameters, step, rng)


def _inverse(motion: Any) -> Any:
    """[3, 4] matrix (Rᵀ | −Rᵀ t) of a rigid motion (R | t)."""
    turned: Any = dr.concat([dr.reshape(motion[:, k : k + 1], (1, 3)) for k in range(3)], axis=0)
    return dr.concat([turned, -(turned @ motion[:, 3:4])], axis=1)
