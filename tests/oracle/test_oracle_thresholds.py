"""Pixels at a threshold: each kind is found where it was put, and nowhere else."""

import numpy as np
import pytest

from minisplat_ref.constants import GSPLAT_MAIN
from minisplat_ref.oracle.hard_cases.scenes import camera, gaussians, rotation_quat
from minisplat_ref.oracle.hard_cases.subjects import cast
from minisplat_ref.oracle.thresholds import thresholds, thresholds_of_view
from minisplat_ref.oracle.tolerances import FLOAT32_RENDERER, IMAGE, OWN_KERNELS
from minisplat_ref.reference.covariance import rotation_matrices
from minisplat_ref.rendering import render
from minisplat_ref.rendering.backends import CPU, REFERENCE
from minisplat_ref.types import Projection, TileGrid

ULP = float(np.spacing(np.float32(3)))
FAR = 0.01  # relative distance from a threshold that no margin bridges


def flat_layers(alphas, depths=None):
    """Layers of these alphas over 4 x 3 pixels, and the thresholds there; a conic of 1e-30 does not fall off."""
    n = len(alphas)
    depths = np.arange(1.0, n + 1) if depths is None else np.array(depths)
    boxes = np.tile(np.array([0, 0, 4, 3], np.int32), (n, 1))
    conics = np.tile([1e-30, 0, 1e-30], (n, 1))
    projection = Projection(np.full((n, 2), 2.0), depths, conics, np.array(alphas), np.full((n, 2), 4, np.int32), boxes)
    grid = TileGrid(4, 3, REFERENCE.tile_width, REFERENCE.tile_height)
    return projection, REFERENCE.bin_gaussians(projection, grid, GSPLAT_MAIN)


def found(alphas, depths=None, margins=FLOAT32_RENDERER, **options):
    """Whether jumps, kinks and medians are found; the same in every pixel."""
    at = thresholds(*flat_layers(alphas, depths), GSPLAT_MAIN, margins, **options)
    masks = at.jumps, at.kinks, at.medians
    assert all(mask.shape == (3, 4) and mask.all() == mask.any() for mask in masks)
    assert ((at.allowance > 0) == at.jumps).all() and (at.is_near == at.jumps | at.kinks).all()
    return tuple(bool(mask.all()) for mask in masks)


@pytest.mark.parametrize("margins", [FLOAT32_RENDERER, OWN_KERNELS], ids=["renderer", "kernels"])
@pytest.mark.parametrize(
    ("kind", "alphas_at", "expected"),
    [
        ("skip", lambda x: [0.3, x * GSPLAT_MAIN.alpha_min], (True, False, False)),
        ("clamp", lambda x: [x * GSPLAT_MAIN.alpha_max], (False, True, False)),
        ("stop", lambda x: [0.95, 0.96, 1 - x * GSPLAT_MAIN.transmittance_min / (0.05 * 0.04)], (True, False, False)),
        ("median", lambda x: [1 - 0.5 * x], (False, False, True)),
    ],
)
def test_each_threshold_is_found_as_far_as_its_margin(kind, alphas_at, expected, margins):
    margin = getattr(margins, kind)
    for sign in (-1, 1):
        assert found(alphas_at(1 + 0.5 * sign * margin), margins=margins) == expected
        assert found(alphas_at(1 + 2 * sign * margin), margins=margins) == (False, False, False)


def test_neighbours_in_depth_are_found_unless_they_are_equal_or_nothing():
    near = 1 + FLOAT32_RENDERER.order / 2
    assert found([0.3, 0.4], [2.0, 2.0 * near]) == (True, False, False)
    assert found([0.3, 0.4], [2.0, 2.0]) == (False, False, False), "the lower row comes first in every renderer"
    assert found([0.3, 0.4], [3.0, 3.0 + ULP], OWN_KERNELS) == (False, False, False), "they sort by float32 numbers"
    assert found([0.3, 0.4], [3.0, 3.0 + 0.1 * ULP], OWN_KERNELS) == (True, False, False), "these are one float32"
    assert found([0.3, 0.4], [2.0, 2.0 * (1 + FAR)]) == (False, False, False)


def test_where_a_gaussian_is_steep_the_rounding_of_its_place_decides():
    """At 3.5 px alpha is 2e-6 of itself beside alpha_min: it falls by 2.5 of itself a pixel, 2.5 px from the mean."""
    projection, bins = flat_layers([(1 + 2e-6) * GSPLAT_MAIN.alpha_min * np.exp(2.5**2 / 2)])
    at = {}
    for conic in (1, 0):  # falling off along x, and flat
        p = projection._replace(means2d=np.array([[6.0, 1.5]]), conics=np.array([[conic, 0, 1e-30]]))
        at[conic] = thresholds(p, bins, GSPLAT_MAIN, OWN_KERNELS).jumps
    assert at[1][:, 3].all() and not at[1][:, :3].any() and not at[0].any()
    still = OWN_KERNELS._replace(place=0.0)
    assert not thresholds(p._replace(conics=np.array([[1.0, 0, 1e-30]])), bins, GSPLAT_MAIN, still).jumps.any()


def test_behind_the_stop_nothing_is_found():
    at_skip = GSPLAT_MAIN.alpha_min
    assert found([0.9, 0.9, at_skip]) == (True, False, False)
    assert found([0.98, 0.98, 0.98, at_skip]) == (False, False, False)


def test_allowance_is_what_the_hit_can_change():
    alpha_min = GSPLAT_MAIN.alpha_min
    projection, bins = flat_layers([0.3, alpha_min])
    at = thresholds(projection, bins, GSPLAT_MAIN, span=2.0)
    assert np.allclose(at.allowance, 2 * 0.7 * alpha_min * (1 + FLOAT32_RENDERER.skip), rtol=1e-12)
    swapped = thresholds(*flat_layers([0.3, 0.4], [2.0, 2.0 + 1e-7]), GSPLAT_MAIN)
    assert np.allclose(swapped.allowance, 0.3 * 0.4, rtol=1e-12), (
        "0.3 + 0.7 * 0.4 or 0.4 + 0.6 * 0.3: each moves by 0.12"
    )


def test_all_hits_of_one_depth_may_change_places():
    """Not neighbours in the list alone: what does not hit the pixel stands between, and each may pass any other."""
    depths = [2.0, 2.0 + 1e-7, 2.0 + 2e-7]
    one_between = thresholds(*flat_layers([0.3, 0.001, 0.4], depths), GSPLAT_MAIN)
    assert np.allclose(one_between.allowance, 0.3 * 0.4, rtol=1e-12)
    three = thresholds(*flat_layers([0.3, 0.2, 0.4], depths), GSPLAT_MAIN)
    assert np.allclose(three.allowance, 0.3 * 0.2 + 0.3 * 0.4 + 0.2 * 0.4, rtol=1e-12)
    behind = thresholds(*flat_layers([0.5, 0.3, 0.2, 0.4], [1.0, *depths]), GSPLAT_MAIN)
    assert np.allclose(behind.allowance, 0.5 * three.allowance, rtol=1e-12)
    two_groups = thresholds(*flat_layers([0.3, 0.4, 0.2, 0.1], [2.0, 2.0 + 1e-7, 3.0, 3.0 + 1e-7]), GSPLAT_MAIN)
    assert np.allclose(two_groups.allowance, 0.3 * 0.4 + 0.42 * 0.2 * 0.1, rtol=1e-12)
    many = thresholds(*flat_layers([0.2] * 9, list(2 + 1e-7 * np.arange(9))), GSPLAT_MAIN)
    assert np.allclose(many.allowance, 1, rtol=1e-12), "never more than all the light"


def test_a_tie_at_the_stop_moves_all_that_is_left():
    """Which of two opaque hits ends the pixel, and is left out, depends on their order."""
    at = thresholds(*flat_layers([0.9, 0.99, 0.98], [1.0, 2.0, 2.0 + 1e-7]), GSPLAT_MAIN)
    assert np.allclose(at.allowance, 0.1, rtol=1e-12)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_wall_before_a_turned_camera_is_explained(dtype):
    """Its depths differ by less than float32 can tell: order by float32 depths is that of the rows."""
    rng, R = np.random.default_rng(0), rotation_matrices(rotation_quat(0.7, (1, 2, 3))[None])[0]
    on_wall = np.column_stack([rng.uniform((-1.6, -1.2), (1.6, 1.2), size=(100, 2)), np.full(100, 4.0)])
    wall = gaussians(on_wall @ R, 0.05, logits=rng.normal(1, 1, 100))
    view = camera(80, 58, fx=100.0, fy=100.0, cam_from_world_R=R)
    expected, tape = render(wall, view, backend=REFERENCE)
    at = thresholds_of_view(tape.splats)
    assert np.ptp(tape.splats.projection.depths) < 1e-6 and (at.allowance == 0).any()
    output, _ = render(cast(wall, np.dtype(dtype)), view, backend=CPU)
    error = np.abs(output.image - expected.image).max(axis=2)
    assert (error > 0.1).any() == (dtype == np.float32), "by float32 depths the image is another"
    assert (error <= IMAGE.of(dtype) + at.allowance).all()


def test_slack_widens_skip_and_stop():
    at_stop = 1 - (1 + FAR) * GSPLAT_MAIN.transmittance_min / (0.05 * 0.04)
    for alphas in (
        [0.3, GSPLAT_MAIN.alpha_min * (1 - FAR)],
        [0.3, GSPLAT_MAIN.alpha_min * (1 + FAR)],
        [0.95, 0.96, at_stop],
    ):
        assert found(alphas) == (False, False, False) and found(alphas, slack=2 * FAR) == (True, False, False)
