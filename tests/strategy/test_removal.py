"""What the removal of each Gaussian changes, against the image without it, and which are not worth their place."""

import numba
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from minisplat_ref.constants import GSPLAT_MAIN
from minisplat_ref.errors import InputError
from minisplat_ref.rendering import SPLATTING, RenderSettings, Request, render, render_vjp
from minisplat_ref.rendering.backends import CPU, REFERENCE
from minisplat_ref.strategy.removal import RemovalCosts, collect_removal_costs, select_worthwhile
from minisplat_ref.types import Model, View, view_from
from scenes import as_dtype, make_camera, make_gaussians
from tolerances import PARITY_FLOAT32_IMAGE, PARITY_FLOAT64, REMOVAL

N = 20
BACKGROUND = np.array([0.2, 0.3, 0.4])


@pytest.fixture
def camera(rng):
    return make_camera(37, 29, fx=40, fy=45, rng=rng)


@pytest.fixture
def gaussians(rng):
    """Thin enough that no pixel stops early; at the end one behind the camera and one too faint to be drawn."""
    gaussians = make_gaussians(rng, N, size=0.2, opacity_logit=-1)
    gaussians.means[-2, 2] = -5
    gaussians.opacity_logits[-1] = -9
    return gaussians


def changes_of(gaussians, camera, backend):
    """S, by the renderer."""
    request = Request(BACKGROUND, backend=backend, wants=frozenset({"removal_changes"}))
    return SPLATTING.render(Model(gaussians), view_from(camera), request)[0].extras["removal_changes"]


def render_without(gaussians, camera, backend, without=None):
    is_visible = None if without is None else np.arange(len(gaussians.means)) != without
    return render(gaussians, camera, background=BACKGROUND, backend=backend, is_visible=is_visible)[0].image


# One view -------------------------------------------------------------------------------------------------------------


def test_it_is_the_squared_change_of_the_image_without_each(backend, gaussians, camera):
    gaussians.opacity_logits[0] = 9  # clamped
    whole = render_without(gaussians, camera, backend)
    expected = [np.sum((render_without(gaussians, camera, backend, i) - whole) ** 2) for i in range(N)]
    changes = changes_of(gaussians, camera, backend)
    assert_allclose(changes, expected, rtol=REMOVAL, atol=REMOVAL)
    assert np.count_nonzero(changes) >= 15 and not changes[-2:].any()


def test_with_the_gradient_it_is_the_change_of_the_squared_error(backend, gaussians, camera, rng):
    """SSE without i - SSE = S_i - o dSSE/do, and dSSE/d logit = (1 - o) o dSSE/do."""
    photograph = rng.uniform(size=(29, 37, 3))
    output, tape = render(gaussians, camera, background=BACKGROUND, backend=backend)
    residual = output.image - photograph
    v_logits = render_vjp(tape, 2 * residual).gaussians.opacity_logits
    gradients = v_logits * (1 + np.exp(gaussians.opacity_logits))  # divided by 1 - o
    without = [np.sum((render_without(gaussians, camera, backend, i) - photograph) ** 2) for i in range(N)]
    exact = without - np.sum(residual**2)
    assert_allclose(changes_of(gaussians, camera, backend) - gradients, exact, rtol=REMOVAL, atol=REMOVAL)
    assert exact.min() < 0 < exact.max()  # some are in the way


@pytest.mark.parametrize(("dtype", "tolerance"), [(np.float64, PARITY_FLOAT64), (np.float32, PARITY_FLOAT32_IMAGE)])
def test_kernels_agree_with_the_reference(camera, rng, dtype, tolerance):
    """Where pixels stop early, too, and where tiles end at the edge of the image."""
    gaussians = as_dtype(make_gaussians(rng, 60, size=0.3, opacity_logit=3), dtype)
    expected = changes_of(gaussians, camera, REFERENCE)
    assert_allclose(changes_of(gaussians, camera, CPU), expected, rtol=tolerance, atol=tolerance * expected.max())
    endless = GSPLAT_MAIN._replace(transmittance_min=0.0)
    assert render(gaussians, camera, conventions=endless)[0].alpha.max() > 1 - GSPLAT_MAIN.transmittance_min  # they do


def test_same_bytes_with_one_thread_and_two(gaussians, camera):
    threads, results = numba.get_num_threads(), []
    try:
        for n in (1, min(2, numba.config.NUMBA_NUM_THREADS)):
            numba.set_num_threads(n)
            results.append(changes_of(gaussians, camera, CPU))
    finally:
        numba.set_num_threads(threads)
    assert_array_equal(*results)


def test_an_empty_population(backend, camera, gaussians):
    nobody = type(gaussians)(*(field[:0] for field in gaussians))
    assert changes_of(nobody, camera, backend).shape == (0,)


# Several views --------------------------------------------------------------------------------------------------------


def test_costs_are_sums_over_views(gaussians, camera, rng):
    """A masked pixel is no error."""
    photographs = rng.integers(0, 256, (2, 29, 37, 3), dtype=np.uint8)
    mask = rng.uniform(size=(29, 37)) < 0.5
    cameras = [camera, make_camera(37, 29)]
    views = [View(str(i), cameras[i], photographs[i], (None, mask)[i]) for i in range(2)]
    costs = collect_removal_costs(gaussians, views, RenderSettings(BACKGROUND))
    assert_allclose(costs.changes, sum(changes_of(gaussians, own, CPU) for own in cameras), rtol=PARITY_FLOAT64)
    errors = [(render_without(gaussians, own, CPU) - p / 255) ** 2 for own, p in zip(cameras, photographs, strict=True)]
    assert_allclose(costs.squared_error, errors[0].sum() + errors[1][mask].sum(), rtol=PARITY_FLOAT32_IMAGE)
    assert_allclose(costs.slopes, N * costs.changes / costs.squared_error, rtol=PARITY_FLOAT64)


def test_a_renderer_that_does_not_say(gaussians, camera):
    def render(model, view, request):
        return SPLATTING.render(model, view, request._replace(wants=frozenset()))

    views = [View("a", camera, np.zeros((29, 37, 3), np.uint8), None)]
    with pytest.raises(InputError, match="renderer silent does not say"):
        silent = SPLATTING._replace(name="silent", render=render)
        collect_removal_costs(gaussians, views, RenderSettings(BACKGROUND, renderer=silent))


def test_what_is_not_worth_its_place():
    """Four of five slopes are below 1; half of five are two, those of the least slopes, of equals the first."""
    costs = RemovalCosts(np.array([0.8, 0.0, 8.0, 1.6, 1.6]), 10.0)
    assert_allclose(costs.slopes, [0.4, 0.0, 4.0, 0.8, 0.8])
    assert_array_equal(select_worthwhile(costs, 1.0, 1.0), [2])
    assert_array_equal(select_worthwhile(costs, 1.0, 0.5), [2, 3, 4])
    assert_array_equal(select_worthwhile(costs, 1.0, 0.7), [2, 4])
    assert_array_equal(select_worthwhile(costs, 0.0, 1.0), np.arange(5))


def test_without_an_error_everything_that_changes_is_worth_it():
    assert_array_equal(RemovalCosts(np.array([0.0, 2.0]), 0.0).slopes, [0.0, np.inf])


def exact_costs(gaussians, views):
    """Return the exact change of the squared error by each removal, ``S - o dSSE/do``, where alpha is not clamped."""
    changes, squared_error = np.zeros(N), 0.0
    request = Request(BACKGROUND, backend=CPU, wants=frozenset({"removal_changes"}))
    for view in views:
        output, tape = SPLATTING.render(Model(gaussians), view, request)
        residual = output.image - view.image / np.float32(255.0)
        v_logits = SPLATTING.render_vjp(tape, 2 * residual, None).gaussians.opacity_logits
        changes += output.extras["removal_changes"] - v_logits * (1 + np.exp(gaussians.opacity_logits))
        squared_error += float(np.sum(residual**2, dtype=np.float64))  # v_logit = o (1 - o) v_o
    return RemovalCosts(changes, squared_error)


def test_the_exact_change_is_that_of_the_photographs_squared_error(gaussians, camera, rng):
    """S is the part of it that is no gradient, and the whole is that of the images without each Gaussian."""
    photographs = rng.integers(0, 256, (2, 29, 37, 3), dtype=np.uint8)
    views = [View(str(i), camera, photographs[i], None) for i in range(2)]

    def squared_error(without=None):
        image = render_without(gaussians, camera, CPU, without)
        return np.sum((image - photographs / np.float32(255)) ** 2)

    costs = exact_costs(gaussians, views)
    assert_allclose(costs.squared_error, squared_error(), rtol=PARITY_FLOAT64)
    expected = [squared_error(i) - squared_error() for i in range(N)]
    assert_allclose(costs.changes, expected, rtol=REMOVAL, atol=REMOVAL)
