"""Files that claim what they do not hold: each is refused in one line that names it, before anything is allocated."""

import io
import json
import pickle
import re
import struct
import tracemalloc
import zipfile

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from PIL import Image

from minisplat_ref.app.cli import main
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.errors import LINE_MAX, InputError, InputWarning
from minisplat_ref.io import load_ply, load_scene, read_image, viewpoints
from minisplat_ref.io.checkpoint import load_checkpoint, save_checkpoint
from minisplat_ref.io.lens import import_pycolmap
from minisplat_ref.io.npz import read_npz
from minisplat_ref.io.ply import read_vertices, save_ply
from minisplat_ref.methods import get_recipe
from minisplat_ref.training.initial_state import initial_state
from minisplat_ref.training.loop import train
from minisplat_ref.training.recipe_settings import configure
from minisplat_ref.training.saved_state import load_state, save_state
from minisplat_ref.types import Gaussians
from photo_scenes import edit_transforms, write_colmap, write_transforms

DEEP = "[" * 100_000 + "]" * 100_000
FEW_BYTES = 2_000_000  # that a refusal may take, whatever the file claims


@pytest.fixture
def refused(tmp_path):
    """Read what must be refused in one line that names the folder, with hardly any memory; return the line."""

    def run(read, *arguments, **options):
        tracemalloc.start()
        try:
            with pytest.raises(InputError) as caught:
                read(*arguments, **options)
            peak = tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()
        message = str(caught.value)
        assert message.isprintable() and len(message) <= LINE_MAX and str(tmp_path) in message
        assert peak < FEW_BYTES
        return message

    return run


# messages


def test_message_is_one_line_whatever_it_quotes():
    assert str(InputError("a\nb\x1b[31mc\ud800 é")) == "a\\nb\\x1b[31mc\\ud800 é"
    long = str(InputError("x" * 5000 + "; the way out"))
    assert len(long) == LINE_MAX and long.endswith("; the way out") and " ... " in long


# .npz


def write_npz(path, parts, compression=zipfile.ZIP_STORED):
    with zipfile.ZipFile(path, "w", compression) as archive:
        for name, part in parts:
            archive.writestr(name, part)
    return path


def npy(header, content=b""):
    text = header.encode() + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text + content


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_npz_there_and_back(tmp_path, rng, save):
    arrays = {
        "c": rng.normal(size=(3, 4)).astype(np.float32),
        "fortran": np.asfortranarray(rng.normal(size=(3, 4))),
        "big_endian": np.arange(5, dtype=">i4"),
        "none": np.zeros((0, 3)),
        "scalar": np.array(7, np.uint8),
        "truth": np.array([True, False]),
    }
    save(tmp_path / "a.npz", **arrays)
    read = read_npz(tmp_path / "a.npz", "way out")
    assert list(read) == list(arrays)
    for name, array in arrays.items():
        assert_array_equal(read[name], array)
        assert read[name].dtype == array.dtype.newbyteorder("=") and read[name].flags.writeable


FLOATS = "{'descr': '<f4', 'fortran_order': False, 'shape': (%s), }"


@pytest.mark.parametrize(
    ("part", "reason"),
    [
        (npy(FLOATS % "3000000000,"), r"a.npy should be float32[3000000000], but 0 bytes are there"),
        (npy(FLOATS % "4294967296, 4294967296"), "should be float32[4294967296, 4294967296]"),
        (npy(FLOATS % "2,", bytes(9)), "should be float32[2], but 9 bytes are there"),
        (npy(FLOATS % ("9" * 5000)), "is not an .npz of plain arrays, or is damaged"),
        (npy("{'descr': '|O', 'fortran_order': False, 'shape': (1,), }", b"cos\nsystem\n"), "not an .npz of plain"),
        (npy("{'descr': [('x', '<f4')], 'fortran_order': False, 'shape': (1,), }", bytes(4)), "a.npy is none"),
        (npy("{'descr': '<M8[s]', 'fortran_order': False, 'shape': (1,), }", bytes(8)), "a.npy is none"),
        (
            npy("{'descr': '|S4', 'fortran_order': False, 'shape': (1,), }", bytes(4)),
            "only floating point and integers",
        ),
        (npy("__import__('os').system('true')"), "a.npy is none"),
        (npy("(" * 10_000), "a.npy is none"),
        (b"", "a.npy is none"),
    ],
)
def test_array_that_is_not_what_its_header_says(tmp_path, refused, part, reason):
    path = write_npz(tmp_path / "a.npz", [("a.npy", part)])
    message = refused(read_npz, path, "write it again")
    assert reason in message and message.endswith("write it again")


def test_array_twice(tmp_path, refused):
    part = npy(FLOATS % "1,", bytes(4))
    with pytest.warns(UserWarning, match="Duplicate name"):
        path = write_npz(tmp_path / "a.npz", [("a.npy", part), ("a.npy", part)])
    assert "holds a twice" in refused(read_npz, path, "")


def test_checkpoint_that_unpacks_to_a_thousand_times_its_size(tmp_path, refused):
    """As one of 11.7 MB did to 11.2 GiB, here smaller by the same factor."""
    path = tmp_path / "checkpoint.npz"
    save_checkpoint(path, {"gaussians.means": np.zeros((5_000_000, 3), np.float32)}, {})
    with zipfile.ZipFile(path) as archive:
        parts = [(name, archive.read(name)) for name in archive.namelist()]
    write_npz(path, parts, zipfile.ZIP_DEFLATED)
    assert path.stat().st_size < 70_000
    assert "its arrays would take 60,000,3" in refused(load_checkpoint, path)


def test_checkpoint_whose_header_is_no_header(tmp_path, refused):
    path = tmp_path / "checkpoint.npz"
    for text in ("[]", "{}", '{"format": 1}', DEEP, "{", '{"metadata": 3, "format": "minisplat_ref checkpoint 2"}'):
        np.savez(path, header=np.frombuffer(text.encode(), np.uint8))
        refused(load_checkpoint, path)
    np.savez(path, means=np.zeros(3))
    assert "not a checkpoint" in refused(load_checkpoint, path)


# checkpoints that are whole, and yet no state of a training

RECIPE = configure(get_recipe("3dgs-accel"), exposure="learned")._replace(iterations=2)


@pytest.fixture(scope="module")
def scene():
    return make_scene("room", supersampling=1, n_views=6, width=24, height=18, n_points=40).scene


@pytest.fixture
def state(scene):
    state = initial_state(scene, RECIPE, 0)
    state.stats["count"] = np.zeros(len(state.gaussians.means), np.int32)
    state.view_order = [2, 0, 1]
    return state


@pytest.fixture
def saved(state, tmp_path):
    """A checkpoint, and what writes it again with something changed."""
    path = tmp_path / "checkpoint.npz"
    save_state(path, state, RECIPE)
    arrays, metadata = load_checkpoint(path)

    def change(arrays_too=None, **changes):
        metadata_now = {name: value for name, value in {**metadata, **changes}.items() if value is not ...}
        arrays_now = {name: a for name, a in {**arrays, **(arrays_too or {})}.items() if a is not None}
        save_checkpoint(path, arrays_now, metadata_now)
        return path

    return change


def test_whole_checkpoint_is_read(saved, state):
    loaded = load_state(saved(), RECIPE)
    assert loaded.view_order == [2, 0, 1]
    assert loaded.rng.bit_generator.state == state.rng.bit_generator.state
    for name in state.gaussians._fields:
        assert_array_equal(getattr(loaded.gaussians, name), getattr(state.gaussians, name), strict=True)
    assert_array_equal(loaded.shared["exposures"], state.shared["exposures"], strict=True)


def pcg(**changes):
    state = {"bit_generator": "PCG64", "state": {"state": 1, "inc": 3}, "has_uint32": 0, "uinteger": 0}
    return {**state, **changes}


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"step": ...}, "step is no whole number"),
        ({"step": -1}, "step is no whole number"),
        ({"step": "3"}, "step is no whole number"),
        ({"step": True}, "step is no whole number"),
        ({"adam_step": 1.5}, "adam_step is no whole number"),
        ({"shared_adam_step": 2**63}, "shared_adam_step is no whole number"),
        ({"view_order": ...}, "view_order is no list"),
        ({"view_order": [0, "1"]}, "a number in view_order is no whole number"),
        ({"view_order": [-1]}, "a number in view_order is no whole number"),
        ({"recipe": ...}, "was written by recipe without a name of unknown iterations"),
        ({"recipe": [1]}, "was written by recipe without a name of unknown iterations"),
        ({"rng": ...}, "rng is no state of the random generator PCG64"),
        ({"rng": []}, "rng is no state"),
        ({"rng": pcg(bit_generator="MT19937")}, "rng is no state"),
        ({"rng": pcg(state=None)}, "rng is no state"),
        ({"rng": pcg(state={"state": 2**128, "inc": 1})}, "rng is no state"),
        ({"rng": pcg(state={"state": 1, "inc": 2})}, "rng is no state"),
        ({"rng": pcg(uinteger=-1)}, "rng is no state"),
        ({"rng": pcg(has_uint32=None)}, "rng is no state"),
    ],
)
def test_checkpoint_with_wrong_metadata(saved, refused, changes, reason):
    assert reason in refused(load_state, saved(**changes), RECIPE)


def changed(name, change):
    return lambda arrays: {name: change(arrays[name])}


def with_nan(array):
    array = array.copy()
    array.flat[-1] = np.nan
    return array


@pytest.mark.parametrize(
    ("name", "change", "reason"),
    [
        ("gaussians.quats", lambda a: None, "fields of the Gaussians are not those of the recipe (quats)"),
        ("gaussians.colour", lambda a: np.zeros((40, 3), np.float32), "not those of the recipe (colour)"),
        ("gaussians.means", lambda a: a[:-1], "gaussians.quats has shape [40, 4], which does not fit"),
        ("gaussians.means", lambda a: a[:, :2], "gaussians.means has shape [40, 2], which does not fit"),
        ("gaussians.means", lambda a: np.float32(1), "gaussians.means is missing or has no rows"),
        ("gaussians.sh_rest", lambda a: a[:, :7], "gaussians.sh_rest has shape [40, 7, 3], which does not fit"),
        ("gaussians.means", with_nan, "gaussians.means holds NaN"),
        ("gaussians.opacity_logits", lambda a: np.full_like(a, -np.inf), "opacity_logits holds infinity"),
        ("gaussians.sh_dc", lambda a: a.astype(np.float16), "gaussians.sh_dc has dtype float16"),
        ("gaussians.sh_dc", lambda a: a.astype(np.int32), "gaussians.sh_dc has dtype int32"),
        ("first.means", lambda a: a[:-1], "first.means does not fit the parameters"),
        ("second.means", lambda a: None, "second.means does not fit the parameters"),
        ("second.quats", lambda a: a.astype(np.float64), "second.quats does not fit the parameters"),
        ("second.quats", with_nan, "second.quats holds NaN"),
        ("shared_first.exposures", lambda a: None, "shared_first.exposures does not fit"),
        ("shared.exposures", with_nan, "shared.exposures holds NaN"),
        ("stats.count", lambda a: a[:-1], "stats.count has shape [39] for 40 Gaussians"),
        ("means", lambda a: np.zeros(3), "an array 'means' belongs to no checkpoint"),
        ("other.means", lambda a: np.zeros(3), "an array 'other.means' belongs to no checkpoint"),
    ],
)
def test_checkpoint_with_wrong_arrays(saved, refused, name, change, reason):
    arrays, _ = load_checkpoint(saved())
    assert reason in refused(load_state, saved({name: change(arrays.get(name))}), RECIPE)


@pytest.mark.parametrize("n_rest", [0, 3, 8, 15, 24])
def test_coefficients_of_each_degree_are_read(saved, refused, n_rest):
    """Those of the degrees 0 to 3; 24 would be degree 4."""
    sh_rest = np.zeros((40, n_rest, 3), np.float32)
    path = saved({f"{group}.sh_rest": sh_rest for group in ("gaussians", "first", "second")})
    if n_rest == 24:
        assert "gaussians.sh_rest has shape [40, 24, 3], which does not fit" in refused(load_state, path, RECIPE)
    else:
        assert load_state(path, RECIPE).gaussians.sh_rest.shape == (40, n_rest, 3)


def test_info_of_a_checkpoint_that_lies(saved, capsys):
    """What info shows is checked; what it does not show may be wrong."""
    assert main(["info", str(saved())]) == 0
    assert "3dgs-accel for 2 iterations" in capsys.readouterr().out
    arrays, _ = load_checkpoint(saved())
    wrong = [{"gaussians.means": None}, {"gaussians.means": np.zeros(3)}, {"gaussians.quats": np.zeros((2, 4))}]
    wrong += [{"gaussians.log_scales": with_nan(arrays["gaussians.log_scales"])}]
    for path in (saved, *(lambda a=a: saved(a) for a in wrong), lambda: saved(step="3"), lambda: saved(step=...)):
        code = main(["info", str(path())])
        error = capsys.readouterr().err
        assert code == (0 if path is saved else 2) and len(error.splitlines()) == (0 if path is saved else 1)
    huge = np.full_like(arrays["gaussians.log_scales"], 1e30)
    for changes in ({"gaussians.log_scales": huge}, {"gaussians.sh_rest": np.zeros(40, np.float32)}):
        assert main(["info", str(saved(changes))]) == 0
    assert main(["info", str(saved(recipe=[1]))]) == 0
    assert "without a name" in capsys.readouterr().out


def test_checkpoint_with_parameters_that_the_recipe_does_not_train(saved, refused):
    extra = {f"{group}.poses": np.zeros((2, 3)) for group in ("shared", "shared_first", "shared_second")}
    assert "holds poses, which recipe 3dgs-accel does not train" in refused(load_state, saved(extra), RECIPE)


@pytest.mark.parametrize("n_views", [5, 7])
def test_checkpoint_of_another_number_of_views(saved, scene, n_views):
    state = load_state(saved(view_order=[]), RECIPE)
    views = (*scene.train_views, scene.test_views[0])[:n_views]
    with pytest.raises(InputError, match=f"{n_views} training views, for which the run .* no exposures: give the same"):
        train(scene._replace(train_views=views), RECIPE, seed=0, state=state)
    state = load_state(saved({"stats.is_visible": np.ones((40, 3), bool)}, view_order=[]), RECIPE)
    with pytest.raises(InputError, match="no is_visible: give the same"):
        train(scene, RECIPE, seed=0, state=state)


# PLY


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("n", [2**31, 2**63, 10**400])
def test_ply_that_claims_billions_of_vertices(tmp_path, refused, encoding, n):
    (tmp_path / "a.ply").write_text(
        f"ply\nformat {encoding} 1.0\nelement vertex {n}\nproperty float x\nend_header\n1\n2\n"
    )
    assert "truncated" in refused(load_ply, tmp_path / "a.ply")


def test_ascii_ply_that_skips_billions_of_rows(tmp_path, refused):
    header = (
        f"ply\nformat ascii 1.0\nelement a {2**70}\nproperty int i\nelement vertex 1\nproperty float x\nend_header\n"
    )
    (tmp_path / "a.ply").write_text(f"{header}1\n2\n")
    assert "truncated" in refused(load_ply, tmp_path / "a.ply")


# JSON


def camera(**changes):
    entry = {"img_name": "a", "width": 8, "height": 6, "fx": 9.0, "fy": 9.0}
    return {**entry, "position": [0, 0, -3], "rotation": np.eye(3).tolist(), **changes}


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (DEEP, "nested too deeply"),
        (b"\xff\xfe[]", "not valid JSON"),
        ("[" + "9" * 5000 + "]", "not valid JSON"),
        (json.dumps([camera(fx=10**400)]), "finite numbers"),
        (json.dumps([camera(width=float("inf"))]), "finite numbers"),
        (json.dumps([camera(width=float("nan"))]), "finite numbers"),
        (json.dumps([camera(position=[10**400, 0, 0])]), "finite numbers"),
        (json.dumps([camera(position=[1e300, 0, 0])]), "none above 1e+18"),
        (json.dumps([camera(position={"x": 1})]), "position must be 3"),
        (json.dumps([camera(width=1e6, height=1e6)]), "1000000 x 1000000 pixels, more than"),
        (json.dumps([camera(img_name=[1])]), "img_name and split must be text"),
        (json.dumps([3]), "camera 0 is not an object"),
        (json.dumps([{"position": [0, 0, 0]}]), "lacks rotation, width, height, fx, fy"),
    ],
)
def test_camera_file(tmp_path, refused, text, reason):
    (tmp_path / "c.json").write_bytes(text if isinstance(text, bytes) else text.encode())
    assert reason in refused(viewpoints.read, tmp_path / "c.json")


def test_json_may_begin_with_a_byte_order_mark(tmp_path):
    (tmp_path / "c.json").write_text("\ufeff" + json.dumps([camera()]), encoding="utf-8")
    assert viewpoints.read(tmp_path / "c.json")[0].name == "a"


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"file_path": "x" * 5000}, "no focal|missing|images/0001"),
        ({"transform_matrix": [[10**400] * 4] * 4}, "is not 4x4"),
        ({"transform_matrix": [[1e300, 0, 0, 1e300]] * 4}, "is not a rotation"),
        ({"fl_x": 10**400}, "fl_x of .* is 10000.*, not a number"),
        ({"fl_x": [[1]]}, r"fl_x of .* is \[\[1\]\], not a number"),
        ({"w": 1e300}, "w of .* is 1e.300, not a number of pixels"),
        ({"w": float("inf")}, "w of .* is inf, not a number of pixels"),
        ({"mask_path": 3}, "mask_path is 3, not the path of a file"),
        ({"k1": float("nan")}, "coefficients that are not finite"),
        ({"time": [1]}, r"has the time \[1\]: give a number"),
    ],
)
def test_transforms(tmp_path, refused, changes, reason):
    write_transforms(tmp_path, fl_x=40.0)
    edit_transforms(tmp_path / "transforms.json", lambda content: content["frames"][1].update(changes))
    if "file_path" in changes:  # a name that no file can have is a missing file
        unused = pytest.warns(InputWarning, match="3 of 4 photographs have cameras; without a camera: 0001")
        with unused, pytest.warns(UserWarning, match="1 of 4 images are missing and skipped: x"):
            assert len(load_scene(tmp_path, test_every=0).train_views) == 3
    else:
        assert re.search(reason, refused(load_scene, tmp_path, undistort=True))


@pytest.mark.parametrize(("entry", "value"), [("ply_file_path", 3), ("ply_file_path", "x" * 5000)])
def test_transforms_with_points_that_are_no_file(tmp_path, refused, entry, value):
    write_transforms(tmp_path, fl_x=40.0, **{entry: value})
    assert "ply_file_path" in refused(load_scene, tmp_path)


# files that are as they should be, and large


def test_memory_is_a_small_multiple_of_the_file(tmp_path, rng):
    """Measured: 2.7 for the PLY (bytes, columns, fields), 1.8 as text, 1.8 for the .npz, 10 for JSON."""
    n = 5000
    shapes = ((n, 3), (n, 4), (n, 3), (n,), (n, 3), (n, 15, 3))
    gaussians = Gaussians(*(rng.normal(size=shape).astype(np.float32) for shape in shapes))
    save_ply(tmp_path / "a.ply", gaussians)
    columns = read_vertices(tmp_path / "a.ply")
    names = "".join(f"property float {name}\n" for name in columns)
    lines = "".join(" ".join(f"{x:.3g}" for x in row) + "\n" for row in zip(*columns.values(), strict=True))
    header = f"ply\nformat ascii 1.0\nelement vertex {n}\n{names}end_header\n"
    (tmp_path / "text.ply").write_text(header + lines)
    np.savez(tmp_path / "a.npz", **gaussians._asdict())
    (tmp_path / "c.json").write_text(json.dumps([camera()] * n))
    readers = {"a.ply": load_ply, "text.ply": load_ply, "c.json": viewpoints.read}
    readers["a.npz"] = lambda path: read_npz(path, "")
    for name, read in readers.items():
        tracemalloc.start()
        read(tmp_path / name)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < (16 if name == "c.json" else 4) * (tmp_path / name).stat().st_size, name


# COLMAP


@pytest.fixture
def binary(tmp_path):
    """Folder of a binary model with tracks, in a scene."""
    sparse = write_colmap(tmp_path) / "sparse" / "0"
    import_pycolmap().Reconstruction(str(sparse)).write_binary(str(sparse))
    return sparse


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin", "frames.bin", "rigs.bin"])
@pytest.mark.parametrize("count", [2**31, 2**63 - 1, 2**64 - 1])
def test_colmap_that_claims_billions_of_records(binary, tmp_path, refused, name, count):
    file = binary / name
    file.write_bytes(struct.pack("<Q", count) + file.read_bytes()[8:])
    refused(load_scene, tmp_path)


def test_colmap_name_that_is_not_utf8(binary, tmp_path, refused):
    file = binary / "images.bin"
    file.write_bytes(file.read_bytes().replace(b"0002.png", b"\xff\xfe02.png"))
    assert "the name of image 3 is not UTF-8; rename" in refused(load_scene, tmp_path)


def test_colmap_points_that_are_too_far_away(tmp_path, refused):
    points = write_colmap(tmp_path) / "sparse" / "0" / "points3D.txt"
    points.write_text(points.read_text().replace("7 0 0 5", "7 0 0 1e300"))
    assert "1 of 3 sparse points are not finite or beyond 1e+18" in refused(load_scene, tmp_path)


def test_image_larger_than_its_camera_is_not_decoded(tmp_path, refused):
    """The size that the file claims is compared first: a flat image of any size fits a few kilobytes."""
    write_colmap(tmp_path)
    Image.new("L", (6000, 6000)).save(tmp_path / "images" / "0002.png")
    assert "the image is 6000x6000 but its camera is 32x24" in refused(load_scene, tmp_path)


def test_png_that_claims_a_chunk_of_two_gigabytes(tmp_path):
    """After its pixels Pillow asks for what is left of the chunk, as many bytes as its length says."""
    path = tmp_path / "a.png"
    Image.fromarray(np.zeros((6, 8, 4), np.uint8)).save(path)
    content = path.read_bytes()
    start = content.index(b"IDAT") - 4
    path.write_bytes(content[:start] + struct.pack(">I", 2**31 - 1) + content[start + 4 :])
    tracemalloc.start()
    assert not read_image(path).any()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < FEW_BYTES


def test_nothing_is_unpickled(tmp_path, refused):
    """Neither .npy inside .npz nor a pickle that is called one."""
    path = tmp_path / "a.npz"
    with io.BytesIO() as file:
        np.save(file, np.array([{"a": 1}], dtype=object), allow_pickle=True)
        write_npz(path, [("a.npy", file.getvalue())])
    assert "a.npy is none" in refused(read_npz, path, "")
    path.write_bytes(pickle.dumps([1, 2]))
    assert "is not an .npz" in refused(read_npz, path, "")
