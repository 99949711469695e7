"""The weight of Gaussians inside and outside masks, against the weights of all pairs."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from minisplat_ref.constants import GSPLAT_MAIN
from minisplat_ref.reference.compositing import composite_all_pairs
from minisplat_ref.rendering import RenderSettings
from minisplat_ref.rendering.backends import REFERENCE
from minisplat_ref.strategy.mask_weights import collect_mask_weights
from minisplat_ref.types import View
from scenes import activated, make_camera, make_gaussians
from tolerances import PARITY_FLOAT64

N = 20
BLACK, BEHIND = 0, N - 1


@pytest.fixture
def gaussians(rng):
    """One is black beyond the clamp, and the last is behind the camera."""
    gaussians = make_gaussians(rng, N, sh_degree=1, size=0.2)
    gaussians.sh_dc[BLACK] = -5.0
    gaussians.means[BEHIND, 2] = -5.0
    return gaussians


@pytest.mark.parametrize("masked", [(True, True), (True, False), (False, False)])
def test_they_are_sums_of_weights(backend, gaussians, rng, masked):
    cameras = [make_camera(37, 29, fx=40, fy=45, rng=rng), make_camera(30, 20)]
    views, inside, all_ = [], np.zeros(N), np.zeros(N)
    for i, (camera, has_mask) in enumerate(zip(cameras, masked, strict=True)):
        photograph = np.zeros((camera.height, camera.width, 3), np.uint8)
        mask = rng.uniform(size=photograph.shape[:2]) < 0.3 if has_mask else None
        views.append(View(str(i), camera, photograph, mask))
        projection = REFERENCE.project(*activated(gaussians), camera, GSPLAT_MAIN)
        w = composite_all_pairs(projection, np.eye(N), np.zeros(N), camera.width, camera.height, GSPLAT_MAIN)[0]
        all_ += w.sum(axis=(0, 1))  # w is [H, W, N]
        inside += np.einsum("hwn,hw->n", w, np.ones(photograph.shape[:2]) if mask is None else mask)
    found = collect_mask_weights(gaussians, views, RenderSettings(np.array([0.2, 0.3, 0.4]), backend=backend))
    assert_allclose(found, [inside, all_], rtol=PARITY_FLOAT64)
    assert_array_equal(np.flatnonzero(found[1] == 0), [BEHIND])  # the black one has its weight
    assert (found[0] < found[1]).any() == any(masked)
