"""The cross-check: its arithmetic on made-up numbers, its estimators against each other and against `sira_sg`, a
tiny run end to end, and its errors for bad input."""

import sira_mi  # noqa: F401, I001  (first: Dr.Jit must find LLVM)

import dataclasses
import json
import sys
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from conftest import camera

from sira_mi.export import scene as scenes
from studies import measures
from studies.crosscheck import causes, curves, forms, images, page, plots, speed
from studies.crosscheck.__main__ import _command, main
from studies.crosscheck.case import Case, load_case
from studies.crosscheck.fits import read_fits
from studies.crosscheck.lights import SETTINGS, SOFT, lobes_of
from studies.crosscheck.points import field_points, in_double, mesh_points
from studies.crosscheck.regions import HEAD, REGIONS, SILHOUETTE, regions
from studies.crosscheck.run import Settings, measure
from studies.data import read_figures, write_figures
from sira_mi.errors import InputError

pytest.importorskip("flip_evaluator")
pytest.importorskip("matplotlib")

SIZE, VOXEL = 20, 0.15


@pytest.fixture(scope="module")
def case(avatar_path):
    return Case("a blob", avatar_path, 0.5, 1.0, scenes.sensor(camera(30.0, SIZE)), SIZE, SIZE)


@pytest.fixture(scope="module")
def head(case):
    return case.head(VOXEL)


@pytest.fixture(scope="module")
def lit(case, head):
    """The soft light's scene, its lobes in the head's coordinates, and points on the field and on the mesh."""
    lobes = lobes_of(SOFT)
    scene = case.scene(head, lobes)
    return (
        scene,
        forms.local_lobes(lobes, head),
        field_points(case, scene, head, 2, 0),
        mesh_points(case, scene, head, 2, 0),
    )


def noisy(truth, noise, rng):
    return truth + noise * rng.standard_normal(truth.shape)


def test_slope_of_a_curve_that_falls_with_the_root_of_time():
    x = np.array([0.1, 0.5, 2.0, 30.0])
    assert curves.slope_of(x, 0.3 / np.sqrt(x)) == pytest.approx(-0.5)
    assert np.isnan(curves.slope_of(x[:1], x[:1]))
    points = [curves.Point("sun", curves.PATH, n, 0.01 * n, 0.4 / np.sqrt(n), 0.1) for n in (1, 4, 16, 64, 256)]
    (slope,) = curves.slopes(points)
    assert slope.over_time == pytest.approx(-0.5) and slope.over_samples == pytest.approx(-0.5)
    assert curves.time_of_path(points, "sun", 0.01) == pytest.approx(0.01 * 1600)


def test_variance_decides_when_a_reference_ends():
    """The estimated standard error is the true one, and noise of half the size takes a quarter of the passes."""
    mask, passes = np.ones((30, 30), bool), {}
    for noise in (0.2, 0.1):
        rng = np.random.default_rng(1)
        estimate = images.converge(lambda k, n=noise, r=rng: noisy(np.ones((30, 30, 3)), n, r), mask, 0.01, 60.0)
        passes[noise] = estimate.passes
        assert estimate.converged and estimate.error <= 0.01
        assert np.sqrt(((estimate.mean - 1) ** 2).mean()) == pytest.approx(estimate.error, rel=0.1)
    assert passes[0.2] == pytest.approx(4 * passes[0.1], rel=0.15)
    rng = np.random.default_rng(1)
    short = images.converge(lambda k: noisy(np.ones((30, 30, 3)), 0.2, rng), mask, 1e-6, 0.0)
    assert not short.converged and short.passes == 8, "the end of the time is said"


def test_launches_that_are_not_finite_are_counted_and_made_again(lit, monkeypatch):
    scene, found = lit[0], iter([np.nan, 2.0, np.inf, np.nan, 4.0])
    monkeypatch.setattr(mi, "render", lambda *_, **__: mi.TensorXf(np.full((SIZE, SIZE, 4), next(found), np.float32)))
    monkeypatch.setattr(images, "_LAUNCH", SIZE * SIZE)
    log = images.LaunchLog()
    assert (images.render(scene, None, 2, 0, log=log) == 3).all() and (log.launches, log.non_finite) == (5, 3)
    found = iter([np.nan] * 5)
    with pytest.raises(RuntimeError, match="not finite"):
        images.render(scene, None, 1, 0)


def test_errors_do_not_hold_the_noise_of_the_reference():
    rng = np.random.default_rng(2)
    halves = np.stack([noisy(np.ones((80, 80, 3)), 0.2, rng) for _ in range(2)])
    reference, mask = images.Estimate(halves, 0.1, 2, 0.0, True), np.ones((80, 80), bool)
    assert images.relative_error(np.full((80, 80, 3), 1.05), reference, mask) == pytest.approx(0.05, abs=0.01)
    found = [images.relative_error(noisy(np.ones((80, 80, 3)), 0.3, rng), reference, mask) for _ in range(2)]
    assert found == pytest.approx([0.3, 0.3], rel=0.05), "the image's own noise counts"
    pictures = [noisy(np.ones((80, 80, 3)), 0.3, rng) for _ in range(2)]
    limit = curves.limit("sun", curves.PATH, pictures, reference, mask)
    assert limit.error <= limit.resolution < 0.1
    off = curves.limit("sun", curves.PATH, [p + 0.1 for p in pictures], reference, mask)
    assert off.error > off.resolution and off.error == pytest.approx(0.1, rel=0.15)


def test_flip_is_zero_for_equal_pictures_and_grows_with_the_difference():
    rng, mask = np.random.default_rng(3), np.ones((32, 32), bool)
    picture = rng.uniform(0.1, 0.9, (32, 32, 3))
    found = [measures.flip(picture + shift, picture, mask) for shift in (0.0, 0.02, 0.1)]
    assert found[0] < 1e-6 < found[1] < found[2] < 1


def test_regions_part_the_head():
    rng = np.random.default_rng(4)
    y, x = np.mgrid[:40, :40]
    coverage = np.clip(16 - np.hypot(x - 20, y - 20), 0, 1)
    found = regions(coverage, rng.uniform(0, 1, (40, 40)), rng.uniform(0, 1, (40, 40)))
    assert (sum(found[name].astype(int) for name in REGIONS) == found[HEAD]).all()
    assert (found[HEAD] == (coverage > 0)).all() and all(found[name].any() for name in REGIONS)
    assert found[SILHOUETTE][(coverage > 0) & (coverage < 1)].all() and not found[SILHOUETTE][20, 20]


def test_causes_add_up():
    """Means and shares of the causes add up to the total's, also where causes cancel; errors are without noise."""
    rng, shape = np.random.default_rng(5), (2, 50, 50, 3)
    first, second = (np.broadcast_to(rng.standard_normal((50, 50, 3)), shape) for _ in range(2))
    named = {"a": noisy(0.1 * first, 0.05, rng), "b": noisy(0.2 * second - 0.05 * first + 0.02, 0.05, rng)}
    named[causes.TOTAL] = named["a"] + named["b"]
    everywhere = dict.fromkeys((*REGIONS, HEAD), np.ones((50, 50), bool))
    found = {row.cause: row for row in causes.rows("sun", "", named, everywhere, 2.0)}
    total = found[causes.TOTAL]
    assert total.share == pytest.approx(1) and found["a"].share + found["b"].share == pytest.approx(1)
    assert found["a"].bias + found["b"].bias == pytest.approx(total.bias) and total.bias == pytest.approx(0.01, rel=0.2)
    assert found["a"].errors[HEAD] == pytest.approx(0.05, rel=0.05)


def test_parts_lead_from_every_form_to_the_reference():
    rng, shape = np.random.default_rng(6), (2, 4, 4, 3)
    fields = [field.name for field in dataclasses.fields(causes.Pictures)]
    pictures = causes.Pictures(**{name: rng.random(shape) for name in fields})
    reference = images.Estimate(rng.random(shape), 0.1, 8, 0.0, True)
    for form, start in ((causes.PHYSG, "physg"), (causes.FORM, "form"), (causes.VISIBLE, "visible")):
        parts = causes.parts(pictures, reference, rng.random(shape))[form]
        total = parts.pop(causes.TOTAL)
        np.testing.assert_allclose(sum(parts.values()), total, atol=1e-12)
        np.testing.assert_allclose(getattr(pictures, start) + total, reference.halves, atol=1e-12)


@pytest.mark.slow
def test_our_points_shade_like_the_plugin(case, head, lit):
    """The closed form with visibility at these points is `sira_sg`, and without it the one with `visibility` off."""
    scene, lobes, field, _ = lit
    light = lobes, case.roughness, case.k_s
    found = {True: forms.with_visibility(field, scene, head, *light), False: forms.closed_form(field, *light)}
    inside = field.picture(np.ones((1, field.x.shape[1])))[..., 0] > 0.999
    for visibility, values in found.items():
        plugin = mi.load_dict({"type": "sira_sg", "hide_emitters": True, "visibility": visibility})
        other = images.render(scene, plugin, 64, 0)
        difference = (field.picture(values) - other)[inside]
        assert np.sqrt((difference**2).mean()) < 0.03 * other[inside].mean()
        assert abs(difference.mean()) < 0.005 * other[inside].mean()


@pytest.mark.slow
def test_direct_light_agrees_with_the_path_tracer(case, head, lit):
    """Two programs, one integral: this package's estimator at the mesh's points, and `path` of depth 2."""
    scene, lobes, _, mesh = lit
    direct = forms.direct_light(mesh, scene, head, lobes, case.roughness, 128, 3)[1]
    ours = mesh.picture(direct.radiance(*mesh.baked(), case.k_s))
    traced = [images.render(scene, images.path(2), 512, k) for k in range(2)]
    inside = mesh.picture(np.ones((1, mesh.x.shape[1])))[..., 0] > 0.999
    mean = traced[0][inside].mean()
    assert abs((ours - traced[0])[inside].mean()) < 0.005 * mean
    error = images.root(images.mean_square(ours - traced[0], ours - traced[1], inside))
    assert error < 0.03 * mean, "jittered points and the traced picture's pixels"


@pytest.mark.slow
def test_closed_form_in_both_precisions_and_by_monte_carlo(case, head, lit):
    """Single precision is within 1e-4 of double; Monte Carlo without shadows within the form's documented error;
    PhySG's form is farther from it."""
    scene, lobes, field, _ = lit
    light = lobes, case.roughness, case.k_s
    form = forms.closed_form(field, *light)
    normal = in_double(field, head)[1]
    np.testing.assert_allclose(np.linalg.norm(normal, axis=0), 1, atol=1e-12)
    exact = forms.closed_form_double(field, normal, *light)
    assert np.abs(form - exact).max() < 1e-3 * exact.mean() and np.abs(form - exact).max() > 0
    direct, shadowed = forms.direct_light(field, scene, head, lobes, case.roughness, 256, 1)
    truth = direct.radiance(field.diffuse, field.specular, case.k_s)
    errors = [np.sqrt(((f - truth) ** 2).mean()) / truth.mean() for f in (form, forms.physg(field, *light))]
    assert errors[0] < 0.02 and errors[1] > 1.2 * errors[0]
    assert (shadowed.irradiance <= direct.irradiance + 1e-6).all()


def test_a_round_head_of_random_networks_and_growth(case):
    costs = speed.width_costs(case, lobes_of("sun"), (32,), voxel=0.3)
    assert [cost.width for cost in costs] == [32] and all(cost.seconds > 0 and cost.points > 20 for cost in costs)
    made_up = [speed.Cost("shade", n, m, 0, 1e-9 * n * m**0.5) for n in (8, 32, 128) for m in (100, 1000)]
    assert speed.growth(made_up, "lobes") == pytest.approx(1) and speed.growth(made_up, "points") == pytest.approx(0.5)


TINY = Settings(minutes=0.0, voxel=VOXEL, usual_voxel=0.2, pass_samples=2, side=1, directions=4, speed=False)


@pytest.mark.slow
def test_a_tiny_run_gives_figures_plots_and_page(case, tmp_path):
    """Figures, plots and page of one light; kept evidence is not measured again."""
    lights, evidence = {SOFT: lobes_of(SOFT)}, tmp_path / "evidence"
    measured, lit = measure(case, lights, TINY, lambda line: None, evidence)
    again, _ = measure(case, lights, TINY, lambda line: None, evidence)
    assert again["lights"] == json.loads(json.dumps(measured["lights"]))
    rows = tmp_path / "draft" / "rows.json"
    rows.parent.mkdir()
    rows.write_text(json.dumps(fit_rows()))
    fits = {"rows": [dataclasses.asdict(fit) for fit in read_fits([rows])]}
    file = tmp_path / page.FIGURES
    figures = write_figures(file, {"command": "python -m studies.crosscheck --size 20", **measured, "fits": fits})
    text = page.write_page(figures, tmp_path).read_text(encoding="utf-8")
    assert text == page.render_page(read_figures(file)), "the page is a function of the JSON file"
    assert "--size 20" in text and "| draft | 2 | 30 | 1.50 | 31.0 |" in text and "Not measured (`--no-speed`)" in text
    assert all(cause in text for cause in (causes.PROXY, causes.FLOAT32, causes.NOISE, causes.REST))
    assert "NaN" not in file.read_text() and "Infinity" not in file.read_text()
    points = {(p["method"], p["samples"]): p["error"] for p in figures["lights"][0]["points"]}
    assert points[curves.PATH, 1] > points[curves.PATH, 16] > 0

    plots.plot_curves([curves.Point(**p) for p in figures["lights"][0]["points"]], tmp_path / "curves.svg")
    svg = (tmp_path / "curves.svg").read_text()
    assert svg.lstrip().startswith("<?xml") and "slope" in svg and curves.PATH in svg
    plots.plot_sheet(lit, tmp_path / "causes.png")
    assert mi.Bitmap(str(tmp_path / "causes.png")).size()[0] > 400


def test_the_page_in_docs_is_that_of_its_figures():
    """`docs/crosscheck.md` is `docs/data/crosscheck.json` in the template, in at most 1,500 words; no field is left."""
    docs = Path(__file__).resolve().parent.parent / "docs"
    text = (docs / "crosscheck.md").read_text(encoding="utf-8")
    assert text == page.render_page(read_figures(docs / page.FIGURES)), "run python -m studies.crosscheck --page"
    assert len(text.split()) <= 1500 and "$" not in text


def test_a_missed_mark_is_called_missed():
    """Verdicts follow the figures: each mark alone turns when its figure passes the bound."""
    docs = Path(__file__).resolve().parent.parent / "docs"
    figures = read_figures(docs / page.FIGURES)
    marks = page.render_page(figures).split("## Marks")[1].split("## ")[0]
    worse = json.loads(json.dumps(figures))
    for row in worse["lights"][0]["causes"]:
        row["errors"]["head"] *= 10
    for ratio in worse["speed"]["ratios"]:
        ratio["value"] *= 10
    for point in worse["lights"][1]["points"]:
        point["error"] = 0.1
    changed = page.render_page(worse).split("## Marks")[1].split("## ")[0]
    assert changed.count("missed") == marks.count("missed") + 3


def fit_rows():
    scores = [{"h3ds_face_mean": 1.0, "final_psnr": 30.0}, {"h3ds_face_mean": 2.0, "final_psnr": 32.0}]
    rows = []
    for k, score in enumerate(scores):
        rows.append({"portrait": f"p{k}", "row": "draft", "scores": score, "wall_seconds": 30.0})
    return [*rows, {"portrait": "p2", "row": "draft", "error": "no face"}]


SCENE = """<scene version="3.0.0">
{shape}
<emitter type="{emitter}"/>
<sensor type="{sensor}"><film type="hdrfilm">
<integer name="width" value="64"/><integer name="height" value="32"/><rfilter type="box"/></film>
<transform name="to_world"><lookat origin="0, 0, 9" target="0, 0, 0" up="0, 1, 0"/></transform></sensor>
</scene>"""
HEAD_XML = """<shape type="neural_sdf"><string name="avatar" value="{avatar}"/><float name="voxel" value="0.3"/>
<transform name="to_world"><rotate y="1" angle="30"/></transform><bsdf type="{bsdf}">{textures}</bsdf></shape>"""
TEXTURES = """<float name="roughness" value="0.4"/>
<texture type="neural_albedo" name="diffuse_albedo"><string name="avatar" value="{avatar}"/></texture>
<texture type="neural_albedo" name="specular_albedo"><string name="avatar" value="{avatar}"/>
<string name="kind" value="specular"/></texture>"""


def scene_file(
    path, avatar, bsdf="sira_bsdf", textures=TEXTURES, shape=HEAD_XML, emitter="sg_envmap", sensor="perspective"
):
    shape = shape.format(avatar=avatar, bsdf=bsdf, textures=textures.format(avatar=avatar))
    path.write_text(SCENE.format(shape=shape, emitter=emitter, sensor=sensor))
    return path


@pytest.mark.slow
def test_a_scene_file_gives_head_light_and_sensor(avatar_path, tmp_path):
    case = load_case(scene_file(tmp_path / "scene.xml", avatar_path), 32)
    assert (case.width, case.height, case.roughness) == (32, 16, pytest.approx(0.4)) and case.lobes.shape == (1, 7)
    np.testing.assert_allclose(case.to_world[:3, :3] @ case.to_world[:3, :3].T, np.eye(3), atol=1e-6)
    scene = case.scene(case.head(0.3), case.lobes)
    own = mi.load_file(str(tmp_path / "scene.xml"))
    pictures = [images.render(s, images.path(2), 256, 0) for s in (scene, own)]
    small = pictures[1].reshape(16, 2, 32, 2, 3).mean(axis=(1, 3))
    assert np.abs(pictures[0] - small).mean() < 0.05 * small.mean()


@pytest.mark.parametrize(
    "changed, message",
    [
        ({"shape": ""}, "holds 0 neural_sdf"),
        ({"bsdf": "diffuse", "textures": ""}, "not a sira_bsdf"),
        ({"textures": ""}, "must be neural_albedo"),
        ({"emitter": "constant"}, "must be one sg_envmap"),
        ({"sensor": "orthographic"}, "give a perspective one"),
        ({"shape": "<nonsense/>"}, "cannot load it"),
    ],
)
def test_a_scene_that_lacks_something_is_told_so(changed, message, avatar_path, tmp_path):
    with pytest.raises(InputError, match=message):
        load_case(scene_file(tmp_path / "scene.xml", avatar_path, **changed), 16)


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["--size", "4"], "--size is 4"),
        (["--minutes", "nan"], "--minutes is nan"),
        (["--lights", "moon"], "unknown lights moon"),
        (["--out", "nowhere/at/all"], "is not a folder"),
        (["missing.xml"], "missing.xml does not exist"),
        (["missing.safetensors"], "no such avatar file"),
        (["--fits", "missing.json"], "cannot read missing.json"),
        (["--size", "big"], "invalid int value"),
    ],
)
def test_bad_command_lines_end_in_one_line(arguments, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    extra = [] if "--out" in arguments else ["--out", str(tmp_path)]
    with pytest.raises(InputError, match=message) as raised:
        main([*arguments, *extra])
    assert "\n" not in str(raised.value)


def test_the_command_of_the_page_leaves_folders_out():
    arguments = ["a.xml", "--out", "x", "--size", "64", "--evidence=y", "--lights", "soft studio"]
    assert _command(arguments) == "python -m studies.crosscheck a.xml --size 64 --lights 'soft studio'"


def test_rows_of_fits_that_are_none(tmp_path):
    file = tmp_path / "rows.json"
    for text, message in (("{", "not the rows.json"), ("[]", "holds no fit"), ("[1]", "not the rows.json")):
        file.write_text(text)
        with pytest.raises(InputError, match=message):
            read_fits([file])


def test_plots_say_which_extra_is_missing(monkeypatch):
    for module in ("matplotlib", "flip_evaluator"):
        monkeypatch.setitem(sys.modules, module, None)
    for need in (plots.pyplot, measures.require_flip):
        with pytest.raises(InputError, match=r"sira-mi\[plots\]"):
            need()


def test_settings_of_lights_are_lobes():
    assert len(SETTINGS) >= 4
    for name in SETTINGS:
        lobes = lobes_of(name)
        assert (lobes[:, 3:] >= 0).all() and np.allclose(np.linalg.norm(lobes[:, :3], axis=1), 1)
