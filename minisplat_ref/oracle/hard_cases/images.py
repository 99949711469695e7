"""Hard cases of images: one pixel or nothing in view, extreme colours, losses that divide 0 by a tiny number."""

import numpy as np

from minisplat_ref.constants import SH_C0
from minisplat_ref.oracle.hard_cases.scenes import call, camera, cloud, gaussians, round_to_float32
from minisplat_ref.oracle.hard_cases.subjects import Call, HardCase, Images, Parameters
from minisplat_ref.oracle.tolerances import FAINT, HARMONICS, SIMILARITY
from minisplat_ref.types import Floats

EVERY_PIXEL = "as a cut from a larger image"


def _make_sized(width: int, height: int, **focal: float) -> Parameters:
    return Parameters(cloud(40), camera(width, height, **focal))


IMAGES = (
    HardCase("1x1", "one pixel: smaller than any tile", EVERY_PIXEL, lambda: _make_sized(1, 1)),
    HardCase("2x1", "two pixels", EVERY_PIXEL, lambda: _make_sized(2, 1)),
    HardCase(
        "3x1000", "63 tiles that are mostly beyond the edge", EVERY_PIXEL, lambda: _make_sized(3, 1000, fy=1400.0)
    ),
    HardCase(
        "1000x3", "125 tiles that are mostly beyond the edge", EVERY_PIXEL, lambda: _make_sized(1000, 3, fx=1400.0)
    ),
    HardCase("no-tile-divides", "37 x 41: both are prime", EVERY_PIXEL, lambda: _make_sized(37, 41, fx=50.0, fy=50.0)),
    HardCase("one-more-than-tiles", "17 x 33: one pixel over 16 and 8", EVERY_PIXEL, lambda: _make_sized(17, 33)),
    HardCase("one-less-than-tiles", "15 x 31", EVERY_PIXEL, lambda: _make_sized(15, 31)),
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


AXES = {"x": (1, 0, 0), "y": (0, 1, 0), "z": (0, 0, 1)}


def _look_straight(axis: int, sign: float) -> Parameters:
    """One Gaussian straight ahead of a camera that looks along a world axis: the other two components are 0."""
    rows = [np.eye(3)[(axis + 1) % 3], np.eye(3)[(axis + 2) % 3], np.eye(3)[axis]]
    R = np.array(rows) * [[1.0], [sign], [sign]]  # a rotation for either sign
    rest = 0.3 * np.random.default_rng(9).normal(size=(1, 15, 3))
    return Parameters(gaussians([3 * sign * np.eye(3)[axis]], sh_rest=rest), camera(cam_from_world_R=R))


def _make_clamped(value: float) -> Parameters:
    return Parameters(cloud(sh_dc=np.full((30, 3), round_to_float32((value - 0.5) / SH_C0))), camera())


def _coefficients(factor: float) -> Parameters:
    population = cloud(sh_degree=3)
    return Parameters(population._replace(sh_rest=round_to_float32(factor * population.sh_rest)), camera())


def _channels(colors: Floats) -> Call:
    return call(
        np.random.default_rng(6).uniform((-0.2, -0.2, 2.8), (0.2, 0.2, 3.2), size=(len(colors), 3)), colors=colors
    )


COLORS = (
    *(
        HardCase(
            f"sh-3-at-{'plus' if sign > 0 else 'minus'}-{name}",
            "two components of the direction are 0: most polynomials vanish, their derivatives do not",
            "the polynomials' value and derivative; no 0 / 0 of angles",
            lambda axis=axis, sign=sign: _look_straight(axis, sign),  # type: ignore[misc]
        )
        for axis, name in enumerate(AXES)
        for sign in (1.0, -1.0)
    ),
    HardCase("sh-3-of-many", "all sixteen polynomials", "their sum, clamped at 0", lambda: _coefficients(1.0)),
    HardCase(
        "sh-3-times-1e4",
        "coefficients of 1e4 cancel to what is seen",
        "their sum, relative to its terms",
        lambda: _coefficients(1e4),
        HARMONICS,
    ),
    HardCase(
        "color-below-0",
        "all channels are negative before the clamp",
        "black, and no gradient with respect to the colours",
        lambda: _make_clamped(-0.3),
    ),
    HardCase(
        "color-just-above-0",
        "1e-3 above the clamp",
        "nearly black, and the whole gradient with respect to the colours",
        lambda: _make_clamped(1e-3),
    ),
    HardCase(
        "colors-negative-and-huge",
        "given channels from -1e6 to 1e6",
        "no clamp: they are any numbers",
        lambda: _channels(round_to_float32(np.linspace(-1e6, 1e6, 60).reshape(20, 3))),
    ),
    HardCase(
        "colors-1e30",
        "their squares are beyond float32",
        "sums of 1e30, finite",
        lambda: _channels(np.full((20, 3), round_to_float32(1e30))),
    ),
    HardCase(
        "colors-1e-40",
        "subnormal in float32",
        "as good as black",
        lambda: _channels(np.full((20, 3), round_to_float32(1e-40))),
    ),
    HardCase(
        "background-1e6",
        "a million times brighter than the Gaussians: alpha's last digit is seen",
        "what the Gaussians leave of it",
        lambda: Parameters(cloud(scales=0.3), camera(), background=(1e6, 1e6, 0.0)),
        HARMONICS,
    ),
)


def _noise(height: int = 20, width: int = 24, seed: int = 0) -> Floats:
    return round_to_float32(np.random.default_rng(seed).uniform(size=(height, width, 3)))


def _flat(value: float, height: int = 20, width: int = 24) -> Floats:
    return np.full((height, width, 3), round_to_float32(value))


def _one_bright() -> Floats:
    image = _flat(0.0)
    image[9, 11] = 1
    return image


def _checkers() -> Floats:
    y, x = np.mgrid[:20, :24]
    return np.repeat(((x + y) % 2)[:, :, None], 3, axis=2).astype(float)


def _mask(row: int) -> np.ndarray:
    mask = np.zeros((20, 24), dtype=bool)
    mask[row:, 11] = True
    return mask


EQUAL = "loss 0 and, but for rounding, no gradient"
FLAT = "variance 0, as a difference of means: rounding decides its sign; C2 keeps the quotient away from 0 / 0"

LOSSES = (
    HardCase("ssim-flat-equal", FLAT, EQUAL, lambda: Images(_flat(0.5), _flat(0.5)), SIMILARITY),
    HardCase(
        "ssim-flat-white",
        "the same at 1, where squares are largest",
        EQUAL,
        lambda: Images(_flat(1.0), _flat(1.0)),
        SIMILARITY,
    ),
    HardCase(
        "ssim-black",
        "all moments are 0: (C1 C2) / (C1 C2)",
        EQUAL,
        lambda: Images(_flat(0.0), _flat(0.0)),
        SIMILARITY,
    ),
    HardCase(
        "ssim-flat-different", FLAT, "luminance alone differs", lambda: Images(_flat(0.25), _flat(0.75)), SIMILARITY
    ),
    HardCase(
        "ssim-black-white",
        "structure 1, luminance C1 / (1 + C1)",
        "nearly the largest loss",
        lambda: Images(_flat(0.0), _flat(1.0)),
        SIMILARITY,
    ),
    HardCase(
        "ssim-equal",
        "the derivative is a sum of terms that cancel, and the sign of 0 is asked for",
        EQUAL,
        lambda: Images(_noise(), _noise()),
        SIMILARITY,
    ),
    HardCase(
        "ssim-nearly-equal",
        "differences of 1e-7, one float32",
        "signs of the differences; SSIM 1 but for rounding",
        lambda: Images(_noise(), round_to_float32(_noise() + 1e-7)),
        SIMILARITY,
    ),
    HardCase(
        "ssim-one-bright-pixel",
        "one pixel in a flat image",
        "finite, largest around it",
        lambda: Images(_one_bright(), _flat(0.0)),
        SIMILARITY,
    ),
    HardCase(
        "ssim-checkers",
        "the largest variance there is, against its inverse",
        "SSIM near -1",
        lambda: Images(_checkers(), 1 - _checkers()),
        SIMILARITY,
    ),
    HardCase(
        "ssim-alone", "w = 1: no L1 beside it", "1 - SSIM", lambda: Images(_noise(), _noise(seed=1), 1.0), SIMILARITY
    ),
    HardCase(
        "l1-alone",
        "w = 0",
        "mean difference and its signs",
        lambda: Images(_noise(), _noise(seed=1), 0.0),
        SIMILARITY,
    ),
    HardCase(
        "ssim-beyond-1",
        "values up to 30, whose squares are far above C1 and C2",
        "the same formula",
        lambda: Images(30 * _noise(), 30 * _noise(seed=1)),
        SIMILARITY,
    ),
    HardCase(
        "ssim-1x1",
        "the window of 11 pixels finds one",
        "zeros beyond the border",
        lambda: Images(_noise(1, 1), _noise(1, 1, 1)),
        SIMILARITY,
    ),
    HardCase(
        "ssim-3x1000",
        "narrower than the window",
        "zeros beyond the border",
        lambda: Images(_noise(1000, 3), _noise(1000, 3, 1)),
        SIMILARITY,
    ),
    HardCase(
        "ssim-mask-empty",
        "no pixel counts: a mean over nothing",
        "loss 0, gradient 0",
        lambda: Images(_noise(), _noise(seed=1), mask=_mask(20)),
        SIMILARITY,
    ),
    HardCase(
        "ssim-mask-one-pixel",
        "one pixel counts, windows see its neighbours",
        "nothing leaks in from outside",
        lambda: Images(_noise(), _noise(seed=1), mask=_mask(19)),
        SIMILARITY,
    ),
)
