"""Claim ``reflective/mirrors`` (arXiv 2412.19282): what a mirror needs, on spheres whose every pixel is known.

A metal sphere of surfels stands in an environment with a lamp and stripes. Its truth is shaded where the pixel's ray
meets the sphere. Beside shading per pixel and per surfel, each surfel gets the spherical harmonics of degree 3 that fit
its true radiance best. A second, black sphere then hides a part of the environment from the first, and in the end the
environment itself is sought, from images of the first sphere alone.
"""

import argparse
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from data_tools.claims import kit
from data_tools.claims.kit.claim import OUT, declare, seeds
from data_tools.claims.kit.figures import show, subplots
from data_tools.claims.kit.tables import spread, table
from minisplat_ref.constants import SH_C0
from minisplat_ref.datasets.synthetic.cameras import look_at
from minisplat_ref.io.srgb import encode_srgb
from minisplat_ref.mechanisms.gbuffer.environment import texel_directions
from minisplat_ref.mechanisms.gbuffer.lighting import ENVIRONMENT
from minisplat_ref.mechanisms.gbuffer.population import (
    PER_PIXEL,
    PER_SURFEL,
    STAGE,
    WITH_OCCLUSION,
    ReflectiveSurfels,
)
from minisplat_ref.mechanisms.gbuffer.prefilter import Filtered, prefilter
from minisplat_ref.mechanisms.gbuffer.renderer import REFLECTIVE
from minisplat_ref.mechanisms.gbuffer.shading import Surface, shade
from minisplat_ref.mechanisms.surfels.renderer import SURFELS
from minisplat_ref.reference.pinhole import pinhole_rays
from minisplat_ref.reference.spherical_harmonics import sh_basis
from minisplat_ref.rendering import Request
from minisplat_ref.types import Bools, Camera, Floats, Gaussians, Model, view_from

ALBEDO, ROUGHNESS = 0.9, 0.1  # of the metal
WIDTH, HEIGHT, N_VIEWS = 96, 72, 8
N_SURFELS = (500, 2000, 8000)
TILT = 0.05  # radians: standard deviation by which normals are off
OTHER = np.array([2.3, 0.0, 0.0])  # centre of the black sphere
INFINITE = 40.0  # logit of a share of 1
STEPS, RATE = 60, 0.1  # of the search for the environment
SHADED = (
    ("PSNR (dB)", spread("psnr", 1)),
    ("highlight off by (px)", spread("highlight", 2)),
    ("normals off by (degrees)", spread("normal_error", 2)),
)


class Truth(NamedTuple):
    """A view of the sphere."""

    camera: Camera
    image: Floats
    """[H, W, 3] sRGB, black beside the sphere."""
    is_sphere: Bools
    """[H, W]."""
    normals: Floats
    """[P, 3] of its pixels, world frame."""
    is_hidden: Bools
    """[P] whether the black sphere is in the way of the reflected ray."""


def run(args: argparse.Namespace) -> kit.Report:
    """Measure, and draw one view of each arm."""
    records, shown = [], {}
    light = prefilter(environment())
    for seed in kit.with_progress(range(args.seeds), "seeds"):
        rng = np.random.default_rng(seed)
        views = [trace(camera, light) for camera in _cameras(rng)]
        for n in N_SURFELS:
            for tilt in (0.0, TILT):
                sphere = sphere_of(n, tilt, rng)
                for arm, image in _images(sphere, views, light).items():
                    records.append({"surfels": n, "tilt": tilt, "arm": arm, "seed": seed, **compare(views, image)})
                    shown[arm] = image[0]
        both = [trace(camera, light, hides=True) for camera in _cameras(rng)]
        records += [{"seed": seed, **record} for record in _occlusion(both, rng)]
        records.append({"arm": "environment", "seed": seed, **recover(views[:4], rng)})
    described = {**kit.settings_of(args, "seeds"), "albedo": ALBEDO, "roughness": ROUGHNESS, "tilt": TILT}
    return kit.Report({**described, "records": records}, draw(views[0], shown), tables(records))


def environment() -> Floats:
    """Return an environment with a horizon, stripes and one lamp, linear RGB [32, 64, 3]."""
    directions, _ = texel_directions(32, 64)
    up = directions[..., 2:]
    stripes = 0.5 + 0.5 * np.sign(np.sin(6 * np.arctan2(directions[..., 1:2], directions[..., :1])))
    image = np.where(up > 0, [0.35, 0.5, 0.8], [0.25, 0.2, 0.15]) * (0.4 + 0.6 * stripes)
    lamp = np.array([0.4, -0.5, np.sqrt(1 - 0.41)])
    image[directions @ lamp > np.cos(0.12)] = 8.0
    return image


def _cameras(rng: np.random.Generator) -> list[Camera]:
    turned = rng.uniform(0, 2 * np.pi) + 2 * np.pi * np.arange(N_VIEWS) / N_VIEWS
    places = [np.array([4 * np.cos(a), 4 * np.sin(a), rng.uniform(0.5, 2.0)]) for a in turned]
    return [look_at(place, np.zeros(3), 1.3 * WIDTH, WIDTH, HEIGHT) for place in places]


def _towards_unit_sphere(origins: Floats, rays: Floats, centre: Floats) -> tuple[Bools, Floats]:
    """Return which unit rays meet a sphere of radius 1 ahead, and how far away."""
    offsets = origins - centre
    b, c = np.sum(rays * offsets, axis=-1), np.sum(offsets * offsets, axis=-1) - 1
    root = b * b - c
    t = -b - np.sqrt(np.maximum(root, 0))
    return (root > 0) & (t > 1e-6), t


def trace(camera: Camera, light: Filtered, *, hides: bool = False) -> Truth:
    """Return the truth of a view; with ``hides``, the black sphere is there."""
    rays = pinhole_rays(np.arange(WIDTH) + 0.5, np.arange(HEIGHT)[:, None] + 0.5, camera) @ camera.cam_from_world_R
    rays /= np.linalg.norm(rays, axis=2, keepdims=True)
    is_met, t = _towards_unit_sphere(camera.center, rays, np.zeros(3))
    if hides:
        in_front, _ = _towards_unit_sphere(camera.center, rays, OTHER)
        is_met &= ~in_front
    d = rays[is_met]
    normals = camera.center + t[is_met][:, None] * d
    r = d - 2 * np.sum(d * normals, axis=1, keepdims=True) * normals
    is_hidden = _towards_unit_sphere(normals, r, OTHER)[0] & hides
    n = len(d)
    metal = Surface(np.full((n, 3), ALBEDO), np.ones(n), np.full(n, ROUGHNESS), normals, -d)
    image = np.zeros((HEIGHT, WIDTH, 3))
    image[is_met] = np.where(is_hidden[:, None], 0, encode_srgb(shade(metal, light)[0]))
    return Truth(camera, image, is_met, normals, is_hidden)


def sphere_of(n: int, tilt: float, rng: np.random.Generator, centre: Floats | None = None) -> Gaussians:
    """Return surfels on a sphere of radius 1, evenly spread and tangent, but for a tilt of random axis, in radians."""
    i = np.arange(n) + 0.5
    z, phi = 1 - 2 * i / n, np.pi * (1 + 5**0.5) * i
    normals = np.stack([np.sqrt(1 - z * z) * np.cos(phi), np.sqrt(1 - z * z) * np.sin(phi), z], axis=1)
    tilted = normals + tilt * rng.normal(size=(n, 3))
    tilted /= np.linalg.norm(tilted, axis=1, keepdims=True)
    quats = np.stack([1 + tilted[:, 2], -tilted[:, 1], tilted[:, 0], np.zeros(n)], axis=1)  # turns z to the normal
    size = np.log(0.7 * np.sqrt(4 * np.pi / n))
    means = normals if centre is None else normals + centre
    return Gaussians(
        means, quats, np.full((n, 3), size), np.full(n, 4.0), np.full((n, 3), -0.5 / SH_C0), np.zeros((n, 0, 3))
    )


def metal_of(gaussians: Gaussians, metallic: Floats | float = INFINITE, albedo: float = ALBEDO) -> ReflectiveSurfels:
    """Return surfels of the metal; no light comes from around."""
    n = len(gaussians.means)
    return ReflectiveSurfels(
        **gaussians._asdict(),
        albedo_logits=np.full((n, 3), np.log(albedo / (1 - albedo))),
        metallic_logits=np.broadcast_to(metallic, n).astype(float),
        roughness_logits=np.full(n, np.log(ROUGHNESS / (1 - ROUGHNESS))),
        around_dc=np.zeros((n, 3)),
        around_rest=np.zeros((n, 0)),
    )


def model_of(surfels: ReflectiveSurfels, stage: int, log_environment: Floats | None = None) -> Model:
    """Return a model in the environment of the claim, or in another."""
    shared = np.log(environment()) if log_environment is None else log_environment
    return Model(surfels, {ENVIRONMENT: shared, STAGE: np.full(1, float(stage))})


def _images(sphere: Gaussians, views: list[Truth], light: Filtered) -> dict[str, list[Floats]]:
    """Return the images [H, W, 3] of every arm, view by view, with the normals of those that have them."""
    metal, request = metal_of(sphere), Request(wants=frozenset({"normal"}))
    by_stage = {
        arm: [REFLECTIVE.render(model_of(metal, stage), view_from(v.camera), request)[0].image for v in views]
        for arm, stage in (("per pixel", PER_PIXEL), ("per surfel", PER_SURFEL))
    }
    fitted = Model(fit_harmonics(sphere, light))
    return {**by_stage, "harmonics": [SURFELS.render(fitted, view_from(v.camera), request)[0].image for v in views]}


def fit_harmonics(sphere: Gaussians, light: Filtered, n_directions: int = 120) -> Gaussians:
    """Return the surfels with harmonics of degree 3 that fit their radiance best, over the hemisphere seen of each."""
    n = len(sphere.means)
    normals = sphere.means / np.linalg.norm(sphere.means, axis=1, keepdims=True)
    i = np.arange(n_directions) + 0.5
    z, phi = 1 - i / n_directions, np.pi * (1 + 5**0.5) * i
    local = np.stack([np.sqrt(1 - z * z) * np.cos(phi), np.sqrt(1 - z * z) * np.sin(phi), z], axis=1)
    coefficients = np.empty((n, 16, 3))
    for k in range(n):
        helper = np.eye(3)[np.argmin(np.abs(normals[k]))]
        u = np.cross(normals[k], helper)
        u /= np.linalg.norm(u)
        to_camera = local @ np.stack([u, np.cross(normals[k], u), normals[k]])
        flat = np.ones(n_directions)
        point = Surface(
            ALBEDO * np.ones((n_directions, 3)), flat, ROUGHNESS * flat, flat[:, None] * normals[k], to_camera
        )
        target = encode_srgb(shade(point, light)[0]) - 0.5
        coefficients[k] = np.linalg.lstsq(sh_basis(-to_camera, 3), target, rcond=None)[0]
    return sphere._replace(sh_dc=coefficients[:, 0], sh_rest=coefficients[:, 1:])


def compare(views: list[Truth], images: list[Floats]) -> dict[str, float]:
    """Return PSNR on the sphere, how far the highlight is from where it belongs, and the error of normals."""
    errors, offsets, angles = [], [], []
    for truth, image in zip(views, images, strict=True):
        found = np.clip(image[truth.is_sphere][:, :3], 0, 1)
        errors.append(np.mean((found - np.clip(truth.image[truth.is_sphere], 0, 1)) ** 2))
        centres = [_highlight(picture, truth.is_sphere) for picture in (truth.image, image[..., :3])]
        if centres[0] is not None and centres[1] is not None:
            offsets.append(np.linalg.norm(centres[0] - centres[1]))
        normals = image[truth.is_sphere][:, 3:6] @ truth.camera.cam_from_world_R
        angles.append(kit.angles(normals, truth.normals).mean())
    return {
        "psnr": float(-10 * np.log10(np.mean(errors))),
        "highlight": float(np.mean(offsets)) if offsets else float("nan"),
        "normal_error": float(np.mean(angles)),
    }


def _highlight(image: Floats, is_sphere: Bools) -> Floats | None:
    """Return the centre (y, x) of what is within a tenth of the brightest, or of white; None if nothing is bright."""
    brightness = np.where(is_sphere, image.min(axis=2), 0)
    if brightness.max() < 0.5:
        return None
    bright = brightness > 0.9 * min(brightness.max(), 1.0)
    return np.argwhere(bright).mean(axis=0)


def _occlusion(views: list[Truth], rng: np.random.Generator) -> list[dict[str, Any]]:
    """Return PSNR where the black sphere is reflected, and on the rest of the mirror, with occlusion and without."""
    mirror, black = sphere_of(2000, 0.0, rng), sphere_of(2000, 0.0, rng, OTHER)
    both = Gaussians(*(np.concatenate(fields) for fields in zip(mirror, black, strict=True)))
    metal = metal_of(both)
    albedo = metal.albedo_logits.copy()
    albedo[len(mirror.means) :] = -INFINITE
    metal, records = metal._replace(albedo_logits=albedo), []
    for arm, stage in (("all of the environment", PER_PIXEL), ("with occlusion", WITH_OCCLUSION)):
        hidden, seen = [], []
        for truth in views:
            image = REFLECTIVE.render(model_of(metal, stage), view_from(truth.camera), Request())[0].image
            errors = (np.clip(image[truth.is_sphere], 0, 1) - np.clip(truth.image[truth.is_sphere], 0, 1)) ** 2
            hidden.append(errors[truth.is_hidden])
            seen.append(errors[~truth.is_hidden])
        decibels = [float(-10 * np.log10(np.concatenate(part).mean())) for part in (hidden, seen)]
        records.append({"arm": arm, "hidden_psnr": decibels[0], "seen_psnr": decibels[1]})
    return records


def recover(views: list[Truth], rng: np.random.Generator) -> dict[str, float]:
    """Return the error of the environment that Adam finds from images of the sphere, before and after."""
    metal, target = metal_of(sphere_of(2000, 0.0, rng)), environment()
    _, solid = texel_directions(*target.shape[:2])
    log = np.full(target.shape, np.log(0.4))
    m, v, errors = np.zeros_like(log), np.zeros_like(log), []

    def error() -> float:
        difference = (encode_srgb(np.exp(log)) - encode_srgb(target)) ** 2
        return float(np.sqrt(np.sum(solid[..., None] * difference) / (12 * np.pi)))

    errors.append(error())
    for step in range(1, STEPS + 1):
        truth = views[step % len(views)]
        output, tape = REFLECTIVE.render(model_of(metal, PER_PIXEL, log), view_from(truth.camera), Request())
        v_image = np.where(truth.is_sphere[..., None], output.image - truth.image, 0) / truth.is_sphere.sum()
        gradient = REFLECTIVE.render_vjp(tape, v_image, None).shared[ENVIRONMENT]
        m, v = 0.9 * m + 0.1 * gradient, 0.99 * v + 0.01 * gradient**2
        log = log - RATE * (m / (1 - 0.9**step)) / (np.sqrt(v / (1 - 0.99**step)) + 1e-8)
    errors.append(error())
    return {"error_before": errors[0], "error_after": errors[1]}


def tables(records: list[dict[str, Any]]) -> str:
    """Return the tables: shading, occlusion, and the environment that was sought."""
    shaded = [record for record in records if "highlight" in record]
    beside = [record for record in records if "hidden_psnr" in record]
    sought = [record for record in records if "error_before" in record]
    hidden = (("where it is hidden", spread("hidden_psnr", 1)), ("elsewhere", spread("seen_psnr", 1)))
    before, after = (spread(key, 3)(sought) for key in ("error_before", "error_after"))
    return (
        f"{table(shaded, {'surfels': 'surfels', 'tilt': 'tilt', 'arm': 'shaded'}, SHADED)}\n\n"
        f"beside a black sphere, PSNR in dB:\n\n{table(beside, {'arm': 'reflected'}, hidden)}\n\n"
        f"environment from images of the sphere, RMS error in sRGB: {before} at the start, {after} after {STEPS} steps"
    )


def draw(truth: Truth, shown: dict[str, Floats]) -> Figure:
    """Draw one view: the truth, and each arm with most surfels and tilted normals."""
    figure, axes = subplots((3 * (1 + len(shown)), 2.6), 1, 1 + len(shown))
    show(axes[0], np.clip(truth.image, 0, 1), "truth")
    for ax, (arm, image) in zip(axes[1:], shown.items(), strict=True):
        show(ax, np.clip(image[..., :3], 0, 1), arm)
    return figure


CLAIMS = (declare("mirrors", "what a mirror needs: shading per pixel, light, occlusion", run, *(OUT, seeds(3))),)
