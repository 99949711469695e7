"""GauStudio through the command line: the list of modules, an exchange of all stages, masks, bad names."""

import json
import re

import numpy as np
import pytest

from minisplat_ref.app.cli import main
from minisplat_ref.app.runs.depth_maps import DepthKind
from minisplat_ref.extensions.gaustudio.commands import DEPTHS, STAGES, all_stages
from minisplat_ref.io import load_scene
from minisplat_ref.io.images import read_image

TINY = ("--views", "9", "--width", "32", "--height", "24", "--supersampling", "1", "--points", "150")
OTHERS = {
    "initialiser": "box",
    "representation": "surfels",
    "background": "sky_map",
    "photo_loss": "squared",
    "density": "halves",
    "sky_mask": "from_files",
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("gaustudio")
    assert main(["synthetic", "outdoor", "--out", str(folder / "scene"), *TINY]) == 0
    assert main(["gaustudio", "masks", str(folder / "scene"), "--out", str(folder / "masks")]) == 0
    return folder


def train(folder, out, *options):
    common = ["train", str(folder / "scene"), "--recipe", "gaustudio", "--iterations", "8"]
    return main([*common, "--out", str(folder / out), *options])


def test_the_list_is_what_set_takes(capsys):
    assert main(["gaustudio", "modules"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 92 and sum(line.startswith("  * ") for line in lines) == len(STAGES) + 1
    assert DEPTHS.keys() == {kind.value for kind in DepthKind} and next(iter(DEPTHS)) == "median"
    for stage in all_stages():
        assert stage.present in stage.modules and len(stage.modules) > 1
        assert any(line.startswith(f"--set {stage.name}=") for line in lines)
        for name, module in stage.modules.items():
            (line,) = [line for line in lines if line[4:].split()[:1] == [name]]
            assert module.__doc__.split()[0] in line


def test_masks_are_those_of_the_tracer(folder):
    """Of the sky of ``outdoor`` the rule finds nearly all and hardly anything else; the depths are 0 there."""
    scene = load_scene(folder / "scene", test_every=0)
    found = [read_image(folder / "masks" / f"{view.name}.png")[..., 0] > 0 for view in scene.train_views]
    truth = [np.load(folder / "scene" / "depths" / f"{view.name}.npy") == 0 for view in scene.train_views]
    both, either = np.sum(np.logical_and(found, truth)), np.sum(np.logical_or(found, truth))
    assert np.sum(truth) > 500 and both / either > 0.8


def test_all_stages_are_exchanged_at_once(folder, capsys):
    """Then the run is rendered, measured and continued, and its PLY says by what it is drawn."""
    chosen = [word for name, value in OTHERS.items() for word in ("--set", f"{name}={value}")]
    assert train(folder, "all", *chosen, "--set", f"mask_folder={folder / 'masks'}") == 0
    assert "the sky" in capsys.readouterr().out, "which the PLY does not hold"
    config = json.loads((folder / "all" / "config.json").read_text())
    assert config["recipe"]["representation"]["renderer"] == {"representation": "surfels", "background": "sky_map"}
    with np.load(folder / "all" / "shared.npz") as shared:
        assert shared["sky"].shape == (64, 128, 3) and shared["sky"].std() > 0
    for command in (["eval"], ["render"], ["train", "--resume"]):
        more = ["--iterations", "10"] if "--resume" in command else []
        assert main([*command, str(folder / "all"), *more]) == 0
    capsys.readouterr()
    assert main(["info", str(folder / "all" / "point_cloud.ply")]) == 0
    said = capsys.readouterr()
    assert "gaustudio" in said.out + said.err and "sky" in said.out + said.err


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("background=cube", "background=cube names no function: choose from ball, harmonics, nothing, sky_map"),
        ("density=grow", "density=grow names no function: choose from clones, fixed, halves"),
        ("representation=points", "representation=points names no function: choose from gaussians, surfels"),
        ("sky=true", "recipe gaustudio has no sky to set; did you mean sky_mask"),
        ("sky_mask=from_files", "sky_mask=from_files has no folder to read: add --set mask_folder=DIR"),
    ],
)
def test_bad_names_are_one_line(folder, capsys, setting, message):
    assert train(folder, "bad", "--set", setting) == 2
    (line,) = [line for line in capsys.readouterr().err.splitlines() if "error" in line]
    assert re.search(message, line)
    assert not (folder / "bad").exists()
