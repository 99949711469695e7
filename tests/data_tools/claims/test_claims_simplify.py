"""The claim ``simplify``: through the command line with tiny settings, and its parts on cases done by hand."""

import json

import numpy as np
import pytest
from scipy.spatial import cKDTree

from data_tools.claims import simplify
from data_tools.claims.__main__ import main as measure_claim
from data_tools.claims.kit.claim import RESULT
from measured_claims import read_result
from minisplat_ref.app.cli import main
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.io import load_ply, load_scene, save_ply
from minisplat_ref.methods import get_recipe
from minisplat_ref.metrics import evaluate
from minisplat_ref.rendering import RenderSettings
from minisplat_ref.strategy.importance import collect_importance, indoor
from minisplat_ref.strategy.initialization import gaussians_from_points
from minisplat_ref.strategy.removal import collect_removal_costs
from minisplat_ref.strategy.simplify import intersection_preserving, most_important, select_mass
from minisplat_ref.training.loop import train
from tolerances import CLOSED_FORM, PRINTED_DIGITS

TINY = ("--views", "6", "--width", "32", "--height", "24", "--supersampling", "1", "--points", "200")


@pytest.fixture(scope="module")
def scene_folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("claim") / "room"
    assert main(["synthetic", "room", "--out", str(folder), *TINY]) == 0
    return folder


@pytest.fixture(scope="module")
def dense_file(scene_folder):
    """A Gaussian at each point, small and opaque, so that many dominate a pixel without any training."""
    scene = load_scene(scene_folder)
    gaussians = gaussians_from_points(scene.points, scene.point_colors, sh_degree=1)
    small = gaussians._replace(log_scales=gaussians.log_scales - 1, opacity_logits=gaussians.opacity_logits + 4)
    save_ply(scene_folder.parent / "dense.ply", small)
    return scene_folder.parent / "dense.ply"


@pytest.mark.parametrize("restart", [(), ("--restart",)])
def test_claim(scene_folder, dense_file, tmp_path, capsys, restart):
    out = tmp_path / "out"
    numbers = ("--fractions", "0.2,0.5", "--fine-tune", "2", "--seeds", "0,1")
    arguments = ["simplify", str(scene_folder), "--out", str(out), "--ply", str(dense_file), *numbers]
    assert measure_claim([*arguments, *restart]) == 0
    result = read_result(out)
    assert result["machine"] and result["restart"] == bool(restart)

    # The numbers: parts of the candidates, and what carries the mass, which is what rank keeps of that number.
    scene, dense = load_scene(scene_folder), load_ply(dense_file)
    stats = collect_importance(dense, scene.train_views)
    importance = intersection_preserving(indoor(stats), stats.dominant_count)
    n_candidates = np.count_nonzero(importance)
    n_of_mass = len(select_mass(importance, simplify.MASS))
    assert result["dense"]["n_gaussians"] == len(dense.means) > n_candidates == result["dense"]["n_candidates"]
    assert result["counts"] == {
        "20 %": round(0.2 * n_candidates),
        "50 %": round(0.5 * n_candidates),
        "mass 0.99": n_of_mass,
    }
    assert np.array_equal(select_mass(importance, simplify.MASS), most_important(importance, n_of_mass))

    runs = {(run["kept"], run["choice"], run["seed"]): run for run in result["runs"]}
    assert len(runs) == len(result["runs"]) == 3 * 4 * 2
    for (kept, _, _), row in runs.items():
        assert row["n_gaussians"] == result["counts"][kept] and row["chamfer_dense"] > 0
        assert row["psnr"] != row["psnr_tuned"]
    for kept in result["counts"]:
        assert runs[kept, "rank, mass", 0]["psnr"] == runs[kept, "rank, mass", 1]["psnr"]
        assert runs[kept, "sampling", 0]["psnr"] != runs[kept, "sampling", 1]["psnr"]

    changes = collect_removal_costs(dense, scene.train_views, RenderSettings(scene.background)).changes * (
        importance > 0
    )
    kept = dense._make(field[most_important(changes, n_of_mass)] for field in dense)
    psnr = evaluate(kept, scene.test_views, RenderSettings(scene.background)).psnr
    assert runs["mass 0.99", "least change", 0]["psnr"] == psnr != runs["mass 0.99", "rank, mass", 0]["psnr"]

    # One of the measures by another way.
    kept = dense._make(field[most_important(importance, n_of_mass)] for field in dense)
    row = runs["mass 0.99", "rank, mass", 0]
    assert row["psnr"] == evaluate(kept, scene.test_views, RenderSettings(scene.background)).psnr
    nearest = np.linalg.norm(dense.means[:, None].astype(float) - kept.means, axis=2).min(axis=1)
    assert abs(row["chamfer_dense"] - nearest.mean()) < CLOSED_FORM  # the other way it is 0: they were kept

    # The table says the means and deviations.
    printed = capsys.readouterr().out.splitlines()
    lines = [[cell.strip() for cell in line.strip("|").split("|")] for line in printed if line.startswith("|")]
    assert len(lines) == 2 + 12
    for label, n, choice, *cells in lines[2:]:
        values = [runs[label, choice, seed]["psnr_tuned"] for seed in (0, 1)]
        mean, deviation = map(float, cells[1].split(" ± "))
        assert int(n) == result["counts"][label]
        assert abs(mean - np.mean(values)) < 100 * PRINTED_DIGITS
        assert abs(deviation - abs(values[0] - values[1]) / np.sqrt(2)) < 100 * PRINTED_DIGITS


def test_dense_population_is_trained(scene_folder, tmp_path):
    out = tmp_path / "out"
    arguments = [
        "simplify",
        str(scene_folder),
        "--out",
        str(out),
        "--recipe",
        "3dgs-accel",
        "--iterations",
        "3",
    ]
    assert measure_claim([*arguments, "--fractions", "0.5", "--fine-tune", "1", "--seeds", "0"]) == 0
    result = json.loads((out / RESULT).read_text())
    assert (result["recipe"], result["iterations"], result["ply"]) == ("3dgs-accel", 3, None)
    dense = train(load_scene(scene_folder), get_recipe("3dgs-accel", 3), seed=0).gaussians
    assert result["dense"]["n_gaussians"] == len(dense.means)


def test_chamfer_by_hand():
    points = np.array([[0.0, 0, 0], [1, 0, 0]])
    cloud = cKDTree([[0.0, 0, 0], [0, 3, 0], [1, 0, 1]])
    # there: 0 and 1; back: 0, 3 and 1.
    assert simplify.chamfer(points, cloud) == 1 / 2 + 4 / 3


def test_true_surface_is_on_the_floor_and_the_walls(monkeypatch):
    small = lambda name, **settings: make_scene(name, n_views=3, width=24, height=16, **settings)  # noqa: E731
    monkeypatch.setattr(simplify, "make_scene", small)
    points = simplify.true_surface("room")["surface"]
    assert points.shape == (3 * 24 * 16, 3) and points[:, 2].min() > -1e-6
    assert np.mean(np.abs(points[:, 2]) < 1e-6) > 0.02  # the floor is at z = 0


def test_folder_has_no_true_surface(scene_folder, monkeypatch):
    assert simplify.true_surface(str(scene_folder)) == {}
    monkeypatch.chdir(scene_folder.parent)  # where a folder is called as a synthetic scene is
    assert simplify.true_surface("room") == {}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--fractions", "0.1,2"], "'2' is not a number above 0 and at most 1"),
        (["--fractions", "a"], "'a' is not a number above 0 and at most 1"),
        (["--ply", "no.ply"], "no.ply"),
    ],
)
def test_bad_input(scene_folder, tmp_path, capsys, arguments, message):
    command = ["simplify", str(scene_folder), "--out", str(tmp_path / "out"), *arguments]
    try:
        assert measure_claim(command) == 2
    except SystemExit as stop:
        assert stop.code == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
