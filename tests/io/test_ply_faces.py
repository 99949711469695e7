"""Faces of PLY files: in every encoding, beside other properties; what is wrong with them is said in one line."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from minisplat_ref.errors import InputError
from minisplat_ref.io.ply_faces import read_faces
from minisplat_ref.io.ply_file import count_rows, read_vertices, write_vertices

CORNERS = [[0, 1, 2], [3, 2, 1, 0], [1, 0, 3]]
LIST = "property list uchar int vertex_indices"
BYTES, TEXT = (f"{encoding} 1.0|element vertex 1|property char x" for encoding in ("binary_little_endian", "ascii"))


def ply(path, header, body):
    path.write_bytes(f"ply|format {header}|end_header|".replace("|", "\n").encode() + body)
    return path


def binary(order, corners, before=b""):
    """Four vertices of one coordinate, then faces with a colour before and a quality after the corners."""
    faces = b"".join(
        b"\x07"
        + np.array(c, f"{order}i4").tobytes().join([bytes([len(c)]), b""])
        + np.array(0.5, f"{order}f4").tobytes()
        for c in corners
    )
    return np.arange(4, dtype=f"{order}f4").tobytes() + before + faces


FACES = f"element face 3|property uchar red|{LIST}|property float quality"


@pytest.mark.parametrize(("name", "order"), [("little", "<"), ("big", ">")])
def test_binary_faces_of_any_number_of_corners(tmp_path, name, order):
    header = f"binary_{name}_endian 1.0|element vertex 4|property float x|{FACES}"
    path = ply(tmp_path / "a.ply", header, binary(order, CORNERS))
    assert [face.tolist() for face in read_faces(path)] == CORNERS
    assert_array_equal(read_vertices(path)["x"], np.arange(4))


def test_text_faces(tmp_path):
    body = b"0\n1\n2\n3\n" + b"".join(f"7 {len(c)} {' '.join(map(str, c))} 0.5\n".encode() for c in CORNERS)
    path = ply(tmp_path / "a.ply", f"ascii 1.0|element vertex 4|property float x|{FACES}", body)
    assert [face.tolist() for face in read_faces(path)] == CORNERS


def test_faces_before_the_vertices_and_by_their_other_name(tmp_path):
    header = "ascii 1.0|element face 1|property list uchar uint vertex_index|element vertex 1|property float x"
    assert read_faces(ply(tmp_path / "a.ply", header, b"3 0 0 0\n5\n"))[0].tolist() == [0, 0, 0]


@pytest.mark.parametrize("faces", ["", "|element face 1|property uchar red", "|element face 0|" + LIST])
def test_a_file_without_faces_has_none(tmp_path, faces):
    path = ply(tmp_path / "a.ply", f"ascii 1.0|element vertex 1|property float x{faces}", b"5\n5\n")
    assert read_faces(path) == []


def test_written_triangles_are_read(tmp_path, rng):
    columns = dict(zip("xyz", rng.normal(size=(3, 5)), strict=True))
    triangles = np.array([[0, 1, 2], [4, 3, 2]])
    write_vertices(tmp_path / "a.ply", columns, triangles)
    assert_array_equal(np.stack(read_faces(tmp_path / "a.ply")), triangles)
    assert count_rows(tmp_path / "a.ply", "face") == 2
    for name, column in read_vertices(tmp_path / "a.ply").items():
        assert_array_equal(column, columns[name], strict=True)


@pytest.mark.parametrize(
    ("header", "body", "message"),
    [
        (
            f"{BYTES}|element face 2|{LIST}",
            b"\0\3" + bytes(11),
            "trunc",
        ),
        (
            f"{BYTES}|element face 9999999999|{LIST}",
            b"\0",
            "truncated",
        ),
        (
            f"{BYTES}|element face 1|property list uint int vertex_index",
            b"\0\xff\xff\xff\xff",
            "has 4294967295 values",
        ),
        (
            f"{BYTES}|element face 1|property list char int vertex_index",
            b"\0\xff",
            "has -1 values",
        ),
        (
            f"{TEXT}|element face 2|{LIST}",
            b"0\n3 0 0 0\n",
            "2 faces expected, 1 lines",
        ),
        (f"{TEXT}|element face 1|{LIST}", b"0\n3 0 0\n", "a face is '3 0 0'"),
        (
            f"{TEXT}|element face 1|{LIST}",
            b"0\n3 0 0.5 0\n",
            "a face is '3 0 0.5 0'",
        ),
        (
            f"{TEXT}|element face 1|property list uchar float vertex_index",
            b"0\n3 0 0 0\n",
            "not of integers",
        ),
    ],
)
def test_bad_faces(tmp_path, header, body, message):
    with pytest.raises(InputError, match=message) as caught:
        read_faces(ply(tmp_path / "a.ply", header, body))
    assert str(tmp_path) in str(caught.value)
