"""Bytes against quality: formats that lose nothing, what SPZ rounds, and runs that are refused."""

import json
from functools import partial

import numpy as np
import pytest

from compact import refused_line, short_run
from data_tools.claims import compression as rate_distortion
from data_tools.claims.__main__ import main as measure_claim
from measured_claims import measured
from minisplat_ref import load_ply
from minisplat_ref.constants import GSPLAT_MAIN
from minisplat_ref.extensions.compression import levels, msz
from minisplat_ref.io import load_scene
from minisplat_ref.io.formats import spz
from minisplat_ref.rendering import SPLATTING, Request
from minisplat_ref.types import Model, view_from
from tolerances import PARITY_FLOAT32_IMAGE

LEVELS = range(levels.N_LEVELS)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return short_run(tmp_path_factory.mktemp("compression"))


@pytest.fixture
def one_line(capfd, tmp_path):
    return partial(refused_line, capfd, tmp_path)


def claim(run, out, *options):
    ply = str(run / "point_cloud.ply")
    name = "compression/rate-distortion"
    return measure_claim([name, str(run.parent / "nook"), "--ply", ply, "--out", out, *options])


def rms(image):
    return np.sqrt(np.mean(image**2))


def test_claim_of_a_ply(run, tmp_path, capsys):
    """Formats that keep every float lose nothing, and the finest lattice loses less than the coarsest."""
    copier = tmp_path / "copier"
    copier.write_text('#!/bin/sh\n[ "$1 $2" = "-g cpu" ] && cp "$3" "$4"\n')
    copier.chmod(0o755)
    assert claim(run, str(tmp_path / "out"), "--splat-transform", str(copier)) == 0
    result = json.loads((tmp_path / "out" / "result.json").read_text())
    drops = {point["name"]: point["drop"] for point in result["runs"][0]}
    sizes = {point["name"]: point["n_bytes"] for point in result["runs"][0]}
    assert list(drops) == [
        "ply",
        "sog",
        "spz version 3",
        "spz version 4",
        "spz version 2",
        *(f"msz {level}" for level in LEVELS),
    ]
    assert drops["ply"] == drops["sog"] == drops["msz 0"] == 0.0
    assert abs(drops["msz 1"]) < 0.2 * abs(drops["msz 12"])
    (kept,) = result["spz_apart_from_harmonics"]
    assert kept != drops["spz version 3"] and abs(kept) < 0.1
    assert sizes["ply"] == sizes["sog"] == (run / "point_cloud.ply").stat().st_size
    assert sizes["msz 5"] == len(msz.encode(load_ply(run / "point_cloud.ply"), 5))
    assert (tmp_path / "out" / "figure.png").stat().st_size > 10_000
    assert "bytes per Gaussian" in capsys.readouterr().out


def test_what_spz_loses_apart_from_its_harmonics(run):
    """With harmonics in SPZ's own steps the two losses are the same, and with others they are not."""
    scene, gaussians = load_scene(run.parent / "nook"), load_ply(run / "point_cloud.ply")
    rounded = gaussians._replace(sh_rest=spz.SPZ.decode(spz.SPZ.encode(gaussians, 0), "").sh_rest)
    rough = gaussians._replace(sh_rest=gaussians.sh_rest + np.float32(0.03))
    for model, is_same in ((rounded, True), (rough, False)):
        psnr = rate_distortion.mean_psnr(model, scene.test_views, scene.background)
        back = rate_distortion.round_trip(model, spz.SPZ, 0)[1]
        drop = psnr - rate_distortion.mean_psnr(back, scene.test_views, scene.background)
        kept = rate_distortion.drop_apart_from_harmonics(model, scene.test_views, scene.background, psnr)
        assert (kept == drop) is is_same


def test_a_smaller_scene_is_the_same_image_in_every_format(run):
    """At 1/512 of the size a step of 2^-12 would be an eighth of an original unit: SPZ gets more fractional bits."""
    views, gaussians = load_scene(run.parent / "nook").test_views, load_ply(run / "point_cloud.ply")
    images = []
    for factor in (1.0, 1 / 512):
        small, camera = rate_distortion.shrink(gaussians, factor), rate_distortion.shrink_camera(views[0], factor)
        conventions = GSPLAT_MAIN._replace(near_plane=factor * GSPLAT_MAIN.near_plane)
        files = [format_.decode(format_.encode(small, level), "") for format_, level in ((msz.MSZ, 5), (spz.SPZ, 0))]
        request = Request(conventions=conventions)
        images.append([SPLATTING.render(Model(g), view_from(camera), request)[0].image for g in (small, *files)])
    (large, large_msz, large_spz), (small, small_msz, small_spz) = images
    assert np.abs(small - large).max() < 20 * PARITY_FLOAT32_IMAGE
    assert rms(small_msz - small) < 2 * rms(large_msz - large)
    assert rms(small_spz - small) < 2 * rms(large_spz - large)


def test_claim_trains(run, tmp_path, capsys):
    nook = str(run.parent / "nook")
    options = ["--recipe", "3dgs-accel", "--iterations", "3", "--seeds", "2", "--out", str(tmp_path / "out")]
    result = measured(["compression/rate-distortion", nook, *options])
    assert len(result["runs"]) == len(result["psnr"]) == 2 and result["iterations"] == 3
    assert "nook" in capsys.readouterr().out


def test_claim_that_cannot_be(run, tmp_path, one_line, capfd):
    out = str(tmp_path / "out")
    program = ["--splat-transform", "not-there"]
    ply = str(run / "point_cloud.ply")
    name = "compression/rate-distortion"
    nook = str(run.parent / "nook")
    assert "not-there does not work" in one_line(name, nook, "--ply", ply, "--out", out, *program, main=measure_claim)
    assert "neither a folder" in one_line(name, "nowhere", "--out", out, main=measure_claim)
    with pytest.raises(SystemExit, match="2"):
        measure_claim([name, nook, "--out", out, "--seeds", "0"])
    assert "--seeds: '0' is not a whole number of at least 1" in capfd.readouterr().err
