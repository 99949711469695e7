import json

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from minisplat_ref.app.cli import main
from minisplat_ref.datasets.synthetic import SCENE_NAMES, make_scene
from minisplat_ref.datasets.synthetic.cameras import look_at
from minisplat_ref.datasets.synthetic.files import write_scene
from minisplat_ref.datasets.synthetic.geometry import Primitive, first_hits
from minisplat_ref.datasets.synthetic.materials import (
    Checker,
    Material,
    Noise,
    Plain,
    linear_rgb,
    random_lattice,
)
from minisplat_ref.datasets.synthetic.shapes import Box, Cylinder, Rectangle, Sphere
from minisplat_ref.datasets.synthetic.sparse_points import project_points
from minisplat_ref.datasets.synthetic.tracer import World, pixel_rays, radiance
from minisplat_ref.errors import InputError
from minisplat_ref.io.srgb import encode_srgb
from tolerances import (
    CLOSED_FORM,
    SYNTHETIC_COLOR_LEVELS,
    SYNTHETIC_FLOAT32,
    SYNTHETIC_SURFACE,
)

SMALL = {"n_views": 4, "width": 64, "height": 48, "supersampling": 1, "n_points": 300, "test_every": 4}
GREY = Material(Plain("#ffffff"))


@pytest.fixture(scope="module", params=SCENE_NAMES)
def synthetic(request):
    return make_scene(request.param, **SMALL, point_noise=0.0)


def place(shape, centre, rotation=None):
    return Primitive(shape, GREY, np.array(centre, float), np.eye(3) if rotation is None else rotation)


def rays_of(camera):
    return pixel_rays(camera, 0.5, 0.5, np.arange(camera.height))


# --- closed form: intersections ---


@pytest.mark.parametrize(
    ("shape", "origin", "direction", "t", "normal"),
    [
        (Sphere(1.0), [0, 0, -5], [0, 0, 1], 4.0, [0, 0, -1]),
        (Sphere(1.0), [0, 0, -5], [0, 0, 2], 2.0, [0, 0, -1]),  # t counts directions, not metres
        (Sphere(1.0), [0, 0, 0], [0, 0, 1], 1.0, [0, 0, 1]),  # from inside
        (Sphere(1.0), [0, 0, 5], [0, 0, 1], np.inf, None),  # behind
        (Sphere(1.0), [1.1, 0, -5], [0, 0, 1], np.inf, None),  # beside
        (Box(1.0, 2.0, 3.0), [-5, 0, 0], [1, 0, 0], 4.0, [-1, 0, 0]),
        (Box(1.0, 2.0, 3.0), [0, -5, 2.9], [0, 1, 0], 3.0, [0, -1, 0]),
        (Box(1.0, 2.0, 3.0), [0, -5, 3.1], [0, 1, 0], np.inf, None),
        (Box(1.0, 2.0, 3.0), [-5, 0, 9], [1, 0, -1.5], 4.0, [-1, 0, 0]),  # hits (-1, 0, 3): both faces' edge
        (Box(1.0, 2.0, 3.0), [0, 0, 0], [0, 0, -1], 3.0, [0, 0, -1]),
        (Cylinder(1.0, 2.0), [-5, 0, 0], [1, 0, 0], 4.0, [-1, 0, 0]),  # side
        (Cylinder(1.0, 2.0), [0.5, 0, 9], [0, 0, -1], 7.0, [0, 0, 1]),  # cap, along the axis
        (Cylinder(1.0, 2.0), [1.5, 0, 9], [0, 0, -1], np.inf, None),
        (Cylinder(1.0, 2.0), [-5, 0, 2.1], [1, 0, 0], np.inf, None),  # above the cap
        (Rectangle(1.0, 2.0), [0.9, 1.9, 4], [0, 0, -1], 4.0, [0, 0, 1]),
        (Rectangle(1.0, 2.0), [1.1, 0, 4], [0, 0, -1], np.inf, None),
        (Rectangle(1.0, 2.0), [0, 2.1, 4], [0, 0, -1], np.inf, None),
        (Rectangle(1.0, 2.0), [0, 0, 4], [1, 0, 0], np.inf, None),  # parallel
    ],
)
def test_intersection_by_hand(shape, origin, direction, t, normal):
    primitive = place(shape, [0, 0, 0])
    origin, direction = np.array(origin, float), np.array([direction], float)
    assert_allclose(primitive.distances(origin, direction), [t], rtol=CLOSED_FORM)
    if normal is not None and not (isinstance(shape, Box) and origin[2] == 9):
        assert_allclose(primitive.normals(origin + t * direction), [normal], atol=CLOSED_FORM)


def test_turned_box_by_hand():
    box = place(Box(1.0, 1.0, 1.0), [0, 0, 7], Rotation.from_euler("y", 45, degrees=True).as_matrix())
    assert_allclose(box.distances(np.array([0, 0.5, 0]), np.array([[0, 0, 1.0]])), [7 - np.sqrt(2)], rtol=CLOSED_FORM)
    assert_allclose(box.normals(np.array([[-0.5, 0, 7.5 - np.sqrt(2)]])), [[-(0.5**0.5), 0, -(0.5**0.5)]])


def is_inside(shape, points):
    match shape:
        case Sphere(radius):
            return np.linalg.norm(points, axis=1) < radius
        case Box(x, y, z):
            return np.all(np.abs(points) < [x, y, z], axis=1)
        case Cylinder(radius, half_length):
            return (np.hypot(points[:, 0], points[:, 1]) < radius) & (np.abs(points[:, 2]) < half_length)


@pytest.mark.parametrize("shape", [Sphere(0.8), Box(0.5, 0.9, 0.2), Cylinder(0.4, 0.9), Cylinder(0.9, 0.1)])
def test_first_entry_of_random_rays(shape, rng):
    """Walking along a ray, every point before t is outside and the next one inside; the normal points back."""
    rotation = Rotation.random(rng=rng).as_matrix()
    primitive = place(shape, rng.normal(size=3), rotation)
    origins = primitive.centre + 4 * rng.normal(size=(400, 3))
    origins = origins[~is_inside(shape, primitive.to_local(origins))]
    directions = primitive.centre + rng.uniform(-0.8, 0.8, size=origins.shape) - origins
    t = primitive.distances(origins, directions)
    hit = np.isfinite(t)
    assert 0.2 < hit.mean() < 0.99
    for share in np.linspace(0, 1.5, 400):
        inside = is_inside(shape, primitive.to_local(origins + share * directions))
        assert not np.any(inside & ~(share >= t))
    step = SYNTHETIC_SURFACE
    assert np.all(is_inside(shape, primitive.to_local((origins + (t + step)[:, None] * directions)[hit])))
    normals = primitive.normals((origins + np.where(hit, t, 0)[:, None] * directions)[hit])
    assert_allclose(np.linalg.norm(normals, axis=1), 1, rtol=CLOSED_FORM)
    assert np.all(np.sum(normals * directions[hit], axis=1) < 0)


def test_culling_changes_nothing(rng):
    shapes = [Sphere(0.5), Box(0.2, 0.9, 0.2), Cylinder(0.05, 0.9), Rectangle(2.0, 2.0)]
    primitives = tuple(place(shape, rng.normal(size=3), Rotation.random(rng=rng).as_matrix()) for shape in shapes * 4)
    directions = rng.normal(size=(500, 3)) + np.array([0, 0, 1])
    for origins in (np.array([0.1, 0.2, -4.0]), primitives[0].centre, rng.normal(size=(500, 3))):
        every = np.stack([primitive.distances(origins, directions) for primitive in primitives])
        assert 0.01 < np.isfinite(every).mean() < 0.5
        hits = first_hits(primitives, origins, directions)
        assert_array_equal(hits.distances, every.min(axis=0))
        assert_array_equal(hits.primitive_ids, np.where(np.isinf(every.min(axis=0)), -1, every.argmin(axis=0)))


# --- closed form: light, textures, cameras ---


def test_light_and_shadow_by_hand():
    """A white floor under a lamp 2 m above: cosine and distance by hand; ambient light alone beneath a table."""
    lamp, ambient = np.array([[0.0, 0.0, 2.0]]), np.array([0.1, 0.2, 0.3])
    world = World(
        (place(Rectangle(5, 5), [0, 0, 0]), place(Cylinder(0.2, 0.01), [1, 0, 1])),
        lamp, np.array([1.0, 0.5, 0.25]), 2.0, ambient, np.zeros(3), None,
    )  # fmt: skip
    below = np.array([[0.0, 0, 0], [2, 0, 0], [0, 2, 0]])  # at the foot, in the table's shadow, as far but free
    origins = below + np.array([0, 0, 0.5])
    directions = np.tile([0.0, 0, -1], (3, 1))
    hits = first_hits(world.primitives, origins, directions)
    colors = radiance(world, origins, directions, hits, np.zeros(3, int))
    # At (0, 2): distance^2 is 8, so (2^2 / 8) cos 45 degrees is left of the light.
    expected = [ambient + world.light_color, ambient, ambient + world.light_color * 0.5 * np.sqrt(0.5)]
    assert_allclose(colors, expected, rtol=CLOSED_FORM)


def test_mirror_and_sky_by_hand():
    """A black mirror of reflectance 1/2 under a sky of colour |direction|, looked at from above and at 60 degrees."""
    mirror = place(Rectangle(9, 9), [0, 0, 0])._replace(material=Material(Plain("#000000"), reflectance=0.5))
    world = World((mirror,), np.array([[0, 0, 3.0]]), np.ones(3), 1.0, np.ones(3), np.ones(3), np.abs)
    slant = np.array([0, np.sqrt(0.75), 0.5])
    directions = np.stack([np.array([0, 0, -2.0]), 2 * slant * [1, 1, -1], 2 * slant])
    hits = first_hits(world.primitives, np.array([0, 0, 1.0]), directions)
    colors = radiance(world, np.array([0, 0, 1.0]), directions, hits, np.zeros(3, int))
    # Schlick: F(0) = 1/2, F(60 degrees) = 1/2 + 1/2 (1 - 1/2)^5 = 33/64; the third ray goes up to the sky.
    assert_allclose(colors, [[0, 0, 0.5], 33 / 64 * slant, slant], atol=CLOSED_FORM)


def test_textures_by_hand(rng):
    checker = Checker("#000000", "#ffffff", 0.5)
    assert_allclose(checker(np.array([[0.1, 0, 0], [0.3, 0, 0], [0.3, 0.3, 0], [-0.3, 0, 0]]))[:, 0], [0, 1, 0, 1])
    assert_allclose(encode_srgb(linear_rgb("#0a80ff")), np.array([10, 128, 255]) / 255, rtol=CLOSED_FORM)
    noise = Noise("#000000", "#ffffff", np.array([1.0, 2.0, 4.0]), random_lattice(rng), n_octaves=1)
    corners = np.array([[3, 8, 12], [-1, 0, 0]])  # lattice points (3, 4, 3) and (31, 0, 0), the lattice being periodic
    assert_allclose(noise.values(corners), noise.lattice[[3, 31], [4, 0], [3, 0]], rtol=CLOSED_FORM)
    start, end = noise.lattice[[3, 4], 4, 3]
    quarter = start + (3 / 16 - 2 / 64) * (end - start)  # 3 f^2 - 2 f^3 at f = 1/4
    assert_allclose(noise.values(np.array([[3.25, 8, 12]])), [quarter], rtol=CLOSED_FORM)
    assert_allclose(noise.values(corners + 1e-9), noise.values(corners - 1e-9), atol=1e-8)


def test_camera_looks_at_target_upright():
    position, target = np.array([3.0, -2.0, 1.5]), np.array([0.5, 0.5, 0.5])
    camera = look_at(position, target, 50.0, 64, 48)
    assert_allclose(camera.cam_from_world_R @ camera.cam_from_world_R.T, np.eye(3), atol=CLOSED_FORM)
    assert np.linalg.det(camera.cam_from_world_R) > 0
    assert_allclose(camera.center, position, rtol=CLOSED_FORM)
    pixels, depths = project_points(camera, np.stack([target, target + np.array([0, 0, 0.3])]))
    assert_allclose(pixels[0], [32, 24], rtol=CLOSED_FORM)
    assert_allclose(depths[0], np.linalg.norm(target - position), rtol=CLOSED_FORM)
    assert_allclose(pixels[1, 0], 32, rtol=CLOSED_FORM)
    assert pixels[1, 1] < 24  # image y runs down, so up in the world is up in the image


# --- truth: depth and normals ---


def surface_points(camera, depth):
    return camera.center + depth.reshape(-1, 1) * rays_of(camera)  # [H W, 3]


def test_depth_agrees_between_views():
    """Inverse depth is linear across the image of a plane, so where four pixels of view B see one plane, the depth of
    view A's points must meet it exactly, or lie behind it."""
    synthetic = make_scene("plain-wall", **SMALL | {"n_views": 12})
    (a, b), (depth_a, depth_b) = synthetic.scene.train_views[:2], synthetic.train_depths[:2]
    points = surface_points(a.camera, depth_a)
    pixels, z = project_points(b.camera, points)
    height, width = depth_b.shape
    corner = np.floor(pixels - 0.5).astype(int)
    inside = (z > 0) & np.all((corner >= 0) & (corner < [width - 1, height - 1]), axis=1)
    corner, z, (fx, fy) = corner[inside], z[inside], (pixels[inside] - 0.5 - corner[inside]).T
    columns, lines = corner[:, :1] + [0, 1, 0, 1], corner[:, 1:] + [0, 0, 1, 1]
    normals = synthetic.train_normals[1][lines, columns]  # [n, 4, 3]
    seen = surface_points(b.camera, depth_b).reshape(height, width, 3)[lines, columns]
    offsets = np.sum(seen * normals[:, :1], axis=2)
    is_plane = np.all(normals == normals[:, :1], axis=(1, 2)) & (np.ptp(offsets, axis=1) < SYNTHETIC_SURFACE)
    weights = np.stack([(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy], axis=1)
    expected = 1 / np.sum(weights / depth_b[lines, columns], axis=1)
    ratio = (z / expected)[is_plane]
    assert len(ratio) > 1000
    assert np.mean(np.abs(ratio - 1) < SYNTHETIC_SURFACE) > 0.8
    assert np.mean(ratio < 1 - SYNTHETIC_SURFACE) < 0.01  # in front: only what falls between pixels at a silhouette


def test_normals(synthetic):
    for view, depth, normal in zip(
        synthetic.scene.train_views, synthetic.train_depths, synthetic.train_normals, strict=True
    ):
        is_surface = (depth > 0).ravel()
        flat = normal.reshape(-1, 3)
        assert_allclose(np.linalg.norm(flat[is_surface], axis=1), 1, rtol=CLOSED_FORM)
        assert np.all(np.sum(flat * rays_of(view.camera), axis=1)[is_surface] < 0)
        assert_array_equal(flat[~is_surface], 0)


def test_normals_are_those_of_the_depth():
    """Neighbours on one plane: the cross product of their offsets is its normal."""
    synthetic = make_scene("plain-wall", **SMALL)
    points = surface_points(synthetic.scene.train_views[0].camera, synthetic.train_depths[0]).reshape(48, 64, 3)
    normals = synthetic.train_normals[0]
    here, right, down = points[:-1, :-1], points[:-1, 1:], points[1:, :-1]
    cross = np.cross(down - here, right - here)
    cross /= np.linalg.norm(cross, axis=2, keepdims=True)
    is_flat = np.all((normals[:-1, :-1] == normals[:-1, 1:]) & (normals[:-1, :-1] == normals[1:, :-1]), axis=2)
    assert is_flat.mean() > 0.5
    cosines = np.sum(cross * normals[:-1, :-1], axis=2)[is_flat]
    assert np.mean(cosines > 1 - SYNTHETIC_SURFACE) > 0.99  # the rest are pairs of parallel faces


def test_sky_has_no_depth():
    outdoor = make_scene("outdoor", **SMALL)
    is_sky = outdoor.train_depths == 0
    assert 0.1 < is_sky.mean() < 0.6
    assert np.all(np.isfinite(outdoor.train_depths))
    assert is_sky[:, 0].mean() > 0.5  # the top of the images
    assert not is_sky[:, -1].any()  # their bottom
    assert np.all(outdoor.train_depths >= 0)
    assert np.all(make_scene("room", **SMALL).train_depths > 0)


def test_supersampling_smooths_colour_but_not_depth():
    coarse, fine = (make_scene("room", **SMALL | {"supersampling": n}) for n in (1, 3))
    assert_array_equal(coarse.train_depths, fine.train_depths)
    assert_array_equal(coarse.train_normals, fine.train_normals)
    roughness = [
        np.abs(np.diff(scene.scene.train_views[0].image.astype(float), axis=1)).mean() for scene in (coarse, fine)
    ]
    assert roughness[1] < 0.95 * roughness[0]


# --- scenes ---


def test_scene_is_what_a_loader_gives(synthetic):
    scene = synthetic.scene
    assert (len(scene.train_views), len(scene.test_views)) == (4, 2)
    names = sorted(view.name for view in scene.train_views + scene.test_views)
    assert [view.name for view in scene.test_views] == names[::4]
    for view in scene.train_views + scene.test_views:
        assert view.image.shape == (view.camera.height, view.camera.width, 3) == (48, 64, 3)
        assert 60 < view.image.mean() < 190  # neither dark nor washed out
        assert (view.image.min(axis=2) == 255).mean() < 0.1
    assert synthetic.test_depths.shape == (2, 48, 64)
    assert synthetic.test_normals.shape == (2, 48, 64, 3)
    centres = np.array([view.camera.center for view in scene.train_views])
    assert_allclose(scene.extent, 1.1 * np.linalg.norm(centres - centres.mean(axis=0), axis=1).max())


def test_seed_decides_everything():
    first, again, other = (make_scene("room", **SMALL, seed=seed) for seed in (3, 3, 4))
    for one, two in zip(first.scene.train_views, again.scene.train_views, strict=True):
        assert_array_equal(one.image, two.image)
    assert_array_equal(first.scene.points, again.scene.points)
    assert_array_equal(first.scene.point_colors, again.scene.point_colors)
    assert np.any(first.scene.train_views[0].image != other.scene.train_views[0].image)


def test_no_test_views():
    scene = make_scene("glossy", **SMALL | {"test_every": 0}).scene
    assert (len(scene.train_views), len(scene.test_views)) == (4, 0)


@pytest.mark.parametrize(("name", "is_glossy"), [("plain-wall", False), ("glossy", True)])
def test_only_gloss_depends_on_the_viewpoint(name, is_glossy):
    world = make_scene(name, **SMALL).world
    ball = next(primitive for primitive in world.primitives if isinstance(primitive.shape, Sphere))
    normals = np.array([[0.6, 0, 0.8], [-0.6, 0.0, 0.8], [0.0, -0.6, 0.8]])
    points = ball.centre + ball.shape.radius * normals
    colors = []
    for side in (-1.0, 1.0):
        origins = points + 0.5 * normals + side * np.array([0.0, 0.3, 0.1])
        hits = first_hits(world.primitives, origins, points - origins)
        assert_allclose(hits.distances, 1, rtol=SYNTHETIC_SURFACE)
        colors.append(radiance(world, origins, points - origins, hits, np.zeros(3, int)))
    difference = np.abs(colors[0] - colors[1]).max()
    assert difference > 0.05 if is_glossy else difference < SYNTHETIC_SURFACE


# --- sparse points ---


def test_points_are_seen_where_they_say(synthetic):
    """Each is seen from two views at least; in those it projects onto a pixel of its colour and of its depth."""
    scene = synthetic.scene
    assert len(scene.points) == 300
    assert np.all(synthetic.point_visibility.sum(axis=0) >= 2)
    color_errors, depth_errors = [], []
    for view, depth, seen in zip(scene.train_views, synthetic.train_depths, synthetic.point_visibility, strict=True):
        pixels, z = project_points(view.camera, scene.points[seen])
        x, y = np.minimum(np.floor(pixels).astype(int), [63, 47]).T
        color_errors.append(np.abs(view.image[y, x].astype(int) - scene.point_colors[seen]).max(axis=1))
        depth_errors.append(np.abs(depth[y, x] / z - 1))
    assert np.median(np.concatenate(color_errors)) < SYNTHETIC_COLOR_LEVELS
    assert np.median(np.concatenate(depth_errors)) < 0.01  # half a pixel away on the same surface, nearly always


def test_points_lie_on_surfaces_and_not_on_the_sky(synthetic):
    view = synthetic.scene.train_views[0]
    seen = synthetic.scene.points[synthetic.point_visibility[0]]
    origin = view.camera.center
    assert_allclose(first_hits(synthetic.world.primitives, origin, seen - origin).distances, 1, rtol=SYNTHETIC_SURFACE)


def test_bare_walls_get_few_points():
    synthetic = make_scene("plain-wall", **SMALL)
    views = zip(synthetic.scene.train_views, synthetic.train_depths, strict=True)
    pixels = np.concatenate([surface_points(view.camera, depth) for view, depth in views])
    on_wall = [np.mean((np.abs(points[:, :2]).max(axis=1) > 2.59) & (points[:, 2] > 0.05))
               for points in (pixels, synthetic.scene.points)]  # fmt: skip
    assert on_wall[0] > 0.4
    assert on_wall[1] < 0.1


def test_point_noise():
    clean, noisy = (make_scene("room", **SMALL, point_noise=noise).scene for noise in (0.0, 0.02))
    deviation = (noisy.points - clean.points).std()
    assert deviation == pytest.approx(0.02, rel=0.1)


# --- folder and command line ---


def test_folder(tmp_path, capsys):
    folder = tmp_path / "made" / "room"
    options = ["--views", "4", "--width", "64", "--height", "48", "--supersampling", "1", "--points", "300"]
    assert main(["synthetic", "room", "--out", str(folder), *options, "--test-every", "4"]) == 0
    assert "4 training and 2 test views, 300 points" in capsys.readouterr().out
    assert [path.name for path in folder.parent.iterdir()] == ["room"]
    synthetic = make_scene("room", **SMALL)

    from minisplat_ref.io import load_scene

    loaded = load_scene(folder, test_every=4)
    for made, read in (
        (synthetic.scene.train_views, loaded.train_views),
        (synthetic.scene.test_views, loaded.test_views),
    ):
        assert [view.name for view in made] == [view.name for view in read]
        for one, two in zip(made, read, strict=True):
            assert_array_equal(one.image, two.image)
            assert one.camera[2:8] == two.camera[2:8]
            assert_allclose(one.camera.cam_from_world_R, two.camera.cam_from_world_R, atol=CLOSED_FORM)
            assert_allclose(one.camera.cam_from_world_t, two.camera.cam_from_world_t, atol=CLOSED_FORM)
    for view, made, seen in zip(
        loaded.train_views, synthetic.scene.train_views, synthetic.point_visibility, strict=True
    ):
        assert_array_equal(view.point_ids, np.flatnonzero(seen))
        assert_array_equal(made.point_ids, np.flatnonzero(seen))
    assert all(view.point_ids is None for view in synthetic.scene.test_views)
    assert_allclose(loaded.points, synthetic.scene.points, atol=CLOSED_FORM)
    assert_array_equal(loaded.point_colors, synthetic.scene.point_colors)
    assert loaded.extent == pytest.approx(synthetic.scene.extent)
    for view, depth, normal in zip(
        synthetic.scene.train_views, synthetic.train_depths, synthetic.train_normals, strict=True
    ):
        assert_allclose(np.load(folder / "depths" / f"{view.name}.npy"), depth, rtol=SYNTHETIC_FLOAT32)
        assert_allclose(np.load(folder / "normals" / f"{view.name}.npy"), normal, atol=SYNTHETIC_FLOAT32)
    info = json.loads((folder / "scene_info.json").read_text())
    assert (info["scene"], info["seed"], info["test_views"]) == ("room", 0, ["view_0000", "view_0004"])


def test_tracks_are_consistent(tmp_path):
    pycolmap = pytest.importorskip("pycolmap")
    synthetic = make_scene("outdoor", **SMALL)
    write_scene(synthetic, tmp_path / "scene", {})
    model = pycolmap.Reconstruction(str(tmp_path / "scene" / "sparse" / "0"))
    assert model.num_reg_images() == 6
    assert model.num_points3D() == 300
    assert model.compute_num_observations() == synthetic.point_visibility.sum()
    model.update_point_3d_errors()
    errors = [point.error for point in model.points3D.values()]
    assert max(errors) < SYNTHETIC_SURFACE


def test_nothing_half_written(tmp_path, monkeypatch):
    def full_disk(*_):
        raise OSError("no space left")

    synthetic = make_scene("glossy", **SMALL)
    monkeypatch.setattr(np, "save", full_disk)
    with pytest.raises(InputError, match="no space left"):
        write_scene(synthetic, tmp_path / "scene", {})
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "culprit"),
    [
        (["kitchen", "--out", "{}/new"], "kitchen"),
        (["room", "--out", "{}"], "exists already"),
        (["room", "--out", "{}/new", "--views", "1"], "n_views is 1"),
        (["room", "--out", "{}/new", "--width", "0"], "width is 0"),
        (["room", "--out", "{}/new", "--supersampling", "0"], "supersampling is 0"),
        (["room", "--out", "{}/new", "--seed", "-1"], "seed is -1"),
        (["room", "--out", "{}/new", "--test-every", "1"], "test_every is 1"),
        (["room", "--out", "{}/new", "--point-noise", "nan"], "point_noise is nan"),
    ],
)
def test_bad_input_is_one_line(arguments, culprit, tmp_path, capsys):
    (tmp_path / "something").touch()
    assert main(["synthetic", *(argument.format(tmp_path) for argument in arguments)]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert culprit in lines[-1]
    assert lines[-1].startswith("minisplat-ref: error: ")
    assert [path.name for path in tmp_path.iterdir()] == ["something"]
