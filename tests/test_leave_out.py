"""What pictures and fits leave out: bounds hold against the truth, and results agree with and without the decisions."""

import json
from dataclasses import replace
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from conftest import camera, small_avatar, tiny_fit

from sira_mi.avatar.file import PRIOR, load_avatar, save_avatar
from sira_mi.decisions import Decision, Plan, explain
from sira_mi.export.scene import orbit
from sira_mi.fields.directions import fibonacci_directions
from sira_mi.fit.appearance import AppearanceStage
from sira_mi.fit.driver import Progress
from sira_mi.fit.fit import FitRequest, fit_portrait, read_portrait
from sira_mi.fit.measure import measure_fit
from sira_mi.fit.stage import FitTask
from sira_mi.fit.state import initial_state
from sira_mi.relight import measure
from sira_mi.relight.__main__ import main as relight
from sira_mi.relight.leave_out import TOLERANCE, approximate_lobes, largest_reflectance, plan_relight
from sira_mi.relight.measure import measure_plan
from sira_mi.relight.render import RelightSettings, head_window, load_head, load_scene, render_passes
from sira_mi.relight.subject import Light, Subject
from sira_mi.relight.surface import Surface, reflect_bounces, sample_surface
from sira_mi.sg.fit_environment import render_environment
from sira_mi.sg.lights_io import write_lights
from sira_mi.sg.shading import shade_tensor
from sira_mi.sg.weak_lobes import radiance_bounds, select_lobes, white_radiance
from studies.data import read_figures
from studies.leave_out import page

# A key, a dome and three lobes that are far too dim to be seen.
LOBES = np.array(
    [
        [-0.5, 0.4, 0.76, 6, 2.0, 1.8, 1.5],
        [0.3, 0.1, 0.9, 40, 1e-4, 2e-4, 1e-4],
        [0, 1, 0, 0.5, 0.3, 0.35, 0.4],
        [0.9, 0.1, 0.4, 200, 1e-3, 0, 1e-3],
        [0, 0, 1, 1e-3, 1e-5, 1e-5, 1e-5],
    ],
    np.float32,
)
SIZE = 24


@pytest.fixture(scope="module")
def blob(avatar, avatar_path):
    """A nearly convex head."""
    return Subject(Path(avatar_path), avatar, camera(40.0, SIZE))


@pytest.fixture(scope="module")
def mean_head(tmp_path_factory):
    """The prior's mean head, which shadows itself, with albedo networks of the shipped sizes."""
    prior = load_avatar(PRIOR)
    view = camera(30.0, SIZE)
    place = view.world_to_camera.copy()
    place[2, 3] = 12.0
    return Subject(PRIOR, prior, replace(camera(60.0, SIZE), world_to_camera=place))


def everything(integrator: str, **options) -> RelightSettings:
    """Settings that leave nothing out, but for networks inside of path tracing."""
    return RelightSettings(integrator, **{"samples": 4, "voxel": 0.15, **options})


def picture(subject, light, settings, yaw=0.0):
    return render_passes(load_scene(load_head(subject, settings), subject.camera, light, yaw, settings), settings)[
        ..., :3
    ]


def by_name(plan: Plan) -> dict[str, Decision]:
    return {d.name: d for d in plan.decisions}


def random_directions(rng, count):
    v = rng.standard_normal((3, count))
    return (v / np.linalg.norm(v, axis=0)).astype(np.float32)


def test_no_surface_reflects_more_of_a_lobe_than_the_bound():
    """The bound of each lobe against the closed form at random points; the closed form itself errs by up to 5%."""
    rng = np.random.default_rng(0)
    for roughness, k_s, reflectivity in ((0.2, 1.0, 1.0), (0.5, 1.0, 0.05), (0.7, 2.0, 0.3), (0.5, 0.0, 0.5)):
        normal, view = random_directions(rng, 2000), random_directions(rng, 2000)
        albedo = 0.8
        for sharpness in (1e-3, 0.5, 8.0, 300.0, 2e4):
            lobe = np.array([[*random_directions(rng, 1)[:, 0], sharpness, 0.5, 2.0, 1.0]], np.float32)
            tensors = [mi.TensorXf(np.ascontiguousarray(v)) for v in (normal, view)]
            irradiance, specular = shade_tensor(
                *tensors, mi.Float(reflectivity), mi.Float(roughness), mi.TensorXf(lobe)
            )
            truth = albedo / np.pi * irradiance.numpy() + k_s * specular.numpy()
            bound = radiance_bounds(lobe, roughness, k_s, albedo, largest_reflectance(reflectivity, roughness))
            assert truth.max() <= 1.05 * bound[0]
            assert k_s > 0 or sharpness > 1e3 or truth.max() > 0.8 * bound[0], "far from tight"


def test_white_is_no_brighter_than_a_surface_can_be():
    """The unit of all errors against irradiance in many directions: never larger, and not far from it."""
    normal = fibonacci_directions(2000).T.astype(np.float32)
    for lobes in (LOBES, small_avatar().tensors["lobes"]):
        irradiance, _ = shade_tensor(
            *[mi.TensorXf(np.ascontiguousarray(normal))] * 2, mi.Float(0.0), mi.Float(0.5), mi.TensorXf(lobes)
        )
        largest = irradiance.numpy().max() / np.pi
        assert 0.7 * largest < white_radiance(lobes) < 1.01 * largest


def test_the_weakest_lobes_go_together():
    bounds = np.array([3.0, 1e-4, 5e-4, 1.0, 3e-4])
    assert select_lobes(bounds, 1e-3).tolist() == [0, 3]
    assert select_lobes(bounds, 3.9e-4).tolist() == [0, 2, 3, 4]
    assert select_lobes(bounds, 100.0).tolist() == [0], "the strongest stays"


def test_bounces_in_a_closed_room_are_powers_of_the_albedo():
    """In a room of one albedo a whose walls shine with radiance 1, n bounces leave aⁿ, and all that follow the sum of
    the series."""
    rng = np.random.default_rng(1)
    normal = random_directions(rng, 50)
    walls = np.full((64, 50), 7)
    room = Surface(normal, normal, np.full((3, 50), 0.5), np.zeros((1, 50)), walls)
    parts = reflect_bounces(room, None, 0.5, 0.0, 0.0)
    for n in range(6):
        np.testing.assert_allclose(parts[n], 0.5 ** (n + 1), rtol=0.1)
    np.testing.assert_allclose(parts[-1], parts[-2], rtol=0.1)
    assert all((part == 0).all() for part in reflect_bounces(replace(room, neighbour=walls * 0 - 1), None, 0.5, 1, 1))


def test_a_plan_is_carried_out_and_switched_off():
    decisions = (
        Decision(
            "a",
            "picture",
            True,
            "why",
            1e-3,
            changes={"max_depth": 4},
            error=1e-4,
            noise=1e-5,
            saved=0.25,
            saved_spread=0.02,
        ),
        Decision("b", "picture", False, "why not", changes={"visibility": False}),
        Decision("c", "picture", True, "it is 0"),
    )
    plan = Plan(decisions)
    settings = plan.apply(RelightSettings())
    assert settings.max_depth == 4 and settings.visibility and plan.bound == 1e-3
    kept = plan.keep_all()
    assert kept.apply(RelightSettings()) == RelightSettings() and kept.bound == 0
    assert not any(kept.leaves_out(name, "picture") for name in "abc")
    text = explain(plan)
    assert "bound 1.0e-03, measured 1.0e-04 ± 1.0e-05, 25 ± 2 % of the time saved" in text and text.count("\n") == 2
    assert json.loads(json.dumps(plan.report()))[0]["changes"] == {"max_depth": 4}


@pytest.mark.slow
def test_closed_form_pictures_with_and_without_the_plan(blob):
    """Each decision about the closed form alone changes no pixel by more than its bound, and all together neither."""
    light, settings = Light(LOBES), everything("sg")
    plan = plan_relight(blob, light, load_head(blob, settings), settings, [20.0])
    found = by_name(plan)
    assert found["weak lobes"].changes["kept_lobes"] == (0, 2)
    assert not found["specular term"].left_out
    white, reference = white_radiance(LOBES), picture(blob, light, settings, 20.0)
    for decision in plan.decisions:
        assert not decision.left_out or decision.bound <= TOLERANCE
        if decision.left_out and "crop" not in decision.changes:
            changed = picture(blob, light, Plan((decision,)).apply(settings), 20.0)
            assert np.abs(changed - reference).max() <= decision.bound * white + 1e-6, decision.name
    planned = replace(plan.apply(settings), crop=False)
    assert np.abs(picture(blob, light, planned, 20.0) - reference).max() <= plan.bound * white + 1e-6
    assert (picture(blob, light, replace(planned, kept_lobes=(0,)), 20.0) != reference).any()


@pytest.mark.slow
def test_shared_shadings_change_pixels_by_less_than_their_bound(blob):
    """On a film whose pixels are small enough to share, with as much tolerance as that takes."""
    light, settings = Light(LOBES), everything("sg")
    near = replace(blob, camera=camera(120.0, 4 * SIZE))
    shape = load_head(near, settings)
    name = "a shading for every sample"
    found = by_name(plan_relight(near, light, shape, settings, [0.0]))[name]
    assert not found.left_out and found.bound > TOLERANCE, "the blob's albedo changes within a pixel"
    decision = by_name(plan_relight(near, light, shape, settings, [0.0], tolerance=0.5))[name]
    assert decision.left_out
    first, second = (picture(near, light, one) for one in (settings, Plan((decision,)).apply(settings)))
    difference = np.abs(first - second).max(axis=2)
    assert 0 < difference.max() <= decision.bound * white_radiance(LOBES)
    assert (difference > 0).sum() > 0.5 * (first.max(axis=2) > 0).sum()
    alone = replace(settings, samples=1)
    assert name not in by_name(plan_relight(near, light, shape, alone, [0.0]))


@pytest.mark.slow
def test_visibility_is_left_out_of_convex_shapes_only(blob, mean_head):
    """Nothing of a convex shape is shadowed and the picture stays as it is; a head shadows itself under light from
    above, and under a flash at the camera it still lights its own hollows."""
    settings = everything("sg", samples=1)
    decision = by_name(plan_relight(blob, Light(LOBES), load_head(blob, settings), settings, [0.0]))["visibility"]
    assert decision.left_out and decision.bound <= TOLERANCE
    first, second = (picture(blob, Light(LOBES), replace(settings, visibility=v)) for v in (True, False))
    assert np.abs(first - second).max() <= decision.bound * white_radiance(LOBES) + 1e-6

    shape = load_head(mean_head, settings)
    for direction in ((0, 1, 0.3), (0, 0, 1)):
        light = Light(np.array([[*direction, 20, 3, 3, 3]], np.float32))
        decision = by_name(plan_relight(mean_head, light, shape, settings, [0.0]))["visibility"]
        first, second = (picture(mean_head, light, replace(settings, visibility=v)) for v in (True, False))
        assert not decision.left_out
        assert np.abs(first - second).max() > TOLERANCE * white_radiance(light.lobes)


@pytest.mark.slow
def test_late_bounces_add_less_than_their_bound(mean_head):
    """Path tracing to the planned depth against ten more bounces: the bound, where the tolerance is generous, is not
    met by two bounces less."""
    light, settings = Light(LOBES[[0, 2]]), everything("path", samples=128)
    shape = load_head(mean_head, settings)
    decision = by_name(plan_relight(mean_head, light, shape, settings, [0.0], tolerance=0.02))["late bounces"]
    assert decision.left_out and 0 < decision.bound <= 0.02
    depth = decision.changes["max_depth"]
    assert 3 <= depth <= 9
    white = white_radiance(light.lobes)
    pictures = {}
    for one in (2, depth, depth + 10):
        scene = load_scene(shape, mean_head.camera, light, 0.0, replace(settings, max_depth=one))
        pictures[one] = render_passes(scene, settings)[..., :3].reshape(4, 6, 4, 6, 3).mean(axis=(1, 3))
    lost = pictures[depth + 10] - pictures[depth]
    assert np.abs(lost).max() <= decision.bound * white + 0.002 * white, "noise of 4608 samples a block"
    assert (pictures[depth + 10] - pictures[2]).max() > 0.002 * white, "there are bounces"


@pytest.mark.slow
def test_without_a_specular_term_nothing_of_it_is_computed(avatar, tmp_path):
    """k_s = 0: the plan leaves the specular term out; the closed form stays the same, path tracing within its noise."""
    save_avatar(tmp_path / "matt.safetensors", replace(avatar, k_s=0.0))
    matt = Subject(tmp_path / "matt.safetensors", replace(avatar, k_s=0.0), camera(40.0, SIZE))
    light = Light(LOBES)
    for integrator, samples, allowed in (("sg", 4, 1e-6), ("path", 256, 0.02)):
        settings = everything(integrator, samples=samples)
        shape = load_head(matt, settings)
        decision = by_name(plan_relight(matt, light, shape, settings, [0.0]))["specular term"]
        assert decision.left_out and decision.bound == 0
        almost = Subject(matt.path, replace(matt.avatar, k_s=1e-9), matt.camera)
        first = picture(almost, light, settings).reshape(4, 6, 4, 6, 3).mean(axis=(1, 3))
        second = picture(matt, light, replace(settings, specular=False)).reshape(4, 6, 4, 6, 3).mean(axis=(1, 3))
        np.testing.assert_allclose(second, first, rtol=0, atol=allowed * first.max())
        assert first.max() > 0.1


@pytest.mark.slow
def test_no_ray_beside_the_window_meets_the_head(blob, mean_head):
    """The window holds every pixel that the head covers, is not much larger, and is the whole film for a camera inside
    the head; a picture of the window alone is the same but for its random numbers."""
    for subject in (blob, mean_head):
        settings = everything("sg", visibility=False)
        shape = load_head(subject, settings)
        for yaw in (0.0, 70.0):
            image = render_passes(load_scene(shape, subject.camera, Light(LOBES), yaw, settings), settings)
            x, y, width, height = head_window(shape, orbit(subject.camera, yaw))
            rows, columns = np.nonzero(image[..., 3] > 0)
            assert x <= columns.min() and columns.max() < x + width and columns.min() - x < 4
            assert y <= rows.min() and rows.max() < y + height and rows.min() - y < 4
            cropped = load_scene(shape, subject.camera, Light(LOBES), yaw, replace(settings, crop=True))
            cropped = render_passes(cropped, settings)
            assert cropped.shape == image.shape
            both = (image[..., 3] == 1) & (cropped[..., 3] == 1)
            assert both.sum() > 0.7 * (image[..., 3] > 0).sum()
            difference, mean = (cropped - image)[both][:, :3], image[both][:, :3].mean()
            assert np.abs(difference).mean() < 0.1 * mean and abs(difference.mean()) < 0.01 * mean
    inside = camera(40.0, SIZE)
    inside.world_to_camera[2, 3] = 0.0
    assert head_window(shape, inside) == (0, 0, SIZE, SIZE)


def test_an_image_is_planned_by_lobes_of_its_light():
    """The lobes that stand for an image bring its irradiance, roughly, whatever its size."""
    lobes = LOBES[[0, 2]]
    normal = fibonacci_directions(200).T.astype(np.float32)
    values = []
    for light in (lobes, approximate_lobes(Light(None, render_environment(lobes, 37)))):
        irradiance, _ = shade_tensor(
            *[mi.TensorXf(np.ascontiguousarray(normal))] * 2, mi.Float(0.0), mi.Float(0.5), mi.TensorXf(light)
        )
        values.append(irradiance.numpy())
    np.testing.assert_allclose(values[1], values[0], atol=0.06 * values[0].max())


@pytest.mark.slow
def test_what_is_measured_stays_below_its_bound(blob):
    light, settings = Light(LOBES), everything("sg")
    plan = plan_relight(blob, light, load_head(blob, settings), settings, [0.0])
    for decision in measure_plan(plan, blob, light, settings, 0.0, size=16).decisions:
        if decision.left_out and decision.changes:
            assert decision.error <= decision.bound + 1.5 * decision.noise + 1e-6, decision.name
            assert decision.saved is not None


def test_the_points_of_a_surface_repeat_and_lie_on_it(blob):
    shape = load_head(blob, everything("sg"))
    first, second = sample_surface(shape), sample_surface(shape)
    for name in Surface.__dataclass_fields__:
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))
    assert ((first.albedo >= 0) & (first.albedo <= 1)).all() and np.ptp(first.albedo) > 0.1
    np.testing.assert_allclose(np.linalg.norm(first.normal, axis=0), 1, atol=1e-4)


@pytest.fixture(scope="module")
def task(tmp_path_factory):
    """The appearance stages of a tiny fit of the example."""
    settings, prior = tiny_fit(steps=4), load_avatar(PRIOR)
    settings = replace(settings, stages=tuple(s for s in settings.stages if isinstance(s, AppearanceStage)))
    folder = tmp_path_factory.mktemp("fit")
    portrait = read_portrait(FitRequest(None, folder, example=True), settings, prior)
    return FitTask(portrait, prior, PRIOR, settings, folder, settings.plan())


@pytest.mark.slow
def test_a_fit_with_and_without_the_plan_is_the_same(task):
    """What the stages leave out is 0 or was computed before: gradients and results differ by rounding at most."""
    taken = {(d.name, d.where) for d in task.plan.decisions if d.left_out}
    base = "base albedo at every step"
    assert taken == {("specular term", "light"), ("specular term", "albedo"), (base, "light"), (base, "refinement")}
    start = initial_state(task.prior, 0)
    for decision in measure_fit(task, start).decisions:
        assert decision.error is not None and decision.error <= 1e-5, decision
    results = []
    for plan in (task.plan, task.plan.keep_all()):
        progress = Progress(start)
        fit_portrait(task.with_plan(plan), progress, seed=0)
        results.append(progress.state)
    for name, value in results[0].arrays().items():
        np.testing.assert_allclose(value, results[1].arrays()[name], rtol=0, atol=1e-5, err_msg=name)
    assert not np.array_equal(results[0].avatar["z_a"], start.avatar["z_a"])


@pytest.mark.slow
def test_a_changed_base_albedo_is_computed_again(task):
    """The base albedo of a stage that holds it is that of the state at hand, also after another stage moved it."""
    stage, index = task.settings.stages[-2], np.arange(10)
    state = initial_state(task.prior, 0)
    once, always = (stage.problem(task.with_plan(plan), state) for plan in (task.plan, task.plan.keep_all()))
    values = []
    for z_a in (state.avatar["z_a"], state.avatar["z_a"] + 0.5):
        for problem in (once, always):
            problem.refresh(state.with_parameters({"z_a": z_a}))
            values.append(problem._base_and_skin(problem._fixed, index)[0].numpy())
        np.testing.assert_allclose(values[-2], values[-1], atol=1e-6)
    assert np.abs(values[0] - values[2]).max() > 1e-3


@pytest.mark.slow
def test_relight_explains_and_keeps_all(avatar_path, tmp_path, monkeypatch, capsys):
    default = RelightSettings.__init__
    monkeypatch.setitem(measure._SAMPLES, "sg", 1)
    monkeypatch.setattr(RelightSettings, "__init__", lambda self, *a, **k: default(self, *a, **{**k, "voxel": 0.2}))
    write_lights(tmp_path / "lights.json", LOBES)
    common = [
        avatar_path,
        "--lights",
        str(tmp_path / "lights.json"),
        "--integrator",
        "sg",
        "--spp",
        "8",
        "--size",
        "16",
    ]
    assert relight([*common, "--explain", "--out", str(tmp_path / "planned")]) == 0
    words = capsys.readouterr().out
    for name in ("weak lobes", "visibility", "a shading for every sample", "pixels beside the head", "specular term"):
        assert name in words
    assert "measured" in words and "time saved" in words
    assert relight([*common, "--keep-all", "--out", str(tmp_path / "all")]) == 0
    first, second = (np.array(mi.Bitmap(str(tmp_path / f"{name}.exr"))) for name in ("planned", "all"))
    inside = (first.min(axis=2) > 0.05) & (second.min(axis=2) > 0.05)
    assert inside.sum() > 20 and np.median(np.abs(first - second)[inside]) < 0.03 * second[inside].mean()
    assert first.max() > 0.1


def test_the_page_in_docs_is_that_of_its_figures():
    """`docs/leave_out.md` is `docs/data/leave_out.json` in the template, in at most 700 words; no field is left."""
    docs = Path(__file__).resolve().parent.parent / "docs"
    text = (docs / "leave_out.md").read_text(encoding="utf-8")
    assert text == page.render_page(read_figures(docs / page.FIGURES)), "run python -m studies.leave_out --page"
    assert len(text.split()) <= 700 and "$" not in text


def test_the_page_of_a_measured_plan(blob):
    """Decisions as they are measured fill the page."""
    plan = plan_relight(blob, Light(LOBES), load_head(blob, everything("sg")), everything("sg"), [0.0])
    decisions = [{**d, "error": 1e-5, "noise": None, "saved": 0.25, "saved_spread": 0.02} for d in plan.report()]
    figures = {
        "measured": {"revision": "abc", "date": "2026-11-22"},
        "command": "python -m studies.leave_out AVATAR",
        "size": 16,
        "tolerance": TOLERANCE,
        "pictures": [{"title": "a blob", "decisions": decisions}],
        "fit": [decisions[0]],
    }
    text = page.render_page(figures)
    assert "a blob: weak lobes" in text and "- specular term: it may add" in text and "25 ± 2 %" in text
