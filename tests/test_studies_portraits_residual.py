"""The shares of a photo's residual are the best linear estimate, and the loss holds albedo and light to them."""

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from conftest import camera

from sira_mi.avatar.file import PRIOR, load_avatar
from sira_mi.portrait.landmarks import EYES, LIPS
from sira_mi.portrait.portrait import Portrait

SIZE = 160
COUNT = 200_000
ALBEDO = np.array([[0.1**2], [0.04**2]])


@pytest.fixture(scope="module")
def portrait():
    """The mean head's landmarks before a camera."""
    view = camera(focal=250, size=SIZE)
    points = load_avatar(PRIOR).tensors["landmarks"] @ view.world_to_camera[:3, :3].T + view.world_to_camera[:3, 3]
    landmarks = (points @ view.K.T)[:, :2] / points[:, 2:]
    return Portrait(np.full((SIZE, SIZE, 3), 0.3), np.ones((SIZE, SIZE)), landmarks, landmarks, view, ())


def deviating(rng, grey, colour):
    """Log factors [3, N] with these deviations of their mean over channels and of the length of the rest."""
    rest = rng.standard_normal((3, COUNT))
    rest -= rest.mean(axis=0)
    return grey * rng.standard_normal(COUNT) + colour * rest / np.sqrt(2)


@pytest.mark.parametrize("light", [(0.05, 0.02), (0.3, 0.1)])
@pytest.mark.parametrize("albedo", [(0.1, 0.04), (0.4, 0.2)])
def test_the_shares_are_the_best_linear_estimate_of_the_albedo(variant, albedo, light):
    """Of a photo made of independent deviations of albedo and light, where the light's are known, and the albedo's as
    well or larger than expected: no other factor of grey or colour leaves a smaller error of the albedo."""
    from studies.portraits.residual import albedo_shares, log_residual

    rng = np.random.default_rng(3)
    true = deviating(rng, *albedo)
    radiance = np.full((3, COUNT), 20.0)
    residual = log_residual(radiance * np.exp(true + deviating(rng, *light)), radiance)
    variances = np.square(light)[:, None] * np.ones((1, COUNT))
    every = np.arange(COUNT)
    shares = albedo_shares(residual, every, ALBEDO * np.ones((1, COUNT)), variances)[:, 0]

    def error(of_grey, of_colour):
        grey = residual.mean(axis=0)
        return np.square(of_grey * grey + of_colour * (residual - grey) - true).mean()

    best = error(*shares)
    for change in ((0.07, 0), (-0.07, 0), (0, 0.07), (0, -0.07)):
        assert error(*(shares + change)) > best
    assert best < min(error(0, 0), error(1, 1))


def test_a_tie_of_another_colour_does_not_make_all_of_a_photo_albedo(variant):
    """A tenth of the pixels is far off, the rest as the light explains."""
    from studies.portraits.residual import albedo_shares

    residual = deviating(np.random.default_rng(1), 0.1, 0.04)
    residual[0, : COUNT // 10] += 2.0
    light = np.square([[0.3], [0.1]]) * np.ones((1, COUNT))
    shares = albedo_shares(residual, np.arange(COUNT), ALBEDO * np.ones((1, COUNT)), light)
    np.testing.assert_allclose(shares, (ALBEDO / (ALBEDO + light)), rtol=1e-5)


def points_of_a_ball(count: int):
    """Points of a unit ball before a camera on +z, under open sky but for a wall in the half space x > 0.5 that shades
    those behind it."""
    from sira_mi.fit.shaded import PhotoPoints

    rng = np.random.default_rng(2)
    x = rng.standard_normal((3, count))
    x[2] = np.abs(x[2])
    x = (x / np.linalg.norm(x, axis=0)).astype(np.float32)
    view = np.tile(np.float32([[0], [0], [-1]]), (1, count))
    origin, t = x - 5 * view, np.full((1, count), 5, np.float32)
    blank = np.zeros(count, int)
    return PhotoPoints(blank, blank, origin, view, t, x, x, x, (x[0] < 0.5)[None])


def test_the_light_is_uncertain_where_it_grazes_and_where_shadows_end(variant):
    """A distant light from +z that the wall blocks: small in the middle, larger towards the terminator, largest at the
    shadow's edge; of a coloured light next to a white one colour varies too. A sky of one radiance leaves the least."""
    from studies.portraits.residual import light_variances

    points = points_of_a_ball(6000)
    chosen = np.arange(0, 6000, 2)

    def grey_light(p):
        return np.repeat((np.maximum(p.normal[2], 0) * p.unoccluded[0] + 0.05)[None], 3, axis=0)

    def two_colours(p):
        return np.stack([np.maximum(p.normal[0], 0), np.maximum(-p.normal[0], 0), 0 * p.normal[0]]) + 0.3

    grey, colour = light_variances(grey_light, points, chosen, 0)
    x, _, z = points.normal
    middle, edge = (z > 0.9) & (x < 0.2), np.abs(x - 0.5) < 0.03
    grazing = (z < 0.3) & (x < 0.2)
    assert 3 * grey[middle].mean() < grey[grazing].mean() and 10 * grey[middle].mean() < grey[edge].mean()
    assert colour.max() < 5e-4
    assert light_variances(two_colours, points, chosen, 0)[1][np.abs(x) < 0.3].mean() > 10 * colour.mean()
    least = light_variances(lambda p: np.ones_like(p.normal), points, chosen, 0)
    np.testing.assert_allclose(least, np.square([[0.03], [0.02]]) * np.ones((1, 6000)), rtol=1e-5)


def test_eyes_and_mouth_may_deviate_further_than_skin(variant, portrait):
    """Where landmarks say that eyes are, or teeth; without landmarks, all is alike."""
    from studies.portraits.residual import albedo_variances

    row, column = (a.ravel() for a in np.mgrid[0:SIZE, 0:SIZE])
    grey, colour = albedo_variances(portrait, row, column).reshape(2, SIZE, SIZE)

    def at(landmarks):
        x, y = portrait.landmarks[list(landmarks)].mean(axis=0)
        return grey[int(y), int(x)], colour[int(y), int(x)]

    forehead, cheek = at([151]), at([50])
    assert forehead == cheek
    for opening in (*EYES, LIPS):
        assert at(opening)[0] > 9 * cheek[0] and at(opening)[1] > 4 * cheek[1]
    assert at([105])[0] > 2 * cheek[0]
    nowhere = np.full((468, 2), np.nan)
    faceless = replace(portrait, landmarks=nowhere, head_landmarks=nowhere)
    assert np.ptp(albedo_variances(faceless, row, column), axis=1).max() == 0


def test_the_loss_is_zero_at_the_shares_alone(variant):
    """And its gradient moves the refinement of the light towards them."""
    from studies.portraits.residual import share_loss

    rng = np.random.default_rng(4)
    base = rng.uniform(0.1, 0.5, (3, 50))
    residual = rng.uniform(-0.3, 0.3, (3, 50))
    shares = np.array([[0.2] * 50, [0.7] * 50])
    grey = residual.mean(axis=0)
    part = 0.2 * grey + 0.7 * (residual - grey)
    albedo = (base + 0.02) * np.exp(part) - 0.02

    def loss(of_light):
        return share_loss(*(mi.TensorXf(a.astype(np.float32)) for a in (base, albedo)), of_light, shares)

    right = mi.TensorXf((residual - part).astype(np.float32))
    assert loss(right).numpy().item() < 1e-6
    wrong = mi.TensorXf((residual - part + 0.1).astype(np.float32))
    dr.enable_grad(wrong)
    value = loss(wrong)
    dr.backward(value)
    assert value.numpy().item() == pytest.approx(0.02, rel=1e-3) and (dr.grad(wrong).numpy() > 0).all()
