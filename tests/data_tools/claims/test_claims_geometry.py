"""Depth under each loss, on a small scene."""

from measured_claims import measured
from minisplat_ref.datasets.synthetic import make_scene


def test_the_claim_measures_depths(tmp_path, capsys, monkeypatch):
    tiny = {"n_views": 8, "width": 48, "height": 36, "n_points": 200, "supersampling": 1, "test_every": 4}
    monkeypatch.setattr("data_tools.claims.geometry.make_scene", lambda name: make_scene(name, **tiny))
    out = tmp_path / "measured"
    options = ["--iterations", "120", "--seeds", "1", "--out", str(out)]
    records = {r["arm"]: r for r in measured(["geometry/depth", "room", *options])["records"]}
    assert records["sfm_depth"]["median_error"] < records["without"]["median_error"] < 0.5
    assert (out / "figure.png").stat().st_size > 10_000 and "| all three" in capsys.readouterr().out
