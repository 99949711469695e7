"""Errors to plant into a copy of the package: one line of the renderer, of a loss or of Adam, changed.

Most were found to pass every check of an earlier oracle. An error in the reference is as good as one in the kernels:
what compares the two cannot tell who is wrong, but must notice.
"""

from typing import NamedTuple


class TextError(NamedTuple):
    """One change of the source."""

    what: str
    """The error, in a few words; unique."""
    file: str
    """Below the package."""
    right: str
    """What stands there, once."""
    wrong: str
    """What stands there instead."""

    @property
    def is_compiled(self) -> bool:
        """Whether kernels are made of the file."""
        return self.file.startswith(("jit/", "scalar/", "cpu/"))


_CALL = "gsplat_compat.py"
_CALL_ERRORS = (
    TextError(
        "expected depth: sign of alpha's gradient",
        _CALL,
        "v_alpha = v_alpha + v_alpha_of_depth",
        "v_alpha = v_alpha - v_alpha_of_depth",
    ),
    TextError(
        "view matrix without the harmonics' share",
        _CALL,
        "v_R, v_t = v_R + np.outer(w, lookout.cam_from_world_t), v_t - w",
        "pass",
    ),
    TextError("expected depth not divided", _CALL, "expected_depth(images[..., -1], alphas)", "images[..., -1]"),
    TextError(
        "all cameras' colours to the first",
        _CALL,
        "v_own_colors = v_colors[c] if",
        "v_own_colors = v_colors[0] if",
    ),
    TextError("camera's centre by the transpose", _CALL, "np.linalg.solve(R, t))", "R.T @ t)"),
    TextError("means without the harmonics' share", _CALL, "v_means = v_means + v_sh.means", "pass"),
)
_SPLATTING_ERRORS = (
    TextError(
        "depth channel over white",
        "splatting.py",
        "np.append(background, background.dtype.type(0))",
        "np.append(background, background.dtype.type(1))",
    ),
    TextError("depth channel's gradient lost", "splatting.py", "v.colors[:, -1].copy()", "np.zeros_like(v_depths)"),
    TextError("1 - opacity rounded", "rendering.py", "1 / (1 + np.exp(g.opacity_logits))", "1 - opacities"),
)
_HITS, _PROJECTION = "reference/hits.py", "reference/projection.py"
_REFERENCE_ERRORS = (
    TextError(
        "goes on at equality",
        _HITS,
        "transmittances > conventions.transmittance_min",
        "transmittances >= conventions.transmittance_min",
    ),
    TextError(
        "stops at equality (3DGS)",
        _HITS,
        "return transmittances >= conventions.transmittance_min",
        "return transmittances > conventions.transmittance_min",
    ),
    TextError("skips at equality", _HITS, "alphas >= conventions.alpha_min", "alphas > conventions.alpha_min"),
    TextError("clamps at equality", _HITS, "unclamped > conventions.alpha_max", "unclamped >= conventions.alpha_max"),
    TextError(
        "drawn on the near plane", _PROJECTION, "conventions.near_plane < depths", "conventions.near_plane <= depths"
    ),
    TextError(
        "drawn on the far plane", _PROJECTION, "depths < conventions.far_plane", "depths <= conventions.far_plane"
    ),
    TextError("near plane at 0", _PROJECTION, "conventions.near_plane < depths", "0 < depths"),
    TextError(
        "drawn behind the camera",
        _PROJECTION,
        "conventions.near_plane < depths",
        "conventions.near_plane < np.abs(depths)",
    ),
    TextError("no far plane", _PROJECTION, "(depths < conventions.far_plane)", "(depths < np.inf)"),
    TextError(
        "y clamped by the limits of x, backward",
        "reference/pinhole.py",
        "v_slopes = np.where((low < slopes) & (slopes < high)",
        "v_slopes = np.where((low[0] < slopes) & (slopes < high[0])",
    ),
    TextError(
        "a clamped colour has a gradient",
        "reference/spherical_harmonics.py",
        "np.where(_unclamped(basis, coefficients) > 0, v_colors[rows], 0)",
        "v_colors[rows]",
    ),
    TextError(
        "median at equality",
        "reference/compositing.py",
        "tile.transmittances[1:] < MEDIAN_TRANSMITTANCE",
        "tile.transmittances[1:] <= MEDIAN_TRANSMITTANCE",
    ),
    TextError(
        "largest weight summed",
        "reference/compositing.py",
        "np.maximum(stats.blend_weight_max[ids], weights.max(axis=1))",
        "stats.blend_weight_max[ids] + weights.max(axis=1)",
    ),
    TextError(
        "hits counted by the clamp",
        "reference/compositing.py",
        "(weights > 0).sum",
        "(weights > 0.01).sum",
    ),
    TextError(
        "expected depth's gradient, reference",
        "reference/depth.py",
        "-v_accumulated_depth * expected_depth",
        "v_accumulated_depth * expected_depth",
    ),
    TextError(
        "surface at half the chord",
        "reference/depth.py",
        'np.einsum("pi,pi->p", a, b) / np.einsum("pi,pi->p", b, b)  # [P]',
        'np.einsum("pi,pi->p", a, b) / np.einsum("pi,pi->p", b, b) / 2  # [P]',
    ),
)
_LOSS_AND_ADAM_ERRORS = (
    TextError(
        "masked pixels leak into windows",
        "reference/loss.py",
        "    image = np.where(mask[:, :, None], image, target)\n",
        "",
    ),
    TextError(
        "mean over all pixels, not the mask",
        "reference/loss.py",
        "np.abs(image - target)[mask]",
        "np.abs(image - target)",
    ),
    TextError("bytes divided by 256", "reference/loss.py", "255 if target.dtype", "256 if target.dtype"),
    TextError(
        "eps inside the root",
        "reference/adam.py",
        "(np.sqrt(v) + step.eps)",
        "np.sqrt(v + step.eps)",
    ),
    TextError("beta2 for the mean", "reference/adam.py", "(1 - step.beta1) * (g - m)", "(1 - step.beta2) * (g - m)"),
    TextError("all rows stepped", "reference/adam.py", "slice(None) if rows is None else rows", "slice(None)"),
    TextError(
        "correction of the step before", "training/adam.py", "step = state.step + 1\n", "step = max(1, state.step)\n"
    ),
    TextError(
        "eps not corrected", "training/adam.py", "eps = rule.eps * (math.sqrt", "eps = rule.eps * max(1.0, math.sqrt"
    ),
)
_KERNEL_ERRORS = (
    TextError(
        "kernel: y clamped by the limits of x, forward",
        "scalar/projection.py",
        "smaller(larger(y, lens.y_min), lens.y_max), V[1], V[2])",
        "smaller(larger(y, lens.x_min), lens.x_max), V[1], V[2])",
    ),
    TextError(
        "kernel: y clamped by the limits of x, backward",
        "scalar/projection.py",
        "(y > lens.y_min) & (y < lens.y_max)",
        "(y > lens.x_min) & (y < lens.x_max)",
    ),
    TextError(
        "kernel: stops by the other rule",
        "cpu/compositing/tile_state.py",
        "if conventions.stops_at_equality",
        "if not conventions.stops_at_equality",
    ),
    TextError(
        "kernel: skips at equality", "scalar/compositing.py", "is_hit = alpha >= frame", "is_hit = alpha > frame"
    ),
    TextError(
        "kernel: clamps at equality",
        "cpu/compositing/backward.py",
        "q_shape = select(unclamped <= frame",
        "q_shape = select(unclamped < frame",
    ),
    TextError("kernel: drawn on the near plane", "cpu/projection.py", "p[2] > lens.near", "p[2] >= lens.near"),
    TextError("kernel: eps inside the root", "scalar/adam.py", "(sqrt(second) + step.eps)", "sqrt(second + step.eps)"),
    TextError(
        "kernel: fourth channel without its shade",
        "cpu/compositing/backward.py",
        "shade = shade + v * records[n, COLOR + k]",
        "pass",
    ),
    TextError(
        "kernel: median at equality",
        "cpu/compositing/forward.py",
        "is_crossing = (after < MEDIAN) & (after + weight >= MEDIAN)",
        "is_crossing = (after <= MEDIAN) & (after + weight > MEDIAN)",
    ),
    TextError(
        "kernel: a clamped colour has a gradient",
        "cpu/spherical_harmonics.py",
        "select(green > ZERO, gather(v_colors, rows, 1), ZERO)",
        "gather(v_colors, rows, 1)",
    ),
    TextError("kernel: masked pixels have a gradient", "cpu/loss/__init__.py", "v_image[~mask] = 0", "pass"),
    TextError(
        "kernel: pivot of needles kept too large", "scalar/compositing.py", "np.float32(1e-14)", "np.float32(1e-4)"
    ),
)

ERRORS = (*_CALL_ERRORS, *_SPLATTING_ERRORS, *_REFERENCE_ERRORS, *_LOSS_AND_ADAM_ERRORS, *_KERNEL_ERRORS)
"""In the order of the table."""
