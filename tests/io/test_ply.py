"""PLY: the 3DGS layout and point clouds."""

import tracemalloc

import numpy as np
import pytest

from minisplat_ref.errors import InputError, InputWarning
from minisplat_ref.io import ply_file
from minisplat_ref.io.ply import COLORS, load_ply, load_points, read_vertices, save_ply, write_vertices
from minisplat_ref.types import Gaussians
from tolerances import SPLAT_BYTE, SPLAT_SCALE

N_REST = (0, 3, 8, 15)


def random_gaussians(rng, n=5, n_rest=15, dtype=np.float32):
    shapes = ((n, 3), (n, 4), (n, 3), (n,), (n, 3), (n, n_rest, 3))
    return Gaussians(*(rng.normal(size=shape).astype(dtype) for shape in shapes))


def columns_of(gaussians, with_normals=True):
    """The file's columns by hand: every coefficient is looked up on its own."""
    g = gaussians
    columns = dict(zip("xyz", g.means.T, strict=True))
    if with_normals:
        columns |= {name: np.zeros(len(g.means), np.float32) for name in ("nx", "ny", "nz")}
    columns |= {f"f_dc_{ch}": g.sh_dc[:, ch] for ch in range(3)}
    n_rest = g.sh_rest.shape[1]
    columns |= {f"f_rest_{ch * n_rest + k}": g.sh_rest[:, k, ch] for ch in range(3) for k in range(n_rest)}
    columns |= {"opacity": g.opacity_logits}
    columns |= {f"scale_{i}": g.log_scales[:, i] for i in range(3)}
    return columns | {f"rot_{i}": g.quats[:, i] for i in range(4)}


def assert_same(actual, expected):
    for name, a, e in zip(Gaussians._fields, actual, expected, strict=True):
        assert a.dtype == e.dtype, name
        np.testing.assert_array_equal(a, e, err_msg=name)


# Writing


@pytest.mark.parametrize("n_rest", N_REST)
@pytest.mark.parametrize("n", [0, 1, 7])
def test_round_trip_is_exact(tmp_path, rng, n, n_rest):
    gaussians = random_gaussians(rng, n, n_rest)
    save_ply(tmp_path / "a.ply", gaussians)
    assert_same(load_ply(tmp_path / "a.ply"), gaussians)


def test_written_layout(tmp_path, rng):
    gaussians = random_gaussians(rng, 2, 15)
    save_ply(tmp_path / "a.ply", gaussians)
    header, _, body = (tmp_path / "a.ply").read_bytes().partition(b"end_header\n")
    names = [line.split()[2] for line in header.decode().splitlines() if line.startswith("property float ")]
    rest = [f"f_rest_{i}" for i in range(45)]
    order = [*"xyz", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", *rest, "opacity"]
    assert names == [*order, "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    assert header.startswith(b"ply\nformat binary_little_endian 1.0\nelement vertex 2\n")
    assert len(body) == 2 * 248
    row = np.frombuffer(body, "<f4")[62:]  # the second Gaussian
    assert row[9 + 2] == gaussians.sh_rest[1, 2, 0]  # f_rest_2: third coefficient, red
    assert row[9 + 15] == gaussians.sh_rest[1, 0, 1]  # f_rest_15: first coefficient, green
    assert row[9 + 44] == gaussians.sh_rest[1, 14, 2]
    assert not row[3:6].any()  # normals


def test_float64_is_written_as_float32(tmp_path, rng):
    gaussians = random_gaussians(rng, dtype=np.float64)
    save_ply(tmp_path / "a.ply", gaussians)
    assert_same(load_ply(tmp_path / "a.ply"), Gaussians(*(field.astype(np.float32) for field in gaussians)))


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e39])
def test_bad_value_is_not_written(tmp_path, rng, value):
    gaussians = random_gaussians(rng, dtype=np.float64)
    gaussians.log_scales[3, 1] = value
    with pytest.raises(InputError, match=r"a\.ply: property scale_1 is (nan|inf) in row 3"):
        save_ply(tmp_path / "a.ply", gaussians)
    assert not list(tmp_path.iterdir())


def test_file_is_replaced_whole_or_not_at_all(tmp_path, rng, monkeypatch):
    path = tmp_path / "a.ply"
    save_ply(path, random_gaussians(rng))
    before = path.read_bytes()

    def fail(descriptor):
        raise OSError("disk full")

    monkeypatch.setattr("os.fsync", fail)
    with pytest.raises(InputError, match=r"a\.ply cannot be written \(disk full\)"):
        save_ply(path, random_gaussians(rng))
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_many_rows_are_written_in_parts_without_copies(tmp_path, rng, monkeypatch):
    """The same bytes as at once, and memory for no more than some of the rows."""
    gaussians = random_gaussians(rng, 50_000)
    save_ply(tmp_path / "whole.ply", gaussians)
    monkeypatch.setattr(ply_file, "ROWS_AT_ONCE", 700)
    tracemalloc.start()
    save_ply(tmp_path / "parts.ply", gaussians)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert (tmp_path / "parts.ply").read_bytes() == (tmp_path / "whole.ply").read_bytes()
    assert peak < sum(field.nbytes for field in gaussians) / 4


def test_missing_folder(tmp_path, rng):
    with pytest.raises(InputError, match=r"nowhere does not exist; create it first"):
        save_ply(tmp_path / "nowhere" / "a.ply", random_gaussians(rng))


# Reading what others write


@pytest.mark.parametrize("n_rest", N_REST)
@pytest.mark.parametrize("with_normals", [True, False])
def test_any_order_of_properties(tmp_path, rng, n_rest, with_normals):
    gaussians = random_gaussians(rng, n_rest=n_rest)
    columns = list(columns_of(gaussians, with_normals).items())
    rng.shuffle(columns)
    extra = {"segment": np.arange(5, dtype=np.int32), "quality": np.full(5, np.nan, np.float32)}
    write_vertices(tmp_path / "a.ply", dict(columns) | extra)
    with pytest.warns(InputWarning, match=r"a\.ply: not drawn are segment, quality \(unknown here\)$"):
        assert_same(load_ply(tmp_path / "a.ply"), gaussians)


def test_one_double_makes_all_double(tmp_path, rng):
    gaussians = random_gaussians(rng, dtype=np.float64)
    columns = columns_of(gaussians) | {"opacity": gaussians.opacity_logits.astype(np.float32)}
    write_vertices(tmp_path / "a.ply", columns)
    expected = gaussians._replace(opacity_logits=gaussians.opacity_logits.astype(np.float32).astype(np.float64))
    assert_same(load_ply(tmp_path / "a.ply"), expected)


def as_ascii(gaussians, newline="\n"):
    columns = columns_of(gaussians)
    lines = ["ply", "format ascii 1.0", "comment by hand", "obj_info none", "element camera 1", "property float fov"]
    lines += [f"element vertex {len(gaussians.means)}", *(f"property float {name}" for name in columns)]
    lines += ["element face 0", "property list uchar int vertex_indices", "end_header", "45.0"]
    lines += [" ".join(repr(float(column[i])) for column in columns.values()) for i in range(len(gaussians.means))]
    return newline.join(lines) + newline


@pytest.mark.parametrize("newline", ["\n", "\r\n"])
def test_ascii_after_another_element(tmp_path, rng, newline):
    gaussians = random_gaussians(rng)
    (tmp_path / "a.ply").write_bytes(as_ascii(gaussians, newline).encode())
    assert_same(load_ply(tmp_path / "a.ply"), gaussians)


def test_big_endian(tmp_path, rng):
    gaussians = random_gaussians(rng)
    save_ply(tmp_path / "a.ply", gaussians)
    header, _, body = (tmp_path / "a.ply").read_bytes().partition(b"end_header\n")
    swapped = np.frombuffer(body, "<f4").astype(">f4").tobytes()
    (tmp_path / "b.ply").write_bytes(header.replace(b"little", b"big") + b"end_header\n" + swapped)
    assert_same(load_ply(tmp_path / "b.ply"), gaussians)


def test_real_file_with_trailing_bytes(shared_data):
    path = shared_data / "ply" / "epfl_pc_short_100.ply"
    gaussians = load_ply(path)
    assert gaussians.sh_rest.shape == (100, 15, 3)
    raw = path.read_bytes().partition(b"end_header\n")[2]
    assert len(raw) - 100 * 248 == 14_029
    rows = np.frombuffer(raw[: 100 * 248], "<f4").reshape(100, 62)
    assert_same(load_ply(path), gaussians)
    np.testing.assert_array_equal(gaussians.quats, rows[:, 58:])
    np.testing.assert_array_equal(gaussians.sh_rest[:, :, 2], rows[:, 39:54])  # blue is the last third
    norms = np.linalg.norm(gaussians.quats, axis=1)
    assert norms.min() < 0.73 and norms.max() > 1.36  # kept as trained, not normalised


def test_real_file_agrees_with_its_splat(shared_data):
    gaussians = load_ply(shared_data / "ply" / "metalsplatter_train_3points.ply")
    splat = (shared_data / "ply" / "metalsplatter_train_3points.splat").read_bytes()
    layout = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quat", "u1", 4)])
    splats = np.frombuffer(splat, layout)
    np.testing.assert_array_equal(gaussians.means, splats["mean"])
    np.testing.assert_allclose(np.exp(gaussians.log_scales), splats["scale"], rtol=SPLAT_SCALE)
    quats = gaussians.quats / np.linalg.norm(gaussians.quats, axis=1, keepdims=True)
    assert np.abs(128 + 128 * quats - splats["quat"]).max() <= SPLAT_BYTE
    opacities = 255 / (1 + np.exp(-gaussians.opacity_logits))
    assert np.abs(opacities - splats["rgba"][:, 3]).max() <= SPLAT_BYTE


# Point clouds


def cloud_columns(points, colors):
    return dict(zip("xyz", points.T, strict=True)) | dict(zip(COLORS, colors.T, strict=True))


@pytest.fixture
def cloud(rng):
    return rng.normal(size=(6, 3)).astype(np.float32), rng.integers(0, 256, (6, 3), dtype=np.uint8)


def test_point_cloud(tmp_path, cloud):
    points, colors = cloud
    columns = cloud_columns(points, colors)
    write_vertices(tmp_path / "p.ply", columns)
    read = load_points(tmp_path / "p.ply")
    assert read.points.dtype == np.float64 and read.colors.dtype == np.uint8
    np.testing.assert_array_equal(read.points, points)
    np.testing.assert_array_equal(read.colors, colors)
    assert (read.has_colors, read.n_dropped) == (True, 0)
    for dtype in (np.float32, np.float64):
        write_vertices(tmp_path / "f.ply", columns | {c: columns[c] / dtype(255) for c in COLORS})
        np.testing.assert_array_equal(load_points(tmp_path / "f.ply").colors, colors)
    write_vertices(tmp_path / "i.ply", columns | {c: columns[c].astype(np.int32) for c in COLORS})
    np.testing.assert_array_equal(load_points(tmp_path / "i.ply").colors, colors)


def test_point_cloud_without_colors(tmp_path, cloud):
    """Two of three channels are no colour either."""
    columns = cloud_columns(*cloud)
    for missing in (COLORS, ("green",)):
        write_vertices(tmp_path / "a.ply", {name: c for name, c in columns.items() if name not in missing})
        read = load_points(tmp_path / "a.ply")
        assert not read.has_colors and (read.colors == 128).all() and read.colors.shape == (6, 3)


def test_points_that_are_not_finite_are_left_out(tmp_path, rng):
    """Of coordinates and colours, and what would be infinite in float32; other properties do not matter."""
    columns = {name: rng.random(7) for name in (*"xyz", *COLORS, "quality")}
    columns["x"][1], columns["z"][2], columns["blue"][4], columns["y"][5] = np.nan, -np.inf, np.nan, 1e39
    columns["quality"][:] = np.nan
    write_vertices(tmp_path / "a.ply", columns)
    read = load_points(tmp_path / "a.ply")
    assert read.n_dropped == 4
    np.testing.assert_array_equal(read.points, np.stack([columns[name][[0, 3, 6]] for name in "xyz"], axis=1))
    expected = np.stack([np.rint(255 * columns[name][[0, 3, 6]]) for name in COLORS], axis=1)
    np.testing.assert_array_equal(read.colors, expected)


@pytest.mark.parametrize(
    ("column", "message"),
    [
        (
            np.array([0.5, 1.01]),
            "green is 1.01; colours are integers from 0 to 255 or floats .*: export them as floats",
        ),
        (np.array([0.5, -0.1]), "green is -0.1;"),
        (np.array([0, 256], np.uint16), "green is 256; .*: export them as uchar"),
        (np.array([0, -1], np.int32), "green is -1;"),
    ],
)
def test_colors_out_of_range(tmp_path, column, message):
    columns = {name: np.zeros(2) for name in "xyz"} | {name: np.zeros(2, np.uint8) for name in COLORS}
    write_vertices(tmp_path / "a.ply", columns | {"green": column})
    with pytest.raises(InputError, match=rf"a\.ply: {message}"):
        load_points(tmp_path / "a.ply")


def test_no_coordinates(tmp_path):
    write_vertices(tmp_path / "a.ply", {"x": np.zeros(2), "y": np.zeros(2)})
    with pytest.raises(InputError, match=r"a\.ply: not a point cloud, it has no property z"):
        load_points(tmp_path / "a.ply")


EDGES = [(0, 1), (5, 2), (3, 3)]
FACES = [[0, 1, 2], [], [2, 3, 4, 5]]


def write_mesh(path, points, colors, encoding):
    """A mesh as few write it: edges and faces before the vertices, lists among the properties of each vertex."""
    header = ["ply", f"format {encoding} 1.0", "element edge 3", "property int vertex1", "property int vertex2"]
    header += ["element face 3", "property uchar flag", "property list uchar uint vertex_indices"]
    header += [f"element vertex {len(points)}", "property list ushort short seen", "property uchar blue"]
    header += ["property double z", "property float nx", "property float x", "property list int8 double weights"]
    header += ["property uchar green", "property float y", "property uchar red", "element end 1", "property float rest"]
    records = [[("i4", end) for end in edge] for edge in EDGES]
    records += [[("u1", 7), ("u1", len(face)), *(("u4", i) for i in face)] for face in FACES]
    for i, ((x, y, z), (red, green, blue)) in enumerate(zip(points, colors, strict=True)):
        seen = [("u2", i), *(("i2", -k) for k in range(i))]
        weights = [("i1", 1), ("f8", 0.5)] if i % 2 else [("i1", 0)]
        scalars = [("u1", blue), ("f8", z), ("f4", 0.0), ("f4", x)]
        records.append([*seen, *scalars, *weights, ("u1", green), ("f4", y), ("u1", red)])
    records.append([("f4", 1.0)])
    order = ">" if encoding == "binary_big_endian" else "<"
    if encoding == "ascii":
        body = "".join(
            " ".join(str(np.asarray(value).item()) for _, value in record) + "\n" for record in records
        ).encode()
    else:
        body = b"".join(np.array(value, order + code).tobytes() for record in records for code, value in record)
    path.write_bytes("\n".join([*header, "end_header\n"]).encode() + body)


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_any_elements_in_any_order(tmp_path, cloud, encoding):
    write_mesh(tmp_path / "a.ply", *cloud, encoding)
    read = load_points(tmp_path / "a.ply")
    np.testing.assert_array_equal(read.points, cloud[0])
    np.testing.assert_array_equal(read.colors, cloud[1])
    assert list(read_vertices(tmp_path / "a.ply")) == ["blue", "z", "nx", "x", "green", "y", "red"]


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian"])
def test_truncated_anywhere(tmp_path, cloud, encoding):
    """Among the faces, in a list of a vertex, in a number."""
    write_mesh(tmp_path / "a.ply", *cloud, encoding)
    content = (tmp_path / "a.ply").read_bytes()
    start = content.index(b"end_header\n") + len(b"end_header\n")
    for end in range(start, len(content) - 5, 7):
        (tmp_path / "a.ply").write_bytes(content[:end])
        with pytest.raises(InputError, match=r"a\.ply: (truncated|row \d is)"):
            load_points(tmp_path / "a.ply")


@pytest.mark.parametrize(
    ("header", "body", "message"),
    [
        ("ascii 1.0|element vertex 1|property list char int i|property int x", b"-1 5", "row 0 is '-1 5'"),
        ("ascii 1.0|element vertex 1|property list char int i|property int x", b"1 5 7 9", "row 0 is '1 5 7 9'"),
        ("ascii 1.0|element vertex 1|property int x|property list char int i", b"7 2 5", "row 0 is '7 2 5'"),
        ("binary_little_endian 1.0|element vertex 1|property list char int i|property int x", b"\xff", "has -1 values"),
        ("ascii 1.0|element vertex 1|property list float int i|property int x", b"", "cannot read the header line"),
    ],
)
def test_bad_lists(tmp_path, header, body, message):
    (tmp_path / "a.ply").write_bytes(f"ply|format {header}|end_header|".replace("|", "\n").encode() + body)
    with pytest.raises(InputError, match=message):
        read_vertices(tmp_path / "a.ply")


def test_every_scalar_type(tmp_path):
    columns = {f"c_{code}": np.array([1, 2], code) for code in ("i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8")}
    write_vertices(tmp_path / "a.ply", columns)
    read = read_vertices(tmp_path / "a.ply")
    assert {name: column.dtype for name, column in read.items()} == {name: c.dtype for name, c in columns.items()}
    assert all((column == [1, 2]).all() for column in read.values())


# Bad input


def test_truncated(tmp_path, rng):
    path = tmp_path / "a.ply"
    save_ply(path, random_gaussians(rng))
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(InputError, match=r"a\.ply: truncated, 5 vertices of 248 bytes need 1240 .* there are 1239"):
        load_ply(path)


def test_truncated_ascii(tmp_path, rng):
    path = tmp_path / "a.ply"
    text = as_ascii(random_gaussians(rng))
    path.write_text("".join(text.splitlines(keepends=True)[:-1]))
    with pytest.raises(InputError, match=r"a\.ply: truncated, 5 vertices expected, 4 lines found"):
        load_ply(path)
    path.write_text(text[: text.rfind(" ")])  # without the last number
    with pytest.raises(InputError, match=r"a\.ply: row 4 is '.*', not 62 numbers"):
        load_ply(path)


@pytest.mark.parametrize(("value", "shown"), [(np.nan, "nan"), (-np.inf, "-inf")])
def test_not_finite(tmp_path, rng, value, shown):
    columns = columns_of(random_gaussians(rng))
    columns["f_rest_7"] = columns["f_rest_7"].copy()
    columns["f_rest_7"][[2, 4]] = value
    write_vertices(tmp_path / "a.ply", columns)
    with pytest.raises(InputError, match=rf"a\.ply: property f_rest_7 is {shown} in row 2 \(2 of 5 rows"):
        load_ply(tmp_path / "a.ply")


def test_zero_quaternion(tmp_path, rng):
    gaussians = random_gaussians(rng)
    gaussians.quats[3] = 0
    save_ply(tmp_path / "a.ply", gaussians)
    with pytest.raises(InputError, match=r"a\.ply: the rotation of row 3 is a zero quaternion; remove"):
        load_ply(tmp_path / "a.ply")


@pytest.mark.parametrize(
    ("drop", "message"),
    [
        (["rot_3"], "no property rot_3; export it again with all properties"),
        (["x", "opacity"], "no property x, opacity; export it again with all properties"),
        (["f_rest_44"], r"44 properties f_rest_\*, but spherical harmonics .* have 0, 9, 24 or 45"),
        ([f"f_rest_{i}" for i in range(36)], "no property f_rest_0, f_rest_1"),
    ],
)
def test_missing_properties(tmp_path, rng, drop, message):
    columns = columns_of(random_gaussians(rng))
    write_vertices(tmp_path / "a.ply", {name: column for name, column in columns.items() if name not in drop})
    with pytest.raises(InputError, match=message):
        load_ply(tmp_path / "a.ply")


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ("", "does not begin with 'ply'"),
        ("GIF89a", "does not begin with 'ply'"),
        ("ply|format ascii 1.0|element vertex 1|property float x|", "header has no end_header"),
        ("ply|format ascii 2.0 1.0|end_header|", "cannot read the header line 'format ascii 2.0 1.0'"),
        ("ply|format ascii 1.0|element vertex -1|end_header|", "cannot read the header line 'element vertex -1'"),
        (
            "ply|format ascii 1.0|element vertex 1|property list uchar int i|end_header|",
            "lacks its format, vertices or",
        ),
        ("ply|format ascii 1.0|element vertex 1|property half x|end_header|", "'property half x'"),
        ("ply|format ascii 1.0|element face 1|property int i|end_header|", "lacks its format, vertices or properties"),
        ("ply|element vertex 1|property int i|end_header|", "lacks its format, vertices or properties"),
        ("ply|format ascii 1.0|element vertex 1|property int i|property int i|end_header|1 2|", "or repeats one"),
        (
            "ply|format binary_big_endian 1.0|element a 1|property int i|element vertex 1|property int i|end_header|",
            "truncated, 1 vertices of 4 bytes need 4 bytes but there are 0",
        ),
        ("ply|format ascii 1.0|element vertex 1|property uchar i|end_header|300|", "row 0 is '300', not 1 numbers"),
    ],
)
def test_bad_header_or_body(tmp_path, lines, message):
    (tmp_path / "a.ply").write_text(lines.replace("|", "\n"))
    with pytest.raises(InputError, match=message) as caught:
        read_vertices(tmp_path / "a.ply")
    assert str(tmp_path / "a.ply") in str(caught.value)
    assert "\n" not in str(caught.value)


def test_missing_file(tmp_path):
    with pytest.raises(InputError, match=r"a\.ply: cannot be opened \(No such file"):
        load_ply(tmp_path / "a.ply")
