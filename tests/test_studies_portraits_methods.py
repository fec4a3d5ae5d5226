"""The benchmark's methods: what each optimises, and that fits are kept and continue from each other."""

import mitsuba as mi
import numpy as np
import pytest
from conftest import camera

from sira_mi.avatar.file import PRIOR, load_avatar
from sira_mi.fit.appearance import AppearanceStage
from sira_mi.fit.detail import DetailStage
from sira_mi.fit.refinement import AlbedoRefinementStage
from sira_mi.fit.settings import QUALITIES
from sira_mi.fit.shading import ShadingStage
from sira_mi.fit.stage import FitTask
from sira_mi.portrait.portrait import Portrait
from studies.portraits.methods import BY_NAME, METHODS, is_geometry
from studies.portraits.shared_residual import SharedResidualStage

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
        for name, refined in {"b.7": AlbedoRefinementStage, "b.8": SharedResidualStage}.items():
            assert type(BY_NAME[name].settings(quality).stages[-1]) is refined
        assert type(BY_NAME["b.3"].settings(quality).stages[-1]) is DetailStage
    assert moved("b.5") == {"z_l", "illumination", "z_s", "albedo_refinement"}
    assert moved("b.8") - moved("b.7") == {"light_refinement"} and moved("b.6") == moved("b.3") == moved("b.7")
    others = {method.name for method in METHODS if method.task is FitTask}
    assert {"a.4", "b.3"} < others and not {"a.3", "b.6"} & others


def test_a_method_and_what_it_goes_on_from_take_the_steps_of_the_fit():
    """Otherwise the table would compare lengths of optimisation."""
    geometry = sum(stage.steps for stage in DRAFT.stages if is_geometry(stage))
    appearance = sum(stage.steps for stage in DRAFT.stages if isinstance(stage, AppearanceStage))
    for method in METHODS:
        stages = method.settings(DRAFT).stages
        steps = sum(stage.steps for stage in stages if not isinstance(stage, ShadingStage))
        if method.name == "landmarks":
            assert steps == geometry + appearance
        elif method.after is None:
            assert steps == geometry
        elif method.name in ("b.1", "b.3", "b.4", "b.6", "b.7", "b.8"):
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
