import drjit as dr
import mitsuba as mi

from sira_mi.avatar.decoders import render_radiance
from sira_mi.avatar.file import AvatarArchitecture, load_avatar
from sira_mi.conventions import DOMAIN_LOWER, DOMAIN_UPPER
from sira_mi.fields.columns import from_columns, gather_columns, normalise, scatter_columns
from sira_mi.fields.mlp import layers
from sira_mi.fields.sdf import signed_distance, surface
from sira_mi.fields.tracing import closest_approach, differentiable_hit, refine_approach
from sira_mi.plugins._parameters import check_networks, read_number
from sira_mi.plugins.neural_albedo import find_avatar
from sira_mi.plugins.neural_sdf import NeuralSDF, find_head, trace_head

# The closest approach that a ray outside the domain box is given, in scene units.
FAR = 1.0
# Rays that come this close to the surface, in scene units, decide the mask.
OUTLINE = 0.3


class SiraRadiance(mi.SamplingIntegrator):
    r"""
    .. _integrator-sira_radiance:

    Learned radiance (`sira_radiance`)
    ----------------------------------

    .. pluginparameters::

     * - avatar
       - |string|
       - An `avatar.safetensors`; empty for the one that the scene's head was loaded from. (Default: empty)
     * - mask_sharpness
       - |float|
       - α of the soft mask σ(−α min f), per scene unit. (Default: 50)
     * - rendering
       - |Float|
       - Flat parameters of the rendering function r.
       - |exposed|, |differentiable|
     * - z_r
       - |Float|
       - Appearance latent.
       - |exposed|, |differentiable|

    Renders a scene's `neural_sdf` by its learned, non-physical radiance r(x_ref, n, v, γ) (eq. 4), as section 3.2.1
    fits it to a photo. It ignores lights; other shapes only occlude. Hits lie on the field, not on its mesh, and are
    differentiable by implicit differentiation with respect to the shape's latent, networks and pose. The rendering
    function is differentiable with respect to `z_r` and `rendering`.

    Besides colour and alpha (1 where the ray hits the head) there are two channels: `mask`, IDR's soft mask
    σ(−α min f), and `closest`, min f along the ray in scene units (1 for rays outside the domain box), from which a
    mask loss can be computed stably. Silhouette gradients come from these channels; those of the colour come from
    inside the silhouette.

    Without an `avatar`, the networks are loaded at the first render, and `rendering` and `z_r` are exposed from then
    on; give `avatar` to differentiate them from the start. Not available inside symbolic code, since the networks are
    evaluated in tensor mode on all rays of a pass.

    Source: SIRA (Caselles et al. 2022), eq. 4 and section 3.2.1; IDR (Yariv et al. 2020).

    .. tabs::
        .. code-tab:: python

            'type': 'sira_radiance',
            'avatar': 'avatar/avatar.safetensors'
    """

    def __init__(self, props):
        super().__init__(props)
        path = find_avatar(props)
        self.mask_sharpness = read_number(props, "sira_radiance", "mask_sharpness", 50.0, 1e-6)
        self.architecture: AvatarArchitecture | None = None
        if path:
            self._load(path)

    def _load(self, path: str) -> AvatarArchitecture:
        avatar = load_avatar(path)
        self.architecture = avatar.architecture
        self.rendering = mi.Float(avatar.tensors["rendering"])
        self.z_r = mi.Float(avatar.tensors["z_r"])
        self._sizes = {"rendering": len(self.rendering), "z_r": len(self.z_r)}
        return avatar.architecture

    def sample(self, scene, sampler, ray, medium=None, active=True):
        # Scene and hits.
        head = find_head(scene, "sira_radiance")
        architecture = self.architecture or self._load(head.avatar_path)
        ray = mi.Ray3f(dr.detach(ray))
        width = dr.width(ray.o, ray.d)
        local = head.ray_to_local(ray)
        t, hit = trace_head(scene, head, ray, active)
        field = head.field()

        # Mask: by the closest approach of every ray. Before the colour: the order decides the last bits of gradients.
        closest = self._closest(head, field, local, active, width)
        mask = dr.rcp(1.0 + dr.exp(dr.clip(self.mask_sharpness * closest, -60.0, 60.0)))

        # Colour: eq. 4 at the hits, in tensors, one column a hit.
        color = dr.zeros(mi.Color3f, width)
        index = dr.compress(hit)
        if dr.width(index) > 0:
            origin, direction, parameter = (gather_columns(a, index) for a in (local.o, local.d, t / head.scale))
            x = differentiable_hit(field, origin, direction, parameter)
            _, gradient, x_ref, gamma = surface(field, x)
            network = layers(architecture.networks["rendering"], self.rendering, self.z_r)
            octaves = architecture.rendering_octaves
            radiance = render_radiance(network, octaves, x_ref, normalise(gradient), normalise(direction), gamma)
            color = scatter_columns(radiance, index, width, mi.Color3f)
        return color, hit, [mask, closest]

    @staticmethod
    def _closest(head: NeuralSDF, field, local, active, width: int):
        """min f along the rays (Float): evaluated on the field, at a place found on the shape's distance grid. Near the
        outline, where it decides the mask, the place is found on the field."""
        box = mi.BoundingBox3f(mi.Point3f(*DOMAIN_LOWER), mi.Point3f(*DOMAIN_UPPER))
        inside, near, far = box.ray_intersect(local)
        inside &= active
        near = dr.maximum(near, 0.0)
        t = closest_approach(head.grid, local.o, local.d, near, far, inside)
        outline = dr.compress(inside & (dr.abs(head.grid(local.o + t * local.d, inside)) < OUTLINE))
        if dr.width(outline) > 0:
            origin, direction, near_t = (gather_columns(a, outline) for a in (local.o, local.d, t))
            approach = refine_approach(field, origin, direction, near_t, head.voxel)
            dr.scatter(t, from_columns(approach, mi.Float), outline)
            t = dr.clip(t, near, far)
        index = dr.compress(inside)
        closest = dr.full(mi.Float, FAR, width)
        if dr.width(index) > 0:
            x = gather_columns(mi.Point3f(local.o + t * local.d), index)
            dr.scatter(closest, from_columns(signed_distance(field, x), mi.Float), index)
        return closest

    def aov_names(self):
        return ["mask", "closest"]

    def traverse(self, callback):
        if self.architecture is not None:
            callback.put("rendering", self.rendering, mi.ParamFlags.Differentiable)
            callback.put("z_r", self.z_r, mi.ParamFlags.Differentiable)

    def parameters_changed(self, keys=()):
        if self.architecture is not None:
            check_networks("sira_radiance", {"rendering": self.rendering, "z_r": self.z_r}, self._sizes)

    def to_string(self):
        return f"SiraRadiance[mask_sharpness = {self.mask_sharpness}]"


mi.register_integrator("sira_radiance", lambda props: SiraRadiance(props))
