"""Secondary rays: mirrors, glass, shadows, triangles, the command that draws them, and Mitsuba as a peer."""

import json

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from data_tools.claims.rays import demo
from data_tools.claims.rays import measures as claims
from minisplat_ref.app.cli import main
from minisplat_ref.constants import GSPLAT_MAIN
from minisplat_ref.errors import InputError
from minisplat_ref.extensions.rays.lights import (
    DIFFUSE,
    GLASS,
    MIRROR,
    Surroundings,
    concatenate_surfaces,
    continue_rays,
    find_normals,
    irradiance,
    make_surfaces,
    nearest_triangles,
    parallelogram,
    reflect,
    refract,
    shade,
    visibility,
)
from minisplat_ref.extensions.rays.model import TRACED, intersect, whiten_model
from minisplat_ref.extensions.rays.render import check_lights
from minisplat_ref.io.images import read_image
from minisplat_ref.io.ply import save_ply
from minisplat_ref.mechanisms.meshes.mesh import Mesh, save_mesh
from minisplat_ref.mechanisms.rays.pixel_rays import Rays, pixel_rays
from minisplat_ref.rendering import Request
from minisplat_ref.types import Model, view_from
from tolerances import CLOSED_FORM, MITSUBA_DEPTH, PARITY_FLOAT64, RAY_ORDER

NO_LIGHTS = np.zeros((0, 3))
BLACK = np.zeros(3)
WALL = np.array([[4.0, 0.0, 0.0], [0.0, 4.0, 0.0]])


def box(low, high):
    """Return a closed mesh whose normals point outwards."""
    x, y, z = np.array([low, high]).T
    vertices = np.array([[x[i & 1], y[i >> 1 & 1], z[i >> 2]] for i in range(8)], float)
    quads = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]]
    return Mesh(vertices, np.array([[q[0], q[k], q[k + 1]] for q in quads for k in (1, 2)]))


def around(*surfaces, lights=NO_LIGHTS, ambient=0.0):
    return Surroundings(np.asarray(lights, float), ambient, 0.0, concatenate_surfaces(list(surfaces)))


def rays_of(origins, directions):
    origins, directions = np.array(origins, float), np.array(directions, float)
    return Rays(origins, directions, np.full(len(origins), 0.01), np.full(len(origins), 1e10))


# --- triangles ---


def test_a_ray_meets_a_triangle_where_its_plane_is(rng):
    """The expected values solve ``O + t d = p0 + u e1 + v e2``."""
    corners, rays = rng.normal(size=(20, 3, 3)), rays_of(3 * rng.normal(size=(50, 3)), rng.normal(size=(50, 3)))
    depths, faces = nearest_triangles(corners, rays)
    for r in range(50):
        best = np.inf
        for p0, p1, p2 in corners:
            u, v, t = np.linalg.solve(np.column_stack([p1 - p0, p2 - p0, -rays.directions[r]]), rays.origins[r] - p0)
            if min(u, v, 1 - u - v) >= 0 and t > 0.01:
                best = min(best, t)
        assert depths[r] == pytest.approx(best, rel=1e-9)
    assert 5 < (faces >= 0).sum() < 45


def test_a_ray_in_the_plane_of_a_triangle_misses_it():
    depths, faces = nearest_triangles(
        np.array([[[0, 0, 1], [1, 0, 1], [0, 1, 1.0]]]), rays_of([[-1, 0.2, 1]], [[1, 0, 0]])
    )
    assert depths[0] == np.inf and faces[0] < 0


def test_the_normals_of_a_box_point_outwards():
    mesh = box([-1, -1, -1], [1, 1, 1])
    assert_allclose(np.sum(find_normals(mesh.corners) * mesh.corners.mean(axis=1), axis=1), 1)


# --- reflection and refraction ---


def test_a_mirrored_ray_seems_to_come_from_the_mirrored_eye():
    rays, n = rays_of([[1, 2, 0]], [[0.3, -0.2, 1]]), np.array([[0.0, 0.0, -1.0]])
    back = continue_rays(rays, np.array([5.0]), reflect(rays.directions, n))
    assert_allclose(back.origins, [[1, 2, 10]], rtol=CLOSED_FORM)
    assert_allclose(back.directions, [[0.3, -0.2, -1]])


def test_snell_schlick_and_total_reflection():
    angles = np.radians([0, 30, 60, 30, 60])
    entering = np.array([1, 1, 1, -1, -1])  # against the normal or along it
    d = 2.0 * np.column_stack([np.sin(angles), np.zeros(5), -entering * np.cos(angles)])
    bent, shares, is_total = refract(d, np.tile([0.0, 0, 1], (5, 1)), np.full(5, 1.5))
    assert_array_equal(is_total, [False, False, False, False, True])  # beyond asin(1 / 1.5) = 41.8 degrees
    assert_allclose(np.linalg.norm(bent, axis=1), 2, rtol=CLOSED_FORM)
    assert_allclose(bent[:4, 0] / 2, np.sin(angles[:4]) * [1 / 1.5, 1 / 1.5, 1 / 1.5, 1.5], rtol=CLOSED_FORM)
    assert shares[0] == pytest.approx(0.04) and shares[4] == 1  # ((1.5 - 1) / (1.5 + 1))^2
    assert shares[1] == pytest.approx(0.04 + 0.96 * (1 - np.cos(angles[1])) ** 5)
    assert (np.diff(shares[:3]) > 0).all()
    # Leaving at 30 degrees, the ray has sin = 0.75 and cos = 0.6614378 in the air: 0.04 + 0.96 * 0.3385622^5.
    assert shares[3] == pytest.approx(0.0442703, abs=1e-7)
    assert shares[2] == pytest.approx(0.04 + 0.96 / 32)  # cos = 1 / 2


def test_a_pane_shifts_what_is_behind_it():
    """A ray through a pane of thickness h keeps its direction and is shifted by h sin(a - b) / cos(b)."""
    h, a = 0.5, np.radians(40)
    b = np.arcsin(np.sin(a) / 1.5)
    pane = make_surfaces(box([-9, -9, 1], [9, 9, 1 + h]), GLASS)
    d = np.array([[np.sin(a), 0.0, np.cos(a)]])
    rays = rays_of([[0, 0, 0]], d)
    for _ in range(2):
        depths, faces = nearest_triangles(pane.corners, rays._replace(near=rays.near * (1 + 1e-7)))
        bent, _, _ = refract(rays.directions, pane.normals[faces], pane.indices[faces])
        rays = continue_rays(rays, depths, bent)
    assert_allclose(rays.directions, d, atol=CLOSED_FORM)
    beside = np.linalg.norm(np.cross(rays.origins + depths * rays.directions, d))
    assert beside == pytest.approx(h * np.sin(a - b) / np.cos(b), rel=1e-9)


def test_a_mirror_shows_what_the_mirrored_camera_sees():
    assert claims.mirror_difference(100, 2) < RAY_ORDER
    gaussians = claims.random_gaussians(100, np.random.default_rng(2))
    assert TRACED.renderer.render(Model(gaussians), view_from(demo.camera_of(64, 48)), Request())[0].alpha.mean() > 0.1


def test_glass_of_index_one_is_not_there():
    gaussians, camera = claims.random_gaussians(100, np.random.default_rng(3)), demo.camera_of(32, 24)
    air = make_surfaces(box([-3, -3, 2], [3, 3, 4.1]), GLASS, index=1.0)
    images = [
        shade(demo.world_of(gaussians, around(*parts), BLACK), pixel_rays(camera, GSPLAT_MAIN))
        for parts in ((air,), ())
    ]
    assert_allclose(images[0], images[1], atol=1e-4)  # rays that carry less than LEAST end
    traced = TRACED.renderer.render(Model(gaussians), view_from(camera), Request())[0].image
    assert_allclose(images[1], traced.reshape(-1, 3), atol=PARITY_FLOAT64)


def test_two_mirrors_that_face_each_other_end():
    sides = np.array([[4.0, 0, 0], [0, 4.0, 0]])
    walls = [make_surfaces(parallelogram(np.array([-2, -2, z]), sides), MIRROR) for z in (1.0, -1.0)]
    world = demo.world_of(claims.random_gaussians(0, np.random.default_rng(0)), around(*walls), np.ones(3))
    assert_allclose(shade(world, rays_of([[0, 0, 0]], [[0.0, 0, 1]])), 1)  # after three of them, the background


def test_after_three_surfaces_a_ray_sees_through_the_next():
    """Between mirrors that each reflect half, it keeps an eighth of the background."""
    sides = np.array([[4.0, 0, 0], [0, 4.0, 0]])
    walls = [make_surfaces(parallelogram(np.array([-2, -2, z]), sides), MIRROR, np.full(3, 0.5)) for z in (1.0, -1.0)]
    world = demo.world_of(claims.random_gaussians(0, np.random.default_rng(0)), around(*walls), np.ones(3))
    assert_allclose(shade(world, rays_of([[0, 0, 0]], [[0.0, 0, 1]])), 0.125, rtol=CLOSED_FORM)


def test_a_ray_ends_below_a_ten_thousandth_in_its_brightest_channel():
    nobody = claims.random_gaussians(0, np.random.default_rng(0))
    for color, is_kept in (([1.1e-4, 0.0, 1e-5], True), ([0.9e-4, 0.9e-4, 1e-5], False)):
        mirror = make_surfaces(parallelogram(np.array([-2.0, -2, 3]), WALL), MIRROR, np.array(color))
        seen = shade(demo.world_of(nobody, around(mirror), np.ones(3)), rays_of([[0, 0, 0]], [[0.0, 0, 1]]))
        assert_allclose(seen, [color if is_kept else [0, 0, 0]], rtol=CLOSED_FORM)


def test_glass_reflects_its_share_and_tints_what_it_lets_through():
    """A red veil of opacity 1/2 before a sheet of glass of index 1.5, which reflects 0.04 of light that faces it.

    Half is the veil's red. Of the other half, 0.04 comes back and passes the veil once more, and 0.96 goes on with the
    tint: red ``0.5 + 0.5 (0.04 (0.5 + 0.5 * 0.25) + 0.96 * 0.8 * 0.25)``.
    """
    veil = demo.discs(np.array([[0.0, 0, 2]]), np.array([[0.0, 0, 1]]), 0.5, np.array([[1.0, 0, 0]]))
    glass = make_surfaces(parallelogram(np.array([-2.0, -2, 3]), WALL[::-1]), GLASS, np.array([0.8, 0.6, 0.4]))
    world = demo.world_of(veil._replace(opacity_logits=np.zeros(1)), around(glass), np.array([0.25, 0.5, 0.75]))
    seen = shade(world, rays_of([[0, 0, 0]], [[0.0, 0, 1]]))
    assert_allclose(seen, [[0.6085, 0.149, 0.1515]], rtol=1e-12)


# --- meshes and shadows ---


def test_gaussians_in_front_of_a_mesh_cover_it_and_those_behind_it_do_not_count():
    front = demo.discs(np.array([[0.0, 0, 2]]), np.array([[0.0, 0, 1]]), 0.5, np.array([[1.0, 0, 0]]))
    behind = front._replace(means=np.array([[0.0, 0, 4]]))
    wall = make_surfaces(parallelogram(np.array([-4.0, -4, 3]), 2 * WALL), DIFFUSE, np.array([0.0, 0.0, 1.0]))
    rays = rays_of([[0, 0, 0], [0, 0, 0]], [[0.0, 0, 1], [0.9, 0, 1]])
    o = 1 / (1 + np.exp(-4))
    image = shade(demo.world_of(front, around(wall), BLACK), rays)
    assert_allclose(image, [[o, 0, 1 - o], [0, 0, 1]], rtol=CLOSED_FORM)
    assert_allclose(shade(demo.world_of(behind, around(wall), BLACK), rays), [[0, 0, 1], [0, 0, 1]])


def test_a_wall_is_lit_by_the_cosine_and_dark_behind_another():
    wall = make_surfaces(parallelogram(np.array([-2.0, -2, 3]), WALL), DIFFUSE)
    lamp = np.array([[1.0, 0.0, 2.0]])
    nobody = claims.random_gaussians(0, np.random.default_rng(0))
    rays = rays_of([[0, 0, 0]], [[0.0, 0, 1]])
    lit = shade(demo.world_of(nobody, around(wall, lights=lamp, ambient=0.2), BLACK), rays)
    assert_allclose(lit, 0.2 + 0.8 * np.sqrt(0.5), rtol=CLOSED_FORM)
    screen = make_surfaces(parallelogram(np.array([0.1, -1.0, 2.5]), 0.5 * WALL), DIFFUSE)
    dark = shade(demo.world_of(nobody, around(wall, screen, lights=lamp, ambient=0.2), BLACK), rays)
    assert_allclose(dark, 0.2)


def test_lamps_share_the_light_and_gaussians_have_no_cosine():
    """Lamps at 45 degrees and straight in front light a wall by ``0.2 + 0.8 (0.7071068 + 1) / 2``."""
    wall = make_surfaces(parallelogram(np.array([-2.0, -2, 3]), WALL), DIFFUSE)
    lamps = np.array([[1.0, 0.0, 2.0], [0.0, 0.0, 0.5]])
    nobody, rays = claims.random_gaussians(0, np.random.default_rng(0)), rays_of([[0, 0, 0]], [[0.0, 0, 1]])
    world = demo.world_of(nobody, around(wall, lights=lamps, ambient=0.2), BLACK)
    assert_allclose(shade(world, rays), 0.8828427, atol=1e-7)
    points = np.array([[0.0, 0, 2.9]])
    assert_allclose(irradiance(world, points, None), 1, rtol=CLOSED_FORM)
    screen = make_surfaces(parallelogram(np.array([0.1, -1.0, 2.5]), 0.5 * WALL), DIFFUSE)
    half = demo.world_of(nobody, around(screen, lights=lamps, ambient=0.2), BLACK)
    assert_allclose(irradiance(half, points, None), 0.6, rtol=CLOSED_FORM)


def test_a_lamp_in_front_of_a_gaussian_is_not_dimmed_by_it(rng):
    """Only what lies between counts; a faint Gaussian between transmits its part."""
    veil = demo.discs(np.array([[0.0, 0, 2]]), np.array([[0.0, 0, 1]]), 0.5, np.full((1, 3), 0.5))
    world = demo.world_of(veil._replace(opacity_logits=np.zeros(1)), around(), BLACK)
    point = np.array([[0.0, 0, 4]])
    found = [visibility(world, point, np.array([[0.0, 0, z]]) - point, 0.0)[0] for z in (3.0, 1.0)]
    assert found == [1.0, pytest.approx(0.5)]


# --- the command ---


@pytest.fixture
def ply(tmp_path):
    path = tmp_path / "ball.ply"
    save_ply(path, demo.concatenate_populations(demo.ball(60), demo.floor(8)))
    return path


def described(tmp_path, **content):
    path = tmp_path / "scene.json"
    path.write_text(json.dumps(content))
    return path


def test_draws_a_scene_with_all_there_is(ply, tmp_path, capsys):
    save_mesh(tmp_path / "block.ply", box([0.4, 0.3, 2.5], [0.8, 0.7, 3.0]))
    mirror = {"kind": "mirror", "corner": [0.5, -0.6, 3.4], "sides": [[0.5, 0, 1], [0, 1.5, 0]], "color": [1, 0.9, 0.8]}
    glass, block = ({"kind": kind, "mesh": "block.ply"} for kind in ("glass", "diffuse"))
    camera = {"position": [0, 0, 0], "rotation": np.eye(3).tolist(), "width": 32, "height": 24, "fx": 35, "fy": 35}
    (tmp_path / "cameras.json").write_text(json.dumps([{**camera, "img_name": "front"}]))
    images = set()
    for number, surfaces in enumerate(([], [mirror], [glass], [block])):
        scene = described(tmp_path, lights=[demo.LAMP.tolist()], bias=0.1, surfaces=surfaces)
        out = tmp_path / f"out{number}"
        options = ["--scene", str(scene), "--cameras", str(tmp_path / "cameras.json"), "--out", str(out)]
        assert main(["rays", "render", str(ply), *options]) == 0
        images.add((out / "front.png").read_bytes())
    assert len(images) == 4 and "1 images in" in capsys.readouterr().out


def test_the_background_is_given_as_for_other_commands(ply, tmp_path):
    camera = {"position": [0, 0, -90], "rotation": np.eye(3).tolist(), "width": 8, "height": 6, "fx": 8, "fy": 8}
    (tmp_path / "cameras.json").write_text(json.dumps([{**camera, "img_name": "far"}]))
    options = ["--scene", str(described(tmp_path)), "--cameras", str(tmp_path / "cameras.json")]
    shown = {}
    for name, given in (("none", []), ("given", ["--background", "255,128,0"])):
        assert main(["rays", "render", str(ply), *options, *given, "--out", str(tmp_path / name)]) == 0
        shown[name] = read_image(tmp_path / name / "far.png")[0, 0].tolist()
    assert shown == {"none": [0, 0, 0], "given": [255, 128, 0]}


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"surfaces": [{"kind": "mirror", "corner": [0, 0, 1], "sides": [[1, 0, 0], [2, 0, 0]]}]}, "has no area"),
        ({"surfaces": [{"kind": "glass", "corner": [0, 0, 1], "sides": [[1, 0, 0], [0, 1, 0]]}]}, "closed mesh"),
        ({"surfaces": [{"kind": "gold", "mesh": "a.ply"}]}, "choose from diffuse, mirror, glass"),
        ({"surfaces": [{"kind": "mirror"}]}, "give either mesh"),
        ({"surfaces": [{"kind": "mirror", "mesh": "none.ply"}]}, "none.ply"),
        ({"surfaces": [{"kind": "mirror", "corner": [0, 0, 1], "sides": WALL.tolist(), "color": [2, 0, 0]}]}, "color"),
        ({"lamps": []}, "'lamps' is unknown"),
        ({"lights": [[0, 0]]}, "is not 3 finite numbers"),
        ({"lights": [[0, 0, "nan"]]}, "is not 3 finite numbers"),
        ({"ambient": 2}, "ambient is 2"),
        ({"lights": [[-0.4, 1.0, 4.0], [0.25, 1.0, 4.45]]}, "lies inside Gaussian"),
    ],
)
def test_bad_scenes_are_refused_in_one_line(content, message, ply, tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["rays", "render", str(ply), "--scene", str(described(tmp_path, **content)), "--out", str(out)]) == 2
    err = capsys.readouterr().err
    assert message in err and len(err.strip().splitlines()) == 1 and not out.exists()


def test_a_light_in_a_faint_gaussian_is_taken():
    one = demo.discs(np.array([[0.0, 0, 2]]), np.array([[0.0, 0, 1]]), 0.5, np.full((1, 3), 0.5))
    for logit, is_refused in ((4.0, True), (-1.0, False)):
        gaussians = whiten_model(Model(one._replace(opacity_logits=np.array([logit]))))
        lit = around(lights=[[0.0, 0, 2]])
        if is_refused:
            with pytest.raises(InputError, match="lies inside Gaussian 0"):
                check_lights(lit, gaussians, "it")
        else:
            check_lights(lit, gaussians, "it")


# --- a peer ---


def test_mitsuba_meets_the_same_ellipsoids():
    """Mitsuba 3 intersects rays with ellipsoids of three standard deviations, and must find those with q < 9, and enter
    the first at ``t - sqrt((9 - q) / a)``. Rays that graze one are left out, because float32 decides those."""
    mitsuba = pytest.importorskip("mitsuba", reason="needs mitsuba: pip install 'minisplat_ref[rays]'")
    mitsuba.set_variant("scalar_rgb")
    g = claims.random_gaussians(30, np.random.default_rng(4), size=0.05)
    gaussians, rays = whiten_model(Model(g)), pixel_rays(demo.camera_of(12, 9), GSPLAT_MAIN)
    unit = g.quats / np.linalg.norm(g.quats, axis=1, keepdims=True)
    tensors = {"centers": g.means, "scales": np.exp(g.log_scales), "quaternions": np.roll(unit, -1, axis=1)}
    shape = {name: mitsuba.TensorXf(array.astype(np.float32)) for name, array in tensors.items()}
    scene = mitsuba.load_dict(
        {"type": "scene", "all": {"type": "ellipsoids", "extent": 3.0, "extent_adaptive_clamping": False, **shape}}
    )
    n, n_rays = len(g.means), len(rays.near)
    pairs = intersect(gaussians, rays, np.repeat(np.arange(n_rays), n), np.tile(np.arange(n), n_rays))
    q = np.sum(pairs.e**2, axis=1)
    entries = (pairs.depths - np.sqrt(np.maximum(9 - q, 0) / np.sum(pairs.v**2, axis=1))).reshape(-1, n)
    is_met, is_clear = (q < 9).reshape(-1, n), (np.abs(q - 9) > 0.5).reshape(-1, n)
    for r in range(n_rays):
        first = scene.ray_intersect(mitsuba.Ray3f(rays.origins[r].tolist(), rays.directions[r].tolist()))
        found = entries[r][is_met[r] & (entries[r] > 0)]
        if is_clear[r].all():
            assert first.is_valid() == bool(len(found))
            if first.is_valid():
                assert first.t == pytest.approx(found.min(), rel=MITSUBA_DEPTH)
    is_met = is_met[is_clear.all(axis=1)]
    assert 20 < is_met.any(axis=1).sum() < len(is_met)
