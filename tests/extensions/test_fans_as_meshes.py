"""MeshSplats: Gaussians as fans by hand, the renderer's gradients, files that trimesh opens, refits from end to end."""

import json
import sys

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from actions import act, scene_of, state_of
from data_tools.claims.fans.profile import fan_profile
from data_tools.claims.fans.shape_search import alpha_of, best_shape, render_clipped
from data_tools.foreign_files.gltf import glb_parts, only_primitive, values
from minisplat_ref.app.cli import main
from minisplat_ref.constants import SH_C0
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.datasets.synthetic.files import write_scene
from minisplat_ref.errors import InputError
from minisplat_ref.extensions.extension import find_recipe
from minisplat_ref.extensions.fans.mesh_files import load_fans, save_fans, write_mesh
from minisplat_ref.extensions.fans.model import (
    FANS_OF_GAUSSIANS,
    Fans,
    FanShape,
    convert_gaussians,
    keep_in_range,
    mesh_of,
    mesh_of_vjp,
    prune_faint_fans,
    render_fans,
    render_fans_vjp,
    stages,
    table,
    vertices_of,
    visible_mesh,
)
from minisplat_ref.io.ply import save_ply
from minisplat_ref.io.srgb import encode_srgb
from minisplat_ref.mechanisms.peeling.layers import TranslucentMesh
from minisplat_ref.oracle.gradients import jacobian_case
from minisplat_ref.oracle.pieces import SEED, tiny_setting
from minisplat_ref.reference.covariance import covariances
from minisplat_ref.rendering import Request
from minisplat_ref.rendering.backends import CPU, REFERENCE
from minisplat_ref.training.adam import zero_moments
from minisplat_ref.training.state import TrainState
from minisplat_ref.types import Gaussians, Model, view_from
from scenes import as_dtype, make_camera, make_gaussians
from tolerances import (
    CLOSED_FORM,
    COVERAGE_MIN,
    PARITY_FLOAT32_GRADIENT,
    PARITY_FLOAT64,
    PRINTED_DIGITS,
    ROUNDED_TO_FLOAT32,
)

FLAT, SOLID = FanShape(8, 2.5, 0.2), FanShape(8, 2.3, 0.1, is_flat=False)


def fans_of(rng, n, shape=FLAT, dtype=np.float64):
    return convert_gaussians(as_dtype(make_gaussians(rng, n, sh_degree=1), dtype), shape)


def pieces(rng, n, shape, backend, dtype=np.float64):
    """An image of fans, and its gradient for random cotangents."""
    fans, view = fans_of(rng, n, shape, dtype), view_from(make_camera(rng=rng))
    output, tape = render_fans(Model(fans), view, Request(np.full(3, 0.3), backend=backend))
    v_image, v_alpha = rng.normal(size=output.image.shape), rng.normal(size=output.alpha.shape)
    return output, render_fans_vjp(tape, v_image.astype(dtype), v_alpha.astype(dtype))


# --- shapes ---


def test_a_flat_fan_by_hand():
    """In the plane of the larger axes, here y and z; its colour is that of degree 0, the opacity falls to the rim."""
    one = Gaussians(
        means=np.array([[1.0, 2, 3]]),
        quats=np.array([[1.0, 0, 0, 0]]),
        log_scales=np.log([[1e-3, 2.0, 0.5]]),
        opacity_logits=np.array([np.log(3)]),
        sh_dc=np.array([[0.5, -3, 4]]),
        sh_rest=np.ones((1, 3, 3)),
    )
    fans = convert_gaussians(one, FanShape(4, 2.5, 0.2))
    corners = [[1, 2 + 5, 3], [1, 2, 3 + 1.25], [1, 2 - 5, 3], [1, 2, 3 - 1.25]]
    assert_allclose(vertices_of(fans)[0], [[1, 2, 3], *corners], rtol=CLOSED_FORM, atol=CLOSED_FORM)
    assert_allclose(fans.colors[0], np.tile([0.5 + 0.5 * SH_C0, 0, 1], (5, 1)), rtol=CLOSED_FORM)  # clipped
    assert_allclose(fans.opacities[0], [0.75, *[0.15] * 4], rtol=CLOSED_FORM)
    assert_array_equal(table(1, 4), [[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 1]])


@pytest.mark.parametrize("n_sides", [4, 8, 12])
def test_solid_fans_share_the_ends_of_the_axes(n_sides, rng):
    """On the ellipsoid of k deviations, in three planes, all vertices used; with 8 sides, 19 vertices, 24 triangles."""
    g = make_gaussians(rng, 5)
    fans = convert_gaussians(g, FanShape(n_sides, 2.3, 0.1, is_flat=False))
    assert fans.n_vertices == 1 + 3 * n_sides - 6
    triangles = table(*fans.rims.shape[1:3])
    assert triangles.shape == (3 * n_sides, 3)
    rim = vertices_of(fans)[:, 1:] - fans.means[:, None]
    inverses = np.linalg.inv(covariances(g.quats, np.exp(g.log_scales)))
    assert_allclose(np.einsum("nvi,nij,nvj->nv", rim, inverses, rim), 2.3**2, rtol=1e-9)  # of the inverses
    uses = np.bincount(triangles[:, 1:].ravel())[1:]
    assert (uses == 4).sum() == 6 and (uses == 2).sum() == 3 * n_sides - 12
    for ring in triangles.reshape(3, n_sides, 3):  # closed, and in one plane
        assert_array_equal(ring[:, 2], np.roll(ring[:, 1], -1))
        lengths = np.linalg.svd(vertices_of(fans)[:, ring[:, 1]] - fans.means[:, None], compute_uv=False)
        assert_allclose(lengths[:, 2], 0, atol=1e-12)
        turns = np.cross(rim[:, ring[:, 1] - 1], rim[:, ring[:, 2] - 1])
        assert (np.sum(turns * turns[:, :1], axis=2) > 0).all()  # all the way round, never back


@pytest.mark.parametrize("shape", [FLAT, SOLID], ids=["flat", "solid"])
def test_the_gradient_of_the_mesh_is_its_adjoint(shape, rng):
    fans = fans_of(rng, 4, shape)
    direction = Fans._make(rng.normal(size=field.shape) for field in fans)
    moved = mesh_of(direction)
    v_vertices, v_rgba = rng.normal(size=moved.vertices.shape), rng.normal(size=moved.rgba.shape)
    v = mesh_of_vjp(fans, v_vertices, v_rgba)
    expected = np.vdot(moved.vertices, v_vertices) + np.vdot(moved.rgba, v_rgba)
    assert_allclose(sum(np.vdot(a, b) for a, b in zip(v, direction, strict=True)), expected, rtol=CLOSED_FORM)


@pytest.mark.parametrize(
    ("shape", "named"),
    [
        (FanShape(2), "2 sides"),
        (FanShape(6, is_flat=False), "which are 6"),
        (FanShape(reach=0.0), "a rim 0 standard"),
        (FanShape(rim=1.5), "1.5 times the centre's"),
        (FanShape(rim=np.nan), "nan times"),
    ],
)
def test_shapes_that_are_none_are_refused(shape, named, rng):
    with pytest.raises(InputError, match=named):
        convert_gaussians(make_gaussians(rng, 2), shape)


# --- the profile ---


def test_a_fan_seen_from_the_front_has_the_profile(backend):
    """A disc that faces the camera: alpha at a pixel is o times the closed form, to the last digits."""
    one = as_dtype(
        Gaussians([[0.0, 0, 3]], [[1.0, 0, 0, 0]], np.log([[0.4, 0.4, 0.01]]), [1.0], [[0.0] * 3], np.zeros((1, 0, 3))),
        np.float64,
    )
    camera = make_camera(40, 30, fx=50.0, fy=50.0, cx=20.2, cy=15.1)
    alpha = alpha_of(convert_gaussians(one, FLAT), view_from(camera), backend=backend)
    x, y = np.meshgrid((np.arange(40) + 0.5 - 20.2) / 50 * 3 / 0.4, (np.arange(30) + 0.5 - 15.1) / 50 * 3 / 0.4)
    expected = fan_profile(np.stack([x, y], axis=-1), FLAT) / (1 + np.exp(-1))
    assert expected.max() > 0.7 and (expected == 0).any()
    assert_allclose(alpha, expected, atol=100 * CLOSED_FORM)


# --- the renderer ---


@pytest.mark.parametrize("checked", [REFERENCE, CPU], ids=lambda b: b.name)
def test_the_gradient_of_the_renderer(checked):
    """With respect to every vertex, colour and opacity, the background and the pose, in float64."""
    (stage,) = stages(checked, tiny_setting(), np.random.default_rng(SEED))
    case = jacobian_case(stage)
    assert case.passed, case
    assert set(stage.inputs) == {*Fans._fields, "background", "cam_from_world_R", "cam_from_world_t"}


@pytest.mark.parametrize("shape", [FLAT, SOLID], ids=["flat", "solid"])
def test_kernels_are_the_reference(shape):
    (ours, v_ours), (theirs, v_theirs) = (pieces(np.random.default_rng(1), 12, shape, b) for b in (CPU, REFERENCE))
    assert theirs.alpha.mean() > COVERAGE_MIN
    assert_allclose(ours.image, theirs.image, atol=PARITY_FLOAT64)
    assert_array_equal(ours.visible_ids, theirs.visible_ids)
    pairs = [*zip(v_ours.gaussians, v_theirs.gaussians, strict=True), (v_ours.means2d, v_theirs.means2d)]
    for a, b in pairs:
        assert_allclose(a, b, atol=10 * PARITY_FLOAT64 * np.abs(b).max())
    _, v_float32 = pieces(np.random.default_rng(1), 12, shape, CPU, np.float32)
    for a, b in zip(v_float32.gaussians, v_theirs.gaussians, strict=True):
        assert a.dtype == np.float32 and a.flags.c_contiguous
        assert_allclose(a, b, atol=PARITY_FLOAT32_GRADIENT * np.abs(b).max())


@pytest.mark.parametrize("axis", [0, 1])
def test_the_gradient_of_projected_centres_moves_a_whole_fan(axis, rng):
    fans, camera = fans_of(rng, 3), make_camera(rng=rng)
    view, request, step = view_from(camera), Request(backend=REFERENCE), 1e-5
    output, tape = render_fans(Model(fans), view, request)
    v_image = rng.normal(size=output.image.shape)
    v = render_fans_vjp(tape, v_image).means2d
    z = fans.means @ camera.cam_from_world_R[2] + camera.cam_from_world_t[2]
    per_pixel = camera.cam_from_world_R[axis] * z[1] / (camera.fx, camera.fy)[axis]  # world units of fan 1

    def loss(shift):
        means, rims = fans.means.copy(), fans.rims.copy()
        means[1] += shift * per_pixel
        rims[1] += shift * per_pixel
        return np.vdot(render_fans(Model(fans._replace(means=means, rims=rims)), view, request)[0].image, v_image)

    assert abs(v[1, axis]) > 1e-2
    assert (loss(step) - loss(-step)) / (2 * step) == pytest.approx(v[1, axis], rel=1e-4)


def test_rows_that_are_not_drawn(backend, rng):
    fans, view = fans_of(rng, 9), view_from(make_camera())
    is_visible = np.arange(9) % 2 == 0
    some, tape = render_fans(Model(fans), view, Request(backend=backend, is_visible=is_visible))
    alone, _ = render_fans(Model(Fans._make(f[is_visible] for f in fans)), view, Request(backend=backend))
    assert_array_equal(some.image, alone.image)
    assert set(some.visible_ids) <= {0, 2, 4, 6, 8} and len(some.visible_ids) == len(alone.visible_ids) > 2
    v = render_fans_vjp(tape, np.ones_like(some.image))
    assert not v.gaussians.rims[1::2].any() and v.gaussians.rims[0].any()


def test_what_is_not_drawn_is_refused(rng):
    model, view = Model(fans_of(rng, 2)), view_from(make_camera())
    with pytest.raises(InputError, match="without depth"):
        render_fans(model, view, Request(wants=frozenset({"depth"})))
    with pytest.raises(InputError, match="max_layers is 0"):
        render_fans(model, view, Request(), max_layers=0)


# --- training ---


def test_colors_stay_in_range_and_faint_fans_go(rng):
    fans = fans_of(rng, 6, dtype=np.float32)
    fans.opacities[2], fans.opacities[4, 0], fans.colors[0, 3] = 0.01, 1.7, [-1.0, 0.5, 2.0]
    state = TrainState(fans, zero_moments(fans), 0, [], rng, {})
    keep_in_range(state, None)
    assert state.gaussians.opacities[4, 0] == 1
    assert_array_equal(state.gaussians.colors[0, 3], [0, 0.5, 1])
    prune_faint_fans(state, None, min_opacity=0.02)
    assert_array_equal(state.gaussians.means, fans.means[[0, 1, 3, 4, 5]])
    assert state.adam.first.rims.shape == (5, 1, 8, 3)


def test_a_fan_goes_once_its_most_opaque_vertex_is_below_two_hundredths(rng):
    fans = fans_of(rng, 4, dtype=np.float32)
    fans.opacities[:] = [[0.9] + [0.0] * 8, [0.019] * 9, [0.0] * 8 + [0.021], [0.0] * 9]
    state = state_of(fans)
    act(find_recipe("fans"), prune_faint_fans, state, scene_of())
    assert_array_equal(state.gaussians.means, fans.means[[0, 2]])


def test_the_best_shape_is_found_again(rng):
    """Images of fans themselves, of another reach and rim than where the search begins."""
    g, view = make_gaussians(rng, 8), view_from(make_camera())
    target = render_clipped(convert_gaussians(g, FanShape(8, 2.0, 0.15)), view)
    found = best_shape(g, FanShape(), [view], [target], np.zeros(3))
    assert found.reach == pytest.approx(2.0, abs=0.05) and found.rim == pytest.approx(0.15, abs=0.05)


# --- files ---


@pytest.mark.parametrize("shape", [FLAT, SOLID, FanShape(4, is_flat=False), FanShape(3)], ids=str)
@pytest.mark.parametrize("n", [1, 7])
def test_a_population_goes_through_its_ply(shape, n, rng, tmp_path):
    fans = fans_of(rng, n, shape, np.float32)
    save_fans(tmp_path / "fans.ply", fans)
    loaded = load_fans(tmp_path / "fans.ply", Fans)
    for a, b in zip(loaded, fans, strict=True):
        assert a.shape == b.shape and a.tobytes() == b.tobytes()


def test_no_fans_go_through_a_ply(rng, tmp_path):
    save_fans(tmp_path / "none.ply", fans_of(rng, 0, dtype=np.float32))
    assert len(load_fans(tmp_path / "none.ply").means) == 0


def test_other_meshes_are_no_fans(rng, tmp_path):
    fans, path = fans_of(rng, 3, dtype=np.float32), tmp_path / "x.ply"
    write_mesh(path, mesh_of(fans))
    with pytest.raises(InputError, match="no property rgba_0"):
        load_fans(path)
    fans.opacities[1, 2] = 1.5
    save_fans(path, fans)
    with pytest.raises(InputError, match=r"opacity of vertex 11 is 1.5, not in \[0, 1\]"):
        load_fans(path)
    fans.opacities[1, 2] = 0.5
    save_fans(path, fans)
    content = path.read_bytes()
    last, before = content[-13:], content[-26:-13]  # a count of one byte and three corners each
    path.write_bytes(content[:-26] + last + before)
    with pytest.raises(InputError, match="its triangles are not those of 3 fans"):
        load_fans(path)
    path.write_bytes(content[:-26].replace(b"element face 24", b"element face 22"))
    with pytest.raises(InputError, match="its faces make no fans"):
        load_fans(path)


def test_faint_triangles_are_left_out(rng):
    fans = fans_of(rng, 3)
    fans.opacities[1], fans.opacities[2, :3] = 0.001, 0.0  # all of fan 1; the centre of fan 2 and one side
    whole, mesh = mesh_of(fans), visible_mesh(mesh_of(fans), 1 / 255)
    assert len(mesh.faces) == len(whole.faces) - 8 - 1 and len(mesh.vertices) == len(whole.vertices) - 9
    kept = (whole.rgba[whole.faces, 3] >= 1 / 255).any(axis=1)
    assert_array_equal(mesh.vertices[mesh.faces], whole.vertices[whole.faces[kept]])


# --- from end to end ---

SCENE = {"n_views": 6, "width": 32, "height": 24, "n_points": 60, "test_every": 4}


@pytest.fixture(scope="module")
def scene_folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scenes") / "nook"
    write_scene(make_scene("room", supersampling=1, **SCENE), folder, SCENE)
    return folder


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    path = tmp_path_factory.mktemp("models") / "point_cloud.ply"
    save_ply(path, as_dtype(make_gaussians(np.random.default_rng(3), 40), np.float32))
    return path


@pytest.mark.parametrize("suffix", ["ply", "glb", "obj"])
def test_trimesh_opens_what_is_exported(suffix, model, tmp_path, capsys):
    trimesh = pytest.importorskip("trimesh")
    out = tmp_path / f"mesh.{suffix}"
    assert main(["fans", "export", str(model), str(out), "--sides", "8", "--solid", "--rim", "0.2"]) == 0
    told = capsys.readouterr()
    assert "40 fans in" in told.out and "960 triangles, 760 vertices" in told.out
    assert ("opaque" in told.err) == (suffix == "obj")
    (opened,) = trimesh.load_scene(out, process=False).geometry.values()
    assert len(opened.faces) == 960 and len(opened.vertices) == 760
    fans = convert_gaussians(
        as_dtype(make_gaussians(np.random.default_rng(3), 40), np.float32), FanShape(8, 3.0, 0.2, False)
    )
    mesh = mesh_of(fans)
    turned = mesh.vertices * ([-1, -1, 1] if suffix == "glb" else 1)
    assert_allclose(opened.vertices[opened.faces], turned[mesh.faces], atol=1e-6)
    if suffix == "glb":
        assert opened.visual.material.alphaMode == "BLEND" and opened.visual.material.doubleSided
        rgba = 255 * np.asarray(opened.visual.vertex_attributes["color"])
        rgba[:, :3] = 255 * encode_srgb(rgba[:, :3] / 255)
    else:
        rgba = opened.visual.vertex_colors
    n_channels = 3 if suffix == "obj" else 4
    expected = np.rint(255 * mesh.rgba[mesh.faces][..., :n_channels])
    assert_allclose(np.asarray(rgba)[opened.faces][..., :n_channels], expected, atol=1)


def test_gltf_has_linear_colours_and_opacities_as_they_are(tmp_path):
    """Of an opacity of 0.5, 0.5; of the colour 0.5, 0.2140. It blends, is seen from both sides, and is not lit."""
    pytest.importorskip("trimesh")
    rgba = np.array([[0.5, 0.04, 1.0, 0.5], [0.0, 0.5, 0.5, 0.04], [1.0, 1.0, 0.0, 1.0]])
    mesh = TranslucentMesh(np.array([[1.0, 2, 3], [2, 2, 3], [1, 3, 4]]), rgba, np.array([[0, 1, 2]]))
    write_mesh(tmp_path / "mesh.glb", mesh)
    document, body = glb_parts((tmp_path / "mesh.glb").read_bytes())
    primitive, material = only_primitive(document)
    positions, colors = (values(document, body, primitive["attributes"][name]) for name in ("POSITION", "COLOR_0"))
    assert_array_equal(positions, [[-1, -2, 3], [-2, -2, 3], [-1, -3, 4]])
    half, dark = 0.21404114, 0.04 / 12.92
    by_hand = [[half, dark, 1, 0.5], [0, half, half, 0.04], [1, 1, 0, 1]]
    assert_allclose(colors, by_hand, rtol=ROUNDED_TO_FLOAT32)
    assert material == {
        "pbrMetallicRoughness": {"metallicFactor": 0, "roughnessFactor": 1},
        "extensions": {"KHR_materials_unlit": {}},
        "alphaMode": "BLEND",
        "doubleSided": True,
    }
    assert document["extensionsUsed"] == ["KHR_materials_unlit"] and "extensionsRequired" not in document


def test_without_trimesh_a_line_says_how_to_get_it(model, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "trimesh", None)
    out = tmp_path / "mesh.glb"
    assert main(["fans", "export", str(model), str(out)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "pip install 'minisplat_ref[meshes]'" in line and not any(tmp_path.iterdir())
    assert main(["fans", "export", str(model), str(tmp_path / "mesh.ply")]) == 0


def test_a_scene_is_refitted_drawn_and_exported(scene_folder, tmp_path, capsys):
    """From a plain run: its fans gain by training, render and export read them, and are no Gaussians to others."""
    run, fans, again = tmp_path / "plain", tmp_path / "fans.ply", tmp_path / "again.ply"
    options = ["--recipe", "3dgs-accel", "--test-every", "4", "--iterations", "40", "--out", str(run)]
    assert main(["train", str(scene_folder), *options]) == 0
    capsys.readouterr()
    tune = ["fans", "fine-tune", str(scene_folder), str(run), str(fans), "--iterations", "40"]
    assert main(tune) == 0
    before, after = (float(line.split(" dB")[0].split()[-1]) for line in capsys.readouterr().out.splitlines())
    assert after > before + 0.2
    assert main([*tune[:4], str(again), *tune[5:]]) == 0 and again.read_bytes() == fans.read_bytes()
    cameras = ["--cameras", str(run / "cameras.json")]
    assert main(["render", str(fans), *cameras, "--out", str(tmp_path / "images")]) == 0
    command = ["render", str(fans), *cameras, "--depth", "--out", str(tmp_path / "depths")]
    assert main(command) == 2 and not (tmp_path / "depths").exists()
    assert len(list((tmp_path / "images").glob("*.png"))) == 8
    capsys.readouterr()
    assert main(["fans", "export", str(fans), str(tmp_path / "mesh.ply")]) == 0
    assert f"{len(load_fans(fans).means):,} fans in" in capsys.readouterr().out
    assert main(["info", str(fans)]) == 0 and main(["info", str(tmp_path / "mesh.ply")]) == 2  # which is for others


def test_fans_are_trained_and_measured_before_the_background_of_their_run(scene_folder, tmp_path, capsys):
    run, out = tmp_path / "white", tmp_path / "fans.ply"
    options = ["--recipe", "3dgs-accel", "--background", "255,255,255", "--test-every", "4", "--iterations", "5"]
    assert main(["train", str(scene_folder), *options, "--out", str(run)]) == 0
    printed, bytes_of = {}, {}
    for name, background in (("its own", []), ("white", ["255,255,255"]), ("black", ["0,0,0"])):
        given = ["--background", *background] if background else []
        capsys.readouterr()
        assert main(["fans", "fine-tune", str(scene_folder), str(run), str(out), "--iterations", "2", *given]) == 0
        printed[name], bytes_of[name] = capsys.readouterr().out, out.read_bytes()
    assert printed["its own"] == printed["white"] and printed["black"].split(",")[1] != printed["white"].split(",")[1]
    assert bytes_of["its own"] == bytes_of["white"] != bytes_of["black"]


def test_the_recipe_trains_from_points_resumes_and_is_measured(scene_folder, tmp_path, capsys):
    run = tmp_path / "run"
    options = ["--recipe", "fans", "--test-every", "4", "--set", "n_sides=6", "--set", "max_layers=8"]
    assert main(["train", str(scene_folder), *options, "--iterations", "30", "--out", str(run)]) == 0
    assert main(["train", "--resume", str(run), "--iterations", "40"]) == 0
    losses = [json.loads(line)["loss"] for line in (run / "log.jsonl").read_text().splitlines()]
    assert losses[-1] < losses[0]
    assert load_fans(run / "point_cloud.ply").rims.shape[1:] == (1, 6, 3)
    psnr = json.loads((run / "metrics.json").read_text())["psnr"]
    capsys.readouterr()
    assert main(["eval", str(run)]) == 0
    assert json.loads((run / "metrics.json").read_text())["psnr"] == pytest.approx(psnr, abs=PRINTED_DIGITS)


@pytest.mark.parametrize(
    ("options", "named"),
    [
        (["mesh.stl"], "ends in .ply, .glb, .obj"),
        (["mesh.ply", "--sides", "2"], "2 sides"),
        (["mesh.ply", "--rim", "1.2"], "1.2 times"),
        (["mesh.ply", "--reach", "-1"], "-1 standard"),
        (["mesh.ply", "--solid", "--sides", "6"], "which are 6"),
        (["mesh.ply", "--min-opacity", "2"], "--min-opacity"),
        (["nowhere/mesh.ply"], "nowhere"),
    ],
)
def test_bad_input_is_one_line(options, named, model, tmp_path, capsys):
    command = ["fans", "export", str(model), str(tmp_path / options[0]), *options[1:]]
    assert main(command) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert named in line and not any(tmp_path.iterdir())


def test_models_that_hold_nothing_are_refused(model, scene_folder, tmp_path, capsys):
    none, out = tmp_path / "none.ply", tmp_path / "out.ply"
    for save, empty in ((save_ply, make_gaussians(np.random.default_rng(0), 0)), (save_fans, None)):
        if empty is None:
            empty = fans_of(np.random.default_rng(0), 0, dtype=np.float32)
        save(none, empty)
        for command in (["export", str(none), str(out)], ["fine-tune", str(scene_folder), str(none), str(out)]):
            assert main(["fans", *command]) == 2
            (line,) = capsys.readouterr().err.splitlines()
            assert "none.ply holds no" in line and not out.exists()
    tune = ["fans", "fine-tune", str(scene_folder), str(model)]
    assert main([*tune, str(tmp_path / "out.glb")]) == 2 and "fans export" in capsys.readouterr().err
    white = ["fans", "fine-tune", "room", str(model), str(out), "--background", "255,255,255"]
    assert main(white) == 2 and "room is made on black" in capsys.readouterr().err and not out.exists()
    with pytest.raises(SystemExit, match="2"):
        main([*tune, str(out), "--iterations", "0"])
    assert "--iterations" in capsys.readouterr().err


def test_fans_of_sparse_points_face_everywhere(rng):
    """Points are balls at first; no direction sees more than a few of their fans edge on."""
    balls = make_gaussians(rng, 500)._replace(
        log_scales=np.full((500, 3), -3.0), quats=np.tile([1.0, 0, 0, 0], (500, 1))
    )
    fans = FANS_OF_GAUSSIANS.extend(balls, rng)
    spans = fans.rims[:, 0, [0, 2]] - fans.means[:, None]  # [N, 2, 3] of eight sides, a quarter of a turn apart
    normals = np.cross(spans[:, 0], spans[:, 1])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    for direction in np.eye(3):
        # |n . d| of evenly spread normals is uniform in [0, 1].
        assert np.quantile(np.abs(normals @ direction), [0.25, 0.5, 0.75]) == pytest.approx([0.25, 0.5, 0.75], abs=0.1)


def test_its_representation_draws_fans():
    assert FANS_OF_GAUSSIANS.renderer.channels(frozenset({"depth"})) == {"rgb": slice(0, 3)}
