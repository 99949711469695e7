"""Small scenes for the tests."""

import numpy as np

from minisplat_ref.constants import GSPLAT_1_5, GSPLAT_MAIN, INRIA, MINI_SPLATTING2, SH_C0
from minisplat_ref.reference.covariance import rotation_matrices
from minisplat_ref.types import Camera, Gaussians

ANTIALIASED = GSPLAT_MAIN._replace(name="ANTIALIASED", is_antialiased=True)
ALL_CONVENTIONS = (GSPLAT_MAIN, GSPLAT_1_5, INRIA, MINI_SPLATTING2, ANTIALIASED)


def make_camera(width=24, height=18, *, fx=30.0, fy=28.0, cx=None, cy=None, rng=None):
    """A camera at the origin looking along +z or, with `rng`, turned by up to about 20 degrees and moved a little."""
    R, t = np.eye(3), np.zeros(3)
    if rng is not None:
        quat = np.concatenate([[1.0], 0.1 * rng.uniform(-1, 1, size=3)])
        R, t = rotation_matrices(quat[None])[0], 0.1 * rng.normal(size=3)
    return Camera(R, t, fx, fy, width / 2 if cx is None else cx, height / 2 if cy is None else cy, width, height)


def turned_camera(width=40, height=28, *, fx=40.0, fy=25.0, cx=17.0, cy=12.0):
    """A camera with nothing by which two errors could cancel: turned by 74 degrees about an odd axis, moved, with two
    focal lengths and a principal point beside the middle.
    """
    R = rotation_matrices(np.array([[0.8, 0.2, -0.4, 0.4]]))[0]
    return Camera(R, np.array([0.3, -0.2, 0.5]), fx, fy, cx, cy, width, height)


def in_front_of(camera, points):
    """The world points [N, 3] that a camera has at these places of its own frame."""
    return (np.atleast_2d(np.asarray(points, float)) - camera.cam_from_world_t) @ camera.cam_from_world_R


def balls(centers, sizes, opacities, colors=None):
    """Balls of one colour each; grey without colours."""
    n, centers = len(sizes), np.asarray(centers, float)
    opacities, colors = np.asarray(opacities, float), np.full((n, 3), 0.5) if colors is None else np.asarray(colors)
    return Gaussians(
        centers,
        np.tile([1.0, 0.0, 0.0, 0.0], (n, 1)),
        np.log(np.repeat(np.asarray(sizes, float)[:, None], 3, axis=1)),
        np.log(opacities / (1 - opacities)),
        (colors - 0.5) / SH_C0,
        np.zeros((n, 0, 3)),
    )


def make_gaussians(rng, n, *, sh_degree=3, depth=3.0, size=0.15, opacity_logit=0.5):
    """Random Gaussians in front of :func:`make_camera`, spread over its image and over the depths depth +- 0.8."""
    z = depth + rng.uniform(-0.8, 0.8, size=n)
    xy = rng.uniform(-0.35, 0.35, size=(n, 2)) * z[:, None]
    n_coefficients = (sh_degree + 1) ** 2
    return Gaussians(
        means=np.column_stack([xy, z]),
        quats=rng.normal(size=(n, 4)),
        log_scales=np.log(size) + rng.uniform(-0.7, 0.7, size=(n, 3)),
        opacity_logits=opacity_logit + rng.normal(size=n),
        sh_dc=rng.normal(size=(n, 3)),
        sh_rest=0.3 * rng.normal(size=(n, n_coefficients - 1, 3)),
    )


def as_dtype(bundle, dtype):
    """The bundle with its floating arrays cast."""
    fields = (np.asarray(f) if isinstance(f, (np.ndarray, list)) else f for f in bundle)
    return type(bundle)(*(f.astype(dtype) if isinstance(f, np.ndarray) and f.dtype.kind == "f" else f for f in fields))


def activated(gaussians):
    """What `project` takes: means, quats, scales, opacities."""
    opacities = 1 / (1 + np.exp(-gaussians.opacity_logits))
    return gaussians.means, gaussians.quats, np.exp(gaussians.log_scales), opacities
