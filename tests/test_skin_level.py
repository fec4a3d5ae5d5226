"""What photos tell of the level of their skin's albedo, measured on portraits whose albedo is known."""

import numpy as np
import pytest
from egg import SIZE, SKIN, head_like, landmarks_on, truth_of

from sira_mi.conventions import LUMINANCE
from sira_mi.errors import InputError
from sira_mi.evaluate import __main__ as command
from sira_mi.evaluate.portraits import skin_level
from sira_mi.evaluate.portraits.skin_level import Observation, estimate, true_luminance
from sira_mi.fit.skin import SkinCues


def observations(noise: float, heads: int = 12, lights: int = 5) -> list[Observation]:
    """Skin of log luminance -1 + 0.2 log radiance + 0.6 contrast, off by one `noise` a head."""
    rng = np.random.default_rng(0)
    found = []
    for head in range(heads):
        off = noise * rng.standard_normal()
        for _ in range(lights):
            radiance, contrast = rng.uniform(-3, 0), rng.uniform(-2, 0.5)
            level = np.exp(-1 + 0.2 * radiance + 0.6 * contrast + off)
            found.append(Observation(str(head), SkinCues(float(np.exp(radiance)), contrast), float(level)))
    return found


def test_least_squares_find_the_law_of_the_cues():
    """Exactly without noise; portraits without eyes do not count; the error is that of heads left out, so that it is
    near the noise and above what remains of it."""
    exact = observations(0.0)
    blind = Observation("blind", SkinCues(0.1, None), 9.0)
    found = estimate([*exact, blind], eyes=True)
    np.testing.assert_allclose(found.coefficients, [-1, 0.2, 0.6], atol=1e-9)
    assert found.error < 1e-9
    noisy = observations(0.3)
    with_eyes, without = estimate(noisy, eyes=True), estimate(noisy, eyes=False)
    design = np.array([[1, np.log(o.cues.radiance), o.cues.over_white] for o in noisy])
    remains = design @ with_eyes.coefficients - np.log([o.luminance for o in noisy])
    assert np.sqrt((remains**2).mean()) < with_eyes.error < 0.45 < without.error
    for few in (exact[:10], exact[:15]):
        with pytest.raises(InputError, match="are needed"):
            estimate(few, eyes=True)


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


def test_the_command_prints_the_constants_of_the_fit(monkeypatch, capsys, tmp_path):
    """Coefficients and errors by skin alone and with the eyes, or one line that says what is missing."""
    monkeypatch.setattr("sys.argv", ["evaluate", "skin", "--benchmark", str(tmp_path)])
    with pytest.raises(InputError, match="no benchmark"):
        command.main()
    monkeypatch.setattr(skin_level, "observe", lambda folder: (observations(0.0), ["blind"]))
    command.main()
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("60 portraits") and lines[0].endswith("unseen: 1")
    assert lines[2] == "by skin and eyes: -1.00, 0.20, 0.60; error 0.00"
    monkeypatch.setattr(skin_level, "observe", lambda folder: ([], ["blind"]))
    with pytest.raises(InputError, match="0 portraits of 0 heads"):
        command.main()
