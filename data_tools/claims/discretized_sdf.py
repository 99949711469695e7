"""Claims ``discretized-sdf/sphere`` and ``discretized-sdf/relight``: noisy surfels, and a glossy sphere relit.

The paper is Discretized SDF Gaussian Splatting, arXiv 2507.15629.

*sphere*: tangent surfels lie up to a tenth of the radius off a sphere, with distances that know nothing of it. In 200
steps the projection loss alone moves centres and distances, while normals stay. Opacities stay as they were, or follow
the distances, with the first gamma or with one that grows to what the median loss asks for.

*relight*: a glossy sphere with a chequered albedo is trained by ``reflective`` and by ``discretized-sdf``, and then
shown in another environment. Albedo and light are only known up to a factor per channel, which is fitted.
"""

import argparse
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from data_tools.claims import kit
from data_tools.claims.kit.claim import OUT, declare, iterations, seeds
from data_tools.claims.kit.figures import show, subplots
from data_tools.claims.kit.tables import spread, table
from minisplat_ref.datasets.synthetic.cameras import look_at
from minisplat_ref.extensions.discretized_sdf.model import (
    WIDTH,
    SDFSurfels,
    facing,
    opacity_logits,
    projected,
    reference_sharpness,
    with_distances,
)
from minisplat_ref.extensions.discretized_sdf.recipe import projection
from minisplat_ref.extensions.extension import find_recipe
from minisplat_ref.io.srgb import decode_srgb, encode_srgb
from minisplat_ref.mechanisms.gbuffer.environment import texel_directions
from minisplat_ref.mechanisms.gbuffer.lighting import ENVIRONMENT
from minisplat_ref.mechanisms.gbuffer.prefilter import Filtered, prefilter
from minisplat_ref.mechanisms.gbuffer.shading import Surface, shade
from minisplat_ref.mechanisms.surfels.renderer import SURFELS
from minisplat_ref.reference.depth import expected_depth
from minisplat_ref.reference.pinhole import pinhole_rays
from minisplat_ref.rendering import Request
from minisplat_ref.strategy.initialization import gaussians_from_means
from minisplat_ref.training.losses import Rendered
from minisplat_ref.training.recipe_settings import configure
from minisplat_ref.types import Bools, Camera, Floats, Model, Scene, View, number_views, view_from

WIDTH_PX, HEIGHT_PX, N_VIEWS = 96, 72, 8
N_SURFELS, OFFSET, STEPS = 1500, 0.1, 200
RATES = {"distances": 2e-3, "means": 5e-4}
ARMS = ("by distance, gamma by the median", "by distance, first gamma", "as at the start")
N_POINTS, NOISE = 400, 0.03  # where the training of the glossy sphere starts
ROUGHNESS = 0.3
RECIPES = ("discretized-sdf", "reflective")
SPHERE = (
    ("radius error of x_0", spread("radius_error", 4)),
    ("std of s - true s", spread("consistency", 4)),
    ("depth bias", spread("depth_bias", 4)),
    ("|depth error|", spread("depth_error", 4)),
    ("ds/dn", spread("slope", 2)),
)
RELIT = (
    ("RMS error of albedo", spread("albedo_error", 3)),
    ("relit (dB)", spread("relit_psnr", 1)),
    ("as trained (dB)", spread("psnr", 1)),
    ("surfels", spread("surfels", 0)),
)


class Truth(NamedTuple):
    """A unit sphere in a view."""

    camera: Camera
    is_sphere: Bools  # [H, W]
    depth: Floats  # [P] camera z of its pixels
    normals: Floats  # [P, 3] world frame, which are the points, too
    to_camera: Floats  # [P, 3]


def cameras(rng: np.random.Generator, n: int) -> list[Camera]:
    """Return cameras around the sphere."""
    turned = rng.uniform(0, 2 * np.pi) + 2 * np.pi * np.arange(n) / n
    places = [np.array([4 * np.cos(a), 4 * np.sin(a), rng.uniform(-1.0, 2.0)]) for a in turned]
    return [look_at(place, np.zeros(3), 1.3 * WIDTH_PX, WIDTH_PX, HEIGHT_PX) for place in places]


def trace(camera: Camera) -> Truth:
    """Return where the rays of a camera meet the unit sphere."""
    rays = pinhole_rays(np.arange(camera.width) + 0.5, np.arange(camera.height)[:, None] + 0.5, camera)
    length = np.linalg.norm(rays, axis=2)
    d = (rays / length[..., None]) @ camera.cam_from_world_R
    b = d @ camera.center
    root = b * b - camera.center @ camera.center + 1
    is_sphere = root > 0
    t = (-b - np.sqrt(np.maximum(root, 0)))[is_sphere]
    return Truth(camera, is_sphere, t / length[is_sphere], camera.center + t[:, None] * d[is_sphere], -d[is_sphere])


# --- sphere ---


def run_sphere(args: argparse.Namespace) -> kit.Report:
    """Measure both arms, and draw errors of the projected centres."""
    records, errors = [], {}
    for seed in kit.with_progress(range(args.seeds), "seeds"):
        for arm in ARMS:
            rng = np.random.default_rng(seed)
            g, truths = noisy_sphere(rng), [trace(camera) for camera in cameras(rng, N_VIEWS)]
            before = measure(g, opacities(g, WIDTH), truths)
            moved, logits = project_sphere(g, truths, arm)
            after = measure(moved, logits, truths)
            records.append({"arm": arm, "seed": seed, "before": before, "after": after})
            points = projected(moved.means, moved.quats, moved.distances)
            errors[arm] = np.linalg.norm(points, axis=1) - 1
    described = {**kit.settings_of(args, "seeds"), "surfels": N_SURFELS, "offset": OFFSET, "steps": STEPS}
    figure, ax = subplots((5, 3))
    for arm, values in errors.items():
        ax.hist(values, 40, histtype="step", label=f"opacity {arm}")
    ax.set(xlabel="distance of projected centres from the sphere, in radii", ylabel="surfels")
    ax.legend()
    return kit.Report({**described, "records": records}, figure, sphere_table(records))


def noisy_sphere(rng: np.random.Generator) -> SDFSurfels:
    """Return tangent surfels off the sphere, with distances of half the offset's size that are not related to it."""
    i = np.arange(N_SURFELS) + 0.5
    z, phi = 1 - 2 * i / N_SURFELS, np.pi * (1 + 5**0.5) * i
    normals = np.stack([np.sqrt(1 - z * z) * np.cos(phi), np.sqrt(1 - z * z) * np.sin(phi), z], axis=1)
    means = (1 + rng.uniform(-OFFSET, OFFSET, size=N_SURFELS))[:, None] * normals
    g = with_distances(gaussians_from_means(means, np.zeros((N_SURFELS, 3)), 0), rng, foreground=0.0)
    size = np.full((N_SURFELS, 3), np.log(0.7 * np.sqrt(4 * np.pi / N_SURFELS)))
    quats = facing(normals, np.broadcast_to(np.eye(3), (N_SURFELS, 3, 3)))
    return g._replace(quats=quats, log_scales=size, distances=0.5 * rng.uniform(-OFFSET, OFFSET, size=N_SURFELS))


def opacities(g: SDFSurfels, width: float) -> Floats:
    """Return the logits that follow from the distances."""
    return opacity_logits(g.distances, np.full(1, np.log(width)))


def draw_depth(g: SDFSurfels, logits: Floats, camera: Camera) -> Rendered:
    """Return a view of the surfels with its depths."""
    request, view = Request(wants=frozenset({"depth"})), view_from(camera)
    model = Model(g._replace(opacity_logits=logits))
    output, _ = SURFELS.render(model, view, request)
    nowhere = Scene("sphere", (), (), np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros(3), 1.0)
    return Rendered(output, SURFELS.channels(request.wants), view, nowhere, model, 1, request)


def project_sphere(g: SDFSurfels, truths: list[Truth], arm: str) -> tuple[SDFSurfels, Floats]:
    """Return the surfels after the steps of an arm, and their logits."""
    moments = {name: [np.zeros_like(getattr(g, name)) for _ in range(2)] for name in RATES}
    logits, width = opacities(g, WIDTH), WIDTH
    for step in range(1, STEPS + 1):
        rendered = draw_depth(g, logits, truths[step % len(truths)].camera)
        _, v = projection(rendered, reach=OFFSET)
        for name, rate in RATES.items():
            if name not in v.gaussians:
                continue
            m, s = moments[name]
            m[:], s[:] = 0.9 * m + 0.1 * v.gaussians[name], 0.999 * s + 0.001 * v.gaussians[name] ** 2
            move = rate * (m / (1 - 0.9**step)) / (np.sqrt(s / (1 - 0.999**step)) + 1e-15)
            g = g._replace(**{name: getattr(g, name) - move})
        if arm == ARMS[0]:
            width = min(width, 1 / reference_sharpness(g.distances))
        if arm != ARMS[2]:
            logits = opacities(g, width)
    return g, logits


def measure(g: SDFSurfels, logits: Floats, truths: list[Truth]) -> dict[str, float]:
    """Return errors of projected centres, distances and rendered depths, and the slope of distances along normals."""
    errors = []
    for truth in truths:
        rendered = draw_depth(g, logits, truth.camera)
        depth = expected_depth(rendered.channel("depth")[..., 0], rendered.output.alpha)[truth.is_sphere]
        errors.append((depth - truth.depth)[depth > 0])
    radii = np.linalg.norm(projected(g.means, g.quats, g.distances), axis=1)
    return {
        "radius_error": float(np.mean(np.abs(radii - 1))),
        "consistency": float(np.std(g.distances - np.linalg.norm(g.means, axis=1) + 1)),
        "depth_bias": float(np.mean(np.concatenate(errors))),
        "depth_error": float(np.mean(np.abs(np.concatenate(errors)))),
        "slope": eikonal(g),
    }


def eikonal(g: SDFSurfels, n_neighbours: int = 6) -> float:
    """Return the slope of distances along normals, fitted to all pairs of neighbours; 1 for a distance."""
    from scipy.spatial import cKDTree

    normals = g.means / np.linalg.norm(g.means, axis=1, keepdims=True)
    _, near = cKDTree(normals).query(normals, n_neighbours + 1)
    between = (normals[near[:, 1:]] + normals[:, None]) / 2  # by one normal alone, the curvature would count as rise
    rise = np.sum((g.means[near[:, 1:]] - g.means[:, None]) * between, axis=2)
    return float(np.sum((g.distances[near[:, 1:]] - g.distances[:, None]) * rise) / np.sum(rise * rise))


def sphere_table(records: list[dict[str, Any]]) -> str:
    """Return the table: what all arms begin with, and each at its end."""
    before = [{"arm": "before", **record["before"]} for record in records if record["arm"] == ARMS[0]]
    return table(
        [*before, *({"arm": record["arm"], **record["after"]} for record in records)], {"arm": "opacity"}, SPHERE
    )


# --- relight ---


def run_relight(args: argparse.Namespace) -> kit.Report:
    """Train both recipes, and measure albedo and relit images."""
    records: list[dict[str, Any]] = []
    shown: dict[str, Floats] = {}
    for seed in kit.with_progress(range(args.seeds), "seeds"):
        scene, truths = glossy_sphere(np.random.default_rng(seed))
        for name in RECIPES:
            recipe = find_recipe(name, args.iterations)
            recipe = configure(recipe, foreground=1.0) if name == RECIPES[0] else recipe
            model = kit.train_with_progress(scene, recipe, seed).model
            render = recipe.representation.renderer.render
            measured, shown[name] = compare(model, render, truths)
            records.append({"recipe": name, "seed": seed, "surfels": len(model.gaussians.means), **measured})
    truth_image = photograph(truths[0], _light(1))
    text = table(records, {"recipe": "recipe"}, RELIT)
    figure, panels = subplots((9, 2.6), 1, 3)
    for axes, (name, image) in zip(panels, {"truth, relit": truth_image, **shown}.items(), strict=True):
        show(axes, np.clip(image, 0, 1), name)
    return kit.Report({**kit.settings_of(args, "iterations", "seeds"), "records": records}, figure, text)


def environment(which: int) -> Floats:
    """Return the environment of the training, 0, or that of the relighting, 1: linear RGB [32, 64, 3]."""
    directions, _ = texel_directions(32, 64)
    sky, ground = ([0.9, 1.0, 1.2], [0.4, 0.35, 0.3]) if which == 0 else ([0.5, 0.4, 0.35], [0.2, 0.3, 0.5])
    image = np.where(directions[..., 2:] > 0, sky, ground)
    lamp = np.array([0.6, 0.0, 0.8]) if which == 0 else np.array([-0.8, 0.6, 0.0])
    image[directions @ lamp > np.cos(0.25)] = 6.0
    return image


@cache
def _light(which: int) -> Filtered:
    return prefilter(environment(which))


def albedo_at(points: Floats) -> Floats:
    """Return the chequered albedo [P, 3] of points of the sphere."""
    longitude, latitude = np.arctan2(points[:, 1], points[:, 0]), np.arcsin(np.clip(points[:, 2], -1, 1))
    is_dark = (np.floor(longitude / (np.pi / 4)) + np.floor(latitude / (np.pi / 4))) % 2 > 0
    return np.where(is_dark[:, None], [0.15, 0.3, 0.5], [0.8, 0.6, 0.3])


def photograph(truth: Truth, light: Filtered) -> Floats:
    """Return the exact image [H, W, 3] of the glossy sphere, sRGB; black beside it."""
    n = len(truth.normals)
    surface = Surface(albedo_at(truth.normals), np.zeros(n), np.full(n, ROUGHNESS), truth.normals, truth.to_camera)
    image = np.zeros((*truth.is_sphere.shape, 3))
    image[truth.is_sphere] = encode_srgb(shade(surface, light)[0])
    return image


def glossy_sphere(rng: np.random.Generator) -> tuple[Scene, list[Truth]]:
    """Return the scene, twelve photographs and points near the sphere, and three more views."""
    truths = [trace(camera) for camera in (*cameras(rng, 12), *cameras(rng, 3))]
    views = []
    for i, truth in enumerate(truths[:12]):
        image = np.round(255 * np.clip(photograph(truth, _light(0)), 0, 1)).astype(np.uint8)
        views.append(View(f"{i:02d}", truth.camera, image, None))
    points = rng.normal(size=(N_POINTS, 3))
    points *= (1 + NOISE * rng.normal(size=(N_POINTS, 1))) / np.linalg.norm(points, axis=1, keepdims=True)
    grey = np.full((N_POINTS, 3), 128, np.uint8)
    return Scene("glossy sphere", number_views(views), (), points, grey, np.zeros(3), 4.4), truths[12:]


def compare(model: Model, render: Any, truths: list[Truth]) -> tuple[dict[str, float], Floats]:
    """Return the errors of a model in views that it was not trained on, and the first of them relit."""
    relit = model._replace(shared={**model.shared, ENVIRONMENT: np.log(environment(1)).astype(np.float32)})
    found: dict[str, list[Floats]] = {"albedo": [], "relit": [], "plain": []}
    exact: dict[str, list[Floats]] = {"albedo": [], "relit": [], "plain": []}
    first = np.zeros((1, 1, 3))
    for k, truth in enumerate(truths):
        output, _ = render(model, view_from(truth.camera), Request(wants=frozenset({"albedo"})))
        alpha = np.maximum(output.alpha[truth.is_sphere], 1e-6)[:, None]
        found["albedo"].append(output.image[truth.is_sphere][:, -3:] / alpha)
        found["plain"].append(output.image[truth.is_sphere][:, :3])
        image = render(relit, view_from(truth.camera), Request())[0].image
        first = image if k == 0 else first
        found["relit"].append(decode_srgb(np.clip(image[truth.is_sphere], 0, 1)))
        exact["albedo"].append(albedo_at(truth.normals))
        for name, which in (("plain", 0), ("relit", 1)):
            exact[name].append(np.clip(photograph(truth, _light(which))[truth.is_sphere], 0, 1))
    all_found, all_exact = ({key: np.concatenate(parts) for key, parts in d.items()} for d in (found, exact))
    albedo = _scaled(all_found["albedo"], all_exact["albedo"]) - all_exact["albedo"]
    linear = np.maximum(_scaled(all_found["relit"], decode_srgb(all_exact["relit"])), 0)
    light = encode_srgb(linear) - all_exact["relit"]
    plain = np.clip(all_found["plain"], 0, 1) - all_exact["plain"]
    return {
        "albedo_error": float(np.sqrt(np.mean(albedo**2))),
        "relit_psnr": float(-10 * np.log10(np.mean(light**2))),
        "psnr": float(-10 * np.log10(np.mean(plain**2))),
    }, first


def _scaled(found: Floats, exact: Floats) -> Floats:
    """Return values [P, 3] times the factor of each channel that fits best."""
    factors: Floats = np.sum(found * exact, axis=0) / np.maximum(np.sum(found * found, axis=0), 1e-12)
    return found * factors


CLAIMS = (
    declare("sphere", "noisy surfels around a sphere: what projection does", run_sphere, *(OUT, seeds(3))),
    declare("relight", "a glossy sphere relit, beside Ref-Gaussian", run_relight, *(OUT, iterations(2000), seeds(3))),
)
