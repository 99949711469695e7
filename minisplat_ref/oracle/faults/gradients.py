"""Errors of gradients: images are right."""

from minisplat_ref.oracle.faults.backward import (
    as_planted,
    changed_project_vjp,
    scale_band,
    scale_gradient,
    scale_share,
    with_v_alpha,
    with_v_depths,
    without_clamp_of_colors,
    without_what_is_behind,
)
from minisplat_ref.oracle.faults.fault import Fault

FACTORS = (0.5,)  # any: a gradient is linear in its factor


def _scaled(what: str, where: str, stage: str, *fields: str, columns: tuple[float, ...] | None = None) -> Fault:
    """Return the fault of gradients that are off by a factor."""
    return Fault(what, where, scale_gradient(stage, *fields, columns=columns), FACTORS, 1.0)


GRADIENTS = (
    _scaled("the gradient of the centres times {}", "gradient of blending", "composite_vjp", "means2d"),
    _scaled(
        "the gradient of the conic's off-diagonal times {}",
        "gradient of blending",
        "composite_vjp",
        "conics",
        columns=(0, 1, 0),
    ),
    _scaled("the gradient of the conics times {}", "gradient of blending", "composite_vjp", "conics"),
    _scaled("the gradient of the blended opacities times {}", "gradient of blending", "composite_vjp", "opacities"),
    _scaled("the gradient of the blended colours times {}", "gradient of blending", "composite_vjp", "colors"),
    _scaled("the gradient of the background times {}", "gradient of blending", "composite_vjp", "background"),
    Fault("clamped alpha that hands its gradient on", "gradient of blending", as_planted("mean-gradient-unclamped")),
    Fault(
        "the background forgotten in the gradient of alpha", "gradient of blending", as_planted("background-forgotten")
    ),
    Fault(
        "the derivative by alpha itself times {}",
        "gradient of blending",
        with_v_alpha,
        FACTORS,
        1.0,
    ),
    Fault(
        "the Jacobian's share of the centres' gradient times {}",
        "gradient of projection",
        scale_share("pinhole_jacobians_vjp"),
        FACTORS,
        1.0,
    ),
    Fault(
        "the projected centre's share of the gradient times {}",
        "gradient of projection",
        scale_share("pinhole_vjp"),
        FACTORS,
        1.0,
    ),
    Fault(
        "the compensation's gradient times {}",
        "gradient of projection",
        scale_share("compensations_vjp"),
        FACTORS,
        1.0,
    ),
    Fault(
        "the gradient of the depths times {}",
        "gradient of projection",
        with_v_depths,
        FACTORS,
        1.0,
    ),
    Fault("S R for R S in the covariance's gradient", "gradient of projection", as_planted("transposed-rs")),
    _scaled("the covariance's gradient times {}", "gradient of projection", "project_vjp", "quats", "scales"),
    Fault(
        "the quaternion's length left out of its gradient", "gradient of projection", as_planted("unit-quats-assumed")
    ),
    _scaled("the gradient of the quaternions times {}", "gradient of projection", "project_vjp", "quats"),
    _scaled("the gradient of the scales times {}", "gradient of projection", "project_vjp", "scales"),
    Fault(
        "the gradient by log scales in place of scales",
        "gradient of projection",
        lambda _: changed_project_vjp(lambda v, a: v._replace(scales=v.scales * a[2])),
    ),
    _scaled("the gradient of the opacities times {}", "gradient of projection", "project_vjp", "opacities"),
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
        "the gradient of the view's rotation times {}",
        "gradient of projection",
        "project_vjp",
        "cam_from_world_R",
    ),
    _scaled(
        "the gradient of the view's translation times {}",
        "gradient of projection",
        "project_vjp",
        "cam_from_world_t",
    ),
    Fault(
        "the viewing direction's gradient times {}",
        "gradient of colours",
        scale_gradient("sh_colors_vjp", "means", "cam_from_world_R", "cam_from_world_t"),
        FACTORS,
        1.0,
    ),
    Fault(
        "the viewing direction's share of the means' gradient times {}",
        "gradient of colours",
        scale_gradient("sh_colors_vjp", "means"),
        FACTORS,
        1.0,
    ),
    Fault(
        "the viewing direction's share of the view's gradient times {}",
        "gradient of colours",
        scale_gradient("sh_colors_vjp", "cam_from_world_R", "cam_from_world_t"),
        FACTORS,
        1.0,
    ),
    _scaled("the gradient of the base colour times {}", "gradient of colours", "sh_colors_vjp", "sh_dc"),
    _scaled("the gradient of the harmonics times {}", "gradient of colours", "sh_colors_vjp", "sh_rest"),
    _scaled("the gradient of the means times {}", "gradient of projection", "project_vjp", "means"),
    _scaled(
        "the gradient of the view times {}",
        "gradient of projection",
        "project_vjp",
        "cam_from_world_R",
        "cam_from_world_t",
    ),
    Fault("what is behind a hit forgotten in the gradient of alpha", "gradient of blending", without_what_is_behind),
    Fault("colours clamped at 0 that hand their gradient on", "gradient of colours", without_clamp_of_colors),
    *(
        Fault(f"the gradient of degree {degree} times {{}}", "gradient of colours", scale_band(degree), FACTORS, 1.0)
        for degree in (1, 2, 3)
    ),
)
