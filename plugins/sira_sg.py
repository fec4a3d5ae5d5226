from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from sira_mi.errors import InputError
from sira_mi.fields.columns import (
    evaluate_in_chunks,
    from_columns,
    gather_columns,
    in_three,
    normalise,
    scatter_columns,
    to_array,
    to_columns,
)
from sira_mi.fields.sdf import deform, surface
from sira_mi.fields.tracing import differentiable_hit, on_ray
from sira_mi.plugins._parameters import read_flag, read_integer
from sira_mi.plugins.neural_albedo import NeuralAlbedo, find_avatar
from sira_mi.plugins.neural_sdf import NeuralSDF, find_head, trace_head
from sira_mi.plugins.sg_envmap import LightRefinement, SGEnvmap, read_refinement
from sira_mi.plugins.sira_bsdf import SiraBSDF
from sira_mi.sg.layers import EXTRA_LAYERS, channel_count, extra_channel_names
from sira_mi.sg.multisampling import representative_samples
from sira_mi.sg.radiance import Material, Radiance, closed_form_radiance
from sira_mi.sg.visibility import (
    DEFAULT_DIRECTIONS,
    SHADOW_OFFSET,
    Directions,
    light_directions,
    light_visibility,
    trace_unoccluded,
)

# Mitsuba's BSDFs that have a diffuse term alone.
DIFFUSE_BSDFS = ("SmoothDiffuse", "TwoSidedBRDF")


class SiraSG(mi.SamplingIntegrator):
    r"""
    .. _integrator-sira_sg:

    Closed-form shading (`sira_sg`)
    -------------------------------

    .. pluginparameters::

     * - hide_emitters
       - |bool|
       - Show black instead of the environment behind the head. (Default: false)
     * - visibility
       - |bool|
       - Shadows, and one diffuse bounce off the surfaces that cast them. (Default: true)
     * - visibility_directions
       - |int|
       - Directions in which visibility is tested, 16 to 4096. (Default: 64)
     * - aovs
       - |bool|
       - Render the extra channels. Without them a picture can be written as PNG. (Default: false)
     * - exact
       - |bool|
       - Use hits and normals of the field. If false, use those of the mesh, and the albedos of its vertices where a
         texture is baked: faster, but only as accurate as the shape's `voxel` is small. (Default: true)
     * - shared
       - |bool|
       - Shade a pixel once, at its middle sample, where all its samples hit the head within 4 mm of each other and with
         normals within 15 degrees. Coverage is still computed for every sample. (Default: false)
     * - light_refinement
       - |string|
       - An `avatar.safetensors` whose light refinement multiplies the radiance: the part of the photo that neither
         eq. 8 nor the albedo explains. It is only valid under that avatar's fitted light.
         (Default: that of the `sg_envmap`)
     * - shaded_lobes
       - |tensor|
       - Indices of the lobes that the closed form sums over. Visibility always uses all lobes. (Default: all)

    Evaluates eq. 8 in closed form, without sampling and without noise: the radiance that a `neural_sdf` with a
    `sira_bsdf` reflects under an `sg_envmap`. To find shadows, rays are traced against the scene's meshes in a fixed
    set of directions. Half of them are evenly spread, half follow the lobes. Interreflection is one bounce off
    surfaces that are assumed to face the point and to share its albedo; `path` renders the same scene without these
    approximations. Albedos that are `neural_albedo` textures are evaluated as networks, in tensor mode; other textures
    are evaluated at the hit.

    Shapes beside the head are shaded in the same way; their BSDF must be `diffuse`, a `twosided` one, or `sira_bsdf`.
    They have no derivatives of their own. Other materials, instances, and lights besides the `sg_envmap` raise
    RuntimeError, which names them.

    The extra channels are `diffuse.RGB` and `specular.RGB` (the two terms of eq. 8, without `light_refinement`),
    `diffuse_albedo.RGB`, `specular_albedo`, `normal.XYZ` (of the field, in world space), `depth` (distance along the
    ray from the sensor's near plane in scene units, as in `aov`) and `mask` (1 on the head). All are zero off the head.

    Differentiable in every parameter of the head, its material and its light: lobes and their scale, albedo networks,
    latents and textures, k_s, k_r and roughness and, by implicit differentiation, the shape's networks, latent and
    pose. Derivatives of the shape are those inside the silhouette; for silhouettes see `sira_radiance` and Mitsuba's
    projective integrators. Visibility and the directions in which it is tested are constants. If any parameter has
    gradients enabled, hits are exact, each sample is shaded on its own and all lobes are summed, whatever the options
    say. The specular term is skipped only if k_s is 0 and no gradient is needed.

    Not available inside symbolic code. Derivatives are the same bits on every run, except those of the lobes through a
    visible background and those of textures other than `neural_albedo`, which are summed by atomics.

    Source: SIRA (Caselles et al. 2022), section 3.1.3; PhySG (Zhang et al. 2021).

    .. tabs::
        .. code-tab:: python

            'type': 'sira_sg'
    """

    def __init__(self, props):
        super().__init__(props)
        self.hide_environment = read_flag(props, "sira_sg", "hide_emitters", False)
        self.visibility = read_flag(props, "sira_sg", "visibility", True)
        self.directions = read_integer(props, "sira_sg", "visibility_directions", DEFAULT_DIRECTIONS, 16, 4096)
        self.aovs = read_flag(props, "sira_sg", "aovs", False)
        self.exact = read_flag(props, "sira_sg", "exact", True)
        self.shared = read_flag(props, "sira_sg", "shared", False)
        self.refinement = read_refinement(find_avatar(props, "light_refinement"))
        self.shaded_lobes = np.array(props["shaded_lobes"]).astype(int) if "shaded_lobes" in props else None

    def sample(self, scene, sampler, ray, medium=None, active=True):
        # Scene: one head, its material and its light.
        head = find_head(scene, "sira_sg")
        bsdf, light = head.bsdf(), scene.environment()
        if not isinstance(bsdf, SiraBSDF):
            raise RuntimeError("sira_sg: the neural_sdf must have a sira_bsdf; use path for other materials")
        if not isinstance(light, SGEnvmap):
            raise RuntimeError("sira_sg: the environment must be an sg_envmap; use path for other lights")
        refinement = self.refinement_of(light)
        others = other_materials(scene, light)
        ray = mi.Ray3f(ray)
        width = dr.width(ray.o, ray.d)
        attached = dr.grad_enabled(ray.o, ray.d) or has_gradients(head, light)

        # Hits: where the rays meet the head, and which of them are shaded.
        samples = sampler.sample_count() if self.shared and sampler is not None and not attached else 1
        samples = samples if width % samples == 0 else 1
        hits = find_hits(scene, head, ray, active, samples, exact=attached or self.exact)

        # Shading: eq. 8 and the extra channels in tensors, one column a shaded ray.
        index = dr.compress(hits.shaded)
        columns, shader = None, HeadShader(self, scene, head, light, attached)
        if dr.width(index) > 0:
            columns = shader.shade(ray, hits, index)

        # Scatter: from the columns back to the rays.
        parts = {}
        for layer, (name, rows) in enumerate(self.rows(refinement).items()):
            kind = mi.Color3f if rows == 3 else mi.Float
            part = dr.zeros(kind, width)
            if columns is not None:
                part = scatter_columns(columns[layer], index, width, kind)
            parts[name] = hits.spread(part)
        t, hit = hits.spread(hits.t), hits.spread(hits.shaded)
        radiance = parts["diffuse"] + parts["specular"]
        if refinement is not None:
            radiance *= parts["light_refinement"]

        # Other shapes, background, and what the film takes.
        background = dr.zeros(mi.Color3f, width)
        if not self.hide_environment:
            si = dr.zeros(mi.SurfaceInteraction3f, width)
            si.wi = -ray.d
            background = light.eval(si, active & ~hit)
        valid = active & (hit | (not self.hide_environment))
        if others:
            shape, on_shape = shader.shade_others(others, ray, active & ~hit)
            background, valid = dr.select(on_shape, shape, background), valid | on_shape
        color = dr.select(hit, radiance, background)
        if not self.aovs:
            return color, valid, []
        parts |= {"depth": dr.select(hit, t, 0.0), "mask": dr.select(hit, mi.Float(1.0), 0.0)}
        extra = (parts[name] for name in EXTRA_LAYERS)
        return color, valid, [c for part in extra for c in (part if isinstance(part, mi.Color3f) else [part])]

    def refinement_of(self, light: SGEnvmap) -> LightRefinement | None:
        """The refinement of the light that multiplies the radiance: the integrator's, or else the light's own."""
        return self.refinement or light.refinement

    def rows(self, refinement: LightRefinement | None) -> dict[str, int]:
        """Number of rows of each tensor that `HeadShader` returns, by the layer that it is."""
        names = ["diffuse", "specular", *(("diffuse_albedo", "specular_albedo", "normal") if self.aovs else ())]
        factor = {} if refinement is None else {"light_refinement": 3}
        return {name: channel_count(name) for name in names} | factor

    def select_lobes(self, lobes):
        """Those of `lobes` [N_l, 7] that the closed form sums over. Raises InputError for an index that they lack."""
        chosen, count = self.shaded_lobes, lobes.shape[0]
        if chosen is None:
            return lobes
        if not (len(chosen) and ((chosen >= 0) & (chosen < count)).all()):
            raise InputError(f"sira_sg: shaded_lobes must be numbers of lobes, 0 to {count - 1}, and at least one")
        return to_array(lobes.numpy()[chosen])

    def aov_names(self):
        return extra_channel_names() if self.aovs else []

    def to_string(self):
        return f"SiraSG[hide_emitters = {self.hide_environment}, visibility = {self.visibility}]"


def has_gradients(*objects: mi.Object) -> bool:
    """Whether gradients are enabled for a parameter that one of the objects, or one nested in it, exposes."""
    return any(dr.grad_enabled(value) for one in objects for _, value in mi.traverse(one))


def other_materials(scene, light) -> list[mi.BSDF]:
    """The BSDFs of the shapes beside the head. Raises RuntimeError, with its name, for a shape or a light that
    closed-form shading does not show."""
    for emitter in scene.emitters():
        if emitter is not light:
            raise RuntimeError(
                f"sira_sg: it shades by one sg_envmap, not by {_name(emitter)}; use path for other lights"
            )
    materials: list[mi.BSDF] = []
    for shape in scene.shapes():
        if isinstance(shape, NeuralSDF):
            continue
        bsdf = shape.bsdf()
        nested = [node for node in mi.traverse(bsdf).hierarchy if isinstance(node, mi.BSDF)] if bsdf else []
        known = all(isinstance(node, SiraBSDF) or node.class_name() in DIFFUSE_BSDFS for node in nested)
        plain = isinstance(bsdf, SiraBSDF) or not any(isinstance(node, SiraBSDF) for node in nested)
        if not (nested and known and plain) or shape.is_medium_transition():
            raise RuntimeError(
                f"sira_sg: it cannot shade {_name(shape)}; shapes beside the head need a diffuse or sira_bsdf "
                "material, and may not be instances; use path for others"
            )
        if has_gradients(shape):
            raise RuntimeError(f"sira_sg: no derivatives by {_name(shape)}, which is not the head; use prb")
        if not any(bsdf is known for known in materials):
            materials.append(bsdf)
    return materials


def _name(part) -> str:
    """What a part of a scene is called in a message."""
    return f"'{part.id()}' ({part.class_name()})"


# Hits


@dataclass(frozen=True, eq=False)
class Hits:
    """Where rays meet the head, one lane a ray."""

    t: mi.Float  # along the ray
    shaded: mi.Bool  # whether the ray meets the head and is shaded
    on_mesh: mi.SurfaceInteraction3f | None = None  # interactions with the mesh; None where hits are exact
    representative: mi.UInt32 | None = None  # the ray whose shading each ray takes; None: its own

    def spread(self, value):
        """A value of the shaded rays, at every ray that they represent."""
        return value if self.representative is None else dr.gather(type(value), value, self.representative)


def find_hits(scene, head, ray, active, samples: int, exact: bool) -> Hits:
    """Hits of the rays on the head, on its field (`exact`) or on its mesh. With `samples` > 1, that many consecutive
    rays are a pixel, whose shading is shared where `representative_samples` allows it."""
    if samples == 1 and exact:
        return Hits(*trace_head(scene, head, ray, active))
    with dr.suspend_grad():
        si = scene.ray_intersect(ray, active)
        shaded = active & si.is_valid() & (si.shape == mi.ShapePtr(head))
        dr.eval(si, shaded)
    representative = None
    if samples > 1:
        position, normal, hit = (a.numpy() for a in (head.to_local @ si.p, si.sh_frame.n, shaded))
        representative = mi.UInt32(representative_samples(position, normal, hit, samples))
        shaded &= representative == dr.arange(mi.UInt32, dr.width(shaded))
    if exact:
        t, shaded = head.refine(ray, si.t, shaded)
        return Hits(t, shaded, None, representative)
    return Hits(si.t, shaded, si, representative)


# Shading


class HeadShader:
    """Eq. 8 and the extra channels at points of a head, as tensors in its field's coordinates, one column a point.

    Results are the tensors of `SiraSG.rows`, apart: in the adjoint of rows cut from one tensor, gradients get lost at
    random. Without gradients (`attached`) points are evaluated in chunks."""

    def __init__(self, integrator: SiraSG, scene, head, light, attached: bool):
        self.integrator, self.scene, self.head, self.attached = integrator, scene, head, attached
        self.bsdf, self.field = head.bsdf(), head.field()
        self.refinement = integrator.refinement_of(light)
        self.specular_term = attached or self.bsdf.k_s.numpy().item() != 0
        self.lobes = local_lobes(light, head)
        self.shaded_lobes = self.lobes if attached else integrator.select_lobes(self.lobes)
        self.directions: Directions | None = None
        if integrator.visibility:
            self.directions = light_directions(dr.detach(self.lobes).numpy(), integrator.directions)
        self.to_world = mi.TensorXf(rotation_of(head.to_world))

    def shade(self, ray, hits: Hits, index):
        """At the hits of the rays `index`."""
        if hits.on_mesh is not None:
            return self._shade_mesh(ray, hits, index)
        local = self.head.ray_to_local(ray)
        origin, direction, t = (gather_columns(v, index) for v in (local.o, local.d, hits.t / self.head.scale))
        if self.attached:
            return self._shade_field(differentiable_hit(self.field, origin, direction, dr.detach(t)), direction)
        x = on_ray(origin, direction, t)
        return [mi.TensorXf(part) for part in evaluate_in_chunks(self._shade_field, x.numpy(), direction.numpy())]

    def shade_others(self, materials: list[mi.BSDF], ray, active) -> tuple[mi.Color3f, mi.Bool]:
        """Radiance of the shapes beside the head, whose BSDFs are `materials`, and which rays meet one of them first.
        The shapes are constants."""
        with dr.suspend_grad():
            si = self.scene.ray_intersect(dr.detach(ray), active)
            seen = active & si.is_valid() & (si.shape != mi.ShapePtr(self.head))
            dr.eval(si, seen)
        radiance = dr.zeros(mi.Color3f, dr.width(seen))
        for bsdf in materials:
            same: Any = si.bsdf() == mi.BSDFPtr(bsdf)  # the stubs call it an object
            index: Any = dr.compress(seen & same)
            if dr.width(index) > 0:
                columns = self._shade_other(bsdf, dr.gather(mi.SurfaceInteraction3f, si, index))
                radiance += scatter_columns(columns, index, dr.width(seen), mi.Color3f)
        return radiance, seen

    def _shade_other(self, bsdf, si: mi.SurfaceInteraction3f):
        """Radiance [3, N] at interactions with shapes of one material."""
        head, count = self.head, dr.width(si)
        with dr.suspend_grad():
            front = mi.Frame3f.cos_theta(si.wi) > 0.0
            lit = front | mi.Bool(mi.has_flag(bsdf.flags(), mi.BSDFFlags.BackSide))
            to_local = to_array(rotation_of(head.to_world).T)
            normal = to_local @ to_columns(dr.select(front, si.sh_frame.n, -si.sh_frame.n))
            view = to_local @ to_columns(-si.to_world(si.wi))
            albedo = mi.Color3f(bsdf.eval_diffuse_reflectance(si)) + dr.zeros(mi.Color3f, count)
            columns = [to_columns(head.to_local @ si.p), normal, view, to_columns(dr.select(lit, albedo, 0.0))]
            glossy = isinstance(bsdf, SiraBSDF)
            if glossy:
                specular_albedo = bsdf.specular_albedo.eval_1(si) + dr.zeros(mi.Float, count)
                columns.append(to_columns(specular_albedo))
        shine = dr.select(lit, 1.0, 0.0) if glossy else dr.zeros(mi.Float, count)

        def shade(x, normal, view, diffuse, specular=None):
            material = Material(diffuse, specular, *self._gloss(bsdf if glossy else self.bsdf))
            return tuple(self._radiance(x, normal, view, material))

        if self.attached:
            diffuse, specular = shade(*columns)
        else:
            diffuse, specular = map(mi.TensorXf, evaluate_in_chunks(shade, *(c.numpy() for c in columns)))
        return diffuse + specular * in_three(to_columns(shine))

    @staticmethod
    def _gloss(bsdf: SiraBSDF) -> tuple:
        """Roughness and weight of the specular term."""
        return bsdf.roughness, mi.TensorXf(bsdf.k_s, (1, 1))

    def _shade_mesh(self, ray, hits: Hits, index):
        """At the hits on the mesh of the rays `index`, with its normals; without gradients."""
        si = dr.gather(mi.SurfaceInteraction3f, hits.on_mesh, index)
        to_local = to_array(rotation_of(self.head.to_world).T)
        direction = gather_columns((self.head.to_local @ ray).d, index)
        x, normal = to_columns(self.head.to_local @ si.p), to_local @ to_columns(si.sh_frame.n)
        columns = [x, direction, normal, *mesh_albedos(self.head, self.bsdf, si, x)]
        if (refinement := self.refinement) is not None:
            factor = evaluate_in_chunks(lambda p: refinement.factor(*deform(self.field, p)), x.numpy())[0]
            columns.append(mi.TensorXf(factor))
        return [mi.TensorXf(part) for part in evaluate_in_chunks(self._shade_points, *(c.numpy() for c in columns))]

    def _shade_field(self, x, direction):
        """Points x [3, N] of the field's surface, seen along `direction` [3, N]."""
        _, gradient, x_ref, gamma = surface(self.field, x)
        diffuse = self._albedo(self.bsdf.diffuse_albedo, x, x_ref, gamma, 3)
        specular = None
        if self.specular_term or self.integrator.aovs:
            specular = self._albedo(self.bsdf.specular_albedo, x, x_ref, gamma, 1)
        refinement = self.refinement
        factor = [] if refinement is None else [refinement.factor(x_ref, gamma)]
        return self._shade_points(x, direction, normalise(gradient), diffuse, specular, *factor)

    def _shade_points(self, x, direction, normal, diffuse, specular, *factor):
        """Points whose unit normals and albedos are known."""
        material = Material(diffuse, specular if self.specular_term else None, *self._gloss(self.bsdf))
        radiance = self._radiance(x, normal, normalise(direction), material)
        extra = (diffuse, specular, self.to_world @ normal) if self.integrator.aovs else ()
        return *radiance, *extra, *factor

    def _radiance(self, x, normal, view, material: Material) -> Radiance:
        visibility = None
        if self.directions is not None:
            unoccluded = unoccluded_directions(self.scene, self.head, x, normal, self.directions)
            visibility = light_visibility(
                normal,
                view,
                material.specular_albedo,
                material.roughness,
                self.lobes,
                self.directions,
                unoccluded,
            )
        return closed_form_radiance(normal, view, material, self.shaded_lobes, visibility)

    def _albedo(self, texture, x, x_ref, gamma, rows: int):
        """The albedo [rows, N] of a texture at points x, which lie at x_ref in reference space."""
        if isinstance(texture, NeuralAlbedo):
            return texture.evaluate_columns(x, x_ref, gamma)[0:rows, :]
        si = dr.zeros(mi.SurfaceInteraction3f, x.shape[1])
        si.p = self.head.to_world @ from_columns(x, mi.Point3f)
        value = texture.eval(si) if rows == 3 else texture.eval_1(si)
        return to_columns(value + dr.zeros(mi.Float, x.shape[1]))


def mesh_albedos(head, bsdf, si, x) -> list:
    """Diffuse [3, N] and specular albedo [1, N] at interactions `si` with the head's mesh, at x [3, N] in the field's
    coordinates: of the networks, or looked up at `si` where a texture is baked or of another kind."""
    textures = (bsdf.diffuse_albedo, bsdf.specular_albedo)
    by_network = [isinstance(texture, NeuralAlbedo) and not texture.baked for texture in textures]
    inputs = [x.numpy(), *evaluate_in_chunks(lambda p: deform(head.field(), p), x.numpy())] if any(by_network) else []
    result = []
    with dr.suspend_grad():
        for texture, neural, rows in zip(textures, by_network, (3, 1), strict=True):
            if neural:
                values = evaluate_in_chunks(lambda *a, t=texture, n=rows: t.evaluate_columns(*a)[0:n, :], *inputs)[0]
                result.append(mi.TensorXf(values))
            else:
                value = texture.eval_3(si) if rows == 3 else texture.eval_1(si)
                result.append(to_columns(value + dr.zeros(mi.Float, x.shape[1])))
    return result


def unoccluded_directions(scene, head, x, normal, directions):
    """Whether nothing in the scene blocks each of `directions`, given in the field's coordinates, at surface points and
    normals [3, N] of the field: tensor [K, N] of 0 and 1, without gradients."""
    rotation = rotation_of(head.to_world)
    point = (head.to_world @ from_columns(dr.detach(x), mi.Point3f)).numpy()
    offset = SHADOW_OFFSET * head.voxel * scale_of(head.to_world)
    normal = rotation @ dr.detach(normal).numpy()
    return mi.TensorXf(trace_unoccluded(scene, point, normal, directions.axis @ rotation.T, offset).astype(np.float32))


def local_lobes(light, head):
    """The light's lobes [N_l, 7] with axes in the field's coordinates."""
    rotation = rotation_of(head.to_local @ light.rotation)
    axis, sharpness, amplitude = light.lobes[:, 0:3], light.lobes[:, 3:4], light.lobes[:, 4:7]
    # Flat arrays: the adjoint of a tensor's broadcast is atomic.
    scaled = mi.TensorXf(dr.ravel(amplitude) * light.scale, amplitude.shape)
    return dr.concat([axis @ mi.TensorXf(rotation.T), sharpness, scaled], axis=1)


def rotation_of(transform) -> np.ndarray:
    """Rotation [3, 3] of a transform that rotates, translates and scales uniformly."""
    matrix = np.array(transform.matrix.numpy()).reshape(4, 4)[:3, :3]
    return np.ascontiguousarray(matrix / scale_of(transform), dtype=np.float32)


def scale_of(transform) -> float:
    """Scale of a transform that rotates, translates and scales uniformly."""
    return float(np.cbrt(np.linalg.det(np.array(transform.matrix.numpy()).reshape(4, 4)[:3, :3])))


mi.register_integrator("sira_sg", lambda props: SiraSG(props))
