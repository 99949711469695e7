"""MP-GS: targets and floats by hand, and small runs of all claims."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from data_tools.claims.__main__ import main as measure_claim
from data_tools.claims.kit import psnr_of
from data_tools.claims.mixed import fit
from measured_claims import measured
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.datasets.synthetic.files import write_scene
from minisplat_ref.types import Gaussians

SCENE = {"n_views": 6, "width": 32, "height": 24, "n_points": 120, "test_every": 4}


def test_one_line_is_found_and_one_ellipse_is_not_enough():
    target = fit.one_line()
    line, ellipse = (fit.fit_primitives(target, 1, n_vertices=m, iterations=200, seed=0) for m in (2, 1))
    assert psnr_of(fit.render_primitives(line), target) > psnr_of(fit.render_primitives(ellipse), target) + 10


def test_the_letter_is_a_silhouette():
    """Bright on its strokes, black elsewhere, in between where a pixel is covered in part."""
    image = fit.letter_a()[..., 0]
    assert image[30, 24] == pytest.approx(0.8) and image[20, 24] == 0 and image[2, 2] == 0
    assert 0.05 < np.mean((image > 0) & (image < 0.79)) < 0.2


def test_the_ring_is_five_pixels_wide():
    assert_allclose(fit.ring()[..., 0].sum(), 0.8 * np.pi * (17.5**2 - 12.5**2), rtol=1e-3)


@pytest.mark.parametrize("n_vertices", [1, 2, 3])
def test_numbers_are_counted_as_they_are_used(n_vertices, rng):
    """Of the fields of a primitive, and of the vertices that it has besides the first."""
    of_one = fit.scatter(1, n_vertices, rng)
    six = sum(np.size(getattr(of_one, name)) for name in Gaussians._fields)
    assert fit.N_FLOATS[n_vertices] == six + 2 * (n_vertices - 1)


@pytest.mark.parametrize(("name", "n_images"), [("shapes", 3), ("letter", 2)])
def test_the_claims_of_images(name, n_images, tmp_path, monkeypatch, capsys):
    from data_tools.claims.mixed import shapes as claim

    monkeypatch.setitem(claim.NUMBERS, name, {1: (1,), 2: (1,), 3: (1,)})
    monkeypatch.setitem(claim.SHOWN, name, {1: 1, 2: 1, 3: 1})
    out = tmp_path / "measured"
    result = measured([f"mixed/{name}", "--iterations", "3", "--seeds", "2", "--out", str(out)])
    assert len(result["rows"]) == len(result["needed"]) == 3 * n_images
    assert (out / "figure.png").stat().st_size > 10_000 and "| triangles" in capsys.readouterr().out
    with pytest.raises(SystemExit, match="2"):
        measure_claim([f"mixed/{name}", "--seeds", "0", "--out", str(tmp_path / "none")])
    assert not (tmp_path / "none").exists()


def test_the_claim_of_scenes(tmp_path, capsys):
    write_scene(make_scene("room", supersampling=1, **SCENE), tmp_path / "nook", SCENE)
    options = ["--downscale", "1", "--iterations", "3", "--seeds", "1", "--out", str(tmp_path / "measured")]
    whole, equal, groups_alone, mixed = measured(["mixed/scene", str(tmp_path / "nook"), *options])["rows"]
    assert whole["n_floats"] > mixed["n_floats"] >= equal["n_floats"] > 0.95 * mixed["n_floats"]
    assert groups_alone["number"] == mixed["number"] == sum(mixed["kinds"]) and mixed["kinds"][1] > 0
    assert "mixed" in capsys.readouterr().out
    assert measure_claim(["mixed/scene", str(tmp_path / "gone"), *options[:-1], str(tmp_path / "none")]) == 2
    assert "gone" in capsys.readouterr().err and not (tmp_path / "none").exists()
