from typing import Any, cast

import drjit as dr
import mitsuba as mi
import numpy as np

from sira_mi.avatar.file import load_avatar
from sira_mi.avatar.shape import POSE, SHAPE_PARAMETERS, HeadShape
from sira_mi.fields import tracing
from sira_mi.fields.columns import CHUNK, evaluate_in_chunks, gather_columns, scatter_columns, to_array
from sira_mi.fields.extraction import extract
from sira_mi.fields.sdf import SdfField, deform, signed_distance, surface
from sira_mi.plugins._parameters import (
    check_networks,
    read_flag,
    read_integer,
    read_number,
    read_similarity,
)
from sira_mi.plugins.neural_albedo import FieldMesh, NeuralAlbedo, find_avatar

# An attribute without a meaning of its own: Mitsuba's `merge` leaves meshes with attributes as they are.
UNMERGED = "vertex_unmerged"


class NeuralSDF(mi.Mesh):
    r"""
    .. _shape-neural_sdf:

    Neural signed distance field (`neural_sdf`)
    -------------------------------------------

    .. pluginparameters::

     * - avatar
       - |string|
       - An `avatar.safetensors`; empty for the mean head of the shipped prior. (Default: empty)
     * - voxel
       - |float|
       - Spacing of the grid from which the mesh is extracted, in scene units of 100 mm. (Default: 0.05)
     * - remesh_every
       - |int|
       - Extract the mesh again at every n-th parameter update. With 1 the mesh carries gradients. With more it is kept
         in between and carries none, which suits integrators that refine hits on the field. (Default: 1)
     * - movable
       - |bool|
       - Expose `pose`. (Default: false)
     * - to_world
       - |transform|
       - Rotation, translation and uniform scale. (Default: identity)
     * - deformation, reference
       - |Float|
       - Flat parameters of the deformation and reference networks.
       - |exposed|, |differentiable|, |discontinuous|
     * - z_sdf
       - |Float|
       - Shape latent.
       - |exposed|, |differentiable|, |discontinuous|
     * - pose
       - |Float|
       - Rotation vector (radians) and translation (scene units) applied to points before they enter the field, which
         moves the head by the inverse. Exposed if the shape is `movable`.
       - |exposed|, |differentiable|, |discontinuous|
     * - (Nested plugin)
       - |bsdf|
       - Any BSDF. A `neural_albedo` inside it uses this shape's reference space; baked ones become mesh attributes.

    SIRA's composed signed distance field: a deformation network maps a point and the latent to an offset δ and features
    γ (eq. 1), and the reference network is evaluated at x + δ (eqs 2 and 3). The zero level set inside the domain box
    is extracted as a closed triangle mesh. Newton steps move its vertices onto the level set, and implicit
    differentiation attaches them to the field's parameters,

        x(θ) = x₀ − ∇f (f(x₀; θ) − f(x₀; θ₀)) / |∇f|²,

    so every Mitsuba integrator sees a mesh, and `direct_projective` and `prb_projective` find silhouette gradients.
    This project's integrators refine hits on the field itself (`refine`).

    Change the geometry through the *scene's* parameters (`mi.traverse(scene)`), and call `params.update()` after
    enabling gradients. The shape has no UVs and should not be used as an area light. Where it meets the domain box it
    is closed by a flat cap without gradients. An update refuses the values that loading refuses. When Mitsuba loads a
    scene, it merges meshes with equal BSDFs unless they have attributes; the empty attribute `vertex_unmerged` keeps a
    head apart.

    Source: SIRA (Caselles et al. 2022), section 3.1.1; implicit differentiation as in IDR (Yariv et al. 2020).

    .. tabs::
        .. code-tab:: python

            'type': 'neural_sdf',
            'avatar': 'avatar/avatar.safetensors',
            'bsdf': {'type': 'sira_bsdf'}
    """

    def __init__(self, props):
        self.avatar_path = find_avatar(props)
        avatar = load_avatar(self.avatar_path)
        self.voxel = read_number(props, "neural_sdf", "voxel", 0.05, 0.005, 0.5)
        self.remesh_every = read_integer(props, "neural_sdf", "remesh_every", 1, 1, 1 << 30)
        matrix, self.scale = read_similarity(props, "neural_sdf")
        super().__init__(props.id() or "neural_sdf", 1, 1, props=props, has_vertex_normals=True)
        self.to_world = mi.Transform4f(cast(Any, matrix))  # the stubs leave out float64
        self.to_local = self.to_world.inverse()
        self._matrix_to_local = np.linalg.inv(matrix)
        self.head_shape = HeadShape(avatar.architecture)
        self.parameters = {name: mi.Float(avatar.tensors[name]) for name in SHAPE_PARAMETERS}
        if read_flag(props, "neural_sdf", "movable", False):
            self.parameters[POSE] = mi.Float(np.zeros(6, np.float32))
        self._sizes = {name: len(value) for name, value in self.parameters.items()}
        self._updates = 0
        self._last_hits = None
        self._textures = [node for node in mi.traverse(self.bsdf()).hierarchy if isinstance(node, NeuralAlbedo)]
        if self._textures and POSE in self.parameters:
            raise ValueError("neural_sdf: a movable head cannot carry a neural_albedo, which does not move with it")
        self._mesh = FieldMesh()
        for texture in self._textures:
            texture.own(self)
        self._bind_textures()
        self._extract()
        self._add_attributes()
        self._attach()

    def field(self) -> SdfField:
        """The field's layers at the current parameters; differentiable where those are."""
        return self.head_shape.field(self.parameters)

    def vertices(self) -> np.ndarray:
        """Vertices [3, V] of the mesh in the field's coordinates."""
        return self._x0.numpy()

    def faces(self) -> np.ndarray:
        """Triangles [T, 3] of the mesh, by indices of its vertices."""
        return self._faces.numpy().reshape(-1, 3)

    def remesh_at_next_update(self) -> None:
        """Makes the next update of the parameters extract the mesh, and starts the count of `remesh_every` there."""
        self._updates = self.remesh_every - 1

    def ray_to_local(self, ray):
        """A ray of the world in the field's coordinates, its direction as long as in the world: a distance t along the
        one is t divided by `scale` along the other."""
        local = self.to_local @ ray
        local.d = local.d * self.scale
        return local

    def refine(self, ray, t, active):
        """Exact hits of `ray` (Ray3f) near the proxy hits at t (Float), for the `active` lanes: (t of the exact hit,
        whether there is one). The field is evaluated outside of symbolic code."""
        width = dr.width(t)
        index = dr.compress(active)
        if dr.width(index) == 0:
            return t, dr.zeros(mi.Bool, width)
        ray = dr.detach(ray)
        origin, direction, start = (
            gather_columns(a, index).numpy().astype(np.float64) for a in (ray.o, ray.d, mi.Float(t))
        )
        # From the proxy's hit on: single precision does not resolve 0.01 mm at a camera's distance.
        matrix = self._matrix_to_local
        base = matrix[:3, :3] @ (origin + start * direction) + matrix[:3, 3:]
        columns = [a.astype(np.float32) for a in (base, matrix[:3, :3] @ direction * self.scale, 0 * start)]
        step, f = self._newton(columns)
        hit = dr.zeros(mi.Bool, width)
        dr.scatter(hit, mi.Bool(np.abs(f[0]) < tracing.HIT_TOLERANCE), index)
        exact = (start + step * self.scale).astype(np.float32)
        return scatter_columns(mi.TensorXf(exact), index, width, mi.Float), hit

    def _newton(self, columns: list[np.ndarray]) -> list[np.ndarray]:
        """Newton hits of rays [3, N], [3, N] from [1, N]. The last result is kept: `mi.render` traces the same rays
        once for the picture and once more for its derivative."""
        parameters = tuple(map(dr.detach, self.parameters.values()))
        if self._last_hits is not None:
            rays, then, result = self._last_hits
            same_field = all(a.index == b.index for a, b in zip(parameters, then, strict=True))
            if same_field and all(np.array_equal(a, b) for a, b in zip(columns, rays, strict=True)):
                return result
        result = tracing.refine_hits(tracing.with_unit_gradient(self.field(), self._gradient_length), *columns)
        self._last_hits = (columns, parameters, result) if columns[2].size <= CHUNK else None
        return result

    def _evaluate(self, points: np.ndarray) -> np.ndarray:
        field = self.field()
        return evaluate_in_chunks(lambda x: signed_distance(field, x), points)[0][0]

    def _extract(self) -> None:
        """Extracts the mesh, and moves its vertices onto the field's level set."""
        extracted = extract(self._evaluate, self.voxel)
        self.grid = tracing.DistanceGrid.of(extracted.grid, extracted.spacing)
        field = self.field()
        x = extracted.vertices.T
        moved = ~extracted.on_box
        for _ in range(2):
            f, gradient = evaluate_in_chunks(lambda p: surface(field, p)[:2], x)
            step = f * gradient / np.maximum((gradient**2).sum(axis=0), 1e-4)
            x = x - np.where(moved, np.clip(step, -0.5 * self.voxel, 0.5 * self.voxel), 0)
        self._x0 = to_array(x)
        self._gradient = np.where(moved, gradient, 0)
        lengths = np.linalg.norm(gradient[:, moved], axis=0)
        self._gradient_length = max(float(np.median(lengths)), 1e-3) if moved.any() else 1.0
        self._faces = mi.UInt32(extracted.faces.ravel())
        self._mesh.vertices, self._mesh.faces = self._x0, self._faces

    def _attach(self) -> None:
        """Sets the mesh to the extracted vertices, attached to those parameters that have gradients enabled."""
        x = self._x0
        if any(map(dr.grad_enabled, self.parameters.values())):
            f = signed_distance(self.field(), x)
            weight = self._gradient / np.maximum((self._gradient**2).sum(axis=0), 1e-4)
            x = x - mi.TensorXf(weight.astype(np.float32)) * (f - dr.detach(f))
        position = self.to_world @ mi.Point3f(x[0].array, x[1].array, x[2].array)
        params = mi.traverse(self)
        params["vertex_positions"] = dr.ravel(position)
        params["faces"] = self._faces
        params[UNMERGED] = dr.zeros(mi.Float, x.shape[1])
        for name, albedo in self._bake().items():
            params[name] = albedo
        params.update()

    def _bind_textures(self) -> None:
        for texture in self._textures:
            texture.bind(self.head_shape, self.parameters, self.to_local, self._mesh)

    def _add_attributes(self) -> None:
        """Makes an empty vertex attribute for every baked texture, and tells the textures their names."""
        self.add_attribute(UNMERGED, 1, [0.0] * self.vertex_count())
        self._baked: dict[str, NeuralAlbedo] = {}
        for texture in self._textures:
            if texture.baked:
                same = sum(t.kind == texture.kind for t in self._baked.values())
                name = f"vertex_{texture.kind}_albedo" + (f"_{same + 1}" if same else "")
                self._baked[name] = texture
                texture.bind_attribute(name)
                channels = 1 if texture.kind == "specular" else 3
                self.add_attribute(name, channels, [0.0] * (channels * self.vertex_count()))

    def _bake(self) -> dict:
        """The baked textures' albedos at the vertices, as flat arrays by the name of their attribute."""
        if not self._baked:
            return {}
        field, textures = self.field(), self._baked.values()
        columns = evaluate_in_chunks(
            lambda x: tuple(texture.evaluate_networks(*deform(field, x)) for texture in textures), self.vertices()
        )
        for texture in textures:
            texture.changed = False
        return {name: mi.Float(np.ravel(c.T)) for name, c in zip(self._baked, columns, strict=True)}

    def traverse(self, callback):
        super().traverse(callback)
        for key, value in self.parameters.items():
            callback.put(key, value, mi.ParamFlags.Differentiable | mi.ParamFlags.Discontinuous)

    def parameters_changed(self, keys=()):
        if not any(key in keys for key in self.parameters):
            super().parameters_changed(keys)
            if any(texture.changed for texture in self._baked.values()):
                self._renew_attributes()
            return
        check_networks("neural_sdf", self.parameters, self._sizes)
        self._bind_textures()
        self._updates += 1
        if self._updates % self.remesh_every == 0:
            self._updates = 0
            self._extract()
            self._attach()
        else:
            self._renew_attributes()

    def _renew_attributes(self) -> None:
        if baked := self._bake():
            params = mi.traverse(self)
            for name, albedo in baked.items():
                params[name] = albedo
            params.update()

    def to_string(self):
        return f"NeuralSDF[voxel = {self.voxel}, vertices = {self._x0.shape[1]}]"


def find_head(scene, integrator: str) -> NeuralSDF:
    """The scene's one `neural_sdf`. Raises RuntimeError, naming the integrator, when there is none or several."""
    heads = [shape for shape in scene.shapes() if isinstance(shape, NeuralSDF)]
    if len(heads) != 1:
        raise RuntimeError(f"{integrator}: the scene must hold exactly one neural_sdf, it holds {len(heads)}")
    return heads[0]


def trace_head(scene, head: NeuralSDF, ray, active):
    """Exact hits of `ray` on the head: (t, whether the head is hit and nothing else lies before it). Rays that
    graze the mesh without meeting the field miss."""
    with dr.suspend_grad():
        proxy = scene.ray_intersect_preliminary(ray, True, active)
        on_head = active & proxy.is_valid() & (proxy.shape == mi.ShapePtr(head))
        dr.eval(proxy, on_head)
        return head.refine(ray, proxy.t, on_head)


mi.register_shape("neural_sdf", lambda props: NeuralSDF(props))
