"""Claims: through the command line with tiny settings, and what their tables say must be what was measured."""

import re
from pathlib import Path

import numpy as np
import pytest

import minisplat_ref
from data_tools.claims import all_claims, kit
from data_tools.claims import depth as depth_types
from data_tools.claims.__main__ import main as measure_claim
from measured_claims import read_result
from minisplat_ref.app.cli import main
from minisplat_ref.io import load_scene, save_ply
from minisplat_ref.methods import get_recipe
from minisplat_ref.training.initial_state import initial_state

TINY = ("--views", "6", "--width", "32", "--height", "24", "--supersampling", "1", "--points", "150")


@pytest.fixture(scope="module")
def scene_folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("claims") / "room"
    assert main(["synthetic", "room", "--out", str(folder), *TINY]) == 0
    return folder


def table_rows(text):
    """Cells of the Markdown table without its header."""
    lines = [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines() if line[:1] == "|"]
    return {line[0]: line[1:] for line in lines[2:]}


def test_claims_are_listed(capsys):
    assert measure_claim([]) == 0
    lines = capsys.readouterr().out.splitlines()
    claims = all_claims()
    assert len(lines) == len(claims) >= 70
    for name, claim in claims.items():
        (line,) = [line for line in lines if line.split()[:1] == [name]]
        assert line.endswith(claim.summary) and name.endswith(claim.name)


@pytest.mark.parametrize("name", list(all_claims()))
def test_help_has_an_example_and_fits_a_terminal(name, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    with pytest.raises(SystemExit) as end:
        measure_claim([name, "--help"])
    text = capsys.readouterr().out
    assert end.value.code == 0 and "example" in text
    assert max(map(len, text.splitlines())) <= 80


@pytest.mark.parametrize("name", ["no-such", "textured/no-such", "kit", ""])
def test_a_claim_that_does_not_exist(name, capsys):
    assert measure_claim([name]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"data_tools.claims: error: there is no claim {name!r}: choose from ")


def test_what_is_installed_needs_no_claim():
    """The contract of import-linter, for modules that are imported by their names."""
    files = (Path(minisplat_ref.__file__).parent).rglob("*.py")
    texts = {path: path.read_text(encoding="utf-8") for path in files}
    assert not [path for path, text in texts.items() if re.search(r"^\s*(from|import) data_tools", text, re.MULTILINE)]


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
    arguments = ["culling", str(scene_folder), "--out", str(out), "--iterations", "54", "--repeats", "2"]
    assert measure_claim(arguments) == 0
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
    assert measure_claim(["culling", str(scene_folder), "--out", str(out), "--ply", ply, "--repeats", "2"]) == 0
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
        (["ablaton", "SCENE"], "there is no claim 'ablaton': choose from ablation, adaptive, analytic, "),
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
    assert measure_claim([*arguments, *out]) == 2
    error = capsys.readouterr().err
    assert error.startswith("data_tools.claims: error: ") and error.count("\n") == 1 and message in error
    assert not (tmp_path / "out").exists()


def test_interrupted_claim_leaves_nothing(tmp_path, capsys, monkeypatch):
    def interrupt(*arguments):
        raise KeyboardInterrupt

    monkeypatch.setattr(depth_types, "measure", interrupt)
    assert measure_claim(["depth", "room", "--out", str(tmp_path / "out")]) == 130
    assert "data_tools.claims: interrupted\n" in capsys.readouterr().err
    assert not any(tmp_path.iterdir())


def test_angles_between_directions():
    """Hand-worked: a right angle, 60 degrees between directions of other lengths, opposite ones, and no direction."""
    found = np.array([[0, 0, 2.0], [1, 1, 0], [-3, 0, 0], [0, 0, 0]])
    truth = np.array([[1.0, 0, 0], [0, 0.5**0.5, 0.5**0.5], [1, 0, 0], [0, 1, 0]])
    assert kit.angles(found, truth) == pytest.approx([90, 60, 180, 90])
