"""The package's own formulas in float64.

Mitsuba comes without variants in double precision for every backend, but the functions of `sira_mi.sg` are elementwise
and take Dr.Jit's own double-precision arrays as well as Mitsuba's. Where such a module names a type (`mi.Float(...)`),
it is given the double-precision one while it evaluates."""

from __future__ import annotations

import contextlib
import sys
import types
from collections.abc import Iterator
from unittest import mock

import drjit as dr
import mitsuba as mi
import numpy as np


def types_in_double() -> types.SimpleNamespace:
    """Double-precision counterparts of the current variant's array types, by Mitsuba's names."""
    arrays = dr.cuda.ad if str(mi.variant()).startswith("cuda") else dr.llvm.ad
    return types.SimpleNamespace(
        Float=arrays.Float64,
        Vector3f=arrays.Array3f64,
        Color3f=arrays.Array3f64,
        TensorXf=arrays.TensorXf64,
        UInt32=arrays.UInt32,
        Bool=arrays.Bool,
    )


@contextlib.contextmanager
def in_double() -> Iterator[types.SimpleNamespace]:
    """Within the context the types that the modules of `sira_mi.sg` name are double-precision ones; yields them."""
    double = types_in_double()
    with contextlib.ExitStack() as stack:
        for name, module in list(sys.modules.items()):
            if name.startswith("sira_mi.sg.") and hasattr(module, "mi"):
                stack.enter_context(mock.patch.object(module, "mi", double))
        yield double


def single(values: np.ndarray) -> np.ndarray:
    """Values as float32 holds them, in float64: the exact input of both precisions."""
    return np.asarray(values, np.float32).astype(np.float64)
