"""Kernels of pixels' points against :mod:`minisplat_ref.mechanisms.gbuffer.pixels`, forward and backward."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from gradcheck import check_inner_products
from minisplat_ref.mechanisms.gbuffer import pixel_kernels, pixels
from minisplat_ref.mechanisms.gbuffer.pixels import N_MATERIAL, Blended
from minisplat_ref.mechanisms.gbuffer.prefilter import Filtered
from minisplat_ref.mechanisms.gbuffer.shading import ShadingGradient, Surface
from scenes import make_camera
from tolerances import PARITY_FLOAT32_GRADIENT, PARITY_FLOAT64, ROUNDED_TO_FLOAT32

NORMALS, CARRIED, ALPHA_MIN = 4, 9, 0.002  # own colours, depth, normals, two more, and what is carried


def blended_image(rng, n_further, camera):
    """Sums of pixels, some without a hit, some with an alpha close to the least or of 1, one whose normals cancel."""
    shape = camera.height, camera.width
    alpha = rng.choice([0.0, 0.0021, 0.3, 1.0], size=shape)
    sums = alpha[:, :, None] * rng.uniform(0.1, 1, size=(*shape, CARRIED + N_MATERIAL + n_further))
    sums[:, :, NORMALS : NORMALS + 3] -= 0.5 * alpha[:, :, None]
    alpha[2, 3], sums[2, 3, NORMALS : NORMALS + 3] = 0.5, 0
    return Blended(sums, alpha, NORMALS, CARRIED)


def tilted_camera(rng):
    return make_camera(13, 9, fx=11.0, fy=17.0, rng=rng)._replace(cx=5.0, cy=6.5)


def gradient_of(module, points, camera, v, start):
    out = Blended(start.sums.copy(), start.alpha.copy(), NORMALS, CARRIED)
    module.points_vjp(points, camera, v, out)
    return out


def flat(points):
    return {**points._asdict(), **points.surface._asdict(), "surface": points.alpha}


@pytest.mark.parametrize("has_own", [False, True])
@pytest.mark.parametrize("has_around", [False, True])
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_kernels_are_the_reference(dtype, has_around, has_own, rng):
    camera, n_further = tilted_camera(rng), 3 * has_around
    blended = blended_image(rng, n_further, camera)
    single = blended._replace(sums=blended.sums.astype(dtype), alpha=blended.alpha.astype(dtype))
    wide = blended._replace(sums=single.sums.astype(np.float64), alpha=single.alpha.astype(np.float64))
    rows = pixels.find_rows(single, ALPHA_MIN)
    assert 0 < len(rows) < single.alpha.size and 2 * 13 + 3 not in rows
    expected, found = pixels.points_of(wide, rows, camera), pixel_kernels.points_of(single, rows, camera)
    exact = PARITY_FLOAT64 if dtype == np.float64 else ROUNDED_TO_FLOAT32
    for name, array in flat(expected).items():
        assert flat(found)[name].dtype == (rows.dtype if name == "rows" else dtype)
        assert_allclose(flat(found)[name], array, atol=exact, rtol=0, err_msg=name)
    surface = Surface(*(rng.normal(size=field.shape).astype(dtype) for field in expected.surface))
    light = Filtered((), np.zeros((9, 3)))
    further = rng.normal(size=expected.further.shape).astype(dtype) if has_around else None
    own = rng.normal(size=expected.own.shape).astype(dtype) if has_own else None
    v = ShadingGradient(surface, light, further, own)
    start = Blended(*(rng.normal(size=array.shape).astype(dtype) for array in single[:2]), NORMALS, CARRIED)
    start.sums[:, :, :3] = 0
    v_expected = gradient_of(pixels, expected, camera, v, start)
    v_found = gradient_of(pixel_kernels, found, camera, v, start)
    tolerance = PARITY_FLOAT64 if dtype == np.float64 else PARITY_FLOAT32_GRADIENT
    for a, b in zip(v_found[:2], v_expected[:2], strict=True):
        assert_allclose(a, b, atol=tolerance * np.abs(b).max(), rtol=0)
    is_empty = ~np.isin(np.arange(single.alpha.size), rows).reshape(single.alpha.shape)
    assert_array_equal(v_found.sums[is_empty], start.sums[is_empty])
    assert_array_equal(v_found.alpha[is_empty], start.alpha[is_empty])


@pytest.mark.parametrize("module", [pixels, pixel_kernels])
def test_points_have_their_gradient(module, rng):
    """Of all sums and alphas along random directions; the direction to the camera depends on neither."""
    camera = tilted_camera(rng)
    blended = blended_image(rng, 3, camera)
    rows = pixels.find_rows(blended, 0.1)

    def function(sums, alpha):
        points = module.points_of(Blended(sums, alpha, NORMALS, CARRIED), rows, camera)
        return (*points.surface, points.own, points.further)

    values = function(*blended[:2])
    v = tuple(rng.normal(size=array.shape) for array in values)
    gradient = ShadingGradient(Surface(*v[:5]), Filtered((), np.zeros((9, 3))), v[6], v[5])
    zero = Blended(np.zeros_like(blended.sums), np.zeros_like(blended.alpha), NORMALS, CARRIED)
    found = gradient_of(module, module.points_of(blended, rows, camera), camera, gradient, zero)
    check_inner_products(function, found[:2], blended[:2], v, rng, names=("sums", "alpha"))


@pytest.mark.parametrize("module", [pixels, pixel_kernels])
def test_a_point_by_hand(module):
    """The second of two pixels of a camera that looks along +x of the world: means, and directions in the world."""
    R = np.array([[0, 1.0, 0], [0, 0, 1.0], [1.0, 0, 0]])
    camera = make_camera(2, 1, fx=1.0, fy=1.0)._replace(cam_from_world_R=R, cx=0.5, cy=0.5)
    sums = np.zeros((1, 2, CARRIED + N_MATERIAL))
    sums[0, 1, :3], sums[0, 1, NORMALS : NORMALS + 3] = 0.2, (0.3, 0, -0.4)
    sums[0, 1, CARRIED:] = 0.1, 0.2, 0.3, 0.05, 0.4
    points = module.points_of(Blended(sums, np.array([[0, 0.5]]), NORMALS, CARRIED), np.array([1]), camera)
    assert_allclose(points.surface.albedo, [[0.2, 0.4, 0.6]])
    assert_allclose([points.surface.metallic, points.surface.roughness], [[0.1], [0.8]])
    assert_allclose(points.surface.normals, [[-0.8, 0.6, 0]])
    assert_allclose(points.surface.to_camera, -np.sqrt([[0.5, 0.5, 0]]), atol=1e-15)
    assert_allclose([*points.own[0], *points.lengths], [0.4, 0.4, 0.4, 0.5])
