"""Gradients of views are compared on the tangent of SE(3): by hand, and through whole renderers."""

from dataclasses import replace

import numpy as np
import pytest

from minisplat_ref.gsplat import call as gsplat_compat
from minisplat_ref.oracle.comparison.renderers import from_backend
from minisplat_ref.oracle.comparison.staged import compare_scene, first_divergence
from minisplat_ref.oracle.golden.scenes import RECIPES, inputs, truth
from minisplat_ref.oracle.tangent import on_tangent, turning
from minisplat_ref.rendering.backends import REFERENCE
from minisplat_ref.testing import assert_matches_oracle

TURN = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])  # 90 degrees about z
SCENE = ("odd-size",)


def test_a_turn_by_hand():
    """Of L = R_00 at R = 1 + [w]x every entry of the diagonal stands still; of L = R_10 it is w_z that moves it."""
    v_R = np.zeros((3, 3))
    v_R[0, 0] = 1
    assert np.array_equal(turning(v_R, np.eye(3)), [0, 0, 0])
    v_R = np.zeros((3, 3))
    v_R[1, 0] = 5
    assert np.array_equal(turning(v_R, np.eye(3)), [0, 0, 5])
    assert np.array_equal(turning(v_R, TURN), [0, 0, 0])  # d(R [w]x)_10 = -d(R)_11 w_z .. = R_10 ([w]x)_00 = 0
    v_R = np.zeros((3, 3))
    v_R[0, 0] = 5  # R'_00 = R_01 w_z = -w_z
    assert np.array_equal(turning(v_R, TURN), [0, 0, -5])


def test_what_is_across_the_rotations_is_not_seen():
    """R S with S symmetric is the normal space: |R|^2 and R^T R do not move on the rotations."""
    rng = np.random.default_rng(0)
    R = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    S = rng.normal(size=(3, 3))
    view = np.column_stack([R, rng.normal(size=3)])
    v = rng.normal(size=(2, 4, 4))
    across = np.zeros((4, 4))
    across[:3, :3] = R @ (S + S.T)
    across[3] = 7  # the last row of a view matrix is fixed
    views = np.stack([np.vstack([view, [0, 0, 0, 1]])] * 2)
    assert np.allclose(on_tangent(v + across, views), on_tangent(v, views), atol=1e-14)
    assert np.array_equal(on_tangent(v, views)[:, 3:], v[:, :3, 3])


def test_finite_differences_of_a_function_of_the_view():
    rng = np.random.default_rng(1)
    R, A = np.linalg.qr(rng.normal(size=(3, 3)))[0], rng.normal(size=(3, 3))

    def moved(w):
        x, y, z = w
        return R @ (np.eye(3) + np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]))

    expected = [(np.sum(A * moved(1e-6 * e)) - np.sum(A * moved(-1e-6 * e))) / 2e-6 for e in np.eye(3)]
    assert np.allclose(turning(A, R), expected, rtol=1e-8)


def transposed_centre(v, viewmat):
    """The gradient of a renderer whose camera centre is -R^T t, from that of one with -R^-1 t.

    With v_o = -R w they differ by what the centre's derivative is off the rotations: o = -R^T t has v_R = -t v_o^T, and
    o = -R^-1 t has v_R = -w o^T with w = R v_o; both have v_t = -w.
    """
    R, t = viewmat[:3, :3], viewmat[:3, 3]
    v_o = np.array([0.3, -0.2, 0.5])
    changed = v.copy()
    changed[:3, :3] += -np.outer(t, v_o) + np.outer(R @ v_o, -R.T @ t)
    return changed


def function(**given):
    return gsplat_compat.rasterization(**given)


def test_another_spelling_of_the_camera_centre_is_no_error():
    def vjp(**given):
        v = gsplat_compat.rasterization_vjp(**given)
        changed = transposed_centre(v["v_viewmats"][0], given["viewmats"][0])
        assert np.abs(changed - v["v_viewmats"][0]).max() > 0.1  # the entries are others
        return {**v, "v_viewmats": changed[None]}

    assert assert_matches_oracle(function, vjp, scenes=SCENE, dtype="float64").n_failed == 0


@pytest.mark.parametrize("entry", [(0, 1), (2, 2), (1, 3)])
def test_a_wrong_gradient_of_the_view_is_one(entry, monkeypatch):
    """Any entry moves one of the six components, at a rotation that is not along the axes; no fault is looked for."""
    monkeypatch.setattr("minisplat_ref.oracle.comparison.staged.hints_of", lambda rows: ([], []))

    def vjp(**given):
        v = gsplat_compat.rasterization_vjp(**given)
        changed = v["v_viewmats"].copy()
        changed[0, *entry] *= 1.01
        return {**v, "v_viewmats": changed}

    with pytest.raises(AssertionError, match="first stage that diverges is v_view"):
        assert_matches_oracle(function, vjp, scenes=SCENE, dtype="float64")


def test_stages_are_compared_on_it_too():
    scene = truth(inputs(next(recipe for recipe in RECIPES if recipe.name == "sh3")))
    R = scene.arrays["cam_from_world_R"]

    def changed(by):
        def sh_colors_vjp(*args):
            v = REFERENCE.sh_colors_vjp(*args)
            return v._replace(cam_from_world_R=v.cam_from_world_R + by)

        return from_backend(replace(REFERENCE, sh_colors_vjp=sh_colors_vjp), "float64")

    assert first_divergence(compare_scene(changed(R @ np.diag([1.0, 2, 3])), scene)) is None
    row = first_divergence(compare_scene(changed(R @ np.diag([1.0, 2, 3]) @ TURN), scene))
    assert row.stage == "v_R" and row.arrays == ("v_R_colors",)


def test_images_alone():
    """A wrong gradient is not compared, and a vjp not called."""

    def vjp(**_):
        raise RuntimeError("called")

    assert assert_matches_oracle(function, vjp, scenes=SCENE, has_gradients=False).n_failed == 0


def test_images_alone_in_jax():
    jax = pytest.importorskip("jax")
    from jax_renderer import rasterization

    def wrong(scales, **arguments):
        return rasterization(scales=jax.lax.stop_gradient(scales), **arguments)

    report = assert_matches_oracle(wrong, arrays="jax", scenes=SCENE, dtype="float64", has_gradients=False)
    assert report.n_failed == 0 and not [case.name for case in report.cases if case.name.startswith("v_")]


def test_a_jax_renderer_with_the_usual_centre_agrees(monkeypatch):
    jax = pytest.importorskip("jax")
    import jax_renderer

    def transposed(matrix):
        R, t = matrix[:3, :3], matrix[:3, 3]
        return jax.numpy.eye(4).at[:3, :3].set(R.T).at[:3, 3].set(-R.T @ t)

    monkeypatch.setattr(jax.numpy.linalg, "inv", transposed)
    report = assert_matches_oracle(jax_renderer.rasterization, scenes=SCENE, dtype="float64")
    assert report.n_failed == 0 and "v_view" in [case.name for case in report.cases]


def test_a_jax_function_is_compiled_where_it_can_be():
    jax = pytest.importorskip("jax")
    from jax_renderer import rasterization

    seen = []

    def traced(means, **arguments):
        seen.append(isinstance(means, jax.core.Tracer))
        return rasterization(means, **arguments)

    def peeking(means, Ks, **arguments):
        assert float(Ks[0, 0, 0]) > 0  # not to be traced
        return rasterization(means, Ks=Ks, **arguments)

    assert assert_matches_oracle(traced, arrays="jax", scenes=SCENE, has_gradients=False).n_failed == 0
    assert seen and all(seen)
    assert assert_matches_oracle(peeking, arrays="jax", scenes=SCENE, has_gradients=False).n_failed == 0
