"""The sheets of pictures: the stranger's test has a head and another photo of each person, in orders that its key alone
tells; sheets of rows have a place for each picture."""

import json

import numpy as np
import pytest
from egg import SIZE, head_like, truth_of, write_views
from PIL import Image

from sira_mi.files import write_exr
from studies.portraits import sheets
from studies.portraits.sheets import Album, draw_large, draw_rows, draw_strangers


@pytest.fixture(scope="module")
def albums(tmp_path_factory) -> list[Album]:
    """Two portraits each of twelve people; a person's photos and heads have one grey that is nobody else's."""
    truth = truth_of(*head_like())
    folder = tmp_path_factory.mktemp("benchmark")
    for name in ("photos", "lights", "truth", "runs/draft"):
        (folder / name).mkdir(parents=True)
    for name in ("noon", "lamp"):
        write_exr(folder / "lights" / f"{name}.exr", np.full((8, 16, 3), 0.8))
    found = []
    for person in range(12):
        for take in range(2):
            name, grey = f"p{person}_{take}", 20 + 15 * person
            Image.new("RGB", (SIZE, SIZE), (grey,) * 3).save(folder / "photos" / f"{name}.jpg", quality=100)
            write_views(folder / "truth" / name, truth)
            (folder / "runs" / "draft" / name).mkdir()
            for view in sheets.VIEWS:
                radiance = np.full((SIZE, SIZE, 3), ((grey / 255 + 0.055) / 1.055) ** 2.4)
                write_exr(folder / "runs" / "draft" / name / f"{view}.exr", radiance)
            found.append(Album(folder, folder / "runs", {"name": name, "identity": f"i{person}"}))
    return found


def test_a_stranger_sees_ten_people_and_the_key_pairs_them(albums, tmp_path):
    draw_strangers(albums, "draft", tmp_path, seed=3)
    key = json.loads((tmp_path / "stranger.json").read_text())
    assert list(key["heads"]) == list("ABCDEFGHIJ") == list(key["pairs"]) and len(key["photos"]) == 10
    sheet = np.asarray(Image.open(tmp_path / "stranger.jpg")).astype(int)
    side = sheet.shape[0] // 10
    for letter, place in key["pairs"].items():
        head, photo = key["heads"][letter], key["photos"][str(place)]
        assert head.split("_")[0] == photo.split("_")[0] and head != photo
        middle = side // 2 + side * np.array(["ABCDEFGHIJ".index(letter), place - 1])
        assert abs(sheet[middle[0], 60] - sheet[middle[1], -side // 2]).max() < 5
    assert list(key["pairs"].values()) != sorted(key["pairs"].values())
    assert len(set(key["heads"].values())) == 10


def test_a_seed_repeats_a_sheet(albums, tmp_path):
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        draw_strangers(albums, "draft", tmp_path / name, seed)
    a, b, c = ((tmp_path / name / "stranger.json").read_bytes() for name in "abc")
    assert a == b != c
    assert (tmp_path / "a" / "stranger.jpg").read_bytes() == (tmp_path / "b" / "stranger.jpg").read_bytes()


def test_pictures_are_shown_at_the_exposure_of_the_scores(albums):
    """Under this light it is 1; a head is as bright as its radiance says."""
    album = albums[4]
    assert album.row("draft", "relit_1")[0, 0] == pytest.approx([(20 + 15 * 2) / 255] * 3, abs=2e-3)
    assert (album.row("other", "relit_1") == 1).all()
    assert album.truth("turned_left").shape == (SIZE, SIZE, 3)


def test_sheets_have_a_line_for_each_row_and_portrait(albums, tmp_path):
    draw_rows(
        albums[:3], {"draft": "fit, draft", "other": "a row with a long title that takes two lines"}, tmp_path / "a.jpg"
    )
    draw_large(albums[:2], "draft", tmp_path / "b.jpg")
    assert np.asarray(Image.open(tmp_path / "a.jpg")).shape[0] == 4 * sheets._TILE
    assert np.asarray(Image.open(tmp_path / "b.jpg")).shape == (2 * sheets._LARGE, 5 * sheets._LARGE, 3)
