"""The two losses of MVG-Splatting beside the photometric one: on depth steps, and on normals.

The depth is the expected one. Steps are in units of the scene's extent, so that a weight serves scenes of all sizes.
Normals are compared with those of the depth map after the bilateral filter, and the gradient passes through the filter,
which is linear.
"""

from minisplat_ref.extensions.mvg.insertion import WIDTHS
from minisplat_ref.extensions.mvg.reference import edge_aware_steps, edge_aware_steps_vjp
from minisplat_ref.mechanisms.depth_maps.bilateral import joint_bilateral_depth, joint_bilateral_depth_vjp
from minisplat_ref.mechanisms.surfels.disagreement import disagree
from minisplat_ref.reference.depth import expected_depth, expected_depth_vjp
from minisplat_ref.training.losses import Cotangents, Rendered
from minisplat_ref.types import Floats


def depth_steps(rendered: Rendered, *, sharpness: float) -> tuple[float, Cotangents]:
    """Return the edge-aware steps of the expected depth, and their derivatives."""
    sums, alpha = rendered.channel("depth")[..., 0], rendered.output.alpha
    depth, photograph, unit = expected_depth(sums, alpha), _photograph(rendered), rendered.scene.extent
    value = edge_aware_steps(depth, photograph, sharpness) / unit
    v_depth = edge_aware_steps_vjp(depth, photograph, sharpness) / depth.dtype.type(unit)
    v_sums, v_alpha = expected_depth_vjp(sums, alpha, v_depth)
    return value, Cotangents({"depth": v_sums[..., None]}, v_alpha)


def filtered_normals(rendered: Rendered) -> tuple[float, Cotangents]:
    """Return the deviation of surfels' normals from the surface through the filtered depths, and the derivatives.

    ``v_D'`` is that of :func:`minisplat_ref.mechanisms.surfels.disagreement.disagree`; ``v_D`` follows from it
    through the filter.
    """
    sums, alpha = rendered.channel("depth")[..., 0], rendered.output.alpha
    depth, photograph = expected_depth(sums, alpha), _photograph(rendered)
    found = disagree(rendered, joint_bilateral_depth(depth, photograph, WIDTHS))
    v_depth = joint_bilateral_depth_vjp(depth, photograph, found.v_depth, WIDTHS)
    v_sums, v_alpha = expected_depth_vjp(sums, alpha, v_depth)
    return found.value, Cotangents({"normal": found.v_normal, "depth": v_sums[..., None]}, v_alpha + found.v_alpha)


def _photograph(rendered: Rendered) -> Floats:
    dtype = rendered.output.alpha.dtype
    photograph: Floats = rendered.view.image.astype(dtype) / dtype.type(255)
    return photograph
