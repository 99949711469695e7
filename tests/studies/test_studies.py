"""The studies: through the command line with tiny settings, and what their tables say must be what was measured."""

import json

import numpy as np
import pytest

from minisplat_ref.cli import main
from minisplat_ref.io import load_scene, save_ply
from minisplat_ref.io.images import read_image
from minisplat_ref.methods import get_recipe
from minisplat_ref.studies import all_studies, depth_types
from minisplat_ref.studies.study import FIGURE, RESULT
from minisplat_ref.training.initial_state import initial_state

TINY = ("--views", "6", "--width", "32", "--height", "24", "--supersampling", "1", "--points", "150")


@pytest.fixture(scope="module")
def scene_folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("studies") / "room"
    assert main(["synthetic", "room", "--out", str(folder), *TINY]) == 0
    return folder


def read_result(folder):
    """The JSON, and a figure that is an image with something in it."""
    assert sorted(path.name for path in folder.iterdir()) == sorted([FIGURE, RESULT])
    assert read_image(folder / FIGURE).std() > 1
    return json.loads((folder / RESULT).read_text())


def table_rows(text):
    """Cells of the Markdown table without its header."""
    lines = [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines() if line[:1] == "|"]
    return {line[0]: line[1:] for line in lines[2:]}


def test_studies_are_listed(capsys):
    assert main(["study"]) == 0
    lines = capsys.readouterr().out.splitlines()
    for name, study in all_studies().items():
        (line,) = [line for line in lines if line.split()[:1] == [name]]
        assert study.name == name and line.endswith(study.summary) and len(line) <= 80


# culling


def check_culling(row):
    """The fraction from the table of who is visible agrees with what was drawn view by view."""
    drawn, tile_pairs = np.array(row["views"]["gaussians"]), np.array(row["views"]["tile_pairs"])
    assert (drawn[:, 1] <= drawn[:, 0]).all() and (tile_pairs[:, 1] <= tile_pairs[:, 0]).all()
    assert row["culled_fraction"] == pytest.approx(1 - drawn[:, 1].sum() / drawn[:, 0].sum())
    assert row["culled_fraction_of_tile_pairs"] == pytest.approx(1 - tile_pairs[:, 1].sum() / tile_pairs[:, 0].sum())
    assert 0 <= row["culled_fraction"] < 1
    assert row["ratio_of_medians"] == pytest.approx(row["ms_without"] / row["ms_with"])
    assert abs(row["train_psnr_with"] - row["train_psnr_without"]) < 1


def test_culling_of_a_training(scene_folder, tmp_path, capsys):
    out = tmp_path / "out"
    arguments = ["study", "culling", str(scene_folder), "--out", str(out), "--iterations", "54", "--repeats", "2"]
    assert main(arguments) == 0
    result, rows = read_result(out), table_rows(capsys.readouterr().out)
    assert list(rows) == list(result["places"]) == ["before simplification", "before culling ends"]
    before, after = result["places"].values()
    for row in (before, after):
        check_culling(row)
    assert after["n_gaussians"] < before["n_gaussians"] and before["culled_fraction"] > 0
    assert rows["before simplification"][2] == f"{before['culled_fraction']:.1%}"


def test_culling_of_given_gaussians(scene_folder, tmp_path, capsys):
    scene = load_scene(scene_folder)
    gaussians = initial_state(scene, get_recipe("3dgs"), seed=0).gaussians
    save_ply(tmp_path / "some.ply", gaussians)
    out, ply = tmp_path / "out", str(tmp_path / "some.ply")
    assert main(["study", "culling", str(scene_folder), "--out", str(out), "--ply", ply, "--repeats", "2"]) == 0
    result, rows = read_result(out), table_rows(capsys.readouterr().out)
    assert list(rows) == ["some.ply"]
    row = result["places"]["some.ply"]
    check_culling(row)
    assert row["n_gaussians"] == len(gaussians.means) and row["culled_fraction"] > 0


# bad input


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["ablation", "nowhere"], "nowhere: neither a folder nor one of room, "),
        (["ablation", "SCENE", "--recipe", "5dgs"], "recipe '5dgs' does not exist"),
        (["simplify", "SCENE", "--recipe", "5dgs"], "recipe '5dgs' does not exist"),
        (
            ["ablaton", "SCENE"],
            "there is no study 'ablaton': choose from adaptive, folds, ablation, culling, simplify, max-drop, mesh",
        ),
        (
            ["culling", "room", "--downscale", "2"],
            "room is made at 160 x 120; write it with minisplat-ref synthetic",
        ),
        (["culling", "SCENE", "--ply", "no.ply"], "no.ply"),
        (["culling", "SCENE", "--out", "SCENE"], "already there and not empty"),
    ],
)
def test_bad_input_is_one_line(scene_folder, tmp_path, capsys, arguments, message):
    arguments = [str(scene_folder) if argument == "SCENE" else argument for argument in arguments]
    out = [] if "--out" in arguments else ["--out", str(tmp_path / "out")]
    assert main(["study", *arguments, *out]) == 2
    error = capsys.readouterr().err
    assert error.startswith("minisplat-ref: error: ") and error.count("\n") == 1 and message in error
    assert not (tmp_path / "out").exists()


def test_interrupted_study_leaves_nothing(tmp_path, capsys, monkeypatch):
    def interrupt(*arguments):
        raise KeyboardInterrupt

    monkeypatch.setattr(depth_types, "measure", interrupt)
    assert main(["study", "depth", "room", "--out", str(tmp_path / "out")]) == 130
    assert "minisplat-ref: interrupted\n" in capsys.readouterr().err
    assert not any(tmp_path.iterdir())
