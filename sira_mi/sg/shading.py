"""The integrals of eq. 8 in closed form under an environment of spherical Gaussians, without shadows.

Irradiance is ∫ l (n·ω)₊ dω; specular radiance is ∫ l f^s (n·ω)₊ dω with f^s of `brdf.py`, by the lobes of
`specular.py`.
"""

from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi

from sira_mi.sg.arrays import Color3f, Float, TensorXf, Vector3f
from sira_mi.sg.integrals import cosine_integral
from sira_mi.sg.lobes import interleave, lobe_count, unpack_lobe, unpack_raw
from sira_mi.sg.specular import SpecularLobes, specular_integrals, specular_lobes

# Points that one lane adds up in the adjoint of the lobes; fixed, so that the order of the sum is.
_POINTS_PER_LANE = 32


def diffuse_irradiance(normal: Vector3f, axis: Vector3f, sharpness: Float, amplitude: Color3f) -> Color3f:
    """∫ G (ω·n)₊ dω of one light lobe: irradiance `[..., 3]`; times albedo/π it is diffuse radiance."""
    return amplitude * cosine_integral(dr.dot(normal, axis), sharpness)


def specular_radiance(
    normal: Vector3f,
    view: Vector3f,
    specular_albedo: Float,
    roughness: Float,
    axis: Vector3f,
    sharpness: Float,
    amplitude: Color3f,
) -> Color3f:
    """∫ G f^s (ω·n)₊ dω of one light lobe `[..., 3]`, 0 where the view is below the surface."""
    white, grazing = specular_integrals(specular_lobes(normal, view, roughness), axis, sharpness)
    return amplitude * dr.lerp(grazing, white, specular_albedo)


class DiffusePoint(NamedTuple):
    """A shading point without a specular term."""

    normal: Vector3f


def _point(values):
    """The shading point of the flat `values` of one."""
    return DiffusePoint(*values) if len(values) == 1 else SpecularLobes(*values)


def _integrate_lobe(point, axis, sharpness, amplitude):
    """Irradiance of one light lobe and, but at a `DiffusePoint`, white and grazing specular radiance `[..., 3]`."""
    if isinstance(point, DiffusePoint):
        return (diffuse_irradiance(point.normal, axis, sharpness, amplitude),)
    white, grazing = specular_integrals(point, axis, sharpness)
    return diffuse_irradiance(point.normal, axis, sharpness, amplitude), amplitude * white, amplitude * grazing


def _weigh(parts, gradient):
    """Σ parts · gradient, the scalar whose derivative is the adjoint."""
    return sum(dr.dot(part, weight) for part, weight in zip(parts, gradient, strict=True))


def _sum_over_lobes(point, packed, count):
    """`_integrate_lobe` summed over all lobes, by a symbolic loop in each lane.

    `max_iterations` lets Dr.Jit differentiate the loop in reverse mode."""
    labels = ("irradiance",) if isinstance(point, DiffusePoint) else ("irradiance", "white", "grazing")

    def body(index, *sums):
        parts = _integrate_lobe(point, *unpack_lobe(packed, index))
        return index + 1, *(total + part for total, part in zip(sums, parts, strict=True))

    state: tuple[Any, ...] = (mi.UInt32(0), *(mi.Color3f(0.0) for _ in labels))
    return dr.while_loop(
        state=state,
        cond=lambda index, *_: index < count,
        body=body,
        labels=("index", *labels),
        max_iterations=count,
    )[1:]


def _point_gradient(point, packed, count, gradient):
    """Adjoint of `_sum_over_lobes` in `point`: a loop over the lobes in each lane."""

    def body(index, *sums):
        inputs = tuple(type(value)(value) for value in point)
        dr.enable_grad(inputs)
        parts = _integrate_lobe(_point(inputs), *unpack_lobe(packed, index))
        dr.backward(_weigh(parts, gradient), dr.ADFlag.Default | dr.ADFlag.AllowNoGrad)
        return index + 1, *(total + dr.grad(value) for total, value in zip(sums, inputs, strict=True))

    return dr.while_loop(
        state=(mi.UInt32(0), *(type(value)(0.0) for value in point)),
        cond=lambda index, *_: index < count,
        body=body,
        labels=("index", *(f"d_{name}" for name in point._fields)),
    )[1:]


def _lobe_gradient(point, packed, count, gradient):
    """Adjoint of `_sum_over_lobes` in the flat lobe array, the same bits on every run.

    Lane (chunk, lobe) loops over the chunk's points, and the chunks are then added by a block reduction: each sum has
    one fixed order, unlike a scatter-add from several threads."""
    points = dr.width(*point, *gradient)
    chunks = -(-points // _POINTS_PER_LANE)
    lane = dr.arange(mi.UInt32, count * chunks)
    chunk, lobe = lane // count, lane % count
    point = tuple(value + dr.zeros(type(value), points) for value in point)
    gradient = tuple(value + dr.zeros(type(value), points) for value in gradient)
    dr.eval(point, gradient)

    def body(step, *sums):
        index = chunk * _POINTS_PER_LANE + step
        active = index < points
        here = _point([dr.gather(type(value), value, index, active) for value in point])
        weights = [dr.gather(mi.Color3f, value, index, active) for value in gradient]
        axis, sharpness, amplitude = inputs = unpack_raw(packed, lobe)
        dr.enable_grad(inputs)
        parts = _integrate_lobe(here, dr.normalize(axis), sharpness, amplitude)
        loss = dr.select(active, _weigh(parts, weights), 0.0)
        dr.backward(loss, dr.ADFlag.Default | dr.ADFlag.AllowNoGrad)
        return step + 1, *(total + dr.grad(value) for total, value in zip(sums, inputs, strict=True))

    _, axis, sharpness, amplitude = dr.while_loop(
        state=(dr.zeros(mi.UInt32, count * chunks), mi.Vector3f(0.0), mi.Float(0.0), mi.Color3f(0.0)),
        cond=lambda step, *_: step < _POINTS_PER_LANE,
        body=body,
        labels=("step", "d_axis", "d_sharpness", "d_amplitude"),
    )
    # In one launch; the block sum of what is not evaluated yet would run the loop for itself.
    dr.eval(axis, sharpness, amplitude)
    by_lobe = lane % chunks * count + lane // chunks
    return interleave([dr.block_sum(dr.gather(mi.Float, x, by_lobe), chunks) for x in (*axis, sharpness, *amplitude)])


class _SumOverLobes(dr.CustomOp):
    """`_sum_over_lobes` with adjoints whose sums have a fixed order; `attached`: whether the gradients of the lobes and
    of the point are needed."""

    def eval(self, packed, count, attached, *point):
        self.inputs, self.attached = (_point(point), packed, count), attached
        return _sum_over_lobes(*self.inputs)

    def forward(self):
        point, packed, count = self.inputs
        inputs = [type(value)(value) for value in (packed, *point)]
        of_point: Any = self.grad_in("point")
        tangents = [self.grad_in("packed"), *of_point]
        with dr.resume_grad():
            dr.enable_grad(inputs)
            for value, tangent in zip(inputs, tangents, strict=True):
                dr.set_grad(value, tangent)
            result = _sum_over_lobes(_point(inputs[1:]), inputs[0], count)
            self.set_grad_out(dr.forward_to(result))

    def backward(self):
        gradient = self.grad_out()
        with dr.resume_grad():
            lobes, point = self.attached
            if point:
                self.set_grad_in("point", _point_gradient(*self.inputs, gradient))
            if lobes:
                self.set_grad_in("packed", _lobe_gradient(*self.inputs, gradient))

    def name(self):
        return "sum_over_lobes"


def _sums(point, lobes):
    """`_sum_over_lobes` of a shading point under `lobes` `[N_l, 7]`, differentiable; its adjoint repeats bit for bit
    outside symbolic code."""
    count = lobe_count(lobes)
    if dr.flag(dr.JitFlag.SymbolicScope):
        return _sum_over_lobes(point, lobes.array, count)
    attached = dr.grad_enabled(lobes.array), dr.grad_enabled(*point)
    return dr.custom(_SumOverLobes, lobes.array, count, attached, *point)


def irradiance(normal: Vector3f, lobes: TensorXf) -> Color3f:
    """The irradiance of `shade` alone, for surfaces without a specular term."""
    return _sums(DiffusePoint(normal), lobes)[0]


def shade(
    normal: Vector3f,
    view: Vector3f,
    specular_albedo: Float,
    roughness: Float,
    lobes: TensorXf,
) -> tuple[Color3f, Color3f]:
    """Irradiance and specular radiance under all lobes `[N_l, 7]`; diffuse radiance is albedo/π × irradiance.

    Unit vectors, `view` pointing away from the surface. Differentiable in every argument. Outside symbolic code the
    gradients have the same bits on every run; inside a symbolic loop or call they go through Dr.Jit's own
    differentiation of the loop over lobes, whose scatter-adds have no fixed order."""
    diffuse, white, grazing = _sums(specular_lobes(normal, view, roughness), lobes)
    return diffuse, dr.lerp(grazing, white, mi.Float(specular_albedo))


def shade_tensor(
    normal: TensorXf,
    view: TensorXf,
    specular_albedo: TensorXf,
    roughness: Float,
    lobes: TensorXf,
) -> tuple[TensorXf, TensorXf]:
    """`shade` on tensors: normals and views `[3, P]`, specular albedo `[P]` → irradiance and specular `[3, P]`."""
    albedo = specular_albedo.array if isinstance(specular_albedo, mi.TensorXf) else specular_albedo
    result = shade(mi.Vector3f(normal), mi.Vector3f(view), albedo, roughness, lobes)
    return mi.TensorXf(result[0]), mi.TensorXf(result[1])
