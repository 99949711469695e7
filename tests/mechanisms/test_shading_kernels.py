"""Kernels of shading against :mod:`minisplat_ref.mechanisms.gbuffer.shading`, forward and backward."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from minisplat_ref.mechanisms.gbuffer import shading, shading_kernels
from minisplat_ref.mechanisms.gbuffer.brdf import SIZE
from minisplat_ref.mechanisms.gbuffer.prefilter import KNOTS, Filtered, prefilter
from minisplat_ref.mechanisms.gbuffer.shading import Around, Surface
from tolerances import PARITY_FLOAT32_GRADIENT, PARITY_FLOAT32_IMAGE, PARITY_FLOAT64


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def scattered_points(rng, n=600):
    """Of all directions, some of them seen from behind, and of all roughnesses."""
    normals = unit(rng.normal(size=(n, 3)))
    to_camera = unit(normals + 0.8 * rng.normal(size=(n, 3)))
    return Surface(rng.uniform(size=(n, 3)), rng.uniform(size=n), rng.uniform(size=n), normals, to_camera)


def hard_points(rng):
    """The poles and both sides of the seam, seen straight, grazing and from behind, each of all knots and both ends."""
    axes = np.array([[0, 0, 1.0], [0, 0, -1.0], [-1.0, 0, 0], [0, 1.0, 0], [0.6, 0.8, 0]])
    pairs = [(a, b) for a in axes for b in (*axes, -axes[2])]
    pairs += [(unit(np.array([-1, s, 0.2])),) * 2 for s in (1e-9, -1e-9)]  # close to the seam, on either side
    pairs += [(unit(np.array([s, 0, 1.0])),) * 2 for s in (1e-9, 0.04)]  # close to a pole, and beyond the first row
    roughness = np.array([*KNOTS, 1e-12, 1 - 1e-12, 3 / (SIZE - 1)])
    n = len(pairs) * len(roughness)
    normals, to_camera = (np.repeat([pair[k] for pair in pairs], len(roughness), axis=0) for k in (0, 1))
    metallic = rng.permutation(np.linspace(0, 1, n))  # both ends, too
    return Surface(rng.uniform(size=(n, 3)), metallic, np.tile(roughness, len(pairs)), normals, to_camera)


def options(n, rng, mirrors=True, is_hidden=False, is_given=False):
    visible = rng.permutation(np.linspace(0, 1, n))
    return {
        "mirrors": mirrors,
        "around": Around(visible, rng.uniform(size=(n, 3))) if is_hidden else None,
        "scattered": rng.uniform(size=(n, 3)) if is_given else None,
    }


def gradients(v):
    """The arrays of a gradient by name."""
    maps = {f"map {k}": array for k, array in enumerate(v.light.maps)}
    others = {"irradiance": v.light.irradiance, "around": v.around, "scattered": v.scattered}
    return {**v.surface._asdict(), **maps, **{name: array for name, array in others.items() if array is not None}}


def assert_same_gradients(found, expected, tolerance):
    found, expected = gradients(found), gradients(expected)
    assert found.keys() == expected.keys()
    for name, array in expected.items():
        assert_allclose(found[name], array, atol=tolerance * np.abs(array).max(), rtol=0, err_msg=name)


@pytest.mark.parametrize("points", [scattered_points, hard_points])
@pytest.mark.parametrize("rows", [4, 32, 64])
@pytest.mark.parametrize(
    "kinds",
    [{}, {"is_hidden": True}, {"is_given": True}, {"is_hidden": True, "is_given": True}, {"mirrors": False}],
    ids=lambda kinds: "-".join(kinds) or "plain",
)
def test_kernels_are_the_reference(kinds, rows, points, rng):
    surface, light = points(rng), prefilter(rng.uniform(0.2, 1, size=(rows, 2 * rows, 3)))
    further = options(len(surface.metallic), rng, **kinds)
    expected, tape = shading.shade(surface, light, **further)
    found, our_tape = shading_kernels.shade(surface, light, **further)
    assert np.ptp(expected) > 0.3
    assert_allclose(found, expected, atol=PARITY_FLOAT64 * np.abs(expected).max(), rtol=0)
    v_colors = rng.normal(size=found.shape)
    v, our_v = shading.shade_vjp(tape, v_colors), shading_kernels.shade_vjp(our_tape, v_colors)
    assert v.surface.normals.any() and v.light.maps[1].any() == further["mirrors"]
    assert_same_gradients(our_v, v, PARITY_FLOAT64)


def test_float32_has_the_error_of_its_own_rounding(rng):
    """Numbers that a float32 holds, shaded in both precisions."""
    image = rng.uniform(0.2, 1, size=(8, 16, 3)).astype(np.float32)
    surface = Surface(*(field.astype(np.float32) for field in scattered_points(rng)))
    light = prefilter(image)
    wide = Surface(*(field.astype(np.float64) for field in surface))
    wide_light = Filtered(tuple(m.astype(np.float64) for m in light.maps), light.irradiance.astype(np.float64))
    expected, tape = shading.shade(wide, wide_light)
    found, our_tape = shading_kernels.shade(surface, light)
    assert found.dtype == np.float32
    assert_allclose(found, expected, atol=PARITY_FLOAT32_IMAGE * expected.max(), rtol=0)
    v_colors = rng.normal(size=found.shape).astype(np.float32)
    v, our_v = shading.shade_vjp(tape, v_colors), shading_kernels.shade_vjp(our_tape, v_colors)
    assert all(field.dtype == np.float32 for field in our_v.surface)
    assert_same_gradients(our_v, v, PARITY_FLOAT32_GRADIENT)


@pytest.mark.parametrize("n", [0, 1, shading_kernels.N_CHUNKS + 1])
def test_any_number_of_points(n, rng):
    """None, fewer than there are chunks, and a few more."""
    surface, light = scattered_points(rng, n), prefilter(rng.uniform(size=(4, 8, 3)))
    expected, tape = shading.shade(surface, light)
    found, our_tape = shading_kernels.shade(surface, light)
    assert_allclose(found, expected, rtol=PARITY_FLOAT64)
    v_colors = rng.normal(size=(n, 3))
    v, our_v = shading.shade_vjp(tape, v_colors), shading_kernels.shade_vjp(our_tape, v_colors)
    for name, array in gradients(v).items():
        scale = np.abs(array).max(initial=0)
        assert_allclose(gradients(our_v)[name], array, atol=PARITY_FLOAT64 * scale, rtol=0, err_msg=name)


def test_a_large_environment_has_fewer_sums(rng, monkeypatch):
    """Of the number of chunks the gradient has its rounding, and nothing else."""
    surface, light = scattered_points(rng), prefilter(rng.uniform(size=(8, 16, 3)))
    v_colors = rng.normal(size=(600, 3))
    _, tape = shading_kernels.shade(surface, light)
    many = shading_kernels.shade_vjp(tape, v_colors)
    monkeypatch.setattr(shading_kernels, "SUMS_MAX", 1)
    assert_same_gradients(shading_kernels.shade_vjp(tape, v_colors), many, PARITY_FLOAT64)


def test_points_that_are_not_finite_are_theirs_alone(rng):
    """A kernel checks no index: a direction or a roughness of NaN must read some texel, and no other point notices."""
    surface, light = scattered_points(rng, 12), prefilter(rng.uniform(size=(4, 8, 3)))
    expected, _ = shading_kernels.shade(surface, light)
    surface.normals[2], surface.roughness[5], surface.to_camera[7, 2] = np.nan, np.nan, np.inf
    found, tape = shading_kernels.shade(surface, light)
    is_odd = np.isin(np.arange(12), (2, 5, 7))
    assert_array_equal(found[~is_odd], expected[~is_odd])
    assert np.isnan(found[[2, 5]]).all()
    v = shading_kernels.shade_vjp(tape, np.ones((12, 3)))
    assert np.isfinite(v.surface.normals[~is_odd]).all()
