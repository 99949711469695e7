"""Losses of surfels: they act, the truth is measured as it is, and a small run."""

import json

import numpy as np
import pytest

from data_tools.claims import surfels as claim
from data_tools.claims.__main__ import main as measure_claim
from data_tools.claims.surfels import ARMS, outcome
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.types import RenderOutput


def test_the_losses_act_in_the_claim():
    """Each arm that weighs a loss differently ends elsewhere."""
    made = make_scene("room", n_views=6, width=32, height=24, supersampling=1, n_points=150)
    found = [outcome(made, 40, arm, 0)["psnr"] for arm in ("surfels without", "normal_consistency", "both")]
    assert len(set(found)) == 3 and len(ARMS) == 5


def test_the_claim_measures_the_truth_as_it_is(monkeypatch):
    """A depth that is 2 % too large has an error of 2 %; the normals of the surface through it are the true ones."""
    made = make_scene("room", n_views=4, width=64, height=48, supersampling=1)
    depths = {view.name: depth for view, depth in zip(made.scene.test_views, made.test_depths, strict=True)}

    def render(settings, model, view, wants=frozenset()):
        depth = depths[view.name]
        alpha = np.where(depth > 0, 0.8, 0.0)
        image = np.concatenate([np.zeros((*depth.shape, 3)), (1.02 * alpha * depth)[..., None]], axis=2)
        return RenderOutput(image if wants else image[..., :3], alpha, None, None), None

    monkeypatch.setattr("minisplat_ref.rendering.RenderSettings.render_view", render)
    found = outcome(made, 1, "surfels without", 0)
    assert found["depth_error"] == pytest.approx(2.0, abs=1e-6) and found["normal_error"] < 1


def test_the_claim_of_losses_runs(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(claim, "make_scene", lambda name: make_scene(name, n_views=4, width=24, height=18))
    command = ["surfels/losses", "room", "--iterations", "2", "--seeds", "1", "--out", str(tmp_path / "s")]
    assert measure_claim(command) == 0
    said = capsys.readouterr().out
    assert all(said.count(f"| {arm} ") == 1 for arm in ARMS)
    records = json.loads((tmp_path / "s" / "result.json").read_text())["records"]
    assert [record["arm"] for record in records] == list(ARMS) and all(record["n_gaussians"] for record in records)
