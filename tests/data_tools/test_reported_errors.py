"""What docs/conformance reports, without the programs: each figure by two calculations, each cause by hand."""

import re
import struct
from pathlib import Path

import numpy as np
import pytest

from data_tools.conformance.habits import Habits, image_of
from data_tools.conformance.report import NAMES, REPORTS
from minisplat_ref.constants import GSPLAT_MAIN
from reported_errors import BABYLON, BY_NAME, REPORTED, color_by_hand, pixel_by_hand

DOCS = Path(__file__).parents[2] / "docs" / "conformance"
OWN_RULES = Habits(GSPLAT_MAIN)
ROUNDED = 0.5  # of 255
OF_STORED_SCALES = 1.0  # of 255, what colours and opacities in bytes leave
LOST = 29  # of the crowd: the last in the buffer of GaussianSplats3D


@pytest.mark.parametrize("error", REPORTED, ids=str)
def test_what_is_expected_by_two_calculations(error):
    """The reference, and SciPy with mpmath, which differ by what float64 rounds."""
    x, y = error.pixel
    ours, theirs = 255 * np.clip(image_of(error.probe, OWN_RULES)[y, x], 0, 1), pixel_by_hand(error.probe, error.pixel)
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-6)
    np.testing.assert_allclose(theirs, error.expected, rtol=0, atol=ROUNDED)


@pytest.mark.parametrize("error", [error for error in REPORTED if error.probe is not BABYLON], ids=str)
def test_what_was_found_follows_from_the_rules_of_its_source(error):
    """But for Babylon's, which the last digit of single precision decides: it has a test of its own below."""
    x, y = error.pixel
    probe, habits = error.probe, NAMES[error.renderer].habits
    if error.renderer == "mkkellogg" and error.probe.name != "tiny":  # lost, or without a whole triangle: not a rule
        kept = np.arange(len(probe.gaussians.means)) != (LOST if probe.name == "crowd" else 0)
        probe = probe._replace(gaussians=probe.gaussians._make(field[kept] for field in probe.gaussians))
        if not kept.any():
            assert error.found == (0, 0, 0) == probe.background
            return
    shown = 255 * np.clip(image_of(probe, habits)[y, x], 0, 1)
    np.testing.assert_allclose(shown, error.found, rtol=0, atol=ROUNDED + OF_STORED_SCALES)
    assert np.abs(shown - error.expected).max() > 30


@pytest.mark.parametrize("error", REPORTED, ids=str)
def test_the_report_has_these_figures(error):
    text = (DOCS / f"{error.report}.md").read_text()
    x, y = error.pixel
    for color in (error.expected, error.found):
        assert re.search(rf"\b{color[0]}\b" if len(set(color)) == 1 else re.escape(str(color)), text), color
    assert f"pixel ({x}, {y})" in text


def test_every_report_is_tested():
    assert {error.report for error in REPORTED} == set(REPORTS) == {path.stem for path in DOCS.glob("*.md")}


def longer_axis(a, b, d, epsilon=0.0):
    """(b, lambda1 - a) of a covariance [[a, b], [b, d]] in single precision."""
    a, b, d, two = (np.float32(value) for value in (a, b, d, 2))
    longer = (a + d) / two + np.sqrt(((a - d) / two) ** 2 + b * b) + np.float32(epsilon)
    return float(b), float(longer - a)


def test_the_axis_of_an_upright_ellipse_has_length_zero():
    """gsplat.js and splat: diag(l, l); Babylon adds 1e-4, which single precision drops at 8163, and keeps at 100."""
    assert longer_axis(25.3, 0, 25.3) == (0, 0)
    wide = float(np.float16(4 * 1.85**2)) * (80 / 3.7) ** 2 * np.array([1 + (1.9425 / 3.7) ** 2, 1]) + 0.3
    assert wide.round().tolist() == [8163, 6399]
    assert longer_axis(wide[0], 0, wide[1], 1e-4) == (0, 0)
    assert longer_axis(100.3, 0, 100.3, 1e-4)[1] > 0 and longer_axis(6399, 0, 8163, 1e-4)[1] > 1000
    assert np.spacing(np.float32(wide[0])) == pytest.approx(0.0005, rel=0.05)


def test_halves_that_are_made_infinite():
    """splat and gsplat.js take exponents below 142 alone: four times the square of a scale of 90.6 is beyond."""
    for scale, is_infinite in ((90.5, False), (90.6, True), (127.9, True)):
        value = np.float32(4 * scale**2)
        exponent = struct.unpack("<I", struct.pack("<f", value))[0] >> 23
        assert (exponent >= 142) is is_infinite and np.isfinite(np.float16(value))  # which half precision holds


def test_a_small_scene_of_gsplatjs_is_not_sorted():
    """Blocks of the sort: indices of 4 bytes, then means of 12, for the next power of two; 4,096 bytes are written."""

    def n_zeroed(n):
        block = 2 ** int(np.ceil(np.log2(n)))
        return min(max(0, 1024 * int(np.ceil(n / 1024)) * 4 - 4 * block) // 12, n)

    assert [n_zeroed(n) for n in (2, 40, 200, 256)] == [2, 40, 200, 256]
    assert 0 < n_zeroed(512) < 512 and n_zeroed(513) == n_zeroed(1024) == n_zeroed(1500) == n_zeroed(3000) == 0


def test_the_last_gaussian_of_gaussian_splats_3d():
    """Six elements each, copied up to the first of the last; the order is by blocks of 5 units, then by distance."""
    covariances = np.arange(1.0, 6 * 4 + 1)
    copied = np.zeros_like(covariances)
    copied[: 3 * 6 + 1] = covariances[: 3 * 6 + 1]
    assert (copied.reshape(4, 6) > 0).sum(axis=1).tolist() == [6, 6, 6, 1]
    means = BY_NAME["crowd"].gaussians.means.astype(np.float64)
    blocks = np.floor((means - means.min(axis=0)) / 5)
    distances = np.sum((np.floor(2 * means) / 2) ** 2, axis=1)
    assert np.lexsort((distances, blocks[:, 2], blocks[:, 1], blocks[:, 0]))[-1] == LOST


def test_a_half_difference_makes_an_eigenvalue_negative():
    """GaussianSplats3D: diag(0.31, 0.31) has the eigenvalue 0.31 - sqrt(0.1)."""
    assert -0.0065 < 0.31 - 0.1**0.5 < -0.006


def test_indices_of_a_quad():
    """GaussianSplats3D draws as many of a quad's six indices as there are Gaussians."""
    assert [min(n, 6) // 3 for n in range(1, 8)] == [0, 0, 1, 1, 1, 2, 2]


def test_directions_of_torch_splatting_by_hand():
    """Degree n is multiplied by the distance to the power of n, 27 at 3; that makes the pixel, the reference apart."""
    error = next(error for error in REPORTED if error.probe.name == "harmonics")
    found = pixel_by_hand(error.probe, error.pixel, has_unit_directions=False)
    np.testing.assert_allclose(found, error.found, rtol=0, atol=ROUNDED)
    one = np.zeros((15, 3))
    one[11] = 1.0  # z (2 zz - 3 xx - 3 yy)
    unit, raw = (color_by_hand(np.array([0, 0, 3.0]), np.zeros(3), one, is_unit) - 0.5 for is_unit in (True, False))
    np.testing.assert_allclose(raw / unit, 27)


def test_a_tile_of_torch_splatting_stays_white():
    """Three rounded-up deviations of 3.05 px reach from 41.3 to 53.3, and the second tile begins at 64."""
    assert 41.3 + 3 * np.ceil(np.sqrt(9 + 0.3)) < 64
