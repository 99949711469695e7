"""The gradient proof: differences that can be trusted, checks that cannot pass on nothing, the command."""

import json

import numpy as np
import pytest

from minisplat_ref.app.cli import main
from minisplat_ref.constants import GSPLAT_MAIN, PROFILES
from minisplat_ref.gsplat import call as gsplat_compat
from minisplat_ref.gsplat.arguments import RENDER_MODES
from minisplat_ref.oracle import gradients
from minisplat_ref.oracle.differences import (
    CENTRAL,
    SIXTH_ORDER,
    STEPS,
    Block,
    JacobianCheck,
    Point,
    ThresholdCrossed,
    careful_derivative,
    check_inner_products,
    check_jacobians,
    derivative,
    largest_error,
    relative_error,
    settled_derivative,
)
from minisplat_ref.oracle.gradients import inner_product_case, jacobian_case
from minisplat_ref.oracle.pieces import PIECES, tiny_setting
from minisplat_ref.oracle.public_call import CALLS, Call, rasterization_stage
from minisplat_ref.oracle.setting import make_setting
from minisplat_ref.oracle.stages import Stage, backend_stages, composite_stage, project_stage, render_stage, sh_stage
from minisplat_ref.oracle.tolerances import GRADIENT_REL
from minisplat_ref.reference import projection as reference_projection
from minisplat_ref.reference.depth import expected_depth_vjp
from minisplat_ref.reference.hits import tile_hits
from minisplat_ref.reference.pinhole import pinhole_jacobians_vjp, slope_limits
from minisplat_ref.rendering.backends import BACKENDS, CPU, REFERENCE
from minisplat_ref.rendering.splatting import splat_vjp
from minisplat_ref.types import TileGrid
from tolerances import CLOSED_FORM

ONE = np.ones(1)


def sine(x):
    return Point((np.sin(x),))


def test_the_sixth_order_stencil_is_exact_for_degree_six():
    def polynomial(x):
        return Point((sum((k + 1) * x**k for k in range(7)),))

    (got,) = derivative(polynomial, [0.5 * ONE], 0, ONE, 0.1, SIXTH_ORDER)
    expected = sum(k * (k + 1) * 0.5 ** (k - 1) for k in range(1, 7))
    assert abs(got[0] - expected) <= 1e2 * CLOSED_FORM * expected
    assert abs(derivative(polynomial, [0.5 * ONE], 0, ONE, 0.1, CENTRAL)[0][0] - expected) > 0.1


def test_its_error_falls_with_the_sixth_power():
    errors = [abs(derivative(sine, [ONE], 0, ONE, h)[0][0] - np.cos(1.0)) for h in (0.4, 0.2)]
    assert 50 < errors[0] / errors[1] < 80
    assert abs(derivative(sine, [ONE], 0, ONE, 1e-3)[0][0] - np.cos(1.0)) < 1e-12


def test_a_step_across_a_threshold_is_refused_and_made_smaller():
    def step(x):  # slope 2 everywhere; a jump at 1 + 1e-6
        is_over = x > 1 + 1e-6
        return Point((2 * x + is_over,), (is_over,))

    with pytest.raises(ThresholdCrossed):
        derivative(step, [ONE], 0, ONE, 1e-4)
    (got,), used = careful_derivative(step, [ONE], 0, ONE)
    assert used == 1e-7 and abs(got[0] - 2) < GRADIENT_REL


def test_what_every_step_crosses_is_reported():
    def jump(x):
        return Point((np.sign(x - 1),), (np.sign(x - 1),))

    stage = Stage("jump", {"x": ONE}, ("y",), jump, lambda v: (0 * v,))
    case = jacobian_case(stage)
    assert not case.passed and "cross a threshold" in case.note
    assert not inner_product_case(stage, np.random.default_rng(0)).passed


def test_nothing_is_not_a_proof():
    zero = Stage("zero", {"x": ONE}, ("y",), lambda x: Point((0 * x,)), lambda v: (0 * v,))
    assert "nothing was checked about x" in jacobian_case(zero).note
    assert "the gradient with respect to x is zero" in inner_product_case(zero, np.random.default_rng(0)).note


def test_a_small_block_does_not_hide_behind_a_large_one():
    def function(x):
        return Point((1e6 * x, 1e-3 * x))

    check = check_jacobians(
        function, lambda a, b: (1e6 * a + 0.5e-3 * b,), [ONE], names=["x"], output_names=["large", "small"]
    )
    errors = {block.output: block.error for block in check.blocks}
    assert errors["large"] < GRADIENT_REL and abs(errors["small"] - 0.5) < GRADIENT_REL


def test_a_zero_block_must_be_zero_in_the_gradient_too():
    def function(x, y):
        return Point((x, y))

    check = check_jacobians(
        function, lambda a, b: (a, b + 0.1 * a), [ONE, ONE], names=["x", "y"], output_names=["p", "q"]
    )
    assert [block.error > 0.05 for block in check.blocks] == [False, False, True, False]


def test_a_gradient_that_is_not_a_number_is_wrong():
    stage = Stage("nan", {"x": ONE}, ("y",), lambda x: Point((x,)), lambda v: (v * np.nan,))
    assert not jacobian_case(stage).passed
    assert not inner_product_case(stage, np.random.default_rng(0)).passed


def test_an_empty_image_is_not_a_proof(rng):
    setting = tiny_setting()
    hidden = setting._replace(gaussians=setting.gaussians._replace(opacity_logits=np.full(5, -5.0)))
    assert "all but empty" in jacobian_case(composite_stage(REFERENCE, hidden)).note


def test_inner_products_find_a_wrong_sign(rng):
    stage = composite_stage(REFERENCE, tiny_setting())

    def wrong(*cotangents):
        means2d, *others = stage.vjp(*cotangents)
        return (-means2d, *others)

    products = check_inner_products(stage.function, wrong, list(stage.inputs.values()), rng, names=list(stage.inputs))
    assert [product.error > GRADIENT_REL for product in products] == [True, False, False, False, False]


def test_the_tiny_scene_takes_every_branch():
    setting = tiny_setting()
    camera, conventions = setting.camera, setting.conventions
    projection = REFERENCE.project(*setting.primitives, camera, conventions)
    bins = REFERENCE.bin_gaussians(projection, TileGrid(camera.width, camera.height, 16, 16), conventions)
    (tile,) = tile_hits(projection, bins, conventions)
    would_hit = tile.hit.unclamped >= conventions.alpha_min
    assert (projection.radii > 0).all()
    assert tile.is_clamped.any() and (would_hit & (tile.alphas == 0)).any()  # a clamped hit, and a stopped pixel
    sides = project_stage(REFERENCE, setting)
    _, follows = sides.function(*sides.inputs.values()).sides
    assert not follows.all()  # the Jacobian's clamp
    low, high = slope_limits(camera, conventions, np.dtype(float))
    R, t = setting.pose.values()
    x, y = np.split((setting.primitives.means @ R.T + t)[:, :2] / projection.depths[:, None], 2, axis=1)
    assert ((y > high[1]) & (low[0] < y) & (y < high[0]) & (low[0] < x) & (x < high[0])).any()  # between the limits
    colors = sh_stage(REFERENCE, setting)
    assert (colors.function(*colors.inputs.values()).outputs[0] == 0).any()


@pytest.mark.parametrize("profile", PROFILES.values(), ids=lambda profile: profile.name)
def test_every_stage_of_the_kernels(profile):
    cases = [jacobian_case(s) for s in backend_stages(CPU, tiny_setting(profile), np.random.default_rng(1))]
    assert len(cases) == 7 and all(case.passed for case in cases), [case for case in cases if not case.passed]


def test_every_formula_of_the_reference():
    for module, pieces_of in PIECES.items():
        for case in map(jacobian_case, pieces_of(module)):
            assert case.passed, case


# --- the public call ---


def public_case(call, rng):
    return inner_product_case(rasterization_stage(CPU, tiny_setting(), call, rng), rng)


def test_the_public_call_is_checked_in_every_mode(rng):
    assert {call.render_mode for call in CALLS} == set(RENDER_MODES)
    assert {call.n_channels for call in CALLS} >= {0, 1, 5} and any(call.is_antialiased for call in CALLS)
    for call in CALLS:
        case = public_case(call, rng)
        assert case.passed and case.figures["limit"] == GRADIENT_REL, case


def test_a_wrong_gradient_of_the_expected_depth_is_found(monkeypatch, rng):
    def wrong(accumulated, alpha, v):
        v_accumulated, v_alpha = expected_depth_vjp(accumulated, alpha, v)
        return v_accumulated, -v_alpha

    monkeypatch.setattr(gsplat_compat, "expected_depth_vjp", wrong)
    assert not jacobian_case(rasterization_stage(CPU, tiny_setting(), Call("ED"), rng, n_cameras=1)).passed
    assert [public_case(Call(mode), rng).passed for mode in ("RGB+D", "RGB+ED")] == [True, False]


def test_harmonics_missing_from_the_view_matrix_are_found(monkeypatch, rng):
    right = gsplat_compat.render_one_vjp

    def wrong(batch, c, tape, v_image, v_alpha):
        p = splat_vjp(tape, v_image, v_alpha).primitives
        v_viewmat = np.vstack([np.column_stack([p.cam_from_world_R, p.cam_from_world_t]), np.zeros(4)])
        return right(batch, c, tape, v_image, v_alpha)._replace(viewmat=v_viewmat)

    monkeypatch.setattr(gsplat_compat, "render_one_vjp", wrong)
    assert public_case(Call("RGB", n_channels=5), rng).passed
    assert public_case(Call("RGB"), rng).note == "gradient with respect to viewmats is wrong"


def test_y_clamped_by_the_limit_of_x_is_found(monkeypatch):
    def wrong(means_cam, camera, low, high, v_jacobians):
        return pinhole_jacobians_vjp(means_cam, camera, low[[0, 0]], high[[0, 0]], v_jacobians)

    monkeypatch.setattr(reference_projection, "pinhole_jacobians_vjp", wrong)
    assert not jacobian_case(project_stage(REFERENCE, tiny_setting())).passed


def test_the_report_says_what_was_not_run(monkeypatch):
    def missing(backend):
        raise gradients.InputError("torch is missing")

    monkeypatch.setattr(gradients, "autograd_cases", missing)
    monkeypatch.setattr(gradients, "backend_stages", lambda *args: ())
    monkeypatch.setattr(gradients, "public_call_cases", lambda *args: [])
    report = gradients.check_gradients(CPU, GSPLAT_MAIN)
    assert report.settings[gradients.AUTOGRAD] == "not run: torch is missing" and report.n_failed == 0


def test_a_larger_scene_by_inner_products(backend, rng):
    setting = make_setting(rng, 60, 40, 30, GSPLAT_MAIN, sh_degree=3)
    case = inner_product_case(render_stage(backend, setting), rng)
    assert case.passed, case


def test_the_command(tmp_path, capsys, monkeypatch):
    def stages(*args):
        return (project_stage(CPU, tiny_setting()),)

    monkeypatch.setattr(gradients, "backend_stages", stages)
    monkeypatch.setattr(gradients, "autograd_cases", lambda backend: [])
    monkeypatch.setattr(gradients, "public_call_cases", lambda *args: [])
    arguments = ["oracle", "gradients", "--backend", "cpu", "--profile", "inria", "--json", str(tmp_path / "g.json")]
    assert main(arguments) == 0
    report = json.loads((tmp_path / "g.json").read_text())
    assert report["settings"]["backend"] == "cpu" and report["settings"]["profile"] == "INRIA"
    assert {"project: Jacobian", "project: inner products"} <= {case["name"] for case in report["cases"]}
    output = capsys.readouterr().out
    assert "torch autograd: " in output and "passed" in output


def test_the_command_checks_every_backend(capsys, monkeypatch):
    monkeypatch.setattr(gradients, "backend_stages", lambda backend, *args: (project_stage(backend, tiny_setting()),))
    monkeypatch.setattr(gradients, "autograd_cases", lambda backend: [])
    monkeypatch.setattr(gradients, "public_call_cases", lambda *args: [])
    monkeypatch.setattr(gradients, "PIECES", {})
    assert main(["oracle", "gradients"]) == 0
    output = capsys.readouterr().out
    assert all(f"| {name}: project: Jacobian" in output for name in BACKENDS) and len(BACKENDS) == 3


def test_the_command_fails_when_a_gradient_is_wrong(monkeypatch, capsys):
    def stages(*args):
        stage = project_stage(CPU, tiny_setting())
        return (stage._replace(vjp=lambda *v: [1.01 * gradient for gradient in stage.vjp(*v)]),)

    monkeypatch.setattr(gradients, "backend_stages", stages)
    monkeypatch.setattr(gradients, "autograd_cases", lambda backend: [])
    monkeypatch.setattr(gradients, "public_call_cases", lambda *args: [])
    assert main(["oracle", "gradients", "--backend", "cpu"]) == 1
    assert "is wrong" in capsys.readouterr().out


# --- thresholds that a function does not tell ---


def test_a_step_is_confirmed_to_what_the_proof_asks():
    """Of sin(1550 x) the derivative at 0 is 1550; a step h is wrong by (1550 h)^6 / 140, 1e-7 of it for the first."""

    def wave(x):
        return Point((np.sin(1550 * x),))

    (first,) = derivative(wave, [0 * ONE], 0, ONE, STEPS[0])
    (got,), used = settled_derivative(wave, [0 * ONE], 0, ONE)
    assert 5e-8 < abs(first[0] / 1550 - 1) < 2e-7
    assert used == STEPS[1] and abs(got[0] / 1550 - 1) < GRADIENT_REL / 100


def test_a_derivative_settles_beside_a_kink():
    def kinked(x):  # slope 1, from 1 + 2e-5 on 3
        return Point((x + 2 * np.maximum(x - (1 + 2e-5), 0),))

    (got,), used = settled_derivative(kinked, [ONE], 0, ONE)
    assert used == 1e-6 and abs(got[0] - 1) < GRADIENT_REL


@pytest.mark.parametrize("at", [1.0, 1 + 1e-10])
def test_a_derivative_on_a_kink_does_not_settle(at):
    def kinked(x):
        return Point((np.maximum(x - at, 0) ** 0.5,))

    with pytest.raises(ThresholdCrossed):
        settled_derivative(kinked, [ONE], 0, ONE)


@pytest.mark.parametrize("place", [0, 1, 2])
def test_the_largest_error_is_nan_where_one_is(place):
    """Whichever comes first: Python's ``max`` returns the larger of the others where NaN is not the first."""
    errors = [0.1, 0.3, 0.2]
    errors[place] = np.nan
    blocks = tuple(Block("y", "x", 1.0, error) for error in errors)
    assert np.isnan(JacobianCheck(blocks, 1e-6, 0).error) and np.isnan(largest_error([]))
    assert JacobianCheck(blocks[:place] + blocks[place + 1 :], 1e-6, 0).error == (0.2 if place == 1 else 0.3)


def test_a_relative_error_is_by_the_largest_value_and_absolute_up_to_the_floor():
    assert relative_error(np.array([3.0, -7.0]), np.array([4.0, -8.0])) == 1 / 8
    assert relative_error(np.array([3e-7]), np.zeros(1)) == 3e-7
    assert relative_error(np.array([3e-7]), np.array([1e-7])) == pytest.approx(2)
    assert relative_error(np.array([3e-7]), np.array([1e-7]), 1e-6) == pytest.approx(2e-7)
    assert relative_error(np.zeros(2), np.zeros(3)) == np.inf
    assert np.isnan(relative_error(np.array([np.nan, 0.0]), np.ones(2)))
    assert relative_error(np.zeros(0), np.zeros(0)) == 0.0
