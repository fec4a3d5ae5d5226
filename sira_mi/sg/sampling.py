"""Sampling directions from a mixture of spherical Gaussians in proportion to the lobes' energy.

A normalised lobe is a von Mises-Fisher density, whose cosine can be sampled exactly by inversion:
1 − cos θ = −log(1 − u + u e^{−2λ})/λ. All steps are stable in single precision for sharpness from 0 to 1e7.
"""

from typing import Any

import drjit as dr
import mitsuba as mi

from sira_mi.conventions import LUMINANCE
from sira_mi.sg.arrays import Bool, Color3f, Float, Point2f, TensorXf, UInt32, Vector3f
from sira_mi.sg.integrals import sphere_integral
from sira_mi.sg.lobes import evaluate_lobe, lobe_count, unpack_lobe, unpack_raw

# Below this sharpness 1 − cos θ is evaluated by its expansion in λ.
_SERIES = 0.02


def lobe_energy(lobes: TensorXf) -> Float:
    """Luminance of each lobe's integral over the sphere, `[N_l]`: the weights of the mixture."""
    count = lobe_count(lobes)
    _, sharpness, amplitude = unpack_lobe(lobes.array, dr.arange(mi.UInt32, count))
    return sphere_integral(sharpness) * dr.dot(amplitude, mi.Color3f(LUMINANCE))


def sample_lobe(axis: Vector3f, sharpness: Float, sample: Point2f) -> Vector3f:
    """A direction with the density exp(λ(ω·ξ − 1)) / ∫, from two uniform numbers."""
    u = sample.x
    safe = dr.maximum(sharpness, _SERIES)
    sharp = -dr.log(dr.maximum(dr.fma(u, dr.exp(-2.0 * safe), 1.0 - u), 1e-38)) / safe
    flat = 2.0 * u * (1.0 - sharpness * (1.0 - u) * (1.0 - sharpness * (2.0 - 4.0 * u) / 3.0))
    gap = dr.clip(dr.select(sharpness < _SERIES, flat, sharp), 0.0, 2.0)
    sine = dr.safe_sqrt(gap * (2.0 - gap))
    sin_phi, cos_phi = dr.sincos(dr.two_pi * sample.y)
    local = mi.Vector3f(sine * cos_phi, sine * sin_phi, 1.0 - gap)
    return dr.normalize(mi.Frame3f(axis).to_world(local))


def _sum_lobes(direction, packed, density, count):
    """Radiance and mixture density in a direction: a symbolic loop over the lobes in each lane."""

    def body(index, radiance, pdf):
        axis, sharpness, amplitude = unpack_lobe(packed, index)
        value = evaluate_lobe(direction, axis, sharpness, mi.Color3f(1.0)).x
        weight = dr.gather(mi.Float, density, index)
        return index + 1, radiance + amplitude * value, pdf + weight * dr.detach(value)

    return dr.while_loop(
        state=(mi.UInt32(0), mi.Color3f(0.0), mi.Float(0.0)),
        cond=lambda index, radiance, pdf: index < count,
        body=body,
        labels=("index", "radiance", "pdf"),
        mode="symbolic",
    )[1:]


class _EvaluateMixture(dr.CustomOp):
    """`_sum_lobes` of a `LobeMixture`, differentiated in reverse by a second loop over the lobes.

    Dr.Jit cannot reverse a loop inside the virtual calls through which integrators reach an emitter. The second loop
    backpropagates through each lobe's gather into the gradient of the lobes. The argument `anchor`, gathered from the
    lobes, only makes the result depend on them."""

    def eval(self, direction, anchor, mixture):
        self.direction, self.mixture = direction, mixture
        return _sum_lobes(direction, dr.detach(mixture.lobes.array), mixture.density, mixture.count)

    def forward(self):
        with dr.resume_grad():
            direction = mi.Vector3f(self.direction)
            dr.enable_grad(direction)
            dr.set_grad(direction, self.grad_in("direction"))
            result = _sum_lobes(direction, self.mixture.lobes.array, self.mixture.density, self.mixture.count)
            self.set_grad_out(dr.forward_to(result))

    def backward(self):
        gradients: Any = self.grad_out()
        gradient = gradients[0]

        def body(index, total):
            with dr.resume_grad():
                direction = mi.Vector3f(self.direction)
                dr.enable_grad(direction)
                axis, sharpness, amplitude = unpack_lobe(self.mixture.lobes.array, index)
                radiance = evaluate_lobe(direction, axis, sharpness, amplitude)
                dr.backward_from(dr.dot(radiance, gradient), dr.ADFlag.Default | dr.ADFlag.AllowNoGrad)
                return index + 1, total + dr.grad(direction)

        _, total = dr.while_loop(
            state=(mi.UInt32(0), mi.Vector3f(0.0)),
            cond=lambda index, total: index < self.mixture.count,
            body=body,
            labels=("index", "d_direction"),
            mode="symbolic",
        )
        self.set_grad_in("direction", total)

    def name(self):
        return "evaluate_mixture"


class LobeMixture:
    """A set of lobes `[N_l, 7]` prepared for evaluation and sampling.

    The lobes keep their derivatives in what `evaluate` returns; sampling and density are detached from them."""

    def __init__(self, lobes: TensorXf):
        self.count = lobe_count(lobes)
        self.lobes = lobes
        with dr.suspend_grad():
            energy = lobe_energy(dr.detach(lobes))
            # Black light has to be sampled somehow, and a distribution needs a positive sum.
            energy = dr.select(dr.max(energy) > 0.0, energy, 1.0)
            self.distribution = mi.DiscreteDistribution(energy)
            index: UInt32 = dr.arange(mi.UInt32, self.count)
            sharpness = unpack_raw(dr.detach(lobes).array, index)[1]
            self.density = self.distribution.eval_pmf_normalized(index) / sphere_integral(sharpness)
            dr.eval(self.density)

    def evaluate(self, direction: Vector3f) -> tuple[Color3f, Float]:
        """Radiance `[..., 3]` and the density of `sample`, per steradian, in a unit direction."""
        anchor = dr.gather(mi.Float, self.lobes.array, mi.UInt32(0))
        return dr.custom(_EvaluateMixture, direction, anchor, self)

    def sample(self, sample: Point2f, active: Bool = True) -> Vector3f:
        """A direction: a lobe by its share of the energy, then a direction in it."""
        index, reused = self.distribution.sample_reuse(sample.x, active)
        with dr.suspend_grad():
            axis, sharpness, _ = unpack_lobe(dr.detach(self.lobes).array, index)
            return sample_lobe(axis, sharpness, mi.Point2f(reused, sample.y))
