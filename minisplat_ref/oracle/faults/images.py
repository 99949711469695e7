"""Errors of the blending, and of whole images."""

from collections.abc import Callable
from typing import Any

import numpy as np

from minisplat_ref.io.srgb import encode_srgb
from minisplat_ref.oracle.faults import blending as b
from minisplat_ref.oracle.faults import forward as f
from minisplat_ref.oracle.faults.backward import as_planted
from minisplat_ref.oracle.faults.fault import Fault
from minisplat_ref.oracle.faults.primitives import (
    CENTRES,
    DISTANCE,
    EXPONENT,
    FACTORS,
    HALVES,
    OFF_DIAGONAL,
    OPACITY,
    ORDER,
)
from minisplat_ref.oracle.golden.format import Arrays
from minisplat_ref.types import Floats

COLORED = ("image", "view")  # whose first three channels are the colours of harmonics
IMAGES = ("image", "alpha", "feature_image", "accumulated_depth", "view", "view_alpha")


def _images(change: Callable[[Floats], Floats]) -> Callable[[Arrays, float], Arrays]:
    """Return a change of all images [H, W, ...]."""
    return lambda arrays, _: arrays | {name: change(arrays[name]) for name in IMAGES if name in arrays}


def _colored(change: Callable[[Floats, float], Floats]) -> Callable[[Arrays, float], Arrays]:
    """Return a change of the colours [H, W, 3]."""

    def after(arrays: Arrays, size: float) -> Arrays:
        changed = {name: arrays[name].copy() for name in COLORED if name in arrays}
        for image in changed.values():
            image[..., :3] = change(image[..., :3], size)
        return arrays | changed

    return after


def _expected_depth(change: Callable[[Floats, Floats], Floats]) -> Callable[[Arrays, float], Arrays]:
    """Return a change of the expected depth, by alpha."""

    def after(arrays: Arrays, _: float) -> Arrays:
        view = arrays["view"].copy()
        view[..., 3] = change(view[..., 3], arrays["alpha"])
        return arrays | {"view": view}

    return after


def _normalised(arrays: Arrays, _: float) -> Arrays:
    return arrays | {"accumulated_depth": arrays["accumulated_depth"] / np.maximum(arrays["alpha"], 1e-10)}


def _without_partial_tiles(arrays: Arrays, size: float) -> Arrays:
    """Return images without the tiles at the right and at the lower border that are not whole."""

    def cut(image: Floats) -> Floats:
        n = int(size)
        h, w = (side // n * n for side in image.shape[:2])
        changed = image.copy()
        changed[h:], changed[:, w:] = 0, 0
        return changed

    return _images(cut)(arrays, size)


def _weighed(weigh: Any) -> Callable[[float], Any]:
    return lambda _: b.with_weights(weigh)


BLENDING = (
    Fault(f"{CENTRES}, in x and y", "blending", lambda d: b.with_blended_positions(0.5 - d, 0.5 - d), HALVES, 0.5),
    Fault(f"{CENTRES}, in x", "blending", lambda d: b.with_blended_positions(0.5 - d, 0), HALVES, 0.5),
    Fault(f"{CENTRES}, in y", "blending", lambda d: b.with_blended_positions(0, 0.5 - d), HALVES, 0.5),
    Fault(EXPONENT, "blending", lambda s: b.with_blended_conics(s, s, s), (2.0, 0.5, 1.1), 1.0),
    Fault(OFF_DIAGONAL, "blending", lambda s: b.with_blended_conics(1, s, 1), FACTORS, 1.0),
    Fault("the conic's entry of x times {}", "blending", lambda s: b.with_blended_conics(s, 1, 1), (2.0, 0.5), 1.0),
    Fault("the conic's entry of y times {}", "blending", lambda s: b.with_blended_conics(1, 1, s), (2.0, 0.5), 1.0),
    Fault(OPACITY, "blending", b.with_blended_opacities, (0.9, 0.5), 1.0),
    Fault("the square of opacities", "blending", lambda _: b.with_other_opacities(np.square)),
    Fault("the square root of opacities", "blending", lambda _: b.with_other_opacities(np.sqrt)),
    Fault("a sigmoid of opacities", "blending", lambda _: b.with_other_opacities(lambda o: 1 / (1 + np.exp(-o)))),
    Fault("opacities of 1", "blending", lambda _: b.with_other_opacities(np.ones_like)),
    Fault(ORDER, "blending", lambda _: b.sorted_by(lambda p: 1.0 + np.arange(len(p.depths)))),
    Fault(ORDER, "blending", as_planted("unsorted-depth")),
    Fault("the farthest Gaussian blended first", "blending", lambda _: b.sorted_by(lambda p: -p.depths)),
    Fault(DISTANCE, "blending", f.sorted_by_distances),
    Fault(
        "alpha clamped at {}",
        "blending",
        lambda a: f.with_rules(lambda _: {"alpha_max": a}),
        (0.999, 1.0, 0.95, 0.9, 0.99, 0.9999, 0.8),
    ),
    Fault("no hit too weak: no least alpha", "blending", lambda _: f.with_rules(lambda _: {"alpha_min": 0.0})),
    Fault(
        "a least alpha of {} in place of 1/255",
        "blending",
        lambda a: f.with_rules(lambda _: {"alpha_min": a}),
        (1 / 128, 1 / 512, 0.01, 0.02, 1 / 64, 0.05, 1e-3, 0.1),
    ),
    Fault("no stop of the transmittance", "blending", lambda _: f.with_rules(lambda _: {"transmittance_min": 0.0})),
    Fault(
        "the stop at a transmittance of {} in place of 1e-4",
        "blending",
        lambda t: f.with_rules(lambda _: {"transmittance_min": t}),
        (1e-3, 1e-2, 1e-5, 1e-6, 5e-4, 0.05, 0.1, 1 / 255),
    ),
    Fault("the hit that crosses the stop blended, too", "blending", _weighed(b.with_the_last_hit)),
    Fault("hits weighed by the transmittance behind them", "blending", _weighed(b.behind_each_hit)),
    Fault("hits weighed without the transmittance", "blending", _weighed(b.without_transmittance)),
    Fault("hits averaged, whatever their order", "blending", _weighed(b.by_mean_alphas)),
    Fault(
        "Gaussians cut at {} deviations",
        "blending",
        lambda s: b.with_weights(b.cut_at(s)),
        (3.0, 2.0, 1.0, 2.5, 2.8284),
    ),
    Fault(
        "the nearest {} Gaussians of a pixel alone",
        "blending",
        lambda n: b.with_weights(b.with_nearest(int(n))),
        (1, 2, 4, 8, 16),
    ),
    Fault("the background times {}", "blending", b.with_background, (0.0, 0.5, -1.0), 1.0),
    Fault("the background in full, not dimmed by what is before it", "blending", lambda _: b.with_behind(np.ones_like)),
    Fault("the background times alpha in place of 1 - alpha", "blending", lambda _: b.with_behind(lambda T: 1 - T)),
    Fault("the background dimmed twice", "blending", lambda _: b.with_behind(np.square)),
    Fault("the transmittance in place of alpha", "image", lambda _: b.with_alpha(lambda a: 1 - a)),
    Fault("the image of alpha times {}", "image", lambda s: b.with_alpha(lambda a: s * a), (0.5,), 1.0),
    Fault("the image upside down", "image", after=_images(lambda image: image[::-1])),
    Fault("the image mirrored", "image", after=_images(lambda image: image[:, ::-1])),
    Fault("the image turned by half a turn", "image", after=_images(lambda image: image[::-1, ::-1])),
    Fault(
        "tiles that are not whole left out, {} pixels wide", "image", after=_without_partial_tiles, sizes=(16, 8, 32)
    ),
    Fault("colours of the image clamped at 1", "image", after=_colored(lambda c, _: np.minimum(c, 1))),
    Fault("colours of the image in sRGB", "image", after=_colored(lambda c, _: encode_srgb(np.maximum(c, 0)))),
    Fault(
        "colours of the image to the power of {}",
        "image",
        after=_colored(lambda c, s: np.maximum(c, 0) ** s),
        sizes=(1 / 2.2, 2.2),
    ),
    Fault("colours of the image times {}", "image", after=_colored(lambda c, s: s * c), sizes=(0.5, 255.0), null=1.0),
    Fault("red and blue of the image exchanged", "image", after=_colored(lambda c, _: c[..., ::-1])),
    Fault(
        "colours of the image divided by alpha",
        "image",
        after=lambda a, _: a | {"image": a["image"] / np.maximum(a["alpha"], 1e-10)[..., None]},
    ),
    Fault("expected depths that are not divided by alpha", "image", after=_expected_depth(lambda z, a: z * a)),
    Fault(
        "expected depths divided by alpha twice", "image", after=_expected_depth(lambda z, a: z / np.maximum(a, 1e-10))
    ),
    Fault("accumulated depths divided by alpha", "image", after=_normalised),
)
