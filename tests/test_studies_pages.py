"""The pages of the studies are their figures put into a template: nothing on them is typed by hand or says more than
the figures do."""

from pathlib import Path

import pytest

from sira_mi.errors import InputError
from studies.data import read_figures, write_figures
from studies.markdown import number, table
from studies.portraits import page
from studies.portraits.compare_methods import MEAN_HEAD
from studies.portraits.summary import APPEARANCE_SCORES, GEOMETRY_SCORES, summarise
from studies.priors import page as prior_page
from studies.priors.summary import summarise as summarise_prior

DOCS = Path(__file__).parents[1] / "docs"


def test_the_results_page_is_written_from_its_figures():
    assert (DOCS / "results.md").read_text(encoding="utf-8") == page.render_page(read_figures(DOCS / page.FIGURES))


def test_the_pages_of_the_priors_are_written_from_their_figures():
    for name, text in prior_page.render_pages(read_figures(DOCS / prior_page.FIGURES)).items():
        assert (DOCS / name).read_text(encoding="utf-8") == text


def test_a_page_without_measurements_says_which_command_makes_them(tmp_path):
    write_figures(tmp_path / prior_page.FIGURES, summarise_prior(tmp_path))
    pages = prior_page.render_pages(read_figures(tmp_path / prior_page.FIGURES))
    assert pages["priors.md"].count("Not measured yet: `python -m studies.priors measure`") == 6
    assert pages["prior_trainings.md"].count("Not measured yet: `python -m studies.priors sizes`") == 1


def test_tables_keep_their_columns():
    assert table(["|∇f|", "b"], [["1", "2"]]) == "| \\|∇f\\| | b |\n| --- | --- |\n| 1 | 2 |"
    assert number(None) == number(float("nan")) == "–" and number(2.0, 1) == "2.0"


def rows() -> list[dict]:
    """Made-up rows of two portraits; scores grow with the portrait and fall from method to method."""
    result = []
    for k, light in enumerate(("studio", "extreme")):
        for j, method in enumerate((MEAN_HEAD, "a.3", "a.4", "b.3")):
            scores = {name: 2.0 - 0.4 * j + 0.1 * k for name in GEOMETRY_SCORES + APPEARANCE_SCORES}
            row = {"portrait": f"p{k}", "identity": f"i{k}", "light": light, "method": method, "scores": scores}
            if method != MEAN_HEAD:
                row |= {"seconds": {"latents": 10.0 + k}, "total_seconds": 20.0 + k, "peak_memory_megabytes": 900 + k}
            result.append(row)
    return result


FAILED = {"portrait": "p2", "identity": "i2", "light": "studio", "method": "a.3", "error": "no face found"}


@pytest.fixture
def figures(tmp_path) -> dict:
    """As the command writes and reads them."""
    write_figures(tmp_path / page.FIGURES, summarise(rows(), [*rows(), FAILED], "standard", "draft"))
    return read_figures(tmp_path / page.FIGURES)


def test_figures_are_means_over_portraits(figures):
    """Geometry is that of the methods that move the surface, appearance that of those that estimate one. A method that
    failed on a portrait has no means: they would be of other portraits than the other methods'."""
    assert figures["portraits"] == 2 and list(figures["lights"]) == ["extreme", "studio"]
    shipped, ablations = figures["shipped"]["methods"], figures["ablations"]["methods"]
    assert shipped["b.3"]["geometry"]["h3ds_face_mean"] == pytest.approx(0.85)
    assert shipped["b.3"]["appearance"]["final_psnr"] == pytest.approx(0.85)
    assert "appearance" not in shipped["a.4"] and "geometry" not in ablations["b.3"]
    assert ablations["a.3"]["geometry"]["h3ds_face_mean"] is None
    assert shipped["a.4"]["seconds"] == 20.5 and shipped["a.4"]["stages"] == {"latents": 10.5}
    assert figures["shipped"]["fit_seconds"] == 41 and figures["shipped"]["fit_megabytes"] == 901
    assert [row["mean_head_face"] for row in figures["each"]] == [2.0, 2.1]


def test_the_page_tells_which_marks_are_met(figures):
    text = page.render_page(figures)
    assert "| face, mm | ≤1 | 0.85 | met |" in text
    assert "| over the mean head's | ≤0.7 | 0.41 | met |" in text
    assert "| final render, dB | ≥34 | 0.8 | **missed** |" in text
    assert "| geometry minus best ablation, mm | ≤0 | – | – |" in text
    assert "| fit, s | ≤300 | 41 | met |" in text
    assert "| p2 | a.3 | no face found |" in text
    assert "| smallest | 0.80 |" in text and "| largest | 0.90 |" in text


def test_figures_say_when_they_were_measured(figures, tmp_path):
    assert set(figures["measured"]) == {"revision", "date"}
    for damaged in ("", "[]", "{}"):
        (tmp_path / page.FIGURES).write_text(damaged)
        with pytest.raises(InputError, match="no figures of a study"):
            read_figures(tmp_path / page.FIGURES)
