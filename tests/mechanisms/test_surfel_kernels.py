"""Kernels of surfels' projection and records against their NumPy statement and against inverses, hard cases too."""

import inspect

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from minisplat_ref.constants import GSPLAT_1_5, GSPLAT_MAIN, INRIA
from minisplat_ref.mechanisms.surfels import projection, projection_kernels
from minisplat_ref.mechanisms.surfels.projection import GSPLAT, PAPER, RELEASED, SurfelGradient
from minisplat_ref.mechanisms.surfels.record_kernels import (
    CENTER_X,
    CENTER_Y,
    DEPTH,
    N_GRADIENTS,
    OPACITY,
    REF_X,
    REF_Y,
    W,
    records_of,
    records_of_vjp,
)
from minisplat_ref.mechanisms.surfels.renderer import SURFELS
from minisplat_ref.rendering import Request, activate
from minisplat_ref.rendering.backends import CPU, REFERENCE
from minisplat_ref.types import Camera, Model, Primitives, view_from
from rows import assert_same_rows
from scenes import as_dtype, make_camera, make_gaussians, turned_camera
from tolerances import CLOSED_FORM, PARITY_FLOAT64

CAMERA = Camera(np.eye(3), np.zeros(3), 32.0, 30.0, 12.3, 9.1, 24, 18)
ARRAYS = ("transforms", "means2d", "opacities", "depths", "normals", "radii", "boxes")
RULES = [PAPER, RELEASED, GSPLAT]
AT_ONCE = GSPLAT_MAIN._replace(near_plane=0.0)
NEAR, FAR = GSPLAT_MAIN.near_plane, GSPLAT_MAIN.far_plane
EDGE_ON = (np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0)
FACING = (1.0, 0.0, 0.0, 0.0)
HARD = {  # mean, quaternion, scale, opacity
    "ordinary": ((0.1, -0.2, 4.0), (1.0, 0.3, -0.2, 0.1), 0.2, 0.8),
    "behind": ((0.1, 0.0, -3.0), FACING, 0.2, 0.8),
    "in the plane of the camera": ((0.1, 0.0, 0.0), FACING, 0.2, 0.8),
    "on the near plane": ((0.0, 0.0, NEAR), FACING, 1e-4, 0.8),
    "beyond the far plane": ((0.0, 0.0, 2 * FAR), FACING, 1.0, 0.8),
    "seen from its edge": ((0.0, 0.0, 4.0), EDGE_ON, 0.5, 0.8),
    "reaches behind the camera": ((0.3, 0.1, 0.5), (np.cos(0.7), 0.0, np.sin(0.7), 0.0), 3.0, 0.8),
    "passes through the camera": ((0.0, 0.0, 0.5), EDGE_ON, 3.0, 0.8),
    "without rotation": ((0.0, 0.1, 3.0), (0.0, 0.0, 0.0, 0.0), 0.2, 0.8),
    "long quaternion": ((0.0, 0.1, 3.0), (1e160, 2e159, -1e159, 3e159), 0.2, 0.8),
    "short quaternion": ((0.0, 0.1, 3.0), (1e-170, 2e-171, -1e-171, 3e-171), 0.2, 0.8),
    "a point": ((0.2, 0.1, 3.0), FACING, 0.0, 0.8),
    "below every number": ((0.2, 0.1, 3.0), FACING, 1e-200, 0.8),
    "immense": ((0.2, 0.1, 3.0), (1.0, 0.2, 0.1, 0.0), 1e30, 0.8),
    "the largest scale": ((0.2, 0.1, 3.0), (1.0, 0.2, 0.1, 0.0), float(np.finfo(np.float32).max), 0.8),
    "outside of the image": ((9.0, 0.0, 3.0), FACING, 0.1, 0.8),
    "far outside": ((1e12, 0.0, 3.0), FACING, 0.1, 0.8),
    "too faint": ((0.0, 0.0, 3.0), FACING, 0.2, 0.0039),
    "just visible": ((0.0, 0.0, 3.0), FACING, 0.2, GSPLAT_MAIN.alpha_min),
    "opacity is nan": ((0.0, 0.0, 3.0), FACING, 0.2, np.nan),
    "opacity is infinite": ((0.0, 0.0, 3.0), FACING, 0.2, np.inf),
    "mean is nan": ((np.nan, 0.0, 3.0), FACING, 0.2, 0.8),
    "depth is infinite": ((0.0, 0.0, np.inf), FACING, 0.2, 0.8),
    "scale is nan": ((0.0, 0.0, 3.0), FACING, np.nan, 0.8),
    "quaternion is nan": ((0.0, 0.0, 3.0), (np.nan, 0.0, 0.0, 0.0), 0.2, 0.8),
}


EDGES = [name in ("seen from its edge", "passes through the camera") for name in HARD]
"""Normals at right angles to the direction to the camera: rounding chooses which of their two sides faces it."""


def hard_primitives():
    means, quats, scales, opacities = (np.array(column, float) for column in zip(*HARD.values(), strict=True))
    return Primitives(means, quats, np.column_stack([scales, 0.7 * scales, np.full(len(scales), np.nan)]), opacities)


def random_primitives(rng, n, size=0.3):
    return activate(make_gaussians(rng, n, size=size))


def assert_same(found, expected):
    assert_same_rows(found, expected, ARRAYS)
    assert (found.rules, found.near_plane) == (expected.rules, expected.near_plane)
    assert_allclose(found.pivot, expected.pivot, rtol=CLOSED_FORM)


@pytest.mark.parametrize("rules", RULES)
@pytest.mark.parametrize("conventions", [GSPLAT_MAIN, GSPLAT_1_5, INRIA, AT_ONCE])
@pytest.mark.parametrize(("n", "size"), [(0, 0.3), (1, 0.3), (8, 0.3), (43, 0.3), (43, 3.0)])
def test_the_kernel_projects_as_the_reference_does(n, size, conventions, rules, rng):
    p, camera = random_primitives(rng, n, size), turned_camera() if n == 8 else make_camera(rng=rng)
    found = projection_kernels.project(p, camera, conventions, rules)
    assert_same(found, projection.project(p, camera, conventions, rules))


@pytest.mark.parametrize("rules", RULES)
@pytest.mark.parametrize("conventions", [GSPLAT_MAIN, AT_ONCE])
@pytest.mark.parametrize("name", HARD)
def test_hard_surfels_are_projected_or_culled_alike(name, conventions, rules):
    """Each is alone, and then amid the others, where it must not spoil the seven that are computed with it."""
    p, row = hard_primitives(), list(HARD).index(name)
    alone = Primitives(*(field[[row]] for field in p))
    found, expected = (m.project(alone, CAMERA, conventions, rules) for m in (projection_kernels, projection))
    if EDGES[row]:
        expected = expected._replace(normals=np.copysign(expected.normals, found.normals))
    assert_same(found, expected)
    amid = projection_kernels.project(p, CAMERA, conventions, rules)
    for field in ARRAYS:
        assert_array_equal(getattr(amid, field)[row], getattr(found, field)[0])


def test_hard_surfels_are_of_both_kinds():
    is_seen = projection.project(hard_primitives(), CAMERA, GSPLAT_MAIN).radii[:, 0] > 0
    seen = {name for name, is_one in zip(HARD, is_seen, strict=True) if is_one}
    assert {"ordinary", "seen from its edge", "reaches behind the camera", "a point", "just visible"} <= seen
    assert {"behind", "on the near plane", "too faint", "opacity is nan", "mean is nan"} <= HARD.keys() - seen


@pytest.mark.parametrize("radius_clip", [0.0, 3.0])
def test_the_kernel_clips_radii_as_the_reference_does(radius_clip, rng):
    p, camera = random_primitives(rng, 60, size=0.03), make_camera(rng=rng)
    found = projection_kernels.project(p, camera, GSPLAT_MAIN, GSPLAT, radius_clip)
    assert_same(found, projection.project(p, camera, GSPLAT_MAIN, GSPLAT, radius_clip))
    all_radii = projection_kernels.project(p, camera, GSPLAT_MAIN, GSPLAT).radii
    is_small = (all_radii > 0).all(axis=1) & (all_radii <= radius_clip).all(axis=1)
    assert is_small.any() == (radius_clip > 0) and not found.radii[is_small].any()


@pytest.mark.parametrize("rules", RULES)
@pytest.mark.parametrize("is_hard", [False, True])
def test_the_kernels_gradient_is_that_of_the_reference(is_hard, rules, rng):
    """Of every field, and of the pose; that of a culled surfel does not count, whatever it is."""
    p = hard_primitives() if is_hard else random_primitives(rng, 43)
    camera, conventions = CAMERA if is_hard else turned_camera(), GSPLAT_1_5
    if not is_hard:
        camera = make_camera(rng=rng)
    surfels = projection.project(p, camera, conventions, rules)
    is_seen = surfels.radii[:, 0] > 0
    if is_hard:  # whose gradients are of ordinary size, so that the sums over surfels are compared
        is_seen &= [
            name not in ("immense", "the largest scale", "a point", "below every number", "just visible")
            for name in HARD
        ]
        surfels = surfels._replace(radii=np.where(is_seen[:, None], surfels.radii, 0))
    v = SurfelGradient(*(rng.normal(size=getattr(surfels, name).shape) for name in SurfelGradient._fields))
    if is_hard:
        v.normals[EDGES] = 0
    found = projection_kernels.project_vjp(p, camera, conventions, surfels, v)
    expected = projection.project_vjp(p, camera, conventions, surfels, v)
    assert is_seen.sum() > 5
    for name, got, want in zip(found._fields, found, expected, strict=True):
        assert got.dtype == want.dtype and got.shape == want.shape, name
        assert_allclose(got, want, atol=PARITY_FLOAT64 * np.abs(want).max(), err_msg=name)
        assert np.any(want)
        if len(want) == len(is_seen):
            assert not np.any(got[~is_seen]), name


def test_float32_is_rounded_when_it_is_stored_only(rng):
    p = as_dtype(random_primitives(rng, 43), np.float32)
    camera = make_camera(rng=rng)
    found, expected = (module.project(p, camera, GSPLAT_MAIN) for module in (projection_kernels, projection))
    assert_same(found, expected)
    v = SurfelGradient(*(rng.normal(size=getattr(found, name).shape) for name in SurfelGradient._fields))
    got, want = (m.project_vjp(p, camera, GSPLAT_MAIN, found, v) for m in (projection_kernels, projection))
    for a, b in zip(got, want, strict=True):
        assert a.dtype == np.float32
        assert_allclose(a, b, rtol=2 * np.finfo(np.float32).eps, atol=PARITY_FLOAT64 * np.abs(b).max())


def test_the_gradient_of_strided_tables_is_that_of_whole_ones(rng):
    p, camera = random_primitives(rng, 20), make_camera(rng=rng)
    surfels = projection_kernels.project(p, camera, GSPLAT_MAIN)
    v = SurfelGradient(*(rng.normal(size=getattr(surfels, name).shape) for name in SurfelGradient._fields))
    wide = np.column_stack([np.ones((20, 2)), v.normals]).astype(np.float32)
    v = v._replace(normals=wide[:, 2:].astype(float))
    strided = projection_kernels.project_vjp(p, camera, GSPLAT_MAIN, surfels, v._replace(normals=wide[:, 2:]))
    for a, b in zip(strided, projection_kernels.project_vjp(p, camera, GSPLAT_MAIN, surfels, v), strict=True):
        assert_array_equal(a, b)


def test_both_statements_take_the_same_arguments():
    for name in ("project", "project_vjp"):
        of_kernels, of_reference = (inspect.signature(getattr(m, name)) for m in (projection_kernels, projection))
        assert of_kernels == of_reference


def test_each_backend_projects_by_its_own_statement(rng, monkeypatch):
    g, view = make_gaussians(rng, 5), view_from(make_camera(rng=rng))
    calls = []
    for module in (projection, projection_kernels):
        for name in ("project", "project_vjp"):
            function = getattr(module, name)

            def noted(*args, module=module, name=name, function=function):
                calls.append((module, name))
                return function(*args)

            monkeypatch.setattr(module, name, noted)
    for backend, module in ((REFERENCE, projection), (CPU, projection_kernels)):
        calls.clear()
        output, tape = SURFELS.render(Model(g), view, Request(backend=backend))
        SURFELS.render_vjp(tape, np.ones_like(output.image))
        assert calls == [(module, "project"), (module, "project_vjp")]


def moved(surfels):
    """T [N, 3, 3] of pixels relative to the records' r [N, 2]."""
    r, T = np.rint(surfels.means2d), surfels.transforms
    return r, np.concatenate([T[:, :2] - r[:, :, None] * T[:, 2:], T[:, 2:]], axis=1)


@pytest.mark.parametrize("rules", [RELEASED, GSPLAT])
def test_a_record_holds_the_inverse_of_the_map(rules, rng):
    surfels = projection.project(random_primitives(rng, 43), make_camera(rng=rng), GSPLAT_MAIN, rules)
    is_seen = surfels.radii[:, 0] > 0
    records = records_of(surfels, np.dtype(float))[is_seen]
    r, T = (field[is_seen] for field in moved(surfels))
    expected = np.linalg.inv(T)
    error = np.abs(records[:, :CENTER_X].reshape(-1, 3, 3) - expected).max(axis=(1, 2))
    assert (error <= PARITY_FLOAT64 * np.linalg.cond(T) * np.abs(expected).max(axis=(1, 2))).all()
    assert_array_equal(records[:, REF_X : REF_Y + 1], r)
    assert_allclose(records[:, CENTER_X : CENTER_Y + 1], (surfels.means2d[is_seen] - r), atol=CLOSED_FORM)
    assert_array_equal(records[:, OPACITY], surfels.opacities[is_seen])
    assert_array_equal(records[:, DEPTH], surfels.depths[is_seen])
    assert_array_equal(records[:, REF_Y + 1], surfels.near_plane)
    assert_array_equal(records[:, REF_Y + 2], surfels.pivot)


def test_discs_without_an_inverse_are_met_nowhere():
    """One that passes through the camera has no inverse; a culled one neither."""
    p = hard_primitives()
    surfels = projection.project(p, CAMERA, GSPLAT_MAIN)
    records = records_of(surfels, np.dtype(np.float32))
    assert np.isfinite(records).all()
    for name in ("passes through the camera", "behind", "a point"):
        assert not records[list(HARD).index(name), : W + 3].any()
    assert records[list(HARD).index("ordinary"), : W + 3].any()


@pytest.mark.parametrize("rules", [RELEASED, GSPLAT])
def test_the_records_gradient_is_that_of_the_inverse(rules, rng):
    """``v_T' = -P^T v_P P^T`` with NumPy's inverse, moved back; the depth belongs to T's corner if hits have depths."""
    surfels = projection.project(random_primitives(rng, 43), make_camera(rng=rng), GSPLAT_MAIN, rules)
    rows = np.flatnonzero(surfels.radii[:, 0] > 0)
    v = np.asarray(rng.normal(size=(43, N_GRADIENTS + 4)))[:, :N_GRADIENTS]  # a part of a wider table
    v_T, v_c, v_o, v_z = records_of_vjp(surfels, v)
    r, T = moved(surfels)
    P_transposed = np.swapaxes(np.linalg.inv(T[rows]), 1, 2)
    expected = -P_transposed @ v[rows, :CENTER_X].reshape(-1, 3, 3) @ P_transposed
    expected[:, 2] -= np.einsum("nk,nkj->nj", r[rows], expected[:, :2])
    has_hit_depths = rules is RELEASED
    expected[:, 2, 2] += has_hit_depths * v[rows, DEPTH]
    error = np.abs(v_T[rows] - expected).max(axis=(1, 2))
    condition = np.linalg.cond(T[rows]) * np.abs(expected).max(axis=(1, 2))
    assert (error <= 10 * PARITY_FLOAT64 * condition).all()
    assert_array_equal(v_c, v[:, CENTER_X : CENTER_Y + 1])
    assert_array_equal(v_o, v[:, OPACITY])
    assert_array_equal(v_z, 0 * v_z if has_hit_depths else v[:, DEPTH])
