"""Satellite: closed forms of RPCs, UTM, shadows and light; gradients; the degenerate case; bad input."""

from functools import partial

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import quad

from data_tools.claims.satellite import boxes
from minisplat_ref.constants import GSPLAT_MAIN
from minisplat_ref.errors import InputError
from minisplat_ref.extensions.extension import find_recipe
from minisplat_ref.extensions.satellite import cameras, rpc, utm
from minisplat_ref.extensions.satellite import model as formulas
from minisplat_ref.extensions.satellite.model import HAS_SHADOWS, IN_SHADOW, RADIOMETRY, SATELLITE
from minisplat_ref.extensions.satellite.recipe import (
    SEEN_FROM_ABOVE,
    begin_transparent,
    cast_shadows,
    fold_reference,
    hold_sky,
    opacity_sparsity,
    shadow_entropy,
    stages,
)
from minisplat_ref.mechanisms.cameras.affine import downward, orthographic, sun_slopes, with_affine
from minisplat_ref.oracle.agreement import agreement_cases
from minisplat_ref.oracle.pieces import tiny_setting
from minisplat_ref.rendering import SPLATTING, Request
from minisplat_ref.rendering.backends import CPU, REFERENCE
from minisplat_ref.training.initial_state import initial_state
from minisplat_ref.training.losses import Rendered
from minisplat_ref.training.schedule import firing_steps
from minisplat_ref.types import Camera, Model, Optics, view_from
from scenes import as_dtype
from tolerances import PARITY_FLOAT64

EXACT = 1e-12  # float64, a few operations
NORTH_UP = np.array([[1.0, 0, 0], [0, -1, 0]])  # pixels per world unit
FINE = 1e-8  # central differences of step 1e-5 on values near 1


# --- UTM and RPC ---


def test_utm_of_a_known_tower():
    """The CN Tower, 43 38 33.24 N, 79 23 13.7 W, is at 630084 E, 4833438 N of zone 17, to the metre."""
    longitude, latitude = -(79 + 23 / 60 + 13.7 / 3600), 43 + 38 / 60 + 33.24 / 3600
    assert utm.find_zone(longitude) == 17
    found = utm.utm_from_degrees(np.array([longitude]), np.array([latitude]), 17, is_south=False)
    assert np.abs(found - [630_084, 4_833_438]).max() < 1


def test_utm_of_a_meridian():
    """On its central meridian a zone is 0.9996 times the arc, 4,984,944.378 m to 45 degrees; south begins at 10^7."""
    found = utm.utm_from_degrees(np.full(2, 9.0), np.array([45.0, -45.0]), 32, is_south=False)
    arc = 0.9996 * 4_984_944.378
    assert np.abs(found - [[500_000, arc], [500_000, -arc]]).max() < 1e-3
    south = utm.utm_from_degrees(np.full(1, 9.0), np.array([-45.0]), 32, is_south=True)
    assert south[0, 1] == pytest.approx(1e7 - arc, abs=1e-3)
    with pytest.raises(InputError, match="84 degrees"):
        utm.utm_from_degrees(np.zeros(1), np.array([85.0]), 31, is_south=False)


@pytest.mark.parametrize("latitude", [3.0, 30.0, 61.0, 80.0])
def test_northings_are_arcs_of_the_meridian(latitude):
    """On a central meridian the northing is 0.9996 of the ellipse's arc, here by quadrature, to a micrometre."""
    a, f = 6_378_137.0, 1 / 298.257223563
    e2 = f * (2 - f)
    arc = quad(lambda phi: a * (1 - e2) / (1 - e2 * np.sin(phi) ** 2) ** 1.5, 0, np.radians(latitude), epsrel=1e-13)[0]
    found = utm.utm_from_degrees(np.full(1, 9.0), np.full(1, latitude), 32, is_south=False)
    assert np.abs(found - [500_000, 0.9996 * arc]).max() < 1e-6


@pytest.mark.parametrize("is_south", [False, True])
def test_utm_agrees_with_proj(is_south):
    """All over a zone and half a degree beyond, to a micrometre; what rasterio calls."""
    warp = pytest.importorskip("rasterio.warp")
    rng, code = np.random.default_rng(0), f"EPSG:{32732 if is_south else 32632}"
    longitudes, latitudes = rng.uniform(5.5, 12.5, 1000), rng.uniform(0, 84, 1000) * (-1 if is_south else 1)
    found = utm.utm_from_degrees(longitudes, latitudes, 32, is_south=is_south)
    assert np.abs(found - np.column_stack(warp.transform("EPSG:4326", code, longitudes, latitudes))).max() < 1e-6


def make_rpc(curved=0.0):
    """An RPC over 600 m in Rome, 0.5 m pixels, which a height shifts; ``curved`` adds cubics and a denominator."""
    numerators, denominators = np.zeros((2, 20)), np.zeros((2, 20))
    denominators[:, 0] = 1
    numerators[0, [1, 2, 3]] = 1.0, 0.1, 0.2  # sample: L, P, H
    numerators[1, [1, 2, 3]] = 0.1, -1.0, -0.1
    numerators[:, 10:] += curved
    denominators[:, 1:4] += curved
    degrees = 300 / 111_320
    return rpc.RPC(
        np.array([12.5, 41.9, 50.0]),
        np.array([degrees / np.cos(np.radians(41.9)), degrees, 100.0]),
        np.array([600.0, 600.0]),
        np.array([600.0, 600.0]),
        numerators,
        denominators,
    )


def text_of(r, style="txt"):
    """The text of an RPC."""
    names = [
        *zip(("LONG", "LAT", "HEIGHT"), r.ground_offset, r.ground_scale, strict=True),
        *zip(("SAMP", "LINE"), r.pixel_offset, r.pixel_scale, strict=True),
    ]
    lists = {
        "SAMP_NUM_COEFF": r.numerators[0],
        "LINE_NUM_COEFF": r.numerators[1],
        "SAMP_DEN_COEFF": r.denominators[0],
        "LINE_DEN_COEFF": r.denominators[1],
    }
    flat = {f"{name}_{end}": value for name, *both in names for end, value in zip(("OFF", "SCALE"), both, strict=True)}
    if style == "txt":
        lines = [f"{name}: {float(value)!r} degrees" for name, value in flat.items()]
        lines += [f"{name}_{k}: {float(v)!r}" for name, values in lists.items() for k, v in enumerate(values, 1)]
        return "\n".join(lines)
    back = {theirs: ours for ours, theirs in rpc._RPB_NAMES.items()}
    lines = [f"  {back[name]} = {float(value)!r};" for name, value in flat.items()]
    for name, values in lists.items():
        rows = ",\n".join(repr(float(v)) for v in values)
        lines.append(f"  {back[name]} = (\n{rows});")
    return 'satId = "X";\nBEGIN_GROUP = IMAGE\n' + "\n".join(lines) + "\nEND_GROUP = IMAGE\nEND;"


def test_monomials_have_the_order_of_rpc00b():
    """Each coefficient alone, at L, P, H = 2, 3, 5, by hand."""
    m, _ = rpc._monomials(np.array([[2.0, 3.0, 5.0]]))
    assert m[0].tolist() == [1, 2, 3, 5, 6, 10, 15, 4, 9, 25, 30, 8, 18, 50, 12, 27, 75, 20, 45, 125]


def test_derivatives_of_monomials():
    x, h = np.array([[0.3, -0.7, 0.4]]), 1e-6
    _, dm = rpc._monomials(x)
    for k in range(3):
        step = h * np.eye(3)[k]
        difference = (rpc._monomials(x + step)[0] - rpc._monomials(x - step)[0]) / (2 * h)
        assert np.abs(dm[:, k] - difference).max() < FINE


def test_projection_by_hand():
    """A scale of latitude north is 600 lines up and 60 samples right; the middle's centre is at 600.5."""
    r = make_rpc()
    ground = np.array([r.ground_offset, r.ground_offset + np.array([0, r.ground_scale[1], 0])])
    assert np.abs(rpc.project(r, ground) - [[600.5, 600.5], [660.5, 0.5]]).max() < 1e-9


def test_localisation_inverts_projection():
    r = make_rpc(0.01)
    rng = np.random.default_rng(0)
    pixels, heights = rng.uniform(0, 1200, (50, 2)), rng.uniform(0, 100, 50)
    ground = rpc.localise(r, pixels, heights)
    assert np.abs(rpc.project(r, ground) - pixels).max() < 1e-6
    assert np.abs(ground[:, 2] - heights).max() < EXACT * 100


def test_localisation_refuses_what_has_no_inverse():
    r = make_rpc()
    with pytest.raises(InputError, match="cannot be inverted"):
        rpc.localise(r._replace(numerators=np.ones((2, 20))), np.array([[3.0, 5.0]]), np.zeros(1))


@pytest.mark.parametrize("style", ["txt", "rpb"])
def test_texts_are_read(tmp_path, style):
    r, image = make_rpc(0.01), tmp_path / "a.png"
    (tmp_path / ("a_RPC.TXT" if style == "txt" else "a.RPB")).write_text(text_of(r, style))
    found = rpc.read_rpc(image)
    assert all(np.array_equal(a, b) for a, b in zip(found, r, strict=True))


def test_bad_texts_are_refused(tmp_path):
    text = text_of(make_rpc())
    for bad, message in (
        (text.replace("HEIGHT_OFF", "HIGHT_OFF"), "HEIGHT_OFF"),
        (text.replace("LINE_DEN_COEFF_20", "LINE_DEN_COEFF_21"), "out of order"),
        (text.replace("LAT_SCALE: ", "LAT_SCALE: 0 # "), "scale of the RPC is 0"),
    ):
        with pytest.raises(InputError, match=message):
            rpc.parse_rpc(bad, tmp_path / "x_RPC.TXT")
    with pytest.raises(InputError, match=r"no RPC; put b_RPC\.TXT beside it"):
        rpc.read_rpc(tmp_path / "b.png")


# --- the affine fit ---


def perspective(distance, gsd=0.3, size=500.0):
    """World points that pixels of a camera straight above see at altitudes of -50 to 50 m."""
    n = round(size / gsd)

    def world_of(pixels, altitudes):
        flat = (pixels - n / 2) * gsd * (distance - altitudes)[:, None] / distance
        return np.column_stack([flat * [1, -1], altitudes])

    return partial(cameras.fit_affine, world_of, n, n, (-50.0, 50.0), "photo")


def test_residual_of_a_perspective_camera():
    """A corner 353 m off the axis moves by 353 / 0.3 x 50 / 500,000 pixels between the middle and the top."""
    fit = perspective(500e3)()
    assert fit.worst == pytest.approx(353.5 / 0.3 * 50 / 500e3, rel=0.01)
    assert np.abs(fit.A[2] - [0, 0, 1]).max() < 1e-9  # the third row is the altitude
    with pytest.raises(InputError, match=r"photo: .*leaves 11.8 pixels"):
        perspective(5e3)()


def test_a_pixel_is_the_limit_of_a_fit():
    """From 70 km 353 / 0.3 x 50 / 70,000 = 0.84 pixels are left, and from 50 km 1.18."""
    assert perspective(70e3)().worst == pytest.approx(0.84, abs=0.01)
    with pytest.raises(InputError, match=r"leaves 1\.18 pixels"):
        perspective(50e3)()


def test_a_low_sun_shines():
    """A degree above the horizon it does, 0.03 degrees count as none."""
    low, set_ = (utm.sun_direction(10, elevation, 0) for elevation in (1, 0.03))
    assert sun_slopes(cameras.make_affine_camera(NORTH_UP, np.zeros(2), 1.0, (4, 4), low))[2] == pytest.approx(1)
    with pytest.raises(InputError, match="horizon"):
        cameras.make_affine_camera(NORTH_UP, np.zeros(2), 1.0, (4, 4), set_)


@pytest.mark.parametrize(("longitude", "zone"), [(-180, 1), (-174.1, 1), (-174, 2), (0, 31), (179.9, 60), (180, 1)])
def test_zones(longitude, zone):
    assert utm.find_zone(longitude) == zone


def test_fit_of_an_rpc():
    """An RPC without curvature is affine in degrees; UTM bends it by 0.03 pixels."""
    r = make_rpc()
    frame = cameras.choose_frame([r], (1200, 1200), (0.0, 100.0))
    assert (frame.zone, frame.is_south) == (33, False)
    fit = cameras.fit_rpc(r, frame, (1200, 1200), (0.0, 100.0), "a")
    assert fit.worst < 0.04
    ground = rpc.localise(r, np.array([[100.0, 900.0]]), np.array([80.0]))
    place = utm.utm_from_degrees(ground[:, 0], ground[:, 1], frame.zone, is_south=False)
    x = (np.append(place[0], 80.0) - frame.origin) / frame.scale
    assert np.abs(fit.A @ x + fit.b - [100, 900, 80 - frame.origin[2]]).max() < 0.05
    with pytest.raises(InputError, match=r"curved: .* pixels"):
        cameras.fit_rpc(make_rpc(0.01), frame, (1200, 1200), (0.0, 100.0), "curved")


def test_altitudes_have_to_be_a_range():
    with pytest.raises(InputError, match="--altitudes LOW,HIGH"):
        cameras.check_altitudes(None)
    for bad in ((5.0, 5.0), (3.0, 1.0), (0.0, np.nan)):
        with pytest.raises(InputError, match="no range"):
            cameras.check_altitudes(bad)
    with pytest.raises(InputError, match="horizon"):
        cameras.make_affine_camera(NORTH_UP, np.zeros(2), 1.0, (4, 4), np.array([1.0, 0, 0]))
    with pytest.raises(InputError, match="mirrored"):
        cameras.make_affine_camera(NORTH_UP * [-1, 1, 1], np.zeros(2), 1.0, (4, 4))


def test_an_affine_map_becomes_a_camera():
    """A sheared map of pixels that are not square comes back from rotation, focal lengths and shear; a unit is 48 m."""
    A, b = np.array([[30.0, 2.0, -9.0], [1.5, -41.0, 6.0]]), np.array([20.0, 31.0])
    camera = cameras.make_affine_camera(A, b, 48.0, (60, 40), np.array([2.0, -1.0, 4.0]))
    R = camera.cam_from_world_R
    assert np.abs(R @ R.T - np.eye(3)).max() < EXACT and np.linalg.det(R) == pytest.approx(1)
    assert np.abs(A @ R[2]).max() < EXACT * 100 and R[2, 2] < 0  # rays go down, and a pixel sees one of them
    assert camera.center == pytest.approx(-cameras.AWAY * R[2])
    found = downward(camera)
    assert_allclose(found.cam_from_world_R, [*A, [0, 0, -48]], atol=EXACT * 100)
    assert_allclose(found.cam_from_world_t, [*b, 0], atol=EXACT * 100)
    shift = found.cam_from_world_R[:2] @ sun_slopes(camera)  # a metre up, half a metre east, a quarter south
    assert_allclose(shift, A @ [0.5 / 48, -0.25 / 48, 1 / 48], rtol=1e-12)
    assert not sun_slopes(cameras.make_affine_camera(A, b, 48.0, (60, 40))).any()


def test_convergence_by_hand():
    """3 degrees east of a meridian at 60 N: atan(0.0524078 x 0.8660254) = 2.59867 degrees; west or south, minus it."""
    assert utm.grid_convergence(18.0, 60.0, 33) == pytest.approx(2.59867, abs=1e-5)
    assert utm.grid_convergence(12.0, 60.0, 33) == pytest.approx(-2.59867, abs=1e-5)
    assert utm.grid_convergence(18.0, -60.0, 33) == pytest.approx(-2.59867, abs=1e-5)


@pytest.mark.parametrize(("longitude", "latitude"), [(17.8, 55.0), (12.2, 33.0), (17.0, -70.0)])
def test_the_sun_in_the_north_is_where_utm_has_the_north(longitude, latitude):
    """A sun due north is along the meridian's image, by differences of UTM; one due east at a right angle to it."""
    places = utm.utm_from_degrees(np.full(2, longitude), latitude + np.array([-1e-4, 1e-4]), 33, is_south=latitude < 0)
    north = (places[1] - places[0]) / np.linalg.norm(places[1] - places[0])
    convergence = utm.grid_convergence(longitude, latitude, 33)
    assert_allclose(utm.sun_direction(0, 0, convergence)[:2], north, atol=2e-5)  # 0.001 degrees
    assert_allclose(utm.sun_direction(90, 0, convergence)[:2], [north[1], -north[0]], atol=2e-5)


def test_sun_by_hand():
    assert_allclose(utm.sun_direction(90, 45, 0), [0.5**0.5, 0, 0.5**0.5], atol=EXACT)
    assert_allclose(utm.sun_direction(32, 0, 2), [0.5, 0.75**0.5, 0], atol=EXACT)


# --- light ---


def test_shadow_by_hand():
    """The sun at 45 degrees in the west: 2 m east of a wall of 2 m the ground is dark as exp(-0.8), 3 m it is lit."""
    of_sun = np.zeros((1, 12))
    of_sun[0, 4] = 2.0  # the roof, where the sun's ray arrives that passes it
    tape = formulas.shadows(np.zeros((1, 4)), of_sun, (-1.0, 0.0), (4, 0))
    assert np.abs(tape.shadows - [[np.exp(-0.8), 1, 1, 1]]).max() < EXACT
    high = np.array([[0.0, 0.0, 2.0, 0.0]])  # pixel 2, 2 m high, is read 2 pixels to the right, at 4 + 2 + 2
    of_sun[0, 8] = 3.0
    tape = formulas.shadows(high, of_sun, (-1.0, 0.0), (4, 0))
    assert tape.shadows[0, 2] == pytest.approx(np.exp(-0.4))


def test_light_by_hand():
    radiometry = np.column_stack([np.diag([1.0, 2.0, 0.5]), [0.1, 0.0, 0.2]])
    found = formulas.light(np.full((1, 2, 3), 0.4), np.array([[1.0, 0.5]]), radiometry, np.array([0.0, 0.5, 1.0]))
    assert np.abs(found[0] - [[0.5, 0.8, 0.4], [0.25, 0.6, 0.4]]).max() < EXACT


@pytest.mark.parametrize("name", ["altitudes", "shadows", "light"])
def test_gradients(name):
    """Every entry against central differences."""
    rng = np.random.default_rng(1)
    h, of_sun = rng.uniform(0, 2, (4, 5)), rng.uniform(0, 3, (8, 9))
    arguments, function, gradient = {
        "altitudes": (
            (h, rng.uniform(0.02, 0.9, (4, 5))),
            formulas.altitudes,
            lambda v, *a: formulas.altitudes_vjp(*a, v),
        ),
        "shadows": (
            (h, of_sun, np.array([0.7, -0.4])),
            lambda a, b, g: formulas.shadows(a, b, g, (2, 2)).shadows,
            lambda v, a, b, g: formulas.shadows_vjp(formulas.shadows(a, b, g, (2, 2)), v),
        ),
        "light": (
            (rng.uniform(size=(4, 5, 3)), rng.uniform(size=(4, 5)), rng.normal(size=(3, 4)), rng.uniform(size=3)),
            formulas.light,
            lambda v, *a: formulas.light_vjp(*a, v),
        ),
    }[name]
    v = rng.normal(size=function(*arguments).shape)
    for k, found in enumerate(gradient(v, *arguments)):
        expected = np.zeros_like(arguments[k])
        for index in np.ndindex(*expected.shape):
            sides = []
            for sign in (1, -1):
                moved = [a.copy() for a in arguments]
                moved[k][index] += sign * 1e-6
                sides.append(np.sum(v * function(*moved)))
            expected[index] = (sides[0] - sides[1]) / 2e-6
        assert np.abs(expected).max() > 0.01
        assert np.abs(found - expected).max() < FINE


def test_slopes_at_the_kinks():
    """On a kink the gradient is the slope of one side: lit where h = h_s, the right cell on a border between cells."""
    of_sun, d = np.array([[1.0, 3.0, 2.0]]), 1e-6

    def shadow(h):  # of a pixel over the sun's middle one
        return formulas.shadows(np.full((1, 1), h), of_sun, (0.0, 0.0), (1, 0))

    at = shadow(3.0)
    right, left = (shadow(3.0 + d).shadows - at.shadows) / d, (at.shadows - shadow(3.0 - d).shadows) / d
    assert right[0, 0] == 0 and left[0, 0] == pytest.approx(formulas.DARKENING, rel=1e-5)
    assert [float(v.sum()) for v in formulas.shadows_vjp(at, np.ones((1, 1)))] == [0, 0, 0]
    image, x, y = of_sun[..., None], np.full((1, 1), 1.5), np.full((1, 1), 0.5)
    read = formulas.sample(image, x, y)
    sides = [(formulas.sample(image, x + sign * d, y).values - read.values)[0, 0, 0] / (sign * d) for sign in (1, -1)]
    assert sides == pytest.approx([-1.0, 2.0])
    assert formulas.sample_vjp(read, image.shape, np.ones((1, 1, 1)))[1][0, 0, 0] == pytest.approx(-1.0)
    edge = formulas.sample(image, x + 1, y)  # the last centre: constant beyond it
    assert formulas.sample_vjp(edge, image.shape, np.ones((1, 1, 1)))[1][0, 0, 0] == 0


# --- the renderer ---


@pytest.fixture(scope="module")
def setting():
    """A tiny scene seen by parallel rays."""
    found = tiny_setting(GSPLAT_MAIN)
    camera = found.camera._replace(fx=found.camera.fx / 3, fy=found.camera.fy / 3)
    flat = found.gaussians._replace(sh_rest=found.gaussians.sh_rest[:, :0])
    return found._replace(camera=camera, gaussians=flat)


@pytest.mark.parametrize("backend", [REFERENCE, CPU], ids=lambda b: b.name)
def test_without_sun_and_radiometry_it_is_plain_splatting(setting, backend):
    """The same bytes as splatting by an orthographic camera, image and gradients."""
    model, view = Model(setting.gaussians), view_from(setting.camera)
    request = Request(setting.background, wants=frozenset({"depth"}), backend=backend)
    lit = Model(setting.gaussians, {RADIOMETRY: np.eye(3, 4)[None], IN_SHADOW: np.full((1, 3), 0.05)})
    found, tape = SATELLITE.render(lit, view, request)
    plain_request = request._replace(backend=with_affine(backend, orthographic))
    plain, plain_tape = SPLATTING.render(model, view, plain_request)
    assert np.array_equal(found.image, plain.image)
    v = np.random.default_rng(0).normal(size=plain.image.shape)
    ours, theirs = SATELLITE.render_vjp(tape, v, None), SPLATTING.render_vjp(plain_tape, v)
    for name in ("means", "quats", "log_scales", "opacity_logits", "sh_dc"):
        expected = getattr(theirs.gaussians, name)
        assert np.abs(getattr(ours.gaussians, name) - expected).max() <= 1e-13 * np.abs(expected).max()


def test_a_lone_gaussian_does_not_shade_itself(setting):
    """A tie, not a kink: h and h_s are equal but for rounding, s is 1, and what both get from it cancels."""
    g = type(setting.gaussians)(*(field[:1] for field in setting.gaussians))
    g = g._replace(means=np.array([[0.0, 0.0, 0.3]]), opacity_logits=np.array([4.0]))
    camera = boxes.zenith(24)._replace(optics=Optics("affine", (0.0, 1.0, 0.31 / 12, 0.17 / 12, 1.0)))  # 12 px a unit
    request = Request(backend=REFERENCE, wants=frozenset({"shadow"}))
    output, tape = SATELLITE.render(Model(g), view_from(camera), request)
    shadow = output.image[..., 3]
    is_seen = output.alpha > 0.2  # both altitudes are those of the Gaussian
    assert is_seen.sum() > 20 and np.abs(shadow[is_seen] - 1).max() < EXACT
    v = np.zeros_like(output.image)
    v[..., 3] = is_seen
    found = SATELLITE.render_vjp(tape, v).gaussians
    assert max(np.abs(field).max() for field in found if field.size) < EXACT * is_seen.sum()


def test_a_roof_hides_the_sun():
    """A slab 10 m above the ground throws its shadow where the sun says, and only there; rows are of the photograph."""
    rng = np.random.default_rng(0)
    truth = boxes.make_scene(0, n_points=10, size=16)
    state = initial_state(truth.scene, find_recipe("satellite", 10), 0)
    grid = np.stack(np.meshgrid(*[np.linspace(-1, 1, 24)] * 2), axis=-1).reshape(-1, 2)
    ground = np.column_stack([grid, np.zeros(len(grid))])
    roof = ground[np.abs(grid).max(axis=1) < 0.3] + [0, 0, 10 / boxes.SCALE]
    means = np.concatenate([ground, roof])
    n = len(means)
    g = state.gaussians._replace(
        means=means,
        quats=np.tile([1.0, 0, 0, 0], (n, 1)),
        log_scales=np.log(np.tile([0.06, 0.06, 0.002], (n, 1))),
        opacity_logits=np.full(n, 5.0),
        sh_dc=rng.normal(size=(n, 3)) * 0,
        sh_rest=np.zeros((n, 0, 3)),
    )
    zenith = boxes.zenith(16)
    camera = zenith._replace(optics=Optics("affine", (0.0, 48.0, -2.4, 0.0, 1.0)))  # 4 pixels for 10 m, from the west
    model = Model(g, {RADIOMETRY: np.tile(np.eye(3, 4), (2, 1, 1)), IN_SHADOW: np.array([[0.9] * 3, [0.2] * 3])})
    request = Request(backend=REFERENCE, wants=frozenset({"shadow", "albedo", "altitude"}))
    view = view_from(camera)._replace(view_id=1)
    image = SATELLITE.render(model, view, request)[0].image
    shadow, h = image[..., -1], image[..., 6]
    assert h[8, 8] == pytest.approx(10, abs=0.5) and abs(h[8, 1]) < 0.5
    assert shadow[8, 12] < 0.1 and shadow[8, 3] > 0.9 and shadow[8, 8] > 0.9
    expected = (shadow + (1 - shadow) * 0.2)[..., None] * image[..., 3:6]
    assert np.abs(image[..., :3] - expected).max() < EXACT


def test_folding_changes_no_photograph(setting):
    """Colours take over the reference's radiometry: an opaque scene looks the same in every photograph."""
    truth = boxes.make_scene(0, n_points=4, size=8)
    state = initial_state(truth.scene, find_recipe("satellite", 10), 0)
    rng = np.random.default_rng(3)
    state.gaussians = state.gaussians._replace(
        log_scales=np.full_like(state.gaussians.log_scales, 1.0),
        opacity_logits=np.full_like(state.gaussians.opacity_logits, 9.0),
        sh_dc=rng.uniform(-0.3, 0.3, state.gaussians.sh_dc.shape).astype(np.float32),
    )
    state.shared[RADIOMETRY] += 0.1 * rng.normal(size=state.shared[RADIOMETRY].shape).astype(np.float32)
    views, request = truth.scene.train_views, Request(backend=REFERENCE)
    before = [SATELLITE.render(state.model, view, request)[0].image for view in views]
    assert fold_reference(state, None) is None
    assert np.abs(state.shared[RADIOMETRY][0] - np.eye(3, 4)).max() < 1e-6
    assert np.abs(state.shared[RADIOMETRY][1] - np.eye(3, 4)).max() > 0.05
    after = [SATELLITE.render(state.model, view, request)[0].image for view in views]
    assert np.abs(np.array(after) - before).max() < 1e-3  # 1 - alpha of 1e-4, and float32


def test_a_reference_without_colours_is_not_folded():
    """A matrix that is all but of rank 2 has no inverse to speak of: nothing changes, and the log says why."""
    state = initial_state(boxes.make_scene(0, n_points=4, size=8).scene, find_recipe("satellite", 10), 0)
    state.shared[RADIOMETRY][0, :, :3] = np.diag([1.0, 1.0, 1e-7])
    before = state.gaussians.sh_dc.copy(), state.shared[RADIOMETRY].copy()
    assert "cannot be inverted" in fold_reference(state, None)
    assert np.array_equal(state.gaussians.sh_dc, before[0]) and np.array_equal(state.shared[RADIOMETRY], before[1])


def shadow_of_towers(setting, *towers):
    """The shadow [16, 16] of towers (x, metres) on a plane; the sun in the west at 45 degrees, 8 pixels for 10 m."""
    grid = np.stack(np.meshgrid(*[np.linspace(-3, 3, 73)] * 2), axis=-1).reshape(-1, 2)
    heights = np.zeros(len(grid))
    for x, height in towers:
        heights[np.abs(grid[:, 0] - x) < 0.2] = height / boxes.SCALE
    n = len(grid)
    g = setting.gaussians._replace(
        means=np.column_stack([grid, heights]),
        quats=np.tile([1.0, 0, 0, 0], (n, 1)),
        log_scales=np.log(np.tile([0.06, 0.06, 0.002], (n, 1))),
        opacity_logits=np.full(n, 5.0),
        sh_dc=np.zeros((n, 3)),
        sh_rest=np.zeros((n, 0, 3)),
    )
    camera = boxes.zenith(16)._replace(optics=Optics("affine", (0.0, 48.0, -4.8, 0.0, 1.0)))
    request = Request(backend=REFERENCE, wants=frozenset({"shadow"}))
    return SATELLITE.render(Model(g), view_from(camera), request)[0].image[..., 3]


def test_what_is_beside_the_image_throws_shadows_into_it(setting):
    """Of 10 m, 6 pixels west of an image of 16: 8 pixels to the east are 2."""
    shadow = shadow_of_towers(setting, (-1.75, 10))
    assert shadow[8, 1] < 0.2 and shadow[8, 6] > 0.9


def test_a_roof_at_the_border_is_shaded_by_what_is_higher(setting):
    """Of 10 m, at pixel 14.5; 8 pixels west of it 20 m. The sun's image has both at 22.5, where the photograph ends."""
    assert shadow_of_towers(setting, (0.8125, 10))[8, 14] > 0.9
    assert shadow_of_towers(setting, (0.8125, 10), (-0.1875, 20))[8, 14] < 0.2


def test_loss_terms_by_hand(setting):
    truth = boxes.make_scene(0, n_points=8, size=4)
    g = setting.gaussians._replace(opacity_logits=np.array([0.0, np.log(3.0)]))
    output = SATELLITE.render(Model(setting.gaussians), view_from(setting.camera), Request(backend=REFERENCE))[0]
    s = np.array([[0.5, 1.0], [0.25, 0.0]])[..., None]
    rendered = Rendered(
        output._replace(image=s),
        {"shadow": slice(0, 1)},
        truth.scene.train_views[0],
        truth.scene,
        Model(g),
        1,
        Request(),
    )
    assert opacity_sparsity(rendered)[0] == pytest.approx((0.5 + 0.75) / 8)
    bits = 1 + 0.25 * np.log2(4) + 0.75 * np.log2(4 / 3) - 2 * np.log2(0.95)  # what is surely lit or dark has little
    value, v = shadow_entropy(rendered)
    assert value == pytest.approx(bits / 4)
    slopes = [0.0, -np.log2(19) / 4, np.log2(3) / 4, np.log2(19) / 4]
    assert v.channels["shadow"].ravel().tolist() == pytest.approx(slopes)


def test_other_cameras_are_refused(setting):
    bent = setting.camera._replace(optics=Optics("fisheye", (0.0,) * 4))
    with pytest.raises(InputError, match="affine cameras, not fisheye"):
        SATELLITE.render(Model(setting.gaussians), view_from(bent), Request())
    with pytest.raises(InputError, match="does not give surface"):
        SATELLITE.render(Model(setting.gaussians), view_from(setting.camera), Request(wants=frozenset({"surface"})))


def test_shadows_begin_at_their_date():
    """Before, a photograph has its albedo; from iteration 1,000 of 5,000 on it is shaded, and two losses count."""
    recipe, truth = find_recipe("satellite"), boxes.make_scene(0, n_points=200, size=12)
    state = initial_state(truth.scene, recipe, 0)
    state.gaussians = state.gaussians._replace(opacity_logits=np.full_like(state.gaussians.opacity_logits, 3.0))
    request, view = Request(wants=frozenset({"shadow", "albedo"})), truth.scene.train_views[0]

    def shadow_of():
        output, tape = SATELLITE.render(state.model, view, request)
        v = SATELLITE.render_vjp(tape, np.ones_like(output.image))
        assert v.shared[HAS_SHADOWS] == 0
        return output.image[..., SATELLITE.channels(request.wants)["shadow"]]

    assert (shadow_of() == 1).all()
    cast_shadows(state, None)
    assert shadow_of().min() < 0.9
    assert firing_steps(recipe, cast_shadows) == [1_000]
    for name in ("view_consistency", "shadow_entropy"):
        [term] = [term for term in recipe.losses if term.name == name]
        assert not term.is_due(1_000) and term.is_due(1_001)


def test_light_in_shadows_stays_between_none_and_the_sun_s():
    state = initial_state(boxes.make_scene(0, n_points=8, size=4).scene, find_recipe("satellite", 10), 0)
    state.shared[IN_SHADOW][:2] = [[-0.1, 0.3, 1.7], [0.0, 1.0, 2.0]]
    hold_sky(state, None)
    assert_allclose(state.shared[IN_SHADOW][:2], [[0, 0.3, 1], [0, 1, 1]], rtol=1e-6)


def test_a_transparent_start():
    """All have an opacity of 0.005 and half their size; the moments of the opacities, which point up, are forgotten."""
    state = initial_state(boxes.make_scene(0, n_points=8, size=4).scene, find_recipe("satellite", 10), 0)
    before = np.exp(state.gaussians.log_scales)
    state.adam.first.opacity_logits[:] = 1
    begin_transparent(state, None, opacity=0.005, size=0.5)
    assert np.abs(1 / (1 + np.exp(-state.gaussians.opacity_logits)) - 0.005).max() < 1e-8  # float32
    assert np.abs(np.exp(state.gaussians.log_scales) / before - 0.5).max() < 1e-6
    assert not state.adam.first.opacity_logits.any()


def test_limits_below_the_ground():
    """The same photographs, of a world whose origin is 8 m lower: a point on the ground is seen at the same pixel."""
    plain, low = (boxes.make_scene(0, n_points=50, size=8, below=below) for below in (0.0, 8.0))
    assert np.abs(low.heights - plain.heights - 8).max() < EXACT * 100
    assert low.scene.points[:, 2].max() > 30 / boxes.SCALE and low.scene.points.min(axis=0)[2] >= 0
    for a, b in zip(plain.scene.train_views, low.scene.train_views, strict=True):
        assert np.array_equal(a.image, b.image)
        at = np.array([0.2, -0.3, 0.1])
        a, b = downward(a.camera), downward(b.camera)
        seen = a.cam_from_world_R @ at + a.cam_from_world_t
        moved = b.cam_from_world_R @ np.add(at, [0, 0, 8 / boxes.SCALE]) + b.cam_from_world_t
        assert np.abs(moved - seen - [0, 0, -8]).max() < EXACT * 100  # the depth is minus the altitude


def test_representation():
    assert SEEN_FROM_ABOVE.takes_optics
    assert isinstance(boxes.zenith(), Camera)


def test_backends_agree_on_what_is_highest(rng):
    """Altitudes are negative depths; of what fills a volume and is opaque, a camera sees the top."""
    truth = boxes.make_scene(0, n_points=400, size=16)
    state = initial_state(truth.scene, find_recipe("satellite", 10), 0)
    g = state.gaussians._replace(opacity_logits=np.full(400, 3.0), log_scales=state.gaussians.log_scales + 0.5)
    wants = frozenset({"albedo", "altitude", "shadow"})
    images = []
    for backend in (REFERENCE, CPU):
        request = Request(backend=backend, wants=wants)
        model = Model(as_dtype(g, np.float64), state.shared)
        images.append(SATELLITE.render(model, truth.scene.train_views[1], request)[0].image)
    assert_allclose(images[1], images[0], atol=PARITY_FLOAT64)
    assert np.median(images[0][..., 6]) > 0.7 * boxes.HIGH


@pytest.mark.parametrize("is_wrong", [False, True])
def test_the_oracle_finds_a_wrong_order_of_altitudes(is_wrong, monkeypatch):
    """Negative floats in the order of their bits, as they once were: no gradient is wrong then."""
    if is_wrong:
        monkeypatch.setattr("minisplat_ref.cpu.tiling.depth_keys", lambda depths: depths.view(np.int64))
    own, compared = agreement_cases((REFERENCE, CPU), GSPLAT_MAIN, SEEN_FROM_ABOVE, stages)
    assert own == [] and [case.passed for case in compared] == [True, not is_wrong]
    assert "affine" in compared[1].name
