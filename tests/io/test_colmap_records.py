"""Binary files of COLMAP that end too early, by a model that is written here."""

import pytest

from minisplat_ref.errors import InputError
from minisplat_ref.io.colmap import image_names, read_model
from photo_scenes import write_colmap

FILES = ("cameras.bin", "images.bin", "points3D.bin", "frames.bin")


@pytest.fixture
def model(tmp_path):
    pycolmap = pytest.importorskip("pycolmap")
    scene = write_colmap(tmp_path / "scene")
    folder = scene / "sparse" / "0"
    reconstruction = pycolmap.Reconstruction(str(folder))
    for file in folder.iterdir():
        file.unlink()
    reconstruction.write_binary(str(folder))
    return folder


def test_a_whole_model_is_read(model):
    assert len(read_model(model.parents[1]).images) == 4
    assert image_names(model) == {f"{i:04d}.png" for i in range(4)}


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("n_lost", [1, 7, 20])
def test_the_end_is_missing(name, n_lost, model):
    content = (model / name).read_bytes()
    (model / name).write_bytes(content[:-n_lost])
    with pytest.raises(InputError, match=rf"{name.partition('.')[0]}\.bin: truncated"):
        read_model(model.parents[1])


@pytest.mark.parametrize("name", ["images.bin", "points3D.bin", "frames.bin"])
def test_more_records_are_claimed_than_there_are(name, model):
    content = bytearray((model / name).read_bytes())
    content[:8] = (10**9).to_bytes(8, "little")
    (model / name).write_bytes(content)
    with pytest.raises(InputError, match="truncated"):
        read_model(model.parents[1])
