"""The pages of the studies are their figures put into a template: nothing on them is typed by hand or says more than
the figures do."""

import json
from pathlib import Path

import numpy as np
import pytest

from sira_mi.errors import InputError
from studies.data import read_figures, write_figures
from studies.markdown import number, table
from studies.portraits import page
from studies.portraits.commands.page import write_notes
from studies.portraits.summary import summarise
from studies.priors import page as prior_page
from studies.priors.summary import summarise as summarise_prior

DOCS = Path(__file__).parents[1] / "docs"


def test_the_results_page_is_written_from_its_figures():
    figures = {k: read_figures(DOCS / path) if (DOCS / path).exists() else None for k, path in page.FIGURES.items()}
    assert (DOCS / "results.md").read_text(encoding="utf-8") == page.render_page(figures["foreign"], figures["own"])


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


TITLES = {
    "photo": "the photo unchanged",
    "mean-head": "mean head",
    "mean-head-2": "second mean head",
    "draft": "fit, draft",
}


def rows() -> list[dict]:
    """Made-up results of five portraits. The photo has no head, the mean heads have no appearance; on the darkest
    portrait the draft failed, and on the last it was not made."""
    result = []
    for k in range(5):
        entry = {"name": f"p{k}", "identity": f"i{k // 2}", "tone": ("dark", "light")[k > 1], "hair": k % 2 == 0}
        entry |= {"yaw_degrees": (-40.0, 3, 14, 16, 31)[k], "expression": ("smile", "neutral")[k % 2]}
        entry |= {"skin_luminance": (0.2, 0.1, 0.3, 0.4, 0.5)[k]}
        for name in TITLES:
            row = {"portrait": f"p{k}", "row": name, "entry": entry, "cpu_seconds": 100.0 + k}
            row |= {"peak_memory_megabytes": 900 + k}
            face = {"mean-head": 2.0, "mean-head-2": 1.6 + 0.2 * k, "draft": 1.8}.get(name)
            scores = {} if face is None else {"h3ds_face_mean": face, "silhouette_iou": 0.9}
            if not name.startswith("mean-head"):
                level = (15.0 if name == "photo" else 20.0) + k
                for view, more in (("relit_1", 1), ("relit_2", -1), ("turned_left", 0), ("turned_right", -2)):
                    scores |= {f"{view}_psnr": level + more, f"{view}_ssim": 0.5, f"{view}_flip": 0.1 * (k + 1)}
                    scores |= {f"{view}_hair_psnr": level if entry["hair"] else np.nan, f"{view}_share_hair": 0.25}
            if name == "draft":
                scores |= {"tone_bias": (-1) ** k * 0.5, "camera_distance_error": -10.0, "diffuse_psnr": 22.0}
            if name == "draft" and k == 1:
                row |= {"error": "no face found"}
                scores = {name: value for name, value in scores.items() if "_1_" in name or "_2_" in name}
            if name == "draft" and k == 4:
                result.append({**row, "error": "not made yet"})
                continue
            result.append({**row, "scores": scores})
    return result


@pytest.fixture
def figures(tmp_path) -> dict:
    """As the command writes and reads them."""
    write_figures(tmp_path / page.FIGURES["foreign"], summarise(rows(), TITLES))
    return read_figures(tmp_path / page.FIGURES["foreign"])


def test_figures_are_means_over_portraits_and_views(figures):
    """NaN does not count, and of each score the worst is the one farther from the truth."""
    assert (figures["portraits"], figures["identities"]) == (5, 3)
    photo, draft = figures["rows"]["photo"], figures["rows"]["draft"]
    assert photo["count"] == 5 and draft["count"] == 4
    assert photo["mean"]["relit_psnr"] == 17 and photo["mean"]["turned_psnr"] == 16
    assert photo["worst"]["relit_psnr"] == 15 and photo["worst"]["relit_flip"] == 0.5
    assert photo["mean"]["relit_hair_psnr"] == 17 and photo["mean"]["relit_share_hair"] == 0.25
    assert photo["mean"]["h3ds_face_mean"] is None and photo["mean"]["relit_face_psnr"] is None
    assert draft["mean"]["tone_bias"] == pytest.approx(0.5 / 3, abs=1e-4) and draft["mean"]["tone_bias_size"] == 0.5
    assert draft["mean"]["camera_distance_error_size"] == 10
    assert photo["cpu_seconds"] == 102 and photo["peak_memory_megabytes"] == 904


def test_a_fit_is_compared_with_the_better_mean_head(figures):
    """1.8 mm against the smaller of 2 and 1.6, 2 and 2, 2 and 2.2; none is that of the portrait that failed."""
    draft = figures["rows"]["draft"]
    assert draft["mean"]["over_mean_head"] == pytest.approx((1.8 / 1.6 + 0.9 + 0.9) / 3, abs=1e-4)
    assert draft["worst"]["over_mean_head"] == pytest.approx(1.8 / 1.6)
    assert draft["mean"]["above_mean_head"] == pytest.approx(1 / 3, abs=1e-4)


def test_rows_are_compared_with_the_draft_on_the_portraits_that_both_have(figures):
    """The draft lacks the brightest portrait, and the mean head has no pictures."""
    assert figures["rows"]["photo"]["to_draft"]["relit_psnr"] == -5
    assert figures["rows"]["mean-head-2"]["to_draft"]["relit_psnr"] is None
    assert figures["rows"]["mean-head-2"]["to_draft"]["h3ds_face_mean"] == pytest.approx(
        (-0.2 + 0.2 + 0.4) / 3, abs=1e-4
    )
    assert figures["rows"]["draft"]["to_draft"]["relit_ssim"] == 0


def test_the_darkest_fifth_and_the_groups_are_by_themselves(figures):
    photo = figures["rows"]["photo"]
    assert photo["darkest"]["relit_psnr"] == 16 and photo["darkest"]["relit_hair_psnr"] is None
    assert figures["groups"] == {
        "tone": {"dark": 2, "light": 3},
        "yaw": {"0 to 15°": 2, "15 to 30°": 1, "over 30°": 2},
        "expression": {"neutral": 2, "smile": 3},
        "hair": {"hair": 3, "no hair": 2},
    }
    assert photo["by"]["tone"]["light"]["relit_psnr"] == 18 and photo["by"]["yaw"]["over 30°"]["relit_psnr"] == 17
    assert photo["by"]["expression"]["neutral"]["relit_psnr"] == 17
    assert figures["each"][0]["scores"]["photo"]["relit_psnr"] == 15 and figures["each"][0]["yaw"] == "over 30°"


def test_the_page_has_a_line_for_each_row_that_was_measured(figures):
    """A row appears in the tables of what it has; a score that it lacks is a dash."""
    text = page.render_page(figures, None)
    assert "5 portraits of 3 people" in text
    assert "| the photo unchanged | 5 | 17.0 | 0.500 | 0.300 | 16.0 | 0.500 | 0.300 | -5.0 | 0.000 |" in text
    assert "| mean head | 5 | 2.00 | 1.07 | 1.25 | 40 | – | 0.900 |" in text
    assert text.count("| mean head |") == 3 and "| second mean head |" in text  # face by group, geometry, cost
    assert "| p1 | draft | no face found |" in text
    assert "light (3)" in text and "The ladder" not in text and "## Pictures" not in text


def test_the_page_shows_what_it_is_given(figures):
    figures["rows"]["true-all"] = {**figures["rows"]["draft"], "title": "fit, draft, all of these true"}
    figures["stranger"] = [{"title": "fit, draft", "by": "a person", "right": 7, "of": 10}]
    figures["pictures"] = {"rows": "Some portraits."}
    text = page.render_page(figures, figures)
    assert "| fit, draft, all of these true |" in text.split("## The ladder")[1].split("## Heads of")[0]
    assert "all of these true" not in text.split("## The ladder")[0]
    assert "| fit, draft | a person | 7 of 10 |" in text
    assert "Some portraits.\n\n![" in text and "images/results_worst.jpg" not in text
    assert "| fit, draft | 4 | 21.5 |" in text.split("## Heads of the training's generators")[1]


def test_a_page_without_measurements_says_so(tmp_path):
    assert page.render_page(None, None).count(page.NOT_MEASURED) == 11
    with pytest.raises(InputError, match="no figures of a study"):
        page.write_page(tmp_path)


def test_figures_say_when_they_were_measured(figures, tmp_path):
    assert set(figures["measured"]) == {"revision", "date"}
    for damaged in ("", "[]", "{}"):
        (tmp_path / page.FIGURES["foreign"]).write_text(damaged)
        with pytest.raises(InputError, match="no figures of a study"):
            read_figures(tmp_path / page.FIGURES["foreign"])


def test_notes_are_put_into_the_figures(figures, tmp_path):
    """Figures stay as they were measured; a list of another name is refused."""
    stranger = [{"title": "fit, draft", "by": "a person", "right": 7, "of": 10}]
    (tmp_path / "notes.json").write_text(json.dumps({"stranger": stranger}))
    write_notes(tmp_path / "notes.json", tmp_path)
    assert read_figures(tmp_path / page.FIGURES["foreign"]) == {**figures, "stranger": stranger}
    (tmp_path / "notes.json").write_text('{"rows": []}')
    with pytest.raises(InputError, match="lists stranger alone"):
        write_notes(tmp_path / "notes.json", tmp_path)
