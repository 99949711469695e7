"""Claim ``wave/claims`` (arXiv 2505.06582): the closed form, focus, occlusion, and what a Gaussian costs.

*Closed form.* The field of one tilted Gaussian against the brute-force Rayleigh-Sommerfeld sum, beside what sampling
gives: the image of the Gaussian along z, with its phase of one plane, propagated by the angular spectrum method.

*Focus.* Three Gaussians side by side at three distances; the peak intensity of each over the planes of a focal stack.

*Occlusion.* A wide screen of opacity alpha in front of a Gaussian: the intensity in its plane, over that without the
screen. A mask that lets ``1 - alpha`` of the amplitude pass leaves ``(1 - alpha)^2`` of the intensity. And a half-plane
of nearly opaque Gaussians before a wall of them: what is seen of the wall beside and behind the edge.

*Cost.* Seconds of one processor for each Gaussian and method, and for a cloud of spherical waves that samples it with a
point per pixel.
"""

import argparse
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from data_tools.claims import kit
from data_tools.claims.kit.figures import show, subplots, table_of
from minisplat_ref.extensions.wave import blending
from minisplat_ref.extensions.wave.blending import Scene, front_to_back
from minisplat_ref.extensions.wave.model import (
    Complexes,
    Flats,
    Grid,
    compute_field,
    grid_waves,
    propagate,
    rayleigh_sommerfeld,
    spectra,
)
from minisplat_ref.interface.palette import BLUE, GREEN, OCHRE, RED
from minisplat_ref.interface.reporting import describe_machine
from minisplat_ref.reference.covariance import rotation_matrices
from minisplat_ref.types import Floats

GREEN_LIGHT = 520e-9  # metres
FINE, USUAL = Grid(256, 256, 0.4e-6), Grid(128, 128, 8e-6)
TILTS = (0, 12, 30, 45)  # degrees
DISTANCE = 60e-6  # metres, from a Gaussian to the places where its field is compared
PLACES = np.array([(128, 128), (120, 140), (100, 130), (150, 110), (128, 160), (90, 90)])  # row, column
STACK = np.linspace(-6e-3, 6e-3, 25)  # metres
WAYS: dict[str, Callable[[Scene, Grid, float, int], Complexes]] = {
    "exact": blending.blend,
    "fast": blending.blend_fast,
    "silhouette": blending.blend_silhouettes,
}
ALPHAS = (0.0, 0.25, 0.5, 0.75, 0.9)


def tilted(degrees: float, center: Floats, scales: Floats) -> Flats:
    """Return a Gaussian that is tilted about an oblique axis in the plane."""
    half = np.radians(degrees) / 2
    quat = np.array([[np.cos(half), 0.8 * np.sin(half), 0.6 * np.sin(half), 0.0]])
    return Flats(np.array([center], float), rotation_matrices(quat), np.array([scales], float))


def facing(centers: Floats, sizes: Floats) -> Flats:
    """Return round Gaussians [N] that face the viewer."""
    n = len(centers)
    return Flats(np.asarray(centers, float), np.tile(np.eye(3), (n, 1, 1)), np.tile(np.reshape(sizes, (-1, 1)), (1, 2)))


def closed_form_errors(degrees: float) -> dict[str, float]:
    """Return the largest error at the places, over the peak, of the closed form and of a sampled image."""
    flats = tilted(degrees, np.array([3e-6, -2e-6, -DISTANCE]), np.array([4e-6, 6e-6]))
    waves = grid_waves(FINE, GREEN_LIGHT)
    listed = waves._replace(k=waves.k.reshape(-1, 3))
    field = compute_field(spectra(flats, listed).reshape(waves.k.shape[:2]), waves, FINE)[: FINE.height, : FINE.width]
    rows, columns = PLACES.T
    places = np.column_stack([FINE.x[columns], FINE.y[rows], np.zeros(len(PLACES))])
    truth = rayleigh_sommerfeld(flats, places, GREEN_LIGHT)
    image = image_of(flats, FINE) * np.exp(-2j * np.pi * DISTANCE / GREEN_LIGHT)
    sampled = propagate(image.astype(complex), FINE, GREEN_LIGHT, DISTANCE)
    peak = np.abs(field).max()
    return {
        "closed form": float(np.abs(field[rows, columns] - truth).max() / peak),
        "sampled image": float(np.abs(sampled[rows, columns] - truth).max() / peak),
    }


def image_of(flats: Flats, grid: Grid) -> Complexes:
    """Return the image [H, W] of one Gaussian along z, with the peak 1 and no phase."""
    x, y = np.meshgrid(grid.x - flats.centers[0, 0], grid.y - flats.centers[0, 1])
    d = np.stack([x, y], axis=-1)
    quadratic = np.einsum("hwi,ij,hwj->hw", d, np.linalg.inv(flats.lateral_covariances[0]), d)
    return np.exp(-quadratic / 2).astype(complex)


def focal_stack() -> dict[str, Any]:
    """Return the planes in which three Gaussians are brightest, and their peak intensities over the stack."""
    z = np.array([4e-3, 0.0, -4e-3])
    x = np.array([-2.5e-4, 0.0, 2.5e-4])
    flats = facing(np.column_stack([x, np.zeros(3), z]), np.full(3, 1.0e-5))
    field = blending.blend(Scene(flats, np.ones(3), np.ones((3, 3))), USUAL, GREEN_LIGHT, 1)
    columns = [np.abs(USUAL.x - at) < 8e-5 for at in x]
    peaks = np.array(
        [
            [np.max(np.abs(propagate(field, USUAL, GREEN_LIGHT, plane)[:, near]) ** 2) for plane in STACK]
            for near in columns
        ]
    )
    return {"at": z.tolist(), "sharpest": STACK[peaks.argmax(axis=1)].tolist(), "peaks": peaks.tolist()}


def behind_a_screen(alpha: float) -> dict[str, float]:
    """Return by way the intensity of a Gaussian behind a screen, in its plane, over that without the screen.

    The screen has no light of its own; it is 16 times as wide as the Gaussian and 2 mm in front of it.
    """
    flats = facing(np.array([[0, 0, 1e-3], [0, 0, -1e-3]]), np.array([3.2e-4, 2e-5]))
    amplitudes = np.array([[0.0] * 3, [1.0] * 3])
    middle = USUAL.height // 2, USUAL.width // 2
    found = {"predicted": (1 - alpha) ** 2}
    for name, way in WAYS.items():
        seen = [
            np.abs(propagate(way(Scene(flats, np.array([o, 1.0]), amplitudes), USUAL, GREEN_LIGHT, 1), *_AT)[middle])
            for o in (alpha, 0.0)
        ]
        found[name] = float((seen[0] / seen[1]) ** 2)
    return found


_AT = USUAL, GREEN_LIGHT, -1e-3  # the plane of what is behind the screen


def at_an_edge() -> dict[str, Floats]:
    """Return by way the image [H, W] of a wall of Gaussians, in focus, behind a screen on the left."""
    rows, columns = (g.ravel() for g in np.meshgrid(np.arange(-4, 5), np.arange(-4, 5), indexing="ij"))
    wall = np.column_stack([columns * 1e-4, rows * 1e-4, np.full(len(rows), -1e-3)])
    screen = wall[columns < 0] + [0, 0, 2e-3]
    flats = facing(np.concatenate([screen, wall]), np.full(len(screen) + len(wall), 5e-5))
    is_wall = np.arange(len(flats.centers)) >= len(screen)
    amplitudes = np.where(is_wall, 1.0, 0.0)[:, None] * np.ones(3)
    scene = front_to_back(Scene(flats, np.full(len(is_wall), 0.95), amplitudes))
    return {name: np.abs(propagate(way(scene, USUAL, GREEN_LIGHT, 1), *_AT)) for name, way in WAYS.items()}


def costs(n: int, rng: np.random.Generator) -> dict[str, dict[str, float]]:
    """Return by method milliseconds and evaluations of a wave for each Gaussian, on 128 x 128 pixels.

    Parameters
    ----------
    n : int
        Gaussians, of 1 to 5 pixels.
    rng : Generator
        For their places.
    """
    centers = np.column_stack([rng.uniform(-4e-4, 4e-4, (n, 2)), rng.uniform(-2e-3, 2e-3, n)])
    axes = rotation_matrices(np.column_stack([np.ones(n), 0.3 * rng.normal(size=(n, 3))]))
    flats = Flats(centers, axes, rng.uniform(0.8e-5, 4e-5, (n, 2)))
    scene = front_to_back(Scene(flats, rng.uniform(0.3, 1, n), rng.uniform(size=(n, 3))))
    n_padded, n_pixels = 4 * USUAL.width * USUAL.height, USUAL.width * USUAL.height
    sizes = [
        window.width * window.height for i in range(n) for window in [blending.choose_window(scene.flats.one(i), USUAL)]
    ]
    n_points = float(np.mean(np.prod(6 * scene.flats.scales / USUAL.pitch, axis=1)))  # three deviations to each side
    ways: dict[str, tuple[Callable[..., Any], float]] = {
        "exact, whole grid": (blending.blend, n_padded),
        "silhouette, whole grid": (blending.blend_silhouettes, n_padded),
        "fast, kernel": (blending.blend_by_kernel, n_padded),
        "exact, windows": (blending.blend_windows, float(np.mean(sizes))),
    }
    found = {}
    for name, (way, evaluations) in ways.items():
        way(scene, USUAL, GREEN_LIGHT, 1)  # compiles
        seconds = kit.min_seconds(lambda way=way: way(scene, USUAL, GREEN_LIGHT, 1), 2)  # type: ignore[misc]
        found[name] = {"ms": 1e3 * seconds / n, "waves": evaluations}
    found["point cloud"] = {"ms": _ms_of_points(n_points, n_pixels), "waves": n_points * n_pixels}
    return found


def _ms_of_points(n_points: float, n_pixels: int) -> float:
    """Return milliseconds for a Gaussian as points, each of which sends a spherical wave to every pixel."""
    places = np.column_stack([np.zeros((2, 2)), [-1e-3, -2e-3]])
    flats = facing(np.zeros((1, 3)), np.array([2e-5]))
    start, side = time.process_time(), 128
    rayleigh_sommerfeld(flats, places, GREEN_LIGHT, n=side)
    seconds = (time.process_time() - start) / (len(places) * side * side)
    return 1e3 * seconds * n_points * n_pixels


def run(args: argparse.Namespace) -> kit.Report:
    """Measure all claims."""
    result: dict[str, Any] = {
        "machine": describe_machine(),
        "errors": {f"{tilt} degrees": closed_form_errors(tilt) for tilt in TILTS},
        "stack": focal_stack(),
        "screen": {alpha: behind_a_screen(alpha) for alpha in kit.with_progress(ALPHAS, "screens")},
        "cost": costs(args.gaussians, np.random.default_rng(0)),
    }
    edges = at_an_edge()
    result["edge"] = {name: edge_figures(image) for name, image in edges.items()}
    stack = result["stack"]
    sharpest = ", ".join(
        f"{1e3 * at:+.1f} mm in {1e3 * found:+.1f}" for at, found in zip(stack["at"], stack["sharpest"], strict=True)
    )
    text = (
        f"{result['machine']}\n\nlargest error of the field of a tilted Gaussian, against Rayleigh-Sommerfeld\n\n"
        f"{table_of('tilt', result['errors'])}\n\nbrightest planes of Gaussians at: {sharpest}\n\n"
        f"intensity behind a screen of opacity alpha\n\n{table_of('alpha', result['screen'], '.3f')}\n\n"
        f"a wall behind the edge of a screen: amplitude\n\n{table_of('way', result['edge'], '.3f')}\n\n"
        f"cost of a Gaussian on {USUAL.width} x {USUAL.height} pixels\n\n{table_of('way', result['cost'], '.3g')}"
    )
    return kit.Report(result, draw(stack, edges), text)


def edge_figures(image: Floats) -> dict[str, float]:
    """Return the mean amplitude in the shadow and in the light, away from the edge."""
    rows, middle = slice(44, 84), USUAL.width // 2
    return {
        "shadow": float(image[rows, middle - 30 : middle - 10].mean()),
        "light": float(image[rows, middle + 10 : middle + 30].mean()),
    }


def draw(stack: dict[str, Any], edges: dict[str, Floats]) -> Figure:
    """Draw the focal stack, and the wall behind a screen."""
    figure, panels = subplots((10, 2.9), 1, 4, gridspec_kw={"width_ratios": [1.5, 1, 1, 1]})
    for at, peaks, color in zip(stack["at"], stack["peaks"], (BLUE, GREEN, RED), strict=True):
        panels[0].plot(1e3 * STACK, peaks, color=color, label=f"at {1e3 * at:+.0f}")
        panels[0].axvline(1e3 * at, color=color, lw=0.8, ls=":")
    panels[0].set_xlabel("focused on, mm")
    panels[0].set_ylabel("peak intensity")
    panels[0].set_ylim(0, 1.1)
    panels[0].legend(loc="upper center", ncols=3)
    for axes, (name, image) in zip(panels[1:], edges.items(), strict=True):
        show(axes, np.repeat(image[..., None], 3, axis=2), f"wall behind a screen, {name}")
        axes.axvline(USUAL.width / 2, color=OCHRE, lw=0.6)
    return figure
