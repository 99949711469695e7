"""Scenes on which ``rasterization`` with other cameras is compared: arguments of one call, with cotangents.

The numbers are rounded to float32, so that renderers of either precision get the same problem. ``brown`` has all six
radial and both tangential coefficients; ``fisheye`` sees Gaussians beside and behind the camera, up to 130 degrees from
the axis; ``hard`` has a lens that folds outside of the image, and Gaussians beyond the fold, behind the camera, at the
border of the image and around the camera; ``ortho`` has parallel rays.
"""

from typing import Any

import numpy as np

from minisplat_ref.mechanisms.cameras.gsplat_call import rasterization
from minisplat_ref.oracle.call_comparison import CallScene
from minisplat_ref.types import Floats

SIZE = (44, 36)  # px
LEAVES = ("means", "quats", "scales", "opacities", "colors", "viewmats", "backgrounds")
ALONG_RAYS = {"with_ut": True, "with_eval3d": True}
BROWN = {
    "radial_coeffs": (-0.2, 0.06, 0.01, 0.02, 0.01, 0.005),
    "tangential_coeffs": (0.02, -0.03),
}
FISHEYE = {"camera_model": "fisheye", "radial_coeffs": (0.02, -0.004, 0.001, 0.0)}
FOLDING = {"radial_coeffs": (-0.2, 0.0, 0.0, 0.0, 0.0, 0.0)}  # at a slope of 1.29, which is 0.86 in the image


def scenes() -> tuple[CallScene, ...]:
    """Return the scenes."""
    return (
        _scene("brown", "all coefficients of a distorting lens", 0, _ahead(50, 0), 41.5, {**BROWN, **ALONG_RAYS}),
        _scene("fisheye", "up to 130 degrees from the axis", 1, _surround(70, 1), 12.0, {**FISHEYE, **ALONG_RAYS}),
        _scene("hard", "beyond a fold, behind, at the border, around", 2, _hard(), 41.5, {**FOLDING, **ALONG_RAYS}),
        _scene("ortho", "parallel rays", 3, _ahead(50, 3), 16.0, {"camera_model": "ortho"}),
    )


def _scene(name: str, what: str, seed: int, some: dict[str, Floats], focal: float, lens: dict[str, Any]) -> CallScene:
    rng = np.random.default_rng(200 + seed)
    c, s = np.cos(0.1 * seed), np.sin(0.1 * seed)
    viewmat = np.array([[c, 0, s, -0.05], [0, 1, 0, 0.1], [-s, 0, c, 0.02 * seed], [0, 0, 0, 1.0]])
    K = np.array([[focal, 0.0, 20.3], [0.0, 0.95 * focal, 19.1], [0.0, 0.0, 1.0]])
    arrays = {
        **some,
        "colors": rng.uniform(size=(len(some["means"]), 3)),
        "viewmats": viewmat[None],
        "Ks": K[None],
        "backgrounds": rng.uniform(size=(1, 3)),
        **{key: np.array(value)[None] for key, value in lens.items() if isinstance(value, tuple)},
    }
    settings = {key: value for key, value in lens.items() if not isinstance(value, tuple)}
    arguments: dict[str, Any] = {key: _round(value) for key, value in arrays.items()}
    arguments |= {"width": SIZE[0], "height": SIZE[1], **settings}
    images = rasterization(**arguments, backend="reference")[:2]
    cotangents = {
        f"v_{key}": _round(rng.normal(size=image.shape))
        for key, image in zip(("render_colors", "render_alphas"), images, strict=True)
    }
    return CallScene(name, what, arguments, cotangents)


def _gaussians(means: Floats, rng: np.random.Generator) -> dict[str, Floats]:
    n = len(means)
    scales = np.exp(rng.normal(size=(n, 3)) * 0.5 - 1.8)
    return {
        "means": means,
        "quats": rng.normal(size=(n, 4)),
        "scales": scales,
        "opacities": rng.uniform(0.1, 0.95, n),
    }


def _ahead(n: int, seed: int) -> dict[str, Floats]:
    """Return Gaussians in front of the camera."""
    rng = np.random.default_rng(seed)
    return _gaussians(rng.normal(size=(n, 3)) * (1, 1, 0.5) + (0, 0, 3.5), rng)


def _surround(n: int, seed: int) -> dict[str, Floats]:
    """Return Gaussians around the camera, at distances from 1.5 to 4."""
    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(n, 3)) + np.array([0, 0, 0.3])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return _gaussians(directions * rng.uniform(1.5, 4, (n, 1)), rng)


def _hard() -> dict[str, Floats]:
    """Return a few ordinary Gaussians with hard ones among them."""
    ordinary = _ahead(10, 5)
    hard = [  # mean, scale, opacity
        ((4.5, 0.0, 2.5), 0.3, 0.9),  # beyond the fold, whose image is inside of ours
        ((3.5, 0.3, 2.2), 1.2, 0.8),  # beyond it, and reaches into the image
        ((0.2, 0.1, -2.0), 0.5, 0.9),  # behind the camera
        ((1.9, 0.1, 3.0), 0.3, 0.9),  # at the border of the image
        ((0.1, -0.2, 0.6), 0.9, 0.5),  # around the camera: sigma points are behind it
    ]
    columns = [np.array(column, np.float64) for column in zip(*hard, strict=True)]
    extra = {
        "means": columns[0],
        "quats": np.tile([0.9, 0.1, 0.2, 0.3], (len(hard), 1)),
        "scales": columns[1][:, None] * (1.0, 0.8, 0.9),
        "opacities": columns[2],
    }
    return {key: np.concatenate([ordinary[key], extra[key]]) for key in ordinary}


def _round(array: Floats) -> Floats:
    return array.astype(np.float32).astype(np.float64)
