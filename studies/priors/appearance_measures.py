"""Errors of a prior's appearance model on unseen heads: re-rendering of held-out views, and albedos against the truth,
which neither the training nor the fit of the latents uses.

Scores are dictionaries of numbers, keyed `[points_ or image_]quantity_measure`. Albedo scores come with two baselines:
`constant_`, the training scenes' mean albedo everywhere, and `mean_`, the albedo field of the mean head. PSNR is in dB
with peak 1; `_srgb` marks sRGB-coded values, `_scaled` one least-squares factor a channel, which removes the
ambiguity of exposure. Specular albedo is measured as strength (reflectance at normal incidence F0 / 0.08) and as F0."""

from __future__ import annotations

import dataclasses
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from zipfile import BadZipFile

import drjit as dr
import mitsuba as mi
import numpy as np

from sira_mi.avatar.decoders import diffuse_albedo, illumination, specular_albedo
from sira_mi.avatar.file import Avatar, save_avatar
from sira_mi.avatar.shape import HeadShape, head_of
from sira_mi.colour import linear_to_srgb
from sira_mi.conventions import HELD_OUT_VIEWS, MILLIMETRES_PER_UNIT
from sira_mi.errors import InputError
from sira_mi.fields.columns import evaluate_in_chunks, from_columns, to_columns, unit_columns
from sira_mi.fields.mlp import layers
from sira_mi.fields.sdf import surface
from sira_mi.optimisation.adam import adam, cosine_fall, parameter_values, take_step
from sira_mi.portrait.landmarks import NOSE_TIP
from sira_mi.relight.pictures import psnr
from sira_mi.sg.radiance import Material, closed_form_radiance, reflect
from sira_mi.sg.shading import shade
from sira_mi.training import af_sm
from sira_mi.training.prior import whitening
from sira_mi.training.scenes import TrainingScene
from studies.measures import (
    F0_OF_STRENGTH,
    FACE_RADIUS,
    leakage,
    luminance,
    scale_channels,
    ssim_inside,
)

_ARRAYS = ("points", "albedo", "specular", "visible", "colors", "K", "world_to_camera", "images", "masks", "landmarks")


@dataclass(frozen=True)
class LatentFit:
    """Settings of `fit_appearance_latents`."""

    steps: int = 300
    scenes: int = 16  # scenes a step
    points: int = 256  # observations a scene and step
    rate: float = 0.1  # learning rate of the latents, which are standard normal; falls to a twentieth along a cosine
    embedding: float = 1e-5  # on ‖z‖², in the place of the training's λ6: the prior's latents are standard normal
    beta_2: float = 0.99  # of Adam


@dataclass(frozen=True, eq=False)
class HeldOut:
    """The part of a scene that training never uses; coordinates in scene units, colours and albedos linear."""

    name: str
    source: str  # of the head, empty where the manifest has none
    group: str  # of skin tone, empty where the manifest has none
    points: np.ndarray  # [P, 3]
    observed: np.ndarray  # [P] bool, visible in any view at all
    face: np.ndarray  # [P] bool
    albedo: np.ndarray  # [P, 3] true diffuse albedo
    specular: np.ndarray  # [P] true specular strength
    sample_point: np.ndarray  # [C] index of the point of observation c of a held-out view
    sample_view: np.ndarray  # [C, 3] unit direction from the camera to the point
    sample_color: np.ndarray  # [C, 3] linear radiance
    K: np.ndarray  # [h, 3, 3] of the held-out views, pixels
    world_to_camera: np.ndarray  # [h, 4, 4]
    images: np.ndarray  # [h, H, W, 3] linear radiance
    masks: np.ndarray  # [h, H, W] bool
    albedo_images: np.ndarray | None  # [h, H, W, 3] true diffuse albedo; None in a collection without
    specular_images: np.ndarray | None  # [h, H, W] true specular strength


def load_held_out(path: Path, source: str = "", group: str = "") -> HeldOut:
    """Reads the held-out part of a scene file. Raises InputError for a file that is not a scene."""
    try:
        with np.load(path, allow_pickle=False) as file:
            data = {name: file[name] for name in _ARRAYS}
            pictures = [
                file[name].astype(np.float32) if name in file else None for name in ("albedo_images", "specular_images")
            ]
    except (OSError, KeyError, ValueError, EOFError, BadZipFile) as error:
        raise InputError(f"{path} is not a scene of a collection: {error}") from error
    views = list(HELD_OUT_VIEWS)
    points, pose = data["points"].astype(np.float32), data["world_to_camera"][views].astype(np.float32)
    usable = (data["visible"] & np.isfinite(data["colors"]).all(axis=2))[:, views]
    point, view = np.nonzero(usable)
    centres = -np.einsum("vji,vj->vi", pose[:, :3, :3], pose[:, :3, 3])
    way = points[point] - centres[view]
    nose = np.nan_to_num(data["landmarks"][NOSE_TIP], nan=np.inf)
    return HeldOut(
        name=path.stem,
        source=source,
        group=group,
        points=points,
        observed=data["visible"].any(axis=1),
        face=np.linalg.norm(points - nose, axis=1) * MILLIMETRES_PER_UNIT < FACE_RADIUS,
        albedo=data["albedo"].astype(np.float32),
        specular=data["specular"].astype(np.float32),
        sample_point=point,
        sample_view=way / np.linalg.norm(way, axis=1, keepdims=True),
        sample_color=data["colors"][:, views][point, view].astype(np.float32),
        K=data["K"][views].astype(np.float64),
        world_to_camera=pose.astype(np.float64),
        images=data["images"][views].astype(np.float32),
        masks=data["masks"][views] > 0,
        albedo_images=pictures[0],
        specular_images=pictures[1],
    )


def fit_appearance_latents(
    avatar: Avatar,
    scenes: Sequence[TrainingScene],
    z_sdf: np.ndarray,
    settings: af_sm.AppearanceTraining,
    fit: LatentFit | None = None,
    seed: int = 0,
) -> dict[str, np.ndarray]:
    """z_a, z_s and z_l [dim, S] of `scenes`, whose shape latents `z_sdf` [dim, S] are given, by the AF-SM's own losses
    on the scenes' observations; everything else is frozen, and true albedo is never used."""
    fit = fit or LatentFit()
    shape = {**avatar.tensors, "z_sdf": z_sdf}
    frozen = [
        af_sm.freeze_scene(avatar.architecture, head_of(shape, k), scene, settings, np.random.default_rng([seed, 5, k]))
        for k, scene in enumerate(scenes)
    ]
    settings = dataclasses.replace(
        settings, steps=fit.steps, scenes=fit.scenes, points=fit.points, embedding=fit.embedding
    )
    networks = {name: mi.Float(avatar.tensors[name]) for name in af_sm.NETWORKS}
    start = {name: np.repeat(avatar.tensors[name][:, None], len(scenes), axis=1) for name in af_sm.LATENTS}
    optimizer = adam(start, dict.fromkeys(af_sm.LATENTS, fit.rate), fit.beta_2)
    for step in range(fit.steps):
        optimizer.set_learning_rate(dict.fromkeys(af_sm.LATENTS, fit.rate * cosine_fall(step / fit.steps, 0.05)))
        batch = af_sm.draw_batch(frozen, settings, np.random.default_rng([seed, 6, step]))

        def losses(latents: dict, batch: af_sm.AppearanceBatch = batch) -> dict:
            return af_sm.appearance_losses(avatar.architecture, settings, networks | latents, batch)

        take_step(optimizer, losses, lambda terms: af_sm.weighted_sum(terms, settings))
    return parameter_values(optimizer)


def training_latents(appearance: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The latents [dim, scenes] of a finished training, whitened as those of its prior."""
    result = {}
    for name in af_sm.LATENTS:
        mean, spread = whitening(appearance[name])
        result[name] = (np.linalg.pinv(spread) @ (appearance[name] - mean[:, None])).astype(np.float32)
    return result


@dataclass(frozen=True)
class Factors:
    """Albedos, irradiance and radiance of a fitted head at N surface points."""

    albedo: np.ndarray  # [3, N]
    specular: np.ndarray  # [1, N] reflectance at normal incidence
    irradiance: np.ndarray  # [3, N]
    radiance: np.ndarray  # [3, N]


def surface_inputs(avatar: Avatar, z_sdf: np.ndarray, points: np.ndarray) -> list[np.ndarray]:
    """x_ref [3, N], γ [N_γ, N] and unit normals [3, N] of the field with latent `z_sdf` [dim] at points [N, 3]."""
    field = HeadShape(avatar.architecture).field({**avatar.tensors, "z_sdf": z_sdf})
    _, gradient, x_ref, gamma = evaluate_in_chunks(lambda x: surface(field, x), points.T)
    return [x_ref, gamma, unit_columns(gradient)]


def factors(avatar: Avatar, latents: dict[str, np.ndarray], inputs: Sequence[np.ndarray], views: np.ndarray) -> Factors:
    """The appearance of latents z_a, z_s, z_l [dim] at points given by `surface_inputs`, seen along unit `views`
    [3, N] from the camera."""
    a = avatar.architecture

    def network(name, latent):
        return layers(a.networks[name], mi.Float(avatar.tensors[name]), mi.TensorXf(latents[latent][:, None]))

    diffuse, specular = network("diffuse_albedo", "z_a"), network("specular_albedo", "z_s")
    light = layers(a.networks["illumination"], mi.Float(avatar.tensors["illumination"]))
    lobes = illumination(light, mi.TensorXf(latents["z_l"][:, None]))[:, :, 0]
    dr.eval(lobes)

    def evaluate(x_ref, gamma, normal, view):
        albedo = diffuse_albedo(diffuse, a.albedo_octaves, x_ref, gamma)
        f0 = specular_albedo(specular, a.specular_octaves, x_ref)
        parts = shade(
            from_columns(normal, mi.Vector3f),
            from_columns(-view, mi.Vector3f),
            from_columns(f0, mi.Float),
            mi.Float(avatar.roughness),
            lobes,
        )
        irradiance, glossy = (to_columns(part) for part in parts)
        radiance = reflect(Material(albedo, f0, avatar.roughness, 1.0), irradiance, glossy)
        return albedo, f0, irradiance, radiance.diffuse + radiance.specular

    return Factors(*evaluate_in_chunks(evaluate, *inputs, views))


# Measures


def albedo_scores(values: np.ndarray, truth: np.ndarray) -> dict[str, float]:
    """PSNR of diffuse albedos [N, 3]: linear, sRGB-coded, and linear after one factor a channel."""
    return {
        "psnr": psnr(values, truth),
        "psnr_srgb": psnr(linear_to_srgb(values), linear_to_srgb(truth)),
        "psnr_scaled": psnr(scale_channels(values, truth), truth),
    }


def specular_scores(f0: np.ndarray, strength: np.ndarray) -> dict[str, float]:
    """PSNR of reflectances at normal incidence [N] against the true strength [N], as strength and as F0."""
    return {
        "psnr": psnr(f0 / F0_OF_STRENGTH, strength),
        "psnr_f0": psnr(f0, strength * F0_OF_STRENGTH),
    }


@dataclass(frozen=True)
class Baseline:
    """Mean albedos of the training scenes."""

    albedo: np.ndarray  # [3]
    strength: float  # of the speculars


def training_baseline(scenes: Sequence[HeldOut]) -> Baseline:
    """Means over the observed points of `scenes`, each scene counting the same."""
    return Baseline(
        np.mean([s.albedo[s.observed].mean(axis=0) for s in scenes], axis=0),
        float(np.mean([s.specular[s.observed].mean() for s in scenes])),
    )


def render_scores(avatar: Avatar, latents: dict[str, np.ndarray], z_sdf: np.ndarray, scene: HeldOut) -> dict:
    """Re-rendering against the radiance of the held-out views at their visible points; beside it, one colour all over,
    the mean of those observations."""
    inputs = surface_inputs(avatar, z_sdf, scene.points)
    radiance = factors(
        avatar, latents, [np.ascontiguousarray(v[:, scene.sample_point]) for v in inputs], scene.sample_view.T
    ).radiance.T
    truth = scene.sample_color
    constant = np.broadcast_to(truth.mean(axis=0), truth.shape)
    return {
        "render_psnr": psnr(linear_to_srgb(radiance), linear_to_srgb(truth)),
        "render_psnr_linear": psnr(np.clip(radiance, 0, 1), np.clip(truth, 0, 1)),
        "constant_render_psnr": psnr(linear_to_srgb(constant), linear_to_srgb(truth)),
    }


def point_scores(
    avatar: Avatar, latents: dict[str, np.ndarray], z_sdf: np.ndarray, scene: HeldOut, baseline: Baseline
) -> dict[str, float]:
    """Albedos against the truth at the observed points, of the whole head and (`face_`) of the face, with baselines;
    `leakage`; and `albedo_bias`, the mean log2 of fitted over true albedo luminance in stops."""
    inputs = surface_inputs(avatar, z_sdf, scene.points)
    level = -inputs[2]
    fitted, mean = factors(avatar, latents, inputs, level), factors(avatar, _zero_latents(avatar), inputs, level)
    constant = np.broadcast_to(baseline.albedo, scene.albedo.shape)
    scores = {}
    for part, chosen in (("points_", scene.observed), ("face_", scene.observed & scene.face)):
        if not chosen.any():
            continue
        for prefix, albedo in (("", fitted.albedo.T), ("mean_", mean.albedo.T), ("constant_", constant)):
            for name, value in albedo_scores(albedo[chosen], scene.albedo[chosen]).items():
                scores[f"{part}{prefix}albedo_{name}"] = value
        flat = np.full(chosen.sum(), baseline.strength * F0_OF_STRENGTH)
        speculars = ("", fitted.specular[0][chosen]), ("mean_", mean.specular[0][chosen]), ("constant_", flat)
        for prefix, f0 in speculars:
            for name, value in specular_scores(f0, scene.specular[chosen]).items():
                scores[f"{part}{prefix}specular_{name}"] = value
        albedo, truth = fitted.albedo.T[chosen], scene.albedo[chosen]
        scores[f"{part}leakage"] = leakage(albedo, truth, fitted.irradiance.T[chosen])
        scores[f"{part}albedo_bias"] = float(np.mean(np.log2(luminance(albedo) / luminance(truth))))
    return scores


def _zero_latents(avatar: Avatar) -> dict[str, np.ndarray]:
    return {name: np.zeros_like(avatar.tensors[name]) for name in af_sm.LATENTS}


@dataclass(frozen=True, eq=False)
class View:
    """A fitted head in one view, 0 where it is not hit."""

    hit: np.ndarray  # [H, W] bool
    albedo: np.ndarray  # [H, W, 3]
    specular: np.ndarray  # [H, W] reflectance at normal incidence
    radiance: np.ndarray  # [H, W, 3]
    even: np.ndarray  # [H, W, 3] radiance under even white light, without shading
    mean_albedo: np.ndarray  # [H, W, 3] of the mean head's field
    mean_specular: np.ndarray  # [H, W]


def primary_hits(
    avatar: Avatar, z_sdf: np.ndarray, K: np.ndarray, world_to_camera: np.ndarray, size: tuple[int, int], voxel: float
) -> list[dict[str, np.ndarray]]:
    """Exact hits of the rays through the pixel centres of views `K` [h, 3, 3], `world_to_camera` [h, 4, 4] of `size`
    (rows, columns) on the head with latent `z_sdf`: a view's `pixel` [N], flat index, `points` [N, 3] and unit
    `directions` [N, 3]. `voxel` is the spacing of the proxy mesh, scene units."""
    from sira_mi.plugins.neural_sdf import trace_head

    with tempfile.TemporaryDirectory() as folder:
        path = str(Path(folder) / "head.safetensors")
        save_avatar(path, avatar.with_tensors(z_sdf=np.asarray(z_sdf, np.float32)))
        scene = mi.load_dict({"type": "scene", "head": {"type": "neural_sdf", "avatar": path, "voxel": voxel}})
    head = scene.shapes()[0]
    row, column = (a.ravel() + 0.5 for a in np.indices(size))
    result = []
    for intrinsic, pose in zip(K, world_to_camera, strict=True):
        centre = -pose[:3, :3].T @ pose[:3, 3]
        way = np.linalg.solve(intrinsic, np.stack([column, row, np.ones_like(row)])).T @ pose[:3, :3]
        way = (way / np.linalg.norm(way, axis=1, keepdims=True)).astype(np.float32)
        ray = mi.Ray3f(
            mi.Point3f(*(dr.full(mi.Float, float(c), len(way)) for c in centre)),
            mi.Vector3f(np.ascontiguousarray(way.T)),
        )
        t, hit = trace_head(scene, head, ray, mi.Bool(True))
        pixel = np.flatnonzero(hit.numpy())
        points = centre + t.numpy()[pixel, None] * way[pixel]
        result.append({"pixel": pixel, "points": points.astype(np.float32), "directions": way[pixel]})
    return result


def render_views(
    avatar: Avatar, latents: dict[str, np.ndarray], z_sdf: np.ndarray, scene: HeldOut, voxel: float = 0.1
) -> list[View]:
    """The head with `latents` and `z_sdf` in every held-out view of `scene`."""
    size = scene.masks.shape[1:]
    views = []
    for found in primary_hits(avatar, z_sdf, scene.K, scene.world_to_camera, size, voxel):
        inputs = surface_inputs(avatar, z_sdf, found["points"])
        along = np.ascontiguousarray(found["directions"].T)
        fitted = factors(avatar, latents, inputs, along)
        mean = factors(avatar, _zero_latents(avatar), inputs, along)

        def picture(columns, pixel=found["pixel"]):
            image = np.zeros((size[0] * size[1], len(columns)), np.float32)
            image[pixel] = columns.T
            return image.reshape(*size, len(columns))

        views.append(
            View(
                hit=picture(np.ones((1, len(found["pixel"]))))[..., 0] > 0,
                albedo=picture(fitted.albedo),
                specular=picture(fitted.specular)[..., 0],
                radiance=picture(fitted.radiance),
                even=picture(_evenly_lit(fitted, inputs[2], along, avatar.roughness)),
                mean_albedo=picture(mean.albedo),
                mean_specular=picture(mean.specular)[..., 0],
            )
        )
    return views


def _evenly_lit(fitted: Factors, normal: np.ndarray, view: np.ndarray, roughness: float) -> np.ndarray:
    """Radiance [3, N] under white light of radiance 1 from everywhere."""
    lobes = mi.TensorXf(np.array([[0, 1, 0, 1e-3, 1, 1, 1]], np.float32))

    def evaluate(albedo, f0, normal, view):
        radiance = closed_form_radiance(normal, view, Material(albedo, f0, roughness, 1.0), lobes)
        return radiance.diffuse + radiance.specular

    return evaluate_in_chunks(evaluate, fitted.albedo, fitted.specular, normal, view)[0]


def image_scores(views: Sequence[View], scene: HeldOut, baseline: Baseline) -> dict[str, float]:
    """Means over the held-out views, each inside its mask where the fitted head is hit: PSNR and SSIM (of sRGB-coded
    diffuse albedo, of specular strength and of F0) against the true albedo images, with baselines; `image_covered` is
    the share of the mask that is hit. Raises InputError for a scene without true albedo images."""
    if scene.albedo_images is None or scene.specular_images is None:
        raise InputError(f"{scene.name} has no true albedo images; build the collection again")
    rows = []
    for k, view in enumerate(views):
        inside = scene.masks[k] & view.hit
        truth, strength = scene.albedo_images[k], scene.specular_images[k]
        scores = {"covered": float(inside.sum() / max(scene.masks[k].sum(), 1))}
        constant = np.broadcast_to(baseline.albedo, truth.shape)
        for prefix, albedo in (("", view.albedo), ("mean_", view.mean_albedo), ("constant_", constant)):
            for name, value in albedo_scores(albedo[inside], truth[inside]).items():
                scores[f"{prefix}albedo_{name}"] = value
            scaled = np.zeros(albedo.shape)
            scaled[inside] = scale_channels(albedo[inside], truth[inside])
            for name, image in (("ssim", albedo), ("ssim_scaled", scaled)):
                scores[f"{prefix}albedo_{name}"] = ssim_inside(linear_to_srgb(image), linear_to_srgb(truth), inside)
        flat = np.full(strength.shape, baseline.strength * F0_OF_STRENGTH)
        for prefix, f0 in (("", view.specular), ("mean_", view.mean_specular), ("constant_", flat)):
            for name, value in specular_scores(f0[inside], strength[inside]).items():
                scores[f"{prefix}specular_{name}"] = value
            scores[f"{prefix}specular_ssim"] = ssim_inside(f0 / F0_OF_STRENGTH, strength, inside)
            scores[f"{prefix}specular_ssim_f0"] = ssim_inside(f0, strength * F0_OF_STRENGTH, inside)
        rows.append({f"image_{name}": value for name, value in scores.items()})
    return mean_scores(rows)


def mean_scores(rows: Sequence[dict[str, float]]) -> dict[str, float]:
    """The mean of every score over those `rows` that have it and are not NaN."""
    result = {}
    for name in dict.fromkeys(name for row in rows for name in row):
        values = np.array([row[name] for row in rows if name in row])
        values = values[~np.isnan(values)]
        result[name] = float(values.mean()) if values.size else float("nan")
    return result


def mean_scores_by(scenes: Sequence[HeldOut], rows: Sequence[dict[str, float]], key: str) -> dict[str, dict]:
    """`mean_scores` of each `source` or `group` (`key`) of the scenes, with the number of its `scenes`."""
    names = sorted({getattr(scene, key) for scene in scenes} - {""})
    result = {}
    for name in names:
        mine = [row for scene, row in zip(scenes, rows, strict=True) if getattr(scene, key) == name]
        result[name] = {"scenes": float(len(mine)), **mean_scores(mine)}
    return result


def appearance_sheet(scenes: Sequence[HeldOut], views: Sequence[View], view: int = 0) -> np.ndarray:
    """Display values [rows, columns, 3], a row a head: photo of held-out view number `view`, its re-rendering, true
    albedo, fitted albedo, and the fitted head under even white light. `views` holds that view of every head. Raises
    InputError for a scene without true albedo images."""
    rows = []
    for scene, fitted in zip(scenes, views, strict=True):
        if scene.albedo_images is None:
            raise InputError(f"{scene.name} has no true albedo images; build the collection again")
        mask = scene.masks[view][..., None]
        pictures = (scene.images[view] * mask, fitted.radiance, scene.albedo_images[view], fitted.albedo, fitted.even)
        rows.append(np.concatenate([linear_to_srgb(picture) for picture in pictures], axis=1))
    return np.concatenate(rows, axis=0)
