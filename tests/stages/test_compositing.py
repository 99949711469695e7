import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from gradcheck import check_inner_products, check_jacobian
from minisplat_ref.constants import GSPLAT_MAIN, INRIA
from minisplat_ref.reference.compositing import composite_all_pairs
from minisplat_ref.rendering.backends import REFERENCE
from minisplat_ref.types import Projection, TileGrid
from scenes import ALL_CONVENTIONS, activated, as_dtype, make_camera, make_gaussians
from tolerances import (
    CLOSED_FORM,
    COVERAGE_MIN,
    GRADIENT_FLOOR,
    GRADIENT_STEP_IMAGE,
    PARITY_FLOAT32_GRADIENT,
    PARITY_FLOAT32_IMAGE,
    PARITY_FLOAT64,
    ROUNDED_TO_FLOAT32,
)

BLACK = np.zeros(3)  # three channels wherever statistics are collected, as for trainings: one kernel for all
NAMES = ["means2d", "conics", "opacities", "colors", "background"]


def splats(means2d, conics, opacities, depths, size=(6, 5), boxes=None):
    """Projection with boxes over the whole image of `size` (width, height)."""
    n = len(depths)
    boxes = [[0, 0, *size]] * n if boxes is None else boxes
    return Projection(
        means2d=np.array(means2d, dtype=float).reshape(n, 2),
        depths=np.array(depths, dtype=float),
        conics=np.array(conics, dtype=float).reshape(n, 3),
        opacities=np.array(opacities, dtype=float),
        radii=np.full((n, 2), 9, dtype=np.int32),
        boxes=np.array(boxes, dtype=np.int32).reshape(n, 4),
    )


def blend(backend, projection, colors, background, *, size=(6, 5), conventions=GSPLAT_MAIN, dtype=float, **options):
    grid = TileGrid(*size, backend.tile_width, backend.tile_height)
    bins = backend.bin_gaussians(projection, grid, conventions)
    return backend.composite(
        projection, np.array(colors, dtype=dtype), np.array(background, dtype=dtype), bins, conventions, **options
    )


def as_projected(projection, dtype):
    """The projection as the kernels of a dtype make it, whose conics are float64 in any."""
    return as_dtype(projection, dtype)._replace(conics=projection.conics)


def stack(opacities, **changes):
    """Gaussians of these opacities, one behind the other, all centred on the middle of pixel (2, 1)."""
    n = len(opacities)
    return splats([[2.5, 1.5]] * n, [[0.5, 0, 0.5]] * n, opacities, np.arange(1.0, n + 1), **changes)


# --- closed form ---


def test_one_gaussian_by_hand(backend):
    projection = splats([[2.5, 1.5]], [[0.4, 0.1, 0.6]], [0.8], [3])
    output = blend(backend, projection, [[1, 2, 4]], [10, 20, 40])
    alpha = 0.8 * np.exp(-0.5 * (0.4 * 1 + 0.6 * 4) - 0.1 * 2)  # at pixel (3, 3): d = -(1, 2)
    assert_allclose(output.alpha[3, 3], alpha, rtol=CLOSED_FORM)
    assert_allclose(output.image[3, 3], np.array([1, 2, 4]) * (alpha + 10 * (1 - alpha)), rtol=CLOSED_FORM)
    assert_allclose(output.image[1, 2], [0.8 + 2, 1.6 + 4, 3.2 + 8], rtol=CLOSED_FORM)
    alpha = 0.8 * np.exp(-0.5 * (0.4 * 1 + 0.6 * 4) + 0.1 * 2)  # at pixel (1, 3): the mixed term changes its sign
    assert_allclose(output.alpha[3, 1], alpha, rtol=CLOSED_FORM)


def test_nearer_gaussians_hide_farther_ones(backend):
    projection = stack([0.5, 0.4, 0.2])._replace(depths=np.array([2.0, 1, 3]))
    output = blend(backend, projection, [[1], [10], [100]], [1000])
    assert_allclose(output.image[1, 2], [10 * 0.4 + 0.6 * (0.5 + 0.5 * (100 * 0.2 + 0.8 * 1000))], rtol=CLOSED_FORM)
    assert_allclose(output.alpha[1, 2], 1 - 0.6 * 0.5 * 0.8, rtol=CLOSED_FORM)


def test_alpha_is_clamped(backend):
    output = blend(backend, stack([1.0]), [[1]], [0])
    assert_allclose(output.alpha[1, 2], GSPLAT_MAIN.alpha_max, rtol=CLOSED_FORM)


def test_faint_hits_are_skipped(backend):
    # Alpha falls to 1/255 where exp(-d^2 / 4) = 1 / 127.5: between d = 4 and d = 5.
    projection = splats([[2.5, 1.5]], [[0.5, 0, 0.5]], [0.5], [1], size=(9, 3))
    output = blend(backend, projection, [[1]], [0], size=(9, 3))
    assert_array_equal(output.alpha[1] > 0, [True] * 7 + [False] * 2)
    assert output.alpha[1, 6] > 1 / 255


def test_hits_stay_inside_their_box():
    # Kernels look at boxes tile by tile only: with full support a box holds all that alpha reaches, INRIA's are tiles.
    projection = stack([0.9, 0.9], boxes=[[1, 0, 4, 2], [2, 1, 3, 5]])
    output = blend(REFERENCE, projection, [[1], [1]], [0], with_stats=True)
    assert_array_equal(output.stats.hit_count, [6, 4])
    assert not output.alpha[:, [0, 4, 5]].any() and not output.alpha[2:, [1, 3]].any()


@pytest.mark.parametrize("stops_at_equality", [True, False])
def test_a_pixel_stops_before_the_hit_that_would_finish_it(backend, stops_at_equality):
    # The transmittances 1, 1/2, 1/4, 1/8 are exact, so 1/4 meets the threshold exactly.
    conventions = GSPLAT_MAIN._replace(transmittance_min=0.25, stops_at_equality=stops_at_equality)
    colors = np.outer([1.0, 10, 100, 1000], [1, 2, 3])
    output = blend(backend, stack([0.5] * 4), colors, BLACK, conventions=conventions, with_stats=True)
    n_hits = 1 if stops_at_equality else 2
    assert_allclose(output.image[1, 2] / [1, 2, 3], np.full(3, 0.5 if stops_at_equality else 3), rtol=CLOSED_FORM)
    assert_allclose(output.alpha[1, 2], 1 - 0.5**n_hits, rtol=CLOSED_FORM)


def test_a_stopped_pixel_takes_no_later_fainter_hit(backend):
    # The second hit would leave T = 0.1 * 0.05 < 0.01; the third would leave 0.09, but the pixel is finished.
    conventions = GSPLAT_MAIN._replace(transmittance_min=0.01)
    output = blend(backend, stack([0.9, 0.95, 0.1]), [[1], [10], [100]], [0], conventions=conventions)
    assert_allclose(output.image[1, 2], [0.9], rtol=CLOSED_FORM)


def test_median_depth_by_hand(backend):
    # T: 1, 0.7, 0.49 at the centre, so the second crosses one half; from d = 1 on (alphas 0.23) nothing does.
    projection = stack([0.3, 0.3, 0.3])._replace(depths=np.array([5.0, 6, 7]))
    output = blend(backend, projection, np.ones((3, 3)), BLACK, with_median_depth=True)
    expected = np.zeros((5, 6))
    expected[1, 2] = 6
    expected[[0, 2, 1, 1], [2, 2, 1, 3]] = 7 if (1 - 0.3 * np.exp(-0.25)) ** 3 < 0.5 else 0
    assert_allclose(output.median_depth, expected, rtol=CLOSED_FORM)
    assert (expected == 7).sum() == 4


def test_exactly_one_half_is_not_below_it(backend):
    output = blend(backend, stack([0.5, 0.1]), np.ones((2, 3)), BLACK, with_median_depth=True)
    assert output.median_depth[1, 2] == 2


def test_stats_by_hand(backend):
    # The first and the third are thinner than a pixel, the second is wide along x: offsets -2 to 3 px in its row.
    projection = splats(
        [[2.5, 1.5], [2.5, 1.5], [5.5, 4.5]], [[20, 0, 20], [0.5, 0, 20], [20, 0, 20]], [0.3, 0.5, 0.9], [1, 2, 3]
    )
    stats = blend(backend, projection, np.ones((3, 3)), BLACK, with_stats=True).stats
    beside = 0.5 * np.exp(-0.25 * np.array([4, 1, 1, 4, 9]))
    assert_allclose(stats.blend_weight_sum, [0.3, 0.7 * 0.5 + beside.sum(), 0.9], rtol=CLOSED_FORM)
    assert_allclose(
        stats.blend_weight_max, [0.3, beside[1], 0.9], rtol=CLOSED_FORM
    )  # 0.39 beside, 0.35 behind the first
    assert_array_equal(stats.hit_count, [1, 6, 1])
    assert_array_equal(stats.dominant_count, [0, 6, 1])  # 0.35 > 0.3 on the shared pixel
    expected = np.full((5, 6), -1)
    expected[1] = 1
    expected[4, 5] = 2
    assert_array_equal(stats.dominant_ids, expected)


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_the_largest_weight_of_many_tiles(backend, dtype):
    # The wide one covers all tiles and is half hidden at its centre, so its largest weight is a pixel beside it; the
    # faint one is hit nowhere and the last one lies behind pixels that are finished.
    projection = splats(
        [[20.5, 18.5]] * 4,
        [[20, 0, 20], [0.002, 0, 0.002], [0.002, 0, 0.002], [20, 0, 20]],
        [0.5, 0.95, 0.003, 0.9],
        [1, 2, 3, 4],
        size=(40, 36),
    )
    conventions = GSPLAT_MAIN._replace(transmittance_min=0.024)  # below 0.5 * 0.05, above 0.1 times that
    stats = blend(
        backend,
        as_projected(projection, dtype),
        np.ones((4, 3)),
        BLACK,
        size=(40, 36),
        conventions=conventions,
        with_stats=True,
        dtype=dtype,
    ).stats
    assert stats.hit_count[1] > 1000 and stats.blend_weight_max.dtype == dtype
    expected = [0.5, 0.95 * np.exp(-0.001), 0, 0]
    assert_allclose(stats.blend_weight_max, expected, rtol=CLOSED_FORM if dtype == np.float64 else ROUNDED_TO_FLOAT32)


def test_the_front_most_of_equal_weights_dominates(backend):
    # Half, then all of the other half: an opaque hit needs thresholds that let the transmittance become zero.
    conventions = GSPLAT_MAIN._replace(alpha_max=1.0, transmittance_min=0.0, stops_at_equality=False)
    projection = stack([0.5, 1.0])._replace(depths=np.array([2.0, 1]))
    stats = blend(backend, projection, np.ones((2, 3)), BLACK, conventions=conventions, with_stats=True).stats
    assert stats.dominant_ids[1, 2] == 1 and stats.blend_weight_sum[1] > 1
    stats = blend(backend, stack([0.5, 1.0]), np.ones((2, 3)), BLACK, conventions=conventions, with_stats=True).stats
    assert stats.dominant_ids[1, 2] == 0


def test_a_negative_square_is_no_hit(backend):
    projection = splats([[2.5, 1.5]], [[-0.1, 0, 0.1]], [0.5], [1])
    output = blend(backend, projection, np.ones((1, 3)), BLACK, with_stats=True)
    assert_allclose(output.alpha[1, 2], 0.5, rtol=CLOSED_FORM)  # the square is zero there
    assert not output.alpha[1, [0, 1, 3, 4, 5]].any()


@pytest.mark.parametrize("n_channels", [0, 1, 3, 5])
def test_any_number_of_channels(backend, rng, n_channels):
    projection = stack([0.5, 0.4])
    colors, background = rng.normal(size=(2, n_channels)), rng.normal(size=n_channels)
    output = blend(backend, projection, colors, background)
    assert output.image.shape == (5, 6, n_channels)
    assert_allclose(output.image[1, 2], 0.5 * colors[0] + 0.2 * colors[1] + 0.3 * background, rtol=1e2 * CLOSED_FORM)
    v_image, v_alpha = rng.normal(size=output.image.shape), rng.normal(size=(5, 6))
    bins = backend.bin_gaussians(projection, TileGrid(6, 5, backend.tile_width, backend.tile_height), GSPLAT_MAIN)
    gradient = backend.composite_vjp(projection, colors, background, bins, GSPLAT_MAIN, output, v_image, v_alpha)
    assert gradient.colors.shape == (2, n_channels) and gradient.background.shape == (n_channels,)
    assert gradient.opacities.all()


@pytest.mark.parametrize("n_channels", [0, 3])
def test_no_gaussians_show_the_background(backend, n_channels):
    background = np.arange(1.0, n_channels + 1)
    projection = splats([], [], [], [])
    options = {"with_stats": True, "with_median_depth": True}
    output = blend(backend, projection, np.zeros((0, n_channels)), background, **options)
    assert_array_equal(output.image, np.broadcast_to(background, (5, 6, n_channels)))
    assert not output.alpha.any() and not output.median_depth.any()
    assert (output.stats.dominant_ids == -1).all() and output.stats.hit_count.shape == (0,)
    grid = TileGrid(6, 5, backend.tile_width, backend.tile_height)
    bins = backend.bin_gaussians(projection, grid, GSPLAT_MAIN)
    v_image = np.ones((5, 6, n_channels))
    gradient = backend.composite_vjp(
        projection, np.zeros((0, n_channels)), background, bins, GSPLAT_MAIN, output, v_image, np.ones((5, 6))
    )
    assert_allclose(gradient.background, np.full(n_channels, 30.0), rtol=CLOSED_FORM)
    assert [field.shape for field in gradient[:4]] == [(0, 2), (0, 3), (0,), (0, n_channels)]


# --- against the recursion over all pairs ---


@pytest.mark.parametrize("conventions", ALL_CONVENTIONS, ids=lambda c: c.name)
def test_tiles_change_nothing(backend, conventions, rng):
    projection = REFERENCE.project(
        *activated(make_gaussians(rng, 60, size=0.3, opacity_logit=2)), make_camera(37, 29, fx=40, fy=45), conventions
    )
    colors, background = rng.uniform(size=(60, 3)), rng.uniform(size=3)
    image, alpha = composite_all_pairs(projection, colors, background, 37, 29, conventions)
    assert alpha.mean() > COVERAGE_MIN and alpha.max() > 1 - 1e-3  # some pixels come to their stop
    output = blend(backend, projection, colors, background, size=(37, 29), conventions=conventions, with_stats=True)
    assert_allclose(output.image, image, rtol=0, atol=PARITY_FLOAT64)
    assert_allclose(output.alpha, alpha, rtol=0, atol=PARITY_FLOAT64)
    assert_allclose(output.stats.blend_weight_sum.sum(), alpha.sum(), rtol=PARITY_FLOAT64)
    assert output.stats.dominant_count.sum() == (alpha > 0).sum()


@pytest.mark.parametrize("conventions", ALL_CONVENTIONS, ids=lambda c: c.name)
def test_statistics_of_single_weights(backend, conventions, rng):
    # A channel of one's own is an image of one's weights.
    projection = REFERENCE.project(
        *activated(make_gaussians(rng, 40, size=0.3, opacity_logit=2)), make_camera(37, 29, fx=40, fy=45), conventions
    )
    weights, _ = composite_all_pairs(projection, np.eye(40), np.zeros(40), 37, 29, conventions)  # [H, W, N]
    stats = blend(
        backend, projection, np.zeros((40, 0)), [], size=(37, 29), conventions=conventions, with_stats=True
    ).stats
    assert (weights.max(axis=(0, 1)) > 0).sum() > 20
    assert_allclose(stats.blend_weight_sum, weights.sum(axis=(0, 1)), rtol=PARITY_FLOAT64)
    assert_allclose(stats.blend_weight_max, weights.max(axis=(0, 1)), rtol=0, atol=PARITY_FLOAT64)
    assert_array_equal(stats.hit_count, (weights > 0).sum(axis=(0, 1)))
    assert_array_equal(stats.dominant_ids, np.where(weights.any(axis=2), weights.argmax(axis=2), -1))


@pytest.mark.parametrize("tile", [(16, 16), (5, 7), (64, 1)])
def test_any_tile_size_gives_the_same_image(rng, tile):
    projection = REFERENCE.project(*activated(make_gaussians(rng, 30)), make_camera(37, 29), GSPLAT_MAIN)
    colors, background = rng.uniform(size=(30, 3)), rng.uniform(size=3)
    image, _ = composite_all_pairs(projection, colors, background, 37, 29, GSPLAT_MAIN)
    bins = REFERENCE.bin_gaussians(projection, TileGrid(37, 29, *tile), GSPLAT_MAIN)
    output = REFERENCE.composite(projection, colors, background, bins, GSPLAT_MAIN)
    assert output.alpha.mean() > COVERAGE_MIN
    assert_allclose(output.image, image, rtol=0, atol=PARITY_FLOAT64)


# --- gradient ---


def functions_of_arrays(backend, projection, size, conventions, inputs):
    """`composite` and `composite_vjp` over the arrays with a gradient.

    The image jumps where a hit comes or goes, so no difference may be taken across one: the hits are counted.
    """
    hit_counts = []
    grid = TileGrid(*size, backend.tile_width, backend.tile_height)

    def bins_of(footprints):
        return backend.bin_gaussians(footprints, grid, conventions)

    def function(means2d, conics, opacities, colors, background):
        moved = projection._replace(means2d=means2d, conics=conics, opacities=opacities)
        output = backend.composite(moved, colors, background, bins_of(moved), conventions, with_stats=True)
        hit_counts.append(output.stats.hit_count)
        assert_array_equal(hit_counts[-1], hit_counts[0], "a hit came or went: take a smaller step")
        return output.image, output.alpha

    def vjp(v_image, v_alpha):
        means2d, conics, opacities, colors, background = inputs
        here = projection._replace(means2d=means2d, conics=conics, opacities=opacities)
        bins = bins_of(here)
        output = backend.composite(here, colors, background, bins, conventions)
        return backend.composite_vjp(here, colors, background, bins, conventions, output, v_image, v_alpha)

    return function, vjp


@pytest.mark.parametrize("n_channels", [1, 3, 5])
def test_composite_jacobian(n_channels, rng):
    size = (6, 5)
    projection = splats(
        rng.uniform(1, 5, size=(3, 2)), [[0.3, 0.1, 0.4], [0.5, -0.2, 0.3], [0.2, 0, 0.2]], [0.8, 0.6, 0.9], [2, 1, 3]
    )
    inputs = (
        *projection[:1],
        projection.conics,
        projection.opacities,
        rng.normal(size=(3, n_channels)),
        rng.normal(size=n_channels),
    )
    function, vjp = functions_of_arrays(REFERENCE, projection, size, GSPLAT_MAIN, inputs)
    check_jacobian(function, vjp, inputs, names=NAMES)


@pytest.mark.parametrize("conventions", ALL_CONVENTIONS, ids=lambda c: c.name)
def test_composite_gradient_of_many(backend, conventions, rng):
    size = (40, 30)
    camera = make_camera(*size, fx=45, fy=40)
    projection = REFERENCE.project(*activated(make_gaussians(rng, 40, size=0.25, opacity_logit=2)), camera, conventions)
    # INRIA's gradients pass through the clamp, which no difference can; there it must not be met.
    opacities = projection.opacities * (1 if conventions.clamp_stops_mean_gradient else 0.95)
    projection = projection._replace(opacities=opacities)
    inputs = (projection.means2d, projection.conics, opacities, rng.normal(size=(40, 3)), rng.normal(size=3))
    function, vjp = functions_of_arrays(backend, projection, size, conventions, inputs)
    image, alpha = function(*inputs)
    assert alpha.mean() > COVERAGE_MIN
    cotangents = (rng.normal(size=image.shape), rng.normal(size=alpha.shape))
    check_inner_products(function, vjp(*cotangents), inputs, cotangents, rng, names=NAMES, step=GRADIENT_STEP_IMAGE)


def test_gradient_of_an_output_from_elsewhere(fast_backend, rng):
    projection = stack([0.3, 0.6, 0.5])
    inputs = (projection, rng.uniform(size=(3, 3)), rng.uniform(size=3))
    grid = TileGrid(6, 5, fast_backend.tile_width, fast_backend.tile_height)
    bins = fast_backend.bin_gaussians(projection, grid, GSPLAT_MAIN)
    output = fast_backend.composite(*inputs, bins, GSPLAT_MAIN)
    assert output.saved is not None
    v = rng.normal(size=(5, 6, 3)), rng.normal(size=(5, 6))
    gradients = [
        fast_backend.composite_vjp(*inputs, bins, GSPLAT_MAIN, any_output, *v)
        for any_output in (output, output._replace(saved=None))
    ]
    assert all(np.abs(part).max() > GRADIENT_FLOOR for part in gradients[0])
    for ours, theirs in zip(*gradients, strict=True):
        assert_array_equal(ours, theirs)


@pytest.mark.parametrize("stops_mean", [True, False])
@pytest.mark.parametrize("stops_shape", [True, False])
def test_what_passes_a_clamped_alpha(backend, stops_mean, stops_shape):
    # One pixel, one Gaussian with o E = 0.9975 > 0.99, d = (0.1, 0); v_alpha = 1 - T_end's derivative 0 - ... = 1.
    conventions = GSPLAT_MAIN._replace(clamp_stops_mean_gradient=stops_mean, clamp_stops_shape_gradient=stops_shape)
    projection = splats([[0.6, 0.5]], [[0.5, 0, 0.5]], [1.0], [1], size=(1, 1))
    bins = backend.bin_gaussians(projection, TileGrid(1, 1, backend.tile_width, backend.tile_height), conventions)
    colors, background = np.zeros((1, 1)), np.zeros(1)
    output = backend.composite(projection, colors, background, bins, conventions)
    gradient = backend.composite_vjp(
        projection, colors, background, bins, conventions, output, np.zeros((1, 1, 1)), np.ones((1, 1))
    )
    falloff = np.exp(-0.0025)
    assert_allclose(output.alpha, 0.99, rtol=CLOSED_FORM)
    assert_allclose(gradient.means2d, [[0 if stops_mean else -0.05 * falloff, 0]], rtol=1e2 * CLOSED_FORM)
    assert_allclose(gradient.opacities, [0 if stops_shape else falloff], rtol=1e2 * CLOSED_FORM)
    assert_allclose(gradient.conics, [[0 if stops_shape else -0.005 * falloff, 0, 0]], rtol=1e2 * CLOSED_FORM)


def test_alpha_gradient_behind_a_clamped_hit(backend, rng):
    # What lies behind a clamped hit still gets its gradient; the clamped one keeps that of its colour.
    projection = stack([1.0, 0.7, 0.6])
    inputs = (projection.means2d, projection.conics, projection.opacities, rng.normal(size=(3, 3)), rng.normal(size=3))
    function, vjp = functions_of_arrays(backend, projection, (6, 5), GSPLAT_MAIN, inputs)
    cotangents = [rng.normal(size=output.shape) for output in function(*inputs)]
    check_inner_products(function, vjp(*cotangents), inputs, cotangents, rng, names=NAMES)


def test_no_gradient_beyond_the_stop(backend):
    conventions = GSPLAT_MAIN._replace(transmittance_min=0.2)
    projection = stack([0.7, 0.8, 0.5], size=(1, 1))
    projection.means2d[:] = 0.5
    bins = backend.bin_gaussians(projection, TileGrid(1, 1, backend.tile_width, backend.tile_height), conventions)
    colors = np.array([[1.0], [2], [3]])
    output = backend.composite(projection, colors, np.zeros(1), bins, conventions)
    gradient = backend.composite_vjp(
        projection, colors, np.zeros(1), bins, conventions, output, np.ones((1, 1, 1)), np.ones((1, 1))
    )
    assert_allclose(gradient.opacities, [2, 0, 0], rtol=CLOSED_FORM)  # colour 1 plus alpha 1
    assert_allclose(gradient.colors, [[0.7], [0], [0]], rtol=CLOSED_FORM)


# --- parity ---


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("conventions", ALL_CONVENTIONS, ids=lambda c: c.name)
def test_backends_agree(fast_backend, conventions, dtype, rng):
    size = (64, 48)
    camera = make_camera(*size, fx=70, fy=75)
    projection = REFERENCE.project(*activated(make_gaussians(rng, 80, size=0.2, opacity_logit=1)), camera, conventions)
    colors, background = rng.uniform(size=(80, 3)), rng.uniform(size=3)
    v_image, v_alpha = rng.normal(size=(48, 64, 3)), rng.normal(size=(48, 64))
    results = []
    for backend, kind in ((REFERENCE, np.float64), (fast_backend, dtype)):
        p, c, b = as_projected(projection, kind), colors.astype(kind), background.astype(kind)
        bins = backend.bin_gaussians(p, TileGrid(*size, backend.tile_width, backend.tile_height), conventions)
        output = backend.composite(p, c, b, bins, conventions, with_stats=True, with_median_depth=True)
        v = backend.composite_vjp(p, c, b, bins, conventions, output, v_image.astype(kind), v_alpha.astype(kind))
        results.append((output, v))
    (expected, v_expected), (actual, v_actual) = results
    assert expected.alpha.mean() > COVERAGE_MIN
    assert actual.image.dtype == actual.alpha.dtype == dtype

    # A hit within float32 rounding of a threshold flips; such pixels are counted, not averaged away.
    is_exact = dtype == np.float64
    forward = PARITY_FLOAT64 if is_exact else PARITY_FLOAT32_IMAGE
    assert_array_equal(actual.stats.hit_count, expected.stats.hit_count)
    assert_array_equal(actual.stats.dominant_ids, expected.stats.dominant_ids)
    assert_array_equal(actual.stats.dominant_count, expected.stats.dominant_count)
    assert_allclose(actual.image, expected.image, rtol=0, atol=forward)
    assert_allclose(actual.alpha, expected.alpha, rtol=0, atol=forward)
    assert_allclose(actual.median_depth, expected.median_depth, rtol=forward)
    weight_sums = expected.stats.blend_weight_sum
    assert_allclose(actual.stats.blend_weight_sum, weight_sums, rtol=0, atol=forward * weight_sums.max())
    assert_allclose(actual.stats.blend_weight_max, expected.stats.blend_weight_max, rtol=0, atol=forward)
    assert actual.stats.blend_weight_sum.dtype == actual.stats.blend_weight_max.dtype == dtype
    assert v_actual.conics.dtype == np.float64
    for a, e in zip(v_actual, v_expected, strict=True):
        assert (a.dtype == dtype or a is v_actual.conics) and np.abs(e).max() > GRADIENT_FLOOR
        assert_allclose(a, e, rtol=0, atol=(PARITY_FLOAT64 if is_exact else PARITY_FLOAT32_GRADIENT) * np.abs(e).max())


# --- bounds of the kernels, which know what they leave out ---


@pytest.mark.parametrize("direction", ["up and down", "left and right"])
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_no_hit_at_the_rim_is_lost(fast_backend, dtype, direction, rng):
    """Where the ellipse is widest stands a pixel whose alpha is alpha_min, or a rounding more or less.

    The kernels look for such a pixel in the rows, columns and tiles that they computed the ellipse to reach, with
    roundings of their own. Which alpha they have for it is seen where alpha_min is lower and the ellipse reaches on.
    """
    width, height, n_across = 2 * fast_backend.tile_width, 4 * fast_backend.tile_height, 32
    n = n_across**2  # each in a part of the image of its own
    corners = np.stack(np.divmod(np.arange(n), n_across)[::-1], axis=1) * [width, height]  # [N, 2]
    rims = corners + np.array([width // 2, height // 2])  # first pixel of a tile
    rims[::2] -= 1  # or the last of the one before
    distances = np.where(np.arange(n) % 2, 1, -1) * rng.uniform(3, 9, n)  # to the mean, the tile's way
    a, c = rng.uniform(0.02, 0.1, (2, n))
    b = rng.uniform(-0.8, 0.8, n) * np.sqrt(a * c)
    along = [-b / a * distances, distances] if direction == "up and down" else [distances, -b / c * distances]
    means2d = (rims + 0.5 + np.stack(along, axis=1)).astype(dtype)

    def sigmas():
        dx, dy = (means2d.astype(np.longdouble) - (rims + 0.5)).T
        return (0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy).astype(float)

    a, b, c = np.array([a, b, c]) * rng.uniform(4.5, 5.4, n) / sigmas()  # the fainter the more roundings
    boxes = np.hstack([corners, corners + np.array([width, height])])
    opacities = GSPLAT_MAIN.alpha_min * np.exp(sigmas())
    projection = splats(means2d, np.stack([a, b, c], axis=1), opacities, np.ones(n), boxes=boxes)
    projection = as_projected(projection, dtype)
    alphas = []
    for conventions in (GSPLAT_MAIN, GSPLAT_MAIN._replace(alpha_min=GSPLAT_MAIN.alpha_min / 2)):
        size, colors = (n_across * width, n_across * height), np.ones((n, 1))
        output = blend(fast_backend, projection, colors, [0], size=size, dtype=dtype, conventions=conventions)
        alphas.append(output.image[rims[:, 1], rims[:, 0], 0])
    is_hit = alphas[1] >= dtype(GSPLAT_MAIN.alpha_min)
    assert 0.2 < is_hit.mean() < 0.8
    assert_array_equal(alphas[0], np.where(is_hit, alphas[1], 0))


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("conic", [(4, 2, 1), (4, -2, 1), (1e-6, 1e-3, 1), (1, -1e-3, 1e-6), (1, 1 + 1e-12, 1)])
def test_a_needle_without_end(fast_backend, conic, dtype):
    """a c - b^2 has no digit left, or is below zero: sigma = a (dx + b dy / a)^2 / 2, and no bound becomes NaN."""
    size = 4 * fast_backend.tile_width, 4 * fast_backend.tile_height
    projection = as_projected(splats([[50.5, 30.5]], [conic], [0.9], [1], size=size), dtype)
    xs, ys = np.meshgrid(np.arange(size[0]) - 50, np.arange(size[1]) - 30)
    unclamped = 0.9 * np.exp(-0.5 * conic[0] * (xs + conic[1] / conic[0] * ys) ** 2)
    expected = np.where(unclamped >= GSPLAT_MAIN.alpha_min, unclamped, 0)
    assert np.abs(unclamped - GSPLAT_MAIN.alpha_min).min() > 1e-6  # none is at the threshold
    output = blend(fast_backend, projection, np.ones((1, 1)), [0], size=size, dtype=dtype)
    assert_allclose(output.alpha, expected, rtol=0, atol=PARITY_FLOAT32_IMAGE)


def test_inria_is_not_gsplat(backend, rng):
    # The profiles differ where they say so: INRIA's boxes cut what gsplat's show.
    camera = make_camera(37, 29)
    images = []
    for conventions in (GSPLAT_MAIN, INRIA):
        projection = backend.project(*activated(make_gaussians(rng, 1, opacity_logit=5)), camera, conventions)
        images.append(blend(backend, projection, [[1]], [0], size=(37, 29), conventions=conventions).image)
    assert images[0].max() > 0.5 and np.abs(images[0] - images[1]).max() > 0
