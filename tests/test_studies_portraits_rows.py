"""The rows of the benchmark: baselines with known answers; rows are kept, made again when what they depend on changes,
and failures are results."""

import dataclasses
import json
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
from conftest import tiny_fit
from egg import SIZE, head_like, landmarks_on, truth_of, turned_camera, write_truth, write_views
from PIL import Image

from sira_mi.avatar.file import PRIOR, load_avatar
from sira_mi.colour import linear_to_srgb
from sira_mi.errors import InputError
from sira_mi.files import read_exr, write_exr
from sira_mi.fit import fit
from sira_mi.fit.settings import QUALITIES
from sira_mi.optimisation.adam import read_arrays
from sira_mi.portrait.camera import yaw_rotation
from sira_mi.sg.fit_environment import pixel_directions
from studies.data import write_figures
from studies.portraits import __main__ as portraits
from studies.portraits import baselines, fit_by_method, make_rows, rows
from studies.portraits.benchmark_plan import FORMAT
from studies.portraits.make_rows import make_row, run_measured
from studies.portraits.page_of_code import (
    divide_by_shading,
    evaluate_harmonics,
    integrate_irradiance,
    shade,
)
from studies.portraits.photo_frame import read_frame
from studies.portraits.relit_lights import exposure_of
from studies.portraits.rows import BY_NAME, Case, select_rows
from studies.portraits.score_rows import score_case
from studies.portraits.truth import VIEWS
from studies.portraits.visible_surface import mesh_images

SKIN = np.array([0.5, 0.3, 0.2])


def ball(size: int = 48) -> tuple[np.ndarray, np.ndarray]:
    """Normals [H, W, 3] of the front of a ball, and where it is seen."""
    y, x = 1.05 * (1 - (np.indices((size, size)) + 0.5) / (size / 2))
    z2 = 1 - x * x - y * y
    return np.stack([-x, y, np.sqrt(np.maximum(z2, 0))], axis=-1), z2 > 0.02


def environment(lean: np.ndarray, rows: int = 64) -> np.ndarray:
    """Radiance 1 + lean · direction, for each channel."""
    directions, _ = pixel_directions(rows, 2 * rows)
    return np.repeat((1 + directions @ lean)[..., None], 3, axis=2)


# The page of code


def test_division_by_the_shading_gives_the_albedo_back():
    """A ball of one albedo under a light of nine harmonics, up to the damping of the fit; times its own shading it is
    the photo again."""
    normals, inside = ball()
    light = np.array([1.0, 0.2, 0.3, 0.35, 0.05, -0.05, 0.1, 0.05, 0.05])[:, None] * [1.0, 0.9, 0.7]
    shading = evaluate_harmonics(normals) @ light
    photo = np.where(inside[..., None], SKIN * shading, 0)
    albedo = divide_by_shading(photo, normals, inside, inside, SKIN)
    seen = normals[..., 2] > 0.4
    np.testing.assert_allclose(albedo[seen], np.broadcast_to(SKIN, albedo[seen].shape), rtol=0.03)
    np.testing.assert_allclose((albedo * shading)[seen], photo[seen], rtol=0.03)
    assert not albedo[~inside].any()


def test_marks_on_the_skin_are_albedo_and_do_not_change_the_light():
    """Eyes and lips: the fit of the light is robust, and what it does not explain stays in the picture."""
    normals, inside = ball()
    photo = np.where(inside[..., None], SKIN * (0.6 + 0.4 * normals[..., 2:]), 0)
    photo[20:23, 18:30] *= 0.3
    albedo = divide_by_shading(photo, normals, inside, inside, SKIN)
    np.testing.assert_allclose(albedo[20:23, 18:30], np.broadcast_to(0.3 * SKIN, (3, 12, 3)), rtol=0.05)
    np.testing.assert_allclose(albedo[30, 24], SKIN, rtol=0.03)


def test_irradiance_is_that_of_the_light():
    """Of radiance 1 + a · d the irradiance over π is 1 + 2/3 a · n. A photo relit by its own light is itself."""
    lean = np.array([0.3, 0.5, -0.4])
    light, (normals, inside) = environment(lean), ball()
    expected = np.repeat(1 + 2 / 3 * (normals[inside] @ lean)[:, None], 3, axis=1)
    np.testing.assert_allclose(integrate_irradiance(light, normals[inside]), expected, rtol=2e-3)
    photo = shade(SKIN, normals, inside, light)
    again = shade(divide_by_shading(photo, normals, inside, inside, SKIN), normals, inside, light)
    seen = normals[..., 2] > 0.4
    np.testing.assert_allclose(again[seen], photo[seen], rtol=0.04)


# A benchmark of eggs


@pytest.fixture
def case(tmp_path) -> Case:
    """A portrait of an egg in a benchmark on disk."""
    bench = tmp_path / "bench"
    for folder in ("photos", "lights", "truth"):
        (bench / folder).mkdir(parents=True)
    vertices, faces = head_like()
    truth = truth_of(vertices, faces, landmarks=landmarks_on(vertices))
    coded = (linear_to_srgb(truth.image) * 255 + 0.5).astype(np.uint8)
    Image.fromarray(coded).save(bench / "photos" / "egg.jpg", quality=95, subsampling=0)
    (bench / "photos" / "egg.camera.json").write_text(truth.camera.to_json())
    for name, lean in (("noon", [0, 0.5, 0.2]), ("lamp", [0.6, 0, 0])):
        write_exr(bench / "lights" / f"{name}.exr", 0.7 * environment(np.array(lean), 16))
    write_truth(write_views(bench / "truth" / "egg", truth) / "truth.npz", truth)
    entry = {"name": "egg", "identity": "eggs/1", "half": "choice", "relights": ["noon", "lamp"], "skin_luminance": 0.3}
    entry |= {"tone": "light", "yaw_degrees": 25.0, "hair": False}
    (bench / "benchmark.json").write_text(json.dumps({"format": FORMAT, "kind": "foreign", "portraits": [entry]}))
    return Case(bench, tmp_path / "runs", entry)


def run_baseline(case: Case, row: str, monkeypatch) -> Path:
    """Runs the command of a row in this process."""
    folder = case.folder(row)
    folder.mkdir(parents=True)
    arguments = case.fill(BY_NAME[row])
    assert arguments[:2] == ["-m", "studies.portraits.baselines"]
    monkeypatch.setattr(sys, "argv", arguments[1:])
    baselines.main()
    return folder


def write_head(folder: Path) -> None:
    vertices, faces = head_like()
    view = turned_camera()
    folder.mkdir(parents=True, exist_ok=True)
    arrays = {"vertices": vertices, "faces": faces, "landmarks": landmarks_on(vertices)}
    np.savez(folder / "head.npz", **arrays, K=view.K, world_to_camera=view.world_to_camera)


def test_the_photo_unchanged_scores_its_own_values(case, monkeypatch):
    """At the exposure of each light its sRGB values come out; it has no turned views."""
    folder = run_baseline(case, "photo", monkeypatch)
    photo = np.asarray(Image.open(case.places(BY_NAME["photo"])["photo"]), np.float32) / 255
    for view, light in zip(("relit_1", "relit_2"), case.lights, strict=True):
        exposed = read_exr(folder / f"{view}.exr")[0] * exposure_of(read_exr(light)[0])
        np.testing.assert_allclose(linear_to_srgb(exposed), photo, atol=1e-4)
    assert not list(folder.glob("turned*"))


def test_one_colour_turns_with_the_head(case, monkeypatch):
    """A turned view is that of turned vertices before the same camera and light."""
    write_head(case.folder("draft"))
    folder = run_baseline(case, "one-colour", monkeypatch)
    vertices, faces = head_like()
    for view, (light, yaw) in VIEWS.items():
        seen = mesh_images(vertices @ yaw_rotation(yaw).T, faces, turned_camera())
        expected = shade(baselines.MEAN_SKIN, seen.normal, seen.mask, read_exr(case.lights[light])[0])
        assert np.abs(read_exr(folder / f"{view}.exr")[0] - expected).mean() < 2e-3, view


def test_the_page_of_code_may_know_the_true_tone(case, monkeypatch):
    """The truth is read by that row and the ladder alone, and by no fit."""
    assert {row.name for row in rows.ROWS if "{truth}" in row.command} == {"page-of-code-true-tone", *rows.RUNGS}
    write_head(case.folder("draft"))
    mean, true = (run_baseline(case, row, monkeypatch) for row in ("page-of-code", "page-of-code-true-tone"))
    first, second = (read_exr(folder / "relit_1.exr")[0] for folder in (mean, true))
    inside = (first > 0).all(axis=2) & (second > 0).all(axis=2)
    tone = baselines.measure_skin_colour(case.truth / "truth.npz")
    ratio = np.median(second[inside] / first[inside], axis=0)
    np.testing.assert_allclose(ratio, tone / baselines.MEAN_SKIN, rtol=0.1)


def test_the_mesh_of_a_fit_is_a_head_at_the_pixels_of_the_photo(tmp_path):
    """Of a fit that saw a part of the photo at half the resolution, with a mesh in metres."""
    vertices, faces = head_like()
    (tmp_path / "avatar").mkdir()
    trimesh.Trimesh(vertices / 10, faces, process=False).export(tmp_path / "avatar" / "mesh.ply")
    view = turned_camera().crop(4, 8, 52, 48).scale(0.5, 0.5)
    report = {"camera": view.to_dict(), "window": [4, 8, 56, 56]}
    (tmp_path / "avatar" / "avatar.json").write_text(json.dumps(report))
    head = baselines.read_head(tmp_path, SIZE, SIZE)
    np.testing.assert_allclose(head.vertices, vertices, atol=1e-5)
    np.testing.assert_allclose(head.camera.K, turned_camera().K, atol=1e-9)
    assert read_frame(tmp_path / "avatar").longer_side == 52
    (tmp_path / "avatar" / "avatar.json").write_text("{}")
    with pytest.raises(InputError, match="fit the photo again"):
        baselines.read_head(tmp_path, SIZE, SIZE)
    with pytest.raises(InputError, match=r"avatar\.json"):
        baselines.read_head(tmp_path / "nothing", SIZE, SIZE)


# Making rows


COST = {"cpu_seconds": 3.0, "wall_seconds": 2.0, "peak_memory_megabytes": 500}


@pytest.fixture
def commands(case, monkeypatch):
    """Stands in for all commands: the lines of those that ran. A fit writes its folder, `relight` a picture; photos
    that begin with "bad" have no face."""
    ran: list[str] = []

    def run(arguments, log):
        program, *options = arguments[1:]
        ran.append(f"{program} {' '.join(options)}")
        if program == "sira_mi.relight":
            picture = Path(options[options.index("--out") + 1])
            write_exr(picture, np.full((SIZE, SIZE, 3), 0.1))
            return dict(COST)
        if Path(case.places(BY_NAME["draft"])["photo"]).read_bytes().startswith(b"bad"):
            return {**COST, "error": "exit code 2: no face"}
        if program != "studies.portraits.baselines":
            avatar = case.folder(
                "draft" if program == "sira_mi.fit" else Path(options[options.index("--out") + 1]).parts[-2]
            )
            (avatar / "avatar").mkdir(exist_ok=True)
            report = {"camera": turned_camera().to_dict(), "window": [0, 0, SIZE, SIZE]}
            (avatar / "avatar" / "avatar.json").write_text(json.dumps(report))
        return dict(COST)

    monkeypatch.setattr(make_rows, "run_measured", run)
    return ran


def test_rows_are_made_once_and_share_what_they_go_on_from(case, commands):
    draft = make_row(case, BY_NAME["draft"])
    assert draft == {"portrait": "egg", "row": "draft", **COST, "relight_cpu_seconds": 12.0}
    assert [line.split()[0] for line in commands] == ["sira_mi.fit"] + ["sira_mi.relight"] * 4
    photo = case.places(BY_NAME["draft"])["photo"]
    assert f"sira_mi.fit {photo} --out {case.folder('draft')}/avatar --quality draft" in commands[0]
    assert "truth" not in commands[0] and "camera" not in commands[0]
    assert [f"--yaw {yaw}" in line for line, (_, yaw) in zip(commands[1:], VIEWS.values(), strict=True)] == [True] * 4
    commands.clear()
    page = make_row(case, BY_NAME["page-of-code"])
    assert len(commands) == 1 and page["cpu_seconds"] == 6 and page["peak_memory_megabytes"] == 500
    assert make_row(case, BY_NAME["draft"]) == draft and make_row(case, BY_NAME["page-of-code"]) == page
    make_row(case, BY_NAME["paper"])
    assert [line.split()[:2] for line in commands[1:3]] == [
        ["studies.portraits.fit_by_method", m] for m in ("a.4", "b.7")
    ]
    assert "--after" not in commands[1] and f"--after {case.folder('a.4')}" in commands[2]


def test_a_row_is_made_again_when_what_it_depends_on_changes(case, commands):
    """A photo, a light, a prior, a picture or a row that is thrown away, and then those that go on from it."""
    draft, page = BY_NAME["draft"], BY_NAME["page-of-code"]

    def count() -> tuple[int, int, int]:
        commands.clear()
        make_row(case, draft)
        make_row(case, page)
        programs = [line.split()[0] for line in commands]
        return tuple(programs.count(n) for n in ("sira_mi.fit", "sira_mi.relight", "studies.portraits.baselines"))

    assert count() == (1, 4, 1) and count() == (0, 0, 0)
    photo = case.places(draft)["photo"]
    Image.fromarray(np.zeros((SIZE, SIZE, 3), np.uint8)).save(photo)
    assert count() == (1, 4, 1)
    write_exr(case.lights[1], environment(np.array([0, 0, 0.9]), 16))
    assert count() == (0, 4, 1)
    (case.folder("draft") / "turned_left.exr").unlink()
    assert count() == (0, 4, 0)
    stored = json.loads((case.folder("draft") / "row.json").read_text())
    (case.folder("draft") / "row.json").write_text(json.dumps({**stored, "key": "of another command"}))
    assert count()[0] == 1
    other = Case(case.benchmark, case.runs, case.entry, case.lights[0])
    assert other.key(draft) != case.key(draft) and other.key(BY_NAME["photo"]) == case.key(BY_NAME["photo"])


def test_a_failed_fit_is_a_row_with_its_error(case, commands):
    """And counts as a black picture; what goes on from it fails for the same reason."""
    case.places(BY_NAME["draft"])["photo"].write_bytes(b"bad")
    draft, page = make_row(case, BY_NAME["draft"]), make_row(case, BY_NAME["page-of-code"])
    assert draft["error"] == "exit code 2: no face" and page["error"] == "draft: exit code 2: no face"
    assert len(commands) == 1
    assert make_row(case, BY_NAME["draft"])["error"] == draft["error"] and len(commands) == 1
    (failed,) = score_case(case, [BY_NAME["draft"], BY_NAME["photo"]])
    assert failed["scores"]["relit_1_missed"] == 1 and failed["error"] == "exit code 2: no face"


def test_scores_are_kept_until_the_row_is_made_again(case, monkeypatch):
    folder = run_baseline(case, "photo", monkeypatch)
    (folder / "row.json").write_text(json.dumps({"key": "1", **COST}))
    (first,) = score_case(case, [BY_NAME["photo"]])
    assert first["scores"]["relit_1_psnr"] < 60 and first["cpu_seconds"] == 3 and "key" not in first
    for view in ("relit_1", "relit_2"):
        write_exr(folder / f"{view}.exr", np.zeros((SIZE, SIZE, 3)))
    assert score_case(case, [BY_NAME["photo"]]) == [first]
    (folder / "row.json").write_text(json.dumps({"key": "2", **COST}))
    (second,) = score_case(case, [BY_NAME["photo"]])
    assert second["scores"]["relit_1_missed"] == 1
    write_exr(folder / "relit_1.exr", np.zeros((3, 3, 3)))
    (folder / "row.json").write_text(json.dumps({"key": "3", **COST}))
    (broken,) = score_case(case, [BY_NAME["photo"]])
    assert "relit picture must be numbers" in broken["error"]


def run_studies(monkeypatch, capsys, case: Case, command: str, *options: str) -> str:
    """What `python -m studies.portraits` prints."""
    where = ["--benchmark", str(case.benchmark), "--runs", str(case.runs)]
    monkeypatch.setattr(sys, "argv", ["portraits", command, *where, *options])
    portraits.main()
    return capsys.readouterr().out


def test_fit_score_and_page_make_a_table_of_the_rows(case, commands, monkeypatch, capsys, tmp_path):
    """The rows that RUNS holds, in the words of the page; figures keep the notes that were given."""
    with pytest.raises(InputError, match="holds no rows"):
        run_studies(monkeypatch, capsys, case, "score")
    run_baseline(case, "photo", monkeypatch)
    printed = run_studies(monkeypatch, capsys, case, "fit", "--rows", "draft", "mean-head", "--half", "choice")
    assert printed.endswith("2 rows of 1 portraits, 0 failed\n")
    (case.folder("draft") / "avatar" / "avatar.json").unlink()  # of the stand-in: no head to score
    printed = run_studies(monkeypatch, capsys, case, "score")
    assert printed.splitlines()[0] == "photo: 1 of 1 portraits are not made yet"
    assert "| fit, draft | 1 |" in printed
    (row,) = json.loads((case.runs / "draft" / "rows.json").read_text())
    assert row["wall_seconds"] == 2 and row["scores"]["relit_1_psnr"] > 5
    out = tmp_path / "docs"
    stranger = {"title": "fit, draft", "by": "a person", "right": 7, "of": 10}
    write_figures(out / "data" / "foreign.json", {"stranger": [stranger], "rows": {}})
    run_studies(monkeypatch, capsys, case, "page", "--half", "choice", "--out", str(out))
    text = (out / "results.md").read_text()
    assert "| fit, draft | 1 |" in text and "| 7 of 10 |" in text and "images/results_worst.jpg" in text
    with pytest.raises(InputError, match="no portraits of the half report"):
        run_studies(monkeypatch, capsys, case, "fit", "--half", "report")


def test_commands_are_measured(tmp_path):
    log = tmp_path / "log.txt"
    cost = run_measured(["-c", "print('x' * 9, flush=True); sum(range(10**6))"], log)
    assert set(cost) == {"cpu_seconds", "wall_seconds", "peak_memory_megabytes"} and cost["peak_memory_megabytes"] > 4
    assert log.read_text() == "x" * 9 + "\n"
    failed = run_measured(["-c", "import sys; print('working'); sys.exit('error: no face; give --face')"], log)
    assert failed["error"] == "exit code 1: no face; give --face"
    assert run_measured(["-c", "import os; os._exit(3)"], log)["error"] == "exit code 3: it printed nothing"
    with pytest.raises(KeyboardInterrupt):
        run_measured(["-c", "import sys; sys.exit(130)"], log)


def test_rows_have_names_that_can_be_asked_for():
    assert len(BY_NAME) == len(rows.ROWS) and all(row.after in (None, *BY_NAME) for row in rows.ROWS)
    assert [row.name for row in select_rows(["draft", "paper"])] == ["draft", "paper"]
    with pytest.raises(InputError, match="unknown rows best; known are photo, one-colour"):
        select_rows(["draft", "best"])


# Methods


@pytest.mark.slow
def test_fits_by_a_method_continue_and_end_in_the_folder_of_a_fit(tmp_path, monkeypatch, astronaut):
    """The geometry, an appearance that goes on from its tensors, and the geometry of landmarks alone, which moves shape
    and pose but no network of the shape."""
    tiny = tiny_fit(steps=2)
    stages = tuple(stage for stage in tiny.stages if stage.name in ("networks", "light"))
    monkeypatch.setitem(QUALITIES, "draft", dataclasses.replace(tiny, stages=stages))
    written = []
    monkeypatch.setattr(fit, "write_folder", lambda out, portrait, *rest: written.append((out, portrait, rest[2])))
    Image.fromarray(astronaut).resize((256, 256)).save(tmp_path / "photo.png")

    def run(method: str, *more: str) -> dict[str, np.ndarray]:
        arguments = [method, str(tmp_path / "photo.png"), "--out", str(tmp_path / method), "--prior", str(PRIOR), *more]
        monkeypatch.setattr(sys, "argv", ["fit_by_method", *arguments])
        fit_by_method.main()
        out, portrait, report = written.pop()
        assert out == tmp_path / method / "avatar" and portrait.window == (0, 0, 256, 256)
        assert report["method"] == method and load_avatar(out / "avatar.safetensors").tensors["lobes"].size
        return read_arrays(tmp_path / method / "tensors.safetensors")[0]

    prior = load_avatar(PRIOR).tensors
    shape, landmarks = run("a.4"), run("landmarks")
    shaded = run("b.2", "--after", str(tmp_path / "a.4"))
    for name in ("pose", "avatar/z_sdf", "avatar/deformation"):
        assert np.array_equal(shape[name], shaded[name])
    assert not np.array_equal(shape["avatar/deformation"], prior["deformation"])
    assert not np.array_equal(shape["avatar/z_l"], shaded["avatar/z_l"])
    assert np.array_equal(landmarks["avatar/deformation"], prior["deformation"])
    assert np.abs(landmarks["pose"]).max() > 0 and np.abs(landmarks["avatar/z_sdf"] - shape["avatar/z_sdf"]).max() > 0
