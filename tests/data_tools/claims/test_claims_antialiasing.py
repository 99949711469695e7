"""Zooms of a small scene with every recipe."""

from data_tools.claims.__main__ import main as measure_claim
from measured_claims import NOOK, measured
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.datasets.synthetic.files import write_scene


def test_the_claim_measures_all_recipes(tmp_path, capsys):
    out, larger = tmp_path / "measured", {**NOOK, "width": 64, "height": 48}
    write_scene(make_scene("room", supersampling=1, **larger), tmp_path / "scene", larger)
    options = [str(tmp_path / "scene"), "--downscale", "2", "--iterations", "30", "--seeds", "1", "--out", str(out)]
    result = measured(["antialiasing/zoom", *options])
    assert result["zooms"] == [0.25, 0.5, 1.0, 2.0]
    psnr = {name: seeds[0] for name, seeds in result["psnr"].items()}
    assert [name for name in psnr if "," not in name] == [
        "3dgs-accel",
        "3D filter alone",
        "2D filter alone",
        "antialiasing",
        "analytic",
    ]
    assert psnr["antialiasing"][0] > psnr["3dgs-accel"][0]  # from far
    assert len({tuple(values) for values in psnr.values()}) == len(psnr) == 8
    assert (out / "figure.png").stat().st_size > 10_000 and "| analytic " in capsys.readouterr().out
    assert measure_claim(["antialiasing/zoom", "nowhere", "--out", str(tmp_path / "none")]) == 2
    assert "neither a folder nor one of" in capsys.readouterr().err and not (tmp_path / "none").exists()
