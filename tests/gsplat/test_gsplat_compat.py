import dataclasses
import re
import weakref
from collections.abc import Mapping
from importlib import import_module

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import minisplat_ref
from gradcheck import check_inner_products, check_jacobian
from minisplat_ref import rasterization, rasterization_vjp
from minisplat_ref.constants import GSPLAT_MAIN, INRIA
from minisplat_ref.errors import InputError
from minisplat_ref.gsplat.call import TILE_LISTS
from minisplat_ref.reference.tiling import bin_gaussians
from minisplat_ref.rendering import render
from minisplat_ref.rendering.backends import REFERENCE, get_backend
from minisplat_ref.types import Camera, TileGrid
from minisplat_ref.validation import check_gaussians
from scenes import activated, as_dtype, make_camera, make_gaussians
from tolerances import (
    CLOSED_FORM,
    COVERAGE_MIN,
    GRADIENT_FLOOR,
    GRADIENT_STEP_IMAGE,
    PARITY_FLOAT32_GRADIENT,
    PARITY_FLOAT32_IMAGE,
    PARITY_FLOAT64,
)

WIDTH, HEIGHT = 24, 18
ARRAYS = ("means", "quats", "scales", "opacities", "colors", "viewmats", "Ks")
both_backends = pytest.mark.parametrize("name", ["reference", "cpu"])


def make_scene(rng, n=12, *, channels=3, n_cameras=2, sh_degree=None, own_colors=False, dtype=np.float64):
    """Arguments of `rasterization`, up to Ks, by name."""
    means, quats, scales, opacities = activated(make_gaussians(rng, n, size=0.25))
    shape = (n, channels) if sh_degree is None else (n, (sh_degree + 1) ** 2, 3)
    colors = rng.normal(size=(n_cameras, *shape) if own_colors else shape)
    viewmats, Ks = np.tile(np.eye(4), (n_cameras, 1, 1)), np.tile(np.eye(3), (n_cameras, 1, 1))
    for viewmat, K in zip(viewmats, Ks, strict=True):
        camera = make_camera(WIDTH, HEIGHT, cx=11.0, cy=10.0, rng=rng)
        viewmat[:3, :3], viewmat[:3, 3] = camera.cam_from_world_R, camera.cam_from_world_t
        K[0, 0], K[1, 1], K[0, 2], K[1, 2] = camera.fx, camera.fy, camera.cx, camera.cy
    arrays = (means, quats, scales, opacities, colors, viewmats, Ks)
    return {key: array.astype(dtype) for key, array in zip(ARRAYS, arrays, strict=True)}


def call(scene, **options):
    return rasterization(**scene, width=WIDTH, height=HEIGHT, **options)


# --- closed form ---


@pytest.mark.parametrize("profile", [GSPLAT_MAIN, "GSPLAT_MAIN"], ids=["value", "name"])
@both_backends
def test_one_pixel_by_hand(name, profile):
    # As in test_render: a ball of 2 px on the axis at z = 3, seen at its centre and two pixels beside it.
    arrays = {
        "means": np.array([[0.0, 0, 3]]),
        "quats": np.array([[2.0, 0, 0, 0]]),
        "scales": np.full((1, 3), 0.2),
        "opacities": np.array([0.75]),
        "colors": np.array([[1.0, 0.5, -2]]),
        "viewmats": np.eye(4)[None],
        "Ks": np.array([[[30.0, 0, 4.5], [0, 30, 4.5], [0, 0, 1]]]),
    }
    background = np.array([[0.2, 0.5, 0.9]])
    options = {"width": 9, "height": 9, "backend": name, "profile": profile}
    both, alphas, meta = rasterization(**arrays, **options, backgrounds=background, render_mode="RGB+D")
    expected, _, _ = rasterization(**arrays, **options, render_mode="ED")
    for x, alpha in ((4, 0.75), (6, 0.75 * np.exp(-0.5 * 4 / 4.3))):
        color = alpha * arrays["colors"][0] + (1 - alpha) * background[0]
        assert_allclose(alphas[0, 4, x], [alpha], rtol=CLOSED_FORM)
        assert_allclose(both[0, 4, x], [*color, 3 * alpha], rtol=CLOSED_FORM)
        assert_allclose(expected[0, 4, x], [3], rtol=CLOSED_FORM)
    assert_allclose(meta["means2d"], [[[4.5, 4.5]]], rtol=CLOSED_FORM)
    assert_allclose(meta["conics"], [[[1 / 4.3, 0, 1 / 4.3]]], rtol=CLOSED_FORM, atol=CLOSED_FORM)
    assert_array_equal(meta["radii"], [[[7, 7]]])  # ceil(sqrt(2 ln(255 * 0.75)) * sqrt(4.3)) = ceil(6.7)


@both_backends
def test_shapes_dtypes_and_meta(name, rng):
    for dtype in (np.float32, np.float64):
        scene = make_scene(rng, dtype=dtype)
        colors, alphas, meta = call(scene, backend=name)
        assert colors.shape == (2, HEIGHT, WIDTH, 3) and alphas.shape == (2, HEIGHT, WIDTH, 1)
        assert colors.dtype == alphas.dtype == dtype and alphas.mean() > COVERAGE_MIN
        shapes = {"means2d": (2, 12, 2), "depths": (2, 12), "conics": (2, 12, 3), "opacities": (2, 12)}
        assert {key: meta[key].shape for key in shapes} == shapes
        assert {meta[key].dtype for key in shapes} == {np.dtype(dtype)}
        assert meta["radii"].shape == (2, 12, 2) and meta["radii"].dtype == np.int32
        numbers = {"tile_size": 16, "tile_width": 2, "tile_height": 2, "width": WIDTH, "height": HEIGHT, "n_cameras": 2}
        assert {key: meta[key] for key in numbers} == numbers
        gradients = rasterization_vjp(
            **scene, width=WIDTH, height=HEIGHT, backend=name, v_render_colors=colors, v_render_alphas=alphas
        )
        assert list(gradients) == [f"v_{key}" for key in ARRAYS[:-1]]
        for key in ARRAYS[:-1]:
            assert gradients[f"v_{key}"].shape == scene[key].shape and gradients[f"v_{key}"].dtype == dtype
        assert not gradients["v_viewmats"][:, 3].any()


def test_meta_lists_hold_what_each_tile_may_touch(rng):
    # 24 x 18 pixels are 2 x 2 tiles of 16; a box is the centre -+ the radii, rounded outwards.
    _, _, meta = call(make_scene(rng, 20), backend="reference")
    ids, offsets = meta["flatten_ids"], meta["isect_offsets"]
    assert offsets.shape == (2, 2, 2) and meta["tiles_per_gauss"].sum() == ids.size > 40
    ends = np.append(offsets.ravel()[1:], ids.size).reshape(offsets.shape)
    for c, row, column in np.ndindex(offsets.shape):
        low = np.floor(meta["means2d"][c] - meta["radii"][c]) // 16
        high = (np.ceil(meta["means2d"][c] + meta["radii"][c]) - 1) // 16
        tile = np.array([column, row])
        touches = (meta["radii"][c, :, 0] > 0) & (low <= tile).all(axis=1) & (tile <= high).all(axis=1)
        by_depth = np.argsort(meta["depths"][c], kind="stable")
        assert_array_equal(ids[offsets[c, row, column] : ends[c, row, column]], c * 20 + by_depth[touches[by_depth]])


def expected_lists(scene, backend):
    """The three lists of the meta, made eagerly from every camera's projection."""
    grid, bins = TileGrid(WIDTH, HEIGHT, 16, 16), []
    for viewmat, K in zip(scene["viewmats"], scene["Ks"], strict=True):
        camera = Camera(viewmat[:3, :3], viewmat[:3, 3], K[0, 0], K[1, 1], K[0, 2], K[1, 2], WIDTH, HEIGHT)
        projection = backend.project(*(scene[key] for key in ARRAYS[:4]), camera, GSPLAT_MAIN)
        bins.append(bin_gaussians(projection, grid, GSPLAT_MAIN))
    n, starts = len(scene["means"]), np.cumsum([0, *(len(lists.gaussian_ids) for lists in bins)])
    return {
        "tiles_per_gauss": np.array([np.diff(lists.gaussian_offsets) for lists in bins], np.int32),
        "flatten_ids": np.concatenate([c * n + lists.gaussian_ids for c, lists in enumerate(bins)], dtype=np.int32),
        "isect_offsets": np.array(
            [(starts[c] + lists.tile_offsets[:-1]).reshape(2, 2) for c, lists in enumerate(bins)], np.int32
        ),
    }


@pytest.mark.parametrize("n_cameras", [1, 2])
@both_backends
def test_tile_lists_are_the_references(name, n_cameras, rng):
    scene = make_scene(rng, 20, n_cameras=n_cameras)
    _, _, meta = call(scene, backend=name)
    for key, expected in expected_lists(scene, get_backend(name)).items():
        assert expected.size and expected.any() and meta[key].dtype == np.int32
        assert_array_equal(meta[key], expected, strict=True, err_msg=key)


@pytest.mark.parametrize("first", TILE_LISTS)
def test_tile_lists_are_made_once_and_only_when_read(first, rng, monkeypatch):
    n_calls = 0

    def counted(*args):
        nonlocal n_calls
        n_calls += 1
        return bin_gaussians(*args)

    monkeypatch.setattr(minisplat_ref.gsplat.call, "bin_gaussians", counted)
    _, _, meta = call(make_scene(rng), backend="cpu")
    assert set(TILE_LISTS) < set(meta) and first in meta and first in meta.keys() and len(meta) == 15
    assert first in repr(meta) and "isect_ids" not in meta and meta.get("isect_ids") is None
    assert meta["depths"].any() and meta["n_cameras"] == 2
    assert n_calls == 0
    values = meta[first]
    assert n_calls == 2  # one for each camera
    assert meta[first] is values and all(meta[key].any() for key in TILE_LISTS)
    assert n_calls == 2


def test_meta_is_a_mapping_that_cannot_be_written_to(rng):
    _, _, meta = call(make_scene(rng), backend="reference")
    assert isinstance(meta, Mapping)
    copy = dict(meta)
    assert list(copy) == list(meta) == list(meta.keys()) and len(copy) == len(meta)
    assert all(copy[key] is value is meta[key] for key, value in meta.items())
    assert not any(value is None for value in {**meta}.values())
    with pytest.raises(KeyError, match="isect_ids"):
        meta["isect_ids"]
    with pytest.raises(TypeError, match="item assignment"):
        meta["depths"] = 0


def test_tile_lists_do_not_see_what_a_caller_writes_into_the_meta(rng):
    scene = make_scene(rng, n_cameras=1)
    _, _, meta = call(scene, backend="reference")
    for key in ("means2d", "depths", "opacities", "radii", "conics"):
        meta[key][:] = 0
    assert_array_equal(meta["flatten_ids"], expected_lists(scene, REFERENCE)["flatten_ids"])


def test_meta_keeps_alive_what_the_lists_need_and_no_more(rng):
    needed, others = [], []

    def watched(projection, channels, background, bins, *args, **options):
        output = REFERENCE.composite(projection, channels, background, bins, *args, **options)
        needed.extend(map(weakref.ref, (projection.boxes, projection.depths)))
        rest = (projection.means2d, projection.conics, projection.radii, channels, bins.gaussian_ids, output.image)
        others.extend(map(weakref.ref, rest))
        return output

    backend = dataclasses.replace(REFERENCE, composite=watched)
    _, _, meta = call(make_scene(rng), backend=backend)
    assert len(others) == 12 and not any(reference() is not None for reference in others)
    assert all(reference() is not None for reference in needed)
    assert meta["flatten_ids"].size
    assert not any(reference() is not None for reference in needed)


@pytest.mark.parametrize("mode", ["RGB", "RGB+ED"])
@both_backends
def test_result_belongs_to_the_caller(name, mode, rng):
    scene = make_scene(rng, n_cameras=1)
    options = {"render_mode": mode, "backend": name, "backgrounds": rng.uniform(size=(1, 3))}
    before = {key: array.copy() for key, array in scene.items()}
    *results, meta = call(scene, **options)
    again = [array.copy() for array in results]
    for array in (*results, *(value for value in meta.values() if isinstance(value, np.ndarray))):
        array[:] = 7
    assert all(np.array_equal(scene[key], array) for key, array in before.items())
    for array, expected in zip(call(scene, **options)[:2], again, strict=True):
        assert_array_equal(array, expected)


def test_modes_agree_with_each_other(rng):
    scene = make_scene(rng)
    images = {
        mode: call(scene, backend="reference", render_mode=mode) for mode in ("RGB", "D", "ED", "RGB+D", "RGB+ED")
    }
    colors, depths, alphas = images["RGB"][0], images["D"][0], images["RGB"][1]
    assert depths.shape == (2, HEIGHT, WIDTH, 1) and (alphas == 0).any()
    assert_allclose(images["RGB+D"][0], np.concatenate([colors, depths], axis=3), rtol=CLOSED_FORM)
    assert_allclose(images["RGB+ED"][0], np.concatenate([colors, images["ED"][0]], axis=3), rtol=CLOSED_FORM)
    assert_allclose(images["ED"][0] * alphas, depths, rtol=CLOSED_FORM)
    assert_array_equal(images["ED"][0][alphas == 0], 0)


@pytest.mark.parametrize("channels", [1, 5])
@both_backends
def test_channels_are_independent(name, channels, rng):
    scene = make_scene(rng, channels=channels)
    images, _, _ = call(scene, backend=name)
    assert images.shape == (2, HEIGHT, WIDTH, channels)
    for k in {0, channels - 1}:
        three = np.repeat(scene["colors"][:, k : k + 1], 3, axis=1)
        same = call(scene | {"colors": three}, backend=name)[0][..., 0]
        assert_allclose(images[..., k], same, rtol=0, atol=PARITY_FLOAT64 * np.abs(same).max())


@pytest.mark.parametrize("sh_degree", [None, 1], ids=["colors", "sh"])
def test_every_camera_its_own_colors(sh_degree, rng):
    scene = make_scene(rng, sh_degree=sh_degree, own_colors=True)
    options = {"sh_degree": sh_degree, "backend": "reference"}
    images, _, _ = call(scene, **options)
    for c in range(2):
        one, _, _ = call(scene | {"colors": scene["colors"][c]}, **options)
        assert_array_equal(images[c], one[c])
        assert (images[1 - c] != one[1 - c]).any()


@pytest.mark.parametrize("sh_degree", [0, 1, 2, 3])
@both_backends
def test_spherical_harmonics_as_render_has_them(name, sh_degree, rng):
    gaussians = make_gaussians(rng, 12, size=0.25)
    scene = make_scene(rng, sh_degree=3, n_cameras=1)
    scene |= dict(zip(ARRAYS[:4], activated(gaussians), strict=True))
    scene["colors"] = np.concatenate([gaussians.sh_dc[:, None], gaussians.sh_rest], axis=1)
    image, alphas, _ = call(scene, sh_degree=sh_degree, backend=name)
    viewmat, K = scene["viewmats"][0], scene["Ks"][0]
    camera = Camera(viewmat[:3, :3], viewmat[:3, 3], K[0, 0], K[1, 1], K[0, 2], K[1, 2], WIDTH, HEIGHT)
    output, _ = render(gaussians, camera, sh_degree=sh_degree, backend=REFERENCE)
    assert output.alpha.mean() > COVERAGE_MIN
    assert_allclose(image[0], output.image, rtol=0, atol=PARITY_FLOAT64 * output.image.max())
    assert_allclose(alphas[0, ..., 0], output.alpha, rtol=0, atol=PARITY_FLOAT64)


@both_backends
def test_camera_frame_in_other_units_shows_the_same_image(name, rng):
    # R and t doubled: every slope and the centre -R^-1 t stay, depths double.
    scene = make_scene(rng, sh_degree=2)
    doubled = scene | {"viewmats": scene["viewmats"] * np.array([2.0, 2, 2, 1])[:, None]}
    one, two = (call(s, sh_degree=2, render_mode="RGB+ED", backend=name)[0] for s in (scene, doubled))
    assert_allclose(two, one * [1, 1, 1, 2], rtol=0, atol=PARITY_FLOAT64 * two.max())


def test_options_replace_the_profile(rng):
    scene = make_scene(rng, n_cameras=1)
    _, _, meta = call(scene, backend="reference")
    depths = np.sort(meta["depths"][0])
    _, _, cut = call(scene, backend="reference", near_plane=depths[2], far_plane=depths[-2])
    assert (cut["radii"][0, :, 0] > 0).sum() == (meta["radii"][0, :, 0] > 0).sum() - 5
    _, blurred, _ = call(scene, backend="reference", eps2d=3.0)
    _, antialiased, thin = call(scene, backend="reference", eps2d=3.0, rasterize_mode="antialiased")
    assert antialiased.sum() < blurred.sum() and (thin["opacities"] <= meta["opacities"]).all()
    centred, _, inria = call(scene, backend="reference", profile="INRIA")
    assert_allclose(inria["means2d"] - meta["means2d"], np.tile([1.0, -1.0], (1, 12, 1)), rtol=1e-9)  # cx 11, cy 10
    assert_array_equal(call(scene, backend=REFERENCE, profile=INRIA)[0], centred)


def test_name_is_the_function_whatever_is_imported_first():
    import_module("minisplat_ref.gsplat.call")
    assert minisplat_ref.rasterization is minisplat_ref.gsplat.call.rasterization is rasterization
    assert minisplat_ref.rasterization_vjp is rasterization_vjp


# --- gradient ---


def call_with_gradient(scene, cotangents=None, **options):
    """Function of (means .. colors, viewmats [C, 3, 4], backgrounds) and, with cotangents, its gradients.

    The last row of a view matrix is no variable: it is dropped here.
    """
    keys = ARRAYS[:6]

    def arguments(*inputs):
        *arrays, views, backgrounds = inputs
        rows = np.broadcast_to([0.0, 0, 0, 1], (len(views), 1, 4))
        viewmats = np.concatenate([views, rows], axis=1)
        named = dict(zip(keys, (*arrays, viewmats), strict=True)) | {"Ks": scene["Ks"], "backgrounds": backgrounds}
        return named | options

    def function(*inputs):
        return rasterization(**arguments(*inputs))[:2]

    def vjp(inputs, v_colors, v_alphas):
        v = rasterization_vjp(**arguments(*inputs), v_render_colors=v_colors, v_render_alphas=v_alphas)
        return (*(v[f"v_{key}"] for key in keys[:5]), v["v_viewmats"][:, :3], v["v_backgrounds"])

    return function, vjp


CONFIGURATIONS = {
    "RGB": ({}, {}),
    "RGB+D": ({}, {"render_mode": "RGB+D"}),
    "RGB+ED": ({"own_colors": True}, {"render_mode": "RGB+ED"}),
    "ED": ({}, {"render_mode": "ED"}),
    "D": ({}, {"render_mode": "D"}),
    "five channels, antialiased": ({"channels": 5}, {"rasterize_mode": "antialiased"}),
    "SH 3": ({"sh_degree": 3}, {"sh_degree": 3}),
    "SH 1 of 3, own, ED": ({"sh_degree": 3, "own_colors": True}, {"sh_degree": 1, "render_mode": "RGB+ED"}),
    "INRIA's clamp": ({"sh_degree": 0}, {"sh_degree": 0, "profile": "INRIA"}),
}


@pytest.mark.parametrize("configuration", CONFIGURATIONS.values(), ids=CONFIGURATIONS.keys())
@both_backends
def test_gradient(name, configuration, rng):
    kind, options = configuration
    scene = make_scene(rng, **kind)
    function, vjp = call_with_gradient(scene, width=WIDTH, height=HEIGHT, backend=name, **options)
    has_colors = options.get("render_mode", "RGB").startswith("RGB")
    n_colors = 3 if "sh_degree" in options else kind.get("channels", 3)
    inputs = [*(scene[key] for key in ARRAYS[:5]), scene["viewmats"][:, :3], rng.uniform(size=(2, n_colors))]
    images, alphas = function(*inputs)
    assert alphas.mean() > COVERAGE_MIN
    cotangents = (rng.normal(size=images.shape), rng.normal(size=alphas.shape))
    gradients = vjp(inputs, *cotangents)
    names = [*ARRAYS[:6], "backgrounds"]
    if not has_colors:
        assert not gradients[4].any() and not gradients[6].any()
        constant = inputs[4], inputs[6]
        inputs, gradients, names = ([row[i] for i in (0, 1, 2, 3, 5)] for row in (inputs, gradients, names))

        def varying(*arrays, function=function):
            return function(*arrays[:4], constant[0], arrays[4], constant[1])

        function = varying
    # An expected depth is 3 where a colour's change is judged against 0.1: a larger step, for less rounding.
    step = 10 * GRADIENT_STEP_IMAGE
    check_inner_products(function, gradients, inputs, cotangents, rng, names=names, step=step)


@both_backends
def test_full_jacobian(name, rng):
    # Two Gaussians that cover all of a 3 x 2 image, so that no hit comes or goes.
    scene = make_scene(rng, 2, sh_degree=1, n_cameras=1)
    scene["scales"] *= 2
    scene["Ks"] = np.array([[[6.0, 0, 1.7], [0, 5, 0.9], [0, 0, 1]]])
    options = {"width": 3, "height": 2, "sh_degree": 1, "render_mode": "RGB+ED", "backend": name}
    function, vjp = call_with_gradient(scene, **options)
    inputs = [*(scene[key] for key in ARRAYS[:5]), scene["viewmats"][:, :3], rng.uniform(size=(1, 3))]
    names = [*ARRAYS[:6], "backgrounds"]
    gradients = {}

    def remembered(*cotangents):  # check_jacobian asks for the same ones once per input
        key = np.concatenate([v.ravel() for v in cotangents]).tobytes()
        if key not in gradients:
            gradients[key] = vjp(inputs, *cotangents)
        return gradients[key]

    check_jacobian(function, remembered, inputs, names=names)


def test_background_gradient_is_what_shines_through(rng):
    scene, background = make_scene(rng), rng.uniform(size=(2, 3))
    options = {"width": WIDTH, "height": HEIGHT, "backgrounds": background, "backend": "cpu"}
    images, alphas, _ = rasterization(**scene, **options)
    v_images = rng.normal(size=images.shape)
    v = rasterization_vjp(**scene, **options, v_render_colors=v_images, v_render_alphas=np.zeros_like(alphas))
    assert_allclose(v["v_backgrounds"], np.einsum("cyxk,cyxz->ck", v_images, 1 - alphas), rtol=PARITY_FLOAT64)


# --- parity ---


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_backends_agree(dtype, rng):
    scene = make_scene(rng, 60, sh_degree=3)
    v_images, v_alphas = rng.normal(size=(2, HEIGHT, WIDTH, 4)), rng.normal(size=(2, HEIGHT, WIDTH, 1))
    options = {"width": WIDTH, "height": HEIGHT, "sh_degree": 3, "render_mode": "RGB+ED"}
    results = []
    for name, kind in (("reference", np.float64), ("cpu", dtype)):
        cast = {key: array.astype(kind) for key, array in scene.items()}
        cotangents = {"v_render_colors": v_images.astype(kind), "v_render_alphas": v_alphas.astype(kind)}
        v = rasterization_vjp(**cast, **options, **cotangents, backend=name)
        results.append((*rasterization(**cast, **options, backend=name), v))
    (image, alphas, meta, v), (fast_image, fast_alphas, fast_meta, fast_v) = results
    is_exact = dtype == np.float64
    tolerance = PARITY_FLOAT64 if is_exact else PARITY_FLOAT32_IMAGE
    assert alphas.mean() > COVERAGE_MIN
    assert_allclose(fast_image, image, rtol=0, atol=tolerance * np.abs(image).max())
    assert_allclose(fast_alphas, alphas, rtol=0, atol=tolerance)
    assert_array_equal(fast_meta["flatten_ids"], meta["flatten_ids"])
    assert_array_equal(fast_meta["radii"], meta["radii"])
    for key, expected in v.items():
        assert np.abs(expected).max() > GRADIENT_FLOOR
        atol = (PARITY_FLOAT64 if is_exact else PARITY_FLOAT32_GRADIENT) * np.abs(expected).max()
        assert_allclose(fast_v[key], expected, rtol=0, atol=atol, err_msg=key)


# --- hard cases ---


@pytest.mark.parametrize("mode", ["RGB", "RGB+ED", "D"])
@pytest.mark.parametrize("what", ["no Gaussians", "all behind the camera"])
@both_backends
def test_nothing_to_see_is_the_background(name, what, mode, rng):
    scene = make_scene(rng, 0 if what == "no Gaussians" else 5)
    scene["means"] = -scene["means"]
    background = rng.uniform(size=(2, 3))
    options = {"width": WIDTH, "height": HEIGHT, "backgrounds": background, "render_mode": mode, "backend": name}
    images, alphas, meta = rasterization(**scene, **options)
    if mode.startswith("RGB"):
        assert_array_equal(images[..., :3], np.broadcast_to(background[:, None, None], (2, HEIGHT, WIDTH, 3)))
    assert mode == "RGB" or not images[..., -1].any()
    assert not alphas.any() and not meta["radii"].any() and meta["flatten_ids"].size == 0
    v = rasterization_vjp(**scene, **options, v_render_colors=np.ones_like(images), v_render_alphas=alphas + 1)
    v_background = v.pop("v_backgrounds")
    assert_allclose(v_background, WIDTH * HEIGHT if mode.startswith("RGB") else 0)
    assert not any(gradient.any() for gradient in v.values())


def put(key, index, value):
    """Change of one value of an array."""

    def change(scene):
        scene[key] = scene[key].copy()
        scene[key][index] = value

    return change


def replace(**changed):
    return lambda scene: scene.update(changed)


BAD_CALLS = {
    "means has shape [12, 4]; it must be [N, 3]": replace(means=np.zeros((12, 4))),
    "quats has shape [11, 4]; it must be [N, 4], N = 12": replace(quats=np.ones((11, 4))),
    "opacities has shape [12, 1]; it must be [N], N = 12": replace(opacities=np.ones((12, 1))),
    "colors has shape [2, 11, 3]; it must be [N, D] or [C, N, D], N = 12, C = 2": replace(colors=np.ones((2, 11, 3))),
    "viewmats has shape [4, 4]; it must be [C, 4, 4]": replace(viewmats=np.eye(4)),
    "Ks has shape [1, 3, 3]; it must be [C, 3, 3], C = 2": replace(Ks=np.eye(3)[None]),
    "viewmats holds no camera; give at least one": replace(viewmats=np.zeros((0, 4, 4)), Ks=np.zeros((0, 3, 3))),
    "backgrounds has shape [3]; it must be [C, D], C = 2, D = 3": replace(backgrounds=np.zeros(3)),
    "means has dtype int64; cast all arrays to float32 or float64": replace(means=np.zeros((12, 3), int)),
    "scales has dtype float32, means has float64; cast all": replace(scales=np.ones((12, 3), np.float32)),
    "means is nan at index [3, 1] (1 of 36 values are not finite); remove": put("means", (3, 1), np.nan),
    "colors is inf at index [0, 2]": put("colors", (0, 2), np.inf),
    "viewmats is -inf at index [1, 0, 3]": put("viewmats", (1, 0, 3), -np.inf),
    "Ks is nan at index [0, 1, 1]": put("Ks", (0, 1, 1), np.nan),
    "quats: the rotation of row 7 is a zero quaternion; remove that Gaussian": put("quats", 7, 0),
    "scales is -1.5 at index [2, 0], outside [0, inf]; give exp(log_scales)": put("scales", (2, 0), -1.5),
    "opacities is 2.5 at index [4], outside [0, 1]; give sigmoid(opacity_logits)": put("opacities", 4, 2.5),
    "viewmats[1] has the bottom row 1 2 3 1, not 0 0 0 1; give cam_from_world": put("viewmats", (1, 3), [1, 2, 3, 1]),
    "viewmats[0] has a singular 3 x 3 part; give a rotation": put("viewmats", (0, 2, slice(3)), 0),
    "Ks[1] has focal lengths -30 and 28; they must be positive": put("Ks", (1, 0, 0), -30),
    "Ks[0] has skew 0.5, which is not supported; rectify": put("Ks", (0, 0, 1), 0.5),
    "Ks[1] is not of the form [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]; rewrite": put("Ks", (1, 2, 2), 2),
    "width is 0; it must be a whole number of pixels, at least 1": replace(width=0),
    "height is 18.5; it must be a whole number": replace(height=18.5),
    "near_plane 5 and far_plane 2 are wrong; they must be 0 <= near < far": replace(near_plane=5.0, far_plane=2.0),
    "eps2d is -0.1; it must be": replace(eps2d=-0.1),
    "sh_degree is 2, which needs 9 coefficients a channel, but there are 4; give": replace(
        sh_degree=2, colors=np.zeros((12, 4, 3))
    ),
    "sh_degree is 4; it must be 0 to 3": replace(sh_degree=4, colors=np.zeros((12, 25, 3))),
    "colors has shape [12, 3]; it must be [N, K, 3] or [C, N, K, 3], N = 12, C = 2": replace(sh_degree=0),
    "render_mode 'rgb' is unknown; choose one of RGB, D, ED, RGB+D, RGB+ED": replace(render_mode="rgb"),
    "rasterize_mode 'mip' is unknown; choose one of classic, antialiased": replace(rasterize_mode="mip"),
    "profile 'inria' is unknown; choose one of GSPLAT_MAIN": replace(profile="inria"),
    "backend 'metal' is unknown; choose one of cpu": replace(backend="metal"),
    "v_render_colors has shape [1, 18, 24, 3]; it must be [C, H, W, D], C = 2, H = 18, W = 24, D = 3": replace(
        v_render_colors=np.zeros((1, 18, 24, 3))
    ),
    "v_render_alphas has shape [2, 18, 24]; it must be [C, H, W, 1], C = 2": replace(
        v_render_alphas=np.zeros((2, 18, 24))
    ),
    "v_render_colors is nan at index [0, 0, 0, 0]": replace(v_render_colors=np.full((2, 18, 24, 3), np.nan)),
}


@pytest.mark.parametrize("message", BAD_CALLS)
def test_bad_input(message, rng):
    scene = make_scene(rng) | {"width": WIDTH, "height": HEIGHT, "backend": "reference"}
    cotangents = {"v_render_colors": np.zeros((2, 18, 24, 3)), "v_render_alphas": np.zeros((2, 18, 24, 1))}
    rasterization_vjp(**scene, **cotangents)  # the call is good before it is made bad
    arguments = scene | cotangents
    BAD_CALLS[message](arguments)
    with pytest.raises(InputError, match=re.escape(message)) as caught:
        rasterization_vjp(**arguments)
    assert "\n" not in str(caught.value)
    if not message.startswith("v_render"):
        with pytest.raises(InputError, match=re.escape(message)):
            rasterization(**{key: value for key, value in arguments.items() if key not in cotangents})


def test_check_gaussians(rng):
    gaussians = as_dtype(make_gaussians(rng, 5), np.float32)
    gaussians.quats[1] = [0, 0, 0, -2]  # half a turn: no length is asked for, and w = 0 is no fault
    check_gaussians(gaussians, "a.ply")
    gaussians.quats[2] = 0
    with pytest.raises(InputError, match=r"a\.ply: the rotation of row 2 is a zero quaternion; remove"):
        check_gaussians(gaussians, "a.ply")
    gaussians.sh_rest[1, 0, 2] = np.nan
    with pytest.raises(InputError, match=r"a\.ply: sh_rest is nan at index \[1, 0, 2\]"):
        check_gaussians(gaussians, "a.ply")
