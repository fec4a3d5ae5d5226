"""Every row of `docs/stability.md`, with fewer cases: errors in single precision within bounds, everything finite.
And that a row can fail, and what the page says of it."""

import mitsuba as mi
import numpy as np
import pytest
from conftest import small_avatar
from scipy.special import erfcx

import sira_mi.sg.integrals as integrals
from sira_mi.fields.mlp import layers
from sira_mi.fields.sdf import SdfField, surface
from sira_mi.stability.fields64 import Field64
from sira_mi.stability.page import page
from sira_mi.stability.rows import Row, Section, largest, relative_error
from sira_mi.stability.sections import SECTIONS

MEASURES = [measure for section in SECTIONS for measure in section.measures]


@pytest.mark.parametrize("measure", MEASURES, ids=[f"{m.__module__.split('.')[-1]}-{m.__name__}" for m in MEASURES])
def test_row(measure):
    row = measure(True)
    print(f"\n{row.name}: {row.error:.3g}, bound {row.bound:.3g}, {row.cases} cases")
    assert row.cases > 0
    assert row.non_finite == 0
    assert row.gradients_finite is not False
    assert row.error <= row.bound


def test_measures_notice_what_is_wrong():
    """A NaN is an infinite error, values below the floor do not count, and a row fails by any of its three parts."""
    assert largest(np.array([1.0, np.nan])) == np.inf
    assert relative_error(np.array([1.0, 5.0]), np.array([1.0, 1e-9]), 1.0) == 0.0
    assert relative_error(np.array([1.1]), np.array([1.0]), 1.0) == pytest.approx(0.1)
    good = {"name": "a", "meaning": "b", "cases": 1, "error": 0.5, "bound": 1.0, "non_finite": 0}
    assert Row(**good).passed and Row(**good, gradients_finite=True).passed
    for fault in ({"error": 2.0}, {"error": np.nan}, {"non_finite": 1}, {"gradients_finite": False}):
        row = Row(**{**good, **fault})
        assert not row.passed
        assert "**missed**" in page([(Section("t", "i", ()), [row])], quick=True)


def test_the_reference_field_is_the_package_s():
    """Value and gradient of the NumPy networks in float64 against the package's in single precision."""
    avatar = small_avatar()
    networks = avatar.architecture.networks
    latent = mi.TensorXf(avatar.tensors["z_sdf"][:, None])
    field = SdfField(
        layers(networks["deformation"], mi.Float(avatar.tensors["deformation"]), latent),
        layers(networks["reference"], mi.Float(avatar.tensors["reference"])),
        avatar.architecture.sdf_octaves,
    )
    x = np.random.default_rng(0).uniform(-2, 2, (3, 500)).astype(np.float32)
    value, gradient = (part.numpy() for part in surface(field, mi.TensorXf(x))[:2])
    exact = Field64.of(field)
    np.testing.assert_allclose(value[0], exact.value(x.astype(np.float64)), atol=2e-5)
    np.testing.assert_allclose(gradient, exact.gradient(x.astype(np.float64)), atol=2e-4)


def test_the_mean_above_zero_of_a_normal_variable_keeps_its_digits():
    """x Φ(x) + φ(x) far below zero, where its two terms cancel, against the scaled error function in float64."""
    x = np.linspace(-7.0, 7.0, 1401).astype(np.float32).astype(np.float64)
    t = np.abs(x)
    tail = np.exp(-0.5 * t**2) / np.sqrt(2 * np.pi) * (1 - t * np.sqrt(np.pi / 2) * erfcx(t / np.sqrt(2)))
    exact = np.maximum(x, 0.0) + tail
    np.testing.assert_allclose(integrals.clamped_mean(mi.Float(x)).numpy(), exact, rtol=5e-6)
