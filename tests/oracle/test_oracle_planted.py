"""Would an error be found? Planted backends, and every single change of every gradient of the reference."""

import numpy as np
import pytest

from minisplat_ref.constants import GSPLAT_MAIN
from minisplat_ref.errors import InputError
from minisplat_ref.extensions.geometry.losses import PIECES as GEOMETRY_PIECES
from minisplat_ref.mechanisms import orders
from minisplat_ref.oracle.differences import careful_derivative
from minisplat_ref.oracle.gradients import inner_product_case, jacobian_case
from minisplat_ref.oracle.pieces import PIECES, blending_stage, slant, tiny_setting
from minisplat_ref.oracle.planted import PLANTED, plant
from minisplat_ref.oracle.setting import make_setting
from minisplat_ref.oracle.stages import composite_stage, project_stage, render_stage, sh_stage
from minisplat_ref.oracle.tolerances import GRADIENT_REL
from minisplat_ref.reference import hits
from minisplat_ref.rendering.backends import CPU
from minisplat_ref.types import ProjectionGradient, TileGrid
from mutants import mutants

STAGES = {"project": project_stage, "sh_colors": sh_stage, "composite": composite_stage}


def quantities(backend, setting, rng):
    """What the pipeline computes, in order, by name; each stage starts from what the one before made of it."""
    camera, conventions, g = setting.camera, setting.conventions, setting.gaussians
    p = backend.project(*setting.primitives, camera, conventions)
    colors = backend.sh_colors(g.means, g.sh_dc, g.sh_rest, camera, 2, p.radii)
    grid = TileGrid(camera.width, camera.height, backend.tile_width, backend.tile_height)
    bins = backend.bin_gaussians(p, grid, conventions)
    out = backend.composite(p, colors, setting.background, bins, conventions)
    v_image, v_alpha = rng.normal(size=out.image.shape), rng.normal(size=out.alpha.shape)
    v = backend.composite_vjp(p, colors, setting.background, bins, conventions, out, v_image, v_alpha)
    v_p = ProjectionGradient(v.means2d, rng.normal(size=p.depths.shape), v.conics, v.opacities)
    v_g = backend.project_vjp(*setting.primitives, camera, conventions, p, v_p)
    v_sh = backend.sh_colors_vjp(g.means, g.sh_dc, g.sh_rest, camera, 2, p.radii, v.colors)
    forward = [("means2d", p.means2d), ("depths", p.depths), ("conics", p.conics), ("opacities", p.opacities)]
    forward += [("radii", p.radii), ("colors", colors), ("tile lists", bins.gaussian_ids), ("T", 1 - out.alpha)]
    backward = [(f"v_{name}", value) for name, value in v._asdict().items()]
    backward += [("v_means", v_g.means + v_sh.means), ("v_quats", v_g.quats), ("v_scales", v_g.scales)]
    return [*forward, ("image", out.image), *backward, ("v_R", v_g.cam_from_world_R)]


@pytest.mark.parametrize("error", PLANTED, ids=lambda error: error.name)
def test_planted_errors_are_where_they_say(backend, rng, error):
    setting = make_setting(rng, 12, 24, 20, GSPLAT_MAIN, sh_degree=2)
    seed = rng.integers(1000)
    right = quantities(backend, setting, np.random.default_rng(seed))
    wrong = quantities(plant(error.name, backend), setting, np.random.default_rng(seed))
    differs = [
        name
        for (name, a), (_, b) in zip(right, wrong, strict=True)
        if a.shape != b.shape or not np.abs(a - b).max() <= GRADIENT_REL * np.abs(a).max()
    ]
    assert differs[0] == error.stage


@pytest.mark.parametrize("error", PLANTED, ids=lambda error: error.name)
def test_gradient_checks_find_errors_of_gradients(backend, error):
    wrong = plant(error.name, backend)
    touched = [
        make_stage
        for name, make_stage in STAGES.items()
        if getattr(wrong, name) is not getattr(backend, name)
        or getattr(wrong, f"{name}_vjp") is not getattr(backend, f"{name}_vjp")
    ]
    passed = [jacobian_case(make_stage(wrong, tiny_setting(sh_degree=2))).passed for make_stage in touched]
    # An error of a forward formula is planted with its own derivative: only a comparison can find it. But the check
    # watches the profile's thresholds, and those of another clamp it may cross unseen.
    if error.name != "clamp-0.999":
        assert all(passed) == error.is_forward


def test_the_whole_render_finds_them_too(rng):
    for error in PLANTED:
        stage = render_stage(plant(error.name, CPU), tiny_setting())
        assert inner_product_case(stage, rng).passed == error.is_forward, error.name


def test_an_unknown_name_is_refused():
    with pytest.raises(InputError, match="half-off-diagonal"):
        plant("no-such-error")


def transposed_products(stage, cotangents):
    """J^T v of a stage, input by input, by differences."""
    inputs = list(stage.inputs.values())
    results = []
    for index, x in enumerate(inputs):
        units = np.eye(x.size).reshape(-1, *x.shape)
        columns = [careful_derivative(stage.function, inputs, index, unit)[0] for unit in units]
        dots = [sum(float(np.vdot(v, dy)) for v, dy in zip(cotangents, column, strict=True)) for column in columns]
        results.append(np.reshape(dots, x.shape))
    return results


def is_right(stage, cotangents, expected):
    try:
        with np.errstate(all="ignore"):
            gradients = stage.vjp(*cotangents)
        return all(
            np.shape(got) == np.shape(want) and np.abs(got - want).max() <= GRADIENT_REL * np.abs(want).max()
            for got, want in zip(gradients, expected, strict=True)
        )
    except Exception:  # whatever a broken formula raises
        return False


# Changes that change no gradient, each with the reason.
HOMOGENEOUS = "this function does not depend on the length of that argument"
ONES = "divided by an array of ones or signs instead of multiplied"
SYMMETRIC = "transposed, but symmetric"
COUNTED = "only compared with 0 or counted, or the other side is larger"
NOT_AN_INPUT = "not a gradient of the image by an input: test_render.py checks it"
REPLACED = "the invalid values are dropped by the line that follows"
EQUIVALENT = {
    "covariances_vjp: rotation_matrices(quats) -> rotation_matrices(0.5 * quats)": HOMOGENEOUS,
    "pinhole_vjp: limits = np.full(2, np.inf, dtype=means_cam.dtype)"
    " -> limits = 0.5 * np.full(2, np.inf, dtype=means_cam.dtype)": "half of infinity",
    "pinhole_vjp: pinhole_jacobians(means_cam, camera, -limits, limits)"
    " -> pinhole_jacobians(means_cam, camera, 0.5 * -limits, limits)": "half of infinity",
    "pinhole_vjp: pinhole_jacobians(means_cam, camera, -limits, limits)"
    " -> pinhole_jacobians(means_cam, camera, -limits, 0.5 * limits)": "half of infinity",
    "project_vjp: _expand(means[rows], quats[rows], scales[rows], exponents, camera, conventions)"
    " -> _expand(means[rows], 0.5 * quats[rows], scales[rows], exponents, camera, conventions)": HOMOGENEOUS,
    "project_vjp: _exponents(scales[rows]) -> _exponents(0.5 * scales[rows])": "any power of two serves, and cancels",
    "sh_basis_jacobian: SH_C1 * one -> SH_C1 / one": ONES,
    "sh_basis_jacobian: -SH_C1 * one -> -SH_C1 / one": ONES,
    "conic_hit_vjp: np.einsum('gp,gij,gpj->gi', -unclamped * v_mean, Q, offsets)"
    " -> np.einsum('gp,gji,gpj->gi', -unclamped * v_mean, Q, offsets)": SYMMETRIC,
    "conic_hit_vjp: np.einsum('gp,gpi,gpj->gij', -unclamped * v_shape / 2, offsets, offsets)"
    " -> np.einsum('gp,gpi,gpj->gji', -unclamped * v_shape / 2, offsets, offsets)": SYMMETRIC,
    "surface_points_vjp: _whiten(means, quats, scales, camera, ids, ys, xs)"
    " -> _whiten(means, 0.5 * quats, scales, camera, ids, ys, xs)": HOMOGENEOUS,
    "photometric_loss_vjp: max(1, image.shape[2] * int(np.count_nonzero(mask)))"
    " -> max(0.5 * 1, image.shape[2] * int(np.count_nonzero(mask)))": COUNTED,
    "photometric_loss_vjp: one_over_n * np.sign(image - target) -> one_over_n / np.sign(image - target)": ONES,
    "expected_depth_vjp: is_hit = _is_hit(accumulated_depth, alpha)"
    " -> is_hit = 0.5 * _is_hit(accumulated_depth, alpha)": COUNTED,
    "expected_depth_vjp: _is_hit(accumulated_depth, alpha) -> _is_hit(0.5 * accumulated_depth, alpha)": COUNTED,
    "expected_depth_vjp: _is_hit(accumulated_depth, alpha) -> _is_hit(accumulated_depth, 0.5 * alpha)": COUNTED,
    "expected_depth_vjp: np.where(is_hit, alpha, 1) -> alpha": REPLACED,
    "depth_normals_vjp: np.where(exists, np.linalg.norm(N, axis=2, keepdims=True), 1)"
    " -> np.linalg.norm(N, axis=2, keepdims=True)": REPLACED,
    "depth_normals_vjp: _rays(camera, depth) -> _rays(camera, 0.5 * depth)": HOMOGENEOUS,
    "geometric_loss_vjp: depth_normals(depth, camera) -> depth_normals(0.5 * depth, camera)": HOMOGENEOUS,
    "sfm_depth_loss_vjp: max(1, len(errors)) -> max(0.5 * 1, len(errors))": COUNTED,
    "sfm_depth_loss_vjp: len(errors) -> len(0.5 * errors)": COUNTED,
    "depth_smoothness_vjp: _logs_and_weights(depth, photograph)"
    " -> _logs_and_weights(0.5 * depth, photograph)": HOMOGENEOUS,
    "depth_smoothness_vjp: v_loss * e * np.sign(np.diff(logs, axis=axis))"
    " -> v_loss * e / np.sign(np.diff(logs, axis=axis))": ONES,
    "normal_smoothness_vjp: _normal_weights(normals, photograph)"
    " -> _normal_weights(0.5 * normals, photograph)": COUNTED,
    "splat_vjp: SplatGradient(v_primitives, v_colors, v_background, v.means2d)"
    " -> SplatGradient(v_primitives, v_colors, v_background, 0.5 * v.means2d)": NOT_AN_INPUT,
}


def sides_in_order(response, projection, bins):
    tiles = orders.sort_hits(projection, bins, GSPLAT_MAIN, response)
    return tuple(side for tile, order in tiles for side in (tile.alphas > 0, tile.is_clamped, order))


def order_pieces(m):
    """Pixels sort two hits at a time."""
    return (blending_stage(m, orders.Sorted(slant(hits), buffer_size=2), sides_in_order),)


ALL_PIECES = {**PIECES, **GEOMETRY_PIECES, orders: order_pieces}


@pytest.mark.parametrize("module", ALL_PIECES, ids=lambda module: module.__name__.rpartition(".")[2])
def test_no_changed_gradient_survives(module):
    rng = np.random.default_rng(0)
    stages = ALL_PIECES[module](module)
    cotangents = [[rng.normal(size=np.shape(y)) for y in s.function(*s.inputs.values()).outputs] for s in stages]
    expected = [transposed_products(stage, v) for stage, v in zip(stages, cotangents, strict=True)]
    assert all(map(is_right, stages, cotangents, expected))

    n, survivors = 0, set()
    for what, mutant in mutants(module):
        n += 1
        if all(map(is_right, ALL_PIECES[module](mutant), cotangents, expected)):
            survivors.add(what)
    assert n >= 10
    own = {name for name, value in vars(module).items() if getattr(value, "__module__", "") == module.__name__}
    assert survivors == {what for what in EQUIVALENT if what.partition(":")[0] in own}
