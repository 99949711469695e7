"""Fans: profiles in closed form, and small runs of both claims."""

import numpy as np
import pytest

from data_tools.claims.fans.profile import fan_profile, mass, profile_error
from measured_claims import measured, scene_folder  # noqa: F401  (a fixture)
from minisplat_ref.extensions.fans.model import FanShape
from minisplat_ref.io.ply import save_ply
from scenes import as_dtype, make_gaussians
from tolerances import PROFILE_GRID

FLAT, SOLID = FanShape(8, 2.5, 0.2), FanShape(8, 2.3, 0.1, is_flat=False)


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    path = tmp_path_factory.mktemp("models") / "point_cloud.ply"
    save_ply(path, as_dtype(make_gaussians(np.random.default_rng(3), 40), np.float32))
    return path


def test_the_error_and_the_mass_of_profiles():
    """Closed form of the mass by a sum; the best fan of eight sides errs by 12 %."""
    axis = np.arange(-4, 4, 0.01)
    grid = np.stack(np.meshgrid(axis, axis), axis=-1)
    for shape in (FanShape(), FLAT, FanShape(3, 2.0, 0.5)):
        assert fan_profile(grid, shape).sum() * 1e-4 / (2 * np.pi) == pytest.approx(mass(shape), rel=PROFILE_GRID)
    assert [round(profile_error(s), 2) for s in (FanShape(reach=2.5), FanShape(reach=2.3, rim=0.2))] == [0.12, 0.26]


def test_the_claims(scene_folder, model, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("data_tools.claims.fans.measures.REACHES", (2.5,))
    monkeypatch.setattr("data_tools.claims.fans.measures.SIDES", (4, 8))
    monkeypatch.setattr("data_tools.claims.fans.measures.VIEWS_MAX", 1)
    monkeypatch.setattr("data_tools.claims.fans.shape_search.EVALUATIONS", 4)
    monkeypatch.setattr("data_tools.claims.fans.shape_search.FIRST_REACHES", (2.5,))
    monkeypatch.setattr("data_tools.claims.fans.profile.ANGLES", (0, 90))
    refit, profile = tmp_path / "refit", tmp_path / "profile"
    options = ["--ply", str(model), "--fine-tune", "3", "--out", str(refit)]
    (run,) = measured(["fans/refit", str(scene_folder), *options])["runs"]
    assert [row["form"] for row in run["rows"] if "triangles" in row][::3] == ["flat fans", "solid fans"]
    assert (refit / "figure.png").stat().st_size > 10_000 and "| flat fans, vertices" in capsys.readouterr().out
    assert sorted(path.name for path in refit.iterdir()) == ["figure.png", "result.json"]
    tilts = measured(["fans/profile", "--out", str(profile)])["tilts"]
    edge_on = {(tilt["kind"], tilt["is_flat"]): tilt["errors"][1] for tilt in tilts}
    assert edge_on["ball", True] > 0.99 > edge_on["ball", False]
    assert "| 8     | 2.50  | 0.00 | 12.3%     | 0.94 |" in capsys.readouterr().out
