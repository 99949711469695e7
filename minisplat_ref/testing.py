"""For the tests of other renderers: that a function agrees with the oracle, and where it does not.

::

    from minisplat_ref.testing import assert_matches_oracle
    from my_package import rasterization

    def test_rasterization():
        assert_matches_oracle(rasterization)
"""

from collections.abc import Callable, Sequence
from typing import Any

from minisplat_ref.constants import GSPLAT_MAIN, Conventions
from minisplat_ref.oracle.cases import Report, as_markdown
from minisplat_ref.oracle.comparison.renderers import choose_scenes
from minisplat_ref.oracle.comparison.staged import STAGES, as_report, compare_scene
from minisplat_ref.oracle.peers.function import from_function

HAS_NO_GRADIENTS = "gives no gradients: let its tensors have them, give vjp, or has_gradients=False for images alone"


def assert_matches_oracle(
    function: Callable[..., Any],
    vjp: Callable[..., Any] | None = None,
    *,
    scenes: Sequence[str] = ("all",),
    arrays: str | None = None,
    dtype: str = "float32",
    profile: Conventions = GSPLAT_MAIN,
    has_gradients: bool = True,
) -> Report:
    """Assert that a rasterizer agrees with the float64 reference, stage by stage, forward and backward.

    Parameters
    ----------
    function : callable
        With the parameters of gsplat's ``rasterization``, which are given by name: ``means`` [N, 3], ``quats`` [N, 4],
        ``scales`` [N, 3], ``opacities`` [N], ``colors`` [N, K, 3] with ``sh_degree``, or [N, D], ``viewmats``
        [1, 4, 4], ``Ks`` [1, 3, 3], ``width``, ``height``, ``backgrounds`` [1, D]; of its options those that the
        function has. Returns ``render_colors`` [1, H, W, D] and ``render_alphas`` [1, H, W, 1], and perhaps a mapping
        with gsplat's keys, such as ``means2d``: its entries are compared as well, and a failure is located better.
    vjp : callable, optional
        Takes the same, ``v_render_colors`` and ``v_render_alphas``; returns a dict of ``v_means`` and so on. Without it
        torch and JAX differentiate the function.
    scenes : sequence of str
        Names, of those that ``minisplat-ref oracle compare --help`` lists; by default all that the function can render.
    arrays : {"numpy", "torch", "jax"}, optional
        The kind of its arguments; by default the one that its module has imported.
    dtype : {"float32", "float64"}
        The dtype of its computation, and so the tolerances.
    profile : Conventions
        Its rules, where the scenes leave a choice, such as ``GSPLAT_1_5``, which clamps alpha at 0.999.
    has_gradients : bool
        Whether gradients are compared, and it is a failure to give none; otherwise images and meta alone are.

    Returns
    -------
    Report
        What was compared.

    Raises
    ------
    AssertionError
        Where it differs: names the first stage, and holds the table of all.
    InputError
        If the function cannot be called like gsplat's, or returns arrays of other shapes.
    """
    __tracebackhide__ = True  # pytest shows the line of the test
    renderer = from_function(function, vjp, arrays=arrays, dtype=dtype, profile=profile, has_gradients=has_gradients)
    rows = []
    for name in scenes:
        truths, left_out = choose_scenes(renderer, name, "reference", None)
        rows += [row for truth in truths.values() for row in compare_scene(renderer, truth)]
    report = as_report(renderer, rows, {"left_out": list(left_out)})
    not_given = report.settings["not_given"]
    if report.n_failed:
        looks_like = "".join(f"{line}\n" for line in report.settings["looks_like"])
        raise AssertionError(
            f"{report.title}\n\n{as_markdown(report)}\n\n{looks_like}not given: {', '.join(not_given) or 'nothing'}"
        )
    gradients = [stage for stage in STAGES if stage.startswith("v_")]
    if has_gradients and all(stage in not_given for stage in gradients):
        raise AssertionError(f"{renderer.name} {HAS_NO_GRADIENTS}")
    return report
