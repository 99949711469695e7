"""Satellite: the frame of a photograph, shears, and consistency of views by hand."""

from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from data_tools.claims.satellite import boxes
from minisplat_ref.constants import GSPLAT_MAIN
from minisplat_ref.extensions.satellite import cameras
from minisplat_ref.extensions.satellite.model import SATELLITE
from minisplat_ref.extensions.satellite.recipe import make_shear, view_consistency
from minisplat_ref.rendering import Request
from minisplat_ref.training.losses import Rendered
from minisplat_ref.types import view_from
from plateau import plateau  # noqa: F401  (a fixture)
from tolerances import CLOSED_FORM

# --- cameras ---


@pytest.mark.parametrize("size", [(1200, 1200), (600, 1200)])
def test_the_half_diagonal_of_a_photograph_is_one(size, monkeypatch):
    """With pixels of half a metre, north up: the corners are half of 300 or 600 by 600 m away from the middle."""

    def localise(rpc, pixels, altitudes):
        return np.column_stack([pixels * [0.5, -0.5] + 1000, altitudes])

    monkeypatch.setattr(cameras, "localise", localise)
    monkeypatch.setattr(cameras, "find_zone", lambda longitude: 33)
    monkeypatch.setattr(cameras, "utm_from_degrees", lambda x, y, zone, is_south: np.column_stack([x, y]))
    frame = cameras.choose_frame([None], size, (20.0, 80.0))
    width, height = size
    assert_allclose(frame.scale, np.hypot(width, height) / 4, rtol=CLOSED_FORM)
    assert_allclose(frame.origin, [1000 + width / 4, 1000 - height / 4, 20.0], rtol=CLOSED_FORM)


# --- consistency of views ---


def rendered_of(camera, step=1):
    """Return what a shear needs: the view, the iteration."""
    return SimpleNamespace(view=view_from(camera), request=SimpleNamespace(conventions=GSPLAT_MAIN), step=step)


def test_a_shear_is_of_the_size_of_the_image():
    """Per metre at most 0.1 of half the width, and of half the height, which a third of the draws have.

    A normal variate that is kept between -1 and 1 has the variance ``1 - 2 phi(1) = 0.516``.
    """
    camera = boxes.zenith(40)._replace(height=20)
    shears = np.array([make_shear(rendered_of(camera, step), 0.1) for step in range(2_000)])
    assert_allclose(shears.max(axis=0), [2, 1], rtol=CLOSED_FORM)
    assert_allclose(shears.min(axis=0), [-2, -1], rtol=CLOSED_FORM)
    assert_allclose(shears.std(axis=0), [2 * 0.516**0.5, 0.516**0.5], rtol=0.05)  # 2,000 draws: 1 %
    assert np.abs(shears.mean(axis=0)).max() < 0.1 and abs(np.corrcoef(shears.T)[0, 1]) < 0.1
    assert_allclose(make_shear(rendered_of(camera, 3), 0.1), make_shear(rendered_of(camera, 3), 0.1), rtol=0)


CHANNELS = {"albedo": slice(3, 6), "altitude": slice(6, 7)}


def consistency(monkeypatch, plateau, shift, change=lambda image: image):
    """Return the loss of a view whose image is changed after it was rendered, by a shear that is given."""
    (model, scene), request = plateau, Request(wants=frozenset(CHANNELS))
    view = view_from(boxes.zenith(24))
    output, _ = SATELLITE.render(model, view, request)
    changed = output._replace(image=change(output.image))
    monkeypatch.setattr("minisplat_ref.extensions.satellite.recipe.make_shear", lambda *_: shift)
    rendered = Rendered(changed, CHANNELS, view, scene, model, 1, request)
    return view_consistency(rendered, altitude=0.01, color=0.1, noise=0.0, limit=1.0)[0]


@pytest.mark.parametrize("shift", [(0.3, 0.0), (0.0, 0.3), (0.25, -0.35)])
def test_views_of_a_plateau_agree(plateau, shift, monkeypatch):
    """A pixel is found where the shear has moved it; two pixels beside, the loss is ten times as large."""
    right = consistency(monkeypatch, plateau, shift)
    wrong = consistency(monkeypatch, plateau, shift, lambda image: np.roll(image, 2, axis=(0, 1)))
    assert 0 < 10 * right < wrong


@pytest.mark.parametrize(
    ("change", "value"),
    [
        ([0, 0, 0, 0.5], 0.01 * 0.5),
        ([0.2, 0.2, 0.2, 0], 0.1 * 0.6),
        ([0.3, 0, 0, 0], 0.1 * 0.3),
        ([0.2, 0.2, 0.2, 1.5], 0.0),  # something hides it
    ],
)
def test_weights_of_consistency_by_hand(plateau, change, value, monkeypatch):
    """Without a shear, views differ by what is added: altitudes weigh 0.01, albedos 0.1 in the sum of the channels."""
    added = np.array([0, 0, 0, *change])
    assert consistency(monkeypatch, plateau, (0.0, 0.0), lambda image: image + added) == pytest.approx(
        value, abs=CLOSED_FORM
    )


def test_only_pixels_that_agree_count(plateau, monkeypatch):
    """Half of them are off by 0.5 m, the others by more than the limit: the mean is that of the first."""
    added = np.zeros((24, 24, 7))
    added[:12, :, 6], added[12:, :, 6] = 0.5, 1.5
    found = consistency(monkeypatch, plateau, (0.0, 0.0), lambda image: image + added)
    assert found == pytest.approx(0.01 * 0.5, abs=CLOSED_FORM)


def test_pixels_that_leave_the_image_do_not_count(plateau, monkeypatch):
    """A shear of -1 pixel per metre moves by 6: of 24 columns 18 are seen, and only they are off by what is added."""
    added = np.zeros((24, 24, 7))
    added[:, 18:, 6] = 0.9  # of those that leave
    clean = consistency(monkeypatch, plateau, (-1.0, 0.0))
    assert consistency(monkeypatch, plateau, (-1.0, 0.0), lambda image: image + added) == pytest.approx(clean, rel=1e-6)
