"""AF-SM, the appearance factorization model: self-supervised auto-decoder training, eq. 10 (section 3.1.4).

It sees the images only, never the true albedo. Points enter through the frozen deformation of a trained SA-SM."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.spatial import cKDTree

from sira_mi.conventions import LUMINANCE
from sira_mi.fields.appearance import SKIN_SPECULAR, diffuse_albedo, illumination, specular_albedo
from sira_mi.fields.columns import from_columns, to_columns
from sira_mi.fields.mlp import initial_parameters, layers
from sira_mi.fields.sdf import SdfField, deform, evaluate_in_chunks, in_three, surface
from sira_mi.models import losses
from sira_mi.models.avatar import AvatarArchitecture
from sira_mi.models.scenes import TrainingScene
from sira_mi.sg.lobes import unpack_raw
from sira_mi.sg.shading import diffuse_irradiance, shade
from sira_mi.sg.specular import SpecularLobes, specular_integrals, specular_lobes

NETWORKS = ("diffuse_albedo", "specular_albedo", "illumination")
LATENTS = ("z_a", "z_s", "z_l")

# Landmarks on bare facial skin: upper cheeks, bridge of the nose, forehead between the brows.
SKIN_LANDMARKS = (50, 280, 101, 330, 117, 346, 118, 347, 6, 197, 9, 151)
# Measured facial skin in log linear RGB. The patches "light skin" and "dark skin" of the ColorChecker, made after
# measured skin (McCamy et al. 1976), sRGB (194, 150, 130) and (115, 82, 68), give its mean and the axis of skin tone;
# across that axis skin varies as within one population (Yun et al. 2010, a* ± 2.65 and b* ± 2.39).
SKIN_TONE_MEAN = np.array([-1.190, -1.830, -2.175])
SKIN_TONE_AXIS = np.array([0.524, 0.587, 0.617])
_SKIN_LUMINANCE = np.array(LUMINANCE) * np.exp(SKIN_TONE_MEAN)
# Change of log luminance along the axis.
_SKIN_TONE_SLOPE = float(_SKIN_LUMINANCE @ SKIN_TONE_AXIS / _SKIN_LUMINANCE.sum())
# Observations within this distance of a landmark tell how bright the skin is in the photos, scene units.
_SKIN_RADIUS = 0.06
# Deviation from measured skin from which on the loss grows linearly, standard deviations.
_SKIN_OUTLIER = 2.0


@dataclass(frozen=True)
class AppearanceTraining:
    """Settings of the AF-SM training; λ as in eq. 10."""

    steps: int = 4000
    scenes: int = 24  # scenes a step: more of them and fewer points, so that latents are visited often
    points: int = 128  # a scene and step
    frozen_points: int = 6000  # of each scene's points, drawn once, at which the frozen deformation is evaluated
    learning_rate: float = 2e-3  # of the networks; falls to a twentieth along a cosine
    latent_rate: float = 4e-3  # of the latents
    roughness: float = 0.5  # of skin (FLARE: 0.5 ± 0.1), fixed
    jitter: float = 0.03  # ε of L_Reg, scene units (NeRFactor 0.01 on another scale)
    embedding: float = 1e-4  # λ6, on ‖z‖²
    smoothness: float = 0.05  # λ7 (NeRFactor)
    specular_anchor: float = 0.01  # pull of the log specular albedo to that of skin, which images hardly determine
    white_light: float = 0.02  # pull of the light towards grey, which settles the colour of light against albedo
    skin_tone: float = 1e-3  # on the deviations of a face's skin albedo from measured skin, which settles the
    # level and colour of the light against the albedo's
    skin_radiance: float = 0.286  # luminance of average skin in a photo: the geometric mean of the collection's photos
    skin_deviations: tuple[float, float] = (0.6, 0.08)  # of log skin albedo along and across the axis of skin tone:
    # half a stop from the tone that the photo's brightness tells, and Yun et al. 2010


@dataclass(frozen=True)
class FrozenScene:
    """What the AF-SM sees of a scene: the frozen deformation's outputs at its points, and its observations."""

    x_ref: np.ndarray  # [3, P]
    gamma: np.ndarray  # [N_γ, P]
    normals: np.ndarray  # [3, P] unit, of the field
    jittered_x_ref: np.ndarray  # [3, P] at x + ε
    jittered_gamma: np.ndarray  # [N_γ, P]
    skin_x_ref: np.ndarray  # [3, L] at `SKIN_LANDMARKS`
    skin_gamma: np.ndarray  # [N_γ, L]
    skin_weight: np.ndarray  # [1, L] shares of the known landmarks; all 0 where none is known
    skin_radiance: float  # luminance of the skin in the photos, geometric mean; NaN where none is seen
    sample_point: np.ndarray  # [C] index of the point of observation c
    sample_view: np.ndarray  # [3, C] unit direction from the camera to the point
    sample_color: np.ndarray  # [3, C] linear radiance


def freeze_scene(
    architecture: AvatarArchitecture,
    shape: dict[str, np.ndarray],
    z_sdf: np.ndarray,
    scene: TrainingScene,
    settings: AppearanceTraining,
    rng: np.random.Generator,
) -> FrozenScene:
    """Evaluates a trained SA-SM (`shape`: its `deformation` and `reference`) with latent `z_sdf` at points of a
    scene."""
    networks = architecture.networks
    field = SdfField(
        layers(networks["deformation"], mi.Float(shape["deformation"]), mi.TensorXf(z_sdf[:, None])),
        layers(networks["reference"], mi.Float(shape["reference"])),
        architecture.sdf_octaves,
    )
    count = len(scene.points)
    chosen = np.sort(rng.choice(count, min(settings.frozen_points, count), replace=False))
    x = scene.points[chosen].T
    moved = x + settings.jitter * rng.standard_normal(x.shape).astype(np.float32)
    _, gradient, x_ref, gamma = evaluate_in_chunks(lambda p: surface(field, p), x)
    jittered_x_ref, jittered_gamma = evaluate_in_chunks(lambda p: deform(field, p), moved)
    landmarks = scene.landmarks[list(SKIN_LANDMARKS)]
    known = np.isfinite(landmarks).all(axis=1)
    skin_x_ref, skin_gamma = evaluate_in_chunks(lambda p: deform(field, p), np.where(known[:, None], landmarks, 0).T)
    place = np.full(count, -1)
    place[chosen] = np.arange(len(chosen))
    samples = np.flatnonzero(place[scene.sample_point] >= 0)
    return FrozenScene(
        x_ref,
        gamma,
        gradient / np.maximum(np.linalg.norm(gradient, axis=0), 1e-6),
        jittered_x_ref,
        jittered_gamma,
        skin_x_ref,
        skin_gamma,
        known[None, :].astype(np.float32) / max(known.sum(), 1),
        skin_radiance(scene, landmarks[known]),
        place[scene.sample_point[samples]],
        scene.views(samples).T,
        scene.sample_color[samples].T,
    )


def skin_radiance(scene: TrainingScene, landmarks: np.ndarray) -> float:
    """Geometric mean of the luminance of the observations near `landmarks` [L, 3]; NaN when there are none."""
    if not len(landmarks):
        return float("nan")
    near = cKDTree(landmarks).query(scene.points, distance_upper_bound=_SKIN_RADIUS)[0] < _SKIN_RADIUS
    luminance = scene.sample_color[near[scene.sample_point]] @ np.array(LUMINANCE)
    return float(np.exp(np.mean(np.log(np.maximum(luminance, 1e-3))))) if len(luminance) else float("nan")


def initial_appearance_model(architecture: AvatarArchitecture, scenes: int, seed: int) -> dict:
    """Starting values of the three decoders and the latents [dim, scenes]."""
    rng = np.random.default_rng([seed, 1])
    networks = architecture.networks
    return {
        **{name: initial_parameters(networks[name], rng, output_scale=0.1) for name in NETWORKS},
        **{
            name: (rng.standard_normal((architecture.latents[name], scenes)) * 0.1).astype(np.float32)
            for name in LATENTS
        },
    }


@dataclass(frozen=True)
class AppearanceBatch:
    """Observations of some scenes, those of one scene consecutive; tensors."""

    scenes: mi.TensorXf  # [total scenes, S] one-hot columns
    count: int  # S
    x_ref: mi.TensorXf  # [3, S·n]
    gamma: mi.TensorXf
    normals: mi.TensorXf
    jittered_x_ref: mi.TensorXf
    jittered_gamma: mi.TensorXf
    skin_x_ref: mi.TensorXf  # [3, S·L]
    skin_gamma: mi.TensorXf
    skin_weight: mi.TensorXf  # [1, S·L]
    skin_radiance: np.ndarray  # [S]
    views: mi.TensorXf  # [3, S·n] from the camera to the point
    colors: mi.TensorXf  # [3, S·n]


def draw_batch(scenes: list[FrozenScene], settings: AppearanceTraining, rng: np.random.Generator) -> AppearanceBatch:
    """A random batch of observations."""
    chosen = np.sort(rng.choice(len(scenes), min(settings.scenes, len(scenes)), replace=False))
    names = ("x_ref", "gamma", "normals", "jittered_x_ref", "jittered_gamma")
    skin = ("skin_x_ref", "skin_gamma", "skin_weight")
    parts: dict[str, list] = {name: [] for name in (*names, *skin, "views", "colors")}
    for k in chosen:
        frozen = scenes[k]
        samples = rng.integers(len(frozen.sample_point), size=settings.points)
        points = frozen.sample_point[samples]
        for name in names:
            parts[name].append(getattr(frozen, name)[:, points])
        for name in skin:
            parts[name].append(getattr(frozen, name))
        parts["views"].append(frozen.sample_view[:, samples])
        parts["colors"].append(frozen.sample_color[:, samples])
    one_hot = np.zeros((len(scenes), len(chosen)), np.float32)
    one_hot[chosen, np.arange(len(chosen))] = 1
    tensor = {k: mi.TensorXf(np.ascontiguousarray(np.concatenate(v, axis=1))) for k, v in parts.items()}
    level = np.array([scenes[k].skin_radiance for k in chosen])
    return AppearanceBatch(mi.TensorXf(one_hot), len(chosen), skin_radiance=level, **tensor)


def physical_radiance(albedo, specular, normals, views, roughness, k_s, lobes):
    """Eq. 8 in closed form: diffuse and specular radiance [3, N] of surface points under `lobes` [N_l, 7].

    `albedo` [3, N], `specular` [1, N], `roughness` and `k_s` numbers or [1, 1], unit `normals` [3, N], `views` [3, N]
    from the camera to the point. Where a normal faces away from the camera there is no specular radiance."""
    irradiance, specular_radiance = shade(
        from_columns(normals, mi.Vector3f),
        from_columns(-views, mi.Vector3f),
        from_columns(specular, mi.Float),
        mi.Float(roughness),
        lobes,
    )
    return albedo * to_columns(irradiance) * (1 / np.pi), to_columns(specular_radiance) * k_s


def _integrate_lobe(point, axis, sharpness, amplitude):
    """Irradiance, white and grazing specular radiance `[..., 3]` of one light lobe."""
    white, grazing = specular_integrals(point, axis, sharpness)
    return diffuse_irradiance(point.normal, axis, sharpness, amplitude), amplitude * white, amplitude * grazing


class _SumOfLights(dr.CustomOp):
    """Irradiance, white and grazing specular radiance of S·n points, n consecutive ones under each of S lights.

    `packed` is the flat array of lights [S, N_l, 7]; only it is differentiated, the points are constants. Each lane
    of the adjoint writes its point's share of every lobe's gradient to a place of its own, and the shares are then
    added by a block reduction: sums of one fixed order, the same bits on every run."""

    def eval(self, packed, lights, *point):
        width = dr.width(*point)
        self.point = SpecularLobes(*(value + dr.zeros(type(value), width) for value in point))
        self.packed, self.count, self.points = packed, len(packed) // (7 * lights), width // lights
        dr.eval(self.point, packed)
        first = dr.arange(mi.UInt32, width) // self.points * self.count

        def body(index, *sums):
            axis, sharpness, amplitude = unpack_raw(packed, first + index)
            parts = _integrate_lobe(self.point, dr.normalize(axis), sharpness, amplitude)
            return index + 1, *(total + part for total, part in zip(sums, parts, strict=True))

        return dr.while_loop(
            state=(mi.UInt32(0), mi.Color3f(0.0), mi.Color3f(0.0), mi.Color3f(0.0)),
            cond=lambda index, *_: index < self.count,
            body=body,
            labels=("index", "irradiance", "white", "grazing"),
        )[1:]

    def backward(self):
        with dr.resume_grad():
            self.set_grad_in("packed", self._gradient(self.grad_out()))

    def _gradient(self, gradient):
        width = dr.width(*self.point)
        gradient = tuple(value + dr.zeros(type(value), width) for value in gradient)
        dr.eval(gradient)
        lane = dr.arange(mi.UInt32, width)
        light = lane // self.points
        place = light * (self.count * self.points) + lane % self.points
        shares = [dr.empty(mi.Float, width * self.count) for _ in range(7)]

        def body(index):
            inputs = unpack_raw(self.packed, light * self.count + index)
            dr.enable_grad(inputs)
            parts = _integrate_lobe(self.point, dr.normalize(inputs[0]), *inputs[1:])
            loss = sum(dr.dot(part, weight) for part, weight in zip(parts, gradient, strict=True))
            dr.backward(loss, dr.ADFlag.Default | dr.ADFlag.AllowNoGrad)
            axis, sharpness, amplitude = (dr.grad(value) for value in inputs)
            for share, value in zip(shares, (*axis, sharpness, *amplitude), strict=True):
                dr.scatter(share, value, place + index * self.points)
            return (index + 1,)

        dr.while_loop((mi.UInt32(0),), lambda index: index < self.count, body, labels=("index",))
        return dr.ravel(mi.ArrayXf([dr.block_sum(share, self.points) for share in shares]))

    def name(self):
        return "sum_of_lights"


def shade_scenes(normals, views, specular, roughness: float, lobes, scenes: int):
    """Irradiance and specular radiance [3, S·n] of the points of `scenes` S scenes, each scene's points consecutive and
    under its own light `lobes` [N_l, 7, S]: `sg.shading.shade` for all scenes in one launch. Unit `normals` and
    `views` [3, S·n], from the camera to the point, are constants; differentiable in `specular` [1, S·n] and `lobes`."""
    point = specular_lobes(from_columns(normals, mi.Vector3f), from_columns(-views, mi.Vector3f), mi.Float(roughness))
    packed = dr.moveaxis(lobes, 2, 0).array
    irradiance, white, grazing = dr.custom(_SumOfLights, packed, scenes, *point)
    return to_columns(irradiance), to_columns(dr.lerp(grazing, white, from_columns(specular, mi.Float)))


def skin_tone_loss(albedo, weight, radiance: np.ndarray, settings: AppearanceTraining):
    """Mean over scenes of the squared deviation x² of the log of a scene's mean skin albedo from measured skin, in
    standard deviations along and across the axis of skin tone; far out it grows with |x| only (pseudo-Huber), so that
    painted faces are possible. `albedo` [3, S·L], `weight` [1, S·L] and `radiance` [S] as in `FrozenScene`; scenes of
    weight 0 do not count.

    Photos are taken to be exposed for the light: along the axis, skin that is brighter in its photos than
    `settings.skin_radiance` is expected to be lighter by as much."""
    scenes = len(radiance)
    mean = dr.sum(dr.reshape(albedo * in_three(weight), (3, scenes, -1)), axis=2)
    known = dr.sum(dr.reshape(weight, (1, scenes, -1)), axis=2)
    axis = SKIN_TONE_AXIS / np.linalg.norm(SKIN_TONE_AXIS)
    shift = np.nan_to_num(np.log(radiance / settings.skin_radiance)) / _SKIN_TONE_SLOPE
    centre = mi.TensorXf((SKIN_TONE_MEAN[:, None] + axis[:, None] * shift).astype(np.float32))
    deviation = dr.log(mean + in_three(1.0 - known) * dr.exp(centre)) - centre
    along = mi.TensorXf(axis[None, :].astype(np.float32)) @ deviation
    along = dr.sum(along * along, axis=0)
    across = dr.sum(deviation * deviation, axis=0) - along
    wide, narrow = settings.skin_deviations
    square = along * (1 / wide**2) + across * (1 / narrow**2)
    bend = 2.0 * _SKIN_OUTLIER**2
    return losses.mean(bend * (dr.sqrt(1.0 + square * (1 / _SKIN_OUTLIER**2)) - 1.0))


def appearance_losses(architecture, settings: AppearanceTraining, parameters: dict, batch: AppearanceBatch) -> dict:
    """Every term of eq. 10 and the anchors, unweighted, by the names of `AppearanceTraining`."""
    z_a, z_s, z_l = (parameters[name] @ batch.scenes for name in LATENTS)
    networks = architecture.networks
    diffuse = layers(networks["diffuse_albedo"], parameters["diffuse_albedo"], z_a)
    speculars = layers(networks["specular_albedo"], parameters["specular_albedo"], z_s)
    albedo = diffuse_albedo(diffuse, architecture.albedo_octaves, batch.x_ref, batch.gamma)
    moved = diffuse_albedo(diffuse, architecture.albedo_octaves, batch.jittered_x_ref, batch.jittered_gamma)
    specular = specular_albedo(speculars, architecture.specular_octaves, batch.x_ref)
    lobes = illumination(layers(networks["illumination"], parameters["illumination"]), z_l)

    irradiance, specular_radiance = shade_scenes(
        batch.normals, batch.views, specular, settings.roughness, lobes, batch.count
    )
    radiance = albedo * irradiance * (1 / np.pi) + specular_radiance
    skin = diffuse_albedo(diffuse, architecture.albedo_octaves, batch.skin_x_ref, batch.skin_gamma)
    difference = albedo - moved
    anchor = dr.log(specular * (1 / SKIN_SPECULAR))
    amplitude = dr.log(lobes[:, 4:7, :])
    grey = amplitude - in_three(dr.reshape(dr.mean(amplitude, axis=1), (-1, 1, batch.count)), axis=1)
    return {
        "color": losses.photometric_loss(radiance, batch.colors),
        "embedding": losses.embedding_loss(z_a) + losses.embedding_loss(z_s) + losses.embedding_loss(z_l),
        "smoothness": losses.mean(dr.abs(difference)),
        "specular_anchor": losses.mean(anchor * anchor),
        "white_light": losses.mean(grey * grey),
        "skin_tone": skin_tone_loss(skin, batch.skin_weight, batch.skin_radiance, settings),
    }


def weighted_sum(terms: dict, settings: AppearanceTraining):
    """L_Col + Σ λ L."""
    return sum((getattr(settings, k) * v for k, v in terms.items() if k != "color"), terms["color"])


def rates(settings: AppearanceTraining, step: int) -> dict[str, float]:
    """Learning rate of every parameter at `step`."""
    fall = 0.05 + 0.95 * 0.5 * (1 + np.cos(np.pi * step / settings.steps))
    return {
        **dict.fromkeys(NETWORKS, settings.learning_rate * fall),
        **dict.fromkeys(LATENTS, settings.latent_rate * fall),
    }


def training_step(architecture, settings: AppearanceTraining, optimizer, batch: AppearanceBatch) -> dict[str, float]:
    """One Adam step; returns the unweighted terms."""
    dr.enable_grad(*(optimizer[name] for name in optimizer))
    terms = appearance_losses(architecture, settings, dict(optimizer.items()), batch)
    dr.backward(weighted_sum(terms, settings))
    optimizer.step()
    return {name: float(value.numpy().item()) for name, value in terms.items()}
