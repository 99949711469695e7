"""Scenes whose surface is the subject: what they show by hand, ids, and the mesh against the traced truth."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from minisplat_ref.app.cli import main
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.datasets.synthetic.geometry import first_hits
from minisplat_ref.datasets.synthetic.shapes import Box, Cylinder, Rectangle, Sphere
from minisplat_ref.datasets.synthetic.tracer import points_along
from minisplat_ref.datasets.synthetic.triangles import N_AROUND, triangulate, triangulate_world
from minisplat_ref.datasets.synthetic.truths import RADIUS, RISE, TREAD
from tolerances import CLOSED_FORM, SYNTHETIC_SURFACE

SMALL = {"n_views": 4, "width": 64, "height": 48, "supersampling": 1, "n_points": 300, "test_every": 4}


def probe(made, origin, direction):
    """Return where a ray meets the world, and the primitive there."""
    origin, direction = np.array(origin, float), np.array([direction], float)
    hits = first_hits(made.world.primitives, origin, direction)
    return points_along(origin, direction, hits)[0], int(hits.primitive_ids[0])


@pytest.fixture(scope="module")
def staircase():
    return make_scene("staircase", **SMALL)


def test_the_steps_by_hand(staircase):
    for k in range(5):
        point, index = probe(staircase, [(k - 2) * TREAD, 0.1, 3.0], [0, 0, -1])
        assert_allclose(point, [(k - 2) * TREAD, 0.1, RISE * (k + 1)], atol=CLOSED_FORM)
        assert index == k + 1  # after the table


def test_two_spheres_hide_each_other():
    made = make_scene("facing-spheres", **SMALL)
    point, first = probe(made, [-3.0, 0, 0.4], [1, 0, 0])
    assert_allclose(point, [-0.88, 0, 0.4], atol=CLOSED_FORM)
    point, second = probe(made, [0.0, 0, 0.4], [1, 0, 0])  # from the gap
    assert_allclose(point, [0.08, 0, 0.4], atol=CLOSED_FORM)
    assert (first, second) == (1, 2)


def test_points_of_the_noisy_sphere_err_by_a_twentieth_of_its_radius():
    noisy, clean = (make_scene("noisy-sphere", **SMALL | settings).scene for settings in ({}, {"point_noise": 0.0}))
    radii = np.linalg.norm(clean.points - [0, 0, RADIUS], axis=1)
    assert np.mean(np.abs(radii - RADIUS) < SYNTHETIC_SURFACE) > 0.2  # the others are on the table
    assert (noisy.points - clean.points).std() == pytest.approx(0.05 * RADIUS, rel=0.1)


def test_the_seed_builds_another_city():
    heights = [[p.shape.half_z for p in make_scene("box-city", **SMALL, seed=s).world.primitives[1:]] for s in (0, 1)]
    assert len(heights[0]) == 16
    assert np.all(np.array(heights[0]) != heights[1])


def test_ids_are_those_of_the_surface(staircase):
    for view, depth, ids in zip(staircase.scene.train_views, staircase.train_depths, staircase.train_ids, strict=True):
        assert_array_equal(ids == -1, depth == 0)
        for index in np.unique(ids[ids >= 0]):
            rows, columns = np.nonzero(ids == index)
            camera = view.camera
            rays = np.stack([(columns + 0.5 - camera.cx) / camera.fx, (rows + 0.5 - camera.cy) / camera.fy], axis=1)
            rays = np.column_stack([rays, np.ones(len(rays))]) @ camera.cam_from_world_R
            points = camera.center + depth[rows, columns][:, None] * rays
            assert distance_to(staircase.world.primitives[index], points).max() < CLOSED_FORM


def distance_to(primitive, points):
    """Return the distances to the surface of a box or a cylinder that points are on or in."""
    local, shape = np.abs(primitive.to_local(points)), primitive.shape
    if isinstance(shape, Box):
        return np.abs(np.min([shape.half_x, shape.half_y, shape.half_z] - local, axis=1))
    return np.abs(np.minimum(shape.radius - np.hypot(local[:, 0], local[:, 1]), shape.half_length - local[:, 2]))


@pytest.mark.parametrize(
    ("shape", "volume", "area"),
    [
        (Box(1.0, 2.0, 3.0), 48.0, 88.0),
        (Sphere(2.0), 32 * np.pi / 3, 16 * np.pi),
        (Cylinder(0.5, 2.0), np.pi, 4.5 * np.pi),
        (Rectangle(1.0, 2.0), None, 8.0),
    ],
)
def test_triangles_of_a_shape(shape, volume, area):
    """Closed, turned outwards, with the volume and the area of the shape; round ones a little inside."""
    vertices, faces = triangulate(shape)
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    across = np.cross(b - a, c - a)
    loss = (
        0 if isinstance(shape, Box | Rectangle) else 20 / N_AROUND**2
    )  # second order in both angles, pi / N each: (2 pi)^2 / 2
    assert_allclose(np.linalg.norm(across, axis=1).sum() / 2, area, rtol=max(loss, CLOSED_FORM))
    if volume is not None:
        edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
        assert np.all(np.unique(edges, axis=0, return_counts=True)[1] == 2)
        assert_allclose(np.sum(a * np.cross(b, c)) / 6, volume, rtol=max(loss, CLOSED_FORM))


def test_the_mesh_is_the_surface_that_rays_hit(staircase):
    """From outside, above the middle of every face of a box, a ray meets the world there, or something before it."""
    triangles = triangulate_world(staircase.world)
    middles = triangles.vertices[triangles.faces].mean(axis=1)
    for index, primitive in enumerate(staircase.world.primitives):
        own = middles[triangles.ids == index]
        tolerance = CLOSED_FORM if isinstance(primitive.shape, Box) else 2e-3 * 1.5  # of the table's radius
        assert len(own) >= 12
        assert distance_to(primitive, own).max() < tolerance
    assert np.all((triangles.colors >= 0) & (triangles.colors <= 1))


def test_the_folder_has_ids_and_a_mesh(tmp_path, staircase):
    folder = tmp_path / "staircase"
    options = ["--views", "4", "--width", "64", "--height", "48", "--supersampling", "1", "--points", "300"]
    assert main(["synthetic", "staircase", "--out", str(folder), *options, "--test-every", "4"]) == 0
    for view, ids in zip(staircase.scene.train_views, staircase.train_ids, strict=True):
        read = np.load(folder / "ids" / f"{view.name}.npy")
        assert read.dtype == np.int16
        assert_array_equal(read, ids)
    header = (folder / "mesh.ply").read_bytes().split(b"end_header")[0].decode()
    triangles = triangulate_world(staircase.world)
    assert f"element vertex {len(triangles.vertices)}" in header
    assert f"element face {len(triangles.faces)}" in header
