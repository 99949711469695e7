"""Claim ``polygons/edits`` (arXiv 2503.12284): the way to polygons and back, affine edits, and a sheet that is bent.

All in float64. An affine edit of all corners is compared with the Gaussians themselves under the same map,
``Sigma' = A Sigma A^T`` refactored by singular values (``mechanisms.editing.deformation``), as covariances and as
images.

Bending is not affine. The corners of a flat sheet of splats are displaced onto a cylinder,

    phi(x, y, z) = ((rho - z) sin(x / rho), y, rho - (rho - z) cos(x / rho)),   rho = 2 / angle   for a sheet 2 wide

which takes flat polygons to bent ones; the Gaussians that fit them stay flat and elliptical. What is lost is measured
by the corners: the root mean square distance of the displaced ones from where the fitted spans have them, over that
from the centres. And by the image, against that of the bent polygons themselves, whose triangles are drawn as they are,
with the alpha that barycentric coordinates carry along: once as the light that the sheet lets pass, to which the order
of splats does not matter, and once in colours, where neighbours that cross each other change places.
"""

import argparse
from collections.abc import Callable
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from data_tools.claims import kit
from data_tools.claims.kit.figures import set_ticks, show, subplots, table_of
from minisplat_ref.constants import GSPLAT_MAIN, SH_C0
from minisplat_ref.extensions.polygons.kernels import Fans, build_tree, meet
from minisplat_ref.extensions.polygons.model import TRACED
from minisplat_ref.extensions.polygons.soup import Soup, carry_gaussians, make_soup
from minisplat_ref.interface.palette import BLUE, GREY, OCHRE, RED
from minisplat_ref.interface.reporting import markdown_table
from minisplat_ref.mechanisms.editing.deformation import Deformation, deform
from minisplat_ref.mechanisms.meshes.fans import Flat, by_gram_schmidt, fit_flat_gaussians, fit_spans, flatten, rims
from minisplat_ref.mechanisms.rays.kernels import tracer_of
from minisplat_ref.mechanisms.rays.pixel_rays import pixel_rays
from minisplat_ref.reference.covariance import rotation_matrices
from minisplat_ref.rendering import Request
from minisplat_ref.rendering.backends import CPU
from minisplat_ref.types import Camera, Floats, Gaussians, Model, view_from

TURN = rotation_matrices(np.array([[0.8, 0.2, -0.4, 0.4]]))[0]
MAPS = {
    "turn": TURN,
    "turn and scale": 1.4 * TURN,
    "mirror": np.diag([1.0, -1.0, 1.0]),
    "stretch": np.diag([0.5, 1.0, 1.6]),
    "shear": np.array([[1.0, 0.8, -0.3], [0.0, 1.0, 0.5], [0.2, 0.0, 1.0]]),
}
WAYS: dict[str, Callable[[Floats, Floats], Flat]] = {"fit": fit_flat_gaussians, "Gram-Schmidt": by_gram_schmidt}
SIDES = (3, 4, 8, 16)
N = 200  # Gaussians of a cloud
ANGLES = (5, 10, 20, 45, 90, 180, 360)  # degrees that a sheet is bent by
PER_SIDE = (5, 10, 20, 40, 80)  # splats
USUAL_ANGLE, USUAL_PER_SIDE = 90, 20
SIZE = 160  # pixels a side
THICKNESS = 1e-10  # so that the plane of the larger axes is that of the flat Gaussian to the last digit, also sheared


def cloud(rng: np.random.Generator) -> Gaussians:
    """Return flat Gaussians of all shapes and directions around (0, 0, 4), in float64."""
    return Gaussians(
        means=np.array([0.0, 0, 4]) + 0.5 * rng.normal(size=(N, 3)),
        quats=rng.normal(size=(N, 4)),
        log_scales=np.log(np.column_stack([0.12 * np.exp(rng.uniform(-1.5, 0.5, (N, 2))), np.full(N, THICKNESS)])),
        opacity_logits=1 + rng.normal(size=N),
        sh_dc=rng.normal(size=(N, 3)),
        sh_rest=0.3 * rng.normal(size=(N, 15, 3)),
    )


def round_trips(seed: int) -> dict[int, float]:
    """Return by the number of sides the largest distance of a corner from itself after the way to a Gaussian and back.

    Relative to the largest coordinate, of polygons with rotated, long and thin, and round Gaussians.
    """
    gaussians, worst = cloud(np.random.default_rng(seed)), {}
    gaussians.log_scales[::4, 1] = gaussians.log_scales[::4, 0]
    gaussians.log_scales[1::4, 1] -= 7
    for n_sides in SIDES:
        soup = make_soup(gaussians, n_sides)
        back = fit_flat_gaussians(soup.corners, soup.radii)
        again = rims(back.means, back.spans, soup.radii, n_sides)
        worst[n_sides] = float(np.abs(again - soup.corners).max() / np.abs(soup.corners).max())
    return worst


def affine_errors(name: str, seed: int) -> dict[str, float]:
    """Return the largest errors of an affine edit of the corners: covariances by both ways, colours, and the image.

    Covariances are relative to the largest entry of each.
    """
    before, A = cloud(np.random.default_rng(seed)), MAPS[name]
    centre = np.array([0.0, 0, 4])
    soup, shift = make_soup(before, 8), centre - A @ centre
    corners = soup.corners @ A.T + shift
    after, _ = carry_gaussians(before, soup, corners, name)
    direct = deform(before, before.means @ A.T + shift, Deformation(A[None], np.zeros(N, int)))
    spans = A @ flatten(before.means, before.quats, before.log_scales).spans
    expected = (spans @ np.swapaxes(spans, 1, 2))[soup.rows]
    errors = {}
    for way, inverse in WAYS.items():
        found = inverse(corners, soup.radii).spans
        difference = np.abs(found @ np.swapaxes(found, 1, 2) - expected).max(axis=(1, 2))
        errors[f"covariance, {way}"] = float((difference / np.abs(expected).max(axis=(1, 2))).max())
    seen = Gaussians(*(field[soup.rows] for field in direct))  # the others have no polygon, and stay behind
    mine = Gaussians(*(field[soup.rows] for field in after))
    plain = mine._replace(sh_rest=np.zeros((len(soup.rows), 0, 3)))
    errors["image"] = float(np.abs(render_float64(plain) - render_float64(seen._replace(sh_rest=plain.sh_rest))).max())
    return errors


def camera() -> Camera:
    """Return a camera at the origin that looks along z."""
    return Camera(np.eye(3), np.zeros(3), SIZE, SIZE, SIZE / 2, SIZE / 2, SIZE, SIZE)


def render_float64(gaussians: Gaussians) -> Floats:
    """Return Gaussians in their polygons over white, [H, W, 3]."""
    request = Request(np.ones(3), backend=CPU)
    image: Floats = TRACED.renderer.render(Model(gaussians), view_from(camera()), request)[0].image
    return image


def render_soup(gaussians: Gaussians, soup: Soup, corners: Floats) -> Floats:
    """Return edited polygons as they are, flat or not, over white, [H, W, 3]."""
    centres = corners.mean(axis=1)
    opacities = 1 / (1 + np.exp(-gaussians.opacity_logits[soup.rows]))
    fans = Fans(centres, corners - centres[:, None], soup.radii, opacities)
    colors = np.maximum(0, 0.5 + SH_C0 * gaussians.sh_dc[soup.rows])
    tracer = tracer_of(meet, build_tree(fans, GSPLAT_MAIN))
    return tracer.blend(colors, pixel_rays(camera(), GSPLAT_MAIN), np.ones(3), GSPLAT_MAIN).image.reshape(SIZE, SIZE, 3)


def sheet(n: int) -> Gaussians:
    """Return n by n flat splats in the square from -1 to 1 of the plane z = 0, checkered, as wide as their distance.

    Heights differ by up to a thousandth, so that they have an order.
    """
    rng = np.random.default_rng(0)
    axis = (np.arange(n) + 0.5) / n * 2 - 1
    x, y = (values.ravel() for values in np.meshgrid(axis, axis))
    angle, spacing = rng.uniform(0, np.pi, n * n), 2 / n
    is_dark = (np.floor(2 * x) + np.floor(2 * y)) % 2 == 0
    colors = np.where(is_dark[:, None], [0.1, 0.25, 0.6], [0.95, 0.8, 0.35])
    scales = np.column_stack([spacing * rng.uniform(0.4, 0.8, (n * n, 2)), np.full(n * n, THICKNESS)])
    return Gaussians(
        means=np.column_stack([x, y, rng.uniform(-5e-4, 5e-4, n * n)]),
        quats=np.column_stack([np.cos(angle / 2), np.zeros((n * n, 2)), np.sin(angle / 2)]),
        log_scales=np.log(scales),
        opacity_logits=np.zeros(n * n),
        sh_dc=(colors - 0.5) / SH_C0,
        sh_rest=np.zeros((n * n, 0, 3)),
    )


def bend(points: Floats, angle: float) -> Floats:
    """Return phi of points [..., 3], for a sheet that is bent by an angle in degrees."""
    rho = 2 / np.radians(angle)
    x, y, z = np.moveaxis(points, -1, 0)
    return np.stack([(rho - z) * np.sin(x / rho), y, rho - (rho - z) * np.cos(x / rho)], axis=-1)


def place_sheet(points: Floats) -> Floats:
    """Return points [..., 3] placed before the camera and seen obliquely from above."""
    c, s = np.cos(np.radians(50)), np.sin(np.radians(50))
    oblique = np.array([[1, 0, 0], [0, c, s], [0, -s, c]])
    return points @ oblique.T + [0, -0.1, 3.9]


def bend_errors(n: int, angle: float) -> dict[str, float]:
    """Return the errors of a sheet of n by n splats that is bent by an angle: corners by both ways, and images."""
    gaussians = sheet(n)
    soup = make_soup(gaussians, 8)
    corners = place_sheet(bend(soup.corners, angle))
    centres, spans = fit_spans(corners, soup.radii)
    paper = by_gram_schmidt(corners, soup.radii)
    spread = np.sqrt(np.mean((corners - centres[:, None]) ** 2))
    errors = {
        f"corners, {way}": float(np.sqrt(np.mean((rims(centres, S, soup.radii) - corners) ** 2)) / spread)
        for way, S in zip(WAYS, (spans, paper.spans), strict=True)
    }
    after, _ = carry_gaussians(gaussians, soup, corners, "the bent sheet")
    black = np.full_like(gaussians.sh_dc, -10.0)
    for name, sh_dc in (("light that passes", black), ("colours", gaussians.sh_dc)):
        found = render_float64(after._replace(sh_dc=sh_dc))
        difference = found - render_soup(gaussians._replace(sh_dc=sh_dc), soup, corners)
        errors[f"{name}, RMS"] = float(np.sqrt(np.mean(difference**2)))
    return errors


def measure(seeds: int) -> dict[str, Any]:
    """Return all that is reported, by claim."""
    trips = [round_trips(seed) for seed in range(seeds)]
    result: dict[str, Any] = {"round trip": {n: max(trip[n] for trip in trips) for n in SIDES}, "affine": {}}
    for name in kit.with_progress(MAPS, "edits"):
        rows = [affine_errors(name, seed) for seed in range(seeds)]
        result["affine"][name] = {key: max(row[key] for row in rows) for key in rows[0]}
    result["angle"] = {angle: bend_errors(USUAL_PER_SIDE, angle) for angle in kit.with_progress(ANGLES, "angles")}
    result["splats"] = {n * n: bend_errors(n, USUAL_ANGLE) for n in kit.with_progress(PER_SIDE, "splats")}
    return result


def run(args: argparse.Namespace) -> kit.Report:
    """Take polygons to Gaussians and back, edit them, bend a sheet of them."""
    found = measure(args.seeds)
    trips = markdown_table(["sides", "distance"], [[str(n), f"{e:.1e}"] for n, e in found["round trip"].items()])
    text = (
        f"largest distance of a corner from itself, after the way to a Gaussian and back\n\n{trips}\n\n"
        "largest error of an affine edit of the corners, against the Gaussians under the same map\n\n"
        f"{table_of('map', found['affine'])}\n\n"
        f"a sheet of {USUAL_PER_SIDE**2} splats that is bent\n\n{table_of('degrees', found['angle'])}\n\n"
        f"a sheet that is bent by {USUAL_ANGLE} degrees\n\n{table_of('splats', found['splats'])}"
    )
    return kit.Report({"seeds": args.seeds, **found}, draw(found), text)


def draw(result: dict[str, Any]) -> Figure:
    """Draw a bent sheet, as polygons and as Gaussians, beside both curves."""
    figure, panels = subplots((10.5, 2.9), 1, 4, gridspec_kw={"width_ratios": [1, 1, 1.4, 1.4]})
    gaussians, angle = sheet(USUAL_PER_SIDE), 180
    soup = make_soup(gaussians, 8)
    corners = place_sheet(bend(soup.corners, angle))
    fitting, _ = carry_gaussians(gaussians, soup, corners, "the bent sheet")
    images = {
        f"polygons bent by {angle}°": render_soup(gaussians, soup, corners),
        "the Gaussians that fit": render_float64(fitting),
    }
    for axes, (title, image) in zip(panels, images.items(), strict=False):
        show(axes, image, title)
    curves = {
        "corners, fit": BLUE,
        "corners, Gram-Schmidt": OCHRE,
        "light that passes, RMS": RED,
        "colours, RMS": GREY,
    }
    labels = (f"degrees, {USUAL_PER_SIDE**2} splats", f"splats, {USUAL_ANGLE} degrees")
    for axes, key, label in zip(panels[2:], ("angle", "splats"), labels, strict=True):
        rows = result[key]
        for name, color in curves.items():
            axes.loglog(list(rows), [row[name] for row in rows.values()], "o-", ms=3, color=color, label=name)
        axes.set_xlabel(label, fontsize=8)
        set_ticks(axes, list(rows), [str(value) for value in rows])
        axes.tick_params(labelsize=7)
    panels[2].set_ylabel("error", fontsize=8)
    panels[3].legend(fontsize=6.5, loc="lower left")
    return figure
