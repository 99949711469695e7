"""Analytic splatting: integrals against quadrature, gradients, parity of kernels and reference, training end to end."""

import json

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.integrate import dblquad

from data_tools.claims import analytic as footprint
from gradcheck import check_jacobian
from minisplat_ref import load_ply
from minisplat_ref.app.cli import main
from minisplat_ref.constants import GSPLAT_MAIN, INRIA
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.datasets.synthetic.files import write_scene
from minisplat_ref.extensions.analytic.boxes import visible_boxes
from minisplat_ref.extensions.analytic.model import INTEGRATED, stages
from minisplat_ref.extensions.analytic.response import (
    EXACT_RESPONSE,
    LOGISTIC,
    NORMAL,
    RESPONSE,
    axes_of,
    axes_of_vjp,
    integrals,
    integrals_vjp,
)
from minisplat_ref.oracle.models import check_model_gradients
from minisplat_ref.rendering import SPLATTING, Request
from minisplat_ref.rendering.backends import CPU, REFERENCE
from minisplat_ref.types import Model, Projection, view_from
from scenes import as_dtype, balls, in_front_of, make_camera, make_gaussians, turned_camera
from tolerances import (
    ALPHA_INTEGRAL,
    COVERAGE_MIN,
    PARITY_FLOAT32_IMAGE,
    PARITY_FLOAT64,
    REMOVAL,
)

DRAW = INTEGRATED.renderer
# The logistic curve differs from the normal distribution by 3.9e-4 at most (``analytic/footprint``), in two
# differences.
LOGISTIC_ERROR = 2e-3
# Gradients in float32, relative to the largest. An integral is a difference of two values of a curve, and in its
# derivative with respect to a scale two terms cancel again, which loses a digit compared to PARITY_FLOAT32_GRADIENT.
INTEGRAL_FLOAT32_GRADIENT = 2e-4


def one(mean, conic, opacity):
    ones, box = np.ones((1, 2), np.int32), np.zeros((1, 4), np.int32)
    return Projection(np.asarray(mean)[None], np.ones(1), np.asarray(conic)[None], np.array([opacity]), ones, box)


# --- the integral ---


@pytest.mark.parametrize("sigmas", [(0.1, 0.1), (0.3, 2.0), (1.5, 0.2), (4.0, 4.0)])
def test_along_the_image_axes_it_is_the_exact_mean(sigmas):
    mean, (a, c) = np.array([0.7, 0.2]), 1 / np.square(sigmas)
    pixels = np.array([[0.5, 0.5], [1.5, 0.5], [0.5, -0.5]])
    found = EXACT_RESPONSE.hit(one(mean, [a, 0.0, c], 0.8), np.zeros(1, int), pixels).unclamped[0]
    for alpha, (x, y) in zip(found, pixels, strict=True):
        exact, _ = dblquad(
            lambda v, u: 0.8 * np.exp(-0.5 * (a * (u - mean[0]) ** 2 + c * (v - mean[1]) ** 2)),
            *(x - 0.5, x + 0.5, y - 0.5, y + 0.5),
            epsabs=1e-12,
        )
        assert alpha == pytest.approx(exact, abs=ALPHA_INTEGRAL)


def test_at_an_angle_it_keeps_the_mass_of_the_image():
    """The rotated squares of all pixels cover the plane only on average, so the mean over 16 positions is the mass."""
    C, sums = footprint.covariance(0.6, 3.0, 0.6), []
    for step in range(16):
        mean = np.array([step % 4, step // 4]) / 4
        sums.append(footprint.alphas_of(mean, C, EXACT_RESPONSE).sum())
    mass = footprint.OPACITY * 2 * np.pi * np.sqrt(np.linalg.det(C))
    assert np.mean(sums) == pytest.approx(mass, rel=1e-4) and np.ptp(sums) < 0.02 * mass


def test_a_wide_gaussian_is_its_value_at_the_centre():
    mean, C = np.array([0.3, 0.4]), footprint.covariance(30.0, 2.0, 0.3)
    conic = np.linalg.inv(C)[[0, 0, 1], [0, 1, 1]]
    found = EXACT_RESPONSE.hit(one(mean, conic, 0.8), np.zeros(1, int), np.array([[0.5, 0.5], [9.5, 3.5]])).unclamped
    offsets = mean - [[0.5, 0.5], [9.5, 3.5]]
    expected = 0.8 * np.exp(-0.5 * np.einsum("pi,ij,pj->p", offsets, np.linalg.inv(C), offsets))
    assert_allclose(found[0], expected, rtol=1 / 24 / 30**2 * 2)  # the next term of the series


def test_the_logistic_curve_is_near_the_normal_one():
    x = np.linspace(-6, 6, 1001)
    assert np.abs(LOGISTIC.cdf(x) - NORMAL.cdf(x)).max() < 4e-4
    mean, C = np.array([0.3, 0.4]), footprint.covariance(0.4, 3.0, 0.3)
    exact, logistic = (footprint.alphas_of(mean, C, response) for response in (EXACT_RESPONSE, RESPONSE))
    assert 0 < np.abs(exact - logistic).max() < LOGISTIC_ERROR


@pytest.mark.parametrize("distribution", [NORMAL, LOGISTIC], ids=["normal", "logistic"])
def test_the_gradient_of_integrals(distribution, rng):
    u, rates = rng.uniform(-2, 2, 8), rng.uniform(0.3, 3, 8)
    check_jacobian(
        lambda u, rates: (integrals(u, rates, distribution),),
        lambda v: integrals_vjp(u, rates, distribution, v),
        [u, rates],
        names=["u", "rates"],
    )


def random_conics(rng, n):
    L = rng.normal(size=(n, 2, 2))
    Q = L @ np.swapaxes(L, 1, 2) + 0.1 * np.eye(2)
    return Q[:, [0, 0, 1], [0, 1, 1]].copy()


def test_the_gradient_of_axes(rng):
    conics = random_conics(rng, 6)
    axes = axes_of(conics)
    for k, conic in enumerate(conics):  # the axes are the eigenvectors, the rates the roots of the eigenvalues
        e = np.array([np.cos(axes.angles[k]), np.sin(axes.angles[k])])
        assert_allclose(conic[[0, 1, 1, 2]].reshape(2, 2) @ e, axes.rates[k, 0] ** 2 * e, atol=PARITY_FLOAT64 * 10)
    check_jacobian(
        lambda conics: tuple(axes_of(conics)),
        lambda *v: (axes_of_vjp(conics, axes, type(axes)(*v)),),
        [conics],
        names=["conics"],
    )


@pytest.mark.parametrize("response", [EXACT_RESPONSE, RESPONSE], ids=["erf", "logistic"])
def test_the_gradient_of_alpha(response, rng):
    conics, opacities, means = random_conics(rng, 3), rng.uniform(0.2, 0.9, 3), rng.uniform(-1, 1, (3, 2))
    ids, pixels = np.arange(3), rng.uniform(-2, 2, (5, 2))
    ones, box = np.ones((3, 2), np.int32), np.zeros((3, 4), np.int32)

    def hit(means, conics, opacities):
        return response.hit(Projection(means, np.ones(3), conics, opacities, ones, box), ids, pixels)

    inputs = [means, conics, opacities]
    projection = Projection(means, np.ones(3), conics, opacities, ones, box)
    check_jacobian(
        lambda *moved: (hit(*moved).unclamped,),
        lambda v: response.hit_vjp(projection, ids, hit(*inputs), v, v, None),
        inputs,
        names=["means2d", "conics", "opacities"],
    )


def test_a_round_footprint_has_a_finite_gradient():
    projection = one([0.2, 0.3], [4.0, 0.0, 4.0], 0.7)
    hit = RESPONSE.hit(projection, np.zeros(1, int), np.array([[0.5, 0.5]]))
    v = RESPONSE.hit_vjp(projection, np.zeros(1, int), hit, np.ones((1, 1)), np.ones((1, 1)), None)
    assert all(np.isfinite(array).all() for array in v) and np.abs(v[1]).max() > 0


# --- whole images ---


def test_the_gradient_of_the_whole_model(small_proof):
    """On kernels; the reference's is checked for every extension by test_every_extension.py."""
    report = check_model_gradients(CPU, GSPLAT_MAIN, INTEGRATED, stages)
    assert len(report.cases) == 2 and report.n_failed == 0, report.cases


def test_a_wrong_gradient_is_found(monkeypatch, small_proof):
    path = "minisplat_ref.extensions.analytic.response.axes_of_vjp"
    monkeypatch.setattr(path, lambda conics, axes, v_axes: 1.001 * axes_of_vjp(conics, axes, v_axes))
    report = check_model_gradients(REFERENCE, GSPLAT_MAIN, INTEGRATED, stages)
    assert report.n_failed == 2 and "is wrong" in report.cases[0].note


@pytest.mark.parametrize(
    ("dtype", "image_rel", "gradient_rel"),
    [(np.float64, PARITY_FLOAT64, 10 * PARITY_FLOAT64), (np.float32, PARITY_FLOAT32_IMAGE, INTEGRAL_FLOAT32_GRADIENT)],
)
@pytest.mark.parametrize("size", [0.15, 0.02])
def test_kernels_and_reference_agree(dtype, image_rel, gradient_rel, size, rng):
    """They agree for Gaussians of several pixels and of fractions of one; the reference is in float64.

    In float64 with the depth, as the oracle renders, so that both share the compiled kernels.
    """
    gaussians, view = make_gaussians(rng, 60, size=size), view_from(make_camera(rng=rng))
    wants = frozenset({"depth"} if dtype == np.float64 else ())
    v_image, v_alpha = rng.normal(size=(18, 24, 3 + len(wants))), rng.normal(size=(18, 24))
    results = []
    for backend, kind in ((CPU, dtype), (REFERENCE, np.float64)):
        output, tape = DRAW.render(Model(as_dtype(gaussians, kind)), view, Request(backend=backend, wants=wants))
        v = DRAW.render_vjp(tape, v_image.astype(kind), v_alpha.astype(kind)).gaussians
        results.append((output, v))
    (ours, v_ours), (theirs, v_theirs) = results
    assert ours.image.dtype == dtype and theirs.alpha.max() > COVERAGE_MIN
    assert np.abs(ours.image - theirs.image).max() <= image_rel * np.abs(theirs.image).max()
    for name, expected in v_theirs._asdict().items():
        found, scale = getattr(v_ours, name), np.abs(expected).max()
        assert found.dtype == dtype and scale > 0
        assert np.abs(found - expected).max() <= gradient_rel * scale, name


def test_a_pixel_holds_the_integral_of_what_is_thinner_than_it(backend):
    """A ball at the corner of four pixels, and of four tiles, whose deviations are 0.2 and 0.125 pixels.

    Each of the four gets ``o 2 pi l_1 l_2 (F(1 / l_1) - F(0)) (F(1 / l_2) - F(0))`` with the paper's F, a quarter of
    ``0.9 * 2 pi * 0.2 * 0.125``. With a low-pass it would reach further pixels; sampled at their
    centres, it would reach none.
    """
    camera = turned_camera(60, 28, cx=32.0, cy=16.0)
    ball = balls(in_front_of(camera, [0.0, 0.0, 5.0]), [0.025], [0.9])
    alpha = DRAW.render(Model(ball), view_from(camera), Request(backend=backend))[0].alpha
    (F5, F8) = (1 / (1 + np.exp(-(1.6 * x + 0.07 * x**3))) for x in (5.0, 8.0))
    quarter = 0.9 * 2 * np.pi * 0.2 * 0.125 * (F5 - 0.5) * (F8 - 0.5)
    assert quarter == pytest.approx(0.0353429, abs=1e-7)
    assert_allclose(alpha[15:17, 31:33], quarter, rtol=1e-6)  # the constants of F are rounded to float32
    alpha[15:17, 31:33] = 0
    assert_array_equal(alpha, 0)


@pytest.mark.parametrize("alpha_min", [1 / 255, 0.05, 0.0])
def test_a_box_has_every_pixel_in_which_a_gaussian_is_seen(alpha_min, rng):
    """Needles and balls from 0.01 to 30 pixels at any angle, of any opacity, around 24 x 24 pixels."""
    n, size = 3000, 24
    angles, sigmas = rng.uniform(0, np.pi, n), np.exp(rng.uniform(np.log(0.01), np.log(30), (n, 2)))
    sigmas[::3, 1] = sigmas[::3, 0]
    axes = np.stack([np.cos(angles), np.sin(angles), -np.sin(angles), np.cos(angles)], 1).reshape(n, 2, 2)
    Q = np.einsum("nki,nk,nkj->nij", axes, sigmas**-2.0, axes)
    boxes = np.tile(np.array([[0, 0, size, size]], np.int32), (n, 1))
    means, opacities = rng.uniform(-8, size + 8, (n, 2)), rng.uniform(0, 1, n)
    projection = Projection(means, np.ones(n), Q[:, [0, 0, 1], [0, 1, 1]], opacities, np.ones((n, 2), np.int32), boxes)
    centers = np.stack(np.meshgrid(np.arange(size), np.arange(size)), -1).reshape(-1, 2) + 0.5
    alphas = RESPONSE.hit(projection, np.arange(n), centers).unclamped.reshape(n, size, size)
    x0, y0, x1, y1 = visible_boxes(projection, alpha_min).T[:, :, None, None]
    y, x = np.mgrid[:size, :size]
    is_inside = (x >= x0) & (x < x1) & (y >= y0) & (y < y1)
    assert not (alphas[~is_inside] >= alpha_min).any()
    is_seen = (alphas >= alpha_min).any((1, 2))
    assert is_seen.sum() > n / 3
    if alpha_min > 0:  # and few others: 4 / pi times the pixels of a circle, more around needles
        assert is_inside.sum() < 2 * (alphas >= alpha_min).sum() < is_inside.size
    else:
        assert is_inside.all()


def test_in_the_conventions_of_inria_kernels_and_reference_agree(rng):
    """There a Gaussian is drawn in all tiles that its largest extent touches, beyond its box of pixels."""
    gaussians, view = make_gaussians(rng, 60, size=0.15), view_from(make_camera(70, 40, rng=rng))
    request = Request(conventions=INRIA)
    images = [DRAW.render(Model(gaussians), view, request._replace(backend=b))[0].image for b in (CPU, REFERENCE)]
    assert np.abs(images[1]).max() > COVERAGE_MIN
    assert_allclose(images[0], images[1], atol=PARITY_FLOAT64)


def test_wide_gaussians_are_drawn_as_by_3dgs_without_a_low_pass(backend, rng):
    gaussians, camera = make_gaussians(rng, 20, size=1.0), make_camera(rng=rng, fx=90.0, fy=90.0)
    ours, _ = DRAW.render(Model(gaussians), view_from(camera), Request(backend=backend))
    bare = GSPLAT_MAIN._replace(eps2d=0.0)
    theirs, _ = SPLATTING.render(Model(gaussians), view_from(camera), Request(backend=backend, conventions=bare))
    assert 0 < np.abs(ours.image - theirs.image).max() < 5 * LOGISTIC_ERROR


def test_a_thin_needle_misses_no_tile(rng):
    """3DGS without low-pass does not see a needle between rows of pixel centres, a twentieth of a pixel thick."""
    needle = make_gaussians(rng, 1, sh_degree=0)._replace(
        means=np.array([[0.0, 0.0, 3.0]]),
        quats=np.array([[1.0, 0, 0, 0]]),
        log_scales=np.log([[1.0, 0.005, 0.005]]),
        opacity_logits=np.array([4.0]),
    )
    view = view_from(make_camera(70, 40, fx=30.0, fy=30.0))
    images = []
    for backend in (CPU, REFERENCE):
        output, _ = DRAW.render(Model(needle), view, Request(backend=backend))
        images.append(output.alpha)
        assert (output.alpha[19:21] > 0).sum() > 60
    assert_allclose(images[0], images[1], atol=PARITY_FLOAT64)
    bare = Request(backend=REFERENCE, conventions=GSPLAT_MAIN._replace(eps2d=0.0))
    assert SPLATTING.render(Model(needle), view, bare)[0].alpha.max() == 0


def test_without_gaussians_nothing_is_drawn(backend):
    none = as_dtype(make_gaussians(np.random.default_rng(0), 0), np.float32)
    assert DRAW.render(Model(none), view_from(make_camera()), Request(backend=backend))[0].image.max() == 0


def test_statistics_are_those_of_integrals(backend, rng):
    """Both backends agree, and a removal changes what the image lacks without the Gaussian."""
    g, view = make_gaussians(rng, 12, opacity_logit=1.0), view_from(make_camera(rng=rng))
    wants = frozenset({"stats", "median_depth", "removal_changes"})
    output, expected = (DRAW.render(Model(g), view, Request(backend=b, wants=wants))[0] for b in (backend, REFERENCE))
    for found, statistic in zip(output.stats, expected.stats, strict=True):
        assert_allclose(found, statistic, rtol=REMOVAL, atol=PARITY_FLOAT64)
    assert_allclose(output.median_depth, expected.median_depth, atol=PARITY_FLOAT64)
    changes = output.extras["removal_changes"]
    n = int(np.argmax(changes))
    without, _ = DRAW.render(Model(g), view, Request(backend=backend, is_visible=np.arange(12) != n))
    assert_allclose(changes[n], np.sum((output.image - without.image) ** 2), rtol=REMOVAL)
    assert changes[n] > 0.1 and output.stats.hit_count.sum() > 100


# --- from end to end ---

SCENE = {"n_views": 6, "width": 32, "height": 24, "n_points": 60, "test_every": 4}


def test_trains_evaluates_and_renders(tmp_path):
    write_scene(make_scene("room", supersampling=1, **SCENE), tmp_path / "nook", SCENE)
    run = tmp_path / "run"
    options = ["--recipe", "analytic", "--test-every", "4", "--iterations", "30", "--out", str(run)]
    assert main(["train", str(tmp_path / "nook"), *options]) == 0
    losses = [json.loads(line)["loss"] for line in (run / "log.jsonl").read_text().splitlines()]
    assert losses[-1] < losses[0]
    assert main(["eval", str(run)]) == 0
    ply, cameras = str(run / "point_cloud.ply"), ["--cameras", str(run / "cameras.json")]
    for name, extension in (("ours", []), ("theirs", ["--extension", "core"])):
        assert main(["render", ply, *cameras, *extension, "--out", str(tmp_path / name)]) == 0
    ours, theirs = (sorted((tmp_path / name).glob("*.png")) for name in ("ours", "theirs"))
    assert len(ours) == 8 and all(a.read_bytes() != b.read_bytes() for a, b in zip(ours, theirs, strict=True))
    assert len(load_ply(run / "point_cloud.ply").means) > 0
