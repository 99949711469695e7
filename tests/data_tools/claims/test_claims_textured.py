"""Textures at the limb, and small runs of both claims."""

import numpy as np
import pytest

from data_tools.claims.__main__ import main as measure_claim
from data_tools.claims.textured import colors_across
from measured_claims import measured, scene_folder  # noqa: F401  (a fixture)
from minisplat_ref.app.cli import main


@pytest.fixture(scope="module")
def run_folder(scene_folder, tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "plain"
    options = ["--recipe", "3dgs-accel", "--test-every", "4", "--iterations", "60", "--out", str(folder)]
    assert main(["train", str(scene_folder), *options]) == 0
    return folder


def test_a_texture_does_not_jump_at_the_limb():
    """Rays ten times closer differ ten times less; a texture that ends at the limb jumps as much as before."""
    coarse, fine = (np.abs(np.diff(colors_across(step)[0])).max() for step in (0.01, 0.001))
    assert 0 < fine < 0.15 * coarse
    assert np.abs(np.diff(colors_across(0.001)[1])).max() > 0.1


def test_the_claims(scene_folder, run_folder, tmp_path, capsys):
    out, ply = tmp_path / "measured", str(run_folder / "point_cloud.ply")
    options = ["--ply", ply, "--fine-tune", "3", "--out", str(out)]
    (rows,) = measured(["textured/counts", str(scene_folder), *options])["runs"]
    assert [row["form"] for row in rows].count("textures for view") == 4
    fewer = [row["n_floats"] for row in rows if row["kept"] == "as many floats"]
    assert len(fewer) == 2 and max(fewer) <= rows[0]["n_floats"]
    assert (out / "figure.png").stat().st_size > 10_000 and "| as many floats" in capsys.readouterr().out
    assert measure_claim(["textured/limb"]) == 0
    assert "nearest point beyond" in capsys.readouterr().out
