"""``mesh``: from a run to a mesh and its page; every depth, scenes far away, and bad input in one line."""

import json
import re
import shutil

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial import cKDTree

from minisplat_ref.app.cli import main
from minisplat_ref.app.runs.depth_maps import DepthKind
from minisplat_ref.app.runs.mesh_report import report_html
from minisplat_ref.app.runs.meshing import MeshOptions, mesh_run, open_for_mesh
from minisplat_ref.app.runs.run_folder import CAMERAS
from minisplat_ref.io.ply_file import read_vertices
from minisplat_ref.mechanisms.fusion import volume
from minisplat_ref.mechanisms.meshes.mesh import load_mesh
from minisplat_ref.types import Frame
from run_commands import write_room
from tolerances import CLOSED_FORM

pytest.importorskip("skimage")
SCENE = {"n_views": 10, "width": 64, "height": 48, "n_points": 300, "test_every": 5}
TRAIN = ["--recipe", "3dgs-accel", "--test-every", "5", "--iterations", "200"]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("mesh")
    write_room(folder / "nook", **SCENE)
    assert main(["train", str(folder / "nook"), *TRAIN, "--out", str(folder / "run")]) == 0
    return folder / "run"


def mesh(run, out, *options):
    return main(["mesh", str(run), "--out", str(out), *options])


def refused(run, out, capsys, *options):
    """Return the one line with which a command is refused that leaves nothing behind."""
    before = sorted(out.parent.iterdir())
    assert mesh(run, out, *options) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert sorted(out.parent.iterdir()) == before
    return line


def test_a_run_becomes_a_mesh_and_a_page(run, tmp_path, capsys):
    out = tmp_path / "room.ply"
    assert mesh(run, out, "--voxel", "0.1") == 0
    printed = capsys.readouterr().out
    found = load_mesh(out)
    assert f"{len(found.faces):,} triangles in {out}: 10 views on " in printed and " voxels of 0.1;" in printed
    assert len(found.faces) > 2000
    assert set(read_vertices(out)) == {"x", "y", "z", "red", "green", "blue"}
    page = (tmp_path / "room.html").read_text()
    assert page.count("<img") == 12 and "room.ply: a mesh of run" in page


@pytest.mark.parametrize("kind", list(DepthKind))
def test_the_surface_is_where_the_depths_are(kind, run):
    """Points that a camera's depth shows lie on the mesh, half of them within one and a half voxels of a vertex."""
    opened = open_for_mesh(run)
    options = MeshOptions(run, kind, voxel=0.1)
    meshed = mesh_run(opened, options)
    view = opened.views[0]
    depth, camera = opened.render_map(view, kind).depth, opened.adapt_camera(view)
    y, x = np.nonzero(depth)
    rays = np.column_stack([(x + 0.5 - camera.cx) / camera.fx, (y + 0.5 - camera.cy) / camera.fy, np.ones(len(x))])
    points = (depth[y, x][:, None] * rays - camera.cam_from_world_t) @ camera.cam_from_world_R
    distances, _ = cKDTree(meshed.mesh.vertices).query(points)
    assert np.median(distances) < 0.15
    assert meshed.voxel == pytest.approx(0.1)


def test_a_glb_is_upright(run, tmp_path, capsys):
    """In glTF y is up: a mesh whose x is up is turned; a PLY has the axes of the scene."""
    trimesh = pytest.importorskip("trimesh")
    assert mesh(run, tmp_path / "a.ply", "--voxel", "0.2", "--up", "1,0,0") == 0
    assert mesh(run, tmp_path / "a.glb", "--voxel", "0.2", "--up", "1,0,0") == 0
    assert "up is 1.00,0.00,0.00, by --up 1,0,0" in capsys.readouterr().out
    heights = trimesh.load(tmp_path / "a.glb", force="mesh").vertices[:, 1]
    assert_allclose(np.sort(heights), np.sort(load_mesh(tmp_path / "a.ply").vertices[:, 0]), atol=1e-5)


def test_without_bounds_it_reaches_further(run, tmp_path, capsys):
    assert mesh(run, tmp_path / "far.ply", "--unbounded", "--voxel", "0.05") == 0
    assert mesh(run, tmp_path / "near.ply", "--voxel", "0.05") == 0
    far, near = (np.ptp(load_mesh(tmp_path / f"{name}.ply").vertices, axis=0) for name in ("far", "near"))
    assert np.prod(far) > np.prod(near)
    assert "in contracted space" in (tmp_path / "far.html").read_text()


def test_the_mesh_is_in_the_frame_of_the_files(run):
    """A run that is rendered in another frame gives the same mesh, moved and scaled, and the voxel is in its unit."""
    opened = open_for_mesh(run)
    here = mesh_run(opened, MeshOptions(run, voxel=0.1))
    frame = Frame((1000.0, -50.0, 3.0), 2.0)
    there = mesh_run(opened._replace(frame=frame), MeshOptions(run, voxel=0.2))
    assert_allclose(there.mesh.vertices, 2 * here.mesh.vertices + frame.origin, rtol=CLOSED_FORM)
    assert (there.voxel, there.shape) == (pytest.approx(0.2), here.shape)
    options, name = MeshOptions(run), run / "x.ply"
    moved = opened._replace(frame=frame)
    pages = (report_html(moved, options, there, name), report_html(opened, options, here, name))
    ours, theirs = (re.findall('data:image[^"]*', page) for page in pages)
    assert len(ours) == 12 and ours == theirs


# Bad input ------------------------------------------------------------------------------------------------------------


def test_bad_input_is_one_line(run, tmp_path, capsys, monkeypatch):
    assert "room.stl is not named like a mesh: give" in refused(run, tmp_path / "room.stl", capsys)
    assert "none is not a folder" in refused(tmp_path / "none", tmp_path / "room.ply", capsys)
    line = refused(run, tmp_path / "room.ply", capsys, "--min-views", "99")
    assert "seen by 99 views" in line and "lower --min-views" in line
    with monkeypatch.context() as patched:
        patched.setattr(volume, "free_bytes", lambda: 1e6)
        line = refused(run, tmp_path / "room.ply", capsys, "--voxel", "0.05")
        assert "1 MB are free: --voxel" in line and line.endswith("fits")
    for option in ("--voxel=0", "--voxel=-1", "--depth=mean", "--parts=0"):
        with pytest.raises(SystemExit, match="2"):
            mesh(run, tmp_path / "room.ply", option)
    capsys.readouterr()
    assert not any(tmp_path.iterdir())


def test_a_run_that_shows_no_surface(run, tmp_path, capsys):
    """All cameras look away."""
    away = tmp_path / "away"
    shutil.copytree(run, away)
    cameras = json.loads((away / CAMERAS).read_text())
    for camera in cameras:
        camera["position"] = [1e3, 0, 0]
        camera["rotation"] = [[0, 0, 1], [1, 0, 0], [0, 1, 0]]
    (away / CAMERAS).write_text(json.dumps(cameras))
    assert "no training view shows a surface" in refused(away, tmp_path / "room.ply", capsys)


def test_a_renderer_without_depth(tmp_path, capsys):
    write_room(tmp_path / "nook", **SCENE)
    options = ["--recipe", "fans", "--test-every", "5", "--iterations", "5", "--out", str(tmp_path / "run")]
    assert main(["train", str(tmp_path / "nook"), *options]) == 0
    capsys.readouterr()
    (tmp_path / "out").mkdir()
    line = refused(tmp_path / "run", tmp_path / "out" / "room.ply", capsys)
    assert "renderer fans gives no median depth" in line
