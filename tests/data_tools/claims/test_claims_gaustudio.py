"""GauStudio: the sky and the swaps on a small scene, and what is measured where."""

import numpy as np
import pytest

from data_tools.claims import gaustudio as claim
from data_tools.claims.__main__ import main as measure_claim
from measured_claims import measured
from minisplat_ref.app.cli import main
from minisplat_ref.extensions.gaustudio import commands
from minisplat_ref.extensions.gaustudio.commands import STAGES

TINY = ("--views", "9", "--width", "32", "--height", "24", "--supersampling", "1", "--points", "150")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("gaustudio")
    assert main(["synthetic", "outdoor", "--out", str(folder / "scene"), *TINY]) == 0
    assert main(["gaustudio", "masks", str(folder / "scene"), "--out", str(folder / "masks")]) == 0
    return folder


def test_the_claim_of_the_sky(folder, tmp_path, capsys):
    arms = ["--arms", "without,ball+loss", "--iterations", "60", "--seeds", "0"]
    scene, masks = str(folder / "scene"), ["--masks", str(folder / "masks")]
    without, both = measured(["gaustudio/sky", scene, *masks, *arms, "--out", str(tmp_path / "sky")])["records"]
    assert both["opacity"] < 0.8 * without["opacity"] and both["psnr_sky"] > without["psnr_sky"]
    assert both["opacity"] < both["opacity_scene"] <= 1
    assert "| ball+loss" in capsys.readouterr().out
    assert measure_claim(["gaustudio/sky", scene, "--arms", "moon", "--out", str(tmp_path / "x")]) == 2
    assert "--arms moon is unknown: choose from without, loss, ball" in capsys.readouterr().err


def test_the_claim_of_swaps(folder, tmp_path, capsys):
    options = ["--stages", "photo_loss", "--iterations", "5", "--seeds", "0", "--out", str(tmp_path / "swaps")]
    records = measured(["gaustudio/swaps", str(folder / "scene"), *options])["records"]
    assert [record["arm"] for record in records] == ["as it is", "photo_loss=l1", "photo_loss=squared"]
    assert set(claim.SWAPPED) == STAGES.keys() - {"sky_mask"}
    assert len(claim.swaps(claim.SWAPPED)) == 1 + sum(
        len(stage.modules) - 1 for stage in commands.all_stages() if stage.name != "sky_mask"
    )
    assert (
        measure_claim(["gaustudio/swaps", str(folder / "scene"), "--stages", "sky", "--out", str(tmp_path / "y")]) == 2
    )
    assert "--stages sky is unknown: choose from initialiser" in capsys.readouterr().err


def test_opacity_is_measured_away_from_edges():
    """By hand: without two pixels along the edge of a mask of 7 x 7 its inner 3 x 3 are left."""
    assert claim.EDGE == 2
    is_sky = np.zeros((9, 9), bool)
    is_sky[1:8, 1:8] = True
    inner = claim.binary_erosion(is_sky, iterations=claim.EDGE, border_value=1)
    assert inner.sum() == 9 and inner[3:6, 3:6].all()
    assert claim.psnr_of(np.full(4, 0.01)) == pytest.approx(20) and claim.psnr_of(np.zeros(0)) is None
