"""Planted errors with a size, from which the signatures of errors are measured.

:mod:`minisplat_ref.oracle.planted` has errors that the oracle must find; these are the ones that it must tell apart.
Each changes one formula of a backend. A fault of a forward formula has its own derivative, so that its gradients are
consistent with its images. Most have a size, such as the factor by which a gradient is off: the table of signatures is
measured at one size, and judged at others (:mod:`minisplat_ref.oracle.comparison.signatures`).
"""

from collections.abc import Callable
from typing import NamedTuple

from minisplat_ref.oracle.faults.backward import (
    as_planted,
    changed_project_vjp,
    scale_gradient,
    scale_share,
    with_v_alpha,
    with_v_depths,
)
from minisplat_ref.oracle.faults.forward import (
    sorted_from_behind,
    with_background,
    with_bands,
    with_blended_conics,
    with_blended_opacities,
    with_conics,
    with_directions_from_the_origin,
    with_distances,
    with_lighter_colors,
    with_negative_colors,
    with_rolled_quats,
    with_rules,
    with_scales,
    with_slope_limits,
    with_unnormalised_quats,
    with_unsquared_scales,
    without_highest_band,
    without_rotation,
)
from minisplat_ref.oracle.planted import change_camera
from minisplat_ref.rendering.backends import REFERENCE, Backend


class Fault(NamedTuple):
    """A kind of error."""

    what: str
    """The error, in words that end a sentence: "as with ..."."""
    where: str
    """The stage of which a formula is wrong: ``projection``, ``colours``, ``blending``, or their ``gradient``."""
    plant: Callable[[float], Backend]
    """Returns a backend that is wrong by a size."""
    size: float = 1.0
    """At which its signature is measured."""
    others: tuple[float, ...] = ()
    """Further sizes, at which the signatures are judged."""


def _scaled(what: str, where: str, stage: str, *fields: str, columns: tuple[float, ...] | None = None) -> Fault:
    """Return the fault of gradients that are off by a factor; the signature is measured at one half."""
    return Fault(what, where, scale_gradient(stage, *fields, columns=columns), 0.5, (0.8, 1.5, -1.0))


FAULTS = (
    Fault(
        "pixel centres that are off",
        "projection",
        lambda d: change_camera(REFERENCE, lambda c: c._replace(cx=c.cx - d, cy=c.cy - d)),
        0.5,
        (0.25, 0.05),
    ),
    Fault(
        "a focal length that is off",
        "projection",
        lambda d: change_camera(REFERENCE, lambda c: c._replace(fx=c.fx * (1 + d), fy=c.fy * (1 + d))),
        0.02,
        (0.005, -0.1),
    ),
    Fault(
        "fx and fy exchanged", "projection", lambda _: change_camera(REFERENCE, lambda c: c._replace(fx=c.fy, fy=c.fx))
    ),
    Fault("the view's rotation transposed in J R", "projection", as_planted("transposed-view")),
    Fault(
        "another low-pass",
        "projection",
        lambda d: with_rules(lambda c: {"eps2d": max(0.0, c.eps2d + d)}),
        -0.3,
        (0.3, -0.1),
    ),
    Fault("another clamp of the Jacobian's slopes", "projection", with_slope_limits, 100.0, (1.2, 0.8)),
    Fault("quaternions read as xyzw", "projection", with_rolled_quats),
    Fault("quaternions that are not normalised", "projection", with_unnormalised_quats),
    Fault("a covariance without its rotation", "projection", without_rotation),
    Fault("scales that are not squared", "projection", with_unsquared_scales),
    Fault("scales that are off by a factor", "projection", with_scales, 1.1, (1.02, 0.7)),
    Fault(
        "the conic's off-diagonal off by a factor in the projection",
        "projection",
        lambda f: with_conics((1, f, 1)),
        0.5,
        (0.8, -1.0),
    ),
    Fault("conics off by a factor in the projection", "projection", lambda f: with_conics((f, f, f)), 1.1, (0.9, 2.0)),
    Fault("the conic's diagonal exchanged", "projection", lambda _: with_conics((1, 1, 1), (2, 1, 0))),
    Fault(
        "opacities that are not compensated", "projection", lambda _: with_rules(lambda c: {"is_antialiased": False})
    ),
    Fault("Gaussians cut at three deviations", "projection", as_planted("three-sigma")),
    Fault(
        "another near plane",
        "projection",
        lambda f: with_rules(lambda c: {"near_plane": f * c.near_plane}),
        2.0,
        (0.1, 1.3),
    ),
    Fault("distances in place of depths", "projection", with_distances),
    Fault("the sign of Y_2-1", "colours", as_planted("sh-sign")),
    Fault("colours off by a constant, such as the 0.5", "colours", with_lighter_colors, -0.5, (0.1, 0.02)),
    Fault("viewing directions reversed", "colours", lambda _: with_bands(lambda degree: (-1.0) ** degree)),
    Fault("viewing directions from the world's origin", "colours", with_directions_from_the_origin),
    Fault("colours that are not clamped at 0", "colours", with_negative_colors),
    Fault("the highest band of the harmonics missing", "colours", without_highest_band),
    Fault(
        "a band of the harmonics off by a factor",
        "colours",
        lambda f: with_bands(lambda degree: f if degree == 1 else 1.0),
        0.5,
        (0.9, -1.0),
    ),
    Fault("a wrong order of the depths", "blending", as_planted("unsorted-depth")),
    Fault("Gaussians blended from behind", "blending", sorted_from_behind),
    Fault("another clamp of alpha", "blending", lambda d: with_rules(lambda c: {"alpha_max": d}), 0.999, (0.95, 0.9)),
    Fault(
        "another least alpha",
        "blending",
        lambda f: with_rules(lambda c: {"alpha_min": f * c.alpha_min}),
        0.0,
        (3.0, 0.5),
    ),
    Fault(
        "another stop of the transmittance",
        "blending",
        lambda f: with_rules(lambda c: {"transmittance_min": f * c.transmittance_min}),
        100.0,
        (0.0, 10.0),
    ),
    Fault("the background missing", "blending", with_background, 0.0, (0.5, 1.1)),
    Fault(
        "an exponent off by a factor, such as the half",
        "blending",
        lambda f: with_blended_conics(f, f, f),
        2.0,
        (1.1, 0.5),
    ),
    Fault(
        "the conic's off-diagonal off by a factor in the exponent",
        "blending",
        lambda f: with_blended_conics(1, f, 1),
        0.5,
        (0.8, -1.0),
    ),
    Fault("opacities off by a factor in alpha", "blending", with_blended_opacities, 0.9, (0.98, 0.5)),
    _scaled("the gradient of the centres off by a factor", "gradient of blending", "composite_vjp", "means2d"),
    _scaled(
        "the gradient of the conic's off-diagonal halved, or off by another factor",
        "gradient of blending",
        "composite_vjp",
        "conics",
        columns=(0, 1, 0),
    ),
    _scaled("the gradient of the conics off by a factor", "gradient of blending", "composite_vjp", "conics"),
    _scaled(
        "the gradient of the blended opacities off by a factor", "gradient of blending", "composite_vjp", "opacities"
    ),
    _scaled("the gradient of the blended colours off by a factor", "gradient of blending", "composite_vjp", "colors"),
    _scaled("the gradient of the background off by a factor", "gradient of blending", "composite_vjp", "background"),
    Fault("clamped alpha that hands its gradient on", "gradient of blending", as_planted("mean-gradient-unclamped")),
    Fault(
        "the background forgotten in the gradient of alpha", "gradient of blending", as_planted("background-forgotten")
    ),
    Fault("the derivative by alpha itself forgotten", "gradient of blending", with_v_alpha, 0.0, (0.5, 2.0)),
    Fault(
        "the Jacobian's share of the centres' gradient forgotten",
        "gradient of projection",
        scale_share("pinhole_jacobians_vjp"),
        0.0,
        (0.5, -1.0),
    ),
    Fault(
        "the projected centre's share of the gradient forgotten",
        "gradient of projection",
        scale_share("pinhole_vjp"),
        0.0,
        (0.5, -1.0),
    ),
    Fault(
        "the compensation's gradient forgotten",
        "gradient of projection",
        scale_share("compensations_vjp"),
        0.0,
        (0.5, 2.0),
    ),
    Fault("the gradient of the depths forgotten", "gradient of projection", with_v_depths, 0.0, (0.5, -1.0)),
    Fault("S R for R S in the covariance's gradient", "gradient of projection", as_planted("transposed-rs")),
    _scaled("the covariance's gradient off by a factor", "gradient of projection", "project_vjp", "quats", "scales"),
    Fault(
        "the quaternion's length left out of its gradient", "gradient of projection", as_planted("unit-quats-assumed")
    ),
    _scaled("the gradient of the quaternions off by a factor", "gradient of projection", "project_vjp", "quats"),
    _scaled("the gradient of the scales off by a factor", "gradient of projection", "project_vjp", "scales"),
    Fault(
        "the gradient by log scales in place of scales",
        "gradient of projection",
        lambda _: changed_project_vjp(lambda v, a: v._replace(scales=v.scales * a[2])),
    ),
    _scaled("the gradient of the opacities off by a factor", "gradient of projection", "project_vjp", "opacities"),
    Fault(
        "the gradient by logits in place of opacities",
        "gradient of projection",
        lambda _: changed_project_vjp(lambda v, a: v._replace(opacities=v.opacities * a[3] * (1 - a[3]))),
    ),
    Fault(
        "the means' gradient left in the camera's frame",
        "gradient of projection",
        lambda _: changed_project_vjp(lambda v, a: v._replace(means=v.means @ a[4].cam_from_world_R.T)),
    ),
    Fault("the gradient of the view's rotation transposed", "gradient of projection", as_planted("transposed-pose")),
    _scaled(
        "the gradient of the view's rotation off by a factor",
        "gradient of projection",
        "project_vjp",
        "cam_from_world_R",
    ),
    _scaled(
        "the gradient of the view's translation off by a factor",
        "gradient of projection",
        "project_vjp",
        "cam_from_world_t",
    ),
    Fault(
        "colours that do not move with the viewing direction",
        "gradient of colours",
        scale_gradient("sh_colors_vjp", "means", "cam_from_world_R", "cam_from_world_t"),
        0.0,
        (0.5, -1.0),
    ),
    Fault(
        "the viewing direction's share of the means' gradient off",
        "gradient of colours",
        scale_gradient("sh_colors_vjp", "means"),
        0.0,
        (0.5, -1.0),
    ),
    Fault(
        "the viewing direction's share of the view's gradient off",
        "gradient of colours",
        scale_gradient("sh_colors_vjp", "cam_from_world_R", "cam_from_world_t"),
        0.0,
        (0.5, -1.0),
    ),
    _scaled("the gradient of the base colour off by a factor", "gradient of colours", "sh_colors_vjp", "sh_dc"),
    _scaled("the gradient of the harmonics off by a factor", "gradient of colours", "sh_colors_vjp", "sh_rest"),
)
"""In the order of the pipeline, forward before backward."""
