"""Optional loss terms on the rendered depth: SfM points, smooth depth, smooth normals."""

import numba
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from gradcheck import check_inner_products, check_jacobian
from minisplat_ref.extensions.geometry import EXTENSION, kernels, reference
from minisplat_ref.extensions.geometry.reference import (
    depth_normals,
    depth_normals_vjp,
    edge_weights,
    normal_smoothness,
    normal_smoothness_vjp,
)
from minisplat_ref.extensions.geometry.weights import GeometricWeights
from minisplat_ref.oracle.gradients import jacobian_case
from minisplat_ref.oracle.pieces import tiny_setting
from minisplat_ref.rendering import Request, render, render_vjp
from minisplat_ref.training.losses import Rendered
from minisplat_ref.types import Gaussians, Model, RenderOutput, Scene, View
from scenes import make_camera, make_gaussians
from tolerances import (
    CLOSED_FORM,
    COVERAGE_MIN,
    GRADIENT_FLOOR,
    PARITY_FLOAT32_GRADIENT,
    PARITY_FLOAT32_LOSS,
    PARITY_FLOAT64,
)

NO_POINTS = np.zeros((0, 3))


def functions_of(backend):
    """Return the module whose functions the loss terms use under a backend."""
    return kernels if backend.is_compiled else reference


SFM = GeometricWeights(sfm_depth=1.0)
DEPTH = GeometricWeights(depth_smoothness=1.0)
NORMALS = GeometricWeights(normal_smoothness=1.0)
ALL = GeometricWeights(0.7, 1.3, 2.1)
TERMS = {"points": SFM, "depth": DEPTH, "normals": NORMALS, "all": ALL}


def slopes(camera):
    """Return x/z and y/z [H, W] of the pixel centres."""
    ys, xs = np.mgrid[: camera.height, : camera.width] + 0.5
    return (xs - camera.cx) / camera.fx, (ys - camera.cy) / camera.fy


def plane_depth(camera, normal, offset):
    """Return the depth [H, W] of the plane ``normal . X = offset`` in the camera frame."""
    s, t = slopes(camera)
    return offset / (normal[0] * s + normal[1] * t + normal[2])


def lift(camera, columns, rows, depths):
    """Return the world points at image positions and depths."""
    x = (np.asarray(columns) - camera.cx) / camera.fx * depths
    y = (np.asarray(rows) - camera.cy) / camera.fy * depths
    in_camera = np.column_stack([x, y, np.broadcast_to(depths, x.shape)])
    return (in_camera - camera.cam_from_world_t) @ camera.cam_from_world_R


def flat_photograph(camera):
    return np.full((camera.height, camera.width, 3), 0.5)


def loss_of(backend, depth, camera, weights, *, photograph=None, points=NO_POINTS, alpha=1.0, mask=None):
    """Return the loss of an expected depth map that is seen with an opacity."""
    alpha = np.broadcast_to(alpha, depth.shape).astype(depth.dtype)
    photograph = flat_photograph(camera) if photograph is None else photograph
    return functions_of(backend).geometric_loss(alpha * depth, alpha, photograph, camera, points, weights, mask)


def rough_view(rng, camera):
    """Return accumulated depth, opacity, photograph and points of a bumpy surface with holes and a rotated camera."""
    shape = camera.height, camera.width
    depth = 3 + 0.1 * rng.uniform(-1, 1, size=shape)
    alpha = rng.uniform(0.2, 1, size=shape) * (rng.uniform(size=shape) < 0.9)
    n = 60  # some beyond the border, some behind the camera, some in one pixel
    columns, rows = rng.uniform(-2, camera.width + 2, n), rng.uniform(-2, camera.height + 2, n)
    points = lift(camera, columns, rows, rng.uniform(2.8, 3.2, n) * np.where(rng.uniform(size=n) < 0.1, -1, 1))
    return alpha * depth, alpha, 0.3 * rng.uniform(size=(*shape, 3)), points


# --- closed form ---


def test_edge_weights_by_hand():
    photograph = np.zeros((2, 2, 3))
    photograph[0, 1], photograph[1, 0] = [0.3, 0.0, 0.0], [0.1, 0.2, 0.3]
    down, right = edge_weights(photograph)
    once, twice = 0.36787944117144233, 0.1353352832366127  # e^-1 and e^-2, of means that differ by 0.1 and 0.2
    assert_allclose(right, [[once], [twice]], rtol=CLOSED_FORM)
    assert_allclose(down, [[twice, once]], rtol=CLOSED_FORM)


@pytest.mark.parametrize("weights", [DEPTH, NORMALS])
def test_plane_parallel_to_the_image_is_smooth(backend, weights):
    camera = make_camera(cx=9.0)
    depth = np.full((18, 24), 2.5)
    loss, tape = loss_of(backend, depth, camera, weights)
    assert loss == pytest.approx(0, abs=CLOSED_FORM)
    assert all(np.abs(v).max() < CLOSED_FORM for v in functions_of(backend).geometric_loss_vjp(tape))
    assert_allclose(depth_normals(depth, camera), np.broadcast_to([0.0, 0, -1], (17, 23, 3)), atol=CLOSED_FORM)


def test_tilted_plane(backend):
    # Its normals are equal, so it is smooth. Depth grows along each row and column: the steps telescope.
    camera, normal = make_camera(cx=9.0), np.array([-0.3, -0.5, 1.0])
    depth = plane_depth(camera, normal, 2.0)
    normals = depth_normals(depth, camera)
    expected = np.broadcast_to(-normal / np.linalg.norm(normal), normals.shape)
    assert_allclose(normals, expected, atol=1e2 * CLOSED_FORM)
    assert loss_of(backend, depth, camera, NORMALS)[0] == pytest.approx(0, abs=CLOSED_FORM)
    logs = np.log(depth)
    total = (logs[:, -1] - logs[:, 0]).sum() + (logs[-1] - logs[0]).sum()
    n_pairs = 18 * 23 + 17 * 24
    assert loss_of(backend, depth, camera, DEPTH)[0] == pytest.approx(total / n_pairs, rel=1e2 * CLOSED_FORM)


@pytest.mark.parametrize("contrast", [0.0, 0.3])
def test_step_costs_less_at_an_edge_of_the_photograph(backend, contrast):
    camera, depth, photograph = make_camera(), np.full((18, 24), 2.0), np.zeros((18, 24, 3))
    depth[:, 10:] = 3.0
    photograph[:, 10:] = contrast
    expected = 18 * np.exp(-10 * contrast) * np.log(1.5) / (18 * 23 + 17 * 24)
    assert loss_of(backend, depth, camera, DEPTH, photograph=photograph)[0] == pytest.approx(
        expected, rel=1e2 * CLOSED_FORM
    )


@pytest.mark.parametrize("edge", [None, 9, 10, 11])
def test_crease_between_two_planes(backend, edge):
    # They meet in the centres of column 10: one pair of normals a row, of the pixels 9 and 10, spans columns 9 to 11.
    camera = make_camera()
    s, _ = slopes(camera)
    ridge, photograph = s[0, 10], flat_photograph(camera)
    n_left, n_right = np.array([-0.4, 0, 1]), np.array([0.2, 0, 1])
    left, right = (plane_depth(camera, n, 2 * (n[0] * ridge + 1)) for n in (n_left, n_right))
    depth = np.where(np.arange(24) <= 10, left, right)
    weight = 1.0
    if edge is not None:
        photograph[:, edge:] += 0.1
        weight = np.exp(-1) if edge in (10, 11) else 1.0
    cosine = n_left @ n_right / (np.linalg.norm(n_left) * np.linalg.norm(n_right))
    expected = 17 * weight * (1 - cosine) / (17 * 22 + 16 * 23)
    loss, _ = loss_of(backend, depth, camera, NORMALS, photograph=photograph)
    assert loss == pytest.approx(expected, rel=1e2 * CLOSED_FORM)


@pytest.mark.parametrize("ratio", [1.0, 1.004, 0.996, 1.2, 0.7])
def test_depth_error_at_a_point(backend, ratio, rng):
    camera, tau = make_camera(rng=rng), 0.01
    depth = np.full((18, 24), 2.0)
    points = lift(camera, [5.9, 5.1], [3.2, 3.7], 2.0 / ratio)  # both in pixel (5, 3)
    loss, tape = loss_of(backend, depth, camera, SFM, points=points, alpha=0.8)
    e = np.log(ratio)
    cost, slope = (e * e / (2 * tau), e / tau) if abs(e) <= tau else (abs(e) - tau / 2, np.sign(e))
    assert loss == pytest.approx(cost, rel=1e2 * CLOSED_FORM, abs=CLOSED_FORM)
    v_depth, v_alpha = functions_of(backend).geometric_loss_vjp(tape)
    expected = np.zeros((18, 24))
    expected[3, 5] = slope / 1.6  # with respect to log z, summed over both points' halves, over the accumulated depth
    assert_allclose(v_depth, expected, rtol=1e2 * CLOSED_FORM, atol=1e2 * CLOSED_FORM)
    assert_allclose(v_alpha, -2 * expected, rtol=1e2 * CLOSED_FORM, atol=1e2 * CLOSED_FORM)


def test_mean_is_over_points_that_are_seen(backend):
    camera, depth, alpha = make_camera(), np.full((18, 24), 2.0), np.ones((18, 24))
    alpha[7, 7] = 0.0
    mask = np.ones((18, 24), bool)
    mask[8, 8] = False
    seen = lift(camera, [4.5, 0.0], [4.5, 0.0], 4.0)
    behind = lift(camera, [4.5], [4.5], -4.0)
    outside = lift(camera, [-0.1, 24.0, 4.5, 4.5], [4.5, 4.5, -0.1, 18.0], 4.0)
    empty, masked = lift(camera, [7.5], [7.5], 4.0), lift(camera, [8.5], [8.5], 4.0)
    points = np.concatenate([outside, seen, behind, empty, masked, np.zeros((1, 3)), np.full((1, 3), np.nan)])
    loss, tape = loss_of(backend, depth, camera, SFM, points=points, alpha=alpha, mask=mask)
    assert loss == pytest.approx(np.log(2) - 0.005, rel=CLOSED_FORM)
    v_depth, _ = functions_of(backend).geometric_loss_vjp(tape)
    assert_array_equal(np.argwhere(v_depth), [[0, 0], [4, 4]])


def test_terms_add_up(backend, rng):
    camera = make_camera(rng=rng)
    accumulated, alpha, photograph, points = rough_view(rng, camera)

    def run(weights):
        loss, tape = functions_of(backend).geometric_loss(accumulated, alpha, photograph, camera, points, weights)
        return loss, *functions_of(backend).geometric_loss_vjp(tape, 3.0)

    parts = [run(weights) for weights in (SFM, DEPTH, NORMALS)]
    for total, *terms in zip(run(ALL), *parts, strict=True):
        expected = sum(weight * term for weight, term in zip(ALL, terms, strict=True))
        assert_allclose(total, expected, atol=1e2 * CLOSED_FORM * np.abs(expected).max())


def test_smoothness_does_not_know_the_unit_of_length(backend, rng):
    camera = make_camera()
    accumulated, alpha, photograph, _ = rough_view(rng, camera)
    weights = GeometricWeights(0.0, 1.0, 1.0)
    losses = []
    for unit in (1.0, 1000.0):
        loss, tape = functions_of(backend).geometric_loss(
            unit * accumulated, alpha, photograph, camera, NO_POINTS, weights
        )
        losses.append(loss)
    assert losses[1] == pytest.approx(losses[0], rel=1e2 * CLOSED_FORM)
    v_depth, v_alpha = functions_of(backend).geometric_loss_vjp(tape)
    size = np.abs(v_depth * unit * accumulated).sum()
    assert size > GRADIENT_FLOOR
    assert abs(np.sum(v_depth * unit * accumulated)) < 1e2 * CLOSED_FORM * size  # scaling all depths changes nothing
    assert_allclose(
        v_depth * unit * accumulated, -v_alpha * alpha, atol=1e2 * CLOSED_FORM * size
    )  # nor opacity and depth sum


# --- gradient ---


def test_normals_jacobian(rng):
    camera, depth = make_camera(5, 4, cx=1.0), 2 + 0.1 * rng.uniform(size=(4, 5))
    check_jacobian(
        lambda x: (depth_normals(x, camera),), lambda v: (depth_normals_vjp(depth, camera, v),), (depth,), names=["z"]
    )


def test_normal_smoothness_jacobian(rng):
    normals, photograph = rng.normal(size=(3, 4, 3)), 0.2 * rng.uniform(size=(4, 5, 3))
    check_jacobian(
        lambda x: (np.array(normal_smoothness(x, photograph)),),
        lambda v: (normal_smoothness_vjp(normals, photograph, v),),
        (normals,),
        names=["normals"],
    )


@pytest.mark.parametrize("is_masked", [False, True])
@pytest.mark.parametrize("term", TERMS)
def test_loss_gradient(backend, term, is_masked, rng):
    camera, weights = make_camera(cx=10.0, rng=rng), TERMS[term]
    accumulated, alpha, photograph, points = rough_view(rng, camera)
    mask = rng.uniform(size=alpha.shape) < 0.8 if is_masked else None

    def function(accumulated, alpha):
        loss, _ = functions_of(backend).geometric_loss(accumulated, alpha, photograph, camera, points, weights, mask)
        return (np.array(loss),)

    # Empty pixels must stay empty, so the steps are proportional to the values.
    _, tape = functions_of(backend).geometric_loss(accumulated, alpha, photograph, camera, points, weights, mask)
    v_accumulated, v_alpha = functions_of(backend).geometric_loss_vjp(tape, 300.0)
    check_inner_products(
        lambda x, y: function(accumulated * (1 + x), alpha * (1 + y)),
        (v_accumulated * accumulated, v_alpha * alpha),
        (np.zeros_like(alpha), np.zeros_like(alpha)),
        (np.array(300.0),),
        rng,
        names=["accumulated_depth", "alpha"],
    )
    hidden = (alpha == 0) | (False if mask is None else ~mask)
    assert hidden.any() and not v_accumulated[hidden].any() and not v_alpha[hidden].any()


@pytest.mark.parametrize("term", TERMS)
def test_gradient_through_the_renderer(backend, term, rng):
    camera, gaussians, weights = make_camera(rng=rng), make_gaussians(rng, 25, size=0.15), TERMS[term]
    photograph = 0.3 * rng.uniform(size=(18, 24, 3))
    points = lift(camera, rng.uniform(0, 24, 50), rng.uniform(0, 18, 50), rng.uniform(2.5, 3.5, 50))
    hit_counts = []

    def run(*fields):
        output, tape = render(Gaussians(*fields), camera, backend=backend, with_depth=True, with_stats=True)
        hit_counts.append(output.stats.hit_count)
        assert_array_equal(hit_counts[-1], hit_counts[0], "a hit came or went: take a smaller step")
        loss = functions_of(backend).geometric_loss(
            output.image[..., 3], output.alpha, photograph, camera, points, weights
        )
        return output, tape, *loss

    output, tape, _, loss_tape = run(*gaussians)
    assert (output.alpha > 0).mean() > COVERAGE_MIN and (output.alpha == 0).any()
    v_image = np.zeros_like(output.image)
    v_image[..., 3], v_alpha = functions_of(backend).geometric_loss_vjp(loss_tape)
    gradient = render_vjp(tape, v_image, v_alpha).gaussians
    names = ["means", "quats", "log_scales", "opacity_logits"]
    assert not gradient.sh_dc.any() and not gradient.sh_rest.any()
    check_inner_products(
        lambda *fields: (np.array(run(*fields)[2]),),
        gradient,
        gaussians,
        (np.array(1.0),),
        rng,
        names=names,
    )


# --- as terms of the loss of a training ---


@pytest.mark.parametrize("is_masked", [False, True])
@pytest.mark.parametrize("term", EXTENSION.losses, ids=lambda term: term.name)
def test_each_term_is_given_what_its_view_holds(backend, term, is_masked, rng):
    """A term gets the photograph, the mask and the points that the view sees; depth and alpha get derivatives."""
    camera = make_camera(rng=rng)
    sums, alpha, photograph, points = rough_view(rng, camera)
    image = np.concatenate([rng.uniform(size=(18, 24, 3)), sums[..., None]], axis=-1)
    stored, mask = np.round(255 * photograph).astype(np.uint8), rng.uniform(size=(18, 24)) < 0.7 if is_masked else None
    view = View("view", camera, stored, mask, point_ids=np.arange(5, 60))
    scene = Scene("tiny", (view,), (), points, np.zeros((60, 3), np.uint8), np.zeros(3), 1.0)
    output = RenderOutput(image, alpha, None, None)
    channels = {"rgb": slice(0, 3), "depth": slice(3, 4)}
    loss, v = term.function(Rendered(output, channels, view, scene, Model(None), 1, Request(backend=backend)))
    weights = {"sfm_depth": SFM, "depth_smoothness": DEPTH, "normal_smoothness": NORMALS}[term.name]
    photograph = stored * np.float32(1 / 255)
    expected, tape = functions_of(backend).geometric_loss(sums, alpha, photograph, camera, points[5:], weights, mask)
    v_sums, v_alpha = functions_of(backend).geometric_loss_vjp(tape)
    assert loss == expected > 0 and set(v.channels) == {"depth"}
    assert_array_equal(v.channels["depth"], v_sums[..., None])
    assert_array_equal(v.alpha, v_alpha)
    assert min(np.abs(v_sums).max(), np.abs(v_alpha).max()) > GRADIENT_FLOOR


# --- hard cases ---


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize(("size", "expected"), [((1, 1), 0.0), ((5, 1), 1 / 4), ((1, 5), 1 / 4), ((2, 2), 2 / 4)])
def test_tiny_images(backend, size, expected, dtype):
    # Depth grows from 2 to 3, so that the steps of a line add up to log(3/2), those of a square to twice that.
    width, height = size
    camera, depth = make_camera(width, height), np.linspace(2, 3, width * height, dtype=dtype).reshape(height, width)
    points = lift(camera, [0.5], [0.5], 2.0)  # at the depth of the map
    loss, tape = loss_of(backend, depth, camera, GeometricWeights(1.0, 1.0, 1.0), points=points)
    assert loss == pytest.approx(expected * np.log(1.5), rel=PARITY_FLOAT32_LOSS)
    v_depth, v_alpha = functions_of(backend).geometric_loss_vjp(tape)
    assert v_depth.shape == v_alpha.shape == depth.shape and v_depth.dtype == v_alpha.dtype == dtype
    assert np.isfinite(v_depth).all() and v_depth.any() == (expected > 0)


def test_empty_view_has_no_loss(backend, rng):
    camera = make_camera()
    points = lift(camera, rng.uniform(0, 24, 9), rng.uniform(0, 18, 9), 2.0)
    loss, tape = loss_of(backend, np.full((18, 24), 2.0), camera, ALL, points=points, alpha=0.0)
    assert loss == 0.0 and not any(v.any() for v in functions_of(backend).geometric_loss_vjp(tape))


def test_everything_masked_out(backend, rng):
    camera = make_camera()
    accumulated, alpha, photograph, points = rough_view(rng, camera)
    mask = np.zeros((18, 24), bool)
    loss, tape = functions_of(backend).geometric_loss(accumulated, alpha, photograph, camera, points, ALL, mask)
    assert loss == 0.0 and not any(v.any() for v in functions_of(backend).geometric_loss_vjp(tape))


def test_single_pixels_have_no_neighbours(backend):
    camera, alpha = make_camera(), np.zeros((18, 24))
    alpha[::2, ::2] = 1.0
    loss, tape = loss_of(backend, np.full((18, 24), 2.0), camera, ALL, alpha=alpha)
    assert loss == 0.0 and not any(v.any() for v in functions_of(backend).geometric_loss_vjp(tape))


def test_no_weight_no_loss(backend, rng):
    camera = make_camera()
    loss, tape = functions_of(backend).geometric_loss(
        *rough_view(rng, camera)[:3], camera, NO_POINTS, GeometricWeights()
    )
    assert loss == 0.0 and not any(v.any() for v in functions_of(backend).geometric_loss_vjp(tape))


@pytest.mark.skipif(numba.config.NUMBA_NUM_THREADS < 2, reason="needs two threads")
def test_same_bytes_at_any_number_of_threads(rng):
    camera, n_threads, results = make_camera(64, 48, rng=rng), numba.get_num_threads(), []
    accumulated, alpha, photograph, points = rough_view(rng, camera)
    try:
        for n in (1, 2, 2):
            numba.set_num_threads(n)
            loss, tape = kernels.geometric_loss(accumulated, alpha, photograph, camera, np.tile(points, (9, 1)), ALL)
            results.append((loss, *(v.tobytes() for v in kernels.geometric_loss_vjp(tape))))
    finally:
        numba.set_num_threads(n_threads)
    assert results[0] == results[1] == results[2]


def test_the_gradient_proof_covers_it(backend, rng):
    """``oracle gradients --extension geometry`` adds these stages to the check of the whole model."""
    cases = [jacobian_case(stage) for stage in EXTENSION.stages(backend, tiny_setting(), rng)]
    assert len(cases) == (1 if backend.is_compiled else 5) and all(case.passed for case in cases), cases


# --- parity ---


@pytest.mark.parametrize("is_masked", [False, True])
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("term", TERMS)
def test_backends_agree(fast_backend, term, dtype, is_masked, rng):
    camera, weights = make_camera(41, 37, cx=18.0, rng=rng), TERMS[term]
    *images, points = rough_view(rng, camera)
    mask = rng.uniform(size=(37, 41)) < 0.8 if is_masked else None
    expected, tape = reference.geometric_loss(*images, camera, points, weights, mask)
    v_expected = reference.geometric_loss_vjp(tape, 2.0)
    images = (image.astype(dtype) for image in images)
    actual, tape = functions_of(fast_backend).geometric_loss(*images, camera, points, weights, mask)
    tolerance = PARITY_FLOAT64 if dtype == np.float64 else PARITY_FLOAT32_GRADIENT
    assert actual == pytest.approx(expected, rel=tolerance)
    for v, e in zip(functions_of(fast_backend).geometric_loss_vjp(tape, 2.0), v_expected, strict=True):
        assert v.dtype == dtype and np.abs(e).max() > GRADIENT_FLOOR
        assert_allclose(v, e, rtol=0, atol=tolerance * np.abs(e).max())
