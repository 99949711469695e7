"""Images with a sharp edge, drawn by few Gaussians with and without cuts: targets, trainings, measures."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from data_tools.claims.kit import psnr_of
from minisplat_ref.extensions.cuts.model import CUT_GAUSSIANS, CUTS, CutGaussians, set_width, with_cuts
from minisplat_ref.rendering import Request
from minisplat_ref.training.adam import zero_moments
from minisplat_ref.training.loop import train
from minisplat_ref.training.representation import GAUSSIANS, Representation
from minisplat_ref.training.schedule import action_name, scale_recipe
from minisplat_ref.training.state import TrainState
from minisplat_ref.types import Bools, Camera, Floats, Gaussians, Model, Scene, View, number_views, view_from

SIZE, FOCAL, DISTANCE = 48, 60.0, 3.0  # px, px, world units
BAND = 1.5  # px on either side of the edge
EXTENT = 10.0  # of the scene; it sets how far the rates of 3DGS let Gaussians move
BRIGHT = 0.8
CAMERA = Camera(np.eye(3), np.zeros(3), FOCAL, FOCAL, SIZE / 2, SIZE / 2, SIZE, SIZE)


class Target(NamedTuple):
    """An image with an edge."""

    image: Floats
    """[H, W, 3] in [0, 1]."""
    band: Bools
    """[H, W] True near the edge."""


def near_edge(edge: Callable[[Floats], Floats]) -> Bools:
    """Return which pixels lie near an edge at ``x = edge(y)``, px."""
    ys, xs = np.mgrid[:SIZE, :SIZE] + 0.5
    near: Bools = np.abs(xs - edge(ys)) < BAND
    return near


def place_cards(n: int, rng: np.random.Generator) -> Gaussians:
    """Return n flat grey Gaussians that face the camera, spread over the image and large enough to fill it."""
    extent = SIZE / FOCAL * DISTANCE  # width of the image, world units
    places = rng.uniform(-0.35, 0.35, (n, 2)) * extent if n > 1 else np.zeros((1, 2))
    scale = 0.25 * extent / np.sqrt(n)
    return Gaussians(
        means=np.column_stack([places, DISTANCE + 1e-3 * np.arange(n)]).astype(np.float32),
        quats=np.tile(np.eye(4, dtype=np.float32)[0], (n, 1)),
        log_scales=np.tile(np.log([scale, scale, 1e-3]).astype(np.float32), (n, 1)),
        opacity_logits=np.ones(n, np.float32),
        sh_dc=np.zeros((n, 3), np.float32),
        sh_rest=np.zeros((n, 0, 3), np.float32),
    )


def cut_gaussian() -> Target:
    """Return a Gaussian whose right side is cut away by a straight edge 0.4 standard deviations from its centre."""
    one = place_cards(1, np.random.default_rng(0))
    points = np.array([[0.4, -3.0, 0.4, -1.0, 0.4, 1.0, 0.4, 3.0]], np.float32)
    bright = one._replace(opacity_logits=np.full(1, 3, np.float32), sh_dc=np.ones((1, 3), np.float32))
    hard = CutGaussians(*bright, curves=points, widths=np.zeros(1, np.float32))
    edge = SIZE / 2 + 0.4 * float(np.exp(one.log_scales[0, 0])) * FOCAL / DISTANCE
    return Target(render_card(hard).astype(np.float64), near_edge(lambda ys: np.full_like(ys, edge)))


def card() -> Target:
    """Return a bright card that fills the image up to a curved edge; pixels on the edge are partly covered."""

    def edge(ys: Floats) -> Floats:
        return 30 - 6 * ((ys - SIZE / 2) / (SIZE / 2)) ** 2

    ys, xs = np.mgrid[:SIZE, :SIZE] + 0.5
    covered = np.clip(edge(ys) - xs + 0.5, 0, 1)
    return Target(np.repeat(BRIGHT * covered[:, :, None], 3, axis=2), near_edge(edge))


def representation_of(population: Any) -> Representation:
    """Return the representation of a population with or without cuts."""
    return CUT_GAUSSIANS if isinstance(population, CutGaussians) else GAUSSIANS


def render_card(population: Any) -> Floats:
    """Return the image [H, W, 3] of a population in front of black."""
    image: Floats = (
        representation_of(population).renderer.render(Model(population), view_from(CAMERA), Request())[0].image
    )
    return image


def fit_card(target: Target, n: int, n_curves: int, iterations: int, seed: int) -> Any:
    """Return n Gaussians with ``n_curves`` curves each, 0 for 3DGS, trained on the target without density control."""
    rng = np.random.default_rng(seed)
    view = View("card", CAMERA, np.rint(255 * np.clip(target.image, 0, 1)).astype(np.uint8), None)
    none = np.zeros((0, 3))
    scene = Scene("card", number_views([view]), (), none, none.astype(np.uint8), np.zeros(3), EXTENT)
    population: Any = place_cards(n, rng)
    if n_curves:
        population = with_cuts(population, rng, n_curves=n_curves)
    events = tuple(event for event in CUTS.events if n_curves and action_name(event) == set_width.__name__)
    recipe = CUTS._replace(events=events, sh_degree=0, representation=representation_of(population))
    state = TrainState(population, zero_moments(population), step=0, view_order=[], rng=rng, stats={})
    return train(scene, scale_recipe(recipe, iterations), seed=seed, state=state).gaussians


def edge_width(image: Floats) -> float:
    """Return the number of pixels over which a row rises from 10 to 90 % of its range, as the mean of middle rows.

    The range is that of the row from the third pixel to the third from the end.
    """
    widths = []
    for row in image.mean(axis=2)[SIZE // 4 : -SIZE // 4, 2:-2].astype(np.float64):
        top = int(np.argmax(row))
        low, high = row[-1], row[top]
        falling = row[top:]
        at = [
            float(np.interp(-(low + part * (high - low)), -np.minimum.accumulate(falling), np.arange(len(falling))))
            for part in (0.9, 0.1)
        ]
        widths.append(at[1] - at[0])
    return float(np.mean(widths))


def measure_parts(target: Target, population: Any) -> dict[str, float]:
    """Return the PSNR of the image, of the band around the edge and of the rest, dB."""
    image, band = render_card(population), target.band
    return {
        "psnr": psnr_of(image, target.image),
        "band": psnr_of(image[band], target.image[band]),
        "elsewhere": psnr_of(image[~band], target.image[~band]),
    }


def measure_card(target: Target, population: Any) -> dict[str, float]:
    """Return what :func:`measure_parts` does, and the edge's width, px."""
    width = edge_width(np.clip(render_card(population), 0, 1))
    return {**measure_parts(target, population), "edge_width": width}
