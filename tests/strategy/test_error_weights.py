"""The error behind which each Gaussian stands, against the weights of all pairs."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from minisplat_ref.constants import GSPLAT_MAIN
from minisplat_ref.reference.compositing import composite_all_pairs
from minisplat_ref.rendering import RenderSettings, render
from minisplat_ref.rendering.backends import REFERENCE
from minisplat_ref.strategy.error_weights import collect_error_weights
from minisplat_ref.types import View
from scenes import activated, make_camera, make_gaussians
from tolerances import PARITY_FLOAT64

N = 20
BACKGROUND = np.array([0.2, 0.3, 0.4])
BEHIND, BLACK = N - 1, 0


@pytest.fixture
def gaussians(rng):
    """Bright ones, but the first, which is black beyond the clamp; the last is behind the camera."""
    gaussians = make_gaussians(rng, N, sh_degree=0, size=0.2)
    gaussians.sh_dc[:] = np.abs(gaussians.sh_dc)
    gaussians.sh_dc[BLACK] = -5.0
    gaussians.means[BEHIND, 2] = -5.0
    return gaussians


@pytest.mark.parametrize("has_mask", [False, True])
def test_it_is_the_sum_of_error_times_weight(backend, gaussians, rng, has_mask):
    cameras = [make_camera(37, 29, fx=40, fy=45, rng=rng), make_camera(30, 20)]
    views, expected = [], np.zeros(N)
    for i, camera in enumerate(cameras):
        photograph = rng.integers(0, 256, (camera.height, camera.width, 3), dtype=np.uint8)
        mask = rng.uniform(size=photograph.shape[:2]) < 0.5 if has_mask else None
        views.append(View(str(i), camera, photograph, mask))
        projection = REFERENCE.project(*activated(gaussians), camera, GSPLAT_MAIN)
        size = camera.width, camera.height
        w = composite_all_pairs(projection, np.eye(N), np.zeros(N), *size, GSPLAT_MAIN)[0]  # [H, W, N]
        image = render(gaussians, camera, background=BACKGROUND, backend=REFERENCE)[0].image
        errors = np.abs(image - photograph / 255).mean(axis=2)
        expected += np.einsum("hwn,hw->n", w, errors if mask is None else errors * mask)
    expected[BLACK] = 0.0
    weights = collect_error_weights(gaussians, views, RenderSettings(BACKGROUND, backend=backend))
    assert_allclose(weights, expected, rtol=PARITY_FLOAT64)
    assert_array_equal(np.flatnonzero(weights == 0), [BLACK, BEHIND])
