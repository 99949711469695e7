"""All of gsplat's call: every keyword is computed, makes no difference, or is refused by name; the table says which."""

import enum
import re
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from minisplat_ref import rasterization, rasterization_vjp
from minisplat_ref.constants import GSPLAT_MAIN
from minisplat_ref.errors import InputError
from minisplat_ref.gsplat.arguments import HIT_DISTANCES, NO_EFFECT, REFUSED
from minisplat_ref.reference.covariance import covariances, covariances_vjp
from minisplat_ref.rendering.backends import REFERENCE
from minisplat_ref.types import TileGrid
from scenes import activated, make_gaussians
from tolerances import CLOSED_FORM, PARITY_FLOAT64

WIDTH, HEIGHT = 24, 18
TABLE = (Path(__file__).parents[2] / "docs" / "ORACLE.md").read_text(encoding="utf-8")
RELEASED = (
    "means quats scales opacities colors viewmats Ks width height near_plane far_plane radius_clip eps2d sh_degree"
    " packed tile_size backgrounds render_mode sparse_grad absgrad rasterize_mode channel_chunk distributed"
    " camera_model segmented covars with_ut with_eval3d radial_coeffs tangential_coeffs thin_prism_coeffs ftheta_coeffs"
    " rolling_shutter viewmats_rs"
).split()  # the parameters of gsplat 1.5.3
OF_MAIN = (
    "return_normals global_z_order rays lidar_coeffs external_distortion_coeffs ut_params extra_signals"
    " extra_signals_sh_degree renderer_config"
).split()  # those that its main branch has besides, in August 2026
backends = pytest.mark.parametrize("backend", ["reference", "cpu"])


def make_call(rng, n=10, n_cameras=2, sh_degree=None):
    means, quats, scales, opacities = activated(make_gaussians(rng, n, size=0.25))
    viewmats, Ks = np.tile(np.eye(4), (n_cameras, 1, 1)), np.tile(np.eye(3), (n_cameras, 1, 1))
    viewmats[:, :3, 3] = rng.uniform((-0.2, -0.2, 0.1), (0.2, 0.2, 0.5), (n_cameras, 3))
    Ks[:, 0, 0], Ks[:, 1, 1], Ks[:, :2, 2] = 28, 27, (11, 10)
    shape = (n, 3) if sh_degree is None else (n, (sh_degree + 1) ** 2, 3)
    arrays = {"means": means, "quats": quats, "scales": scales, "opacities": opacities}
    arrays |= {"colors": rng.normal(size=shape), "viewmats": viewmats, "Ks": Ks}
    return {**arrays, "width": WIDTH, "height": HEIGHT, "sh_degree": sh_degree}


def vjp(arguments, rng):
    images, alphas, _ = rasterization(**arguments)
    cotangents = {"v_render_colors": rng.normal(size=images.shape), "v_render_alphas": rng.normal(size=alphas.shape)}
    return rasterization_vjp(**arguments, **cotangents), cotangents


# --- the table ---


def rows():
    lines = re.findall(r"^\| `(\w+)`.*?\| *(\w+)[^|]*\|", TABLE, re.MULTILINE)
    return {name: word for name, word in lines if name in (*RELEASED, *OF_MAIN)}


def test_the_table_has_every_keyword():
    found = rows()
    assert list(found) == [*RELEASED, *OF_MAIN]
    assert {name for name, word in found.items() if word == "refused"} == set(REFUSED)
    assert {name for name, word in found.items() if word == "no"} == set(NO_EFFECT)
    assert {word for name, word in found.items()} == {"computed", "no", "refused"}


def test_what_is_computed_is_a_parameter():
    import inspect

    for function in (rasterization, rasterization_vjp):
        named = {p.name for p in inspect.signature(function).parameters.values()}
        assert {name for name, word in rows().items() if word == "computed"} <= named
        others = named & (set(REFUSED) | set(NO_EFFECT))
        assert others <= {"sparse_grad", "absgrad"}, "others than those that stand before one that is computed"


# --- refused ---


class Shutter(enum.Enum):
    GLOBAL = 0
    ROLLING_TOP_TO_BOTTOM = 1


ASKS = {
    "camera_model": "fisheye",
    "global_z_order": False,
    "rolling_shutter": Shutter.ROLLING_TOP_TO_BOTTOM,
    "extra_signals_sh_degree": 3,
    **dict.fromkeys(("sparse_grad", "absgrad", "distributed", "with_ut", "with_eval3d", "return_normals"), True),
}
DEFAULTS = {
    "camera_model": "pinhole",
    "global_z_order": True,
    "rolling_shutter": Shutter.GLOBAL,
    **dict.fromkeys(("sparse_grad", "absgrad", "distributed", "with_ut", "with_eval3d", "return_normals"), False),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_not_computed_is_refused_by_name(name, rng):
    given = make_call(rng)
    asked = {name: ASKS.get(name, np.zeros((2, 4)))}
    for function in (rasterization, lambda **a: rasterization_vjp(**a, v_render_colors=0, v_render_alphas=0)):
        with pytest.raises(InputError, match=f"^{name}.* is not computed; ") as caught:
            function(**given, **asked)
        assert "\n" not in str(caught.value) and len(str(caught.value)) < 150
    image = rasterization(**given)[0]
    assert_array_equal(rasterization(**given, **{name: DEFAULTS.get(name)})[0], image)


@pytest.mark.parametrize("model", ["ortho", "ftheta", "lidar"])
def test_other_cameras_are_named(model, rng):
    with pytest.raises(InputError, match=f"camera_model='{model}' is not computed; only pinhole"):
        rasterization(**make_call(rng), camera_model=model)


@pytest.mark.parametrize("mode", HIT_DISTANCES)
def test_distances_along_rays_are_refused(mode, rng):
    with pytest.raises(InputError, match=f"render_mode '{mode}' is not computed: .* choose one of RGB, D, ED"):
        rasterization(**make_call(rng), render_mode=mode)


def test_a_keyword_that_gsplat_has_not_is_an_error_of_the_program(rng):
    with pytest.raises(TypeError, match=r"rasterization\(\) got an unexpected keyword argument 'tile_szie'"):
        rasterization(**make_call(rng), tile_szie=8)
    with pytest.raises(TypeError, match=r"rasterization_vjp\(\) got"):
        rasterization_vjp(**make_call(rng), v_render_colors=0, v_render_alphas=0, tile_szie=8)


@pytest.mark.parametrize("name", NO_EFFECT)
def test_what_makes_no_difference_is_taken(name, rng):
    given = make_call(rng)
    for value in (True, 7):
        assert_array_equal(rasterization(**given, **{name: value})[0], rasterization(**given)[0])


# --- batches ---


def stack(calls, shape):
    return {
        key: np.stack([call[key] for call in calls]).reshape(*shape, *value.shape)
        if isinstance(value, np.ndarray)
        else value
        for key, value in calls[0].items()
    }


@pytest.mark.parametrize("lead", [(3,), (2, 2)])
@pytest.mark.parametrize("mode", ["RGB", "RGB+ED"])
@backends
def test_a_batch_is_its_scenes(backend, mode, lead, rng):
    calls = [make_call(rng, sh_degree=1) for _ in range(int(np.prod(lead)))]
    for call in calls:
        call["backgrounds"] = rng.uniform(size=(2, 3))
    whole = stack(calls, lead) | {"render_mode": mode, "backend": backend}
    images, alphas, meta = rasterization(**whole)
    assert images.shape == (*lead, 2, HEIGHT, WIDTH, 3 + (mode != "RGB")) and alphas.shape == (
        *lead,
        2,
        HEIGHT,
        WIDTH,
        1,
    )
    assert meta["n_batches"] == len(calls) and meta["n_cameras"] == 2
    gradients, cotangents = vjp(whole, rng)
    for index, call in zip(np.ndindex(lead), calls, strict=True):
        alone = call | {"render_mode": mode, "backend": backend}
        image, alpha, own = rasterization(**alone)
        assert_array_equal(images[index], image)
        assert_array_equal(alphas[index], alpha)
        for key in ("means2d", "depths", "conics", "opacities", "radii", "tiles_per_gauss"):
            assert_array_equal(meta[key][index], own[key])
        v = rasterization_vjp(**alone, **{key: value[index] for key, value in cotangents.items()})
        assert v.keys() == gradients.keys()
        for key in v:
            assert_array_equal(gradients[key][index], v[key])


def test_lists_of_a_batch_number_its_images(rng):
    calls = [make_call(rng) for _ in range(2)]
    _, _, meta = rasterization(**stack(calls, (2,)))
    alone = [rasterization(**call)[2] for call in calls]
    ids = np.concatenate([alone[0]["flatten_ids"], alone[1]["flatten_ids"] + 20])  # two cameras of ten Gaussians each
    assert_array_equal(meta["flatten_ids"], ids)
    starts = np.stack([alone[0]["isect_offsets"], alone[1]["isect_offsets"] + len(alone[0]["flatten_ids"])])
    assert_array_equal(meta["isect_offsets"], starts)


def test_coefficients_of_all_scenes(rng):
    calls = [make_call(rng, sh_degree=1) for _ in range(2)]
    shared = calls[0]["colors"]
    whole = stack(calls, (2,)) | {"colors": shared}
    each = stack([call | {"colors": shared} for call in calls], (2,))
    assert_array_equal(rasterization(**whole)[0], rasterization(**each)[0])
    gradients, cotangents = vjp(whole, rng)
    v = rasterization_vjp(**each, **cotangents)
    assert_allclose(gradients["v_colors"], v["v_colors"].sum(axis=0), rtol=PARITY_FLOAT64)
    assert gradients["v_colors"].shape == shared.shape


def test_colors_and_coefficients_of_each_camera(rng):
    for degree in (None, 1):
        call = make_call(rng, sh_degree=degree)
        own = np.stack([call["colors"], 0.5 * call["colors"]])
        images = rasterization(**call | {"colors": own})[0]
        for c in range(2):
            one = call | {"colors": own[c], "viewmats": call["viewmats"][c : c + 1], "Ks": call["Ks"][c : c + 1]}
            assert_array_equal(images[c], rasterization(**one)[0][0])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"opacities": np.ones((3, 10))},
            r"opacities has shape \[3, 10\]; its first sizes .* means, \[2\]",
        ),
        ({"means": np.zeros((0, 10, 3))}, "a batch of no scene"),
        ({"viewmats": np.eye(4)[None]}, r"viewmats has shape \[1, 4, 4\]; its first sizes"),
    ],
)
def test_bad_batches(change, message, rng):
    with pytest.raises(InputError, match=message):
        rasterization(**stack([make_call(rng), make_call(rng)], (2,)) | change)


# --- covariances ---


@pytest.mark.parametrize("mode", ["classic", "antialiased"])
@backends
def test_covariances_instead_of_factors(backend, mode, rng):
    call = make_call(rng) | {"rasterize_mode": mode, "backend": backend}
    given = call | {"quats": None, "scales": None, "covars": covariances(call["quats"], call["scales"])}
    assert_allclose(rasterization(**given)[0], rasterization(**call)[0], atol=1e-12)
    gradients, cotangents = vjp(given, rng)
    v = rasterization_vjp(**call, **cotangents)
    assert set(gradients) == set(v) - {"v_quats", "v_scales"} | {"v_covars"}
    v_quats, v_scales = covariances_vjp(call["quats"], call["scales"], gradients["v_covars"])
    for found, expected in ((v_quats, v["v_quats"]), (v_scales, v["v_scales"]), (gradients["v_means"], v["v_means"])):
        assert_allclose(found, expected, atol=1e-9 * np.abs(expected).max())


def test_the_gradient_of_a_ball(rng):
    """Its factors have no gradient across its axes, the covariance does."""
    call = make_call(rng, n=4)
    balls = np.tile(np.eye(3), (4, 1, 1)) * rng.uniform(0.02, 0.1, (4, 1, 1))
    call |= {"quats": None, "scales": None, "covars": balls, "backend": "reference"}
    gradients, cotangents = vjp(call, rng)
    for i, j in ((0, 0), (0, 1), (1, 2)):
        step = np.zeros_like(balls)
        step[:, i, j] = 1e-6  # the upper triangle is what is read
        (up, up_alpha, _), (down, down_alpha, _) = (
            rasterization(**call | {"covars": balls + sign * step}) for sign in (1, -1)
        )
        moved = np.vdot(cotangents["v_render_colors"], up - down) + np.vdot(
            cotangents["v_render_alphas"], up_alpha - down_alpha
        )
        expected = gradients["v_covars"][:, i, j].sum()
        assert abs(expected) > 1e-2 and abs(moved / 2e-6 - expected) < 1e-5 * abs(expected)
    assert not np.tril(gradients["v_covars"], -1).any()


def test_the_lower_triangle_is_not_read(rng):
    call = make_call(rng)
    covars = covariances(call["quats"], call["scales"])
    given = call | {"quats": None, "scales": None}
    image = rasterization(**given, covars=covars)[0]
    assert_array_equal(rasterization(**given, covars=np.triu(covars))[0], image)


def test_covariances_in_batches_and_float32(rng):
    calls = []
    for _ in range(2):
        call = make_call(rng)
        call |= {"covars": covariances(call["quats"], call["scales"]), "quats": None, "scales": None}
        calls.append({k: v.astype(np.float32) if isinstance(v, np.ndarray) else v for k, v in call.items()})
    images = rasterization(**stack(calls, (2,)))[0]
    assert images.dtype == np.float32 and np.array_equal(images[1], rasterization(**calls[1])[0])
    empty = {k: v[:0] if k in ("means", "opacities", "colors", "covars") else v for k, v in calls[0].items()}
    assert not rasterization(**empty)[0].any()


def test_what_is_no_covariance_is_refused(rng):
    call = make_call(rng)
    covars = covariances(call["quats"], call["scales"])
    covars[3] -= 2 * np.diag(np.diag(covars[3]))
    with pytest.raises(InputError, match=r"covars\[3\] has the eigenvalue -.*no covariance"):
        rasterization(**call, covars=covars)
    with pytest.raises(InputError, match=r"covars has shape \[10, 6\]; it must be \[N, 3, 3\]"):
        rasterization(**call, covars=np.zeros((10, 6)))


# --- the other options ---


@backends
def test_small_radii_are_culled(backend, rng):
    call = make_call(rng) | {"backend": backend}
    radii = rasterization(**call)[2]["radii"]  # [C, N, 2]
    clip = float(np.sort(radii.max(axis=2).ravel())[10])  # one that a Gaussian has
    is_small = (radii <= clip).all(axis=2)
    assert 3 < is_small.sum() < 17
    images, _, meta = rasterization(**call, radius_clip=clip)
    assert_array_equal(meta["radii"][..., 0] == 0, is_small | (radii[..., 0] == 0))
    gradients, cotangents = vjp(call | {"radius_clip": clip}, rng)
    v_means = np.zeros_like(call["means"])
    for c in range(2):
        one = {**call, "viewmats": call["viewmats"][c : c + 1], "Ks": call["Ks"][c : c + 1]}
        one["opacities"] = np.where(is_small[c], 0, call["opacities"])
        assert_array_equal(images[c], rasterization(**one)[0][0])
        v_means += rasterization_vjp(**one, **{k: v[c : c + 1] for k, v in cotangents.items()})["v_means"]
    assert_allclose(gradients["v_means"], v_means, rtol=PARITY_FLOAT64, atol=PARITY_FLOAT64)
    with pytest.raises(InputError, match="radius_clip is -1"):
        rasterization(**call, radius_clip=-1)


def test_packed_rows(rng):
    calls = [make_call(rng) for _ in range(2)]
    calls[1]["means"][:4, 2] = -5  # behind the camera
    whole = stack(calls, (2,))
    image, _, dense = rasterization(**whole)
    packed_image, _, meta = rasterization(**whole, packed=True)
    assert_array_equal(packed_image, image)
    is_seen = dense["radii"][..., 0] > 0  # [B, C, N]
    assert 20 < is_seen.sum() < 40 and not is_seen[1, :, :4].any()
    places = np.argwhere(is_seen)
    ids = np.column_stack([meta[key] for key in ("batch_ids", "camera_ids", "gaussian_ids")])
    assert_array_equal(ids, places)
    for key in ("means2d", "depths", "conics", "opacities", "radii", "tiles_per_gauss"):
        assert_array_equal(meta[key], dense[key][is_seen])
    b, c, n = places[meta["flatten_ids"]].T
    assert_array_equal(20 * b + 10 * c + n, dense["flatten_ids"])
    assert_array_equal(meta["isect_offsets"], dense["isect_offsets"])


@pytest.mark.parametrize("size", [8, 5, 64])
def test_tiles_of_the_meta(size, rng):
    call = make_call(rng, n_cameras=1)
    image, _, meta = rasterization(**call, tile_size=size)
    assert_array_equal(image, rasterization(**call)[0])
    primitives = [call[key] for key in ("means", "quats", "scales", "opacities")]
    V, K = call["viewmats"][0], call["Ks"][0]
    from minisplat_ref.types import Camera

    camera = Camera(V[:3, :3], V[:3, 3], K[0, 0], K[1, 1], K[0, 2], K[1, 2], WIDTH, HEIGHT)
    projection = REFERENCE.project(*primitives, camera, GSPLAT_MAIN)
    bins = REFERENCE.bin_gaussians(projection, TileGrid(WIDTH, HEIGHT, size, size), GSPLAT_MAIN)
    assert_array_equal(meta["flatten_ids"], bins.gaussian_ids)
    assert meta["tile_size"] == size and meta["isect_offsets"].shape == (1, -(-HEIGHT // size), -(-WIDTH // size))
    assert_array_equal(meta["isect_offsets"].ravel(), bins.tile_offsets[:-1])
    assert rasterization(**call, tile_size=None)[2]["tile_size"] == 16
    with pytest.raises(InputError, match="tile_size is 0"):
        rasterization(**call, tile_size=0)


def test_arguments_by_position_are_those_of_gsplat(rng):
    """In the order of gsplat 1.5.3, from the planes to rasterize_mode."""
    call = make_call(rng)
    del call["sh_degree"]
    backgrounds = np.full((2, 3), 0.25)
    by_name = {"near_plane": 0.01, "far_plane": 1e10, "radius_clip": 1.0, "eps2d": 0.2, "sh_degree": None}
    by_name |= {"packed": True, "tile_size": 8, "backgrounds": backgrounds, "render_mode": "RGB+D"}
    by_name |= {"sparse_grad": False, "absgrad": False, "rasterize_mode": "antialiased"}
    (colors, alphas, meta), (others, other_alphas, other_meta) = (
        rasterization(**call, **by_name),
        rasterization(*call.values(), *by_name.values()),  # in the order of make_call
    )
    assert_array_equal(colors, others)
    assert_array_equal(alphas, other_alphas)
    assert meta["tile_width"] == other_meta["tile_width"] and len(meta["depths"]) == len(other_meta["depths"])
    assert not np.array_equal(colors, rasterization(**call, **by_name | {"rasterize_mode": "classic"})[0])
    with pytest.raises(InputError, match="absgrad=True is not computed"):
        rasterization(**call, **by_name | {"absgrad": True})


@pytest.mark.parametrize("mode", ["D", "ED"])
def test_depth_needs_no_colors(mode, rng):
    call = make_call(rng) | {"render_mode": mode}
    depth = rasterization(**call | {"colors": None})[0]
    assert_array_equal(depth, rasterization(**call)[0])
    gradients, cotangents = vjp(call | {"colors": None}, rng)
    v = rasterization_vjp(**call, **cotangents)
    assert set(v) - set(gradients) == {"v_colors"}
    assert_allclose(gradients["v_means"], v["v_means"], atol=CLOSED_FORM)
    with pytest.raises(InputError, match="colors has"):
        rasterization(**call | {"colors": None, "render_mode": "RGB"})
