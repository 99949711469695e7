"""A rasterizer in ``jax.numpy`` with the signature of gsplat's, for the tests of ``oracle compare``; slow, but whole.

It follows gsplat's main branch: every pixel is blended with every Gaussian, alpha is clamped at 0.99, and a pixel ends
where its transmittance would fall to 1e-4. JAX differentiates it. One camera.
"""

import jax
import jax.numpy as jnp

ALPHA_MIN, ALPHA_MAX, T_MIN = 1 / 255, 0.99, 1e-4


def rasterization(
    means,  # [N, 3]
    quats,  # [N, 4]
    scales,  # [N, 3]
    opacities,  # [N]
    colors,  # [N, K, 3], or [N, D] without sh_degree
    viewmats,  # [1, 4, 4]
    Ks,  # [1, 3, 3]
    width,
    height,
    *,
    near_plane=0.01,
    far_plane=1e10,
    eps2d=0.3,
    sh_degree=None,
    backgrounds=None,  # [1, D]
    render_mode="RGB",
    rasterize_mode="classic",
):
    """Return the image [1, H, W, D], alpha [1, H, W, 1] and gsplat's meta."""
    R, t = viewmats[0, :3, :3], viewmats[0, :3, 3]
    x = means @ R.T + t  # [N, 3] camera frame
    is_ahead = (near_plane < x[:, 2]) & (x[:, 2] < far_plane)
    x = jnp.where(is_ahead[:, None], x, jnp.ones(3))  # of finite gradient where it is culled
    depths = x[:, 2]
    C = covariances2d(x, R, quats, scales, Ks[0], width, height)  # [N, 2, 2]
    B = C + eps2d * jnp.eye(2)
    if rasterize_mode == "antialiased":
        ratios = determinant(C) / determinant(B)
        opacities = opacities * jnp.sqrt(jnp.maximum(ratios, 0))
    conics = jnp.stack([B[:, 1, 1], -B[:, 0, 1], B[:, 0, 0]], axis=1) / determinant(B)[:, None]
    means2d = x[:, :2] / depths[:, None] * jnp.array([Ks[0, 0, 0], Ks[0, 1, 1]]) + Ks[0, :2, 2]
    is_visible = is_ahead & (opacities >= ALPHA_MIN)
    if sh_degree is not None:
        centre = jnp.linalg.inv(viewmats[0])[:3, 3]  # by the inverse, as in gsplat, so that its gradient is the same
        colors = jnp.maximum(shaded(means - centre, colors, sh_degree) + 0.5, 0)
    layers = jnp.concatenate([colors, depths[:, None]], axis=1)  # [N, D + 1]
    image, alpha = blend(means2d, conics, jnp.where(is_visible, opacities, 0), layers, (width, height))
    image, depth = image[..., :-1], image[..., -1:]
    if backgrounds is not None:
        image = image + (1 - alpha) * backgrounds[0]
    if render_mode == "RGB+D":
        image = jnp.concatenate([image, depth], axis=-1)
    elif render_mode == "RGB+ED":
        image = jnp.concatenate([image, depth / jnp.maximum(alpha, 1e-10)], axis=-1)
    elif render_mode != "RGB":
        raise NotImplementedError(render_mode)
    return image[None], alpha[None], {"depths": depths[None], "means2d": means2d[None], "conics": conics[None]}


def determinant(A):
    """Return the determinants [N] of matrices [N, 2, 2]."""
    return A[:, 0, 0] * A[:, 1, 1] - A[:, 0, 1] * A[:, 1, 0]


def covariances2d(x, R, quats, scales, K, width, height):
    """Return ``A Sigma A^T`` [N, 2, 2] with ``A = J R``; J is taken at places within 1.3 half fields of view."""
    w, i, j, k = (quats / jnp.linalg.norm(quats, axis=1, keepdims=True)).T
    rows = [
        [1 - 2 * (j * j + k * k), 2 * (i * j - w * k), 2 * (i * k + w * j)],
        [2 * (i * j + w * k), 1 - 2 * (i * i + k * k), 2 * (j * k - w * i)],
        [2 * (i * k - w * j), 2 * (j * k + w * i), 1 - 2 * (i * i + j * j)],
    ]
    M = jnp.moveaxis(jnp.array(rows), 2, 0) * scales[:, None, :]  # [N, 3, 3]
    f, c, size = jnp.array([K[0, 0], K[1, 1]]), K[:2, 2], jnp.array([width, height])
    margin = 0.3 * 0.5 * size / f
    slopes = jnp.clip(x[:, :2] / x[:, 2:], -(c / f + margin), (size - c) / f + margin)  # [N, 2]
    zeros, z = jnp.zeros(len(x)), x[:, 2]
    J = jnp.array([[f[0] / z, zeros, -f[0] * slopes[:, 0] / z], [zeros, f[1] / z, -f[1] * slopes[:, 1] / z]])
    A = jnp.einsum("abn,bc,ncd->nad", J, R, M)
    return A @ jnp.swapaxes(A, 1, 2)


def shaded(directions, coefficients, degree):
    """Return the sums of spherical harmonics [N, 3] of coefficients [N, K, 3] towards directions of any length."""
    x, y, z = (directions / jnp.linalg.norm(directions, axis=1, keepdims=True)).T
    xx, yy, zz = x * x, y * y, z * z
    basis = [jnp.full_like(x, 0.28209479177387814)]
    if degree > 0:
        basis += [0.4886025119029199 * v for v in (-y, z, -x)]
    if degree > 1:
        basis += [1.0925484305920792 * v for v in (x * y, -y * z)]
        basis += [0.31539156525252005 * (2 * zz - xx - yy), -1.0925484305920792 * x * z]
        basis += [0.5462742152960396 * (xx - yy)]
    if degree > 2:
        basis += [-0.5900435899266435 * y * (3 * xx - yy), 2.890611442640554 * x * y * z]
        basis += [-0.4570457994644658 * y * (4 * zz - xx - yy)]
        basis += [0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy)]
        basis += [-0.4570457994644658 * x * (4 * zz - xx - yy), 1.445305721320277 * z * (xx - yy)]
        basis += [-0.5900435899266435 * x * (xx - 3 * yy)]
    Y = jnp.stack(basis, axis=1)  # [N, (degree + 1)^2]
    return jnp.einsum("nk,nkc->nc", Y, coefficients[:, : Y.shape[1]])


def blend(means2d, conics, opacities, layers, size):
    """Return layers [N, D] blended at every pixel [H, W, D], nearest first by the last layer, and alpha [H, W, 1]."""
    order = jnp.argsort(jax.lax.stop_gradient(layers[:, -1]), stable=True)
    means2d, conics, opacities, layers = (array[order] for array in (means2d, conics, opacities, layers))
    x, y = jnp.meshgrid(jnp.arange(size[0]) + 0.5, jnp.arange(size[1]) + 0.5)
    dx, dy = x[..., None] - means2d[:, 0], y[..., None] - means2d[:, 1]  # [H, W, N]
    a, b, c = conics.T
    alphas = jnp.minimum(opacities * jnp.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy), ALPHA_MAX)
    alphas = jnp.where(alphas < ALPHA_MIN, 0, alphas)
    behind = jnp.cumprod(1 - alphas, axis=-1)
    alphas = jnp.where(behind > T_MIN, alphas, 0)
    front = jnp.cumprod(1 - alphas, axis=-1) / (1 - alphas)
    weights = alphas * front
    return weights @ layers, weights.sum(axis=-1, keepdims=True)
