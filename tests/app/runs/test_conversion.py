"""``convert`` and whatever else reads compact files: the choice of a level, and the commands."""

import json
from functools import partial

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from compact import population, refused_line, short_run
from minisplat_ref import load_ply, save_ply
from minisplat_ref.app.cli import main
from minisplat_ref.app.runs import conversion
from minisplat_ref.errors import InputError
from minisplat_ref.extensions import extension as extension_module
from minisplat_ref.extensions.compression import levels, msz
from minisplat_ref.extensions.extension import Extension, find_format, load_extension
from minisplat_ref.io.formats import Format, spz
from minisplat_ref.io.label import Label
from minisplat_ref.io.packing.morton import morton_order
from minisplat_ref.training.calibration import EXPOSURES

LEVELS = range(levels.N_LEVELS)


# The choice of a level


def test_finest_that_fits_and_coarsest_that_is_good_enough():
    gaussians = population(300)
    sizes = [len(msz.encode(gaussians, level)) for level in LEVELS]
    choice = conversion.finest_within(gaussians, msz.MSZ, sizes[4])
    assert choice.level == 4 and len(choice.content) == sizes[4]
    assert conversion.finest_within(gaussians, msz.MSZ, sizes[4] - 1).level == 5
    with pytest.raises(InputError, match=r"no level of \.msz fits 10 bytes, the coarsest takes"):
        conversion.finest_within(gaussians, msz.MSZ, 10)

    def measure_psnr(given):
        """Falls with the error of the colours, which is smaller at every finer level."""
        return 30.0 - 100 * np.abs(np.sort(given.sh_dc, axis=0) - np.sort(gaussians.sh_dc, axis=0)).max()

    drops = [30 - measure_psnr(msz.decode(msz.encode(gaussians, level), "")) for level in LEVELS]
    for allowed in (0.2, 1.0, 4.0):
        choice = conversion.coarsest_within(gaussians, msz.MSZ, allowed, measure_psnr)
        assert choice.level == max(level for level in LEVELS if drops[level] <= allowed)
        assert choice.drop == drops[choice.level]
    assert len({conversion.coarsest_within(gaussians, msz.MSZ, a, measure_psnr).level for a in (0.2, 1.0, 4.0)}) == 3
    with pytest.raises(InputError, match=r"every level of \.spz loses more than 0 dB"):
        conversion.coarsest_within(gaussians, spz.SPZ, 0.0, measure_psnr)


def test_a_drop_that_is_rounding_is_none():
    """Another order of equal depths changes an image in its last bits: level 0 loses nothing all the same."""
    gaussians = population(20)

    def measure_psnr(given):
        if given is gaussians:
            return 30.0
        is_exact = np.array_equal(np.sort(given.sh_dc, axis=0), np.sort(gaussians.sh_dc, axis=0))
        return 30.0 - 2e-7 if is_exact else 29.9

    assert conversion.coarsest_within(gaussians, msz.MSZ, 0.0, measure_psnr).level == 0


@pytest.mark.parametrize(("max_drop", "level"), [(0.05, 2), (0.0499, 1), (0.01, 1), (0.00998, 0), (0.0, 0)])
def test_no_more_is_lost_than_was_allowed(max_drop, level):
    """Three levels lose 0, 0.01 and 0.05 dB."""
    losses = (0.0, 0.01, 0.05)
    decode = {str(k).encode(): object() for k in range(3)}
    measure_psnr = {id(found): 30.0 - loss for found, loss in zip(decode.values(), losses, strict=True)}
    whole = population(1)
    format_ = Format(
        ".x", "", ("",) * 3, 0, lambda _, k: str(k).encode(), lambda content, _: decode[content], lambda *_: []
    )
    choice = conversion.coarsest_within(whole, format_, max_drop, lambda g: measure_psnr.get(id(g), 30.0))
    assert choice.level == level and choice.drop == pytest.approx(losses[level])


# Formats are found by their suffixes


def test_formats_are_found(monkeypatch):
    assert find_format("a/b.MSZ") is msz.MSZ and find_format("b.spz") is spz.SPZ
    assert find_format("b.ply") is None and find_format("b.xyz") is None
    ours = load_extension("compression")
    monkeypatch.setattr(extension_module, "load_extensions", lambda: [ours, Extension("other", formats=(msz.MSZ,))])
    with pytest.raises(InputError, match=r"\.msz is a format of the extensions compression and other"):
        find_format("b.msz")


def test_a_ply_loads_no_extension(monkeypatch):
    monkeypatch.setattr(extension_module, "load_extensions", lambda: pytest.fail("loaded"))
    assert find_format("b.ply") is None


# The command line


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return short_run(tmp_path_factory.mktemp("conversion"))


@pytest.fixture
def one_line(capfd, tmp_path):
    return partial(refused_line, capfd, tmp_path)


def convert(*arguments):
    assert main(["convert", *map(str, arguments)]) == 0


def test_there_and_back_on_the_command_line(run, tmp_path, capsys):
    original = load_ply(run / "point_cloud.ply")
    convert(run, tmp_path / "a.msz", "--level", "0")
    convert(tmp_path / "a.msz", tmp_path / "a.ply")
    back, order = load_ply(tmp_path / "a.ply"), morton_order(original.means)
    for field, decoded in zip(original, back, strict=True):
        assert_array_equal(field[order], decoded)
    convert(run / "checkpoint.npz", tmp_path / "b.msz", "--level", "0")
    assert (tmp_path / "a.msz").read_bytes() == (tmp_path / "b.msz").read_bytes()
    capsys.readouterr()
    convert(tmp_path / "a.ply", tmp_path / "c.spz")
    out = capsys.readouterr().out
    assert "60 Gaussians of a.ply in" in out and "SPZ version: 3" in out
    convert(tmp_path / "c.spz", tmp_path / "d.msz")
    out = capsys.readouterr().out
    assert "level: 5 of 12" in out and "scales: within 0.78 %" in out and "world units along each axis" in out
    assert f"{(tmp_path / 'd.msz').stat().st_size:,} bytes" in out


def test_sizes_and_drops_on_the_command_line(run, tmp_path, one_line, capfd):
    sizes = [len(msz.encode(load_ply(run / "point_cloud.ply"), level)) for level in LEVELS]
    convert(run, tmp_path / "a.msz", "--max-bytes", sizes[7])
    assert (tmp_path / "a.msz").stat().st_size == sizes[7]
    assert "no level of .msz fits 99 bytes" in one_line("convert", run, tmp_path / "b.msz", "--max-bytes", 99)
    capfd.readouterr()
    convert(run, tmp_path / "c.msz", "--max-drop", "0.05")
    out = capfd.readouterr().out
    assert "dB lost on 6 of 6 training views of nook" in out
    assert (tmp_path / "c.msz").stat().st_size < sizes[1]
    ply = run / "point_cloud.ply"
    convert(ply, tmp_path / "d.msz", "--max-drop", "0.05", "--scene", run.parent / "nook")
    needs = one_line("convert", ply, tmp_path / "e.msz", "--max-drop", "0.05")
    assert "is no run: give --scene PATH" in needs


def test_a_drop_is_measured_with_the_exposures_of_the_run(run):
    source = conversion.open_source(run)
    exposures = np.tile(np.eye(3, 4, dtype=np.float32), (6, 1, 1))
    exposures[:, :, 3] = 0.5
    exposed = source._replace(model=source.model._replace(shared={EXPOSURES: exposures}))

    def measure_psnr(given, scene=None):
        return conversion.make_judge(given, run, scene, None).measure_psnr(given.model.gaussians)

    assert measure_psnr(exposed) < measure_psnr(source) - 3
    assert measure_psnr(exposed, run.parent / "nook") == measure_psnr(
        source
    )  # other photographs: they have no exposures


def test_what_convert_refuses(run, tmp_path, one_line):
    assert "has levels 0 to 12" in one_line("convert", run, tmp_path / "a.msz", "--level", "13")
    assert "a PLY has one precision" in one_line("convert", run, tmp_path / "a.ply", "--max-bytes", "9")
    assert ".ply or .spz or .splat" in one_line("convert", run, tmp_path / "a.xyz")
    assert "are for --max-drop" in one_line("convert", run, tmp_path / "a.msz", "--scene", run)
    assert "has its extension recorded" in one_line("convert", run, tmp_path / "a.msz", "--extension", "velocity")
    (tmp_path / "bad.msz").write_bytes(b"MSZ\n")
    assert "bad.msz: not an MSZ file" in one_line("convert", tmp_path / "bad.msz", tmp_path / "a.ply")
    assert "bad.msz" in one_line("info", tmp_path / "bad.msz")


def test_further_fields_need_a_ply(run, tmp_path, one_line, capfd):
    from minisplat_ref.extensions.velocity.model import at_rest

    moving = at_rest(load_ply(run / "point_cloud.ply"), np.random.default_rng(0))
    save_ply(tmp_path / "moving.ply", moving)
    line = one_line("convert", tmp_path / "moving.ply", tmp_path / "a.msz", "--extension", "velocity")
    assert "velocities, which .msz does not hold: convert it to a PLY" in line
    convert(tmp_path / "moving.ply", tmp_path / "b.ply", "--extension", "velocity")
    save_ply(tmp_path / "labelled.ply", moving, Label("velocity"))
    assert (tmp_path / "b.ply").read_bytes() == (tmp_path / "labelled.ply").read_bytes()
    convert(tmp_path / "moving.ply", tmp_path / "c.msz")
    assert "not drawn are velocities_0, velocities_1, velocities_2" in capfd.readouterr().err
    line = one_line("render", tmp_path / "c.msz", "--extension", "velocity", "--out", tmp_path / "views")
    assert ".msz does not hold velocities of extension velocity" in line


def test_compact_files_are_drawn_and_measured_and_described(run, tmp_path, capsys):
    """At level 0 every image and every measure is that of the run, but for the order, which nothing depends on."""
    convert(run, tmp_path / "a.msz", "--level", "0")
    cameras = ["--cameras", str(run / "cameras.json")]
    for source, out in ((tmp_path / "a.msz", "one"), (run / "point_cloud.ply", "other")):
        assert main(["render", str(source), *cameras, "--out", str(tmp_path / out)]) == 0
    images = sorted((tmp_path / "one").glob("*.png"))
    assert len(images) == 8
    for path in images:
        assert path.read_bytes() == (tmp_path / "other" / path.name).read_bytes()
    before = json.loads((run / "metrics.json").read_text())
    assert main(["eval", str(run), "--model", str(tmp_path / "a.msz"), "--out", str(tmp_path / "eval")]) == 0
    metrics = json.loads((tmp_path / "eval" / "metrics.json").read_text())
    assert metrics["psnr"] == before["psnr"] and metrics["model"] == str((tmp_path / "a.msz").resolve())
    assert main(["eval", str(run), "--model", str(tmp_path / "a.msz")]) == 0
    assert (run / "eval-a.msz" / "metrics.json").exists() and json.loads((run / "metrics.json").read_text()) == before
    capsys.readouterr()
    assert main(["info", str(tmp_path / "a.msz")]) == 0
    out = capsys.readouterr().out
    assert "0: every float32" in out and "Gaussians" in out and "60" in out
    assert main(["extensions", "compression"]) == 0
    assert "formats   .msz (lattices of 13 precisions, zstandard)" in capsys.readouterr().out
