"""Depth peeling: what a ray meets by hand, opaque meshes as a z-buffer, gradients, parity, hard triangles."""

import numba
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from gradcheck import check_jacobian
from minisplat_ref.errors import InputError
from minisplat_ref.mechanisms.peeling import kernels as kernels
from minisplat_ref.mechanisms.peeling import reference as reference
from minisplat_ref.mechanisms.peeling.layers import Frame, TranslucentMesh, check_translucent, to_bytes
from minisplat_ref.reference.pinhole import pinhole_rays
from scenes import make_camera
from tolerances import (
    CLOSED_FORM,
    COVERAGE_MIN,
    PARITY_FLOAT32_GRADIENT,
    PARITY_FLOAT32_IMAGE,
    PARITY_FLOAT64,
)

BACKGROUND = np.array([0.2, 0.5, 0.9])
NEAR = 0.2
CENTERS = np.stack(np.meshgrid(np.arange(24) + 0.5, np.arange(18) + 0.5), axis=-1)  # [H, W, 2]


@pytest.fixture(params=[reference, kernels], ids=["reference", "kernels"])
def peeling(request):
    return request.param


def soup(rng, n, size=0.5):
    """n random triangles before the camera, each with its own vertices."""
    centers = np.column_stack([rng.uniform(-0.8, 0.8, (n, 2)), rng.uniform(2, 4, n)])
    vertices = (centers[:, None] + size * rng.normal(size=(n, 3, 3))).reshape(-1, 3)
    return TranslucentMesh(vertices, rng.uniform(0.1, 0.9, (3 * n, 4)), np.arange(3 * n).reshape(n, 3))


def cards(depths, rgba):
    """Triangles across the whole image that face the camera, one colour each."""
    one = np.array([[-9.0, -9, 1], [9, -9, 1], [0, 18, 1]])
    n = len(depths)
    vertices = (np.asarray(depths)[:, None, None] * one).reshape(-1, 3)
    return TranslucentMesh(vertices, np.repeat(np.asarray(rgba, float), 3, axis=0), np.arange(3 * n).reshape(n, 3))


def frame_of(camera=None, **changes):
    return Frame(make_camera() if camera is None else camera, NEAR, **changes)


def as_float32(mesh):
    return TranslucentMesh(mesh.vertices.astype(np.float32), mesh.rgba.astype(np.float32), mesh.faces)


def both(mesh, frame, rng):
    """Pixels and gradient by the kernels and by the reference."""
    height, width = frame.camera.height, frame.camera.width
    v_image, v_alpha = rng.normal(size=(height, width, 3)), rng.normal(size=(height, width))
    results = []
    for module in (kernels, reference):
        peeled = module.peel(mesh, frame, BACKGROUND)
        results.append((peeled, module.peel_vjp(mesh, frame, BACKGROUND, peeled, v_image, v_alpha)))
    return results


# --- closed forms ---


def test_three_cards_are_blended_from_the_front(peeling):
    (r1, a1), (r2, a2), (r3, a3) = (0.9, 0.3), (0.1, 0.6), (0.5, 0.2)
    mesh = cards([3.0, 2.0, 4.0], [[r2, 0, 0, a2], [r1, 0, 0, a1], [r3, 0, 0, a3]])
    peeled = peeling.peel(mesh, frame_of(), np.array([1.0, 0, 0]))
    T = (1 - a1) * (1 - a2) * (1 - a3)
    expected = a1 * r1 + (1 - a1) * a2 * r2 + (1 - a1) * (1 - a2) * a3 * r3 + T
    assert_allclose(peeled.image[..., 0], expected, rtol=CLOSED_FORM)
    assert_allclose(peeled.alpha, 1 - T, rtol=CLOSED_FORM)
    assert (peeled.n_layers == 3).all() and peeled.is_seen.all()


def test_colors_are_linear_in_space_on_a_tilted_triangle(peeling, rng):
    """Colours and opacities that are linear in the world stay so, seen in perspective from a turned camera."""
    camera = make_camera(rng=rng)
    vertices = np.array([[-0.6, -0.5, 1.5], [1.5, -0.4, 4], [0, 0.8, 2.5]])
    slopes = rng.uniform(-0.05, 0.05, (4, 3))
    mesh = TranslucentMesh(vertices, vertices @ slopes.T + 0.5, np.array([[0, 1, 2]]))
    peeled = peeling.peel(mesh, frame_of(camera), np.zeros(3))
    R, t = camera.cam_from_world_R, camera.cam_from_world_t
    d, origin = pinhole_rays(CENTERS[..., 0], CENTERS[..., 1], camera) @ R, -R.T @ t  # world frame
    normal = np.cross(vertices[1] - vertices[0], vertices[2] - vertices[0])
    points = origin + (((vertices[0] - origin) @ normal) / (d @ normal))[..., None] * d
    rgba = points @ slopes.T + 0.5
    is_met = peeled.n_layers == 1
    assert 100 < is_met.sum() < is_met.size
    assert_allclose(peeled.image[is_met], (rgba[..., :3] * rgba[..., 3:])[is_met], rtol=10 * CLOSED_FORM)
    assert_allclose(peeled.alpha[is_met], rgba[is_met, 3], rtol=10 * CLOSED_FORM)
    assert not peeled.image[~is_met].any()


def test_interpenetrating_triangles_are_sorted_pixel_by_pixel(peeling):
    """Two opaque planes that cross on the optical axis: left the first is in front, right the second."""
    tilted = np.array([[-9.0, -9, 0], [9, -9, 0], [0, 18, 0]])
    vertices = np.concatenate([tilted + [0, 0, 3] + 0.2 * s * tilted[:, :1] * [0, 0, 1] for s in (1, -1)])
    rgba = np.repeat([[1.0, 0, 0, 1], [0, 1, 0, 1]], 3, axis=0)
    peeled = peeling.peel(TranslucentMesh(vertices, rgba, np.arange(6).reshape(2, 3)), frame_of(), BACKGROUND)
    assert_allclose(peeled.image[:, :12], np.broadcast_to([1.0, 0, 0], (18, 12, 3)), atol=CLOSED_FORM)
    assert_allclose(peeled.image[:, 12:], np.broadcast_to([0.0, 1, 0], (18, 12, 3)), atol=CLOSED_FORM)


def z_buffer(mesh, camera):
    """The colour of the nearest triangle at each pixel, over the background; triangles have one colour each."""
    d = pinhole_rays(CENTERS[..., 0], CENTERS[..., 1], camera) @ camera.cam_from_world_R
    origin = -camera.cam_from_world_R.T @ camera.cam_from_world_t
    image, depths = np.broadcast_to(BACKGROUND, (18, 24, 3)).copy(), np.full((18, 24), np.inf)
    for face in mesh.faces:
        p = mesh.vertices[face]
        b_over_t = np.linalg.solve((p - origin).T, d.reshape(-1, 3).T).T.reshape(18, 24, 3)
        t = 1 / b_over_t.sum(axis=-1)
        is_nearest = (b_over_t > 0).all(axis=-1) & (t > NEAR) & (t < depths)
        image[is_nearest], depths[is_nearest] = mesh.rgba[face[0], :3], t[is_nearest]
    return image


def test_an_opaque_mesh_is_a_z_buffer(peeling, rng):
    mesh, camera = soup(rng, 40), make_camera(rng=rng)
    mesh.rgba[:] = np.repeat(rng.uniform(size=(40, 4)), 3, axis=0)
    mesh.rgba[:, 3] = 1
    peeled = peeling.peel(mesh, frame_of(camera), BACKGROUND)
    assert peeled.n_layers.max() > 4 and COVERAGE_MIN < peeled.alpha.mean() < 1
    assert_allclose(peeled.image, z_buffer(mesh, camera), atol=CLOSED_FORM)
    assert_allclose(peeled.alpha, peeled.n_layers > 0, atol=CLOSED_FORM)


# --- which pixels belong to a triangle ---


def test_neighbours_share_no_pixel_and_leave_none_out(peeling, rng):
    """A jittered grid in front of all pixels, some of its vertices exactly on their centres and lines."""
    x, y = np.meshgrid(np.linspace(-2, 2, 9), np.linspace(-2, 2, 9))
    vertices = np.column_stack([x.ravel(), y.ravel(), np.full(81, 3.0)])
    inner = (np.abs(vertices[:, :2]) < 1.9).all(axis=1) & (rng.uniform(size=81) < 0.6)
    vertices[inner] += 0.15 * rng.uniform(-1, 1, (inner.sum(), 3))
    corners = np.arange(81).reshape(9, 9)
    a, b, c, d = corners[:-1, :-1], corners[:-1, 1:], corners[1:, :-1], corners[1:, 1:]
    faces = np.concatenate([np.stack(f, axis=-1).reshape(-1, 3) for f in ((a, b, c), (d, b, c))])
    mesh = TranslucentMesh(vertices, np.full((81, 4), 0.5), faces)
    for shift in (0.0, 0.5):  # of the principal point: the optical axis goes between pixels, or through a centre
        peeled = peeling.peel(mesh, frame_of(make_camera(cx=12 + shift, cy=9 + shift)), BACKGROUND)
        assert_array_equal(peeled.n_layers, 1)


def test_a_fans_centre_on_a_pixels_centre_counts_once(peeling):
    phi = 2 * np.pi * np.arange(8) / 8
    vertices = np.concatenate([[[0, 0, 3.0]], np.column_stack([np.cos(phi), np.sin(phi), np.full(8, 3.0)])])
    faces = np.array([(0, 1 + j, 1 + (j + 1) % 8) for j in range(8)])
    rgba = np.column_stack([np.ones((9, 3)), [0.7, *[0] * 8]])
    peeled = peeling.peel(TranslucentMesh(vertices, rgba, faces), frame_of(make_camera(cx=12.5, cy=9.5)), np.zeros(3))
    assert peeled.n_layers.max() == 1
    assert_allclose(peeled.alpha[9, 12], 0.7, rtol=CLOSED_FORM)


def test_only_the_nearest_layers_are_blended_if_so_many_are_asked_for(peeling, rng):
    rgba = rng.uniform(0.1, 0.9, (40, 4))
    depths = 2 + 0.01 * rng.permutation(40)
    order = np.argsort(depths)
    few = peeling.peel(cards(depths, rgba), frame_of(max_layers=3), BACKGROUND)
    nearest = peeling.peel(cards(depths[order[:3]], rgba[order[:3]]), frame_of(), BACKGROUND)
    assert_array_equal(few.image, nearest.image)
    assert (few.n_layers == 40).all()
    whole = peeling.peel(cards(depths, rgba), frame_of(), BACKGROUND)
    assert_allclose(whole.alpha, 1 - np.prod(1 - rgba[:, 3]), rtol=CLOSED_FORM)


# --- gradients ---


@pytest.mark.parametrize("max_layers", [2, 1 << 30], ids=["two layers", "all"])
def test_the_gradient_by_differences(peeling, max_layers):
    """Three slivers of 60 pixels, an opaque one in front of another: alpha = 1 has a gradient, too."""
    rng = np.random.default_rng(2)
    camera = make_camera(8, 6, fx=10.0, fy=9.0, rng=rng)
    one, step = np.array([[-1.0, -0.9, 3], [1.1, -0.8, 2.6], [0.1, 1.2, 2.8]]), np.array([0.1, 0.05, 0.9])
    mesh = TranslucentMesh(
        np.concatenate([one, one + step, one + 2 * step]),
        rng.uniform(0.2, 0.8, (9, 4)),
        np.arange(9).reshape(3, 3),
    )
    mesh.rgba[3:6, 3] = 1

    def images(vertices, rgba, background, R, t):
        at = Frame(camera._replace(cam_from_world_R=R, cam_from_world_t=t), NEAR, max_layers)
        return peeling.peel(TranslucentMesh(vertices, rgba, mesh.faces), at, background)

    inputs = [mesh.vertices, mesh.rgba, BACKGROUND, camera.cam_from_world_R, camera.cam_from_world_t]
    peeled = images(*inputs)
    assert peeled.n_layers.max() == 3

    def function(*inputs):
        moved = images(*inputs)
        assert_array_equal(moved.n_layers, peeled.n_layers)  # or a difference would be no derivative
        return moved.image, moved.alpha

    def vjp(v_image, v_alpha):
        return tuple(peeling.peel_vjp(mesh, Frame(camera, NEAR, max_layers), BACKGROUND, peeled, v_image, v_alpha))

    check_jacobian(function, vjp, inputs, names=["vertices", "rgba", "background", "R", "t"])


# --- parity ---


@pytest.mark.parametrize("max_layers", [2, 1 << 30], ids=["two layers", "all"])
def test_kernels_are_the_reference(max_layers, rng):
    mesh, camera = soup(rng, 80), make_camera(50, 37, fx=60.0, fy=55.0, rng=rng)
    frame = frame_of(camera, max_layers=max_layers)
    (ours, v_ours), (theirs, v_theirs) = both(mesh, frame, rng)
    assert theirs.n_layers.max() > 5 and theirs.alpha.mean() > COVERAGE_MIN
    assert_allclose(ours.image, theirs.image, atol=PARITY_FLOAT64)
    assert_allclose(ours.alpha, theirs.alpha, atol=PARITY_FLOAT64)
    assert_array_equal(ours.n_layers, theirs.n_layers)
    assert_array_equal(ours.is_seen, theirs.is_seen)
    for a, b in zip(v_ours, v_theirs, strict=True):
        assert_allclose(a, b, atol=PARITY_FLOAT64 * np.abs(b).max())


@pytest.mark.parametrize("max_layers", [5, 1 << 30], ids=["five layers", "all"])
@pytest.mark.parametrize("n", [kernels.FEW, kernels.FEW + 1, 3 * kernels.FEW])
def test_few_and_many_layers_are_sorted(n, max_layers, rng):
    """By insertion and by a heap: cards whose depths are shuffled, two of them equal."""
    depths = rng.permutation(np.append(np.linspace(1, 4, n - 1), 2.5))
    shades = rng.uniform(0.02, 0.2, (3 * n, 4))
    mesh, frame = cards(depths, np.zeros((n, 4)))._replace(rgba=shades), frame_of(max_layers=max_layers)
    (ours, v_ours), (theirs, v_theirs) = both(mesh, frame, rng)
    assert theirs.n_layers.max() == n
    assert_allclose(ours.image, theirs.image, atol=PARITY_FLOAT64)
    for a, b in zip(v_ours, v_theirs, strict=True):
        assert_allclose(a, b, atol=PARITY_FLOAT64 * np.abs(b).max())


def test_fragments_are_the_same_with_and_without_room_for_boxes(rng, monkeypatch):
    mesh, frame = soup(rng, 80), frame_of()
    listed = [kernels.peel(mesh, frame, BACKGROUND).tape.fragments]
    monkeypatch.setattr(kernels, "ROOM_MAX", 0)
    listed.append(kernels.peel(mesh, frame, BACKGROUND).tape.fragments)
    assert len(listed[0].pixels) > 1000
    for ours, theirs in zip(*listed, strict=True):
        assert_array_equal(ours, theirs)


def test_float32_and_threads(rng):
    """Some pixels on an edge belong to another triangle in float32; all others are as near as those of 3DGS."""
    mesh, camera = soup(rng, 80), make_camera(50, 37, fx=60.0, fy=55.0, rng=rng)
    frame, v_image, v_alpha = frame_of(camera), rng.normal(size=(37, 50, 3)), rng.normal(size=(37, 50))
    theirs = reference.peel(mesh, frame, BACKGROUND)
    threads, results = numba.get_num_threads(), []
    try:
        for n in (1, min(2, threads)):
            numba.set_num_threads(n)
            peeled = kernels.peel(as_float32(mesh), frame, BACKGROUND)
            v = kernels.peel_vjp(as_float32(mesh), frame, BACKGROUND, peeled, v_image, v_alpha)
            results.append([array.tobytes() for array in (peeled.image, peeled.alpha, *v)])
    finally:
        numba.set_num_threads(threads)
    assert results[0] == results[1]
    assert peeled.image.dtype == np.float32
    assert_array_equal(peeled.n_layers, theirs.n_layers)
    assert_allclose(peeled.image, theirs.image, atol=PARITY_FLOAT32_IMAGE)
    for a, b in zip(v, reference.peel_vjp(mesh, frame, BACKGROUND, theirs, v_image, v_alpha), strict=True):
        assert_allclose(a, b, atol=PARITY_FLOAT32_GRADIENT * np.abs(b).max())


# --- hard triangles ---

ACROSS = np.array([[-3.0, -3, 3], [3, -3, 3], [0, 5, 3]])
HARD = {
    "edge on": [[0.3, -1.0, 2], [0.3 * 2, -1, 4], [0.3 * 1.5, 1, 3]],  # its plane holds the camera
    "nearly edge on": [[-1.0, 0.02, 1], [1, 0.02, 1], [0, 0.02, 50]],
    "no area": [[-1.0, 0, 3], [0, 0.1, 3], [1, 0.2, 3]],
    "a point": [[0.1, 0.1, 3.0]] * 3,
    "behind": [[-3.0, -3, -3], [3, -3, -3], [0, 5, -3]],
    "through the near plane": [[-1.0, -0.5, -1], [1, -0.5, 4], [0.2, 0.6, 4]],
    "around the camera": [[-4.0, -0.1, -2], [4, -0.1, -2], [0, -0.1, 9]],
    "through the camera": [[-1.0, 0, 0], [1, 0, 0], [0, 1, 5]],
    "huge": [[-1e6, -1e6, 10], [1e6, -1e6, 10], [0, 1e6, 1e6]],
    "a needle": [[-1.0, -1, 3], [1, 1.0, 3], [1, 1.0001, 3]],
    "not a number": [[np.nan, 0, 3], [1, 0, 3], [0, 1, 3]],
}
INVISIBLE = {"edge on", "no area", "a needle", "a point", "behind", "through the camera", "not a number"}


@pytest.mark.parametrize("name", HARD)
def test_hard_triangles_are_finite_and_the_same_in_both(name, rng):
    mesh = TranslucentMesh(
        np.concatenate([np.array(HARD[name]), ACROSS]), rng.uniform(0.1, 0.9, (6, 4)), np.arange(6).reshape(2, 3)
    )
    with np.errstate(invalid="ignore"):  # of what is not a number
        (ours, v_ours), (theirs, v_theirs) = both(mesh, frame_of(), rng)
    assert_array_equal(ours.n_layers, theirs.n_layers)
    assert ours.is_seen[0] == (name not in INVISIBLE) and ours.is_seen[1]
    assert np.isfinite(ours.image).all()
    assert_allclose(ours.image, theirs.image, atol=100 * PARITY_FLOAT64)
    if name != "not a number":
        for a, b in zip(v_ours, v_theirs, strict=True):
            assert np.isfinite(a).all()
            assert_allclose(a, b, atol=1e4 * PARITY_FLOAT64 * np.abs(b).max())  # of the needle: 1e4 wide


def test_a_triangle_through_the_near_plane_is_cut_there(peeling):
    """The floor below the camera: the rays that meet it beyond the near plane, and no others."""
    floor = TranslucentMesh(
        np.array(HARD["around the camera"]) * [1, -5, 1], np.full((3, 4), 0.5), np.array([[0, 1, 2]])
    )
    near = 2.5
    peeled = peeling.peel(floor, Frame(make_camera(), near), BACKGROUND)
    d = pinhole_rays(CENTERS[..., 0], CENTERS[..., 1], make_camera())
    t = 0.5 / d[..., 1]  # where the floor y = 0.5 is met
    x, z = t * d[..., 0], t
    expected = (t > near) & (np.abs(x) < 4 * (9 - z) / 11) & (z < 9)
    assert 20 < expected.sum() < (t > 0).sum()
    assert_array_equal(peeled.n_layers == 1, expected)


@pytest.mark.parametrize(("height", "is_drawn"), [(3e-8, True), (3e-10, False)])
def test_a_plane_that_all_but_holds_the_camera_is_not_drawn(peeling, height, is_drawn):
    """A floor so little below the camera that a row of pixels, which looks down as little, meets it at depth 3."""
    vertices = np.array([[-9.0, height, 1], [9, height, 1], [0, height, 50]])
    floor = TranslucentMesh(vertices, np.full((3, 4), 0.5), np.array([[0, 1, 2]]))
    peeled = peeling.peel(floor, frame_of(make_camera(cy=9.5 - 28 * height / 3)), BACKGROUND)
    assert (peeled.n_layers[9] == is_drawn).all()


def test_of_coincident_triangles_the_first_is_in_front(peeling):
    mesh = cards([3.0, 3.0], [[1, 0, 0, 0.6], [0, 1, 0, 0.5]])
    peeled = peeling.peel(mesh, frame_of(), np.zeros(3))
    assert_allclose(peeled.image, np.broadcast_to([0.6, 0.4 * 0.5, 0], (18, 24, 3)), atol=CLOSED_FORM)


def test_no_triangles(peeling):
    mesh = TranslucentMesh(np.zeros((0, 3)), np.zeros((0, 4)), np.zeros((0, 3), int))
    peeled = peeling.peel(mesh, frame_of(), BACKGROUND)
    assert_array_equal(peeled.image, np.broadcast_to(BACKGROUND, (18, 24, 3)))
    v = peeling.peel_vjp(mesh, frame_of(), BACKGROUND, peeled, np.ones((18, 24, 3)), np.ones((18, 24)))
    assert_allclose(v.background, 18 * 24)
    assert v.vertices.shape == (0, 3)


def test_a_mesh_of_numbers_out_of_range_is_refused(rng):
    mesh = soup(rng, 2)
    check_translucent(mesh, "x.ply")
    mesh.rgba[4, 3] = 1.5
    with pytest.raises(InputError, match=r"x.ply: opacity of vertex 4 is 1.5, not in \[0, 1\]"):
        check_translucent(mesh, "x.ply")
    with pytest.raises(InputError, match="a face has a vertex that does not exist"):
        check_translucent(mesh._replace(faces=mesh.faces + 1), "x.ply")
    assert_array_equal(to_bytes(np.array([-1, 0, 0.5, 1, 2])), [0, 0, 128, 255, 255])
