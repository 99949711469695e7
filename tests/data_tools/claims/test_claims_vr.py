"""VR: weighted PSNR, queues and orders by hand, and the exact order against the renderer."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from data_tools.claims.vr import foveation as measures
from data_tools.claims.vr import queues
from minisplat_ref.constants import EXACT_ORDER
from minisplat_ref.extensions.vr.foveation import eccentricities
from minisplat_ref.mechanisms.orders import blending_order
from minisplat_ref.mechanisms.tangent.renderer import prepare, render_planes
from minisplat_ref.rendering import Request
from minisplat_ref.rendering.backends import REFERENCE
from minisplat_ref.types import Model, view_from
from scenes import as_dtype, make_camera, make_gaussians

CAMERA = make_camera(80, 60, fx=60.0, fy=60.0)

REQUEST = Request(np.array([0.2, 0.4, 0.6]), backend=REFERENCE)


def line_of_rays(depths, alphas):
    """G Gaussians on a line of P pixels."""
    depths, alphas = np.array(depths, float), np.array(alphas, float)
    n = depths.shape[1]
    return queues.Rays(alphas > 0, alphas, depths, np.zeros(n, int), np.arange(n))


def test_weighted_psnr_counts_the_fovea(rng):
    angles = eccentricities(CAMERA, 40, 30)
    target = np.full((60, 80, 3), 0.5)
    near, far = target.copy(), target.copy()
    near[28:32, 38:42] += 0.1
    far[:4, :4] += 0.1
    plain = np.zeros_like(angles)
    assert measures.weighted_psnr(near, target, plain) == pytest.approx(measures.weighted_psnr(far, target, plain))
    assert measures.weighted_psnr(near, target, angles) < measures.weighted_psnr(far, target, angles) - 15


def test_a_yaw_does_not_pop(rng):
    gaussians = as_dtype(make_gaussians(rng, 30, size=0.5), np.float32)
    found = measures.yaw_steps(gaussians, make_camera(), 3, 8.0, 8)
    assert max(found["tangent planes, exact order"]) < 1e-10 < 1e-3 < max(found["3DGS: EWA, by z"])


def test_a_queue_by_hand():
    """Keys 3 1 2 0 0: a queue of two passes on 1, 2, 0 and 0, then 3; steps are 1, then 1 past the 3, then 1 and 1."""
    assert queues.pass_queue([3.0, 1.0, 2.0, 0.0, 0.0], 2) == ([1, 2, 3, 4, 0], 4)
    assert queues.pass_queue([3.0, 1.0, 2.0, 0.0, 0.0], 1) == ([0, 1, 2, 3, 4], 0)
    assert queues.pass_queue([3.0, 1.0, 2.0, 0.0, 0.0], 9) == ([3, 4, 1, 2, 0], 1 + 1 + 3 + 3)
    assert queues.pass_queue([], 3) == ([], 0)


def test_the_hierarchy_has_the_published_queues():
    """64 for blocks of 4 x 4 pixels, 8 for 2 x 2, 4 for each pixel."""
    assert queues.HIERARCHY.queues == ((4, 64), (2, 8), (1, 4)) and queues.HIERARCHY.first == "tile"


def test_blocks_take_the_depth_where_a_gaussian_is_strongest():
    """Two Gaussians on four pixels in a row, listed in the wrong order for the block's strongest pixels, 3 and 0.

    The block of four sorts 5 (pixel 3 of the first) before 6 (pixel 0 of the second), that of pixels 0 and 1 sorts 6
    before 8; pixel 0 has them right, and pixel 3, which the second misses, has one.
    """
    rays = line_of_rays([[8, 8, 8, 5], [6, 6, 6, 6]], [[0.1, 0.2, 0.1, 0.9], [0.9, 0.5, 0.1, 0.0]])
    orders, n_depths, n_steps = queues.order_hits(rays, np.array([1, 0]), ((4, 3),))
    assert [order.tolist() for order in orders[:1]] == [[0, 1]] and (n_depths, n_steps) == (2, 1)
    orders, n_depths, n_steps = queues.order_hits(rays, np.array([1, 0]), ((4, 3), (2, 3), (1, 1)))
    assert [order.tolist() for order in orders] == [[1, 0], [1, 0], [0, 1], [0]]
    assert (n_depths, n_steps) == (2 + 2 + 2, 1 + 1 + 0)


def test_queues_without_limit_are_exact_and_buffers_are_those_of_the_reference(rng):
    depths, alphas = rng.uniform(1, 2, (30, 16)), rng.uniform(0, 1, (30, 16)) * (rng.uniform(size=(30, 16)) < 0.7)
    rays = queues.Rays(alphas > 0, alphas, depths, *np.divmod(np.arange(16), 4))
    for size in (1, 3, EXACT_ORDER):
        expected = blending_order(rays.is_hit, depths, size)
        found, _, _ = queues.order_hits(rays, np.arange(30), ((1, size),))
        for p, order in enumerate(found):
            assert order.tolist() == [row for row in expected[:, p] if rays.is_hit[row, p]]
    found, _, _ = queues.order_hits(rays, rng.permutation(30), ((4, 64), (2, 64), (1, 64)))
    assert all((np.diff(depths[order, p]) >= 0).all() and len(order) for p, order in enumerate(found))


def test_the_exact_order_draws_what_the_renderer_draws(rng):
    """So does the buffer of 16; a hierarchy gets fewer pairs wrong than its list, which is better than one by z."""
    model = Model(make_gaussians(rng, 150, size=0.4))
    camera = make_camera(21, 18, fx=20.0, fy=20.0)
    images, works = queues.draw(prepare(model, camera, REQUEST, None), queues.ORDERS)
    named = {stages.name: (image, work) for stages, image, work in zip(queues.ORDERS, images, works, strict=True)}
    n_listed = len(prepare(model, camera, REQUEST, None).listed().gaussian_ids)
    assert named["list by depth in the tile"][1].n_depths == n_listed  # one for each Gaussian of each tile
    for name, buffer_size in (("exact order", None), ("buffer of 16 per pixel", 16)):
        expected = render_planes(model, view_from(camera), REQUEST, buffer_size=buffer_size)[0].image
        assert_allclose(named[name][0], expected, atol=1e-12)
    wrong = [work.n_wrong for work in works]
    by_z, _, by_tile, hierarchy, *_, exact = wrong
    assert by_z > by_tile > hierarchy > exact == 0 and wrong[4] > wrong[5] > wrong[6]
    assert len({(work.n_hits, work.n_pairs) for work in works}) == 1 and works[0].n_depths == works[0].n_steps == 0
