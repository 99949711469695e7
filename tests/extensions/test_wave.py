"""Wave splatting: closed forms, brute force, propagation, blending and occlusion, placement, and what is refused."""

import re

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from data_tools.claims.wave import measures as claims
from data_tools.claims.wave.measures import facing, tilted
from minisplat_ref.app.cli import main
from minisplat_ref.constants import GSPLAT_MAIN
from minisplat_ref.errors import InputError
from minisplat_ref.extensions.wave import blending
from minisplat_ref.extensions.wave.blending import Scene, front_to_back
from minisplat_ref.extensions.wave.focus import decode_phases, encode_phases
from minisplat_ref.extensions.wave.hologram import place, steepest_slope
from minisplat_ref.extensions.wave.kernels import sum_spectra
from minisplat_ref.extensions.wave.model import (
    Flats,
    Grid,
    check_sampling,
    compute_field,
    compute_spectrum,
    grid_waves,
    make_waves,
    propagate,
    spectra,
    spectrum,
    transfer,
)
from minisplat_ref.reference.covariance import rotation_matrices
from minisplat_ref.types import Camera, Gaussians
from tolerances import (
    CLOSED_FORM,
    PARITY_FLOAT64,
    WAVE_ENCODING,
    WAVE_PARAXIAL,
    WAVE_PHASE,
    WAVE_WINDOW,
)

LAMBDA = 520e-9
GRID = Grid(60, 48, 8e-6)


def cloud(rng, n=8):
    """Tilted Gaussians of 2 to 3 pixels inside the grid, at all distances, from front to back."""
    centers = np.column_stack([rng.uniform(-7e-5, 7e-5, (n, 2)), rng.uniform(-1e-3, 1e-3, n)])
    axes = rotation_matrices(np.column_stack([np.ones(n), 0.15 * rng.normal(size=(n, 3))]))
    flats = Flats(centers, axes, rng.uniform(1.6e-5, 2.4e-5, (n, 2)))
    return front_to_back(Scene(flats, rng.uniform(0.3, 1, n), rng.uniform(0.2, 1, (n, 3))))


def images_of(flats, grid=GRID):
    return np.stack([claims.image_of(flats.one(i), grid).real for i in range(len(flats.centers))])


# --- the closed form ---


def test_a_gaussian_that_faces_the_viewer_by_hand():
    """In its plane the spectrum is that of a 2D Gaussian; a quarter of a wavelength before it the peak turns by i."""
    flats = facing([[2.0, 0.5, 3.0]], [0.7])
    waves = make_waves(np.array([0.0, 0.25]), np.array([0.0, 0.0]), 1.0)
    peak = 2 * np.pi * 0.49
    expected = [peak, peak * np.exp(-2 * np.pi**2 * 0.49 * 0.0625) * np.exp(-2j * np.pi * 0.25 * 2.0)]
    slowed = np.exp(2j * np.pi * 0.25 * np.sqrt(1 - 0.0625))
    assert_allclose(spectra(flats, waves, 3.0)[0], expected, rtol=CLOSED_FORM * 10)
    assert_allclose(spectra(flats, waves, 3.25)[0], [1j * peak, expected[1] * slowed], rtol=CLOSED_FORM * 10)


def test_in_its_own_plane_it_is_its_image():
    flats = facing([[1.3e-5, -2e-5, 0.4e-3]], [2e-5])
    waves = grid_waves(GRID, LAMBDA)
    G = spectra(flats, waves._replace(k=waves.k.reshape(-1, 3)), 0.4e-3).reshape(waves.k.shape[:2])
    u = compute_field(G, waves, GRID)[: GRID.height, : GRID.width]
    assert_allclose(np.abs(u), images_of(flats)[0], atol=WAVE_PHASE)


def test_evanescent_waves_carry_nothing():
    waves = make_waves(np.array([0.0, 1.2, 0.8]), np.array([0.0, 0.0, 0.8]), 1.0)
    assert_array_equal(spectra(facing([[0, 0, 0]], [0.1]), waves)[0] != 0, [True, False, False])


def test_the_kernel_sums_the_same(rng):
    scene, waves, weights = cloud(rng), grid_waves(GRID, LAMBDA), rng.normal(size=8)
    expected = spectrum(scene.flats, weights, waves._replace(k=waves.k.reshape(-1, 3)), 2e-4)
    got = sum_spectra(scene.flats, weights, waves, 2e-4)
    assert_allclose(got.ravel(), expected, atol=WAVE_PHASE * np.abs(expected).max())


def test_the_gradient_of_the_closed_form(capsys):
    assert main(["oracle", "gradients", "--extension", "wave", "--backend", "reference"]) == 0
    assert "spectrum: Jacobian" in capsys.readouterr().out


# --- propagation ---


def test_a_beam_spreads_as_it_should():
    """A Gaussian of standard deviation s has the Rayleigh range 2 pi s^2 / lambda, where its peak is 1 / sqrt(2)."""
    grid, s = Grid(96, 96, 8e-6), 4e-5
    beam = claims.image_of(facing([[4e-6, 4e-6, 0]], [s]), grid)  # on the centre of a pixel
    z = 2 * np.pi * s**2 / LAMBDA
    moved = propagate(beam, grid, LAMBDA, z)
    peak = moved[grid.height // 2, grid.width // 2]
    assert_allclose(np.abs(peak), np.sqrt(0.5), rtol=WAVE_PARAXIAL)
    assert_allclose(np.angle(peak * np.exp(-2j * np.pi * z / LAMBDA)), -np.pi / 4, atol=WAVE_PARAXIAL * np.pi)


def test_there_and_back_is_the_field_itself(rng):
    waves = grid_waves(GRID, LAMBDA)
    field = rng.normal(size=(96, 120)) + 1j * rng.normal(size=(96, 120))
    H = transfer(waves, GRID, 1e-4) * transfer(waves, GRID, -1e-4)
    assert_allclose(compute_field(compute_spectrum(field, waves, GRID) * H, waves, GRID), field, atol=WAVE_PHASE)


def test_light_that_would_cross_the_margin_is_left_out():
    """W / z is the tangent of the steepest angle, so the frequency is its sine over the wavelength."""
    z = 25e-3
    H = transfer(grid_waves(GRID, LAMBDA), GRID, z)
    fx = np.abs(np.fft.fftfreq(120, GRID.pitch))
    sines = np.sin(np.arctan(60 * 8e-6 / z))
    assert_array_equal(np.abs(H[0]) > 0, fx <= sines / LAMBDA)
    assert 0 < np.count_nonzero(H[0]) < 120
    assert np.count_nonzero(H[:, 0]) < np.count_nonzero(H[0]) * 96 / 120  # the shorter side is the stricter


# --- blending ---


@pytest.mark.parametrize("way", [blending.blend, blending.blend_silhouettes])
def test_in_one_plane_waves_blend_like_colours(way, rng):
    """With everything at the display, the absolute value is what 3DGS composites."""
    flats = facing(np.column_stack([rng.uniform(-1e-4, 1e-4, (5, 2)), np.zeros(5)]), rng.uniform(1.6e-5, 4e-5, 5))
    scene = Scene(flats, rng.uniform(0.3, 1, 5), rng.uniform(size=(5, 3)))
    alphas, image, T = scene.opacities[:, None, None] * images_of(flats), 0, 1
    for alpha, color in zip(alphas, scene.amplitudes[:, 2], strict=True):
        image, T = image + T * alpha * color, T * (1 - alpha)
    assert_allclose(np.abs(way(scene, GRID, LAMBDA, 2)), image, atol=WAVE_WINDOW * 1e-2)


def test_what_is_behind_hides_nothing():
    """The same screen behind the Gaussian: exact and fast blending leave it as bright as without."""
    flats = facing([[4e-6, 4e-6, 1e-3], [4e-6, 4e-6, -1e-3]], [2e-5, 2e-4])
    lit, dark = np.array([[1.0] * 3, [0.0] * 3]), np.array([1.0, 0.9])
    scene = Scene(flats, dark, lit)
    alone = blending.blend(Scene(flats.one(0), dark[:1], lit[:1]), GRID, LAMBDA, 0)
    for way in (blending.blend, blending.blend_fast):
        assert_allclose(way(scene, GRID, LAMBDA, 0), alone, atol=PARITY_FLOAT64)
    back_to_front = Scene(Flats(*(f[::-1] for f in flats)), dark[::-1], lit[::-1])
    assert_array_equal(front_to_back(back_to_front).flats.centers, flats.centers)


def test_transmittances_by_hand():
    flats = facing([[0, 0, 3e-3], [0, 2e-5, 2e-3], [0, 2e-5, 1e-3]], [2e-5, 1e-5, 1e-5])
    scene = Scene(flats, np.array([0.5, 0.25, 1.0]), np.ones((3, 3)))
    passed = 1 - 0.5 * np.exp(-0.5)
    assert_allclose(blending.center_transmittances(scene), [1, passed, passed * 0.75], rtol=CLOSED_FORM)


def test_gaussians_side_by_side_have_no_use_for_blending():
    flats = facing([[-1.2e-4, 0, 2e-4], [1.2e-4, 0, -2e-4]], [1e-5, 1e-5])
    scene = Scene(flats, np.array([0.5, 1.0]), np.ones((2, 3)))
    exact, fast = (way(scene, GRID, LAMBDA, 0) for way in (blending.blend, blending.blend_fast))
    assert_allclose(fast, exact, atol=WAVE_WINDOW)
    assert np.abs(exact).max() > 0.5


@pytest.mark.parametrize(
    ("way", "in_windows"),
    [
        (blending.blend, blending.blend_windows),
        (blending.blend_silhouettes, blending.blend_silhouette_windows),
    ],
)
def test_windows_are_the_same_blending(way, in_windows, rng):
    scene = cloud(rng)
    exact = way(scene, GRID, LAMBDA, 1)
    error = np.abs(in_windows(scene, GRID, LAMBDA, 1, n_planes=2000) - exact).max()
    assert error < WAVE_WINDOW < 0.1 * np.abs(exact).max()
    few = np.abs(in_windows(scene, GRID, LAMBDA, 1, n_planes=2) - exact).max()
    assert error < few < 0.2 * np.abs(exact).max()  # which is why there are 64 planes


@pytest.mark.parametrize(("pixels", "error"), [(0.55, 0.02), (1.0, 0.001), (2.0, WAVE_WINDOW)])
def test_windows_leave_out_the_ringing_of_narrow_gaussians(pixels, error):
    """As the docstring promises."""
    scene = Scene(facing([[3e-6, 2e-6, 5e-4]], [pixels * 8e-6]), np.ones(1), np.ones((1, 3)))
    exact, in_window = (way(scene, GRID, LAMBDA, 0) for way in (blending.blend, blending.blend_windows))
    assert np.abs(exact - in_window).max() < error


def test_a_window_may_leave_the_grid():
    beside = facing([[-2.4e-4, 0, 0], [1e-2, 0, 0]], [2e-5, 2e-5])  # half outside; far outside
    field = blending.blend_windows(Scene(beside, np.ones(2), np.ones((2, 3))), GRID, LAMBDA, 0)
    assert_allclose(np.abs(field), images_of(beside)[0], atol=WAVE_WINDOW)


def test_planes_are_the_nearest():
    planes = blending.make_planes(np.array([4.0, 3.4, 3.0, 1.0, 0.0]), 5)
    assert_array_equal(planes.z, [4, 3, 2, 1, 0])
    assert_array_equal(planes.of, [0, 1, 1, 3, 4])
    assert_array_equal(blending.make_planes(np.array([1.0, 1.0]), 5).z, [1.0])


# --- focus ---


def test_phases_alone_show_amplitudes():
    phases, peak = encode_phases(np.array([[1.0, 0.5j], [0.5, 0.0]]))
    third = np.pi / 3
    expected = [[0, np.pi / 2 - third], [2 * np.pi - third, np.pi / 2]]
    assert peak == 1
    assert_allclose(phases, expected, atol=CLOSED_FORM * 10)
    rows = np.linspace(0, np.pi, GRID.height)[:, None]
    field = (0.6 + 0.2 * np.cos(np.linspace(0, 6, GRID.width))) * np.exp(0.7j * np.sin(rows))
    shown = decode_phases(*encode_phases(field), GRID, LAMBDA)
    inside = slice(8, -8), slice(8, -8)  # away from the edge of the display, where the amplitude ends
    assert np.abs(shown - field)[inside].max() < WAVE_ENCODING * 2
    assert np.abs(encode_phases(np.zeros((2, 2), complex))[0] - np.pi / 2).max() > 1  # black: half a turn apart


# --- what aliases ---


def pitch_in(message):
    return float(re.search(r"a pitch of ([\d.]+) um fits", message)[1]) * 1e-6


def test_a_pitch_that_is_too_coarse_names_one_that_fits():
    """A steep Gaussian is narrow in its image: 10 um at 80 degrees is 1.7 um."""
    flats = tilted(80, np.zeros(3), np.array([1e-5, 1e-5]))
    narrow = 1e-5 * np.cos(np.radians(80))
    with pytest.raises(InputError, match=r"steepest Gaussian, whose image .* 1\.74 um") as raised:
        check_sampling(flats, GRID, [LAMBDA], 0.0)
    fits = pitch_in(str(raised.value))
    assert 0.98 * narrow / 0.53 < fits < narrow / 0.53
    check_sampling(flats, GRID._replace(pitch=fits), [LAMBDA], 0.0)


def test_a_pitch_that_is_too_fine_names_one_that_fits():
    """Light of 638 nm leaves pixels of 1 um at an angle of 18.6 degrees, and crosses 100 um in 0.3 mm."""
    flats, grid = facing(np.zeros((1, 3)), [2e-5]), Grid(100, 120, 1e-6)
    crossing = 100e-6 / np.tan(np.arcsin(0.319))
    check_sampling(flats, grid, [450e-9, 638e-9], 0.999 * crossing)
    with pytest.raises(InputError, match="638 nm leave so steeply") as raised:
        check_sampling(flats, grid, [450e-9, 638e-9], 1.01 * crossing)
    fits = pitch_in(str(raised.value))
    assert 1e-6 < fits < 1.03e-6
    check_sampling(flats, Grid(round(1e-4 / fits), 120, 1e-4 / round(1e-4 / fits)), [638e-9], crossing)


# --- placement ---

CAMERA = Camera(np.eye(3), np.zeros(3), 50.0, 50.0, 24.0, 16.0, 48, 32)


def discs(means, quats, scales):
    n = len(means)
    log_scales = np.log(np.column_stack([np.reshape(scales, (n, 2)), np.full(n, 1e-6)]))
    grey, bare = np.zeros((n, 3)), np.zeros((n, 0, 3))
    return Gaussians(np.array(means, float), np.array(quats, float), log_scales, np.full(n, 20.0), grey, bare)


def put(gaussians, steepest=1e9, conventions=GSPLAT_MAIN, thickness=2e-3):
    return place(gaussians, CAMERA, 48 * 8e-6, thickness, steepest, conventions)


def test_a_disc_that_faces_the_camera_by_hand():
    """At depth 2 a pixel is 1/25 wide. The box has depths 1 to 4, whose middle in 1 / Z is 1.6."""
    facing_discs = discs([[0, 0, 1], [0.2, -0.4, 2], [0, 0, 4]], [[1, 0, 0, 0]] * 3, [[0.04, 0.08]] * 3)
    placed = put(facing_discs)
    assert placed.n_thick == placed.n_steep == 0
    assert_allclose([placed.box.nearest, placed.box.farthest], [1, 4], rtol=0.03)  # all but a hundredth
    z = 2e-3 * (0.5 - (1 / placed.box.nearest + 1 / placed.box.farthest) / 2)
    z /= 1 / placed.box.nearest - 1 / placed.box.farthest
    assert_allclose(placed.scene.flats.centers[1], [8e-6 * 5, -8e-6 * 10, z], rtol=1e-12)
    expected = 8e-6**2 * np.diag([1.0 + 0.3, 4.0 + 0.3])
    # The slope of the disc in the box is 0 on the axis alone, and there is no shear off it.
    assert_allclose(placed.scene.flats.lateral_covariances[1], expected, rtol=1e-9, atol=1e-18)
    assert_array_equal(placed.scene.opacities, 0.99)
    assert_allclose(placed.scene.amplitudes, 0.5)


def test_planes_stay_planes():
    """The normal in the box is perpendicular to where the plane's other points are taken, without the low-pass."""
    quat = np.array([[0.9, 0.3, -0.2, 0.1]])
    mean = np.array([0.3, -0.2, 2.5])
    both = discs([mean, [0, 0, 1.5], [0, 0, 5]], [quat[0], [1, 0, 0, 0], [1, 0, 0, 0]], [[0.05, 0.09]] * 3)
    placed = put(both, conventions=GSPLAT_MAIN._replace(eps2d=0.0))
    R, box = rotation_matrices(quat)[0], placed.box
    center, normal = placed.scene.flats.centers[1], placed.scene.flats.axes[1, :, 2]
    for step in (R[:, 0], -0.4 * R[:, 0] + 0.3 * R[:, 1]):
        X, Y, Z = mean + 0.3 * step
        moved = np.array([box.rho * 50 * X / Z, box.rho * 50 * Y / Z, box.z_of(Z)]) - center
        assert abs(normal @ moved) < 1e-9 * np.linalg.norm(moved)
    assert np.abs(normal[:2]).max() > 0.1


def test_what_is_too_steep_is_tilted_back():
    """Light of pixels of 8 um leaves at 638 / 16,000: a slope of 12.5 is half of its own."""
    assert_allclose(steepest_slope(638e-9, 8e-6), 0.5 / np.tan(np.arcsin(638e-9 / 16e-6)), rtol=1e-12)
    assert steepest_slope(638e-9, 0.3e-6) == 0
    oblique = discs([[0, 0, 2], [0, 0, 1], [0, 0, 4]], [[0.6, 0.8, 0, 0], [1, 0, 0, 0], [1, 0, 0, 0]], [[0.1, 0.1]] * 3)
    placed = put(oblique, steepest=1.5)
    normals = placed.scene.flats.axes[:, :, 2]
    slopes = np.linalg.norm(normals[:, :2], axis=1) / np.abs(normals[:, 2])
    assert placed.n_steep == 1
    assert_allclose(slopes.max(), 1.5, rtol=1e-9)
    assert put(oblique, steepest=1e6).n_steep == 0


def test_balls_are_counted_as_no_discs():
    balls = discs([[0, 0, 1], [0, 0, 2]], [[1, 0, 0, 0]] * 2, [[0.1, 0.1]] * 2)
    balls.log_scales[1] = np.log([0.1, 0.09, 0.08])
    assert put(balls).n_thick == 1


def test_nothing_in_front_of_the_camera_is_refused():
    behind = discs([[0, 0, -1], [9, 0, 1]], [[1, 0, 0, 0]] * 2, [[0.01, 0.01]] * 2)
    with pytest.raises(InputError, match="none of the 2 Gaussians is in front of the camera"):
        put(behind)
    alone = put(discs([[0, 0, 3]], [[1, 0, 0, 0]], [[0.01, 0.01]]))  # one depth is enough
    assert len(alone.scene.opacities) == 1 and (alone.box.nearest, alone.box.farthest) == pytest.approx((1.5, 6.0))


def test_the_box_leaves_out_what_hardly_shows():
    """Discs of one size at depths 1, 2 and 10 show 1, 1/4 and 1/100 of the first: less than a hundredth of all."""
    box = put(discs([[0, 0, 1], [0, 0, 2], [0, 0, 10]], [[1, 0, 0, 0]] * 3, [[0.05, 0.05]] * 3)).box
    assert (box.nearest, box.farthest) == (1, 2)
    box = put(discs([[0, 0, 1], [0, 0, 2], [0, 0, 10]], [[1, 0, 0, 0]] * 3, [[0.05, 0.05]] * 2 + [[0.1, 0.1]])).box
    assert (box.nearest, box.farthest) == (1, 10)


def test_what_reaches_into_the_image_is_seen():
    """At depth 1 the image ends at 0.48: a disc of deviation 0.01 reaches 0.03 further, and below it ends at 0.32."""
    for place_of, n_seen in (
        ((0.50, 0), 1),
        ((-0.50, 0), 1),
        ((0.52, 0), 0),
        ((0, 0.34), 1),
        ((0, -0.34), 1),
        ((0, -0.36), 0),
    ):
        placed = put(discs([[0, 0, 1], [*place_of, 1]], [[1, 0, 0, 0]] * 2, [[0.01, 0.01]] * 2))
        assert len(placed.scene.opacities) == 1 + n_seen, place_of
