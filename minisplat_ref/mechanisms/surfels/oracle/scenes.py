"""Scenes on which a ``rasterization_2dgs`` is compared: arguments of one call, with cotangents for its six images.

The numbers are rounded to float32, so that renderers of either precision get the same problem. Third scales are one,
because gsplat's torch functions multiply normals by them and its kernels do not. ``hard`` holds the special cases of
surfels: discs seen from the edge, at a grazing angle, behind the camera and across its plane, and smaller than a pixel.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from minisplat_ref.mechanisms.surfels.gsplat_call import NAMES, rasterization_2dgs
from minisplat_ref.oracle.call_comparison import CallScene
from minisplat_ref.types import Floats

SIZE = (44, 36)  # px
INTRINSICS = ((41.5, 0.0, 20.3), (0.0, 38.25, 19.1), (0.0, 0.0, 1.0))
LEAVES = ("means", "quats", "scales", "opacities", "colors", "viewmats", "backgrounds")


def scenes() -> tuple[CallScene, ...]:
    """Return the scenes."""
    return (
        _scene("ordinary", "dense, opaque in places; expected depth", 0, *_ordinary(60, 0)),
        _scene("median", "the surface of the median depths; a rotated camera", 1, *_ordinary(60, 1), "median"),
        _scene("hard", "edge-on, grazing, behind, across the camera's plane, below a pixel", 2, *_hard()),
    )


def _scene(
    name: str,
    what: str,
    seed: int,
    surfels: dict[str, Floats],
    viewmat: Floats,
    depth_mode: str = "expected",
) -> CallScene:
    rng = np.random.default_rng(100 + seed)
    n = len(surfels["means"])
    arguments: dict[str, Any] = {
        **{key: _round(value) for key, value in surfels.items()},
        "colors": _round(rng.normal(size=(n, 9, 3)) * np.array([0.5, *[0.1] * 8])[:, None]),
        "viewmats": viewmat[None],
        "Ks": np.array(INTRINSICS)[None],
        "width": SIZE[0],
        "height": SIZE[1],
        "sh_degree": 2,
        "backgrounds": _round(rng.uniform(size=(1, 3))),
        "render_mode": "RGB+ED",
        "distloss": True,
        "depth_mode": depth_mode,
    }
    images: Sequence[Any] = rasterization_2dgs(**arguments, backend="reference")[:6]
    cotangents = {
        f"v_{key}": _round(rng.normal(size=np.shape(image))) for key, image in zip(NAMES, images, strict=True)
    }
    return CallScene(name, what, arguments, cotangents)


def _ordinary(n: int, seed: int) -> tuple[dict[str, Floats], Floats]:
    """Return surfels at random in front of a wall that fills the image, and a camera."""
    rng = np.random.default_rng(seed)
    wall = {
        "means": np.array([[0.0, 0.0, 7.0]]),
        "quats": np.array([[1.0, 0.02, 0.03, 0.0]]),
        "scales": np.array([[8.0, 8.0, 1.0]]),
        "opacities": np.array([0.9]),
    }
    scales = np.exp(rng.normal(size=(n, 3)) * 0.7 - 1.8)
    scales[:, 2] = 1
    some = {
        "means": rng.normal(size=(n, 3)) * (1, 1, 0.5) + (0, 0, 4),
        "quats": rng.normal(size=(n, 4)),
        "scales": scales,
        "opacities": rng.uniform(0.1, 1, n),
    }
    angle = 0.25 * seed
    c, s = np.cos(angle), np.sin(angle)
    viewmat = np.array([[c, 0, s, -1.0 * seed], [0, 1, 0, 0.1], [-s, 0, c, 0.1 * seed], [0, 0, 0, 1.0]])
    return {key: np.concatenate([some[key], wall[key]]) for key in wall}, viewmat


def _hard() -> tuple[dict[str, Floats], Floats]:
    """Return the ordinary surfels with hard ones among them: see the module's docstring."""
    surfels, _ = _ordinary(12, 5)
    half = np.sqrt(0.5)
    edge_on, grazing = (half, 0.0, half, 0.0), (np.cos(0.783), 0.0, np.sin(0.783), 0.0)
    hard = [  # mean, quaternion, scale, opacity
        ((0.0, 0.0, 3.0), edge_on, 0.4, 0.8),  # its plane holds the camera's centre: p_2 = 0
        ((0.3, 0.2, 3.0), edge_on, 0.4, 0.8),
        ((-0.4, 0.1, 2.5), grazing, 0.5, 0.7),
        ((0.2, 0.1, -2.0), (1.0, 0.1, 0.0, 0.0), 0.5, 0.9),  # behind the camera
        ((0.5, -0.5, 0.6), (0.8, 0.5, 0.1, 0.0), 0.9, 0.5),  # reaches behind it
        ((-0.2, -0.3, 4.0), (1.0, 0.3, 0.2, 0.1), 0.003, 0.9),  # smaller than a pixel
        ((0.1, 0.4, 3.5), (1.0, 0.0, 0.0, 0.0), 0.2, 1.0),  # its alpha is clamped
    ]
    columns = [np.array(column, np.float64) for column in zip(*hard, strict=True)]
    scales = np.column_stack([columns[2], 0.7 * columns[2], np.ones(len(hard))])
    extra = dict(zip(("means", "quats", "scales", "opacities"), (*columns[:2], scales, columns[3]), strict=True))
    return {key: np.concatenate([surfels[key], extra[key]]) for key in surfels}, np.eye(4)


def _round(array: Floats) -> Floats:
    return array.astype(np.float32).astype(np.float64)
