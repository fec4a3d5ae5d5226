"""Every row of `docs/stability.md` but those of fits, with fewer cases: errors in single precision within bounds,
everything finite. A row can fail, the page says so, and it is made of its data alone."""

from dataclasses import replace
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from conftest import small_avatar
from doubles import head_field
from scipy.special import erfcx

import sira_mi.sg.integrals as integrals
from sira_mi.errors import InputError
from sira_mi.fields.sdf import surface
from studies.stability.fields64 import Field64
from studies.stability.fit_runs import list_code
from studies.stability.page import Measured, fill_template, load_rows, write_page
from studies.stability.rows import Row, largest, relative_error
from studies.stability.sections import NUMERICS, list_sections

DOCS = Path(__file__).parents[1] / "docs"
MEASURES = [measure for measures in NUMERICS.values() for measure in measures]


@pytest.mark.slow
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
    good = Row("a", "b", cases=1, error=0.5, bound=1.0, non_finite=0)
    assert good.passed and replace(good, gradients_finite=True).passed
    for row in (
        replace(good, error=2.0),
        replace(good, error=np.nan),
        replace(good, non_finite=1),
        replace(good, gradients_finite=False),
    ):
        assert not row.passed
        page = fill_template({"sampling": Measured(True, (row,))})
        assert "missed**" in page and "| rows that miss theirs | a (b) |" in page


def test_a_section_that_is_not_measured_stays_on_the_page(tmp_path):
    """Rows are read back as they were, infinite errors too; a damaged file is refused in one line."""
    row = Row("r", "m", 1, float("inf"), 1.0, 0, True)
    write_page(tmp_path, {"sampling": Measured(False, (row,))})
    measured = load_rows(tmp_path)
    assert measured == {"sampling": Measured(False, (row,))}
    path = write_page(tmp_path, {**measured, "tracing": Measured(True, (Row("s", "mm", 1, 0.5, 1.0, 0),))})
    text = path.read_text(encoding="utf-8")
    assert "| **inf (1), missed** | m |" in text and "| s | 0.5 (1) | mm |" in text and "Not measured yet." in text
    (tmp_path / "data" / "stability.json").write_text("[1]")
    with pytest.raises(InputError, match="damaged"):
        load_rows(tmp_path)


def test_the_page_is_its_data_filled_in(tmp_path):
    """The committed page is what its figures give, has all sections, and can be read in a few minutes."""
    text = write_page(tmp_path, load_rows(DOCS)).read_text(encoding="utf-8")
    assert text == (DOCS / "stability.md").read_text(encoding="utf-8")
    assert (tmp_path / "data" / "stability.json").read_bytes() == (DOCS / "data" / "stability.json").read_bytes()
    assert len(text.split()) < 1200 and "Not measured yet." not in text
    rows = {name: len(part.rows) for name, part in load_rows(DOCS).items()}
    assert rows == {name: len(measures) for name, measures in list_sections(tmp_path).items()}


def test_a_fit_of_corrupt_input_is_repeated_when_the_code_of_fits_changes():
    """What is read to tell so includes the fit, the plugins and how results are scored."""
    names = {f"{path.parent.name}/{path.name}" for path in list_code()}
    assert {"fit/driver.py", "plugins/neural_sdf.py", "avatar/file.py", "stability/fit_cases.py"} <= names


def test_the_reference_field_is_the_package_s():
    """Value and gradient of the NumPy networks in float64 against the package's in single precision."""
    avatar = small_avatar()
    field = head_field(avatar)
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
