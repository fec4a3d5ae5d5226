"""A signed distance field in float64, written in NumPy and independent of the package's networks; its surface along
rays by dense bisection."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sira_mi.conventions import DOMAIN_LOWER, DOMAIN_UPPER
from sira_mi.fields.mlp import SOFTPLUS_SHARPNESS
from sira_mi.fields.sdf import SdfField

_CHUNK = 1 << 15
_BISECTIONS = 45


def _encoded(x, tangents, octaves):
    if not octaves:
        return x, tangents
    scales = [2.0**k for k in range(octaves)]
    phase = np.concatenate([s * x for s in scales])
    sine, cosine = np.sin(phase), np.cos(phase)
    slopes = [np.concatenate([s * t for s in scales]) for t in tangents]
    return np.concatenate([x, sine, cosine]), [
        np.concatenate([t, cosine * s, -sine * s]) for t, s in zip(tangents, slopes, strict=True)
    ]


def _network(layers, h, tangents):
    for k, (weight, bias) in enumerate(layers):
        a = weight @ h + bias
        tangents = [weight @ t for t in tangents]
        if k + 1 == len(layers):
            return a, tangents
        decay = np.exp(-SOFTPLUS_SHARPNESS * np.abs(a))
        h = np.maximum(a, 0.0) + np.log1p(decay) / SOFTPLUS_SHARPNESS
        tangents = [np.where(a > 0.0, 1.0, decay) / (1.0 + decay) * t for t in tangents]
    raise ValueError("a network has at least one layer")


@dataclass(frozen=True)
class Field64:
    """Eqs 1-3 in float64."""

    deformation: list[tuple[np.ndarray, np.ndarray]]
    reference: list[tuple[np.ndarray, np.ndarray]]
    octaves: int

    @staticmethod
    def of(field: SdfField) -> Field64:
        """The same numbers in float64; of a field that stays where it is."""
        if field.motion is not None:
            raise ValueError("the reference in float64 is of fields without a motion")

        def convert(network):
            return [(np.array(w.numpy(), np.float64), np.array(b.numpy(), np.float64)) for w, b in network]

        return Field64(convert(field.deformation), convert(field.reference), field.octaves)

    def _evaluate(self, x, tangents):
        h, t = _network(self.deformation, *_encoded(x, tangents, self.octaves))
        moved = [a + b[:3] for a, b in zip(tangents, t, strict=True)]
        return _network(self.reference, *_encoded(x + h[:3], moved, self.octaves))

    def value(self, x: np.ndarray) -> np.ndarray:
        """Signed distance [N] at points [3, N]."""
        pieces = [self._evaluate(x[:, k : k + _CHUNK], [])[0][0] for k in range(0, x.shape[1], _CHUNK)]
        return np.concatenate(pieces) if pieces else np.zeros(0)

    def gradient(self, x: np.ndarray) -> np.ndarray:
        """∇f [3, N] at points [3, N]."""
        axes = [np.repeat(np.eye(3)[:, k : k + 1], x.shape[1], axis=1) for k in range(3)]
        return np.concatenate(self._evaluate(x, axes)[1])

    def crossings(self, origin: np.ndarray, direction: np.ndarray, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """All crossings along rays [3, N] between the samples t [S, N], by bisection: (ray's index [K], t [K])."""
        samples = t.shape[0]
        points = origin[:, None] + t[None] * direction[:, None]
        negative = (self.value(points.reshape(3, -1)) < 0.0).reshape(samples, -1)
        step, ray = np.nonzero(negative[1:] != negative[:-1])
        low, high, inside = t[step, ray], t[step + 1, ray], negative[step, ray]
        o, d = origin[:, ray], direction[:, ray]
        for _ in range(_BISECTIONS):
            middle = 0.5 * (low + high)
            same = (self.value(o + middle * d) < 0.0) == inside
            low, high = np.where(same, middle, low), np.where(same, high, middle)
        return ray, 0.5 * (low + high)


def box_interval(origin: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where rays [3, N] enter and leave the domain box [N]; an empty interval for rays that miss it."""
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = ((np.array(end)[:, None] - origin) / direction for end in (DOMAIN_LOWER, DOMAIN_UPPER))
    near, far = np.fmin(a, b).max(axis=0), np.fmax(a, b).min(axis=0)
    return np.maximum(near, 0.0), np.maximum(far, 0.0)
