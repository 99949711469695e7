"""What a primitive does to a pixel can be exchanged, and so can the order of a pixel's hits."""

from typing import NamedTuple

import numba
import numpy as np
import pytest
from gradcheck import check_inner_products
from numpy.testing import assert_allclose, assert_array_equal
from tolerances import (
    CLOSED_FORM,
    COVERAGE_MIN,
    GRADIENT_FLOOR,
    GRADIENT_STEP_IMAGE,
    PARITY_FLOAT32_GRADIENT,
    PARITY_FLOAT32_IMAGE,
    PARITY_FLOAT64,
)

from minisplat_ref.backends import CPU, CPU_EXACT, PLAIN, REFERENCE
from minisplat_ref.constants import EXACT_ORDER, GSPLAT_MAIN, INRIA, LIST_ORDER, MINI_SPLATTING2
from minisplat_ref.cpu import plain
from minisplat_ref.cpu.exponential import exp_exact
from minisplat_ref.cpu.responses import KernelResponse, conic_response
from minisplat_ref.reference import compositing
from minisplat_ref.reference.hits import CONIC, Hit, Response, blending_order, tile_hits
from minisplat_ref.scalar._jit import scalar
from minisplat_ref.scalar.lanes import larger, load, select
from minisplat_ref.scalar.literals import ONE, TWO, ZERO
from minisplat_ref.types import Floats, Ints, Projection, TileGrid

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
DOMES = Response(lambda domes: domes.boxes, dome_hit, dome_hit_vjp, FIELDS, ramp_shade, ramp_shade_vjp)


def dome_kernel_response():
    """The same for the kernels. Functions inside of a function: Numba's cache then sees that they have changed."""

    @scalar
    def hit(records, n, x, y):
        u, v = (x - records[n, 0]) * records[n, 2], (y - records[n, 1]) * records[n, 2]
        height = larger(ONE - (u * u + v * v), ZERO)
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


def both_ways(package, response, case):
    """Image, alpha and every gradient."""
    output = package.composite_hits(response, *case.arguments)
    v = package.composite_hits_vjp(response, *case.arguments, output, case.v_output)
    return dict(zip(("image", "alpha", *FIELDS, "colors", "background"), (*output[:2], *v.primitives, *v[1:])))


def assert_same(got, expected, tolerance):
    for name, value in expected.items():
        assert np.abs(value).max() > GRADIENT_FLOOR, f"{name} is zero: nothing was compared"
        error = np.abs(got[name] - value).max() / np.abs(value).max()
        assert error <= tolerance, f"{name}: {error:.1e}"


# --- closed form ---


def test_one_dome_by_hand():
    domes = Domes(
        np.array([[2.5, 1.5]]), np.array([4.0]), np.array([0.8]), np.ones(1), np.zeros((1, 2)), np.array([[0, 0, 9, 9]])
    )
    bins = REFERENCE.bin_gaussians(
        Projection(domes.means2d, *[domes.depths] * 4, domes.boxes), TileGrid(9, 9, 16, 16), GSPLAT_MAIN
    )
    arguments = domes, np.array([[10.0, 4, 40]]), np.array([100.0]), bins, GSPLAT_MAIN
    v_image, v_alpha = np.zeros((9, 9, 1)), np.zeros((9, 9))
    v_image[3, 3] = 1  # one pixel: (u, v) = (1/4, 2/4)
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
        assert_allclose(v.colors, [[alpha, alpha / 4, alpha / 2]], rtol=CLOSED_FORM)
        assert_allclose(v.background, [1 - alpha], rtol=CLOSED_FORM)


# --- gradients ---


@pytest.mark.parametrize("order", ORDERS.values(), ids=ORDERS)
def test_gradient_of_the_reference_by_differences(order, rng):
    case, response = dome_case(rng, 30), DOMES._replace(buffer_size=order)
    domes, _, _, bins, conventions = case.arguments

    def draw(means2d, radii, opacities, colors, background):
        moved = domes._replace(means2d=means2d, radii=radii, opacities=opacities)
        return compositing.composite_hits(response, moved, colors, background, bins, conventions)[:2]

    inputs = [*(getattr(domes, name) for name in FIELDS), *case.arguments[1:3]]
    got = both_ways(compositing, response, case)
    gradients = [got[name] for name in (*FIELDS, "colors", "background")]
    names = [*FIELDS, "colors", "background"]
    check_inner_products(draw, gradients, inputs, case.v_output, rng, names=names, step=GRADIENT_STEP_IMAGE)


# --- parity ---


@pytest.mark.parametrize("order", ORDERS.values(), ids=ORDERS)
def test_kernels_equal_the_reference(order, rng):
    case = dome_case(rng, 120)
    expected = both_ways(compositing, DOMES._replace(buffer_size=order), case)
    assert_same(both_ways(plain, KERNEL_DOMES._replace(buffer_size=order), case), expected, PARITY_FLOAT64)
