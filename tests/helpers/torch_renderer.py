"""A rasterizer in torch with the signature of gsplat's, for the tests of ``oracle compare``; torch differentiates it.

Transmittances are running products over all Gaussians in one order, and there are no tiles. One camera, the rules of
gsplat's main branch.
"""

import torch

ALPHA_MIN, ALPHA_MAX, T_MIN = 1 / 255, 0.99, 1e-4


def rasterization(
    means,
    quats,
    scales,
    opacities,
    colors,
    viewmats,
    Ks,
    width,
    height,
    near_plane=0.01,
    far_plane=1e10,
    eps2d=0.3,
    sh_degree=None,
    backgrounds=None,
    render_mode="RGB",
    rasterize_mode="classic",
):
    """Return the image [1, H, W, D], alpha [1, H, W, 1] and a meta."""
    R, t = viewmats[0, :3, :3], viewmats[0, :3, 3]
    x = torch.einsum("ij,nj->ni", R, means) + t
    is_seen = (x[:, 2] > near_plane) & (x[:, 2] < far_plane)
    x = torch.where(is_seen[:, None], x, torch.ones_like(x))
    means2d, covariances = project(x, R, quats, scales, Ks[0], width, height)
    low_passed = covariances + eps2d * torch.eye(2, dtype=x.dtype)
    determinants = torch.linalg.det(low_passed)
    if rasterize_mode == "antialiased":
        ratio = torch.linalg.det(covariances) / determinants
        opacities = opacities * ratio.clamp(min=0).sqrt()
    inverses = torch.linalg.inv(low_passed)
    conics = torch.stack([inverses[:, 0, 0], inverses[:, 0, 1], inverses[:, 1, 1]], 1)
    if sh_degree is not None:
        directions = means + R.T @ t
        colors = torch.relu(harmonics(directions, sh_degree, colors) + 0.5)
    is_seen = is_seen & (opacities >= ALPHA_MIN)
    layers = torch.cat([colors, x[:, 2:]], 1)
    keys = x[:, 2].detach()
    visible = torch.where(is_seen, opacities, torch.zeros_like(opacities))
    image, T = blend(means2d, conics, visible, layers, keys, width, height)
    image, depth = image[..., :-1], image[..., -1:]
    if backgrounds is not None:
        image = image + T * backgrounds[0]
    alpha = 1 - T
    if render_mode == "RGB+D":
        image = torch.cat([image, depth], -1)
    elif render_mode == "RGB+ED":
        image = torch.cat([image, depth / alpha.clamp(min=1e-10)], -1)
    meta = {"means2d": means2d[None], "conics": conics[None], "depths": x[None, :, 2], "opacities": opacities[None]}
    return image[None], alpha[None], meta


def project(x, R, quats, scales, K, width, height):
    """Return centres [N, 2] and covariances [N, 2, 2] in the image."""
    q = torch.nn.functional.normalize(quats, dim=1)
    w, i, j, k = q.unbind(1)
    spin = torch.stack(
        [
            torch.stack([w * w + i * i - j * j - k * k, 2 * (i * j - w * k), 2 * (i * k + w * j)], 1),
            torch.stack([2 * (i * j + w * k), w * w - i * i + j * j - k * k, 2 * (j * k - w * i)], 1),
            torch.stack([2 * (i * k - w * j), 2 * (j * k + w * i), w * w - i * i - j * j + k * k], 1),
        ],
        1,
    )
    variances = scales**2
    Sigma = spin @ torch.diag_embed(variances) @ spin.transpose(1, 2)
    z = x[:, 2]
    f, c, size = torch.stack([K[0, 0], K[1, 1]]), K[:2, 2], torch.tensor([width, height], dtype=x.dtype)
    slopes = x[:, :2] / z[:, None]
    low, high = -(c + 0.15 * size) / f, (size - c + 0.15 * size) / f
    limited = torch.minimum(torch.maximum(slopes, low), high)
    J = torch.zeros(len(x), 2, 3, dtype=x.dtype)
    J[:, 0, 0], J[:, 1, 1] = f[0] / z, f[1] / z
    J[:, :, 2] = -f * limited / z[:, None]
    J = J @ R
    return f * slopes + c, J @ Sigma @ J.transpose(1, 2)


def harmonics(directions, degree, coefficients):
    """Return sums of harmonics [N, 3]."""
    d = directions / directions.norm(dim=1, keepdim=True)
    x, y, z = d.unbind(1)
    Y = [torch.full_like(x, 0.28209479177387814)]
    if degree > 0:
        Y += [-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x]
    if degree > 1:
        Y += [1.0925484305920792 * x * y, -1.0925484305920792 * y * z]
        Y += [0.31539156525252005 * (3 * z**2 - 1), -1.0925484305920792 * x * z, 0.5462742152960396 * (x**2 - y**2)]
    if degree > 2:
        Y += [-0.5900435899266435 * y * (3 * x**2 - y**2), 2.890611442640554 * x * y * z]
        Y += [-0.4570457994644658 * y * (5 * z**2 - 1), 0.3731763325901154 * z * (5 * z**2 - 3)]
        Y += [-0.4570457994644658 * x * (5 * z**2 - 1), 1.445305721320277 * z * (x**2 - y**2)]
        Y += [-0.5900435899266435 * x * (x**2 - 3 * y**2)]
    basis = torch.stack(Y, 1)
    return (basis[:, :, None] * coefficients[:, : basis.shape[1]]).sum(1)


def blend(means2d, conics, opacities, layers, keys, width, height):
    """Return the layers blended [H, W, D] and the transmittance that is left [H, W, 1]."""
    order = torch.sort(keys, stable=True).indices
    p, Q, o, layers = means2d[order], conics[order], opacities[order], layers[order]
    xs = torch.arange(width, dtype=p.dtype) + 0.5
    ys = torch.arange(height, dtype=p.dtype) + 0.5
    dx, dy = p[:, 0] - xs[None, :, None], p[:, 1] - ys[:, None, None]
    power = -0.5 * (Q[:, 0] * dx**2 + Q[:, 2] * dy**2) - Q[:, 1] * dx * dy
    alpha = (o * power.exp()).clamp(max=ALPHA_MAX)
    alpha = alpha * (alpha >= ALPHA_MIN)
    T = torch.cumprod(1 - alpha, -1)
    alpha = alpha * (T > T_MIN)
    T = torch.cumprod(torch.cat([torch.ones_like(alpha[..., :1]), 1 - alpha], -1), -1)
    before = T[..., :-1]
    return (alpha * before) @ layers, T[..., -1:]
