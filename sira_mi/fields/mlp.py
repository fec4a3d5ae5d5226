"""Multilayer perceptrons, written once and evaluated two ways.

A network is a flat parameter vector with an `Architecture`. `layers` unpacks it, together with a latent, into plain
weight matrices and biases: the latent only shifts the bias of every hidden layer, so that a decoder conditioned on a
latent costs no more per point than one without. The layers are then evaluated on

- tensors `[features, N]` (`evaluate`, `evaluate_with_tangents`): one matrix product a layer, for batches of points;
- cooperative vectors (`pack`, `evaluate_cooperative`): inside symbolic code such as textures, where tensor `@` is
  not available.

The hidden activation is a softplus with β = 100 (IDR, Yariv et al. 2020).
"""

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from drjit import nn

from sira_mi.fields.columns import to_array

SOFTPLUS_SHARPNESS = 100.0
_LOG2_E = 1.4426950408889634
_MAXIMUM_PARAMETERS = 4_000_000


@dataclass(frozen=True)
class Architecture:
    """Sizes of a network: `inputs` features (already encoded) -> `depth` hidden layers `width` wide -> `outputs`."""

    inputs: int
    outputs: int
    width: int
    depth: int
    latent: int = 0  # dimension of the latent that shifts every hidden layer; 0 for none

    def __post_init__(self):
        sizes = (self.inputs, self.outputs, self.width, self.depth)
        if min(sizes) < 1 or self.latent < 0 or self.parameters > _MAXIMUM_PARAMETERS:
            raise ValueError(f"unusable network sizes: {self}")

    def shapes(self) -> list[tuple[tuple[int, int], tuple[int, int], tuple[int, int]]]:
        """Per layer the shapes of its weight [out, in], bias [out, 1] and latent matrix [out, latent]; the output
        layer has an empty latent matrix."""
        sizes = [self.inputs] + [self.width] * self.depth + [self.outputs]
        return [((o, i), (o, 1), (o, self.latent if k < self.depth else 0)) for k, (i, o) in enumerate(pairwise(sizes))]

    @property
    def parameters(self) -> int:
        """Length of the flat parameter vector."""
        return sum(a * b for layer in self.shapes() for a, b in layer)


def initial_parameters(architecture: Architecture, rng: np.random.Generator, output_scale: float = 1.0) -> np.ndarray:
    """Flat parameters [architecture.parameters] float32: He-normal weights, zero biases, latent matrices N(0,
    1/latent); the output weights are scaled by `output_scale`."""
    pieces = []
    for k, (weight, bias, latent) in enumerate(architecture.shapes()):
        scale = output_scale if k == architecture.depth else 1.0
        pieces.append(rng.standard_normal(weight).ravel() * np.sqrt(2 / weight[1]) * scale)
        pieces.append(np.zeros(bias).ravel())
        pieces.append(rng.standard_normal(latent).ravel() / np.sqrt(max(latent[1], 1)))
    return np.concatenate(pieces).astype(np.float32)


def _add_bias(h, bias):
    """h [W, S·n] + bias [W, S], each of the S columns of the bias for n consecutive points."""
    rows, columns = bias.shape
    if columns == 1:
        return h + bias
    return dr.reshape(dr.reshape(h, (rows, columns, -1)) + dr.reshape(bias, (rows, columns, 1)), h.shape)


def _sum_columns(gradient, columns: int):
    """The adjoint of `_add_bias` in its bias: an axis sum [W, S]. The one of Dr.Jit's broadcast is an atomic scatter,
    whose result varies from run to run."""
    rows = gradient.shape[0]
    total: mi.TensorXf = dr.sum(dr.reshape(gradient, (rows, columns, -1)), axis=2)
    return type(gradient)(total.array, (rows, columns))


class _AddBias(dr.CustomOp):
    """`_add_bias` with `_sum_columns` as its adjoint."""

    def eval(self, h, bias):
        self.columns = bias.shape[1]
        return _add_bias(h, bias)

    def forward(self):
        self.set_grad_out(_add_bias(self.grad_in("h"), self.grad_in("bias")))

    def backward(self):
        gradient = self.grad_out()
        self.set_grad_in("h", gradient)
        self.set_grad_in("bias", _sum_columns(gradient, self.columns))


def layers(architecture: Architecture, parameters, latent=None) -> list[tuple]:
    """Unpacks flat `parameters` [architecture.parameters] into [(weight [out, in], bias [out, S]), ...].

    `latent` is [architecture.latent], or [architecture.latent, S] with one column for every scene of a batch, or None
    for zeros. Both may be NumPy or Dr.Jit arrays; differentiable in the latter."""
    result, offset = [], 0
    parameters, latent = to_array(parameters), to_array(latent)
    if latent is not None and latent.ndim == 1:
        latent = mi.TensorXf(latent, (len(latent), 1))

    def take(shape):
        nonlocal offset
        size = shape[0] * shape[1]
        index = dr.arange(mi.UInt32, size) + offset
        offset += size
        return mi.TensorXf(dr.gather(mi.Float, parameters, index), shape)

    for weight_shape, bias_shape, latent_shape in architecture.shapes():
        weight, bias = take(weight_shape), take(bias_shape)
        if latent_shape[1] > 0:
            shift = take(latent_shape)
            if latent is not None:
                bias = dr.custom(_AddBias, shift @ latent, bias)
        result.append((weight, bias))
    return result


def _softplus(a):
    """Softplus with β = 100, on tensors and cooperative vectors alike, without overflow."""
    e = dr.exp2(dr.maximum(a, a * -1.0) * (-SOFTPLUS_SHARPNESS * _LOG2_E))
    return dr.maximum(a, 0.0) + dr.log2(e + 1.0) * (1.0 / (SOFTPLUS_SHARPNESS * _LOG2_E))


def _softplus_slope(a):
    """Derivative of `_softplus`: the logistic function of β a, without overflow."""
    e = dr.exp2(-dr.abs(a) * (SOFTPLUS_SHARPNESS * _LOG2_E))
    r = dr.rcp(e + 1.0)
    return dr.select(a >= 0.0, r, e * r)


class _HiddenLayer(dr.CustomOp):
    """softplus(W h + b) with the directional derivatives σ(β a) ⊙ W t carried along, one launch a pass.

    The reverse pass is written out, a = W h + b, s = σ(β a), s' = β s (1 − s): with the adjoints h̄ and t̄_k of the
    outputs, ā = s ⊙ h̄ + s' ⊙ Σ_k t̄_k ⊙ W t_k and ū_k = s ⊙ t̄_k are the adjoints of a and of W t_k. Left to automatic
    differentiation the same takes several times as many kernels."""

    def eval(self, weight, bias, h, tangents):
        self.weight, self.h, self.tangents = weight, h, tangents
        self.columns = bias.shape[1]
        self.a = _add_bias(weight @ h, bias)
        self.moved = [weight @ t for t in tangents]
        slope = _softplus_slope(self.a)
        result = _softplus(self.a), [m * slope for m in self.moved]
        dr.eval(self.a, result)
        return result

    def forward(self):
        gradients: list[Any] = [self.grad_in(name) for name in ("weight", "h", "tangents")]
        weight, h, tangents = gradients
        slope = _softplus_slope(self.a)
        bend = SOFTPLUS_SHARPNESS * slope * (1.0 - slope)
        a = _add_bias(weight @ self.h + self.weight @ h, self.grad_in("bias"))
        moved = [weight @ t + self.weight @ d for t, d in zip(self.tangents, tangents, strict=True)]
        self.set_grad_out(
            (slope * a, [slope * d + bend * a * m for d, m in zip(moved, self.moved, strict=True)]),
        )

    def backward(self):
        gradient: Any = self.grad_out()
        h, tangents = gradient
        slope = _softplus_slope(self.a)
        bend = SOFTPLUS_SHARPNESS * slope * (1.0 - slope)
        a = slope * h
        for t, m in zip(tangents, self.moved, strict=True):
            a += bend * t * m
        moved = [slope * t for t in tangents]
        dr.eval(a, moved)
        weight: Any = dr.matmul(a, self.h, Bt=True)
        for u, t in zip(moved, self.tangents, strict=True):
            weight += dr.matmul(u, t, Bt=True)
        self.set_grad_in("weight", weight)
        self.set_grad_in("bias", _sum_columns(a, self.columns))
        self.set_grad_in("h", dr.matmul(self.weight, a, At=True))
        self.set_grad_in("tangents", [dr.matmul(self.weight, u, At=True) for u in moved])


def evaluate(network: list[tuple], h):
    """Tensor mode: features [inputs, N] -> outputs [outputs, N]. With S latents, N is a multiple of S and the points
    of one latent are consecutive."""
    return evaluate_with_tangents(network, h, [])[0]


def evaluate_with_tangents(network: list[tuple], h, tangents: list):
    """`evaluate`, carrying directional derivatives [inputs, N] of the features along: returns the outputs and their
    derivatives [outputs, N]. Dr.Jit has no second-order AD, so a gradient that a loss depends on is primal code."""
    for weight, bias in network[:-1]:
        h, tangents = dr.custom(_HiddenLayer, weight, bias, h, tangents)
    weight, bias = network[-1]
    return dr.custom(_AddBias, weight @ h, bias), [weight @ t for t in tangents]


def evaluate_reference(network: list[tuple], h, tangents: list):
    """`evaluate_with_tangents` in plain operations, differentiated by Dr.Jit: the slow version that tests compare."""
    for k, (weight, bias) in enumerate(network):
        h = dr.custom(_AddBias, weight @ h, bias)
        tangents = [weight @ t for t in tangents]
        if k + 1 < len(network):
            slope = _softplus_slope(h)
            h = _softplus(h)
            tangents = [t * slope for t in tangents]
    return h, tangents


def pack(network: list[tuple]) -> list[tuple]:
    """Packs layers with one latent for `evaluate_cooperative`; differentiable."""
    matrices = [m for weight, bias in network for m in (weight, mi.TensorXf(bias.array, (bias.shape[0],)))]
    packed = nn.pack(*matrices, layout="training")
    return list(zip(packed[0::2], packed[1::2], strict=True))


def evaluate_cooperative(packed: list[tuple], features: list) -> list:
    """Cooperative-vector mode, usable in symbolic code: a list of `inputs` Floats -> a list of `outputs` Floats."""
    h = nn.CoopVec(*features)
    for k, (weight, bias) in enumerate(packed):
        h = nn.matvec(weight, h, bias)
        if k + 1 < len(packed):
            h = _softplus(h)
    return list(h)
