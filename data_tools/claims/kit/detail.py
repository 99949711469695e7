"""PSNR where a photograph is flat and where it has detail.

A mean over all pixels hides what a method does to detail. So the pixels of each test photograph are split by the
length of their gradient into the flatter half and the textured half, and each is measured by itself.
"""

from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.metrics import ViewMetrics, evaluate, psnr
from minisplat_ref.rendering import RenderSettings
from minisplat_ref.types import Bools, Floats, Gaussians, Model, Scene, View


class Quality(NamedTuple):
    """Agreement with the test views, dB."""

    psnr: float
    flat: float
    """Over the flatter half of the pixels of each view."""
    textured: float
    """Over the other half."""


def quality(model: Model | Gaussians, scene: Scene, settings: RenderSettings | None = None) -> Quality:
    """Return the mean PSNR over the test views of all pixels, of the flatter half of each view, and of the rest.

    Parameters
    ----------
    model : Model or Gaussians
    scene : Scene
    settings : RenderSettings, optional
        How to render; by default as in 3DGS, in front of the scene's background.
    """
    found = []

    def on_view(view: View, image: Floats, metrics: ViewMetrics) -> None:
        photo = view.load()
        halves = halves_of(photo.image, photo.mask)
        clipped = np.clip(image, 0, 1)
        found.append((metrics.psnr, *(psnr(clipped, photo.image, half) for half in halves)))

    evaluate(model, scene.test_views, settings or RenderSettings(scene.background), on_view=on_view)
    return Quality(*np.mean(found, axis=0).tolist())


def halves_of(pixels: Any, mask: Bools | None = None) -> tuple[Bools, Bools]:
    """Return which pixels have the smaller and which the larger gradient of the mean of the channels, [H, W] each.

    Only pixels of the mask belong to a half.
    """
    dy, dx = np.gradient(np.asarray(pixels, np.float64).mean(axis=2))
    ascending = np.argsort(np.hypot(dx, dy), axis=None, kind="stable")
    if mask is not None:
        ascending = ascending[mask.ravel()[ascending]]
    halves = np.zeros((2, *dx.shape), bool)
    n = len(ascending) // 2
    halves[0].flat[ascending[:n]] = True
    halves[1].flat[ascending[n:]] = True
    return halves[0], halves[1]
