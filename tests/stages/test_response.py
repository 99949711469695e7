"""What a primitive does to a pixel can be exchanged, and so can the order of a pixel's hits."""

from inspect import signature
from typing import NamedTuple

import numba
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from gradcheck import check_inner_products
from minisplat_ref.constants import EXACT_ORDER, GSPLAT_MAIN, INRIA, LIST_ORDER, MINI_SPLATTING2
from minisplat_ref.cpu.compositing import hits as plain
from minisplat_ref.cpu.compositing.exponential import exp_exact
from minisplat_ref.cpu.compositing.responses import KernelResponse, conic_response
from minisplat_ref.jit.compile import scalar
from minisplat_ref.jit.lanes import load, maximum, select
from minisplat_ref.jit.literals import ONE, TWO, ZERO
from minisplat_ref.mechanisms import orders
from minisplat_ref.mechanisms.orders import Sorted, blending_order
from minisplat_ref.reference import compositing, removal
from minisplat_ref.reference.hits import CONIC, Hit, Response, Shading, tile_hits
from minisplat_ref.rendering.backends import CPU, CPU_EXACT, PLAIN, REFERENCE
from minisplat_ref.types import Floats, Ints, Projection, TileGrid
from scenes import ALL_CONVENTIONS, activated, as_dtype, make_camera, make_gaussians
from tolerances import (
    CLOSED_FORM,
    COVERAGE_MIN,
    GRADIENT_FLOOR,
    GRADIENT_STEP_IMAGE,
    PARITY_FLOAT32_GRADIENT,
    PARITY_FLOAT32_IMAGE,
    PARITY_FLOAT64,
)

WIDTH, HEIGHT, N_CHANNELS = 37, 21, 4  # neither tiles nor rows of eight fit
ORDERS = {"list": LIST_ORDER, "buffer of 2": 2, "buffer of 5": 5, "exact": EXACT_ORDER}


# --- a second response: slanted paraboloids whose colour changes from place to place ---


class Domes(NamedTuple):
    """Round leaves of alpha o (1 - u^2 - v^2), u and v the offset from the centre in radii."""

    means2d: Floats  # [N, 2]
    radii: Floats  # [N]
    opacities: Floats  # [N]
    depths: Floats  # [N] in the middle
    slopes: Floats  # [N, 2] of the depth over (u, v)
    boxes: Ints  # [N, 4]


def dome_hit(domes, ids, centers):
    place = (centers - domes.means2d[ids, None]) / domes.radii[ids, None, None]  # [G, P, 2]
    heights = np.maximum(1 - np.sum(place**2, axis=2), 0)
    depths = domes.depths[ids, None] + np.einsum("gpi,gi->gp", place, domes.slopes[ids])
    return Hit(domes.opacities[ids, None] * heights, depths, place)


def dome_hit_vjp(domes, ids, hit, v_mean, v_shape, v_place):
    heights = np.maximum(1 - np.sum(hit.place**2, axis=2), 0)
    d_place = -2 * (domes.opacities[ids, None] * (heights > 0))[:, :, None] * hit.place  # d alpha / d place
    v_moved, v_scaled = v_mean[:, :, None] * d_place + v_place, v_shape[:, :, None] * d_place + v_place
    r = domes.radii[ids]
    return -v_moved.sum(axis=1) / r[:, None], -(v_scaled * hit.place).sum(axis=(1, 2)) / r, (v_shape * heights).sum(1)


def ramp_shade(coefficients, place):
    c = coefficients.reshape(len(coefficients), 1, coefficients.shape[1] // 3, 3)  # [G, 1, D, 3]
    return c[..., 0] + c[..., 1] * place[:, :, :1] + c[..., 2] * place[:, :, 1:]


def ramp_shade_vjp(coefficients, place, v):
    c = coefficients.reshape(len(coefficients), coefficients.shape[1] // 3, 3)
    v_c = np.stack([v.sum(axis=1), *(np.einsum("gpd,gp->gd", v, place[:, :, i]) for i in (0, 1))], axis=2)
    return v_c.reshape(coefficients.shape), np.einsum("gpd,gdi->gpi", v, c[..., 1:])


FIELDS = ("means2d", "radii", "opacities")
DOMES = Response(lambda domes: domes.boxes, dome_hit, dome_hit_vjp, FIELDS, Shading(ramp_shade, ramp_shade_vjp))


def dome_kernel_response():
    """The same for the kernels. Functions inside of a function: Numba's cache then sees that they have changed."""

    @scalar
    def hit(records, n, x, y):
        u, v = (x - records[n, 0]) * records[n, 2], (y - records[n, 1]) * records[n, 2]
        height = maximum(ONE - (u * u + v * v), ZERO)
        return records[n, 3] * height, records[n, 4] + u * records[n, 5] + v * records[n, 6], (u, v + ZERO * u, height)

    @scalar
    def hit_vjp(records, n, place, v_mean, v_shape, v_place):
        u, v, height = place
        slope = select(height > ZERO, -TWO * records[n, 3] + ZERO * u, ZERO)
        v_u, v_v = load(v_place, 0), load(v_place, 8)
        v_inverse = ((v_shape * slope * u + v_u) * u + (v_shape * slope * v + v_v) * v) / records[n, 2]
        inverse = records[n, 2]
        return -(v_mean * slope * u + v_u) * inverse, -(v_mean * slope * v + v_v) * inverse, v_inverse, v_shape * height

    @scalar
    def shade(colors, n, k, place):
        return colors[n, 3 * k] + colors[n, 3 * k + 1] * place[0] + colors[n, 3 * k + 2] * place[1]

    @scalar
    def shade_vjp(colors, n, k, place, v):
        return (v, v * place[0], v * place[1]), (v * colors[n, 3 * k + 1], v * colors[n, 3 * k + 2])

    def records(domes, dtype):
        columns = (domes.means2d, 1 / domes.radii, domes.opacities, domes.depths, domes.slopes)
        return np.column_stack(columns).astype(dtype)

    def records_vjp(domes, v):
        return v[:, :2], -v[:, 2] / domes.radii**2, v[:, 3]

    return KernelResponse(
        records, records_vjp, lambda domes: domes.boxes, hit, hit_vjp, 4, shade, shade_vjp, n_coefficients=3, n_places=2
    )


KERNEL_DOMES = dome_kernel_response()


def make_domes(rng, n, radius=6.0):
    centers, radii = rng.uniform((-3, -3), (WIDTH + 3, HEIGHT + 3), (n, 2)), radius * rng.uniform(0.5, 1.5, n)
    low, high = np.floor(centers - radii[:, None]), np.ceil(centers + radii[:, None])
    boxes = np.hstack([np.clip(edge, 0, (WIDTH, HEIGHT)) for edge in (low, high)]).astype(np.int32)
    opacities = rng.uniform(0.1, 1.3, n)  # also above the clamp
    return Domes(centers, radii, opacities, rng.uniform(1, 2, n), rng.normal(size=(n, 2)), boxes)


def listed(domes, tile=(16, 8)):
    """Tile lists by depth in the middle."""
    depths = domes.depths
    projection = Projection(domes.means2d, depths, depths, depths, depths, domes.boxes)
    return REFERENCE.bin_gaussians(projection, TileGrid(WIDTH, HEIGHT, *tile), GSPLAT_MAIN)


class Case(NamedTuple):
    """Arguments of composite_hits for both responses, and cotangents."""

    arguments: tuple
    v_output: tuple


def dome_case(rng, n, **changes):
    domes = make_domes(rng, n, **changes)
    colors, background = rng.normal(size=(n, 3 * N_CHANNELS)), rng.normal(size=N_CHANNELS)
    v_output = rng.normal(size=(HEIGHT, WIDTH, N_CHANNELS)), rng.normal(size=(HEIGHT, WIDTH))
    return Case((domes, colors, background, listed(domes), GSPLAT_MAIN), v_output)


def reference(order, response=DOMES):
    """The reference's functions and its response for an order: those of the core for the list's."""
    return (compositing, response) if order == LIST_ORDER else (orders, Sorted(response, order))


def with_order(package, order):
    """The functions and the response for an order: the reference's, or the kernels'."""
    return reference(order) if package is compositing else (package, KERNEL_DOMES._replace(buffer_size=order))


def both_ways(package, response, case):
    """Image, alpha and every gradient."""
    output = package.composite_hits(response, *case.arguments)
    v = package.composite_hits_vjp(response, *case.arguments, output, case.v_output)
    return dict(
        zip(("image", "alpha", *FIELDS, "colors", "background"), (*output[:2], *v.primitives, *v[1:]), strict=True)
    )


def assert_same(got, expected, tolerance):
    for name, value in expected.items():
        assert np.abs(value).max() > GRADIENT_FLOOR, f"{name} is zero: nothing was compared"
        error = np.abs(got[name] - value).max() / np.abs(value).max()
        assert error <= tolerance, f"{name}: {error:.1e}"


# --- closed form ---


def test_one_dome_by_hand():
    domes = Domes(
        means2d=np.array([[2.5, 1.5]]),
        radii=np.array([4.0]),
        opacities=np.array([0.8]),
        depths=np.ones(1),
        slopes=np.zeros((1, 2)),
        boxes=np.array([[0, 0, 9, 9]], np.int32),
    )
    bins = REFERENCE.bin_gaussians(
        Projection(domes.means2d, *[domes.depths] * 4, domes.boxes), TileGrid(9, 9, 16, 16), GSPLAT_MAIN
    )
    colors, background = np.tile([10.0, 4, 40], (1, N_CHANNELS)), np.full(N_CHANNELS, 100.0)
    arguments = domes, colors, background, bins, GSPLAT_MAIN
    v_image, v_alpha = np.zeros((9, 9, N_CHANNELS)), np.zeros((9, 9))
    v_image[3, 3, 0] = 1  # one pixel: (u, v) = (1/4, 2/4)
    alpha, color = 0.8 * (1 - 1 / 16 - 4 / 16), 10 + 4 / 4 + 40 / 2
    for package, response in ((compositing, DOMES), (plain, KERNEL_DOMES)):
        output = package.composite_hits(response, *arguments)
        assert_allclose(output.image[3, 3], alpha * color + (1 - alpha) * 100, rtol=CLOSED_FORM)
        assert_allclose(output.alpha[3, 3], alpha, rtol=CLOSED_FORM)
        v = package.composite_hits_vjp(response, *arguments, output, (v_image, v_alpha))
        v_place = (color - 100) * 0.8 * -2 * np.array([0.25, 0.5]) + alpha * np.array([4, 40])
        assert_allclose(v.primitives[0], [-v_place / 4], rtol=CLOSED_FORM)
        assert_allclose(v.primitives[1], [-v_place @ [0.25, 0.5] / 4], rtol=CLOSED_FORM)
        assert_allclose(v.primitives[2], [(color - 100) * alpha / 0.8], rtol=CLOSED_FORM)
        others = [0.0] * (N_CHANNELS - 1)
        assert_allclose(v.colors, [[alpha, alpha / 4, alpha / 2, *3 * others]], rtol=CLOSED_FORM)
        assert_allclose(v.background, [1 - alpha, *others], rtol=CLOSED_FORM)


# --- gradients ---


@pytest.mark.parametrize("order", ORDERS.values(), ids=ORDERS)
def test_gradient_of_the_reference_by_differences(order, rng):
    case, (package, response) = dome_case(rng, 30), reference(order)
    domes, _, _, bins, conventions = case.arguments

    def draw(means2d, radii, opacities, colors, background):
        moved = domes._replace(means2d=means2d, radii=radii, opacities=opacities)
        return package.composite_hits(response, moved, colors, background, bins, conventions)[:2]

    inputs = [*(getattr(domes, name) for name in FIELDS), *case.arguments[1:3]]
    got = both_ways(package, response, case)
    gradients = [got[name] for name in (*FIELDS, "colors", "background")]
    names = [*FIELDS, "colors", "background"]
    check_inner_products(draw, gradients, inputs, case.v_output, rng, names=names, step=GRADIENT_STEP_IMAGE)


# --- parity ---


@pytest.mark.parametrize("order", ORDERS.values(), ids=ORDERS)
def test_kernels_equal_the_reference(order, rng):
    case = dome_case(rng, 120)
    expected = both_ways(*reference(order), case)
    assert_same(both_ways(plain, KERNEL_DOMES._replace(buffer_size=order), case), expected, PARITY_FLOAT64)


@pytest.mark.parametrize("order", [LIST_ORDER, EXACT_ORDER], ids=["list", "exact"])
@pytest.mark.parametrize("conventions", [INRIA, MINI_SPLATTING2], ids=lambda c: c.name)
def test_conventions_stop_gradients_at_the_clamp(conventions, order, rng):
    case = dome_case(rng, 60)
    other = Case((*case.arguments[:4], conventions), case.v_output)
    results = []
    for arguments in (case, other):
        expected = both_ways(*reference(order), arguments)
        assert_same(both_ways(plain, KERNEL_DOMES._replace(buffer_size=order), arguments), expected, PARITY_FLOAT64)
        results.append(expected)
    (tile, *_) = tile_hits(case.arguments[0], case.arguments[3], GSPLAT_MAIN, DOMES)
    assert (tile.is_clamped & (tile.alphas > 0)).any()
    assert np.abs(results[0]["means2d"] - results[1]["means2d"]).max() > GRADIENT_FLOOR


# --- the conic ---


def conic_case(rng, n, dtype, conventions=GSPLAT_MAIN, **changes):
    """Footprints, colours, background and lists of a view, and cotangents."""
    gaussians, camera = make_gaussians(rng, n, **changes), make_camera(70, 45, fx=80.0, fy=80.0, rng=rng)
    gaussians = as_dtype(gaussians, dtype)
    projection = CPU.project(*activated(gaussians), camera, conventions)
    colors, background = rng.uniform(size=(n, 3)).astype(dtype), np.array([0.2, 0.5, 0.9], dtype)
    bins = CPU.bin_gaussians(projection, TileGrid(70, 45, CPU.tile_width, CPU.tile_height), conventions)
    v_output = rng.normal(size=(45, 70, 3)).astype(dtype), rng.normal(size=(45, 70)).astype(dtype)
    return Case((projection, colors, background, bins, conventions), v_output)


def by_stages(backend, case):
    output = backend.composite(*case.arguments)
    v = backend.composite_vjp(*case.arguments, output, *case.v_output)
    return {"image": output.image, "alpha": output.alpha, **v._asdict()}


@pytest.mark.parametrize("conventions", ALL_CONVENTIONS, ids=lambda c: c.name)
def test_plain_conic_equals_the_reference_and_the_tuned_kernels(conventions, rng):
    case = conic_case(rng, 250, np.float64, conventions)
    got = by_stages(PLAIN, case)
    assert got["alpha"].max() > 1 - 1e-3 and got["alpha"].min() < COVERAGE_MIN  # finished pixels, and empty ones
    assert_same(got, by_stages(REFERENCE, case), PARITY_FLOAT64)
    assert_same(got, by_stages(CPU, case), PARITY_FLOAT64)


def test_plain_conic_in_float32(rng):
    case = conic_case(rng, 250, np.float32)
    got = by_stages(PLAIN, case)
    expected = by_stages(CPU, case)
    assert got["conics"].dtype == np.float64 and {got[n].dtype for n in got if n != "conics"} == {np.dtype(np.float32)}
    assert np.abs(got["image"] - expected["image"]).max() < PARITY_FLOAT32_IMAGE
    assert_same(got, expected, PARITY_FLOAT32_GRADIENT)
    exact = plain.composite_hits(conic_response(exp_exact), *case.arguments).image
    assert not np.array_equal(exact, got["image"])
    assert np.abs(exact - CPU_EXACT.composite(*case.arguments).image).max() < PARITY_FLOAT32_IMAGE


@pytest.mark.parametrize("order", [3, EXACT_ORDER])
def test_conics_are_in_order_already(order, rng):
    """All pixels see a Gaussian at the depth of its mean: sorting them changes nothing, to the digit."""
    case = conic_case(rng, 100, np.float64)
    listed_order = both_ways(plain, conic_response(exp_exact), case)
    got = both_ways(plain, conic_response(exp_exact)._replace(buffer_size=order), case)
    for name, value in listed_order.items():
        if name in ("image", "alpha"):
            assert_array_equal(got[name], value)
        assert_allclose(got[name], value, rtol=0, atol=PARITY_FLOAT64 * np.abs(value).max(), err_msg=name)
    assert_array_equal(
        orders.composite_hits(Sorted(CONIC, order), *case.arguments).image,
        compositing.composite(*case.arguments).image,
    )


# --- orders ---


def test_a_buffer_by_hand():
    """Depths 3 1 2 0 of one pixel; what misses it takes no room."""
    depths, is_hit = np.array([[3.0], [1], [9], [2], [0]]), np.array([[True], [True], [False], [True], [True]])

    def order(buffer_size):
        rows = blending_order(is_hit, depths, buffer_size)[:, 0]
        assert sorted(rows) == [0, 1, 2, 3, 4]
        return [row for row in rows if row != 2]

    assert order(1) == [0, 1, 3, 4]
    assert order(2) == [1, 3, 4, 0]  # 3 1: takes 1; 3 2: takes 2; 3 0: takes 0
    assert order(3) == [1, 4, 3, 0]  # 3 1 2: takes 1; 3 2 0: takes 0
    assert order(4) == order(EXACT_ORDER) == [4, 1, 3, 0]


def test_equal_depths_keep_the_order_of_the_list():
    depths, is_hit = np.ones((6, 1)), np.ones((6, 1), dtype=bool)
    for buffer_size in (1, 2, 4, 6, EXACT_ORDER):
        assert_array_equal(blending_order(is_hit, depths, buffer_size)[:, 0], np.arange(6))


def test_the_order_of_the_list_is_that_of_the_core(rng):
    """To the byte: image, statistics, removal and every gradient."""
    case = dome_case(rng, 60)
    for function in (both_ways, statistics):
        expected = function(compositing, DOMES, case)
        for name, value in function(orders, Sorted(DOMES, LIST_ORDER), case).items():
            assert_array_equal(value, expected[name], err_msg=name)


@pytest.mark.parametrize("package", [compositing, plain], ids=["numpy", "numba"])
def test_orders_meet(package, rng):
    """A buffer that holds all hits sorts exactly, smaller ones come near, and flat domes need no sorting."""
    case = dome_case(rng, 60)

    def image(order, *arguments):
        package_of_order, response = with_order(package, order)
        return package_of_order.composite_hits(response, *arguments).image

    images = {k: image(k, *case.arguments) for k in (1, 2, 8, 60)}
    exact = image(EXACT_ORDER, *case.arguments)
    assert_array_equal(images[60], exact)
    errors = [np.abs(images[k] - exact).mean() for k in (1, 2, 8)]
    assert errors[0] > errors[1] > errors[2] and errors[0] > 1e-2
    flat = case.arguments[0]._replace(slopes=np.zeros((60, 2)))
    in_order = [image(k, flat, *case.arguments[1:]) for k in (1, EXACT_ORDER)]
    assert_array_equal(*in_order)
    assert np.abs(in_order[0] - images[1]).max() == 0  # depths matter to the order alone
    equal = flat._replace(depths=np.ones(60))  # and equal ones keep that of the list
    for k in (3, EXACT_ORDER):
        assert_array_equal(image(k, equal, *case.arguments[1:]), images[1])


def test_statistics_follow_the_order_of_the_pixel(rng):
    case = dome_case(rng, 60)
    output = orders.composite_hits(Sorted(DOMES), *case.arguments, with_stats=True, with_median_depth=True)
    y, x = np.unravel_index(np.argmax(output.alpha), output.alpha.shape)
    hit = dome_hit(case.arguments[0], np.arange(60), np.array([[x + 0.5, y + 0.5]]))
    T, best, median = 1.0, (0.0, -1), 0.0
    for n in np.argsort(hit.depths[:, 0]):
        alpha = min(hit.unclamped[n, 0], GSPLAT_MAIN.alpha_max)
        if alpha < GSPLAT_MAIN.alpha_min:
            continue
        if T * (1 - alpha) <= GSPLAT_MAIN.transmittance_min:
            break
        best = max(best, (alpha * T, n), key=lambda pair: pair[0])
        median = hit.depths[n, 0] if T >= 0.5 > T * (1 - alpha) else median
        T *= 1 - alpha
    assert output.stats.dominant_ids[y, x] == best[1]
    assert_allclose(output.median_depth[y, x], median, rtol=CLOSED_FORM)
    assert_allclose(output.alpha[y, x], 1 - T, rtol=CLOSED_FORM)


# --- degenerate scenes ---


@pytest.mark.parametrize("order", [LIST_ORDER, EXACT_ORDER], ids=["list", "exact"])
@pytest.mark.parametrize("n", [0, 3])
def test_nothing_is_hit(n, order, rng):
    case = dome_case(rng, n)
    domes, colors, background, _, conventions = case.arguments
    domes = domes._replace(opacities=np.full(n, 1e-4))  # listed, but fainter than 1/255
    got = both_ways(
        plain,
        KERNEL_DOMES._replace(buffer_size=order),
        Case((domes, colors, background, listed(domes), conventions), case.v_output),
    )
    assert_array_equal(got["image"], np.broadcast_to(background, got["image"].shape))
    assert not got["alpha"].any() and not any(got[name].any() for name in (*FIELDS, "colors"))
    assert_allclose(got["background"], case.v_output[0].sum(axis=(0, 1)), rtol=PARITY_FLOAT64)


@pytest.mark.parametrize("order", [LIST_ORDER, 7, EXACT_ORDER], ids=["list", "buffer", "exact"])
def test_hundreds_in_every_tile(order, rng):
    case = dome_case(rng, 700, radius=20.0)
    domes = case.arguments[0]._replace(opacities=rng.uniform(0.005, 0.03, 700))  # so that hundreds are blended
    domes.opacities[5] = 1.0
    case = Case((domes, *case.arguments[1:]), case.v_output)
    bins = case.arguments[3]
    assert np.diff(bins.tile_offsets).min() > 200
    expected = both_ways(*reference(order), case)
    assert_same(both_ways(plain, KERNEL_DOMES._replace(buffer_size=order), case), expected, PARITY_FLOAT64)


@pytest.mark.skipif(numba.config.NUMBA_NUM_THREADS < 2, reason="needs two threads")
@pytest.mark.parametrize("order", [LIST_ORDER, 5], ids=["list", "buffer"])
def test_bytes_do_not_depend_on_threads(order, rng):
    case, results = dome_case(rng, 200), []
    threads = numba.get_num_threads()
    try:
        for n in (1, 2, 2):
            numba.set_num_threads(n)
            results.append(both_ways(plain, KERNEL_DOMES._replace(buffer_size=order), case))
    finally:
        numba.set_num_threads(threads)
    for name, value in results[0].items():
        assert value.tobytes() == results[1][name].tobytes() == results[2][name].tobytes(), name


@pytest.mark.parametrize("name", ["composite_hits", "composite_hits_vjp", "removal_changes_of_hits"])
def test_twins_take_the_same_arguments(name):
    of_book = signature(getattr(compositing, name, None) or getattr(removal, name))
    for twin in (plain, orders):
        assert list(signature(getattr(twin, name)).parameters) == list(of_book.parameters)


def test_plain_statistics_equal_those_of_the_tuned_kernels(rng):
    case = conic_case(rng, 250, np.float64)
    got, expected = (
        backend.composite(*case.arguments, with_stats=True, with_median_depth=True) for backend in (PLAIN, CPU)
    )
    assert_array_equal(got.stats.dominant_ids, expected.stats.dominant_ids)
    assert_array_equal(got.stats.hit_count, expected.stats.hit_count)
    assert_allclose(got.stats.blend_weight_sum, expected.stats.blend_weight_sum, rtol=1e-10)
    assert_allclose(got.median_depth, expected.median_depth, rtol=1e-10)


# --- statistics ---


def statistics(package, response, case):
    """Blend statistics, median depth, and the squared change without each primitive, from composite_hits' package."""
    output = package.composite_hits(response, *case.arguments, with_stats=True, with_median_depth=True)
    domes, colors, _, bins, conventions = case.arguments
    changes = (removal if package is compositing else package).removal_changes_of_hits(
        response, domes, colors, bins, conventions, output
    )
    return {**output.stats._asdict(), "median_depth": output.median_depth, "changes": changes}


@pytest.mark.parametrize("order", ORDERS.values(), ids=ORDERS)
def test_statistics_of_kernels_equal_those_of_the_reference(order, rng):
    case = dome_case(rng, 120)
    expected = statistics(*reference(order), case)
    got = statistics(plain, KERNEL_DOMES._replace(buffer_size=order), case)
    assert (expected["dominant_ids"] >= 0).mean() > 0.5 and (expected["median_depth"] > 0).mean() > 0.3
    for name in ("hit_count", "dominant_count", "dominant_ids"):
        assert_array_equal(got[name], expected[name], err_msg=name)
        assert got[name].dtype == expected[name].dtype
    for name in ("blend_weight_sum", "blend_weight_max", "median_depth", "changes"):
        assert_allclose(got[name], expected[name], rtol=1e-10, atol=PARITY_FLOAT64, err_msg=name)


@pytest.mark.parametrize("package", [compositing, plain], ids=["reference", "kernels"])
def test_statistics_by_hand(package):
    """Two domes of alpha 1/2 in one pixel; on the ray, the one listed first is the farther.

    In the list's order its weight is 1/2 and the other's 1/4, and it alone takes T to 1/2, which is not below. Sorted,
    the weights change places, and the second hit, at the depth 3, takes T to 1/4.
    """
    domes = Domes(
        np.array([[0.5, 0.5], [0.5, 0.5]]),
        np.full(2, 2.0),
        np.full(2, 0.5),
        np.array([3.0, 2.0]),
        np.zeros((2, 2)),
        np.tile(np.array([[0, 0, 1, 1]], np.int32), (2, 1)),
    )
    order_of_list = np.array([1.0, 2.0])
    bins = REFERENCE.bin_gaussians(
        Projection(domes.means2d, *[order_of_list] * 4, domes.boxes), TileGrid(1, 1, 16, 16), GSPLAT_MAIN
    )
    arguments = domes, np.zeros((2, 3 * N_CHANNELS)), np.ones(N_CHANNELS), bins, GSPLAT_MAIN
    for buffer_size, weights, dominant in ((LIST_ORDER, [0.5, 0.25], 0), (EXACT_ORDER, [0.25, 0.5], 1)):
        got = statistics(*with_order(package, buffer_size), Case(arguments, ()))
        assert_allclose(got["blend_weight_sum"], weights, rtol=CLOSED_FORM)
        assert_allclose(got["blend_weight_max"], weights, rtol=CLOSED_FORM)
        assert_array_equal(got["hit_count"], [1, 1])
        assert_array_equal(got["dominant_ids"], [[dominant]])
        assert_array_equal(got["dominant_count"], np.arange(2) == dominant)
        assert_allclose(got["median_depth"], [[2.0 if buffer_size == LIST_ORDER else 3.0]], rtol=CLOSED_FORM)
        # Without either, twice the quarter of the background that is seen: 1/4 more in each of the channels.
        assert_allclose(got["changes"], 2 * [N_CHANNELS / 16], rtol=CLOSED_FORM)


def test_removal_is_what_rendering_without_each_changes(rng):
    case, response = dome_case(rng, 12), Sorted(DOMES)
    domes, colors, background, bins, conventions = case.arguments
    open_ended = conventions._replace(transmittance_min=0.0)  # otherwise a pixel could take further hits
    got = statistics(orders, response, Case((*case.arguments[:4], open_ended), ()))["changes"]
    whole = orders.composite_hits(response, *case.arguments[:4], open_ended).image
    for g in (0, 5, 11):
        gone = domes._replace(opacities=np.where(np.arange(12) == g, 0, domes.opacities))
        image = orders.composite_hits(response, gone, colors, background, bins, open_ended).image
        assert_allclose(got[g], np.sum((image - whole) ** 2), rtol=1e-9)
