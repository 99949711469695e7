"""Programs of others read what we write, and we read what they write: splat-transform, gsply, pycolmap.

Each test skips where its program is not installed. ``npm install @playcanvas/splat-transform`` (Node 22 or newer) makes
``node_modules/.bin/splat-transform``, whose folder the PATH must name; gsply comes by pip, pycolmap with ``[photos]``.
"""

import json
import re
import shutil
import subprocess
import warnings

import numpy as np
import pytest
from numpy.testing import assert_allclose

from compact import population, rotation_error
from data_tools.foreign_files.ksplat import write_ksplat
from minisplat_ref.app.cli import main
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.datasets.synthetic.files import write_scene
from minisplat_ref.io import load_ply, save_ply
from minisplat_ref.io.formats import compressed_ply, glb, ksplat, sog, splat, spz
from minisplat_ref.io.formats.axes import ours_from, turn
from minisplat_ref.io.lens import import_pycolmap
from minisplat_ref.reference.covariance import covariances
from minisplat_ref.types import Gaussians
from tolerances import ROUNDED_TO_FLOAT32, SPZ_ROTATION

pytestmark = pytest.mark.interop

COMPRESSED, GLB, KSPLAT = compressed_ply.COMPRESSED_PLY, glb.GLB, ksplat.KSPLAT
SOG, SPLAT, SPZ = sog.SOG, splat.SPLAT, spz.SPZ
SECONDS = 120
ROTATIONS = {".splat": 0.02, ".spz": SPZ_ROTATION}  # radians; it reads a byte b of a .splat as b / 127.5 - 1
SAME_ROTATION = 1e-3  # the root of what three components leave, in float32
LOGIT = 1e-4  # float32 of large logits; those of 0 and 1 are set by each program as it likes
OPAQUE = 5.0  # magnitude of logits that lie within a level of 0 or 1


@pytest.fixture(scope="module")
def splat_transform():
    program = shutil.which("splat-transform")
    if program is None:
        pytest.skip("no splat-transform on the PATH: npm install @playcanvas/splat-transform")
    try:
        version = subprocess.run([program, "--version"], check=True, capture_output=True, text=True, timeout=SECONDS)
    except subprocess.CalledProcessError:
        pytest.skip("splat-transform does not start: it needs Node 22 or newer")

    def run(*arguments):
        command = [program, "-q", "-w", "-g", "cpu", *map(str, arguments)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=SECONDS)
        assert done.returncode == 0, done.stderr

    run.major = int(re.search(r"v(\d+)\.", version.stdout + version.stderr).group(1))
    return run


def mild(n=300, sh_degree=3):
    """Gaussians whose harmonics are in every format's range."""
    gaussians = population(n, sh_degree)
    return gaussians._replace(sh_rest=np.clip(gaussians.sh_rest, -0.9, 0.9))


def encoded(format_, gaussians, level=0):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of harmonics that a .splat leaves out
        return format_.encode(gaussians, level)


def turned(gaussians):
    """The same about x by 180 degrees: what a program shows that takes the frame of an SPZ for that of a PLY."""
    return turn(gaussians, ours_from("RUB"))


def check_same(theirs, ours, rotation=SAME_ROTATION):
    for name in ("means", "log_scales", "sh_dc", "sh_rest"):
        values, others = getattr(theirs, name), getattr(ours, name)
        assert_allclose(values, others, rtol=1e-5, atol=10 * ROUNDED_TO_FLOAT32, err_msg=name)
    logits = np.clip([theirs.opacity_logits, ours.opacity_logits], -OPAQUE, OPAQUE)
    assert_allclose(*logits, atol=LOGIT)
    assert rotation_error(theirs.quats, ours.quats).max() < rotation


WRITTEN = [(SPLAT, 0), (SOG, 0), (COMPRESSED, 0), (SPZ, 0), (SPZ, 1), (SPZ, 2)]


@pytest.mark.parametrize(("format_", "level"), WRITTEN, ids=lambda value: getattr(value, "suffix", value))
def test_splat_transform_reads_what_we_write(format_, level, splat_transform, tmp_path):
    path = tmp_path / f"ours{format_.suffix}"
    path.write_bytes(encoded(format_, mild(), level))
    splat_transform(path, tmp_path / "theirs.ply")
    ours, theirs = format_.decode(path.read_bytes(), path), load_ply(tmp_path / "theirs.ply")
    if format_ is SPZ and not np.allclose(theirs.means, ours.means, atol=1e-3):
        theirs = turned(theirs)  # since its version 3
    check_same(theirs, ours, ROTATIONS.get(format_.suffix, SAME_ROTATION))


@pytest.mark.parametrize("version", [3, 4])
def test_an_spz_of_splat_transform_is_its_ply_with_the_right_axes(version, splat_transform, tmp_path):
    """RUB up to its version 2, RDF in its version 3; in both directions, and never both."""
    save_ply(tmp_path / "from.ply", mild())
    options = ("--spz-version", version) if version == 3 else ()
    splat_transform(*options, tmp_path / "from.ply", tmp_path / "theirs.spz")
    content = (tmp_path / "theirs.spz").read_bytes()

    def is_where_it_was(gaussians):
        distances = np.linalg.norm(gaussians.means[:, None] - mild().means[None], axis=2)  # its order is another
        return distances.min(axis=0).max() < 0.01

    axes = [axes for axes in ("RUB", "RDF") if is_where_it_was(spz.decode(content, "theirs", axes))]
    assert len(axes) == 1
    (tmp_path / "ours.spz").write_bytes(spz.encode(mild(), spz.VERSIONS.index(version), *axes))
    splat_transform(tmp_path / "ours.spz", tmp_path / "back.ply")
    assert is_where_it_was(load_ply(tmp_path / "back.ply"))


def test_gsply_keeps_the_axes_of_the_ply(tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        gsply = pytest.importorskip("gsply", reason="needs gsply: pip install gsply")
    (tmp_path / "ours.spz").write_bytes(spz.encode(mild(), 0, "RDF"))
    data = gsply.read_spz(str(tmp_path / "ours.spz"))
    assert_allclose(data.means, mild().means, atol=2.0**-11)
    gsply.write_spz(str(tmp_path / "theirs.spz"), data)
    theirs = spz.decode((tmp_path / "theirs.spz").read_bytes(), "theirs", "RDF")
    assert_allclose(theirs.means, mild().means, atol=2.0**-11)


def test_splat_transform_reads_our_ply(splat_transform, tmp_path):
    save_ply(tmp_path / "ours.ply", mild())
    splat_transform(tmp_path / "ours.ply", tmp_path / "theirs.ply")
    for field, other in zip(load_ply(tmp_path / "theirs.ply"), mild(), strict=True):
        np.testing.assert_array_equal(field, other)


@pytest.mark.parametrize("options", [(SOG,), (COMPRESSED,), (SPZ, "--spz-version", 3), (SPZ, "--spz-version", 4)])
def test_we_read_what_splat_transform_writes(options, splat_transform, tmp_path):
    """As it reads it itself; and not far from what was written."""
    format_, *arguments = options
    gaussians = mild()
    save_ply(tmp_path / "from.ply", gaussians)
    path = tmp_path / f"theirs{format_.suffix}"
    splat_transform(*arguments, tmp_path / "from.ply", path)
    splat_transform(path, tmp_path / "back.ply")
    ours, theirs = format_.decode(path.read_bytes(), path), load_ply(tmp_path / "back.ply")
    if format_ is SPZ and not np.allclose(theirs.means, ours.means, atol=1e-3):
        theirs = turned(theirs)
    check_same(theirs, ours, ROTATIONS.get(format_.suffix, SAME_ROTATION))
    written = load_ply(tmp_path / "back.ply").means
    distances = np.linalg.norm(written[:, None] - gaussians.means[None], axis=2)  # its order is another
    assert distances.min(axis=0).max() < 0.01


@pytest.mark.parametrize("level", [0, 1, 2])
@pytest.mark.parametrize("sh_degree", [0, 1, 2])
def test_splat_transform_reads_a_ksplat_as_we_do(level, sh_degree, splat_transform, tmp_path):
    path = tmp_path / "a.ksplat"
    path.write_bytes(write_ksplat(mild(83, sh_degree), level, n_sections=1))
    splat_transform(path, tmp_path / "theirs.ply")
    check_same(load_ply(tmp_path / "theirs.ply"), KSPLAT.decode(path.read_bytes(), path))


def test_we_read_the_glb_that_splat_transform_writes(splat_transform, tmp_path):
    """It does not read any, so it is no judge of ours. It turns a Gaussian about its own axis, too, by 180 degrees."""
    save_ply(tmp_path / "from.ply", mild())
    splat_transform(tmp_path / "from.ply", tmp_path / "theirs.glb")
    theirs = GLB.decode((tmp_path / "theirs.glb").read_bytes(), "theirs.glb")
    check_same(theirs, mild(), rotation=np.inf)
    shapes = [covariances(g.quats.astype(float), np.exp(g.log_scales.astype(float))) for g in (theirs, mild())]
    assert_allclose(*shapes, atol=1e-6)


def of_gsply(data):
    """What gsply has read, as Gaussians."""
    fields = (data.means, data.quats, data.scales, data.opacities, data.sh0, data.shN)
    return Gaussians(*(np.asarray(field, np.float32) for field in fields))


@pytest.mark.parametrize("suffix", [".ply", ".compressed.ply"])
def test_gsply_reads_what_we_write(suffix, tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        gsply = pytest.importorskip("gsply", reason="needs gsply: pip install gsply")
    path = tmp_path / f"ours{suffix}"
    if suffix == ".ply":
        save_ply(path, mild())
        ours = mild()
    else:
        path.write_bytes(encoded(COMPRESSED, mild()))
        ours = COMPRESSED.decode(path.read_bytes(), path)
    check_same(of_gsply(gsply.plyread(str(path))), ours)


def test_we_read_what_gsply_writes(tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        gsply = pytest.importorskip("gsply", reason="needs gsply: pip install gsply")
    save_ply(tmp_path / "ours.ply", mild())
    data = gsply.plyread(str(tmp_path / "ours.ply"))
    gsply.plywrite(str(tmp_path / "plain.ply"), data)
    check_same(load_ply(tmp_path / "plain.ply"), mild())
    gsply.plywrite(str(tmp_path / "packed.compressed.ply"), data, compressed=True)
    path = tmp_path / "packed.compressed.ply"
    check_same(of_gsply(gsply.plyread(str(path))), COMPRESSED.decode(path.read_bytes(), path))


def test_pycolmap_reads_the_scenes_that_we_write(tmp_path):
    pytest.importorskip("pycolmap", reason="needs pycolmap: pip install 'minisplat_ref[photos]'")
    sizes = {"n_views": 3, "width": 32, "height": 24, "n_points": 20}
    scene = make_scene("room", supersampling=1, **sizes).scene
    write_scene(make_scene("room", supersampling=1, **sizes), tmp_path / "scene", sizes)
    model = import_pycolmap().Reconstruction(str(tmp_path / "scene" / "sparse" / "0"))
    views = {f"{view.name}.png": view.camera for view in (*scene.train_views, *scene.test_views)}
    assert {image.name for image in model.images.values()} == set(views) and len(model.points3D) == len(scene.points)
    for image in model.images.values():
        pose, camera = image.cam_from_world(), views[image.name]
        assert_allclose(pose.rotation.matrix(), camera.cam_from_world_R, atol=1e-6)  # digits of the text
        assert_allclose(pose.translation, camera.cam_from_world_t, atol=1e-6)


def test_levels_of_detail(splat_transform, tmp_path):
    """splat-transform reads ``lod-meta.json``: each level with its Gaussians, in the axes of the PLY."""
    if splat_transform.major < 3:
        pytest.skip("splat-transform writes levels of detail, and reads them from version 3 on")
    write_scene(
        make_scene("room", n_views=6, width=32, height=24, supersampling=1, n_points=400), tmp_path / "nook", {}
    )
    training = ("--recipe", "3dgs-accel", "--iterations", "30", "--test-every", "4", "--out", str(tmp_path / "run"))
    assert main(["train", str(tmp_path / "nook"), *training]) == 0
    assert main(["convert", str(tmp_path / "run"), str(tmp_path / "levels" / "lod-meta.json")]) == 0
    counts = json.loads((tmp_path / "levels" / "lod-meta.json").read_text())["counts"]
    assert len(counts) >= 3
    for level, count in enumerate(counts):
        splat_transform(tmp_path / "levels" / "lod-meta.json", "-L", level, tmp_path / f"{level}.ply")
        assert len(load_ply(tmp_path / f"{level}.ply").means) == count
    finest, own = load_ply(tmp_path / "0.ply").means, load_ply(tmp_path / "run" / "point_cloud.ply").means
    assert_allclose(np.sort(finest, axis=0), np.sort(own, axis=0), atol=2e-3 * np.abs(own).max())
