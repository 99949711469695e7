"""Claim ``polygons/cost`` (REdiSplats, arXiv 2503.12284): hits, and time of one processor for a pixel.

The same flat Gaussians are drawn as polygons, as ellipsoids that rays trace, and as splats, by the plain kernels and by
the tuned ones. Splats are looked at for every pixel of a tile that they may touch; ellipsoids and polygons, where a
ray comes near their boxes.
"""

import argparse
from functools import partial
from typing import Any

import numpy as np

from data_tools.claims import kit
from data_tools.claims.kit.figures import table_of
from minisplat_ref.constants import GSPLAT_MAIN
from minisplat_ref.extensions.extension import load_extension
from minisplat_ref.extensions.polygons.model import TRACED, build_tree, make_polygons
from minisplat_ref.rendering import SPLATTING, Renderer, Request
from minisplat_ref.rendering.backends import CPU, PLAIN, REFERENCE, Backend
from minisplat_ref.types import Camera, Gaussians, Model, View, view_from

WIDTH, HEIGHT = 240, 135  # pixels
SIZE = 0.02  # median scale; the Gaussians lie 2 to 6 units away
THICKNESS = 1e-5


def flat_gaussians(n: int, rng: np.random.Generator) -> Gaussians:
    """Return overlapping flat Gaussians of random shapes and directions before the camera, in float32."""
    z = rng.uniform(2, 6, n)
    wide = Gaussians(
        means=np.column_stack([rng.uniform(-0.5, 0.5, (n, 2)) * [1, 0.75] * z[:, None], z]),
        quats=rng.normal(size=(n, 4)),
        log_scales=np.column_stack([np.log(SIZE) + 0.7 * rng.normal(size=(n, 2)), np.full(n, np.log(THICKNESS))]),
        opacity_logits=2 * rng.normal(size=n),
        sh_dc=rng.normal(size=(n, 3)),
        sh_rest=np.zeros((n, 0, 3)),
    )
    return Gaussians(*(field.astype(np.float32) for field in wide))


def run(args: argparse.Namespace) -> str:
    """Count and time what a pixel costs, and return a table."""
    return table_of("", measure(args.gaussians, args.repeats), ".3g")


def measure(n: int, repeats: int) -> dict[str, dict[str, float | None]]:
    """Return by renderer what a pixel costs.

    Parameters
    ----------
    n : int
        Gaussians.
    repeats : int
        The least time counts.
    """
    gaussians = flat_gaussians(n, np.random.default_rng(0))
    camera = Camera(np.eye(3), np.zeros(3), WIDTH, WIDTH, WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT)
    view, rays = view_from(camera), load_extension("rays").representation.renderer
    ways: dict[str, tuple[Renderer, Backend]] = {
        "polygons": (TRACED.renderer, CPU),
        "ellipsoids on rays": (rays, CPU),
        "splats, plain": (SPLATTING, PLAIN),
        "splats, tuned": (SPLATTING, CPU),
    }
    found = {name: _row(renderer, backend, gaussians, view, repeats) for name, (renderer, backend) in ways.items()}
    opacities = 1 / (1 + np.exp(-gaussians.opacity_logits.astype(np.float64)))
    polygons = make_polygons(gaussians, opacities)
    found["polygons"]["tree ms"] = 1e3 * kit.min_seconds(partial(build_tree, polygons, GSPLAT_MAIN), repeats)
    found["polygons"]["error of float32"] = _error(gaussians, view)
    return found


def _row(
    renderer: Renderer, backend: Backend, gaussians: Gaussians, view: View, repeats: int
) -> dict[str, float | None]:
    """Return the figures of one renderer; ``None`` where one has no meaning."""
    model, n_pixels, request = Model(gaussians), WIDTH * HEIGHT, Request(backend=backend)
    counted = Request(backend=CPU, wants=frozenset({"stats"}))  # the plain kernels collect no statistics
    stats: Any = renderer.render(model, view, counted)[0].stats
    output, tape = renderer.render(model, view, request)
    forward = kit.min_seconds(partial(renderer.render, model, view, request), repeats)
    backward = kit.min_seconds(partial(renderer.render_vjp, tape, np.ones_like(output.image), None), repeats)
    looked_at = output.n_pairs * backend.tile_width * backend.tile_height / n_pixels if renderer is SPLATTING else None
    return {
        "hits a pixel": float(stats.hit_count.sum() / n_pixels),
        "looked at a pixel": looked_at,
        "tree ms": None,
        "forward us": 1e6 * forward / n_pixels,
        "backward us": 1e6 * backward / n_pixels,
        "error of float32": None,
    }


def _error(gaussians: Gaussians, view: View) -> float:
    """Return the largest difference of a small image in float32 from the reference in float64."""
    few = view.camera._replace(width=40, height=22, fx=40.0, fy=40.0, cx=20.0, cy=11.0)
    wide = Gaussians(*(field.astype(np.float64) for field in gaussians))
    images: list[Any] = [
        TRACED.renderer.render(Model(some), view_from(few), Request(backend=backend))[0].image
        for some, backend in ((gaussians, CPU), (wide, REFERENCE))
    ]
    return float(np.abs(images[0] - images[1]).max())
