"""The grid of ``mesh`` by values: points of the surface, share of the box, margin, voxels, and the truncation."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from minisplat_ref.app.runs import meshing
from minisplat_ref.app.runs.meshing import MeshOptions
from minisplat_ref.io.viewpoints import Viewpoint
from minisplat_ref.mechanisms.fusion.volume import Contraction, DepthMap
from minisplat_ref.types import FILE_FRAME, Camera, Frame
from tolerances import CLOSED_FORM

pytest.importorskip("skimage")
WIDTH, HEIGHT, FOCAL = 80, 60, 40.0
NORMAL, OFFSET = np.array([0.1, -0.2, 1.0]), 2.0  # of the plane that the views show


def looking(center, forward):
    """A view at ``center`` that looks along ``forward``."""
    forward = np.asarray(forward, float) / np.linalg.norm(forward)
    right = np.cross([0.0, 1.0, 0.1], forward)
    right /= np.linalg.norm(right)
    R = np.stack([right, np.cross(forward, right), forward])
    camera = Camera(R, -R @ np.asarray(center, float), FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT)
    return Viewpoint("a", camera, "train")


def plane_map(view, kind):
    """The depth map of the plane ``n . x = offset``, and of nothing in the first columns."""
    camera = view.camera
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    rays = np.stack([(x - camera.cx) / FOCAL, (y - camera.cy) / FOCAL, np.ones_like(x)], axis=2)
    depth = (OFFSET - camera.center @ NORMAL) / (rays @ camera.cam_from_world_R @ NORMAL)
    depth[:, :8] = 0
    return DepthMap(depth, np.full((HEIGHT, WIDTH, 3), 0.5))


def opened_of(views, frame=FILE_FRAME):
    """What a run gives to the mesh: its views and their maps."""
    return SimpleNamespace(views=views, frame=frame, render_map=plane_map, adapt_camera=lambda view: view.camera)


PAIR = [looking([0.1, 0, 0], [0, 0.05, 1]), looking([-0.3, 0.2, -0.1], [0.1, 0, 1])]


def places_of(points, footprint=0.01):
    return meshing._Places(points, np.full(len(points), footprint))


def unit_square(n=101):
    """Points with x from 0 to 1, y from 0 to 2, and z of 5; of 101, 2 % are two."""
    x = np.linspace(0, 1, n)
    return np.column_stack([x, 2 * x[::-1], np.full(n, 5.0)])


def test_the_box_leaves_two_percent_out_and_has_a_margin_of_ten_voxels():
    """Of 0 to 1, 0.02 to 0.98 remains: 9.6 voxels of 0.1 are 10, with 10 on either side, and one for the fence."""
    grid = meshing._choose_grid(opened_of(PAIR), places_of(unit_square()), MeshOptions(Path("run"), voxel=0.1))
    assert grid.shape == (10 + 21, 20 + 21, 0 + 21)
    assert_allclose(grid.origin, [0.02 - 1, 0.04 - 1, 5 - 1], rtol=CLOSED_FORM)
    assert (grid.voxel, grid.contraction) == (0.1, None)
    halved = meshing._choose_grid(opened_of(PAIR), places_of(unit_square()), MeshOptions(Path("run"), voxel=0.05))
    assert halved.shape == (20 + 21, 39 + 21, 0 + 21)


@pytest.mark.parametrize(("n_max", "voxel"), [(10**9, 0.01), (1000, (0.96 * 1.92 * 0.01 / 1000) ** (1 / 3))])
def test_a_voxel_is_a_pixel_of_the_surface_unless_there_would_be_too_many(n_max, voxel, monkeypatch):
    """The median pixel: one that is a hundred times as large changes nothing. A flat surface is as thick as a pixel."""
    monkeypatch.setattr(meshing, "N_VOXELS_MAX", n_max)
    places = places_of(unit_square())
    places.footprints[0] = 1.0
    grid = meshing._choose_grid(opened_of(PAIR), places, MeshOptions(Path("run")))
    assert grid.voxel == pytest.approx(voxel, rel=CLOSED_FORM)
    assert grid.shape[2] == 21


def test_a_voxel_is_given_in_the_unit_of_the_files():
    opened = opened_of(PAIR, Frame((7.0, 8.0, 9.0), 2.0))
    grid = meshing._choose_grid(opened, places_of(unit_square()), MeshOptions(Path("run"), voxel=0.2))
    assert grid.voxel == pytest.approx(0.1) and grid.shape[0] == 31


@pytest.mark.parametrize(("voxel", "n", "side"), [(0.3, 41, 0.1), (0.31, 39, 0.31 / 3), (None, 11, 0.4)])
def test_a_contracted_grid_by_hand(voxel, n, side, monkeypatch):
    """The nearest of the cameras is 3 from the point that all face, (1, 2, 3); contracted space is 4 wide."""
    monkeypatch.setattr(meshing, "N_VOXELS_MAX", 1000)
    target = np.array([1.0, 2.0, 3.0])
    views = [looking(target - length * d / np.linalg.norm(d), d) for length, d in DIRECTIONS]
    options = MeshOptions(Path("run"), voxel=voxel, is_unbounded=True)
    grid = meshing._choose_grid(opened_of(views), places_of(unit_square()), options)
    assert grid.shape == (n, n, n) and grid.voxel == pytest.approx(side, rel=2e-3)
    assert isinstance(grid.contraction, Contraction) and grid.contraction.radius == pytest.approx(3, rel=0.01)
    assert_allclose(grid.contraction.center, target, atol=0.02)
    assert_allclose(grid.origin, -grid.voxel * (n - 1) / 2, rtol=CLOSED_FORM)  # in the middle


DIRECTIONS = [(3.0, np.array([1.0, 0, 0])), (4.0, np.array([0, 0.2, 1])), (5.0, np.array([-1, 0, 0.1]))]


def test_points_of_the_surface_are_those_of_the_depths(monkeypatch):
    """They lie on the plane; a pixel at depth z is z / f wide; of each view at most so many, from all of the image."""
    found = meshing._find_surface(opened_of(PAIR), None)
    assert len(found.points) == 2 * len(range(0, HEIGHT * (WIDTH - 8), 2))  # 4,320 of a view: every other one
    assert_allclose(found.points @ NORMAL, OFFSET, rtol=CLOSED_FORM)
    n = len(found.points) // 2
    z = found.points[:n] @ PAIR[0].camera.cam_from_world_R[2] + PAIR[0].camera.cam_from_world_t[2]
    assert_allclose(found.footprints[:n], z / FOCAL, rtol=CLOSED_FORM)
    monkeypatch.setattr(meshing, "POINTS_PER_VIEW", 4320)
    assert len(meshing._find_surface(opened_of(PAIR), None).points) == 2 * 4320


@pytest.mark.parametrize(("is_unbounded", "radius"), [(False, 1.0), (True, 3.0)])
def test_the_truncation_is_five_voxels(is_unbounded, radius, monkeypatch):
    """In the world's unit, also where the grid is contracted."""
    views, given = [looking(-length * d / np.linalg.norm(d), d) for length, d in DIRECTIONS], []
    monkeypatch.setattr(meshing, "fuse", lambda volume, grid, camera, view, t: given.append((grid.voxel, t)))
    monkeypatch.setattr(meshing, "extract", lambda *_: SimpleNamespace(faces=[], vertices=np.zeros((0, 3))))
    monkeypatch.setattr(meshing, "keep_largest", lambda whole, n: meshing.ColoredMesh(*[np.zeros((0, 3))] * 3))
    options = MeshOptions(Path("run"), voxel=0.6, is_unbounded=is_unbounded)
    meshed = meshing.mesh_run(opened_of(views), options)
    assert len(given) == 3
    for voxel, truncation in given:
        assert truncation == pytest.approx(5 * voxel * radius, rel=0.01) and truncation == pytest.approx(3.0)
    assert meshed.voxel == pytest.approx(0.6)


def test_a_plane_is_meshed_where_both_views_see_it():
    """Vertices are on the plane to a twentieth of a voxel, and reach to the edges of what both views show."""
    meshed = meshing.mesh_run(opened_of(PAIR), MeshOptions(Path("run"), voxel=0.1))
    vertices = meshed.mesh.vertices
    assert np.abs(vertices @ NORMAL - OFFSET).max() < 0.05 * 0.1
    seen = []
    for view in PAIR:
        x = vertices @ view.camera.cam_from_world_R.T + view.camera.cam_from_world_t
        seen.append(x[:, :2] / x[:, 2:] * FOCAL + [WIDTH / 2, HEIGHT / 2])
    for pixels in seen:
        assert pixels[:, 0].min() > 8 - 0.5 and pixels.max(axis=0)[0] < WIDTH and pixels[:, 1].min() > 0
    assert max(pixels[:, 1].max() for pixels in seen) > HEIGHT - 4  # a voxel is 2 pixels wide
    one = meshing.mesh_run(opened_of(PAIR), MeshOptions(Path("run"), voxel=0.1, min_views=1))
    assert len(one.mesh.faces) > len(meshed.mesh.faces)
