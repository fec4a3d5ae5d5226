"""Every row of `docs/stability.md`, with fewer cases: errors in single precision within bounds, everything finite.
And that a row can fail, and what the page says of it."""

import mitsuba as mi
import numpy as np
import pytest
from conftest import small_avatar
from scipy.special import erfcx

import sira_mi.sg.integrals as integrals
from sira_mi.errors import InputError
from sira_mi.fields.mlp import layers
from sira_mi.fields.sdf import SdfField, surface
from studies.stability.fields64 import Field64
from studies.stability.page import Measured, load_rows, page, write_page
from studies.stability.rows import Row, Section, largest, relative_error
from studies.stability.sections import SECTIONS

MEASURES = [measure for section in SECTIONS.values() for measure in section.measures]


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
        assert "**missed**" in page({"a": Section("t", "i", ())}, {"a": Measured(True, (row,))})


def test_a_section_that_is_not_measured_stays_on_the_page(tmp_path):
    """Rows are read back as they were, infinite errors too; a damaged file is refused in one line."""
    sections = {name: Section(f"Part {name}", "i", ()) for name in "ab"}
    row = Row("r", "m", 1, float("inf"), 1.0, 0, True)
    write_page(tmp_path, sections, {"a": Measured(False, (row,))})
    measured = load_rows(tmp_path)
    assert measured == {"a": Measured(False, (row,))}
    path = write_page(tmp_path, sections, {**measured, "b": Measured(True, ())})
    text = path.read_text(encoding="utf-8")
    assert "## Part a" in text and "## Part b" in text and "Missed: r." in text
    (tmp_path / "stability.json").write_text("[1]")
    with pytest.raises(InputError, match="damaged"):
        load_rows(tmp_path)


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
