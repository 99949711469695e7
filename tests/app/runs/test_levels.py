"""Levels of detail: halves by importance, parts of space, and what each level loses."""

import json

import numpy as np
import pytest
from numpy.testing import assert_allclose

from minisplat_ref.app.cli import main
from minisplat_ref.app.runs.levels import write_levels
from minisplat_ref.app.runs.opened_run import open_run
from minisplat_ref.io import load_ply
from minisplat_ref.io.formats import read_content
from minisplat_ref.io.formats.sog import SOG
from minisplat_ref.io.other_places import SOG_LEVELS
from run_commands import refused, write_room  # noqa: F401  (a fixture)

SCENE = {"n_views": 10, "width": 48, "height": 36, "n_points": 600, "test_every": 5}
TRAIN = ("--recipe", "3dgs-accel", "--iterations", "150", "--test-every", "5")


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("levels")
    write_room(folder / "nook", **SCENE)
    assert main(["train", str(folder / "nook"), *TRAIN, "--out", str(folder / "run")]) == 0
    return folder / "run"


def leaves(node):
    if "children" not in node:
        return [node]
    return [leaf for child in node["children"] for leaf in leaves(child)]


def decoded(folder, meta, level):
    """The Gaussians of a level, part by part."""
    references = [leaf["lods"][str(level)] for leaf in leaves(meta["tree"]) if str(level) in leaf["lods"]]
    files = [folder / meta["filenames"][reference["file"]] for reference in references]
    found = [SOG.decode(read_content(path), path) for path in files]
    assert [len(each.means) for each in found] == [reference["count"] for reference in references]
    return np.concatenate([each.means for each in found])


def test_every_level_halves_and_parts_hold_all(run, tmp_path):
    """Four levels in parts of at most 200: each Gaussian of the finest is in one part, inside of its bound."""
    written = write_levels(open_run(run), tmp_path / "out" / SOG_LEVELS, part=200)
    meta = json.loads((tmp_path / "out" / SOG_LEVELS).read_text())
    n = len(load_ply(run / "point_cloud.ply").means)
    assert meta["counts"] == [n, n >> 1, n >> 2, n >> 3] == [level.n_gaussians for level in written]
    assert meta["lodLevels"] == 4 and meta["version"] == 1 and meta["count"] == sum(meta["counts"])
    parts = leaves(meta["tree"])
    assert len(parts) >= n / 200 and all(leaf["lods"]["0"]["count"] <= 200 for leaf in parts)
    finest = decoded(tmp_path / "out", meta, 0)
    own = load_ply(run / "point_cloud.ply").means
    assert_allclose(np.sort(finest[:, 0]), np.sort(own[:, 0]), rtol=1e-3, atol=1e-3)
    low, high = (np.array(meta["tree"]["bound"][end]) for end in ("min", "max"))
    for level in range(4):
        places = decoded(tmp_path / "out", meta, level)
        assert (places >= low - 1e-3).all() and (places <= high + 1e-3).all()
    for leaf in parts:
        assert all(np.array(leaf["bound"]["min"]) >= low - 1e-9) and all(np.array(leaf["bound"]["max"]) <= high + 1e-9)


def test_losses_are_those_of_the_levels(run, tmp_path, capsys):
    """Coarser levels lose more, the finest next to nothing; the file and the terminal say the same."""
    assert main(["convert", str(run), str(tmp_path / "out" / SOG_LEVELS)]) == 0
    printed = capsys.readouterr().out
    meta = json.loads((tmp_path / "out" / SOG_LEVELS).read_text())
    losses = meta["asset"]["psnrLoss"]
    assert abs(losses[0]) < 0.2 and losses[1] < losses[2] < losses[3] and losses[3] > 0.5
    for number, (count, loss) in enumerate(zip(meta["counts"], losses, strict=True)):
        assert f"level {number}: {count:,} Gaussians, {loss:.2f} dB of PSNR" in printed


def test_what_is_refused(run, tmp_path, refused):
    out = tmp_path / "out" / SOG_LEVELS
    assert "--max-bytes means nothing" in refused("convert", run, out, "--max-bytes", "1000")
    assert "is not a folder" in refused("convert", run / "point_cloud.ply", out)
    assert not out.parent.exists()
    out.parent.mkdir()
    (out.parent / "mine.txt").write_text("mine")
    assert "already there and not empty" in refused("convert", run, out)
    assert [path.name for path in out.parent.iterdir()] == ["mine.txt"]
