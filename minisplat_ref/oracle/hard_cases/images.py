"""Images of one pixel, of one column, of nothing; tiles that hang over the edge."""

import numpy as np

from minisplat_ref.oracle.hard_cases.case import HardCase
from minisplat_ref.oracle.hard_cases.scenes import call, camera, cloud, gaussians
from minisplat_ref.oracle.hard_cases.subjects import Parameters
from minisplat_ref.oracle.tolerances import FAINT

EVERY_PIXEL = "as a cut from a larger image"


def _sized(width: int, height: int, **focal: float) -> Parameters:
    return Parameters(cloud(40), camera(width, height, **focal))


IMAGES = (
    HardCase("1x1", "one pixel: smaller than any tile", EVERY_PIXEL, lambda: _sized(1, 1)),
    HardCase("2x1", "two pixels", EVERY_PIXEL, lambda: _sized(2, 1)),
    HardCase("3x1000", "63 tiles that are mostly beyond the edge", EVERY_PIXEL, lambda: _sized(3, 1000, fy=1400.0)),
    HardCase("1000x3", "125 tiles that are mostly beyond the edge", EVERY_PIXEL, lambda: _sized(1000, 3, fx=1400.0)),
    HardCase("no-tile-divides", "37 x 41: both are prime", EVERY_PIXEL, lambda: _sized(37, 41, fx=50.0, fy=50.0)),
    HardCase("one-more-than-tiles", "17 x 33: one pixel over 16 and 8", EVERY_PIXEL, lambda: _sized(17, 33)),
    HardCase("one-less-than-tiles", "15 x 31", EVERY_PIXEL, lambda: _sized(15, 31)),
    HardCase(
        "more-tiles-than-gaussians",
        "one small Gaussian in 256 tiles",
        "255 tiles of background",
        lambda: Parameters(gaussians([[0.4, -0.3, 3]], 0.02), camera(128, 128, fx=100.0, fy=100.0)),
    ),
    HardCase(
        "empty-scene",
        "no Gaussians",
        "the background; empty gradients",
        lambda: Parameters(cloud(0), camera()),
        is_background=True,
    ),
    HardCase(
        "empty-call",
        "no Gaussians, in every array of the call",
        "the background; empty gradients",
        lambda: call(np.zeros((0, 3))),
        is_background=True,
    ),
    HardCase(
        "nothing-in-sight",
        "all Gaussians are behind the camera",
        "the background",
        lambda: Parameters(cloud()._replace(means=cloud().means * [1, 1, -1]), camera()),
        is_background=True,
    ),
    HardCase(
        "accumulated-depth-alone",
        "no colour channel at all",
        "sum of w z; 0 where nothing is",
        lambda: call([[0.1, 0, 2], [-0.1, 0.1, 3]], 0.05, size=(12, 9), render_mode="D"),
    ),
    HardCase(
        "expected-depth-of-empty-pixels",
        "sum of w z over sum of w is 0 / 0 there",
        "depth 0 and no gradient where nothing is",
        lambda: call([[0.1, 0, 2], [-0.1, 0.1, 3]], 0.05, size=(12, 9), render_mode="RGB+ED"),
        FAINT,
    ),
    HardCase(
        "expected-depth-of-faint-pixels",
        "alpha just above 1/255: the quotient of two small numbers",
        "between the least and the largest depth",
        lambda: call([[0.1, 0, 2], [-0.1, 0.1, 300]], [[0.3] * 3, [30] * 3], 0.006, size=(12, 9), render_mode="RGB+ED"),
        FAINT,
    ),
    HardCase(
        "accumulated-depth",
        "a channel of world units beside colours",
        "as the colours, with each Gaussian's depth for its colour",
        lambda: Parameters(cloud(), camera(), with_depth=True),
    ),
)
