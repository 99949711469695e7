import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from gradcheck import check_inner_products
from minisplat_ref.constants import GSPLAT_MAIN, INRIA, SH_C0
from minisplat_ref.cpu import projection, spherical_harmonics
from minisplat_ref.errors import InputError
from minisplat_ref.rendering import render, render_vjp
from minisplat_ref.rendering.backends import CPU, REFERENCE, get_backend
from minisplat_ref.types import Camera, Gaussians
from scenes import ALL_CONVENTIONS, ANTIALIASED, as_dtype, make_camera, make_gaussians
from tolerances import (
    CLOSED_FORM,
    COVERAGE_MIN,
    FLIPPED_PIXELS_MAX,
    GRADIENT_FLOOR,
    GRADIENT_STEP_IMAGE,
    PARITY_FLOAT32_GRADIENT,
    PARITY_FLOAT32_IMAGE,
    PARITY_FLOAT64,
)

BACKGROUND = np.array([0.2, 0.5, 0.9])


def empty_gaussians(dtype=np.float64):
    return as_dtype(make_gaussians(np.random.default_rng(0), 0), dtype)


# --- closed form ---


def test_one_pixel_by_hand(backend):
    # A ball of 30 * 0.2 / 3 = 2 px on the axis of an image of odd size, seen at its centre and two pixels beside it.
    camera = make_camera(9, 9, fx=30.0, fy=30.0)
    gaussians = Gaussians(
        means=np.array([[0.0, 0, 3]]),
        quats=np.array([[2.0, 0, 0, 0]]),
        log_scales=np.log(np.full((1, 3), 0.2)),
        opacity_logits=np.array([np.log(3.0)]),  # opacity 3/4
        sh_dc=np.array([[1.0, 0, -1]]),
        sh_rest=np.zeros((1, 0, 3)),
    )
    options = {"with_depth": True, "with_median_depth": True, "with_stats": True}
    output, tape = render(gaussians, camera, background=BACKGROUND, backend=backend, **options)
    color = 0.5 + SH_C0 * np.array([1, 0, -1])
    for x, alpha in ((4, 0.75), (6, 0.75 * np.exp(-0.5 * 4 / 4.3))):
        assert_allclose(output.alpha[4, x], alpha, rtol=CLOSED_FORM)
        assert_allclose(output.image[4, x, :3], alpha * color + (1 - alpha) * BACKGROUND, rtol=CLOSED_FORM)
        assert_allclose(output.image[4, x, 3], 3 * alpha, rtol=CLOSED_FORM)
    assert output.median_depth[4, 4] == 3
    assert_allclose(output.stats.blend_weight_sum, [output.alpha.sum()], rtol=CLOSED_FORM)
    assert (tape.projection.radii > 0).all()


def test_no_options_no_extras(backend, rng):
    output, _ = render(make_gaussians(rng, 5), make_camera(), backend=backend)
    assert output.image.shape == (18, 24, 3) and output.stats is None and output.median_depth is None
    assert output.image[output.alpha == 0].max(initial=0) == 0  # black background


def test_active_degree(backend, rng):
    gaussians, camera = make_gaussians(rng, 20, size=0.3), make_camera()
    full, _ = render(gaussians, camera, backend=backend)
    flat, tape = render(gaussians, camera, sh_degree=0, backend=backend)
    dc_only, _ = render(gaussians._replace(sh_rest=np.zeros((20, 0, 3))), camera, backend=backend)
    assert full.alpha.mean() > COVERAGE_MIN
    assert_array_equal(flat.image, dc_only.image)
    assert np.abs(full.image - flat.image).max() > 0.01
    gradient = render_vjp(tape, np.ones_like(flat.image))
    assert not gradient.gaussians.sh_rest.any() and gradient.gaussians.sh_dc.any()


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_dtype_is_that_of_the_gaussians(backend, dtype, rng):
    gaussians = as_dtype(make_gaussians(rng, 10, size=0.3), dtype)
    output, tape = render(gaussians, make_camera(), background=BACKGROUND, backend=backend, with_depth=True)
    gradient = render_vjp(tape, np.ones_like(output.image))
    assert output.image.dtype == output.alpha.dtype == dtype
    assert {field.dtype for field in (*gradient.gaussians, *gradient[1:5])} == {np.dtype(dtype)}


# --- gradient ---


@pytest.mark.parametrize("conventions", ALL_CONVENTIONS, ids=lambda c: c.name)
@pytest.mark.parametrize("view", [{}, {"cx": 9.0, "cy": 11.0}], ids=["centred", "off-centre"])
def test_render_gradient(backend, conventions, view, rng):
    camera = make_camera(rng=rng, **view)
    gaussians = make_gaussians(rng, 30, size=0.2)
    names = [*Gaussians._fields, "background", "R", "t"]
    inputs = (*gaussians, BACKGROUND, camera.cam_from_world_R, camera.cam_from_world_t)
    hit_counts = []

    def run(*arrays):
        *fields, background, R, t = arrays
        moved = camera._replace(cam_from_world_R=R, cam_from_world_t=t)
        options = {"background": background, "conventions": conventions, "with_depth": True, "with_stats": True}
        return render(Gaussians(*fields), moved, backend=backend, **options)

    def function(*arrays):
        output, _ = run(*arrays)
        hit_counts.append(output.stats.hit_count)
        assert_array_equal(hit_counts[-1], hit_counts[0], "a hit came or went: take a smaller step")
        return output.image, output.alpha

    output, tape = run(*inputs)
    assert output.alpha.mean() > COVERAGE_MIN and output.alpha.max() < 1
    cotangents = (rng.normal(size=output.image.shape), rng.normal(size=output.alpha.shape))
    gradient = render_vjp(tape, *cotangents)
    gradients = (*gradient.gaussians, gradient.background, gradient.cam_from_world_R, gradient.cam_from_world_t)
    check_inner_products(function, gradients, inputs, cotangents, rng, names=names, step=GRADIENT_STEP_IMAGE)


def test_gradient_of_the_logit_keeps_its_digits_near_1(backend, rng):
    """1 - o is 8e-7 at a logit of 14, of which float32 holds a dozen steps where it is a difference."""
    gaussian = make_gaussians(rng, 1)._replace(means=np.array([[0.0, 0, 3]]), opacity_logits=np.array([14.0]))
    gaussian = as_dtype(gaussian, np.float32)
    v_logits = []
    for same, by in ((gaussian, backend), (as_dtype(gaussian, np.float64), REFERENCE)):
        output, tape = render(same, make_camera(), backend=by)
        v_logits.append(render_vjp(tape, np.ones_like(output.image)).gaussians.opacity_logits)
    assert v_logits[1] != 0
    assert_allclose(*v_logits, rtol=PARITY_FLOAT32_GRADIENT)


def test_screen_gradient_is_that_of_moving_the_image(backend, rng):
    # Moving the principal point by one pixel moves every centre by one pixel.
    gaussians, camera = make_gaussians(rng, 30, size=0.2), make_camera()
    output, tape = render(gaussians, camera, backend=backend)
    v_image = rng.normal(size=output.image.shape)
    step = GRADIENT_STEP_IMAGE
    # Only the position moves with cx: the clamp of the Jacobian is not active in this view.
    moved = [render(gaussians, camera._replace(cx=camera.cx + s), backend=backend)[0].image for s in (step, -step)]
    numeric = np.vdot(v_image, moved[0] - moved[1]) / (2 * step)
    v_means2d = render_vjp(tape, v_image).means2d
    assert np.abs(v_means2d).sum() > GRADIENT_FLOOR
    assert_allclose(v_means2d[:, 0].sum(), numeric, atol=1e-6 * np.abs(v_means2d[:, 0]).sum())


def test_v_alpha_defaults_to_zero(backend, rng):
    output, tape = render(make_gaussians(rng, 10), make_camera(), backend=backend)
    v_image = rng.normal(size=output.image.shape)
    a, b = render_vjp(tape, v_image), render_vjp(tape, v_image, np.zeros_like(output.alpha))
    assert_array_equal(a.gaussians.means, b.gaussians.means)
    assert a.gaussians.means.any()


# --- hard cases ---


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_no_gaussians_render_the_background(backend, dtype):
    options = {"with_depth": True, "with_stats": True, "with_median_depth": True}
    output, tape = render(empty_gaussians(dtype), make_camera(), background=BACKGROUND, backend=backend, **options)
    assert_array_equal(output.image[:, :, :3], np.broadcast_to(BACKGROUND.astype(dtype), (18, 24, 3)))
    assert not output.image[:, :, 3].any() and not output.alpha.any()
    gradient = render_vjp(tape, np.ones_like(output.image))
    assert [field.shape[0] for field in gradient.gaussians] == [0] * 6
    assert_allclose(gradient.background, 18 * 24)
    assert not gradient.cam_from_world_R.any() and not gradient.cam_from_world_t.any()


def test_no_gaussians_have_degrees_of_their_own(backend):
    """A training may have removed all; their degrees are an array without elements."""
    none, no_degrees = empty_gaussians(), np.zeros(0, np.int32)
    output, tape = render(none, make_camera(), background=BACKGROUND, sh_degree=no_degrees, backend=backend)
    assert_array_equal(output.image, np.broadcast_to(BACKGROUND, (18, 24, 3)))
    assert_allclose(render_vjp(tape, np.ones_like(output.image)).background, 18 * 24)


def test_gaussians_behind_the_camera_render_the_background(backend, rng):
    gaussians = make_gaussians(rng, 10)
    gaussians.means[:, 2] *= -1
    output, tape = render(gaussians, make_camera(), background=BACKGROUND, backend=backend)
    assert_array_equal(output.image, np.broadcast_to(BACKGROUND, (18, 24, 3)))
    gradient = render_vjp(tape, np.ones_like(output.image), np.ones_like(output.alpha))
    assert not any(field.any() for field in (*gradient.gaussians, gradient.cam_from_world_R, gradient.means2d))


def test_extreme_parameters_stay_finite(backend, rng):
    gaussians = make_gaussians(rng, 8, size=0.3)
    gaussians.log_scales[0] = 800  # exp overflows
    gaussians.log_scales[1] = -800  # and underflows
    gaussians.opacity_logits[2:4] = [900, -900]
    gaussians.quats[4] = 0
    output, tape = render(gaussians, make_camera(), backend=backend)
    gradient = render_vjp(tape, np.ones_like(output.image))
    assert np.isfinite(output.image).all() and output.alpha.mean() > COVERAGE_MIN
    assert all(np.isfinite(field).all() for field in gradient.gaussians)


@pytest.mark.parametrize("sh_degree", [-1, 2, np.array([-1, 1]), np.array([0, 2])])
def test_degree_that_is_not_stored(sh_degree, rng):
    with pytest.raises(InputError, match="store degrees 0 to 1"):
        render(make_gaussians(rng, 2, sh_degree=1), make_camera(), sh_degree=sh_degree)


def test_get_backend():
    assert get_backend("reference") is REFERENCE and get_backend("cpu") is CPU
    with pytest.raises(InputError, match="'gpu' is unknown"):
        get_backend("gpu")


# --- parity ---


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("conventions", [GSPLAT_MAIN, INRIA, ANTIALIASED], ids=lambda c: c.name)
def test_backends_agree(fast_backend, conventions, dtype, rng):
    gaussians, camera = make_gaussians(rng, 120), make_camera(64, 48, fx=80, fy=75, cx=30, rng=rng)
    v_image, v_alpha = rng.normal(size=(48, 64, 4)), rng.normal(size=(48, 64))
    results = []
    for backend, kind in ((REFERENCE, np.float64), (fast_backend, dtype)):
        options = {"background": BACKGROUND, "conventions": conventions, "with_depth": True}
        output, tape = render(as_dtype(gaussians, kind), camera, backend=backend, **options)
        results.append((output, render_vjp(tape, v_image.astype(kind), v_alpha.astype(kind))))
    (expected, v_expected), (actual, v_actual) = results
    is_exact = dtype == np.float64
    assert expected.alpha.mean() > COVERAGE_MIN
    tolerance = PARITY_FLOAT64 if is_exact else PARITY_FLOAT32_IMAGE
    assert_allclose(actual.image[:, :, :3], expected.image[:, :, :3], rtol=0, atol=tolerance)
    assert_allclose(actual.alpha, expected.alpha, rtol=0, atol=tolerance)
    assert_allclose(actual.image[:, :, 3], expected.image[:, :, 3], rtol=0, atol=tolerance * expected.image.max())
    for a, e in zip((*v_actual.gaussians, *v_actual[1:5]), (*v_expected.gaussians, *v_expected[1:5]), strict=True):
        assert np.abs(e).max() > GRADIENT_FLOOR
        assert_allclose(a, e, rtol=0, atol=(PARITY_FLOAT64 if is_exact else PARITY_FLOAT32_GRADIENT) * np.abs(e).max())


@pytest.mark.parametrize(
    "layout", [np.asfortranarray, lambda a: np.repeat(a, 2, axis=-1)[..., ::2]], ids=["F", "strided"]
)
def test_layout_in_memory_does_not_matter(layout, rng, monkeypatch):
    """Nor are kernels compiled for it, which would take seconds: they are given tables in the usual one."""
    layouts = []

    def watched(kernel):
        def call(tables, *others):
            layouts.append(all(table.flags.c_contiguous for table in tables if isinstance(table, np.ndarray)))
            return kernel(tables, *others)

        return call

    for module, names in (
        (projection, ("_project", "_project_vjp")),
        (spherical_harmonics, ("_sh_colors", "_sh_colors_vjp")),
    ):
        for name in names:
            monkeypatch.setattr(module, name, watched(getattr(module, name)))
    gaussians, camera = make_gaussians(rng, 40), make_camera()
    results = []
    for given in (gaussians, Gaussians._make(map(layout, gaussians))):
        output, tape = render(given, camera)
        results.append((output.image, *render_vjp(tape, layout(output.image)).gaussians))
    assert results[0][0].any() and not gaussians.means.flags.f_contiguous
    assert layouts == [True] * 8
    for expected, found in zip(*results, strict=True):
        assert_array_equal(found, expected)


def test_alpha_min_sets_the_extent(rng):
    # One that falls below 1/255 reaches beyond the 3.33 sigma that are enough for 1/255.
    gaussians, camera = make_gaussians(rng, 30, opacity_logit=3.0), make_camera(64, 48, fx=80, fy=75, rng=rng)
    images = {}
    for alpha_min in (1 / 255, 1e-5):
        conventions = GSPLAT_MAIN._replace(name="far", alpha_min=alpha_min)
        one, other = (
            render(gaussians, camera, conventions=conventions, backend=backend)[0].image for backend in (CPU, REFERENCE)
        )
        assert_allclose(one, other, rtol=0, atol=PARITY_FLOAT64)
        images[alpha_min] = one
    assert np.abs(images[1e-5] - images[1 / 255]).max() > 1 / 255


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_backends_agree_on_real_points(fast_backend, dtype, shared_data, rng):
    # Points and camera of the garden scene; shapes and opacities, which the file does not have, are random.
    data = np.load(shared_data / "gsplat_garden" / "test_garden.npz")
    chosen = rng.choice(len(data["means3d"]), 3000, replace=False)
    gaussians = Gaussians(
        means=data["means3d"][chosen].astype(float),
        quats=rng.normal(size=(3000, 4)),
        log_scales=np.log(rng.uniform(1e-3, 0.04, size=(3000, 3))),
        opacity_logits=2 * rng.normal(size=3000),
        sh_dc=(data["colors"][chosen] / 255 - 0.5) / SH_C0,
        sh_rest=np.zeros((3000, 0, 3)),
    )
    view, K = data["viewmats"][0].astype(float), data["Ks"][0].astype(float) / 8
    camera = Camera(view[:3, :3], view[:3, 3], K[0, 0], K[1, 1], K[0, 2], K[1, 2], 81, 52)
    v_image = rng.normal(size=(52, 81, 3))
    results = []
    for backend, kind in ((REFERENCE, np.float64), (fast_backend, dtype)):
        output, tape = render(as_dtype(gaussians, kind), camera, backend=backend)
        results.append((output, render_vjp(tape, v_image.astype(kind))))
    (expected, v_expected), (actual, v_actual) = results
    assert expected.alpha.mean() > 0.5
    tolerance = PARITY_FLOAT64 if dtype == np.float64 else PARITY_FLOAT32_IMAGE
    is_off = np.abs(actual.image - expected.image).max(axis=2) > tolerance
    assert is_off.mean() <= (0 if dtype == np.float64 else FLIPPED_PIXELS_MAX)
    for a, e in zip(v_actual.gaussians[:5], v_expected.gaussians[:5], strict=True):
        assert_allclose(a, e, rtol=0, atol=tolerance * np.abs(e).max())
