"""Pictures on which the structural similarity divides zero by nearly zero."""

import numpy as np

from minisplat_ref.oracle.hard_cases.case import HardCase
from minisplat_ref.oracle.hard_cases.scenes import rounded
from minisplat_ref.oracle.hard_cases.subjects import Pictures
from minisplat_ref.oracle.tolerances import SIMILARITY
from minisplat_ref.types import Floats


def _noise(height: int = 20, width: int = 24, seed: int = 0) -> Floats:
    return rounded(np.random.default_rng(seed).uniform(size=(height, width, 3)))


def _flat(value: float, height: int = 20, width: int = 24) -> Floats:
    return np.full((height, width, 3), rounded(value))


def _one_bright() -> Floats:
    picture = _flat(0.0)
    picture[9, 11] = 1
    return picture


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
    HardCase("ssim-flat-equal", FLAT, EQUAL, lambda: Pictures(_flat(0.5), _flat(0.5)), SIMILARITY),
    HardCase(
        "ssim-flat-white",
        "the same at 1, where squares are largest",
        EQUAL,
        lambda: Pictures(_flat(1.0), _flat(1.0)),
        SIMILARITY,
    ),
    HardCase(
        "ssim-black",
        "all moments are 0: (C1 C2) / (C1 C2)",
        EQUAL,
        lambda: Pictures(_flat(0.0), _flat(0.0)),
        SIMILARITY,
    ),
    HardCase(
        "ssim-flat-different", FLAT, "luminance alone differs", lambda: Pictures(_flat(0.25), _flat(0.75)), SIMILARITY
    ),
    HardCase(
        "ssim-black-white",
        "structure 1, luminance C1 / (1 + C1)",
        "nearly the largest loss",
        lambda: Pictures(_flat(0.0), _flat(1.0)),
        SIMILARITY,
    ),
    HardCase(
        "ssim-equal",
        "the derivative is a sum of terms that cancel, and the sign of 0 is asked for",
        EQUAL,
        lambda: Pictures(_noise(), _noise()),
        SIMILARITY,
    ),
    HardCase(
        "ssim-nearly-equal",
        "differences of 1e-7, one float32",
        "signs of the differences; SSIM 1 but for rounding",
        lambda: Pictures(_noise(), rounded(_noise() + 1e-7)),
        SIMILARITY,
    ),
    HardCase(
        "ssim-one-bright-pixel",
        "one pixel in a flat image",
        "finite, largest around it",
        lambda: Pictures(_one_bright(), _flat(0.0)),
        SIMILARITY,
    ),
    HardCase(
        "ssim-checkers",
        "the largest variance there is, against its inverse",
        "SSIM near -1",
        lambda: Pictures(_checkers(), 1 - _checkers()),
        SIMILARITY,
    ),
    HardCase(
        "ssim-alone", "w = 1: no L1 beside it", "1 - SSIM", lambda: Pictures(_noise(), _noise(seed=1), 1.0), SIMILARITY
    ),
    HardCase(
        "l1-alone",
        "w = 0",
        "mean difference and its signs",
        lambda: Pictures(_noise(), _noise(seed=1), 0.0),
        SIMILARITY,
    ),
    HardCase(
        "ssim-beyond-1",
        "values up to 30, whose squares are far above C1 and C2",
        "the same formula",
        lambda: Pictures(30 * _noise(), 30 * _noise(seed=1)),
        SIMILARITY,
    ),
    HardCase(
        "ssim-1x1",
        "the window of 11 pixels finds one",
        "zeros beyond the border",
        lambda: Pictures(_noise(1, 1), _noise(1, 1, 1)),
        SIMILARITY,
    ),
    HardCase(
        "ssim-3x1000",
        "narrower than the window",
        "zeros beyond the border",
        lambda: Pictures(_noise(1000, 3), _noise(1000, 3, 1)),
        SIMILARITY,
    ),
    HardCase(
        "ssim-mask-empty",
        "no pixel counts: a mean over nothing",
        "loss 0, gradient 0",
        lambda: Pictures(_noise(), _noise(seed=1), mask=_mask(20)),
        SIMILARITY,
    ),
    HardCase(
        "ssim-mask-one-pixel",
        "one pixel counts, windows see its neighbours",
        "nothing leaks in from outside",
        lambda: Pictures(_noise(), _noise(seed=1), mask=_mask(19)),
        SIMILARITY,
    ),
)
