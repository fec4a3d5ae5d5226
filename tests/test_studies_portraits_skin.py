"""The study of the skin's level: what photos say of the albedo, on portraits whose albedo is known."""

import numpy as np
import pytest
from egg import SIZE, SKIN, head_like, landmarks_on, truth_of

from sira_mi.conventions import LUMINANCE
from sira_mi.errors import InputError
from sira_mi.fit.skin import Eye, SkinCues
from studies.portraits import __main__ as command
from studies.portraits import measure_skin
from studies.portraits.measure_skin import Observation, estimate, true_luminance


def observations(noise: float, heads: int = 40, lights: int = 3, misleading: float = 0.2) -> list[Observation]:
    """Skin whose log luminance is the contrast of an eye less 1, off by `noise` an eye, where the darker eye of some
    portraits shows any contrast."""
    rng = np.random.default_rng(0)
    found = []
    for head in range(heads):
        level = rng.uniform(-2.6, -1.1)
        for _ in range(lights):
            contrasts = level + 1 + noise * rng.standard_normal(2)
            whites = np.array([-1.0, -1.2])
            if rng.random() < misleading:
                contrasts[1], whites[1] = rng.uniform(-1.9, 0.0), -2.5
            eyes = tuple(Eye(float(c), float(w)) for c, w in zip(contrasts, whites, strict=True))
            found.append(Observation(str(head), SkinCues(float(rng.uniform(0.1, 0.3)), eyes), float(np.exp(level))))
    return found


@pytest.mark.slow
def test_the_fit_finds_the_law_of_the_cues():
    """The white of the eyes, in spite of eyes that mislead; portraits without eyes count for brightness alone. The
    error is that of heads left out: near the noise, and far below what brightness tells."""
    blind = Observation("blind", SkinCues(0.1, ()), 0.2)
    found = estimate([*observations(0.1), blind])
    assert found.level.white == pytest.approx(-1, abs=0.1)
    assert 0.05 < found.error < 0.15 < 0.4 < found.error_by_skin
    assert found.level.darker > 0
    for few in (observations(0.1)[:10], observations(0.1, heads=3, lights=5)):
        with pytest.raises(InputError, match="are needed"):
            estimate(few)


def test_the_true_level_is_that_of_skin_near_the_landmarks():
    """Of one colour it is that colour's; what is not skin does not count."""
    vertices, faces = head_like()
    landmarks = landmarks_on(vertices)
    landmarks[[6, 197, 50]] = vertices[np.argmax(vertices[:, 2])]
    truth = truth_of(vertices, faces, landmarks=landmarks)
    truth.diffuse_albedo[truth.mask > 0] = (0.3, 0.2, 0.1)
    assert true_luminance(truth) == pytest.approx(np.array([0.3, 0.2, 0.1]) @ LUMINANCE, rel=1e-5)
    truth.region[truth.region == SKIN] = 1
    assert true_luminance(truth) is None
    assert truth.mask.shape == (SIZE, SIZE)


@pytest.mark.slow
def test_the_command_prints_the_constants_of_the_fit(monkeypatch, capsys, tmp_path):
    """Values and errors by skin alone and with the eyes, or one line that says what is missing."""
    monkeypatch.setattr("sys.argv", ["evaluate", "skin", "--benchmark", str(tmp_path)])
    with pytest.raises(InputError, match="no benchmark"):
        command.main()
    monkeypatch.setattr(measure_skin, "observe", lambda folder: (observations(0.1), ["blind"]))
    command.main()
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("120 portraits") and lines[0].endswith("unseen: 1")
    assert lines[1].startswith("by skin: error 0.4") and lines[2].startswith("usual -1.")
    monkeypatch.setattr(measure_skin, "observe", lambda folder: ([], ["blind"]))
    with pytest.raises(InputError, match="0 portraits of 0 heads"):
        command.main()
