"""Closed-form shading of many points under many lights at once, for training.

`sg.shading.shade` serves one light and is differentiable in the points. Here each scene of a batch has its own light
and the points are constants: one launch for all scenes, and an adjoint without atomics."""

import drjit as dr
import mitsuba as mi

from sira_mi.sg.lobes import interleave, unpack_raw
from sira_mi.sg.shading import diffuse_irradiance
from sira_mi.sg.specular import SpecularLobes, specular_integrals, specular_lobes


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
        return interleave([dr.block_sum(share, self.points) for share in shares])

    def name(self):
        return "sum_of_lights"


def shade_scenes(normal, outgoing, specular, roughness: float, lobes, scenes: int):
    """Irradiance and specular radiance [S·n] of the points of `scenes` S scenes, each scene's points consecutive and
    under its own light `lobes` [N_l, 7, S]: `sg.shading.shade` for all scenes in one launch. Unit `normal` and
    `outgoing` directions (towards the camera) are constants; differentiable in `specular`, the reflectance at normal
    incidence of each point, and in `lobes`."""
    point = specular_lobes(normal, outgoing, mi.Float(roughness))
    packed = dr.moveaxis(lobes, 2, 0).array
    irradiance, white, grazing = dr.custom(_SumOfLights, packed, scenes, *point)
    return irradiance, dr.lerp(grazing, white, specular)
