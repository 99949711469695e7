"""Checkpoints: everything comes back exactly, and a damaged file is said to be one."""

import json

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from minisplat_ref.errors import InputError
from minisplat_ref.io import checkpoint
from minisplat_ref.io.checkpoint import DamagedCheckpoint, load_checkpoint, save_checkpoint


@pytest.fixture
def arrays(rng):
    return {
        "gaussians.means": rng.normal(size=(50, 3)).astype(np.float32),
        "stats.count": np.arange(50, dtype=np.int32),
        "stats.nobody": np.zeros((0, 2), bool),
    }


METADATA = {"step": 3, "state": 2**127 + 1, "rate": 0.1, "order": [3, 1], "name": "fö"}


def test_round_trip_is_exact(arrays, tmp_path):
    path = tmp_path / "checkpoint.npz"
    save_checkpoint(path, arrays, METADATA)
    loaded, metadata = load_checkpoint(path)
    assert metadata == METADATA
    assert loaded.keys() == arrays.keys()
    for name, array in arrays.items():
        assert_array_equal(loaded[name], array, strict=True)
    assert [file.name for file in tmp_path.iterdir()] == ["checkpoint.npz"]  # nothing is left beside it


def test_failed_write_leaves_the_old_checkpoint(arrays, tmp_path, monkeypatch):
    path = tmp_path / "checkpoint.npz"
    save_checkpoint(path, arrays, METADATA)

    def full_disk(file, **_):
        file.write(b"PK half a file")
        raise OSError("No space left on device")

    monkeypatch.setattr(checkpoint.np, "savez", full_disk)
    with pytest.raises(InputError, match=r"checkpoint\.npz cannot be written \(No space left on device\): make room"):
        save_checkpoint(path, arrays, {"step": 4}, previous=tmp_path / "previous.npz")
    assert load_checkpoint(path)[1] == METADATA
    assert [file.name for file in tmp_path.iterdir()] == ["checkpoint.npz"]


@pytest.mark.parametrize("has_links", [True, False])
def test_the_one_before_is_kept(arrays, tmp_path, monkeypatch, has_links):
    if not has_links:
        monkeypatch.setattr(checkpoint.os, "link", no_links)
    path, previous = tmp_path / "checkpoint.npz", tmp_path / "previous.npz"
    for step in (1, 2, 3):
        save_checkpoint(path, arrays, {"step": step}, previous=previous)
    assert [load_checkpoint(file)[1]["step"] for file in (path, previous)] == [3, 2]
    assert len(list(tmp_path.iterdir())) == 2


def no_links(*_):
    raise OSError("Operation not permitted")


def damage(path, how):
    content = path.read_bytes()
    match how:
        case "truncated":
            path.write_bytes(content[: len(content) // 2])
        case "one byte":  # inside the first array, which the zip's checksum covers
            path.write_bytes(content[:900] + bytes([content[900] ^ 1]) + content[901:])
        case "empty":
            path.write_bytes(b"")
        case "text":
            path.write_text("not a checkpoint")
        case "array":
            with open(path, "wb") as file:
                np.save(file, np.zeros(3))
        case "other npz":
            np.savez(path, means=np.zeros(3))
        case "folder":
            path.unlink()
            path.mkdir()
        case "array is missing":
            with np.load(path) as archive:
                kept = {name: archive[name] for name in archive.files if name != "stats.count"}
            np.savez(path, **kept)
        case "array of another":
            with np.load(path) as archive:
                mixed = {**archive, "stats.count": archive["stats.count"] + 1}
            np.savez(path, **mixed)
        case "other version":
            header = np.frombuffer(b'{"format": "minisplat_ref checkpoint 0", "metadata": {}}', np.uint8)
            np.savez(path, header=header)


DAMAGES = (
    "truncated",
    "one byte",
    "empty",
    "text",
    "array",
    "other npz",
    "folder",
    "array is missing",
    "array of another",
    "other version",
)


@pytest.mark.parametrize("how", DAMAGES)
def test_damaged_file_is_refused_by_name(arrays, tmp_path, how):
    path = tmp_path / "checkpoint.npz"
    save_checkpoint(path, arrays, METADATA)
    damage(path, how)
    with pytest.raises(InputError, match=r"checkpoint\.npz") as caught:
        load_checkpoint(path)
    assert "\n" not in str(caught.value)
    assert isinstance(caught.value, DamagedCheckpoint) == (how != "other version")  # for which an older one may do


def test_files_from_before_there_were_hashes_are_read(arrays, tmp_path):
    path = tmp_path / "checkpoint.npz"
    header = json.dumps({"format": checkpoint.FORMAT, "metadata": METADATA}).encode()
    np.savez(path, header=np.frombuffer(header, np.uint8), **arrays)
    assert load_checkpoint(path)[1] == METADATA


def test_missing_file_is_refused_by_name(tmp_path):
    with pytest.raises(InputError, match=r"nowhere\.npz does not exist"):
        load_checkpoint(tmp_path / "nowhere.npz")
