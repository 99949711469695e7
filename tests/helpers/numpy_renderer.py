"""A rasterizer in plain NumPy with the signature of gsplat's, for tests of ``oracle compare``: images, no gradients.

It shares nothing with the package: one Gaussian after the other is blended into all pixels, nearest first, as a loop
over T. One camera, the rules of gsplat's main branch.
"""

import numpy as np

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
    """Return the image [1, H, W, D] and alpha [1, H, W, 1]."""
    view, (fx, fy, cx, cy) = viewmats[0], (Ks[0, 0, 0], Ks[0, 1, 1], Ks[0, 0, 2], Ks[0, 1, 2])
    centre = -view[:3, :3].T @ view[:3, 3]
    xs = np.arange(width) + 0.5
    ys = np.arange(height) + 0.5
    X, Y = np.meshgrid(xs, ys)
    seen = means @ view[:3, :3].T + view[:3, 3]
    shaded = colors if sh_degree is None else shade(means - centre, colors, sh_degree)
    channels = shaded.shape[1]
    image, T = np.zeros((height, width, channels + 1), means.dtype), np.ones((height, width), means.dtype)
    is_over = np.zeros((height, width), bool)
    keys = seen[:, 2]
    for n in np.argsort(keys, kind="stable"):
        x, y, z = seen[n]
        if not near_plane < z < far_plane:
            continue
        # limits of the slopes: 0.15 of the image beyond its borders
        u = min(max(x / z, -cx / fx - 0.15 * width / fx), (width - cx) / fx + 0.15 * width / fx)
        v = min(max(y / z, -cy / fy - 0.15 * height / fy), (height - cy) / fy + 0.15 * height / fy)
        J = np.array([[fx / z, 0, -fx * u / z], [0, fy / z, -fy * v / z]])
        axes = J @ view[:3, :3] @ rotation(quats[n]) @ np.diag(scales[n])
        A = axes @ axes.T
        B = A + eps2d * np.eye(2)
        determinant = B[0, 0] * B[1, 1] - B[0, 1] ** 2
        a, b, c = B[1, 1] / determinant, -B[0, 1] / determinant, B[0, 0] / determinant
        opacity = opacities[n]
        if rasterize_mode == "antialiased":
            opacity = opacity * np.sqrt(max(np.linalg.det(A) / determinant, 0))
        dx, dy = X - (fx * x / z + cx), Y - (fy * y / z + cy)
        alpha = np.minimum(ALPHA_MAX, opacity * np.exp(-0.5 * (a * dx**2 + 2 * b * dx * dy + c * dy**2)))
        alpha[alpha < ALPHA_MIN] = 0
        after = T * (1 - alpha)
        is_over |= after <= T_MIN
        alpha[is_over] = 0
        image += (alpha * T)[..., None] * np.append(shaded[n], z)
        T = T * (1 - alpha)
    alpha = 1 - T[..., None]
    image, depth = image[..., :-1], image[..., -1:]
    if backgrounds is not None:
        image = image + T[..., None] * backgrounds[0]
    if render_mode == "RGB+D":
        image = np.concatenate([image, depth], axis=2)
    elif render_mode == "RGB+ED":
        image = np.concatenate([image, depth / np.maximum(alpha, 1e-10)], axis=2)
    return image[None].astype(means.dtype), alpha[None].astype(means.dtype)


def rotation(q):
    """Return the matrix of a quaternion wxyz by its action: q v q*."""
    w, v = q[0] / np.linalg.norm(q), q[1:] / np.linalg.norm(q)
    return np.column_stack([e + 2 * w * np.cross(v, e) + 2 * np.cross(v, np.cross(v, e)) for e in np.eye(3)])


def shade(directions, coefficients, degree):
    """Return colours [N, 3] by real harmonics with their signs and norms written out."""
    d = directions / np.sqrt((directions**2).sum(1, keepdims=True))
    x, y, z = d[:, 0], d[:, 1], d[:, 2]
    Y = [np.full(len(d), 0.5 / np.sqrt(np.pi))]
    if degree >= 1:
        c1 = np.sqrt(3 / (4 * np.pi))
        Y += [-c1 * y, c1 * z, -c1 * x]
    if degree >= 2:
        c2 = np.sqrt(15 / (4 * np.pi))
        Y += [c2 * x * y, -c2 * y * z]
        Y += [np.sqrt(5 / (16 * np.pi)) * (3 * z * z - 1)]
        Y += [-c2 * x * z]
        Y += [c2 / 2 * (x * x - y * y)]
    if degree >= 3:
        Y += [-np.sqrt(35 / (32 * np.pi)) * y * (3 * x * x - y * y)]
        Y += [np.sqrt(105 / (4 * np.pi)) * x * y * z]
        Y += [-np.sqrt(21 / (32 * np.pi)) * y * (5 * z * z - 1)]
        Y += [np.sqrt(7 / (16 * np.pi)) * z * (5 * z * z - 3)]
        Y += [-np.sqrt(21 / (32 * np.pi)) * x * (5 * z * z - 1)]
        Y += [np.sqrt(105 / (16 * np.pi)) * z * (x * x - y * y)]
        Y += [-np.sqrt(35 / (32 * np.pi)) * x * (x * x - 3 * y * y)]
    sums = sum(y[:, None] * coefficients[:, k] for k, y in enumerate(Y))
    return np.maximum(sums + 0.5, 0)
