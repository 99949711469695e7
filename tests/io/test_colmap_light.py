"""A COLMAP model without its 2D features: which points an image sees, and how much memory a large model takes."""

import struct
import subprocess
import sys

import numpy as np
import pytest

from minisplat_ref.errors import InputError
from minisplat_ref.io import colmap_light, load_colmap
from minisplat_ref.io.colmap import read_model
from minisplat_ref.io.colmap_light import Track, seen_by_image, without_features
from minisplat_ref.io.colmap_records import LAYOUTS, Record, read_records, without_items
from minisplat_ref.io.lens import import_pycolmap
from photo_scenes import write_colmap
from tolerances import LARGE_MODEL_MB

# Points 7, 3 and 9 in this order in the file: their places by number are 1, 0 and 2.
TRACKS = {7: [2, 0, 1, 0], 3: [4, 1, 2, 3, 4, 5], 9: []}  # of image, feature, image, feature, ...; 3 matched 4 twice
SEEN = {1: [1], 2: [0, 1], 4: [0]}


def write_tracks(folder):
    """A text model with the tracks above and features to go with them."""
    sparse = write_colmap(folder) / "sparse" / "0"
    lines = (sparse / "points3D.txt").read_text().splitlines()
    tracks = (" ".join(map(str, TRACKS[int(line.split()[0])])) for line in lines)
    (sparse / "points3D.txt").write_text("".join(f"{line} {t}\n" for line, t in zip(lines, tracks, strict=True)))
    features = " ".join(f"{i}.5 2.5 -1" for i in range(6))
    images = (sparse / "images.txt").read_text()
    (sparse / "images.txt").write_text(images.replace(".png\n\n", f".png\n{features}\n"))
    return sparse


def seen_in(model):
    with without_features(model) as (folder, seen):
        reconstruction = import_pycolmap().Reconstruction(str(folder))
        assert all(len(image.points2D) == 0 for image in reconstruction.images.values())
        assert all(len(point.track.elements) == 0 for point in reconstruction.points3D.values())
        assert len(reconstruction.images) == 4 and sorted(reconstruction.points3D) == [3, 7, 9]
        return None if seen is None else {image: rows.tolist() for image, rows in seen.items()}


def as_binary(sparse):
    """Rewrite a model as binary."""
    import_pycolmap().Reconstruction(str(sparse)).write_binary(str(sparse))
    for file in sparse.glob("*.txt"):
        file.unlink()


@pytest.mark.parametrize("binary", [False, True])
@pytest.mark.parametrize("piece", [1, 3, 1_000_000])
def test_who_sees_what_by_hand(tmp_path, monkeypatch, binary, piece):
    monkeypatch.setattr(colmap_light, "PIECE", piece)
    sparse = write_tracks(tmp_path)
    if binary:
        as_binary(sparse)
    assert seen_in(sparse) == SEEN
    scene = load_colmap(tmp_path, test_every=0)
    # Images 1, 2 and 4 are 0000, 0001 and 0003; the third sees nothing.
    assert [view.point_ids.tolist() for view in scene.train_views] == [[1], [0, 1], [], [0]]
    np.testing.assert_array_equal(scene.points[:, 0], [1, 0, 0])  # point 3, 7, 9


def test_a_model_without_tracks(tmp_path):
    sparse = write_colmap(tmp_path) / "sparse" / "0"
    assert seen_in(sparse) is None
    as_binary(sparse)
    assert seen_in(sparse) is None


def test_against_the_whole_model(shared_data):
    """What pycolmap says of the tracks of a real model, in which images have matched some points twice."""
    scene = shared_data / "fox"
    whole = read_model(scene)
    rows = {number: row for row, number in enumerate(sorted(whole.points3D))}
    expected: dict[int, set[int]] = {}
    for number, point in whole.points3D.items():
        for element in point.track.elements:
            expected.setdefault(element.image_id, set()).add(rows[number])
    with without_features(scene / "sparse" / "0") as (_, seen):
        assert {image: found.tolist() for image, found in seen.items()} == {i: sorted(s) for i, s in expected.items()}


@pytest.mark.parametrize("n_points", [1, 40])
def test_pieces_change_nothing(rng, monkeypatch, n_points):
    numbers = rng.permutation(10 * n_points)[:n_points].tolist()
    tracks = [Track(number, rng.integers(1, 9, rng.integers(0, 12))) for number in numbers]
    ordered = sorted(tracks)
    expected = {i: [k for k, track in enumerate(ordered) if i in track.image_ids] for i in range(1, 9)}
    for piece in (1, 7, 10_000):
        monkeypatch.setattr(colmap_light, "PIECE", piece)
        found = seen_by_image(iter(tracks)) or {}
        assert {i: rows.tolist() for i, rows in found.items()} == {i: rows for i, rows in expected.items() if rows}


@pytest.mark.parametrize("ending", ["\n", "\r\n"])
def test_text_with_comments_between(tmp_path, ending):
    sparse = write_tracks(tmp_path)
    for name in ("images.txt", "points3D.txt"):
        lines = (sparse / name).read_text().splitlines()
        step = 2 if name == "images.txt" else 1
        blocks = [
            f"# a comment{ending}{ending}" + "".join(x + ending for x in lines[k : k + step])
            for k in range(0, len(lines), step)
        ]
        (sparse / name).write_bytes("".join(blocks).encode())
    assert seen_in(sparse) == SEEN


@pytest.mark.parametrize("word", ["two", "2.5", "9" * 30])
def test_a_track_that_is_no_number(tmp_path, word):
    points = write_tracks(tmp_path) / "points3D.txt"
    points.write_text(points.read_text().replace(" 4 1 2 3", f" {word} 1 2 3"))
    with pytest.raises(InputError, match=r"sparse/0: damaged or incomplete COLMAP model \(.*\); copy or export"):
        load_colmap(tmp_path)


@pytest.mark.parametrize("length", [0, 255, 256, 257, 700])
def test_names_of_any_length(tmp_path, length):
    """They are looked for in blocks of 256 bytes."""
    name, items = b"n" * length, b"i" * 48
    records = [Record(bytes([k]) * 64, name, items) for k in range(2)]
    content = b"".join(r.head + r.name + b"\0" + struct.pack("<Q", 2) + r.items for r in records)
    file = tmp_path / "images.bin"
    file.write_bytes(struct.pack("<Q", 2) + content)
    assert list(read_records(file, with_items=True)) == records
    assert list(read_records(file)) == [record._replace(items=b"") for record in records]
    short = without_items(records[0], LAYOUTS["images.bin"])
    assert short == records[0].head + name + b"\0" + bytes(8)
    file.write_bytes(struct.pack("<Q", 1) + records[0].head + name)
    with pytest.raises(InputError, match=r"images\.bin: truncated"):
        list(read_records(file))


def test_memory_of_a_large_model(tmp_path):
    """11.6 million observations in 378 MB, as numbers and not as objects."""
    n_images, n_points, n_seen = 300, 116_000, 100
    sparse = write_colmap(tmp_path, n=n_images) / "sparse" / "0"
    as_binary(sparse)
    records = list(read_records(sparse / "images.bin"))
    n_features = n_points * n_seen // n_images
    with (sparse / "images.bin").open("wb") as file:
        file.write(struct.pack("<Q", n_images))
        for record in records:
            file.write(record.head + record.name + b"\0" + struct.pack("<Q", n_features))
            file.seek(n_features * LAYOUTS["images.bin"].n_item, 1)  # zeros
        file.truncate()
    fields = [("id", "<u8"), ("xyz", "<f8", 3), ("color", "u1", 3), ("error", "<f8")]
    points = np.zeros(n_points, [*fields, ("n", "<u8"), ("track", "<u4", (n_seen, 2))])
    points["id"], points["n"] = np.arange(n_points), n_seen
    points["track"][:, :, 0] = 1 + (np.arange(n_points)[:, None] + np.arange(n_seen)) % n_images
    with (sparse / "points3D.bin").open("wb") as file:
        file.write(struct.pack("<Q", n_points))
        points.tofile(file)
    code = """if True:
    import sys
    from pathlib import Path
    from minisplat_ref.app.runs.run import peak_rss_mb
    from minisplat_ref.io.colmap import list_colmap
    from minisplat_ref.io.lens import import_pycolmap
    import_pycolmap()
    before = peak_rss_mb()
    listing = list_colmap(Path(sys.argv[1]), 0)
    print(len(listing.points), sum(len(photo.point_ids) for photo in listing.train_photos), peak_rss_mb() - before)
    """
    found = subprocess.run([sys.executable, "-c", code, tmp_path], capture_output=True, text=True, check=True)
    n, n_pairs, megabytes = found.stdout.split()
    assert (int(n), int(n_pairs)) == (n_points, n_points * n_seen)
    assert float(megabytes) < LARGE_MODEL_MB
