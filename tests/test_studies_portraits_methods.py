"""The benchmark's methods: what each optimises, and that fits are kept and continue from each other."""

import dataclasses
import json

import mitsuba as mi
import numpy as np
import pytest
import skimage.data
from conftest import camera, tiny_fit
from PIL import Image

from sira_mi.avatar.file import PRIOR, load_avatar
from sira_mi.errors import InputError
from sira_mi.fit.appearance import AppearanceStage
from sira_mi.fit.refinement import RefinementStage
from sira_mi.fit.settings import QUALITIES
from sira_mi.fit.shading import ShadingStage
from sira_mi.fit.stage import FitTask
from sira_mi.fit.state import FitState
from sira_mi.optimisation.adam import read_arrays
from sira_mi.portrait.portrait import Portrait
from studies.portraits import compare_methods, run_fit
from studies.portraits.fit_job import Job
from studies.portraits.methods import BY_NAME, METHODS, is_geometry
from studies.portraits.run_fit import run

DRAFT = QUALITIES["draft"]


def moved(name: str) -> set[str]:
    """The parameters that a method optimises."""
    return {parameter for stage in BY_NAME[name].settings(DRAFT).stages for parameter in stage.rates}


def test_ablations_are_those_of_the_paper():
    """Figure 4: a.3 moves the deformation but not a learned appearance; b.1 has no latents, b.2 no refinement. Pose and
    rendering network are everyone's."""
    shared = {"z_sdf", "pose", "rendering"}
    assert moved("a.3") == shared | {"deformation"}
    assert moved("a.4") == shared | {"deformation", "z_r"}
    assert moved("b.1") == {"illumination", "diffuse_albedo", "specular_albedo"}
    assert "albedo_refinement" not in moved("b.2") and "albedo_refinement" in moved("b.3")
    assert moved("b.4") - moved("b.3") == {"z_sdf", "deformation"}
    for quality in QUALITIES.values():
        assert [type(stage) for stage in BY_NAME["b.4"].settings(quality).stages].count(ShadingStage) == 1
        assert RefinementStage not in [type(stage) for stage in BY_NAME["b.7"].settings(quality).stages]
    assert moved("b.5") == {"z_l", "illumination", "z_s", "albedo_refinement"}
    assert moved("b.3") - moved("b.7") == {"light_refinement"} and moved("b.6") == moved("b.3")
    others = {method.name for method in METHODS if method.task is FitTask}
    assert {"a.4", "b.3"} < others and not {"a.3", "b.6"} & others


def test_a_method_and_what_it_goes_on_from_take_the_steps_of_the_fit():
    """Otherwise the table would compare lengths of optimisation."""
    geometry = sum(stage.steps for stage in DRAFT.stages if is_geometry(stage))
    appearance = sum(stage.steps for stage in DRAFT.stages if isinstance(stage, AppearanceStage))
    for method in METHODS:
        stages = method.settings(DRAFT).stages
        steps = sum(stage.steps for stage in stages if not isinstance(stage, ShadingStage))
        if method.after is None:
            assert steps == geometry
        elif method.name in ("b.1", "b.3", "b.4", "b.6", "b.7"):
            assert steps == appearance
    for quality in QUALITIES.values():
        stages = BY_NAME["a.4"].settings(quality).stages + BY_NAME["b.3"].settings(quality).stages
        assert stages == quality.stages


@pytest.mark.slow
def test_the_ablated_fits_differ_in_what_they_say(tmp_path):
    """a.3 compares the photo at its own exposure; in b.6 nothing blocks the light."""
    prior, nowhere = load_avatar(PRIOR), np.full((468, 2), np.nan)
    view = camera(focal=40, size=32)
    dark = Portrait(np.full((32, 32, 3), 0.01, np.float32), np.ones((32, 32), np.float32), nowhere, nowhere, view, ())
    arguments = (dark, prior, PRIOR, DRAFT, tmp_path, DRAFT.plan())
    assert BY_NAME["a.3"].task(*arguments).exposure() == 1.0
    head = mi.load_dict({"type": "neural_sdf", "avatar": str(PRIOR), "voxel": 0.16})
    open_sky, shadowed = (BY_NAME[name].task(*arguments).photo_points(dark, head) for name in ("b.6", "b.3"))
    assert open_sky.unoccluded.all() and not shadowed.unoccluded.all()
    assert np.array_equal(open_sky.normal, shadowed.normal)


@pytest.fixture(scope="module")
def photo(tmp_path_factory):
    path = tmp_path_factory.mktemp("photo") / "photo.png"
    Image.fromarray(skimage.data.astronaut()).resize((256, 256)).save(path)
    return path


TINY = tiny_fit(steps=3)


@pytest.fixture(scope="module")
def jobs(photo, tmp_path_factory):
    """A geometry and an appearance method, run."""
    runs = tmp_path_factory.mktemp("runs")
    geometry = Job(photo, "a.4", PRIOR, TINY, runs / "a.4", None)
    shaded = Job(photo, "b.2", PRIOR, TINY, runs / "b.2", runs / "a.4")
    return [(job, run(job)) for job in (geometry, shaded)]


@pytest.mark.slow
def test_a_fit_leaves_what_it_is_scored_by(jobs):
    """At the photo's size, whatever the working image's; the appearance goes on from the geometry's very tensors."""
    for job, result in jobs:
        assert "error" not in result and result["peak_memory_megabytes"] > 100
        with np.load(job.out / "head.npz") as head:
            assert head["image/mask"].shape == (256, 256) and head["image/mask"].max() == 1
            assert head["image/normal"].shape == (256, 256, 3)
            assert np.isfinite(head["landmarks"]).all(axis=1).sum() > 300
            assert ("image/final" in head.files) == (job.method == "b.2")
    before, after = (FitState.from_arrays(read_arrays(job.out / "tensors.safetensors")[0]) for job, _ in jobs)
    for name in ("reference", "rendering"):
        assert np.array_equal(before.avatar[name], after.avatar[name])
    for name in ("z_sdf", "deformation"):
        assert not np.array_equal(before.avatar[name], after.avatar[name])
    assert np.array_equal(before.pose, after.pose) and np.abs(before.pose).max() > 0


@pytest.mark.slow
def test_a_fit_is_done_once_and_again_when_what_it_depends_on_changes(jobs, monkeypatch):
    started = []

    class Process:
        exitcode = 0

        def __init__(self, target, args):
            started.append(args[0].method)

        def start(self):
            pass

        join = start

    monkeypatch.setattr(run_fit.multiprocessing, "get_context", lambda kind: type("C", (), {"Process": Process}))
    for job, result in jobs:
        assert run(job) == result
    assert started == []
    longer = dataclasses.replace(jobs[0][0], seed=1)
    with pytest.raises(RuntimeError, match="ended with code"):
        run(dataclasses.replace(longer, out=longer.out.with_name("other")))
    assert started == ["a.4"]


@pytest.mark.slow
def test_a_photo_without_a_face_is_a_result_that_says_so(tmp_path):
    """The table names what failed; it does not stop."""
    blank = tmp_path / "blank.png"
    Image.new("RGB", (128, 128), (90, 90, 90)).save(blank)
    result = run(Job(blank, "a.4", PRIOR, TINY, tmp_path / "a.4", None))
    assert "no face" in result["error"]


def test_unknown_methods_and_portraits_are_named(tmp_path):
    (tmp_path / "benchmark.json").write_text(json.dumps({"format": "sira-mi benchmark 1", "portraits": []}))
    with pytest.raises(InputError, match=r"unknown methods c\.1; known are a\.3"):
        compare_methods.compare(compare_methods.Comparison(tmp_path, tmp_path, methods=("c.1",)))
    with pytest.raises(InputError, match="no such portraits"):
        compare_methods.compare(compare_methods.Comparison(tmp_path, tmp_path, methods=("a.4",)))
