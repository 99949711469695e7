"""The errors that docs/conformance reports, in the programs themselves: a version that mends one fails here.

Then its report and its row in tests/helpers/reported_errors.py are out of date. What is expected is computed in
tests/data_tools/test_reported_errors.py, without the programs.
"""

import numpy as np
import pytest

from data_tools.conformance.probes import Probe
from minisplat_ref.errors import InputError
from reported_errors import BY_NAME, REPORTED

pytestmark = pytest.mark.interop

LEVELS = 2  # of 255: the picture is rounded, and what is stored in bytes was before


@pytest.mark.parametrize("error", REPORTED, ids=str)
def test_an_error_is_still_there(show, error):
    x, y = error.pixel
    picture = 255 * show(error.renderer, error.probe, error.n_more)
    np.testing.assert_allclose(picture[y, x], error.found, rtol=0, atol=LEVELS)
    if error.found == (0, 0, 0) == error.probe.background:
        assert picture.max() == 0  # at every pixel


def test_triangles_of_gaussian_splats_3d(show):
    """Of three Gaussians half of each quad, of six all: one corner of the disc is dark, the other is not."""
    g = BY_NAME["disc"].gaussians
    three, six = (
        show("mkkellogg", Probe("some", "", g._make(np.repeat(field, n, axis=0) for field in g)), 0)[..., 0]
        for n in (3, 6)
    )
    disc = six[20:44, 36:60] > 0.1
    assert 0.4 < (three[20:44, 36:60][disc] > 0.1).mean() < 0.6


@pytest.mark.parametrize(("n_more", "is_sorted"), [(400, False), (600, True)])
def test_gsplatjs_sorts_large_scenes(show, n_more, is_sorted):
    error = next(error for error in REPORTED if error.renderer == "gsplatjs" and error.probe.name == "order")
    x, y = error.pixel
    picture = 255 * show("gsplatjs", error.probe, n_more)
    np.testing.assert_allclose(picture[y, x], error.expected if is_sorted else error.found, rtol=0, atol=LEVELS)


@pytest.mark.parametrize(
    ("behind", "message"),
    [((0, 1), r"tensor a \(0\) must match .* tensor b \(2\)"), ((0,), r"shape of the mask \[2\]")],
)
def test_torch_splatting_ends_with_a_gaussian_behind(show, behind, message):
    g = BY_NAME["near"].gaussians
    means = g.means.copy()
    means[[k for k in range(2) if k not in behind], 2] = 4.0
    with pytest.raises(InputError, match=message):
        show("torch-splatting", BY_NAME["near"]._replace(gaussians=g._replace(means=means)))
