"""Measurements of RaySplats (arXiv 2501.19196), one function per claim."""

import argparse
from functools import partial
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from data_tools.claims import kit
from data_tools.claims.kit.figures import show, subplots, table_of
from data_tools.claims.rays import demo
from minisplat_ref.constants import GSPLAT_MAIN
from minisplat_ref.extensions.rays.lights import (
    MIRROR,
    Surroundings,
    concatenate_surfaces,
    make_surfaces,
    parallelogram,
    shade,
    visibility,
)
from minisplat_ref.extensions.rays.model import TRACED, build_tree, make_tracer, whiten_model
from minisplat_ref.interface.palette import BLUE, OCHRE, RED
from minisplat_ref.interface.reporting import markdown_table
from minisplat_ref.mechanisms.orders import Sorted, composite_hits
from minisplat_ref.mechanisms.rays.pixel_rays import pixel_rays
from minisplat_ref.reference.hits import Hit, Response
from minisplat_ref.rendering import SPLATTING, Request
from minisplat_ref.rendering.backends import CPU, PLAIN, REFERENCE
from minisplat_ref.types import Camera, Floats, Gaussians, Ints, Model, TileBins, TileGrid, view_from

SIGMAS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.3)  # of a Gaussian over its distance
OFF_AXIS = (0.0, 20.0, 40.0)  # degrees
BLACK = np.zeros(3)


def random_gaussians(n: int, rng: np.random.Generator, size: float = 0.1) -> Gaussians:
    """Return overlapping Gaussians of random shapes in front of :func:`demo.camera_of`."""
    z = rng.uniform(2, 6, n)
    return Gaussians(
        means=np.column_stack([rng.uniform(-0.5, 0.5, (n, 2)) * [1, 0.75] * z[:, None], z]),
        quats=rng.normal(size=(n, 4)),
        log_scales=np.log(size) + 0.7 * rng.normal(size=(n, 3)),
        opacity_logits=2 * rng.normal(size=n),
        sh_dc=rng.normal(size=(n, 3)),
        sh_rest=np.zeros((n, 0, 3)),
    )


def tree_against_brute_force(n: int, seed: int) -> float:
    """Return the largest difference between images by the tree and by all pairs of rays and Gaussians."""
    gaussians, view = random_gaussians(n, np.random.default_rng(seed)), view_from(demo.camera_of(64, 48))
    images = [TRACED.renderer.render(Model(gaussians), view, Request(backend=b))[0].image for b in (CPU, REFERENCE)]
    return float(np.abs(images[0] - images[1]).max())


def exact_order(gaussians: Gaussians, camera: Camera) -> Floats:
    """Return the image [H, W, 3] of a response with which every pixel sorts the peaks on its ray.

    With ``S = Sigma^-1``, ``a = d^T S d``, ``b = d^T S (mu - O)`` and ``c = (mu - O)^T S (mu - O)``, the peak lies at
    ``t = b / a`` and is ``o exp(-(c - b^2 / a) / 2)``.
    """
    M = whiten_model(Model(gaussians)).maps
    S = np.swapaxes(M, 1, 2) @ M  # [N, 3, 3]
    opacities = 1 / (1 + np.exp(-gaussians.opacity_logits))
    offsets = gaussians.means - camera.center

    def hit(_: Any, ids: Ints, centers: Floats) -> Hit:
        slopes = (centers - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
        d = np.column_stack([slopes, np.ones(len(slopes))]) @ camera.cam_from_world_R  # [P, 3]
        a = np.einsum("pi,gij,pj->gp", d, S[ids], d)
        b = np.einsum("pi,gij,gj->gp", d, S[ids], offsets[ids])
        c = np.einsum("gi,gij,gj->g", offsets[ids], S[ids], offsets[ids])[:, None]
        t = b / a
        alphas = opacities[ids, None] * np.exp(-0.5 * (c - b * t))
        return Hit(np.where(t > GSPLAT_MAIN.near_plane, alphas, 0.0), t, None)

    def boxes(_: Any) -> Ints:
        return np.tile([0, 0, camera.width, camera.height], (len(offsets), 1))

    response = Sorted(Response(boxes, hit, lambda *_: (), ()))
    n, ids = len(offsets), np.arange(len(offsets), dtype=np.int32)
    grid = TileGrid(camera.width, camera.height, camera.width, camera.height)
    bins = TileBins(ids, np.array([0, n]), ids, np.arange(n + 1), grid)
    colors = CPU.sh_colors(gaussians.means, gaussians.sh_dc, gaussians.sh_rest, camera, 0, np.ones((n, 2), np.int32))
    return composite_hits(response, None, colors, BLACK, bins, GSPLAT_MAIN).image


def order_difference(n: int, seed: int) -> float:
    """Return the largest difference between tracing and :func:`exact_order`."""
    gaussians, camera = random_gaussians(n, np.random.default_rng(seed)), demo.camera_of(64, 48)
    traced = TRACED.renderer.render(Model(gaussians), view_from(camera), Request())[0].image
    return float(np.abs(traced - exact_order(gaussians, camera)).max())


def mirror_difference(n: int, seed: int) -> float:
    """Return the largest difference between the image in a mirror and that of the mirrored camera."""
    gaussians, camera = random_gaussians(n, np.random.default_rng(seed)), demo.camera_of(64, 48)
    gaussians.means[:, 2] -= 10  # behind the camera, which sees them only in the mirror
    z = 1.5
    sides = np.array([[4.0, 0.0, 0.0], [0.0, 4.0, 0.0]])
    wall = make_surfaces(parallelogram(np.array([-2.0, -2.0, z]), sides), MIRROR)
    world = demo.world_of(gaussians, Surroundings(np.zeros((0, 3)), 1.0, 0.0, concatenate_surfaces([wall])), BLACK)
    in_mirror = shade(world, pixel_rays(camera, GSPLAT_MAIN))
    flip = np.diag([1.0, 1.0, -1.0])
    mirrored = camera._replace(cam_from_world_R=flip, cam_from_world_t=-flip @ [0.0, 0.0, 2 * z])
    direct = TRACED.renderer.render(Model(gaussians), view_from(mirrored), Request())[0].image
    return float(np.abs(in_mirror - direct.reshape(-1, 3)).max())


def shadow_edge(n_samples: int = 2000) -> dict[str, float]:
    """Return the distance of the edge of a ball's shadow on a floor from where the lamp's tangent cone meets the floor.

    The ball is one opaque Gaussian. Its silhouette from the lamp is where it transmits one half of the light, ``o
    exp(-q / 2) = 1/2``, which is a ball of radius ``s sqrt(2 ln 2 o)``. The edge is interpolated along a line on the
    floor below the lamp; the unit is a pixel there of an image 240 wide.
    """
    s, opacity, height = 0.3, 1 / (1 + np.exp(-6.0)), 2.0
    centre, lamp = np.array([0.0, 1.0, 4.0]), np.array([0.0, -1.0, 4.0])
    one = demo.discs(centre[None], np.array([[0.0, 0.0, 1.0]]), s, np.full((1, 3), 0.5))
    one = one._replace(log_scales=np.full((1, 3), np.log(s)), opacity_logits=np.array([6.0]))
    world = demo.world_of(one, Surroundings(lamp[None], 0.0, 0.0, concatenate_surfaces([])), BLACK)
    x = np.linspace(0, 2, n_samples)
    points = np.column_stack([x, np.full_like(x, height), np.full_like(x, 4.0)])
    V = visibility(world, points, lamp - points, 0.0)
    found = float(np.interp(0.5, V, x))
    radius, distance = s * np.sqrt(2 * np.log(2 * opacity)), centre[1] - lamp[1]
    expected = float((height - lamp[1]) * radius / np.sqrt(distance**2 - radius**2))
    pixel = 4.0 / demo.camera_of().fx
    return {"found": found, "expected": expected, "pixels": abs(found - expected) / pixel}


def splatting_errors() -> dict[str, list[float]]:
    """Return the mean difference of alpha between splatting and tracing, relative to the mean of alpha.

    There is one round Gaussian of opacity 0.8, without the low-pass; errors are by angle off the axis and angular size.
    """
    found: dict[str, list[float]] = {}
    bare = GSPLAT_MAIN._replace(eps2d=0.0)
    for angle in kit.with_progress(OFF_AXIS, "angles off the axis"):
        errors = []
        for sigma in SIGMAS:
            direction = np.array([np.sin(np.radians(angle)), 0.0, np.cos(np.radians(angle))])
            one = demo.discs(direction[None], np.array([[0.0, 0.0, 1.0]]), sigma, np.full((1, 3), 0.5))
            one = one._replace(log_scales=np.full((1, 3), np.log(sigma)), opacity_logits=np.array([np.log(4.0)]))
            size, focal = 301, 301 / (10 * sigma) * np.cos(np.radians(angle)) ** 2
            place = focal * np.tan(np.radians(angle))
            camera = Camera(np.eye(3), np.zeros(3), focal, focal, size / 2 - place, size / 2, size, size)
            request = Request(conventions=bare)
            splat, traced = (
                renderer.render(Model(one), view_from(camera), request)[0].alpha
                for renderer in (SPLATTING, TRACED.renderer)
            )
            errors.append(float(np.abs(splat - traced).sum() / traced.sum()))
        found[f"{angle:g} degrees"] = errors
    return found


def run_claims(args: argparse.Namespace) -> kit.Report:
    """Measure each claim, and render the scene."""
    edge, errors = shadow_edge(), splatting_errors()
    found = {
        "tree against brute force": tree_against_brute_force(args.gaussians, args.seed),
        "tracing against exact order": order_difference(args.gaussians, args.seed),
        "mirror against mirrored camera": mirror_difference(args.gaussians, args.seed),
        "edge of a shadow, pixels": edge["pixels"],
    }
    result = {**kit.settings_of(args, "gaussians", "seed"), **found, "shadow": edge}
    result["splatting against tracing"] = {"sigmas": list(SIGMAS), "errors": errors}
    by_sigma = {f"{sigma:g}": {angle: errors[angle][s] for angle in errors} for s, sigma in enumerate(SIGMAS)}
    text = markdown_table(["claim", "difference"], [[name, f"{value:.1e}"] for name, value in found.items()])
    text += "\n\nalpha of one round Gaussian, splatted against traced: mean difference over mean\n\n"
    text += table_of("sigma over distance", by_sigma, ".1%")
    return kit.Report(result, draw(errors), text)


def draw(errors: dict[str, list[float]]) -> Figure:
    """Draw the demo scene beside the errors of splatting."""
    camera = demo.camera_of()
    image = shade(demo.demo_world(), pixel_rays(camera, GSPLAT_MAIN)).reshape(camera.height, camera.width, 3)
    figure, (left, right) = subplots((9.5, 3.6), 1, 2)
    show(left, image)
    for (name, values), color in zip(errors.items(), (BLUE, OCHRE, RED), strict=True):
        right.loglog(SIGMAS, values, "o-", ms=4, color=color, label=f"{name} off the axis")
    right.set(xlabel="standard deviation over distance", ylabel="difference of splatting from tracing")
    right.legend()
    return figure


def run_speed(args: argparse.Namespace) -> str:
    """Time a ray and a rasterised pixel."""
    found = speed(args.gaussians, args.repeats)
    table = markdown_table(["measure", "value"], [[name, f"{value:.3g}"] for name, value in found.items()])
    ray, tuned, plain = (
        found[f"{name} forward us"] + found[f"{name} backward us"] for name in ("ray", "pixel", "plain pixel")
    )
    text = (
        f"Forward and backward, a ray takes {ray / tuned:.1f} times as long as a pixel of the tuned kernels,"
        f" {ray / plain:.1f} times a plain one."
    )
    return f"{table}\n\n{text}"


def speed(n: int, repeats: int) -> dict[str, float]:
    """Return processor microseconds per ray and per rasterised pixel, and the error of float32 tracing.

    Pixels are drawn by the tuned kernels and by the plain ones. The error is that of float32 Gaussians and images
    against the reference in float64.
    """
    wide = random_gaussians(n, np.random.default_rng(0), size=0.02)
    gaussians = Gaussians(*(field.astype(np.float32) for field in wide))
    view = view_from(demo.camera_of(240, 135))
    n_pixels, result = 240 * 135, dict[str, float]()
    ways = (("pixel", SPLATTING, CPU), ("plain pixel", SPLATTING, PLAIN), ("ray", TRACED.renderer, CPU))
    for name, renderer, backend in kit.with_progress(ways, "timing"):
        request = Request(backend=backend)
        output, tape = renderer.render(Model(gaussians), view, request)
        forward = kit.min_seconds(partial(renderer.render, Model(gaussians), view, request), repeats)
        backward = kit.min_seconds(partial(renderer.render_vjp, tape, np.ones_like(output.image), None), repeats)
        result |= {f"{name} forward us": forward / n_pixels * 1e6, f"{name} backward us": backward / n_pixels * 1e6}
    whitened = whiten_model(Model(gaussians))
    result["tree ms"] = 1e3 * kit.min_seconds(partial(build_tree, whitened, GSPLAT_MAIN), repeats)
    result["hits per ray"] = output.n_pairs / n_pixels
    few = pixel_rays(demo.camera_of(40, 22), GSPLAT_MAIN)
    colors = np.clip(0.5 + gaussians.sh_dc.astype(np.float64), 0, 1)
    exact, traced = (
        make_tracer(some, GSPLAT_MAIN, backend).blend(colors, few, BLACK, GSPLAT_MAIN).image
        for some, backend in ((whiten_model(Model(wide)), REFERENCE), (whitened, CPU))
    )
    return {**result, "error of float32": float(np.abs(traced.astype(np.float32) - exact).max())}
