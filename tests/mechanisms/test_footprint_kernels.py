"""Kernels of Gaussians along rays of lenses: projection and records against their NumPy statements, hard cases too."""

import inspect

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from minisplat_ref.constants import GSPLAT_MAIN, INRIA
from minisplat_ref.errors import InputError
from minisplat_ref.extensions.lens.model import OPTICS, THROUGH_LENS
from minisplat_ref.mechanisms.cameras import footprint_kernels, ray_footprints
from minisplat_ref.mechanisms.cameras.models import model_of
from minisplat_ref.mechanisms.cameras.ray_footprints import FootprintGradient
from minisplat_ref.mechanisms.cameras.record_kernels import (
    AHEAD,
    DEPTH,
    N_GRADIENTS,
    NORMAL,
    OPACITY,
    V_OPACITY,
    V_WHITE,
    V_WHITE_MEAN,
    WHITE,
    records_of,
    records_of_vjp,
)
from minisplat_ref.rendering import Request, activate
from minisplat_ref.rendering.backends import CPU, REFERENCE
from minisplat_ref.types import Camera, Model, Optics, Primitives, view_from
from rows import assert_same_rows
from scenes import as_dtype, make_camera, make_gaussians, turned_camera
from tolerances import PARITY_FLOAT64

ARRAYS = ("positions", "whitenings", "opacities", "depths", "means2d", "radii", "boxes")
CAMERA = Camera(np.eye(3), np.zeros(3), 32.0, 30.0, 12.3, 9.1, 24, 18)
WIDE = Optics("fisheye", (0.02, 0.0, 0.0, 0.0))
FACING = (1.0, 0.0, 0.0, 0.0)
NEAR, FAR = GSPLAT_MAIN.near_plane, GSPLAT_MAIN.far_plane
HARD = {  # mean, quaternion, scale, opacity
    "ordinary": ((0.1, -0.2, 4.0), (1.0, 0.3, -0.2, 0.1), 0.2, 0.8),
    "on the axis": ((0.0, 0.0, 4.0), (1.0, 0.3, -0.2, 0.1), 0.2, 0.8),
    "beside the axis by a hair": ((1e-9, -1e-9, 4.0), FACING, 0.2, 0.8),
    "behind": ((0.1, 0.0, -3.0), FACING, 0.2, 0.8),
    "behind and two thirds as large as its distance": ((0.1, 0.0, -3.0), FACING, 0.6, 0.8),
    "obliquely behind": ((2.0, 0.5, -1.0), FACING, 0.2, 0.8),
    "behind on the axis": ((0.0, 0.0, -3.0), FACING, 0.2, 0.8),
    "at the camera": ((0.0, 0.0, 0.0), FACING, 0.2, 0.8),
    "around the camera": ((0.0, 0.0, 0.05), FACING, 2.0, 0.8),
    "on the near plane": ((0.0, 0.0, NEAR), FACING, 1e-4, 0.8),
    "beyond the far plane": ((0.0, 0.0, 2 * FAR), FACING, 1.0, 0.8),
    "beside the camera": ((2.0, 0.0, 0.1), FACING, 0.3, 0.8),
    "beside the camera and large": ((2.0, 0.0, 0.1), FACING, 3.0, 0.8),
    "partly behind": ((0.1, 0.0, 0.3), FACING, 1.0, 0.8),
    "without rotation": ((0.0, 0.1, 3.0), (0.0, 0.0, 0.0, 0.0), 0.2, 0.8),
    "long quaternion": ((0.0, 0.1, 3.0), (1e160, 2e159, -1e159, 3e159), 0.2, 0.8),
    "a point": ((0.2, 0.1, 3.0), FACING, 0.0, 0.8),
    "too thin": ((0.2, 0.1, 3.0), FACING, 1e-12, 0.8),
    "thin": ((0.2, 0.1, 3.0), FACING, 1e-11, 0.8),
    "immense": ((0.2, 0.1, 3.0), (1.0, 0.2, 0.1, 0.0), 1e30, 0.8),
    "outside of the image": ((9.0, 0.0, 3.0), FACING, 0.1, 0.8),
    "far outside": ((1e12, 0.0, 3.0), FACING, 0.1, 0.8),
    "too faint": ((0.0, 0.0, 3.0), FACING, 0.2, 0.0039),
    "reaches alpha_min at its mean": ((0.0, 0.0, 3.0), FACING, 0.2, GSPLAT_MAIN.alpha_min),
    "opacity is nan": ((0.0, 0.0, 3.0), FACING, 0.2, np.nan),
    "mean is nan": ((np.nan, 0.0, 3.0), FACING, 0.2, 0.8),
    "depth is infinite": ((0.0, 0.0, np.inf), FACING, 0.2, 0.8),
    "scale is nan": ((0.0, 0.0, 3.0), FACING, np.nan, 0.8),
    "quaternion is nan": ((0.0, 0.0, 3.0), (np.nan, 0.0, 0.0, 0.0), 0.2, 0.8),
}


def hard_primitives():
    means, quats, scales, opacities = (np.array(column, float) for column in zip(*HARD.values(), strict=True))
    return Primitives(means, quats, np.column_stack([scales, 0.7 * scales, 0.9 * scales]), opacities)


def assert_same(found, expected):
    assert_same_rows(found, expected, ARRAYS)
    assert found.rays is expected.rays and found.camera[2:] == expected.camera[2:]


@pytest.mark.parametrize("conventions", [GSPLAT_MAIN, INRIA])
@pytest.mark.parametrize("optics", [*OPTICS, WIDE], ids=str)
@pytest.mark.parametrize(("n", "size"), [(0, 0.3), (1, 0.3), (8, 0.3), (143, 0.3), (143, 3.0)])
def test_the_kernel_projects_as_the_reference_does(n, size, optics, conventions, rng):
    p = activate(make_gaussians(rng, n, size=size))
    camera = (turned_camera() if n == 8 else make_camera(rng=rng))._replace(optics=optics)
    found = footprint_kernels.project(p, camera, conventions)
    assert_same(found, ray_footprints.project(p, camera, conventions))


@pytest.mark.parametrize("optics", [*OPTICS, WIDE], ids=str)
@pytest.mark.parametrize("name", HARD)
def test_hard_gaussians_are_projected_or_culled_alike(name, optics):
    """Each is alone, and then amid the others, where it must not spoil the seven that are computed with it."""
    p, row, camera = hard_primitives(), list(HARD).index(name), CAMERA._replace(optics=optics)
    alone = Primitives(*(field[[row]] for field in p))
    found, expected = (m.project(alone, camera, GSPLAT_MAIN) for m in (footprint_kernels, ray_footprints))
    assert_same(found, expected)
    amid = footprint_kernels.project(p, camera, GSPLAT_MAIN)
    for field in ARRAYS:
        assert_array_equal(getattr(amid, field)[row], getattr(found, field)[0])


@pytest.mark.parametrize(
    ("camera", "only_here"),
    [(CAMERA, set()), (CAMERA._replace(optics=WIDE, fx=6.0, fy=6.0), {"obliquely behind", "beside the camera"})],
    ids=["pinhole", "fisheye"],
)
def test_hard_gaussians_are_of_both_kinds(camera, only_here):
    """The fisheye's image ends at 115 degrees from the axis on both sides."""
    is_seen = ray_footprints.project(hard_primitives(), camera, GSPLAT_MAIN).radii[:, 0] > 0
    seen = {name for name, is_one in zip(HARD, is_seen, strict=True) if is_one}
    everywhere = {
        "ordinary",
        "on the axis",
        "around the camera",
        "partly behind",
        "thin",
        "beside the camera and large",
    }
    nowhere = {"behind", "at the camera", "a point", "too thin", "too faint", "reaches alpha_min at its mean"}
    assert everywhere <= seen and not seen & {*nowhere, "opacity is nan", "mean is nan", "depth is infinite"}
    assert seen & {"obliquely behind", "beside the camera"} == only_here


@pytest.mark.parametrize("optics", [*OPTICS, WIDE], ids=str)
@pytest.mark.parametrize("is_hard", [False, True])
def test_the_kernels_gradient_is_that_of_the_reference(is_hard, optics, rng):
    """Of every field, of the pose, and of the means' pixels; that of a culled Gaussian does not count."""
    p = hard_primitives() if is_hard else activate(make_gaussians(rng, 43))
    camera = (CAMERA if is_hard else make_camera(rng=rng))._replace(optics=optics)
    footprints = ray_footprints.project(p, camera, GSPLAT_MAIN)
    footprints = footprints._replace(whitenings=np.ascontiguousarray(footprints.whitenings))  # as the kernel's are
    is_seen = footprints.radii[:, 0] > 0
    if is_hard:  # whose gradients are of ordinary size, so that the sums over Gaussians are compared
        is_seen &= [name not in ("immense", "thin") for name in HARD]
        footprints = footprints._replace(radii=np.where(is_seen[:, None], footprints.radii, 0))
    v = FootprintGradient(*(rng.normal(size=getattr(footprints, name).shape) for name in FootprintGradient._fields))
    found, found2d = footprint_kernels.project_vjp(p, footprints, v)
    expected, expected2d = ray_footprints.project_vjp(p, footprints, v)
    assert is_seen.sum() > 5
    for name, got, want in zip((*found._fields, "means2d"), (*found, found2d), (*expected, expected2d), strict=True):
        assert got.dtype == want.dtype and got.shape == want.shape, name
        assert_allclose(got, want, atol=PARITY_FLOAT64 * np.abs(want).max(), err_msg=name)
        assert np.any(want)
        if len(want) == len(is_seen):
            assert not np.any(got[~is_seen]), name


def test_float32_is_rounded_when_it_is_stored_only(rng):
    p, camera = as_dtype(activate(make_gaussians(rng, 43)), np.float32), make_camera(rng=rng)._replace(optics=OPTICS[1])
    found, expected = (module.project(p, camera, GSPLAT_MAIN) for module in (footprint_kernels, ray_footprints))
    assert_same(found, expected)
    v = FootprintGradient(*(rng.normal(size=getattr(found, name).shape) for name in FootprintGradient._fields))
    got, want = (m.project_vjp(p, found, v) for m in (footprint_kernels, ray_footprints))
    for a, b in zip((*got[0], got[1]), (*want[0], want[1]), strict=True):
        assert a.dtype == np.float32
        assert_allclose(a, b, rtol=2 * np.finfo(np.float32).eps, atol=PARITY_FLOAT64 * np.abs(b).max())


def test_a_mean_that_moves_by_a_pixel(rng):
    """By differences: the pixel's derivative times the pixel's move is what the response's derivative says."""
    p, camera = activate(make_gaussians(rng, 20)), make_camera(rng=rng)._replace(optics=OPTICS[2])
    footprints = footprint_kernels.project(p, camera, GSPLAT_MAIN)
    zeros = FootprintGradient(*(np.zeros_like(getattr(footprints, name)) for name in FootprintGradient._fields))
    J, move = model_of(camera).jacobians(footprints.positions, camera), rng.normal(size=(20, 2))
    across = np.einsum("nki,nk->ni", J, move)  # J^T move, along which pixels move by J J^T move
    _, v_means2d = footprint_kernels.project_vjp(p, footprints, zeros._replace(positions=across))
    is_seen = footprints.radii[:, 0] > 0
    assert_allclose(v_means2d[is_seen], move[is_seen], rtol=1e-9)


@pytest.mark.parametrize("module", [footprint_kernels, ray_footprints])
def test_cameras_and_conventions_without_rays_are_refused(module):
    p = activate(make_gaussians(np.random.default_rng(0), 2))
    with pytest.raises(InputError, match="parallel rays"):
        module.project(p, CAMERA._replace(optics=Optics("orthographic")), GSPLAT_MAIN)
    with pytest.raises(InputError, match="antialiased"):
        module.project(p, CAMERA, GSPLAT_MAIN._replace(is_antialiased=True))


def test_both_statements_take_the_same_arguments():
    for name in ("project", "project_vjp"):
        of_kernels, of_reference = (inspect.signature(getattr(m, name)) for m in (footprint_kernels, ray_footprints))
        assert of_kernels == of_reference


def test_each_backend_projects_by_its_own_statement(rng, monkeypatch):
    g, view, calls = make_gaussians(rng, 5), view_from(make_camera(rng=rng)), []
    for module in (ray_footprints, footprint_kernels):
        for name in ("project", "project_vjp"):
            function = getattr(module, name)

            def noted(*args, module=module, name=name, function=function):
                calls.append((module, name))
                return function(*args)

            monkeypatch.setattr(module, name, noted)
    for backend, module in ((REFERENCE, ray_footprints), (CPU, footprint_kernels)):
        calls.clear()
        output, tape = THROUGH_LENS.renderer.render(Model(g), view, Request(backend=backend))
        THROUGH_LENS.renderer.render_vjp(tape, np.ones_like(output.image))
        assert calls == [(module, "project"), (module, "project_vjp")]


# --- records ---


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_a_record_is_the_direction_and_the_whitening_by_the_distance(dtype, rng):
    footprints = ray_footprints.project(activate(make_gaussians(rng, 43)), make_camera(rng=rng), GSPLAT_MAIN)
    is_seen = footprints.radii[:, 0] > 0
    records = records_of(footprints, np.dtype(dtype))
    assert records.dtype == dtype
    r = np.linalg.norm(footprints.positions, axis=1, keepdims=True)
    G = footprints.whitenings * r[:, :, None]
    half_ulp = np.finfo(dtype).eps if dtype == np.float32 else PARITY_FLOAT64
    n = records[:, NORMAL:WHITE].astype(float)
    assert_allclose((n * r)[is_seen], footprints.positions[is_seen], atol=half_ulp * r.max())
    assert_allclose(records[:, WHITE:AHEAD].reshape(-1, 3, 3), G, rtol=half_ulp, atol=half_ulp * np.abs(G).max())
    # h is that of the rounded direction to all digits of the record, though G is rounded, too.
    h = np.einsum("nij,nj->ni", G, n)
    assert_allclose(records[:, AHEAD:DEPTH], h, rtol=half_ulp, atol=PARITY_FLOAT64 * np.abs(G).max())
    assert_array_equal(records[:, OPACITY], footprints.opacities.astype(dtype))
    assert_array_equal(records[:, DEPTH], footprints.depths.astype(dtype))
    assert not records[~is_seen].any()


def test_the_records_gradient_by_hand(rng):
    """``v_x = M^T p`` and ``v_M = r P``, from a part of a wider table."""
    footprints = ray_footprints.project(activate(make_gaussians(rng, 43)), make_camera(rng=rng), GSPLAT_MAIN)
    v = np.asarray(rng.normal(size=(43, N_GRADIENTS + 4)))[:, :N_GRADIENTS]
    v_x, v_M, v_o = records_of_vjp(footprints, v)
    for row in (0, 7, 42):
        r, M = np.linalg.norm(footprints.positions[row]) or 1.0, footprints.whitenings[row]
        assert_allclose(v_x[row], M.T @ v[row, V_WHITE_MEAN:V_WHITE], rtol=PARITY_FLOAT64, atol=PARITY_FLOAT64)
        assert_allclose(v_M[row], r * v[row, V_WHITE:].reshape(3, 3), rtol=PARITY_FLOAT64)
    assert_array_equal(v_o, v[:, V_OPACITY])
