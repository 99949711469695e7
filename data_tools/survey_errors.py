"""Errors to plant, one at a time: one line of the renderer, of a loss or of Adam, changed.

Most were found to pass every check of an earlier oracle. An error in the reference is as good as one in the kernels:
what compares the two cannot tell which of them is wrong, but must notice.
"""

from typing import NamedTuple


class PlantedLine(NamedTuple):
    """One change of the source."""

    what: str
    """The error, in a few words; unique."""
    where: str
    """``module:function`` below the package."""
    right: str
    """What stands in the function, once."""
    wrong: str
    """What stands there instead."""
    is_compiled: bool = False
    """Whether the function becomes part of a kernel; such an error stands once in its whole module."""


_CALL = (
    PlantedLine(
        "expected depth: sign of alpha's gradient",
        "gsplat.call:_batch_vjp",
        "v_alpha + v_alpha_of_depth",
        "v_alpha - v_alpha_of_depth",
    ),
    PlantedLine(
        "view matrix without the harmonics' share",
        "gsplat.call:render_one_vjp",
        "v_R, v_t = v_R + np.outer(w, unrotated.cam_from_world_t), v_t - w",
        "pass",
    ),
    PlantedLine(
        "means without the harmonics' share", "gsplat.call:render_one_vjp", "v_means = v_means + v_sh.means", "pass"
    ),
    PlantedLine(
        "expected depth not divided",
        "gsplat.call:rasterization",
        "expected_depth(images[..., -1], alphas)",
        "images[..., -1]",
    ),
    PlantedLine("colours of all cameras to the first", "gsplat.call:_batch_vjp", "v_colors[c] if", "v_colors[0] if"),
    PlantedLine("camera's centre by the transpose", "gsplat.call:remove_rotation", "np.linalg.solve(R, t)", "R.T @ t"),
    PlantedLine(
        "depths over white", "rendering.splatting:append_depths", "background.dtype.type(0)", "background.dtype.type(1)"
    ),
    PlantedLine(
        "gradient of depths lost",
        "rendering.splatting:splat_vjp",
        "v.colors[:, -1].copy()",
        "np.zeros_like(projection.depths)",
    ),
    PlantedLine(
        "1 - opacity rounded",
        "rendering.renderer:activate_vjp",
        "1 / (1 + np.exp(opacity_logits))",
        "1 - primitives.opacities",
    ),
)
_EQUALITY = (
    PlantedLine(
        "continues where T equals the stop",
        "reference.hits:is_accepted",
        "transmittances > conventions",
        "transmittances >= conventions",
    ),
    PlantedLine(
        "stops where T equals the stop, 3DGS's rule",
        "reference.hits:is_accepted",
        "transmittances >= conventions",
        "transmittances > conventions",
    ),
    PlantedLine(
        "skips at alpha_min",
        "reference.hits:tile_hits",
        "alphas >= conventions.alpha_min",
        "alphas > conventions.alpha_min",
    ),
    PlantedLine(
        "clamps at alpha_max",
        "reference.hits:tile_hits",
        "hit.unclamped > conventions.alpha_max",
        "hit.unclamped >= conventions.alpha_max",
    ),
    PlantedLine(
        "median where T equals one half",
        "reference.blend_stats:median_depths",
        "(T >= MEDIAN_TRANSMITTANCE) & (T * (1 - tile.alphas) < MEDIAN_TRANSMITTANCE)",
        "(T > MEDIAN_TRANSMITTANCE) & (T * (1 - tile.alphas) <= MEDIAN_TRANSMITTANCE)",
    ),
    PlantedLine(
        "drawn on the near plane",
        "reference.projection:project",
        "conventions.near_plane < depths",
        "conventions.near_plane <= depths",
    ),
    PlantedLine(
        "drawn on the far plane",
        "reference.projection:project",
        "depths < conventions.far_plane",
        "depths <= conventions.far_plane",
    ),
    PlantedLine(
        "kernels: the other rule of stopping",
        "cpu.compositing.tile_state:pack_frame",
        "if conventions.stops_at_equality",
        "if not conventions.stops_at_equality",
    ),
    PlantedLine(
        "kernels: skip at alpha_min",
        "cpu.compositing.tile_state:pack_frame",
        "conventions.alpha_min,",
        "np.nextafter(conventions.alpha_min, 1.0),",
    ),
    PlantedLine(
        "kernels: clamp at alpha_max",
        "cpu.compositing.tile_state:pack_frame",
        "conventions.alpha_max if conventions.clamp_stops_shape_gradient",
        "np.nextafter(conventions.alpha_max, 0.0) if conventions.clamp_stops_shape_gradient",
    ),
    PlantedLine(
        "kernels: drawn on the near plane",
        "cpu.projection:pack_constants",
        "conventions.near_plane, conv",
        "np.nextafter(conventions.near_plane, 0.0), conv",
    ),
)
_PROJECTION = (
    PlantedLine(
        "near plane at the camera", "reference.projection:project", "conventions.near_plane < depths", "0 < depths"
    ),
    PlantedLine(
        "drawn behind the camera",
        "reference.projection:project",
        "conventions.near_plane < depths",
        "conventions.near_plane < np.abs(depths)",
    ),
    PlantedLine("no far plane", "reference.projection:project", "depths < conventions.far_plane", "depths < np.inf"),
    PlantedLine(
        "gradient of y by the limits of x",
        "reference.pinhole:pinhole_jacobians_vjp",
        "(low < slopes) & (slopes < high)",
        "(low[0] < slopes) & (slopes < high[0])",
    ),
    PlantedLine(
        "kernels: y clamped by the limit of x",
        "cpu.projection:pack_constants",
        "(camera.height - cy) / camera.fy + margin * tan_y",
        "(camera.width - cx) / camera.fx + margin * tan_x",
    ),
    PlantedLine(
        "kernels: gradient of y by the limits of x",
        "scalar.projection:project_gaussian_vjp",
        "(y > constants.y_min) & (y < constants.y_max)",
        "(y > constants.x_min) & (y < constants.x_max)",
        is_compiled=True,
    ),
)
_BLENDING = (
    PlantedLine(
        "colour clamped at 0 has a gradient",
        "reference.spherical_harmonics:sh_colors_vjp",
        "np.where(_unclamped(basis, coefficients) > 0, v_colors[rows], 0)",
        "v_colors[rows]",
    ),
    PlantedLine(
        "largest weight summed over tiles",
        "reference.blend_stats:add_tile_stats",
        "np.maximum(stats.blend_weight_max[ids], weights.max(axis=1))",
        "stats.blend_weight_max[ids] + weights.max(axis=1)",
    ),
    PlantedLine(
        "faint hits not counted", "reference.blend_stats:add_tile_stats", "(weights > 0).sum", "(weights > 1e-4).sum"
    ),
    PlantedLine(
        "last of the largest weights dominates",
        "reference.compositing:composite_hits",
        "np.argmax(weights, axis=0)",
        "len(tile.ids) - 1 - np.argmax(weights[::-1], axis=0)",
    ),
    PlantedLine(
        "expected depth's gradient",
        "reference.depth:expected_depth_vjp",
        "-v_accumulated_depth * expected_depth",
        "v_accumulated_depth * expected_depth",
    ),
    PlantedLine(
        "surface at the chord's end",
        "reference.depth:surface_points",
        'np.einsum("pi,pi->p", a, b) /',
        '(np.einsum("pi,pi->p", a, b) - 1) /',
    ),
    PlantedLine(
        "kernels: fourth channel without its share of alpha's gradient",
        "cpu.compositing.backward:backward_kernel",
        "v_dot_c = v_dot_c + v * records[n, COLOR + k]",
        "pass",
        is_compiled=True,
    ),
    PlantedLine(
        "kernels: median where T equals one half",
        "cpu.compositing.forward:forward_kernel",
        "(after < MEDIAN) & (after + weight >= MEDIAN)",
        "(after <= MEDIAN) & (after + weight > MEDIAN)",
        is_compiled=True,
    ),
)
_LOSS_AND_ADAM = (
    PlantedLine(
        "masked pixels leak into windows",
        "reference.loss:photometric_loss",
        "image = np.where(mask[:, :, None], image, target)",
        "pass",
    ),
    PlantedLine(
        "mean over all pixels, not the mask",
        "reference.loss:photometric_loss",
        "np.abs(image - target)[mask]",
        "np.abs(image - target)",
    ),
    PlantedLine(
        "bytes divided by 256", "reference.loss:photometric_loss", "255 if target.dtype", "256 if target.dtype"
    ),
    PlantedLine(
        "kernels: masked pixels have a gradient",
        "cpu.loss:photometric_loss",
        "v_image[~mask] = 0",
        "v_image[~mask] = 1e-6",
    ),
    PlantedLine(
        "eps inside the root", "reference.adam:adam_update", "(np.sqrt(v) + step.eps)", "np.sqrt(v + step.eps)"
    ),
    PlantedLine(
        "beta2 for the mean", "reference.adam:adam_update", "(1 - step.beta1) * (g - m)", "(1 - step.beta2) * (g - m)"
    ),
    PlantedLine(
        "all rows stepped", "reference.adam:adam_update", "slice(None) if rows is None else rows", "slice(None)"
    ),
    PlantedLine(
        "corrections of the step before",
        "training.adam:adam_step",
        "state.step + 1 - state.joined.get(name, 0)",
        "max(1, state.step - state.joined.get(name, 0))",
    ),
    PlantedLine(
        "eps without its correction",
        "training.adam:_field_update",
        "rule.eps * root",
        "rule.eps",
    ),
    PlantedLine(
        "kernels: eps inside the root",
        "scalar.adam:adam_value",
        "(sqrt(second) + step.eps)",
        "sqrt(second + step.eps)",
        is_compiled=True,
    ),
)

ERRORS = (*_CALL, *_EQUALITY, *_PROJECTION, *_BLENDING, *_LOSS_AND_ADAM)
"""In the order of the table."""
