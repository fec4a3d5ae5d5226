import drjit as dr
import mitsuba as mi
import numpy as np

from sira_mi.avatar.decoders import light_refinement
from sira_mi.avatar.file import load_avatar
from sira_mi.errors import InputError
from sira_mi.fields.columns import evaluate_in_chunks, from_columns, normalise, scatter_columns, to_columns
from sira_mi.fields.mlp import layers
from sira_mi.fields.sdf import deform, surface
from sira_mi.fields.tracing import differentiable_hit, on_ray
from sira_mi.plugins.neural_albedo import NeuralAlbedo, find_avatar
from sira_mi.plugins.neural_sdf import find_head, trace_head
from sira_mi.plugins.sg_envmap import SGEnvmap
from sira_mi.plugins.sira_bsdf import SiraBSDF
from sira_mi.sg import multisampling, visibility
from sira_mi.sg.radiance import Material, reflected_radiance

# Rows of the columns that are computed at a hit, in order.
_ROWS = {"diffuse": 3, "specular": 3, "diffuse_albedo": 3, "specular_albedo": 1, "normal": 3}


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
       - Multiply the closed form by the share of the light that is not blocked, and add one diffuse bounce off what
         blocks it. (Default: true)
     * - visibility_directions
       - |int|
       - Directions of that share, 16 to 4096. (Default: 64)
     * - aovs
       - |bool|
       - Give the extra channels. (Default: true)
     * - exact
       - |bool|
       - Hits and normals of the field. Without it those of the mesh, and albedos from its vertices where a texture is
         baked: quicker, and as good as the shape's `voxel` is fine. (Default: true)
     * - shared
       - |bool|
       - Samples of one pixel that all see the head within 4 mm of the field, with normals within 15 degrees, are shaded
         once, at the one in their middle; what the head covers is still found by the sample. (Default: false)
     * - light_refinement
       - |string|
       - An `avatar.safetensors` whose refinement of the light the radiance is multiplied by: of what the photo shows
         and eq. 8 does not, the part that is not the person's albedo. It holds in the fitted light of that avatar
         alone. An avatar without one has 1 everywhere. (Default: empty, no refinement)
     * - shaded_lobes
       - |tensor|
       - Numbers of the lobes that the closed form sums up; `visibility` is that of all lobes. (Default: all)

    Eq. 8 in closed form: the radiance that a `neural_sdf` with a `sira_bsdf` reflects under an `sg_envmap`, without
    sampling and without noise. Shadows come from rays against the scene's meshes in a fixed set of directions, half of
    them spread evenly, half drawn from the lobes; interreflection is one bounce off surfaces that are taken to face the
    point and to have its albedo. `path` renders the same scene with both in full.
    Albedos that are `neural_albedo` textures are evaluated as networks in tensor mode; any other texture is asked at
    the hit. Other shapes only occlude.

    Where k_s is 0 and not differentiated, the specular part is not computed.

    Extra channels: `diffuse.RGB` and `specular.RGB` (r^d and k_s r^s, without `light_refinement`),
    `diffuse_albedo.RGB`, `specular_albedo`, `normal.XYZ` (world, of the field), `depth` (along the ray from the
    sensor's near plane, as of `aov`, in scene units) and `mask` (1 on the head). All are zero off the head.

    Where something is differentiated, hits are exact, every sample has its own shading and all lobes are summed up,
    whatever the options say. Differentiable in everything that the scene exposes: lobes, albedo networks and latents,
    k_s and k_r, and, through implicit differentiation, the shape's latent and networks (interior derivatives; for
    silhouettes see `sira_radiance` and the stock projective integrators). What blocks the light, and the directions in
    which that is tested, count as constants. Cannot be nested in symbolic code. Derivatives repeat bit for bit, but for
    those of lobes through a background that is shown, which the emitter sums by atomics.

    Source: SIRA (Caselles et al. 2022), section 3.1.3; PhySG (Zhang et al. 2021).

    .. tabs::
        .. code-tab:: python

            'type': 'sira_sg'
    """

    def __init__(self, props):
        super().__init__(props)
        self.hide_environment = bool(props.get("hide_emitters", False))
        self.visibility = bool(props.get("visibility", True))
        self.directions = int(props.get("visibility_directions", 64))
        if not 16 <= self.directions <= 4096:
            raise InputError(f"sira_sg: visibility_directions is {self.directions}; it must be 16 to 4096")
        self.aovs = bool(props.get("aovs", True))
        self.exact = bool(props.get("exact", True))
        self.shared = bool(props.get("shared", False))
        self.refinement = light_refinement_of(find_avatar(props, "light_refinement"))
        self.shaded_lobes = np.array(props["shaded_lobes"]).astype(int) if "shaded_lobes" in props else None

    def sample(self, scene, sampler, ray, medium=None, active=True):
        head = find_head(scene, "sira_sg")
        bsdf, light = head.bsdf(), scene.environment()
        if not isinstance(bsdf, SiraBSDF):
            raise RuntimeError("sira_sg: the neural_sdf must have a sira_bsdf; use path for other materials")
        if not isinstance(light, SGEnvmap):
            raise RuntimeError("sira_sg: the environment must be an sg_envmap; use path for other lights")
        ray = mi.Ray3f(ray)
        width = dr.width(ray.o, ray.d)
        attached = dr.grad_enabled(*differentiable_arrays(head, bsdf, light), ray.o, ray.d)
        samples = sampler.sample_count() if self.shared and sampler is not None and not attached else 1
        shared = samples > 1 and width % samples == 0
        surface_hits = leader = None
        if attached or (self.exact and not shared):
            t, hit = trace_head(scene, head, ray, active)
        else:
            surface_hits, hit = mesh_hits(scene, head, ray, active)
            t, shaded = surface_hits.t, hit
            if shared:
                arrays = (head.to_local @ surface_hits.p, surface_hits.sh_frame.n, hit)
                leader = mi.UInt32(multisampling.leaders(*(a.numpy() for a in arrays), samples))
                shaded = hit & (leader == dr.arange(mi.UInt32, width))
            t, hit = head.refine(ray, t, shaded) if self.exact else (t, shaded)

        background = dr.zeros(mi.Color3f, width)
        if not self.hide_environment:
            si = dr.zeros(mi.SurfaceInteraction3f, width)
            si.wi = -ray.d
            background = light.eval(si, active & ~hit)
        index = dr.compress(hit)
        rows_of = _ROWS if self.aovs else {name: _ROWS[name] for name in ("diffuse", "specular")}
        if self.refinement is not None:
            rows_of = {**rows_of, "light": 3}
        kinds = {name: mi.Color3f if rows == 3 else mi.Float for name, rows in rows_of.items()}
        parts = {name: dr.zeros(kind, width) for name, kind in kinds.items()}
        if dr.width(index) > 0:
            on_mesh = None if attached or self.exact else dr.gather(mi.SurfaceInteraction3f, surface_hits, index)
            columns = self._shade(scene, head, bsdf, light, ray, t, index, attached, on_mesh)
            row = 0
            for name, rows in rows_of.items():
                parts[name] = scatter_columns(columns[row : row + rows, :], index, width, kinds[name])
                row += rows
        if leader is not None:
            t, hit = dr.gather(mi.Float, t, leader), dr.gather(mi.Bool, hit, leader)
            parts = {name: dr.gather(kinds[name], part, leader) for name, part in parts.items()}
        radiance = parts["diffuse"] + parts["specular"]
        if self.refinement is not None:
            radiance *= parts["light"]
        color = dr.select(hit, radiance, background)
        valid = active & (hit | (not self.hide_environment))
        if not self.aovs:
            return color, valid, []
        depth = dr.select(hit, t, 0.0)
        aovs = [
            *parts["diffuse"],
            *parts["specular"],
            *parts["diffuse_albedo"],
            parts["specular_albedo"],
            *parts["normal"],
            depth,
            dr.select(hit, mi.Float(1.0), 0.0),
        ]
        return color, valid, aovs

    def _shade(self, scene, head, bsdf, light, ray, t, index, attached, on_mesh):
        """All of `_ROWS` at the hits `index`, as one tensor [13, n], or the radiances [6, n] without extra channels,
        and the factor [3, n] of the light's refinement, if there is one; in chunks when nothing is differentiated.
        `on_mesh` are the interactions with the mesh, None where hits are exact."""
        field = head.field()
        local = head.to_local @ ray
        origin, direction, parameter = (to_columns(dr.gather(type(v), v, index)) for v in (local.o, local.d, t))
        lobes = all_lobes = local_lobes(light, head)
        if not attached:
            lobes = self._shaded(lobes)
        speculars = attached or bsdf.k_s.numpy().item() != 0
        k_s = mi.TensorXf(bsdf.k_s, (1, 1))
        rotation = mi.TensorXf(rotation_of(head.to_world))

        def albedo(texture, x, x_ref, gamma, rows):
            if isinstance(texture, NeuralAlbedo):
                return texture.evaluate_columns(x_ref, gamma)[0:rows, :]
            si = dr.zeros(mi.SurfaceInteraction3f, x.shape[1])
            si.p = head.to_world @ from_columns(x, mi.Point3f)
            value = texture.eval(si) if rows == 3 else texture.eval_1(si)
            return to_columns(value + dr.zeros(mi.Float, x.shape[1]))

        if self.visibility:
            directions = visibility.light_directions(dr.detach(all_lobes).numpy(), self.directions)

        def radiances(x, normal, view, diffuse, specular):
            material = Material(diffuse, specular if speculars else None, bsdf.roughness, k_s)
            if not self.visibility:
                return reflected_radiance(normal, view, material, lobes)
            unoccluded = unoccluded_directions(scene, head, x, normal, directions)
            visible = visibility.light_visibility(
                normal, view, material.specular_albedo, bsdf.roughness, all_lobes, directions, unoccluded
            )
            return reflected_radiance(normal, view, material, lobes, visible)

        def columns(x, direction):
            _, gradient, x_ref, gamma = surface(field, x)
            diffuse = albedo(bsdf.diffuse_albedo, x, x_ref, gamma, 3)
            specular = albedo(bsdf.specular_albedo, x, x_ref, gamma, 1) if speculars or self.aovs else None
            refined = [] if self.refinement is None else [self._light(x_ref, gamma)]
            return shaded(x, direction, normalise(gradient), diffuse, specular, *refined)

        def shaded(x, direction, normal, diffuse, specular, *refined):
            radiance = radiances(x, normal, normalise(direction), diffuse, specular)
            extra = (diffuse, specular, rotation @ normal) if self.aovs else ()
            return dr.concat([*radiance, *extra, *refined], axis=0)

        if on_mesh is not None:
            inverse = mi.TensorXf(np.ascontiguousarray(rotation_of(head.to_world).T))
            x, normal = to_columns(head.to_local @ on_mesh.p), inverse @ to_columns(on_mesh.sh_frame.n)
            at_mesh = [x, direction, normal, *mesh_albedos(head, bsdf, on_mesh, x)]
            if self.refinement is not None:
                factor = evaluate_in_chunks(lambda p: self._light(*deform(field, p)), x.numpy())[0]
                at_mesh.append(mi.TensorXf(factor))
            return mi.TensorXf(evaluate_in_chunks(shaded, *(a.numpy() for a in at_mesh))[0])
        if not attached:
            x = on_ray(origin, direction, parameter)
            return mi.TensorXf(evaluate_in_chunks(columns, x.numpy(), direction.numpy())[0])
        parameter = dr.detach(parameter)
        return columns(differentiable_hit(field, origin, direction, parameter), direction)

    def _light(self, x_ref, gamma):
        """The factor [3, N] of the light's refinement."""
        network, octaves = self.refinement
        return dr.exp(light_refinement(network, octaves, x_ref, gamma))

    def _shaded(self, lobes):
        """Those of `lobes` [N_l, 7] that the closed form sums up."""
        if self.shaded_lobes is None:
            return lobes
        count = lobes.shape[0]
        if not (len(self.shaded_lobes) and ((self.shaded_lobes >= 0) & (self.shaded_lobes < count)).all()):
            raise InputError(f"sira_sg: shaded_lobes must be numbers of lobes, 0 to {count - 1}, and at least one")
        return mi.TensorXf(np.ascontiguousarray(lobes.numpy()[self.shaded_lobes]))

    def aov_names(self):
        if not self.aovs:
            return []
        names = []
        for name, channels in (("diffuse", "RGB"), ("specular", "RGB"), ("diffuse_albedo", "RGB")):
            names += [f"{name}.{c}" for c in channels]
        return [*names, "specular_albedo", *(f"normal.{c}" for c in "XYZ"), "depth", "mask"]

    def to_string(self):
        return f"SiraSG[hide_emitters = {self.hide_environment}, visibility = {self.visibility}]"


def light_refinement_of(path: str) -> tuple | None:
    """Layers of the network of an avatar file that refines the light, and the octaves of its encoding; None without
    a path and where the avatar has none."""
    avatar = load_avatar(path) if path else None
    if avatar is None or "light_refinement" not in avatar.tensors:
        return None
    network = avatar.architecture.networks["light_refinement"]
    return layers(network, mi.Float(avatar.tensors["light_refinement"])), avatar.architecture.refinement_octaves


def mesh_hits(scene, head, ray, active):
    """Interactions of `ray` with the scene's meshes, and whether they are with the head's."""
    with dr.suspend_grad():
        si = scene.ray_intersect(ray, active)
        hit = active & si.is_valid() & (si.shape == mi.ShapePtr(head))
        dr.eval(si, hit)
        return si, hit


def mesh_albedos(head, bsdf, si, x) -> list:
    """Diffuse [3, N] and specular albedo [1, N] at interactions `si` with the head's mesh, whose places are x [3, N] in
    the field's coordinates: baked ones and those of other textures as they are asked for at `si`, else by networks."""
    textures = (bsdf.diffuse_albedo, bsdf.specular_albedo)
    by_network = [isinstance(texture, NeuralAlbedo) and not texture.baked for texture in textures]
    inputs = evaluate_in_chunks(lambda p: deform(head.field(), p), x.numpy()) if any(by_network) else None
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
    """Which of `directions`, in the field's coordinates, no surface of the scene blocks at surface points and normals
    [3, N] of the field: tensor [K, N] of 0 and 1, without gradients."""
    rotation = rotation_of(head.to_world)
    point = (head.to_world @ from_columns(dr.detach(x), mi.Point3f)).numpy()
    offset = visibility.SHADOW_OFFSET * head.voxel * scale_of(head.to_world)
    normal = rotation @ dr.detach(normal).numpy()
    return mi.TensorXf(
        visibility.trace_unoccluded(scene, point, normal, directions.axis @ rotation.T, offset).astype(np.float32)
    )


def differentiable_arrays(head, bsdf, light) -> list:
    """Every array of the head, its material and its light that a gradient may be asked of."""
    textures = [t for t in (bsdf.diffuse_albedo, bsdf.specular_albedo) if isinstance(t, NeuralAlbedo)]
    own = [p for t in textures for p in (t.weights, t.latent, t.refinement, t.k_r)]
    return [*head.parameters.values(), bsdf.k_s, bsdf.roughness, light.lobes, light.scale, *own]


def local_lobes(light, head):
    """The light's lobes [N_l, 7] with axes in the field's coordinates."""
    rotation = rotation_of(head.to_local @ light.world_transform())
    axis, sharpness, amplitude = light.lobes[:, 0:3], light.lobes[:, 3:4], light.lobes[:, 4:7]
    return dr.concat([axis @ mi.TensorXf(rotation.T), sharpness, amplitude * mi.TensorXf(light.scale, (1, 1))], axis=1)


def rotation_of(transform) -> np.ndarray:
    """Rotation [3, 3] of a transform that rotates, translates and scales uniformly."""
    matrix = np.array(transform.matrix.numpy()).reshape(4, 4)[:3, :3]
    return np.ascontiguousarray(matrix / scale_of(transform), dtype=np.float32)


def scale_of(transform) -> float:
    """Scale of a transform that rotates, translates and scales uniformly."""
    return float(np.cbrt(np.linalg.det(np.array(transform.matrix.numpy()).reshape(4, 4)[:3, :3])))


mi.register_integrator("sira_sg", lambda props: SiraSG(props))
