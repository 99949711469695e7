"""Errors in other people's renderers, each a line of source that is replaced, and what a first hint has to say of them.

None was made of the package's own faults, to which the two that were missed have been added since. Some change a
formula in a way that no planted fault has; then the hint has to name the formula. ``SOUND`` are replacements that
change nothing but the spelling.
"""

import re
import types
from pathlib import Path
from typing import NamedTuple

HERE = Path(__file__).parent


class Foreign(NamedTuple):
    """One replacement."""

    name: str
    module: str
    old: str
    new: str
    hint: str = ""
    """Regular expression of the first hint."""
    is_with_meta: bool = False


def load(change: Foreign):
    """Return the rasterizer of the changed source, in a module of its own."""
    source = (HERE / f"{change.module}.py").read_text()
    assert source.count(change.old) == 1, (change.name, source.count(change.old))
    module = types.ModuleType(f"{change.module}_{re.sub(r'[^a-z]+', '_', change.name)}")
    exec(compile(source.replace(change.old, change.new), f"{module.__name__}.py", "exec"), module.__dict__)
    rasterization = module.rasterization
    if change.is_with_meta or change.module == "numpy_renderer":
        return rasterization

    def without_meta(means, quats, scales, opacities, colors, viewmats, Ks, width, height, **options):
        return rasterization(means, quats, scales, opacities, colors, viewmats, Ks, width, height, **options)[:2]

    return without_meta


N, T, J = "numpy_renderer", "torch_renderer", "jax_renderer"
CENTRES = "pixel centres at {} in place of 0.5, in "
FAULTS = (
    Foreign("pixel centres at 0", N, "xs = np.arange(width) + 0.5\n    ys = np.arange(height) + 0.5",
            "xs = np.arange(width) + 0.0\n    ys = np.arange(height) + 0.0", CENTRES.format("0") + "x and y"),
    Foreign("half a pixel in x", N, "xs = np.arange(width) + 0.5", "xs = np.arange(width) + 1.0",
            CENTRES.format("1") + "x,"),
    Foreign("no stop", N, "is_over |= after <= T_MIN", "is_over |= after < 0", "no stop of the transmittance"),
    Foreign("no dilation", N, "B = A + eps2d * np.eye(2)", "B = A + 1e-9 * np.eye(2)", "low-pass at (0|1e-09) px"),
    Foreign("a sign of degree 3", N, "Y += [np.sqrt(105 / (16 * np.pi)) * z * (x * x - y * y)]",
            "Y += [-np.sqrt(105 / (16 * np.pi)) * z * (x * x - y * y)]", "harmonic Y_3,2 times -1"),
    Foreign("one norm of degree 2", N, "np.sqrt(5 / (16 * np.pi)) * (3 * z * z - 1)",
            "np.sqrt(5 / (4 * np.pi)) * (3 * z * z - 1)", "harmonic Y_2,0 times 2"),
    Foreign("determinant with a plus", N, "B[0, 0] * B[1, 1] - B[0, 1] ** 2", "B[0, 0] * B[1, 1] + B[0, 1] ** 2",
            "determinant"),
    Foreign("a background that shines through", N, "image + T[..., None] * backgrounds[0]",
            "image + backgrounds[0]", "the background in full"),
    Foreign("limits of slopes at the border", N,
            "u = min(max(x / z, -cx / fx - 0.15 * width / fx), (width - cx) / fx + 0.15 * width / fx)", "u = x / z",
            "slopes"),
    Foreign("axes of the quaternion", N, "rotation(quats[n])", "rotation(np.roll(quats[n], 1))", "xyzw"),
    Foreign("the cross term's sign", T, "- Q[:, 1] * dx * dy", "+ Q[:, 1] * dx * dy",
            "off-diagonal times -1, in the blending", True),
    Foreign("pixel centres at 0 with a meta", T, "xs = torch.arange(width, dtype=p.dtype) + 0.5",
            "xs = torch.arange(width, dtype=p.dtype)", CENTRES.format("0") + "x, in the blending", True),
    Foreign("sorted by distance", T, "keys = x[:, 2].detach()", "keys = x.norm(dim=1).detach()",
            "distances .* in the blending", True),
    Foreign("colours that stand still", T, "directions = means + R.T @ t", "directions = means.detach() + R.T @ t",
            "viewing direction's share of the means' gradient times 0"),
    Foreign("a transmittance without gradient", T, "before = T[..., :-1]", "before = T[..., :-1].detach()",
            "behind a hit forgotten"),
    Foreign("scales not squared", T, "variances = scales**2", "variances = scales", "scales that are not squared"),
    Foreign("a norm of degree 1", J, "0.4886025119029199 * v", "0.5 * v", "harmonics of degree 1 times 1.02"),
    Foreign("a stop of the scales' gradient", J, "* scales[:, None, :]", "* jax.lax.stop_gradient(scales)[:, None, :]",
            "gradient of the scales times 0", True),
    Foreign("the Jacobian's third column", J, "zeros, -f[0] * slopes[:, 0] / z]", "zeros, f[0] * slopes[:, 0] / z]",
            "the Jacobian's", True),
    Foreign("no clamp of alpha", J, "- b * dx * dy), ALPHA_MAX)", "- b * dx * dy), 1 - 1e-7)", "alpha clamped at 1,"),
)  # fmt: skip

SOUND = (
    Foreign("centre by solving", N, "centre = -view[:3, :3].T @ view[:3, 3]",
            "centre = np.linalg.solve(view[:3, :3], -view[:3, 3])"),
    Foreign("conic by inversion", N, "a, b, c = B[1, 1] / determinant, -B[0, 1] / determinant, B[0, 0] / determinant",
            "(a, b), (_, c) = np.linalg.inv(B)"),
    Foreign("rotation after scaling", N, "rotation(quats[n]) @ np.diag(scales[n])", "(rotation(quats[n]) * scales[n])"),
    Foreign("centre by the inverse of the view", T, "directions = means + R.T @ t",
            "directions = means - torch.linalg.inv(viewmats[0])[:3, 3]"),
    Foreign("transmittance by logarithms", T,
            "T = torch.cumprod(torch.cat([torch.ones_like(alpha[..., :1]), 1 - alpha], -1), -1)",
            "T = torch.cumsum(torch.cat([torch.zeros_like(alpha[..., :1]), torch.log1p(-alpha)], -1), -1).exp()"),
    Foreign("covariance by axes", T, "Sigma = spin @ torch.diag_embed(variances) @ spin.transpose(1, 2)",
            "M = spin * scales[:, None]\n    Sigma = M @ M.transpose(1, 2)", "", True),
    Foreign("sorted before it is projected", T, "order = torch.sort(keys, stable=True).indices",
            "order = torch.sort(keys, stable=True, descending=True).indices.flip(0)", "", True),
    Foreign("centre by the transpose", J, "jnp.linalg.inv(viewmats[0])[:3, 3]", "-R.T @ t"),
    Foreign("opaque weights by differences", J, "front = jnp.cumprod(1 - alphas, axis=-1) / (1 - alphas)",
            "front = jnp.concatenate([jnp.ones_like(alphas[..., :1]), jnp.cumprod(1 - alphas, axis=-1)[..., :-1]], -1)",
            "", True),
    Foreign("exponent as a product", J, "opacities * jnp.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)",
            "jnp.exp(jnp.log(opacities + 1e-30) - 0.5 * (a * dx + b * dy) * dx - 0.5 * (b * dx + c * dy) * dy)",
            "", True),
)  # fmt: skip
