"""Runs at several sizes: the full size by the run's own metrics, half of it by hand, and what is refused."""

import json

import numpy as np
import pytest

from data_tools.published_scales import main, measure
from minisplat_ref.app.cli import main as minisplat_ref
from minisplat_ref.app.runs.opened_run import open_run
from minisplat_ref.errors import InputError
from minisplat_ref.io import load_scene
from minisplat_ref.types import view_from


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A run of two iterations on 24 x 18 pixels."""
    out = tmp_path_factory.mktemp("scales")
    synthetic = ["synthetic", "room", "--views", "6", "--width", "24", "--height", "18", "--out", str(out / "scene")]
    assert minisplat_ref(synthetic) == 0
    train = ["train", str(out / "scene"), "--recipe", "3dgs-accel", "--iterations", "2", "--out", str(out / "run")]
    assert minisplat_ref(train) == 0
    return out / "run"


def test_sizes_by_hand(folder, capsys):
    run = open_run(folder)
    found = measure(run)
    assert found[0] == pytest.approx(json.loads((folder / "metrics.json").read_text())["psnr"], abs=1e-4)
    halves = []
    for view in run.scene.test_views:
        c = view.camera
        half = {name: getattr(c, name) / 2 for name in ("fx", "fy", "cx", "cy")}
        camera = c._replace(**half, width=c.width // 2, height=c.height // 2)
        image = run.render_settings.render_view(run.model, view_from(camera))[0].image.clip(0, 1).astype(float)
        truth = view.load().image / 255
        truth = (truth[::2, ::2] + truth[1::2, ::2] + truth[::2, 1::2] + truth[1::2, 1::2]) / 4
        halves.append(-10 * np.log10(np.mean((image - truth) ** 2)))
    assert found[1] == pytest.approx(np.mean(halves), abs=1e-6)
    assert abs(found[1] - found[0]) > 1e-3
    assert main([str(folder), str(folder)]) == 0
    rows = [line for line in capsys.readouterr().out.splitlines() if line.startswith("| run ")]
    cells = [f"{x:.2f}" for x in [*found, sum(found) / 4]]
    assert len(rows) == 3 and [cell.strip() for cell in rows[1].split("|")[3:-1]] == cells


def test_what_cannot_be_measured_is_refused(folder, tmp_path, capsys):
    run = open_run(folder)
    with pytest.raises(InputError, match="no test views: train with --test-every"):
        measure(run._replace(scene=run.scene._replace(test_views=())))
    tiny = load_scene(run.settings.scene, downscale=3)
    with pytest.raises(InputError, match="has no pixel left at 1/8"):
        measure(run._replace(scene=run.scene._replace(test_views=tiny.test_views)))
    assert main([str(tmp_path)]) == 2
    assert capsys.readouterr().err.startswith("published_scales: error: ")
