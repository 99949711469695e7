"""Axes of files: sixteen of them by geometry, and those that an SPZ names, is given, or leaves open."""

import gzip
import struct

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from compact import population
from minisplat_ref.app.cli import main
from minisplat_ref.errors import InputError
from minisplat_ref.io import load_ply, save_ply
from minisplat_ref.io.formats import spz
from minisplat_ref.io.formats.axes import AXES, check_axes, ours_from, turn
from minisplat_ref.reference.covariance import covariances
from minisplat_ref.reference.spherical_harmonics import sh_basis
from minisplat_ref.types import Gaussians
from tolerances import CLOSED_FORM

RECORD = 0xADBE0003


def in_float64(gaussians):
    return Gaussians(*(field.astype(np.float64) for field in gaussians))


def check_alike(theirs, ours):
    """Assert that two are the same but for the steps of an SPZ, which lie elsewhere where a sign has changed."""
    assert_allclose(theirs.means, ours.means, atol=2.0**-11)
    shapes = [covariances(g.quats.astype(float), np.exp(g.log_scales.astype(float))) for g in (theirs, ours)]
    sizes = np.exp(2 * ours.log_scales.max(axis=1))[:, None, None]
    assert_allclose(shapes[0] / sizes, shapes[1] / sizes, atol=0.25)
    assert_allclose(theirs.sh_dc, ours.sh_dc)
    assert_allclose(theirs.sh_rest, ours.sh_rest, atol=0.2)
    assert_allclose(theirs.opacity_logits, ours.opacity_logits)


def test_axes_have_the_numbers_of_niantics_library():
    numbers = {"LDB": 1, "RUB": 4, "RDF": 6, "LUF": 7, "RUF": 8, "LFD": 9, "RFU": 12, "LBD": 13, "RBU": 16}
    assert len(set(AXES)) == 16 and {name: AXES.index(name) + 1 for name in numbers} == numbers


def test_axes_by_hand():
    """What is 2 to the right, 3 up and 5 forward is (2, -3, 5) in ours."""
    places = {"RUB": (2, 3, -5), "RDF": (2, -3, 5), "LUF": (-2, 3, 5), "RFU": (2, 5, 3), "LBD": (-2, -5, -3)}
    for name, place in places.items():
        assert_array_equal(ours_from(name) @ place, [2, -3, 5])


@pytest.mark.parametrize("name", AXES)
def test_turned_gaussians_look_the_same_from_there(name, rng):
    """Centres, covariances and colours, by their definitions; and back again, exactly."""
    gaussians, A = in_float64(population(20, 3)), ours_from(name)
    turned = turn(gaussians, A)
    assert_allclose(turned.means, gaussians.means @ A.T, rtol=0, atol=0)
    ours, theirs = (covariances(g.quats, np.exp(g.log_scales)) for g in (gaussians, turned))
    assert_allclose(theirs, A @ ours @ A.T, atol=CLOSED_FORM)
    directions = rng.normal(size=(7, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    seen = np.einsum("dk,nkc->ndc", sh_basis(directions, 3)[:, 1:], gaussians.sh_rest)
    seen_there = np.einsum("dk,nkc->ndc", sh_basis(directions @ A.T, 3)[:, 1:], turned.sh_rest)
    assert_allclose(seen_there, seen, atol=1e-10)  # entries of the matrix are rounded to 12 digits
    back = turn(turned, A.T)
    for value, other in zip(back, gaussians, strict=True):
        assert_allclose(value, other, atol=1e-10)


def test_ours_are_not_copied():
    gaussians = population(3, 1)
    assert turn(gaussians, ours_from("RDF")) is gaussians


@pytest.mark.parametrize("name", [name for name in AXES if name != "RUB"])
def test_version_4_says_which_axes_it_has(name):
    gaussians = population(50, 2)
    usual, content = spz.encode(gaussians, 1), spz.encode(gaussians, 1, name)
    assert content[14] == 2 and usual[14] == 0  # flags
    assert content[32:44] == struct.pack("<III", RECORD, 4, AXES.index(name) + 1)
    assert struct.unpack("<I", content[16:20]) == (44,)
    check_alike(spz.decode(content, "file"), spz.decode(usual, "file"))


def test_a_file_that_says_nothing_has_the_axes_of_the_specification_or_those_that_are_given():
    gaussians = population(9, 1)
    for level in (0, 2):
        plain, theirs = spz.encode(gaussians, level), spz.encode(gaussians, level, "RDF")
        assert_allclose(spz.decode(plain, "a").means, gaussians.means, atol=2.0**-12)
        assert_allclose(spz.decode(theirs, "a").means, gaussians.means * [1, -1, -1], atol=2.0**-12)
        check_alike(spz.decode(theirs, "a", "RDF"), spz.decode(plain, "a"))
    recorded = spz.encode(gaussians, 1, "RDF")
    assert_allclose(spz.decode(recorded, "a", "RUB").means, gaussians.means * [1, -1, -1], atol=2.0**-12)


def with_records(records, flag=2):
    raw = bytearray(gzip.decompress(spz.encode(population(5, 1), 0, "RDF")))
    raw[14] = flag
    return gzip.compress(bytes(raw) + records)


def test_records_of_version_3_are_behind_its_gaussians():
    means = population(5, 1).means
    other, axes = struct.pack("<IIf", 0xADBE0002, 4, 0.5), struct.pack("<III", RECORD, 4, 6)
    for records in (axes, other + axes, axes + other):
        assert_allclose(spz.decode(with_records(records), "a").means, means, atol=2.0**-12)
    for records in (b"", other, struct.pack("<III", RECORD, 4, 0), axes[:-1], struct.pack("<IIII", RECORD, 8, 6, 6)):
        assert_allclose(spz.decode(with_records(records), "a").means, means * [1, -1, -1], atol=2.0**-12)
    assert_allclose(spz.decode(with_records(axes, flag=0), "a").means, means * [1, -1, -1], atol=2.0**-12)
    with pytest.raises(InputError, match="record of axes has the number 17, of 16"):
        spz.decode(with_records(struct.pack("<III", RECORD, 4, 17)), "a")


def test_axes_that_do_not_exist():
    assert check_axes("rdf") == "RDF"
    with pytest.raises(InputError, match="axes 'RRR' do not exist: choose from LDB, "):
        check_axes("RRR")


def test_commands_say_which_axes_were_read_and_written(tmp_path, capsys):
    """A file of a program that keeps the axes of the PLY comes back as it was with --axes RDF, and turned without."""
    save_ply(tmp_path / "a.ply", population(30, 1))
    means = population(30, 1).means

    def convert(*arguments):
        assert main(["convert", *map(str, arguments)]) == 0
        return capsys.readouterr()

    told = convert(tmp_path / "a.ply", tmp_path / "theirs.spz", "--axes", "rdf")
    assert "axes: RDF (x right, y down, z forward), as --axes says" in told.out and "is read with" not in told.err
    told = convert(tmp_path / "theirs.spz", tmp_path / "b.ply", "--axes", "RDF")
    assert "theirs.spz is read with the axes RDF (x right, y down, z forward), as --axes says" in told.err
    assert_allclose(load_ply(tmp_path / "b.ply").means, means, atol=2.0**-12)
    told = convert(tmp_path / "theirs.spz", tmp_path / "c.ply")
    assert "read with the axes RUB (x right, y up, z backward), as the specification says; --axes RDF if" in told.err
    assert_allclose(load_ply(tmp_path / "c.ply").means, means * [1, -1, -1], atol=2.0**-12)
    convert(tmp_path / "a.ply", tmp_path / "said.spz", "--axes", "RFU", "--level", "1")
    assert main(["info", str(tmp_path / "said.spz")]) == 0
    assert "RFU (x right, y forward, z up), as its header says" in capsys.readouterr().out
    convert(tmp_path / "theirs.spz", tmp_path / "d.spz", "--axes", "RDF")
    assert_allclose(spz.decode((tmp_path / "d.spz").read_bytes(), "d").means, means, atol=2.0**-11)
    frame = ["--frames", "1", "--size", "32x24"]
    assert main(["render", str(tmp_path / "theirs.spz"), *frame, "--axes", "RDF", "--out", str(tmp_path / "v")]) == 0
    assert "as --axes says" in capsys.readouterr().err


@pytest.mark.parametrize("command", ["info", "render", "convert", "view"])
def test_axes_are_for_spz(command, tmp_path, capsys):
    save_ply(tmp_path / "a.ply", population(3, 0))
    rest = [str(tmp_path / "b.ply")] if command == "convert" else []
    assert main([command, str(tmp_path / "a.ply"), *rest, "--axes", "RDF"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "--axes is for" in line and ".spz" in line
    (tmp_path / "a.spz").write_bytes(spz.encode(population(3, 0), 0))
    rest = [str(tmp_path / "b.ply")] if command == "convert" else []
    assert main([command, str(tmp_path / "a.spz"), *rest, "--axes", "XYZ"]) == 2
    assert "axes 'XYZ' do not exist" in capsys.readouterr().err
    assert not (tmp_path / "b.ply").exists()
