"""Files of many Gaussians are made in pieces: the same bytes, hardly more memory than the model, progress on stderr."""

import io
import re
import tracemalloc
import warnings

import numpy as np
import pytest

from compact import population
from minisplat_ref.app.cli import main
from minisplat_ref.app.viewer.page import write_page
from minisplat_ref.errors import InputError, InputWarning
from minisplat_ref.extensions.extension import all_formats, find_format
from minisplat_ref.interface import progress
from minisplat_ref.io import save_ply
from minisplat_ref.io.formats import glb, mapped, sog
from minisplat_ref.io.packing import container, deflating, pieces
from minisplat_ref.io.packing.morton import morton_order

N, ROWS = 1500, 256  # the last piece is not whole
WRITTEN = [format_ for _, format_ in all_formats() if format_.levels]
BLACK = np.zeros(3)
UP = np.array([0.0, -1.0, 0.0])


def content_of(format_, gaussians):
    """The file at the default level, without the warning that harmonics are left out."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", InputWarning)
        return format_.encode(gaussians, format_.default_level)


@pytest.mark.parametrize("format_", WRITTEN, ids=lambda f: f.suffix)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_pieces_make_the_same_file(format_, dtype, monkeypatch):
    gaussians = population(N, 3)
    gaussians = type(gaussians)(*(field.astype(dtype) for field in gaussians))
    whole = content_of(format_, gaussians)
    monkeypatch.setattr(pieces, "ROWS", ROWS)
    assert content_of(format_, gaussians) == whole


def test_pieces_make_the_same_page(monkeypatch):
    gaussians = population(N, 3)
    whole = b"".join(write_page("a", gaussians, [], BLACK, UP))
    monkeypatch.setattr(pieces, "ROWS", ROWS)
    monkeypatch.setattr("minisplat_ref.app.viewer.page.BLOCK", 3 * 100)
    assert b"".join(write_page("a", gaussians, [], BLACK, UP)) == whole


def test_axes_of_spz_in_pieces(monkeypatch):
    format_ = find_format("a.spz").with_axes("LUF")
    whole = format_.encode(population(N, 2), 1)
    monkeypatch.setattr(pieces, "ROWS", ROWS)
    assert format_.encode(population(N, 2), 1) == whole


def test_pieces_are_all_rows_once(monkeypatch):
    monkeypatch.setattr(pieces, "ROWS", 4)
    assert [(part.start, part.stop) for part in pieces.pieces(10)] == [(0, 4), (4, 8), (8, 10)]
    assert list(pieces.pieces(0)) == []


@pytest.mark.parametrize("format_", WRITTEN, ids=lambda f: f.suffix)
def test_memory_beyond_the_model(format_, monkeypatch):
    """Five million Gaussians take 1.18 GB, of 2.5: less than as much again may be added to them."""
    monkeypatch.setattr(pieces, "ROWS", 1 << 10)
    monkeypatch.setattr(sog, "PALETTE_MAX", 64)
    monkeypatch.setattr(sog, "SAMPLES_MAX", 1 << 10)
    monkeypatch.setattr(container, "AT_ONCE", 1 << 10)
    gaussians = population(40_000, 3)
    content_of(format_, population(100, 3))  # imports
    tracemalloc.start()
    if format_.write is None:
        content_of(format_, gaussians)
    else:
        with open("/dev/null", "wb") as file:
            format_.write(file, gaussians, 0)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < sum(field.nbytes for field in gaussians)


def test_a_file_as_large_as_the_model_is_written_a_piece_at_a_time(tmp_path, monkeypatch):
    monkeypatch.setattr(pieces, "ROWS", ROWS)
    gaussians = population(N, 3)
    save_ply(tmp_path / "a.ply", gaussians)
    assert main(["convert", str(tmp_path / "a.ply"), str(tmp_path / "a.glb")]) == 0
    assert (tmp_path / "a.glb").read_bytes() == glb.GLB.encode(gaussians, 0)
    assert glb.describe(mapped(tmp_path / "a.glb"), "a.glb") == glb.describe((tmp_path / "a.glb").read_bytes(), "a.glb")


def test_a_refused_glb_leaves_nothing(tmp_path, capsys):
    gaussians = population(N, 3)
    gaussians.log_scales[1234, 1] = 200.0
    save_ply(tmp_path / "a.ply", gaussians)
    (tmp_path / "a.glb").write_bytes(b"earlier")
    assert main(["convert", str(tmp_path / "a.ply"), str(tmp_path / "a.glb")]) == 2
    line = capsys.readouterr().err.strip().splitlines()[-1]
    assert "a.glb cannot be written" in line and "row 1234" in line and "--drop-outliers" in line
    assert (tmp_path / "a.glb").read_bytes() == b"earlier"
    assert {path.name for path in tmp_path.iterdir()} == {"a.ply", "a.glb"}


def test_the_row_that_does_not_fit_is_named_in_a_later_piece(monkeypatch):
    monkeypatch.setattr(pieces, "ROWS", ROWS)
    gaussians = population(N, 0)
    gaussians.log_scales[700, 2] = -200.0
    with pytest.raises(InputError, match="row 700"):
        glb.write(io.BytesIO(), gaussians, 0)


def test_sog_of_more_than_the_sample(monkeypatch):
    """All rows go down the tree of a sample: the error is hardly larger than with the tree of all."""
    monkeypatch.setattr(sog, "PALETTE_MAX", 64)
    rng = np.random.default_rng(3)
    kinds = rng.normal(size=(40, 9))
    rows = (kinds[rng.integers(0, 40, 6000)] + rng.normal(0, 0.05, (6000, 9))).astype(np.float32)
    order = rng.permutation(6000)
    of_all, labels_of_all = sog._palette(rows.reshape(6000, 3, 3), order)
    monkeypatch.setattr(sog, "SAMPLES_MAX", 1000)
    monkeypatch.setattr(pieces, "ROWS", 512)
    palette, labels = sog._palette(rows.reshape(6000, 3, 3), order)
    sorted_ = rows[order].astype(np.float64)
    for entry in np.unique(labels):
        np.testing.assert_allclose(palette[entry], sorted_[labels == entry].mean(axis=0), rtol=0, atol=1e-12)
    error, error_of_all = (
        np.mean((book[which] - sorted_) ** 2) for book, which in ((palette, labels), (of_all, labels_of_all))
    )
    assert error < 1.15 * error_of_all < 0.3 * rows.var(axis=0).mean()


def test_sog_whose_harmonics_are_all_alike(monkeypatch):
    """Equal rows all go to the upper half, and entries that none has are numbers all the same."""
    monkeypatch.setattr(sog, "PALETTE_MAX", 8)
    monkeypatch.setattr(sog, "SAMPLES_MAX", 20)
    palette, labels = sog._palette(np.full((100, 3, 3), 0.25, np.float32), np.arange(100))
    assert np.isfinite(palette).all() and set(labels.tolist()) == {7}
    assert (palette[7] == 0.25).all()


def test_progress_of_a_long_conversion(tmp_path, monkeypatch, capsys):
    """Each step says in a log how far it is; here each piece is late enough for a line."""
    monkeypatch.setattr(progress, "LOG_SECONDS", 0.0)
    monkeypatch.setattr(pieces, "ROWS", ROWS)
    monkeypatch.setattr(container, "AT_ONCE", 1000)
    monkeypatch.setattr(container, "BLOCK", 20_000)
    monkeypatch.setattr(sog, "PALETTE_MAX", 64)
    monkeypatch.setattr(sog, "SAMPLES_MAX", 1000)
    save_ply(tmp_path / "a.ply", population(N, 3))
    for suffix in (*(format_.suffix for format_ in WRITTEN), ".html"):
        capsys.readouterr()
        assert main(["convert", str(tmp_path / "a.ply"), str(tmp_path / f"a{suffix}")]) == 0
        lines = capsys.readouterr().err.splitlines()
        assert [line for line in lines if re.search(r": 1,024 of 1,500 Gaussians, \d\d:\d\d gone, about", line)], suffix


def test_large_files_are_packed_at_the_usual_level(monkeypatch):
    format_ = find_format("a.spz")
    finest = format_.encode(population(N, 3), 0)
    monkeypatch.setattr(deflating, "LARGE", 1000)
    usual = format_.encode(population(N, 3), 0)
    assert len(finest) < len(usual) < 1.05 * len(finest)
    for a, b in zip(format_.decode(finest, "a"), format_.decode(usual, "b"), strict=True):
        np.testing.assert_array_equal(a, b)


def test_long_streams_hold_what_short_ones_do(monkeypatch):
    format_ = find_format("a.msz")
    whole = format_.encode(population(N, 3), 5)
    monkeypatch.setattr(container, "AT_ONCE", 1000)
    monkeypatch.setattr(container, "BLOCK", 700)
    for a, b in zip(format_.decode(whole, "a"), format_.decode(format_.encode(population(N, 3), 5), "b"), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("suffix", [".compressed.ply", ".sog"])
def test_rows_are_in_morton_order(suffix, monkeypatch):
    """Neighbours in space are neighbours in the file, also from one piece to the next."""
    monkeypatch.setattr(pieces, "ROWS", ROWS)
    gaussians = population(N, 0)
    back = find_format(f"a{suffix}").decode(content_of(find_format(f"a{suffix}"), gaussians), "a")
    expected = gaussians.means[morton_order(gaussians.means)]
    assert np.abs(back.means - expected).max() < 0.01 * np.ptp(gaussians.means)
    assert np.abs(back.means - gaussians.means).max() > 0.2 * np.ptp(gaussians.means)
