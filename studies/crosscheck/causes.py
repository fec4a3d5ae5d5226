"""The causes of the difference between closed forms and path tracing: pairs of pictures that differ by one thing."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from sira_mi.plugins.neural_sdf import NeuralSDF
from studies.crosscheck import forms
from studies.crosscheck.case import Case
from studies.crosscheck.images import Estimate, mean_square, resolution, root
from studies.crosscheck.points import Points, field_points, in_double, mesh_points
from studies.crosscheck.regions import HEAD, REGIONS, regions

FLOAT32 = "float32"
INTEGRAL = "integral approximation"
VISIBILITY = "missing visibility"
APPROXIMATE_VISIBILITY = "integral and visibility approximation"
INTERREFLECTION = "missing interreflection"
FURTHER_INTERREFLECTION = "interreflection beyond the one bounce"
PROXY = "proxy mesh instead of the field"
BAKED = "baked instead of neural textures"
REST = "left over"
TOTAL = "total"
NOISE = "Monte Carlo noise of the reference"
PHYSG, FORM, VISIBLE = "PhySG's closed form", "closed form", "closed form with visibility"


@dataclass(frozen=True, eq=False)
class Half:
    """One of two independent sets of points: on the field, on the reference's mesh and on the plugin's usual mesh."""

    field: Points
    normal64: np.ndarray  # [3, N] unit normals of the field's points in float64
    mesh: Points
    usual: Points


@dataclass(frozen=True)
class Row:
    """One cause in one table."""

    light: str
    form: str  # PHYSG, FORM or VISIBLE
    cause: str
    # Root mean square by region, share of the head's mean radiance, without noise; None for a region without pixels.
    errors: dict[str, float | None]
    bias: float  # mean over the head, share of its mean radiance; adds up to the total's
    share: float | None  # of the total's mean square over the head; adds up to 1, None for what is beside the total
    resolution: float | None = None  # the error over the head that noise alone may show


def gather(case: Case, reference: NeuralSDF, usual: NeuralSDF, side: int, seed: int) -> list[Half]:
    """Both halves, side² rays a pixel each. They are the same for every light."""
    halves = []
    for half in range(2):
        black = np.array([[0, 0, 1, 1, 0, 0, 0]], np.float32)
        scene, other = case.scene(reference, black), case.scene(usual, black)
        key = 2 * seed + half
        field = field_points(case, scene, reference, side, key)
        meshes = mesh_points(case, scene, reference, side, key), mesh_points(case, other, usual, side, key)
        halves.append(Half(field, in_double(field, reference)[1], *meshes))
    return halves


@dataclass(frozen=True, eq=False)
class Pictures:
    """Pictures [2, H, W, 3] of one light, a half each: see `shade_halves`."""

    physg: np.ndarray  # PhySG's closed form at the field's points
    form: np.ndarray  # this project's
    form64: np.ndarray  # the same in float64
    visible: np.ndarray  # with visibility and its bounce
    visible_direct: np.ndarray  # with visibility alone
    open: np.ndarray  # direct light without shadows by Monte Carlo, at the field's points
    arriving: np.ndarray  # with shadows
    mesh: np.ndarray  # the same at the reference mesh's points, albedos from the networks
    baked: np.ndarray  # the same with baked albedos
    usual: np.ndarray  # as `mesh`, on the mesh of the plugin's usual spacing


def shade_halves(
    case: Case, reference: NeuralSDF, usual: NeuralSDF, halves: list[Half], lobes: np.ndarray, samples: int, seed: int
) -> Pictures:
    """All pictures of both halves under `lobes` [N_l, 7], with `samples` directions of each kind for direct light."""
    scene, other = case.scene(reference, lobes), case.scene(usual, lobes)
    local, roughness, k_s = forms.local_lobes(lobes, reference), case.roughness, case.k_s
    shaded = []
    for k, half in enumerate(halves):
        field, light = half.field, (local, roughness, k_s)

        def direct(points, where, head, k=k):
            return forms.direct_light(points, where, head, local, roughness, samples, 2 * seed + k)

        no_shadow, shadow = direct(field, scene, reference)
        on_mesh = direct(half.mesh, scene, reference)[1]
        on_usual = direct(half.usual, other, usual)[1]
        shaded.append(
            (
                field.picture(forms.physg(field, *light)),
                field.picture(forms.closed_form(field, *light)),
                field.picture(forms.closed_form_double(field, half.normal64, *light)),
                field.picture(forms.with_visibility(field, scene, reference, *light)),
                field.picture(forms.with_visibility(field, scene, reference, *light, bounce=False)),
                field.picture(no_shadow.radiance(field.diffuse, field.specular, k_s)),
                field.picture(shadow.radiance(field.diffuse, field.specular, k_s)),
                half.mesh.picture(on_mesh.radiance(half.mesh.diffuse, half.mesh.specular, k_s)),
                half.mesh.picture(on_mesh.radiance(*half.mesh.baked(), k_s)),
                half.usual.picture(on_usual.radiance(half.usual.diffuse, half.usual.specular, k_s)),
            )
        )
    return Pictures(*(np.stack(pair) for pair in zip(*shaded, strict=True)))


def masks(halves: list[Half], pictures: Pictures) -> dict[str, np.ndarray]:
    """The regions under the pictures' light."""

    def average(value):
        return np.mean([half.field.picture(value(half.field))[..., 0] for half in halves], axis=0)

    coverage = average(lambda p: np.ones((1, p.x.shape[1])))
    cosine = average(lambda p: (p.normal * p.view).sum(axis=0, keepdims=True)) / np.maximum(coverage, 1e-12)
    direct, arriving = (picture.mean(axis=(0, 3)) for picture in (pictures.open, pictures.arriving))
    share = np.where(direct > 1e-12, arriving / np.maximum(direct, 1e-12), 1.0)
    return regions(coverage, cosine, share)


def parts(pictures: Pictures, reference: Estimate, interreflection: np.ndarray) -> dict[str, dict[str, np.ndarray]]:
    """For each form the causes [2, H, W, 3] that lead from it to the reference. They add up to `TOTAL`; the last of
    them, `REST`, is noise unless a cause was overlooked."""
    p, traced = pictures, reference.halves
    geometry = {PROXY: p.mesh - p.arriving, BAKED: p.baked - p.mesh}
    lit = {VISIBILITY: p.arriving - p.open, **geometry, INTERREFLECTION: interreflection}
    causes = {
        PHYSG: {INTEGRAL: p.open - p.physg, **lit},
        FORM: {FLOAT32: p.form64 - p.form, INTEGRAL: p.open - p.form64, **lit},
        VISIBLE: {
            APPROXIMATE_VISIBILITY: p.arriving - p.visible_direct,
            **geometry,
            FURTHER_INTERREFLECTION: interreflection - (p.visible - p.visible_direct),
        },
    }
    totals = {PHYSG: traced - p.physg, FORM: traced - p.form, VISIBLE: traced - p.visible}
    return {
        form: {**named, REST: totals[form] - sum(named.values()), TOTAL: totals[form]} for form, named in causes.items()
    }


def rows(
    light: str, form: str, named: Mapping[str, np.ndarray], regions: Mapping[str, np.ndarray], level: float
) -> list[Row]:
    """A `Row` for each of the pictures [2, H, W, 3] in `named`, one of which is `TOTAL`."""
    total, head = named[TOTAL], regions[HEAD]
    square = mean_square(total[0], total[1], head)
    result = []
    for cause, part in named.items():
        errors = {
            region: root(mean_square(part[0], part[1], regions[region])) / level if regions[region].any() else None
            for region in (*REGIONS, HEAD)
        }
        common = 0.5 * (mean_square(part[0], total[1], head) + mean_square(part[1], total[0], head))
        share = common / square if square > 0 else None
        least = resolution(part[0], part[1], head) / level
        result.append(Row(light, form, cause, errors, float(part[:, head].mean()) / level, share, least))
    return result


def noise_row(light: str, reference: Estimate, regions: Mapping[str, np.ndarray], level: float) -> Row:
    """The noise of the mean of the reference's halves, by region."""
    half = 0.5 * (reference.halves[0] - reference.halves[1])
    errors = {
        region: float(np.sqrt((half[regions[region]] ** 2).mean())) / level if regions[region].any() else None
        for region in (*REGIONS, HEAD)
    }
    return Row(light, "", NOISE, errors, 0.0, None)


def usual_row(light: str, pictures: Pictures, regions: Mapping[str, np.ndarray], level: float, voxel: float) -> Row:
    """Beside the sum: the error of direct light on a mesh of the plugin's default spacing, against the field."""
    part = pictures.usual - pictures.arriving
    name = f"beside the sum: a mesh of {voxel:g} instead of the field"
    row = rows(light, "", {name: part, TOTAL: part}, regions, level)[0]
    return Row(light, "", name, row.errors, row.bias, None, row.resolution)
