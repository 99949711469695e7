"""Shading once per pixel: environment, averages, split sum, shading, tone, visibility; closed forms and quadrature."""

from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import dblquad, quad

from gradcheck import check_inner_products
from minisplat_ref.constants import GSPLAT_MAIN
from minisplat_ref.errors import InputError
from minisplat_ref.io.srgb import decode_srgb, encode_srgb, encode_srgb_vjp
from minisplat_ref.mechanisms.gbuffer import renderer
from minisplat_ref.mechanisms.gbuffer.brdf import hammersley, integrate, reflectance
from minisplat_ref.mechanisms.gbuffer.environment import locate, read, texel_directions
from minisplat_ref.mechanisms.gbuffer.lighting import read_environment, relight
from minisplat_ref.mechanisms.gbuffer.maps import map_image
from minisplat_ref.mechanisms.gbuffer.pixels import Blended, find_rows, points_of
from minisplat_ref.mechanisms.gbuffer.prefilter import KNOTS, matte, prefilter, prefilter_vjp, reflected
from minisplat_ref.mechanisms.gbuffer.shading import Around, Surface, shade, shade_vjp
from minisplat_ref.mechanisms.gbuffer.visibility import transmittances
from minisplat_ref.mechanisms.rays.pixel_rays import Rays
from minisplat_ref.rendering import Request
from minisplat_ref.rendering.backends import CPU, REFERENCE
from minisplat_ref.types import Camera, Model, Primitives
from tolerances import CLOSED_FORM, ENVIRONMENT_TEXEL, PARITY_FLOAT64, SPLIT_SUM


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


# --- environment ---


def test_directions_and_texels_by_hand():
    """+x is between columns 3 and 4 of 8, +y a quarter to the right, +z above the first row."""
    directions, solid = texel_directions(4, 8)
    assert_allclose(solid.sum(), 4 * np.pi, rtol=CLOSED_FORM)
    assert_allclose(solid[0, 0], 2 * np.pi / 8 * (1 - np.cos(np.pi / 4)), rtol=CLOSED_FORM)
    image = np.zeros((4, 8, 3))
    image[..., 0], image[..., 1] = np.arange(4)[:, None], np.arange(8)
    found = read(image, locate(np.array([[1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0], [0, 0, -1.0]]), 4, 8))
    assert_allclose(found[:2, :2], [[1.5, 3.5], [1.5, 5.5]], atol=CLOSED_FORM)
    assert_allclose(found[2:, 0], [0, 3], atol=CLOSED_FORM)
    places = locate(directions.reshape(-1, 3), 4, 8)
    assert_allclose(read(image, places), image.reshape(-1, 3), atol=CLOSED_FORM)
    across = read(image, locate(unit(np.array([[-1.0, 0.0, 0.0]])), 4, 8))  # between the last column and the first
    assert_allclose(across[0, 1], 3.5, atol=CLOSED_FORM)


def test_a_constant_environment_is_constant_at_every_roughness(rng):
    light, directions = prefilter(np.full((8, 16, 3), 0.7)), unit(rng.normal(size=(50, 3)))
    assert_allclose(matte(light, directions), 0.7, rtol=CLOSED_FORM)
    assert_allclose(reflected(light, directions, rng.uniform(size=50)), 0.7, rtol=CLOSED_FORM)


def test_averages_of_a_light_from_above(rng):
    """Of L = 1 + z, E(n) = 1 + 2/3 n_z, and a lobe around r sees 1 + c r_z; c by an integral over the angle."""
    texels, _ = texel_directions(32, 64)
    light = prefilter(np.repeat(1 + texels[..., 2:], 3, axis=2))
    n = unit(rng.normal(size=(40, 3)))
    assert_allclose(matte(light, n)[:, 0], 1 + 2 / 3 * n[:, 2], atol=ENVIRONMENT_TEXEL * (np.pi / 32) ** 2)
    for roughness, image in zip(KNOTS[1:], light.maps[1:], strict=True):
        alpha2 = roughness**4

        def lobe(theta, alpha2=alpha2):
            return alpha2 / ((1 + np.cos(theta)) / 2 * (alpha2 - 1) + 1) ** 2 * np.cos(theta) * np.sin(theta)

        c = quad(lambda t, f=lobe: f(t) * np.cos(t), 0, np.pi / 2)[0] / quad(lobe, 0, np.pi / 2)[0]
        assert c < 0.995
        found = reflected(light, n, np.full(40, roughness))[:, 0]
        assert_allclose(found, 1 + c * n[:, 2], atol=ENVIRONMENT_TEXEL * (np.pi / len(image)) ** 2)


def test_between_two_roughnesses_light_is_blended(rng):
    light, r = prefilter(rng.uniform(size=(8, 16, 3))), unit(rng.normal(size=(9, 3)))
    at = [reflected(light, r, np.full(9, roughness)) for roughness in (0.5, 0.55, 0.7)]
    assert_allclose(at[1], 0.75 * at[0] + 0.25 * at[2], rtol=1e-12)


@pytest.mark.parametrize(("knot", "rows", "first"), [(1, 8, 1), (2, 4, 2), (4, 2, 4)])
def test_a_map_is_the_average_over_the_lobe_texel_by_texel(knot, rows, first, rng):
    """The sum of the docstring for one direction of a map, over the nine parts of each texel; not all in column 0."""
    image, alpha2 = rng.uniform(size=(8, 16, 3)), KNOTS[knot] ** 4
    found = prefilter(image).maps[knot]
    assert found.shape == (rows, 2 * rows, 3)
    parts, solid = texel_directions(24, 48)
    for row, column in ((0, 0), (rows - 1, 1), (rows // 2, 2 * rows - 1)):
        # A direction of a coarser map lies in the first of the columns that it stands for.
        theta, phi = np.pi * (row + 0.5) / rows, 2 * np.pi * ((first * column + first / 2) / 16 - 0.5)
        r = np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)
        cosines = parts @ r
        lobe = alpha2 / (np.pi * ((1 + cosines) / 2 * (alpha2 - 1) + 1) ** 2) * np.maximum(cosines, 0) * solid
        weights = lobe.reshape(8, 3, 16, 3).sum(axis=(1, 3))
        expected = np.einsum("hw,hwc->c", weights, image) / weights.sum()
        assert_allclose(found[row, column], expected, rtol=PARITY_FLOAT64, err_msg=f"{row}, {column}")


def test_a_fine_environment_keeps_its_mirror_image_and_has_the_averages_of_a_coarse_one(rng):
    coarse = rng.uniform(size=(32, 64, 3))
    fine = np.repeat(np.repeat(coarse, 2, axis=0), 2, axis=1)
    light, other = prefilter(fine), prefilter(coarse)
    assert light.maps[0] is fine
    for a, b in zip((*light.maps[1:], light.irradiance), (*other.maps[1:], other.irradiance), strict=True):
        assert_allclose(a, b, rtol=CLOSED_FORM)


@pytest.mark.parametrize("shape", [(6, 12, 3), (8, 8, 3), (40, 80, 3), (0, 0, 3)])
def test_sizes_that_do_not_divide_are_refused(shape):
    with pytest.raises(InputError, match="must be a multiple of"):
        prefilter(np.ones(shape))


# --- split sum ---


def test_hammersley_by_hand():
    assert_allclose(hammersley(4), [[1 / 8, 0], [3 / 8, 1 / 2], [5 / 8, 1 / 4], [7 / 8, 3 / 4]], rtol=CLOSED_FORM)


def test_a_mirror_reflects_by_schlick():
    """Without roughness there is nothing to integrate: S = 1 - (1 - mu)^5, B = (1 - mu)^5."""
    mu = np.array([0.2, 0.5, 1.0])
    found = integrate(mu, 0.0)
    assert_allclose(found, np.stack([1 - (1 - mu) ** 5, (1 - mu) ** 5], axis=1), atol=SPLIT_SUM)


@pytest.mark.parametrize(("mu", "roughness"), [(0.5, 0.5), (0.9, 0.8), (0.3, 0.7)])
def test_shares_are_integrals_over_all_directions_of_light(mu, roughness):
    """D G F / (4 mu (n.l)) (n.l) over the hemisphere of l, without importance sampling."""
    v, alpha2, k = np.array([np.sqrt(1 - mu * mu), 0, mu]), roughness**4, roughness**2 / 2

    def integrand(phi, z, with_fresnel):
        l = np.array([np.sqrt(1 - z * z) * np.cos(phi), np.sqrt(1 - z * z) * np.sin(phi), z])  # noqa: E741
        h = (l + v) / np.linalg.norm(l + v)
        D = alpha2 / (np.pi * (h[2] ** 2 * (alpha2 - 1) + 1) ** 2)
        G = z / (z * (1 - k) + k) * mu / (mu * (1 - k) + k)
        F = (1 - v @ h) ** 5
        return D * G * (F if with_fresnel else 1 - F) / (4 * mu)

    expected = [2 * dblquad(integrand, 0, 1, 0, np.pi, args=(f,), epsabs=1e-4)[0] for f in (False, True)]
    assert_allclose(integrate(np.array([mu]), roughness)[0], expected, atol=SPLIT_SUM)
    assert_allclose(reflectance(np.array([mu]), np.array([roughness]))[0][0], expected, atol=2 * SPLIT_SUM)


# --- shading ---


def points(rng, n=60):
    normals = unit(rng.normal(size=(n, 3)))
    to_camera = unit(normals + 0.5 * rng.normal(size=(n, 3)))
    return Surface(rng.uniform(size=(n, 3)), rng.uniform(size=n), rng.uniform(size=n), normals, to_camera)


def test_a_matte_and_a_chrome_point_by_hand():
    """Seen from straight above in a light of 2: a matte white point shows 2 (1 + 0.04 S + B), chrome of 0.8 0.8 * 2."""
    up = np.array([[0.0, 0.0, 1.0]])
    light, one = prefilter(np.full((4, 8, 3), 2.0)), np.ones(1)
    S, B = reflectance(one, 0 * one)[0][0]
    assert_allclose((S, B), (1, 0), atol=SPLIT_SUM)
    white, _ = shade(Surface(np.ones((1, 3)), 0 * one, 0 * one, up, up), light)
    chrome, _ = shade(Surface(np.full((1, 3), 0.8), one, 0 * one, up, up), light)
    assert_allclose(white, 2 * (1 + 0.04 * S + B), rtol=CLOSED_FORM)
    assert_allclose(chrome, 2 * (0.8 * S + B), rtol=CLOSED_FORM)


def test_a_mirror_shows_what_lies_behind_the_camera_and_what_is_in_the_way():
    """Tilted by 45 degrees towards +x, it shows +x to a camera above; where that is hidden, what hides it."""
    image = np.zeros((32, 64, 3))
    image[15:17, 31:33] = (1.0, 2.0, 3.0)
    normal, above = unit(np.array([[1.0, 0, 1.0]])), np.array([[0, 0, 1.0]])
    surface = Surface(np.ones((1, 3)), np.ones(1), np.zeros(1), normal, above)
    S, B = reflectance(np.array([np.sqrt(0.5)]), np.zeros(1))[0][0]
    seen, _ = shade(surface, prefilter(image))
    assert_allclose(seen[0], (S + B) * np.array([1.0, 2, 3]), rtol=1e-9)
    hidden, _ = shade(surface, prefilter(image), Around(np.array([0.25]), np.array([[4.0, 0, 0]])))
    assert_allclose(hidden[0], (S + B) * (0.25 * np.array([1.0, 2, 3]) + 0.75 * np.array([4.0, 0, 0])), rtol=1e-9)


def test_light_that_is_scattered_otherwise_replaces_that_of_the_albedo():
    """By hand: a quarter of metal leaves three quarters of the given light, whatever albedo and environment scatter."""
    up, quarter = np.array([[0, 0, 1.0]]), np.full(1, 0.25)
    surface, light = Surface(np.full((1, 3), 0.5), quarter, quarter, up, up), prefilter(np.ones((4, 8, 3)))
    given, _ = shade(surface, light, scattered=np.array([[0.8, 0.4, 0.0]]))
    plain, _ = shade(surface, light)
    assert_allclose(given - plain, 0.75 * (np.array([[0.8, 0.4, 0.0]]) - 0.5), rtol=1e-9)


def test_the_gradient_of_light_that_is_scattered_otherwise(rng):
    surface, image = points(rng), rng.uniform(0.2, 1, size=(4, 8, 3))
    given, cotangent = rng.uniform(size=(60, 3)), rng.normal(size=(60, 3))

    def function(*args):
        *fields, colors = args
        return (shade(Surface(*fields), prefilter(image), scattered=colors)[0],)

    _, tape = shade(surface, prefilter(image), scattered=given)
    v = shade_vjp(tape, cotangent)
    names = (*Surface._fields, "scattered")
    check_inner_products(function, (*v.surface, v.scattered), (*surface, given), (cotangent,), rng, names=names)
    assert not v.light.irradiance.any() and v.light.maps[0].any()


def test_gradients_of_shading_reach_the_texels(rng):
    surface, image = points(rng), rng.uniform(0.2, 1, size=(4, 8, 3))
    visible, around = rng.uniform(size=60), rng.uniform(size=(60, 3))
    cotangent = rng.normal(size=(60, 3))

    def function(*args):
        *fields, texels, colors = args
        return (shade(Surface(*fields), prefilter(texels), Around(visible, colors))[0],)

    _, tape = shade(surface, prefilter(image), Around(visible, around))
    v = shade_vjp(tape, cotangent)
    gradients = (*v.surface, prefilter_vjp(image, v.light), v.around)
    names = (*Surface._fields, "texels", "around")
    check_inner_products(function, gradients, (*surface, image, around), (cotangent,), rng, names=names)


def test_gradients_of_a_fine_environment(rng):
    image = rng.uniform(0.2, 1, size=(64, 128, 3))
    cotangent = prefilter(rng.normal(size=image.shape))
    gradient = prefilter_vjp(image, cotangent)
    direction = rng.normal(size=image.shape)
    moved = prefilter(direction)  # linear
    expected = sum(np.vdot(a, b) for a, b in zip(moved.maps, cotangent.maps, strict=True))
    expected += np.vdot(moved.irradiance, cotangent.irradiance)
    assert_allclose(np.vdot(gradient, direction), expected, rtol=PARITY_FLOAT64 * image.size)


def test_srgb_has_no_end():
    """0.5 is 188 of 255; the line has the slope 12.92."""
    linear = np.array([0.002, 0.5, 1.0, 4.0])
    found = encode_srgb(linear)
    assert_allclose(found[:3], [0.02584, 0.7353569830524495, 1.0], rtol=1e-12)
    assert found[3] > 1.8
    just_past_the_knee = encode_srgb(np.array([0.0035]))
    assert_allclose(just_past_the_knee, 1.055 * 0.0035 ** (1 / 2.4) - 0.055, rtol=1e-12)
    assert_allclose(decode_srgb(found), linear, rtol=1e-12)
    numeric = (encode_srgb(linear + 1e-6) - encode_srgb(linear - 1e-6)) / 2e-6
    assert_allclose(encode_srgb_vjp(linear, np.ones(4)), numeric, rtol=1e-6)


# --- visibility ---


def rays_from(origins, directions, near=0.1, far=10.0):
    origins, directions = np.array(origins, float), np.array(directions, float)
    return Rays(origins, directions, np.full(len(origins), near), np.full(len(origins), far))


def test_one_disc_by_hand(backend):
    """A disc of standard deviations 1 and 0.5 at z = 2: through it, at u = 1, at v = 1, beside, behind, beyond."""
    disc = Primitives(np.array([[0, 0, 2.0]]), np.array([[1.0, 0, 0, 0]]), np.array([[1.0, 0.5, 9.0]]), np.array([0.6]))
    up = [0.0, 0, 1]
    rays = rays_from(
        [[0, 0, 0], [1, 0, 0], [0, 0.5, 0], [9, 0, 0], [0, 0, 3], [0, 0, -9], [0, 0, 2.5]],
        [up, up, up, up, up, up, [1.0, 0, 0]],
    )
    found = transmittances(disc, rays, GSPLAT_MAIN, backend)
    at_one = 1 - 0.6 * np.exp(-0.5)
    assert_allclose(found, [0.4, at_one, at_one, 1, 1, 1, 1], rtol=CLOSED_FORM)


def test_kernels_and_all_pairs_agree_in_a_crowd(rng):
    n, p = 300, 133
    crowd = Primitives(
        rng.normal(size=(n, 3)), rng.normal(size=(n, 4)), rng.uniform(0.05, 0.3, (n, 3)), rng.uniform(size=n)
    )
    crowd.scales[0, 0], crowd.means[1] = 0, np.nan  # neither is drawn
    crowd.opacities[1] = 0
    rays = rays_from(rng.normal(size=(p, 3)), rng.normal(size=(p, 3)))
    slow, fast = (transmittances(crowd, rays, GSPLAT_MAIN, b) for b in (REFERENCE, CPU))
    assert 0.2 < slow.mean() < 0.9 and (slow == 1).any()
    assert_allclose(fast, slow, atol=GSPLAT_MAIN.transmittance_min)
    assert_allclose(fast[slow > 1e-3], slow[slow > 1e-3], rtol=PARITY_FLOAT64)


def test_no_surfels_hide_nothing(backend):
    nothing = Primitives(np.zeros((0, 3)), np.zeros((0, 4)), np.zeros((0, 3)), np.zeros(0))
    assert (transmittances(nothing, rays_from([[0, 0, 0]], [[0, 0, 1]]), GSPLAT_MAIN, backend) == 1).all()


# --- files and pictures ---


@pytest.mark.parametrize(
    ("array", "words"),
    [
        (np.ones((8, 16)), "has the shape (H, 2 H, 3), not (8, 16)"),
        (np.ones((8, 12, 3)), "12 x 8 texels"),
        (np.full((8, 16, 3), -0.1), "finite values of at least 0"),
        (np.full((8, 16, 3), np.inf), "finite values of at least 0"),
    ],
)
def test_environments_that_are_none_are_named(tmp_path, array, words):
    path = tmp_path / "light.npy"
    np.save(path, array)
    with pytest.raises(InputError) as error:
        read_environment(path)
    assert str(path) in str(error.value) and words in str(error.value)


def test_a_model_without_an_environment_is_not_relit(tmp_path):
    np.save(tmp_path / "light.npy", np.ones((8, 16, 3)))
    with pytest.raises(InputError, match="has no environment; train with --recipe reflective"):
        relight(Model(None), tmp_path / "light.npy")


def test_maps_show_means():
    alpha = np.array([[0.5, 0.0]])
    assert map_image("roughness", np.array([[[0.25], [0.0]]]), alpha).tolist() == [[[128] * 3, [0] * 3]]
    assert map_image("normal", np.array([[[0, 0, -0.2], [0, 0, 0]]]), alpha).tolist() == [[[128, 128, 0], [0] * 3]]
    assert map_image("albedo", np.full((1, 2, 3), 0.25), alpha)[0, 0, 0] == 188


@pytest.mark.parametrize("backend", [REFERENCE, CPU], ids=lambda backend: backend.name)
@pytest.mark.parametrize(("distance", "share"), [(0.03, 1.0), (0.05, 0.1), (0.3, 0.1), (50.0, 0.1), (1e4, 0.1)])
def test_a_reflected_ray_begins_beyond_its_surface_and_does_not_end(distance, share, backend):
    """A mirror 2 before the camera, which half of the pixel shows, sends the axis back; a disc of opacity 0.9 is in it.

    What is nearer than 2 % of the depth, 0.04, counts as the mirror itself; behind the camera everything counts.
    """
    camera = Camera(np.eye(3), np.zeros(3), 10.0, 10.0, 0.5, 0.5, 1, 1)
    disc = Primitives(
        np.array([[0, 0, 2 - distance]]), np.array([[1.0, 0, 0, 0]]), np.full((1, 3), 0.5), np.array([0.9])
    )
    towards = np.array([[0.0, 0, -1]])
    surface = Surface(np.ones((1, 3)), np.ones(1), np.zeros(1), towards, towards)
    output = SimpleNamespace(image=np.array([[[0.0, 0, 0, 0.5 * 2]]]))  # the depth times the alpha
    points = SimpleNamespace(rows=np.array([0]), alpha=np.array([0.5]), surface=surface)
    seen = SimpleNamespace(camera=camera, primitives=disc)
    found = renderer._visibility(points, output, seen, Request(conventions=GSPLAT_MAIN, backend=backend))
    assert_allclose(found, [share], atol=CLOSED_FORM)


def test_pixels_without_a_surface_or_whose_normals_cancel_are_not_shaded():
    """Of three pixels the second has two normals that cancel, and the third alpha of less than half the least."""
    sums = np.zeros((1, 3, 12))
    sums[0, :, 6] = -0.5, 0.0, -1e-3
    blended = Blended(sums, np.array([[0.5, 0.5, 0.4 * GSPLAT_MAIN.alpha_min]]), normals=4, carried=7)
    rows = find_rows(blended, GSPLAT_MAIN.alpha_min / 2)
    assert rows.tolist() == [0]
    assert points_of(blended, rows, Camera(np.eye(3), np.zeros(3), 10.0, 10.0, 1.5, 0.5, 3, 1)).lengths == [0.5]


def test_the_first_row_of_the_table_is_of_a_grazing_view():
    """Of a cosine of 0.001, since the integral divides by it; the row after it is of 1 / 31."""
    by_row = [reflectance(np.full(1, mu), np.ones(1))[0] for mu in (0.0, 1 / 31)]
    assert_allclose(by_row, [integrate(np.full(1, mu), 1.0) for mu in (1e-3, 1 / 31)], rtol=1e-9)


@pytest.mark.parametrize("backend", [REFERENCE, CPU], ids=lambda backend: backend.name)
def test_a_hit_hides_no_more_than_alpha_max_and_no_less_than_alpha_min(backend):
    """Of a disc that is hit in its middle: 1 - alpha_max is left however opaque it is, and all if it is too faint."""
    limits = GSPLAT_MAIN.alpha_min, GSPLAT_MAIN.alpha_max
    ray = Rays(np.zeros((1, 3)), np.array([[0.0, 0, 1]]), np.zeros(1), np.full(1, np.inf))
    left = [
        transmittances(
            Primitives(np.array([[0, 0, 2.0]]), np.array([[1.0, 0, 0, 0]]), np.ones((1, 3)), np.array([opacity])),
            *(ray, GSPLAT_MAIN, backend),
        )[0]
        for opacity in (1 - 1e-9, 1.01 * limits[0], 0.99 * limits[0])
    ]
    assert_allclose(left, [1 - limits[1], 1 - 1.01 * limits[0], 1], rtol=CLOSED_FORM)
