"""Published images of Lego: the curve over the cameras, an agreement by hand, and what is refused."""

import json

import numpy as np
import pytest

from data_tools import published_images
from data_tools.published_images import compare, main, read_published
from minisplat_ref.errors import InputError


def write_run(folder, psnr):
    """A run that has ended, with the PSNR of its test images by name."""
    folder.mkdir()
    views = [{"name": name, "psnr": value} for name, value in psnr.items()]
    (folder / "metrics.json").write_text(json.dumps({"per_view": views}))
    return folder


def test_neighbouring_cameras_have_similar_figures():
    """From camera to camera it changes by less than a third of what it would in the order of the file names."""
    published = read_published()
    assert len(published) == 157 and published["r_0"] == 34.62 and published["r_10"] == 24.72
    by_camera = [published[f"r_{i}"] for i in range(100, 200)]
    by_name = [published[name] for name in sorted(published)]
    assert 3 * np.abs(np.diff(by_camera)).mean() < np.abs(np.diff(by_name)).mean()


def test_an_agreement_by_hand(tmp_path, monkeypatch, capsys):
    """Differences are 1, -1 and 3: their mean is 1, and their deviation sqrt((0 + 4 + 4) / 2) = 2."""
    table = tmp_path / "published.csv"
    table.write_text("image,psnr\nr_0,30\nr_1,31\nr_2,32\nr_3,33\n")
    monkeypatch.setattr(published_images, "PUBLISHED", table)
    run = write_run(tmp_path / "run", {"test_r_0": 31.0, "test_r_1": 30.0, "test_r_2": 35.0, "test_r_9": 99.0})
    found = compare(run)
    assert (found.n, found.published, found.ours, found.spread) == pytest.approx((3, 31, 32, 2))
    assert found.correlation == pytest.approx(4 / np.sqrt(2 * 14))  # products of deviations 1, 0 and 3
    assert (found.lowest, found.highest) == (("r_1", -1.0), ("r_2", 3.0))
    assert main([str(run), str(run)]) == 0
    cells = [cell.strip() for cell in capsys.readouterr().out.splitlines()[2].split("|")[1:-1]]
    assert cells == ["run", "3", "31.00", "32.00", "2.00", "0.756", "r_1 -1.00", "r_2 +3.00"]


def test_what_cannot_be_compared_is_refused(tmp_path, capsys):
    with pytest.raises(InputError, match="2 test images with a published figure: it is not of Lego"):
        compare(write_run(tmp_path / "two", {"test_r_0": 31.0, "test_r_1": 30.0}))
    assert main([str(tmp_path)]) == 2
    assert capsys.readouterr().err.startswith("published_images: error: ")
