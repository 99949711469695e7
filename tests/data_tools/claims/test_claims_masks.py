"""``claims masks``: through the command line, and the stray light by hand."""

import json

import numpy as np
import pytest

from data_tools.claims import masks
from data_tools.claims.__main__ import main as measure_claim
from data_tools.claims.kit.claim import RESULT
from minisplat_ref.io import write_image
from minisplat_ref.rendering import RenderSettings, as_model, render
from minisplat_ref.training.recipe_settings import configure
from minisplat_ref.types import view_from
from run_commands import write_room
from scenes import make_camera, make_gaussians

SIZE = {"n_views": 9, "width": 48, "height": 36, "n_points": 150, "test_every": 8}


def test_stray_light_is_the_mean_opacity_outside(rng):
    gaussians, camera = make_gaussians(rng, 12, sh_degree=0), make_camera(33, 29)
    mask = rng.uniform(size=(29, 33)) < 0.4
    view = view_from(camera)._replace(image=np.zeros((29, 33, 3), np.uint8), mask=mask)
    alpha = render(gaussians, camera)[0].alpha
    found = masks.stray_light(as_model(gaussians), view, RenderSettings())
    assert found == pytest.approx(alpha[~mask].sum() / np.count_nonzero(~mask)) and 0 < found < 1


def test_both_arms_through_the_command_line(tmp_path, monkeypatch, capsys):
    """The masks are the left halves; without the rule there is light in the right ones."""
    scene, out = write_room(tmp_path / "room", **SIZE), tmp_path / "out"
    assert measure_claim(["masks", str(scene), "--seeds", "0", "--out", str(out)]) == 2
    assert "held-out photographs without masks" in capsys.readouterr().err and not out.exists()
    (scene / "masks").mkdir()
    for photograph in sorted((scene / "images").iterdir()):
        mask = np.zeros((36, 48, 3), np.uint8)
        mask[:, :24] = 255
        write_image(scene / "masks" / f"{photograph.name}.png", mask)
    real = masks.get_recipe
    monkeypatch.setattr(masks, "get_recipe", lambda name: configure(real(name)._replace(iterations=700), start=100))
    assert measure_claim(["masks", str(scene), "--seeds", "0", "--out", str(out)]) == 0
    removed, kept = json.loads((out / RESULT).read_text())["records"]
    assert (removed["arm"], kept["arm"]) == ("removed", "kept")
    assert removed["stray"] < kept["stray"] and removed["n_gaussians"] < kept["n_gaussians"]
    assert "| removed " in capsys.readouterr().out
