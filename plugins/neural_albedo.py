import weakref
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from sira_mi.avatar.decoders import (
    albedo_refinement,
    albedo_refinement_cooperative,
    diffuse_albedo,
    diffuse_albedo_cooperative,
    refine_albedo,
    specular_albedo,
    specular_albedo_cooperative,
)
from sira_mi.avatar.detail import AlbedoDetail
from sira_mi.avatar.file import load_avatar
from sira_mi.avatar.shape import HeadShape
from sira_mi.errors import InputError
from sira_mi.fields.columns import from_columns, to_columns
from sira_mi.fields.mlp import layers, pack
from sira_mi.fields.sdf import deform_cooperative
from sira_mi.plugins._parameters import check_networks, read_flag


def is_instanced(si):
    """Whether surface interactions are with an `instance` of a shape."""
    return dr.reinterpret_array(mi.UInt32, si.instance) != 0


def find_avatar(props, name: str = "avatar") -> str:
    """The path in a plugin's property `name`: relative to the scene file's folder if it is found there, else to the
    current one; empty where none is given."""
    path = props.get(name, "")
    resolver: Any = mi.file_resolver  # a function, which the stubs call an object
    return str(resolver().resolve(path)) if path else ""


@dataclass
class FieldMesh:
    """A head's mesh in its field's coordinates."""

    vertices: Any = None  # [3, V]
    faces: Any = None  # indices of vertices, three a triangle


class NeuralAlbedo(mi.Texture):
    r"""
    .. _texture-neural_albedo:

    Neural albedo (`neural_albedo`)
    -------------------------------

    .. pluginparameters::

     * - avatar
       - |string|
       - An `avatar.safetensors`; empty for the mean head of the shipped prior. (Default: empty)
     * - kind
       - |string|
       - `diffuse` (three channels, eqs 9a and 11) or `specular` (one channel, eq. 9b). (Default: `diffuse`)
     * - baked
       - |bool|
       - Evaluate the networks once per vertex of the `neural_sdf` that owns this texture, and interpolate. (Default:
         false)
     * - weights
       - |Float|
       - Flat parameters of the albedo network.
       - |exposed|, |differentiable|
     * - latent
       - |Float|
       - Latent code: z_a (`diffuse`) or z_s (`specular`).
       - |exposed|, |differentiable|
     * - refinement
       - |Float|
       - Flat parameters of the refinement network a^r (`diffuse` only).
       - |exposed|, |differentiable|
     * - k_r
       - |Float|
       - Weight of the refinement, eq. 11 (`diffuse` only). (Default: the avatar's)
       - |exposed|, |differentiable|

    A neural field over SIRA's reference space: the deformation network maps a surface point to x_ref and features γ,
    from which the albedo network predicts the albedo. Inside the BSDF of a `neural_sdf`, deformation, shape latent and
    transform are that shape's, and gradients flow to them; elsewhere they are the avatar's. A texture belongs to one
    shape. Two heads need two materials, and `optimize=False` where these are alike, for Mitsuba makes one of them
    otherwise. Instances of its shape show the shape's albedo, without gradients to the shape.

    The avatar of a fit also holds a detail: the diffuse albedo of all that its photo shows, as a picture in the photo's
    camera. Points that the photo shows, by a depth map, take it in place of the networks' albedo, `baked` or not. It is
    as sharp as the photo, fixed in the field's coordinates, and has no gradients.

    Works in any stock BSDF and inside symbolic loops, where networks are evaluated as cooperative vectors. Call
    `params.update()` after enabling gradients. If one channel is asked of a three-channel texture, it returns the
    luminance; if three are asked of a one-channel texture, it returns grey.

    The networks dominate the cost of path tracing a head, and Mitsuba compiles the networks of all live textures into
    every kernel, even those of other scenes. A `baked` texture avoids this: the shape stores the albedo as the mesh
    attribute `vertex_diffuse_albedo` or `vertex_specular_albedo` (with a number appended if a head has several of one
    kind) and updates it whenever parameters change through the scene or the shape. The networks' albedo is limited by
    the mesh; use a `voxel` of 0.03 or less. It has no gradients: enabling one raises RuntimeError at the next render,
    as does using it outside a `neural_sdf`. `sira_sg` evaluates the networks even if a texture is baked, unless its
    `exact` is false.

    Source: SIRA (Caselles et al. 2022), sections 3.1.3 and 3.2.2.

    .. tabs::
        .. code-tab:: python

            'type': 'principled',
            'base_color': {'type': 'neural_albedo', 'avatar': 'avatar/avatar.safetensors'}
    """

    def __init__(self, props):
        super().__init__(props)
        if mi.is_spectral or mi.is_polarized:
            raise InputError("neural_albedo works in RGB and monochrome variants, such as llvm_ad_rgb")
        avatar = load_avatar(find_avatar(props))
        self.baked = read_flag(props, "neural_albedo", "baked", False)
        self.changed = False  # since a baked texture was last baked
        self._attribute = None
        self._owner: Any = None  # a weak reference to the shape whose reference space it has
        self.kind = props.get("kind", "diffuse")
        if self.kind not in ("diffuse", "specular"):
            raise ValueError(f"neural_albedo: kind is '{self.kind}', must be 'diffuse' or 'specular'")
        tensors = avatar.tensors
        self.weights = mi.Float(tensors[f"{self.kind}_albedo"])
        self.latent = mi.Float(tensors["z_a" if self.kind == "diffuse" else "z_s"])
        self.refinement = mi.Float(tensors["albedo_refinement"])
        self.k_r = mi.Float(avatar.k_r)
        self.detail = AlbedoDetail.of(tensors) if self.kind == "diffuse" else None
        self._sizes = {name: len(value) for name, value in self._parameters().items()}
        self.architecture = avatar.architecture
        self._pack()
        self.bind(HeadShape(avatar.architecture), tensors, mi.Transform4f(), None)

    def own(self, owner) -> None:
        """Makes it part of a `neural_sdf`. Raises InputError if it is part of another."""
        if self._owner is not None and self._owner() is not None:
            raise InputError(
                "neural_albedo: two heads share one texture; give each a material of its own, and load with "
                "optimize=False where they are alike"
            )
        self._owner = weakref.ref(owner)

    def bind(self, shape: HeadShape, parameters: Mapping, to_local, mesh: FieldMesh | None) -> None:
        """Takes the reference space from a head: its shape, the parameters of that, the transform from world to the
        field's coordinates, and the mesh."""
        self._mesh = mesh
        self._deformation = pack(shape.deformation(parameters))
        self._to_local = to_local
        self._space = (parameters, to_local)

    def bind_attribute(self, name: str) -> None:
        """Tells a baked texture the mesh attribute that its shape keeps the albedo in."""
        self._attribute = name

    def _network(self):
        return layers(self.architecture.networks[f"{self.kind}_albedo"], self.weights, self.latent)

    def _refinement_network(self):
        return layers(self.architecture.networks["albedo_refinement"], self.refinement)

    def evaluate_columns(self, x, x_ref, gamma):
        """The albedo on tensors, outside of symbolic code: points x [3, N] in the field's coordinates, x_ref [3, N] and
        γ [N_γ, N] -> [3, N] or [1, N]."""
        albedo = self.evaluate_networks(x_ref, gamma)
        if self.detail is None:
            return albedo
        blended = self.detail.blend(list(from_columns(albedo, mi.Color3f)), from_columns(x, mi.Point3f))
        return to_columns(mi.Color3f(*blended))

    def evaluate_networks(self, x_ref, gamma):
        """The albedo without its detail, as `evaluate_columns` takes and returns it."""
        a = self.architecture
        if self.kind == "specular":
            return specular_albedo(self._network(), a.specular_octaves, x_ref)
        base = diffuse_albedo(self._network(), a.albedo_octaves, x_ref, gamma)
        if self._packed_refinement is None:
            return base
        fine = albedo_refinement(self._refinement_network(), a.refinement_octaves, x_ref, gamma)
        return refine_albedo(base, fine, mi.TensorXf(self.k_r, (1, 1)))

    def _pack(self) -> None:
        self._packed = pack(self._network())
        refined = self.kind == "diffuse" and (dr.grad_enabled(self.k_r) or self.k_r.numpy().item() != 0)
        self._packed_refinement = pack(self._refinement_network()) if refined else None
        self._attached = self._gradients()

    def _gradients(self) -> tuple[bool, ...]:
        return tuple(dr.grad_enabled(p) for p in (self.weights, self.latent, self.refinement, self.k_r))

    def _evaluate(self, si) -> list:
        """The albedo at a surface interaction: three Floats (diffuse) or one (specular)."""
        self._check_gradients()
        albedo = self._look_up(si) if self.baked else self._network_albedo(*self._place(si))
        return self._add_detail(albedo, si)

    def _add_detail(self, albedo: list, si) -> list:
        return albedo if self.detail is None else self.detail.blend(albedo, self._point(si))

    def _check_gradients(self) -> None:
        if any(now and not then for now, then in zip(self._gradients(), self._attached, strict=True)):
            raise RuntimeError("neural_albedo: gradients enabled since the last update; call params.update() first")

    def _point(self, si):
        """The point of a surface interaction in the field's coordinates."""
        point = self._to_local @ si.p
        if self._mesh is not None:
            instanced = is_instanced(si)
            point = dr.select(instanced, self._on_mesh(self._mesh, si, instanced), point)
        return point

    def _place(self, si) -> tuple[list, list]:
        """x_ref and γ of a surface interaction."""
        return deform_cooperative(self._deformation, self.architecture.sdf_octaves, list(self._point(si)))

    @staticmethod
    def _on_mesh(mesh: FieldMesh, si, active):
        """The point of the mesh in the field's coordinates. An instance moves the interaction and not the mesh."""
        vertices, faces = mesh.vertices, mesh.faces
        weights = (1.0 - si.uv.x - si.uv.y, si.uv.x, si.uv.y)
        point = mi.Point3f(0.0)
        for corner, weight in enumerate(weights):
            index = dr.gather(mi.UInt32, faces, 3 * si.prim_index + corner, active)
            place = [dr.gather(mi.Float, vertices.array, k * vertices.shape[1] + index, active) for k in range(3)]
            point += weight * mi.Point3f(*place)
        return point

    def _network_albedo(self, x_ref: list, gamma: list) -> list:
        a = self.architecture
        if self.kind == "specular":
            return specular_albedo_cooperative(self._packed, a.specular_octaves, x_ref)
        base = diffuse_albedo_cooperative(self._packed, a.albedo_octaves, x_ref, gamma)
        if self._packed_refinement is None:
            return base
        fine = albedo_refinement_cooperative(self._packed_refinement, a.refinement_octaves, x_ref, gamma)
        return [refine_albedo(b, r, self.k_r) for b, r in zip(base, fine, strict=True)]

    def _look_up(self, si) -> list:
        if self._attribute is None:
            raise RuntimeError("neural_albedo: a baked texture works inside a neural_sdf only; leave baked out")
        if any(self._gradients()):
            raise RuntimeError("neural_albedo: a baked texture has no gradients; leave baked out to differentiate it")
        if self._mesh is not None:  # attributes are looked up at the point where the mesh itself lies
            si = mi.SurfaceInteraction3f(si)
            instanced = is_instanced(si)
            si.p = dr.select(instanced, self._to_local.inverse() @ self._on_mesh(self._mesh, si, instanced), si.p)
        if self.kind == "specular":
            return [si.shape.eval_attribute_1(self._attribute, si)]
        return list(si.shape.eval_attribute_3(self._attribute, si))

    def shares_space(self, other) -> bool:
        """Whether another texture's networks take the same x_ref and γ as this one's."""
        if not isinstance(other, NeuralAlbedo) or self.baked or other.baked:
            return False
        return all(a is b for a, b in zip(self._space, other._space, strict=True))

    def eval_with(self, specular, si, active=True) -> tuple:
        """What `eval` of this texture and `eval_1` of `specular`, which shares its space, give; the deformation is
        evaluated once."""
        self._check_gradients()
        specular._check_gradients()
        place = self._place(si)
        diffuse, other = (texture._network_albedo(*place) for texture in (self, specular))
        diffuse = self._add_detail(diffuse, si)
        value = self._one(diffuse) if mi.is_monochromatic else self._three(diffuse)
        return mi.Spectrum(value) & active, specular._one(other) & active

    def eval(self, si, active=True):
        return mi.Spectrum(self.eval_1(si, active)) if mi.is_monochromatic else self.eval_3(si, active)

    def eval_3(self, si, active=True):
        return self._three(self._evaluate(si)) & active

    def eval_1(self, si, active=True):
        return self._one(self._evaluate(si)) & active

    @staticmethod
    def _three(albedo: list):
        return mi.Color3f(*albedo if len(albedo) == 3 else albedo * 3)

    @staticmethod
    def _one(albedo: list):
        return albedo[0] if len(albedo) == 1 else mi.luminance(mi.Color3f(*albedo))

    def mean(self):
        return mi.Float(0.5)

    def max(self):
        return 1.0

    def is_spatially_varying(self):
        return True

    def _parameters(self) -> dict:
        names = ("weights", "latent", *(("refinement", "k_r") if self.kind == "diffuse" else ()))
        return {name: getattr(self, name) for name in names}

    def traverse(self, callback):
        for name, value in self._parameters().items():
            callback.put(name, value, mi.ParamFlags.Differentiable)

    def parameters_changed(self, keys=()):
        check_networks("neural_albedo", self._parameters(), self._sizes)
        self._pack()
        self.changed = True

    def to_string(self):
        return f"NeuralAlbedo[kind = {self.kind}, baked = {self.baked}]"


mi.register_texture("neural_albedo", lambda props: NeuralAlbedo(props))
