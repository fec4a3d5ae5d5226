"""A row of the table of numerical stability, and the errors that rows are made of."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import drjit as dr
import numpy as np

# A relative error counts where the exact value is above this share of its peak.
FLOOR = 1e-6


@dataclass(frozen=True)
class Row:
    """One row: what was measured, over how many cases, and what it must stay within."""

    name: str
    unit: str  # of the error
    cases: int
    error: float  # the worst over all cases
    bound: float  # of the error
    non_finite: int  # NaN and infinite values among the results
    gradients_finite: bool | None = None  # None where there is nothing to differentiate
    note: str = ""  # a further figure, or what a fit said

    @property
    def passed(self) -> bool:
        """Whether the error is within its bound and everything is finite."""
        return self.error <= self.bound and self.non_finite == 0 and self.gradients_finite is not False


# A function that measures one row; `quick` takes fewer cases.
Measure = Callable[[bool], Row]


def count_non_finite(*values: np.ndarray) -> int:
    """How many values are NaN or infinite."""
    return sum(int(np.size(value) - np.isfinite(value).sum()) for value in values)


def largest(values: np.ndarray) -> float:
    """The largest value, infinite if any is NaN; 0 of none."""
    values = np.asarray(values, np.float64)
    if not values.size:
        return 0.0
    return float(np.where(np.isnan(values), np.inf, values).max())


def relative_error(value: np.ndarray, exact: np.ndarray, peak: np.ndarray | float) -> float:
    """The largest relative error where `exact` (not negative) is above `FLOOR` of `peak`."""
    counted = exact > FLOOR * np.broadcast_to(peak, exact.shape)
    return largest(np.abs(value.astype(np.float64)[counted] / exact[counted] - 1.0))


def peak_error(value: np.ndarray, exact: np.ndarray, peak: np.ndarray | float) -> float:
    """The largest difference as a share of `peak`."""
    return largest(np.abs(value.astype(np.float64) - exact) / peak)


def are_gradients_finite(function: Callable, *inputs) -> bool:
    """Whether the derivatives of the sum of `function(*inputs)` in all `inputs` are finite."""
    copies = [type(value)(value) for value in inputs]
    dr.enable_grad(copies)
    result = function(*copies)
    dr.backward(sum(dr.sum(part, axis=None) for part in _parts(result)))
    return all(count_non_finite(dr.grad(value).numpy()) == 0 for value in copies)


def _parts(result) -> Iterable:
    """The scalar arrays in a result: of tuples, vectors and arrays."""
    if isinstance(result, tuple):
        return [part for value in result for part in _parts(value)]
    return list(result) if dr.depth_v(result) > 1 else [result]
