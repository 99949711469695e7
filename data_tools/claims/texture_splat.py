"""Claim ``texture-splat/bricks`` (arXiv 2506.13348): what a texture is worth beside more surfels with as many floats.

A wall of bricks with rounded edges is covered by a grid of round surfels, which stay where they are. Their textures
are baked from exact maps of albedo and normals in some views, and compared with those of others. Beside textures of
T x T texels on the same surfels there are more and smaller surfels of one texel, baked likewise: as many as have no
more floats. A surfel has its place and shape in 11 numbers and its light from around in 48, harmonics of degree 3, as
the recipe trains it; with a light of degree 0 it has 3 instead, and then a texture costs relatively more.
"""

import argparse
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from data_tools.claims import kit
from data_tools.claims.kit.claim import OUT, declare, seeds
from data_tools.claims.kit.figures import group, mean_and_deviation, show, with_deviation
from minisplat_ref.datasets.synthetic.cameras import look_at
from minisplat_ref.extensions.texture_splat.baking import Maps, bake
from minisplat_ref.extensions.texture_splat.model import TEXTURED, TexturedSurfels, with_textures
from minisplat_ref.interface.palette import BLUE, GREEN, RED
from minisplat_ref.interface.reporting import markdown_table
from minisplat_ref.mechanisms.gbuffer.lighting import ENVIRONMENT
from minisplat_ref.mechanisms.gbuffer.population import PER_PIXEL, STAGE, ReflectiveSurfels
from minisplat_ref.reference.pinhole import pinhole_rays
from minisplat_ref.rendering import Request
from minisplat_ref.types import Camera, Floats, Gaussians, Model, view_from

WIDTH, HEIGHT = 128, 96
N_TRAIN, N_TEST = 8, 4  # views
HALF_WIDTH, HALF_HEIGHT = 1.2, 0.8  # of the wall, in its plane
N_SURFELS = 96  # of the coarse grid: 12 x 8
SIZES = (1, 2, 4, 8)  # T
BRICK = 0.4, 0.16  # width and height
MORTAR, ROUND = 0.01, 0.06  # half the width of a joint, and how far from it a brick is rounded
SLOPE = 0.8  # at its edge
SAMPLES = 4  # of a pixel, along each axis
STEPS = 50
LIGHTS = (3, 0)  # degrees of the harmonics that a surfel's floats are counted with
TEXTURES, MORE, FEWEST = "textures", "more surfels, light of degree 3", "more surfels, light of degree 0"
COLORS = {MORE: BLUE, FEWEST: GREEN, TEXTURES: RED}


class Wall(NamedTuple):
    """Colours of the bricks, and where their rows begin."""

    bricks: Floats
    """[rows, columns, 3] linear RGB, repeated over the wall."""
    shifts: Floats
    """[rows] of a row to the right."""
    mortar: Floats
    """[3]."""


def run(args: argparse.Namespace) -> kit.Report:
    """Bake and measure, and show one test view."""
    records, shown = [], {}
    for seed in kit.with_progress(range(args.seeds), "seeds"):
        rng = np.random.default_rng(seed)
        wall = make_wall(rng)
        maps = [trace(camera, wall) for camera in cameras(rng, N_TRAIN + N_TEST)]
        train, test = maps[:N_TRAIN], maps[N_TRAIN:]
        for arm, size, population in arms(rng):
            for steps in (0, STEPS):
                baked = bake(population, train, steps=steps)
                albedo, normals = zip(*(render_maps(baked, view.camera) for view in test), strict=True)
                records.append(
                    {
                        "arm": arm,
                        "T": size,
                        "seed": seed,
                        "steps": steps,
                        "surfels": len(population.means),
                        "floats": {degree: len(population.means) * floats_of(population, degree) for degree in LIGHTS},
                        **compare(test, albedo, normals),
                    }
                )
            shown[arm, size] = albedo[0], normals[0]
    described = {**kit.settings_of(args, "seeds"), "views": N_TRAIN, "steps": STEPS, "records": records}
    return kit.Report(described, draw(records, test[0], shown), table(records))


def make_wall(rng: np.random.Generator) -> Wall:
    """Return a wall of reddish bricks of random colours, whose rows are shifted at random."""
    base = np.array([0.42, 0.16, 0.1])
    bricks = base * rng.uniform(0.5, 1.7, size=(16, 9, 1)) * rng.uniform(0.85, 1.15, size=(16, 9, 3))
    return Wall(np.clip(bricks, 0, 1), rng.uniform(0, BRICK[0], size=16), np.array([0.55, 0.53, 0.5]))


def look_up(wall: Wall, points: Floats) -> tuple[Floats, Floats]:
    """Return albedo and unit normals at points [P, 2] of the wall, which lies in the plane z = 0 and faces +z."""
    row = np.floor(points[:, 1] / BRICK[1]).astype(int)
    x = points[:, 0] - wall.shifts[row % len(wall.shifts)]
    column = np.floor(x / BRICK[0]).astype(int)
    inside = np.stack([x - column * BRICK[0], points[:, 1] - row * BRICK[1]], axis=1)  # from the brick's corner
    to_low, to_high = inside, np.array(BRICK) - inside  # [P, 2] distances from both edges
    distance = np.minimum(to_low, to_high)
    is_mortar = (distance < MORTAR).any(axis=1)
    side = np.where(to_low < to_high, -1.0, 1.0)  # outward, of the nearer edge
    slopes = np.where(is_mortar[:, None], 0, side * SLOPE * np.maximum(1 - (distance - MORTAR) / ROUND, 0))
    normals = np.column_stack([slopes, np.ones(len(points))])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    brick = wall.bricks[row % wall.bricks.shape[0], column % wall.bricks.shape[1]]
    return np.where(is_mortar[:, None], wall.mortar, brick), normals


def cameras(rng: np.random.Generator, n: int) -> list[Camera]:
    """Return cameras before the wall, from many sides, that look at its middle."""
    places = np.column_stack([rng.uniform(-1.2, 1.2, n), rng.uniform(-0.8, 0.8, n), rng.uniform(2.0, 2.6, n)])
    aims = np.column_stack([rng.uniform(-0.2, 0.2, (n, 2)), np.zeros(n)])
    return [look_at(place, aim, 1.2 * WIDTH, WIDTH, HEIGHT) for place, aim in zip(places, aims, strict=True)]


def trace(camera: Camera, wall: Wall) -> Maps:
    """Return the maps of a view, means over ``SAMPLES``^2 points of each pixel; pixels that show the wall count."""
    albedo, normals = np.zeros((HEIGHT, WIDTH, 3)), np.zeros((HEIGHT, WIDTH, 3))
    is_known = np.ones((HEIGHT, WIDTH), bool)
    offsets = (np.arange(SAMPLES) + 0.5) / SAMPLES
    for dy in offsets:
        for dx in offsets:
            rays = pinhole_rays(np.arange(WIDTH) + dx, np.arange(HEIGHT)[:, None] + dy, camera)
            rays = rays @ camera.cam_from_world_R
            t = -camera.center[2] / rays[:, :, 2]
            points = (camera.center + t[:, :, None] * rays)[:, :, :2]
            is_known &= (t > 0) & (np.abs(points) < (HALF_WIDTH, HALF_HEIGHT)).all(axis=2)
            a, n = look_up(wall, points.reshape(-1, 2))
            albedo += a.reshape(albedo.shape) / SAMPLES**2
            normals += n.reshape(normals.shape) / SAMPLES**2
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    shares = np.broadcast_to([0.0, 0.8], (HEIGHT, WIDTH, 2))
    return Maps(camera, normals, np.concatenate([albedo, shares], axis=2), is_known)


def cover(n: int, rng: np.random.Generator) -> ReflectiveSurfels:
    """Return about ``n`` round surfels in the plane of the wall, on a square grid whose origin is random."""
    spacing = np.sqrt(4 * HALF_WIDTH * HALF_HEIGHT / n)
    counts = [max(1, round(2 * half / spacing)) for half in (HALF_WIDTH, HALF_HEIGHT)]
    # One row and one column more, so that a shifted grid still covers the wall.
    x, y = (
        -half + (np.arange(count + 1) + rng.uniform(-0.5, 0.5)) * 2 * half / count
        for half, count in zip((HALF_WIDTH, HALF_HEIGHT), counts, strict=True)
    )
    means = np.stack([*np.meshgrid(x, y), np.zeros((len(y), len(x)))], axis=2).reshape(-1, 3)
    m = len(means)
    quats, scales = np.tile([1.0, 0, 0, 0], (m, 1)), np.full((m, 3), np.log(0.7 * spacing))
    gaussians = Gaussians(means, quats, scales, np.full(m, 4.0), np.zeros((m, 3)), np.zeros((m, 0, 3)))
    return ReflectiveSurfels(
        **gaussians._asdict(),
        albedo_logits=np.zeros((m, 3)),
        metallic_logits=np.zeros(m),
        roughness_logits=np.zeros(m),
        around_dc=np.zeros((m, 3)),
        around_rest=np.zeros((m, 0)),
    )


def arms(rng: np.random.Generator) -> list[tuple[str, int, TexturedSurfels]]:
    """Return the populations by their arm and T: textures on the coarse grid, and finer grids with as many floats."""
    coarse, found = cover(N_SURFELS, rng), []
    for size in SIZES:
        textured = with_textures(coarse, rng, texels=size)
        found.append((TEXTURES, size, textured))
        for arm, degree in ((MORE, 3), (FEWEST, 0)) if size > 1 else ():
            n_floats = len(coarse.means) * floats_of(textured, degree)
            found.append((arm, size, with_textures(finest(n_floats, degree, rng), rng, texels=1)))
    return found


def finest(n_floats: int, degree: int, rng: np.random.Generator) -> ReflectiveSurfels:
    """Return the finest grid of which surfels with one texel have at most ``n_floats`` floats."""
    n_most = n_floats // floats_of(with_textures(cover(1, rng), rng, texels=1), degree)
    state = rng.bit_generator.state
    n = n_most
    while len((grid := cover(n, rng)).means) > n_most:
        n -= max(1, n // 200)
        rng.bit_generator.state = state
    return grid


def floats_of(population: TexturedSurfels, degree: int) -> int:
    """Return the floats of one surfel whose own colour and light from around have harmonics of a degree."""
    return kit.count_floats(population) + 2 * 3 * ((degree + 1) ** 2 - 1)


def render_maps(population: TexturedSurfels, camera: Camera) -> tuple[Floats, Floats]:
    """Return albedo and normals, world frame and unit, [H, W, 3] each, of a view."""
    model = Model(population, {ENVIRONMENT: np.zeros((4, 8, 3)), STAGE: np.full(1, float(PER_PIXEL))})
    wants = frozenset({"normal", "albedo"})
    output, _ = TEXTURED.render(model, view_from(camera), Request(wants=wants))
    slices = TEXTURED.channels(wants)
    normals = output.image[:, :, slices["normal"]] @ camera.cam_from_world_R
    normals /= np.maximum(np.linalg.norm(normals, axis=2, keepdims=True), 1e-12)
    return output.image[:, :, slices["albedo"]] / np.maximum(output.alpha, 1e-12)[:, :, None], normals


def compare(test: list[Maps], albedo: tuple[Floats, ...], normals: tuple[Floats, ...]) -> dict[str, float]:
    """Return PSNR of albedo, and of normals as pictures (n + 1) / 2, and the mean angle between normals."""
    errors: dict[str, list[Floats]] = {"albedo": [], "normals": [], "angle": []}
    for maps, a, n in zip(test, albedo, normals, strict=True):
        known = maps.is_known
        errors["albedo"].append((a - maps.materials[:, :, :3])[known] ** 2)
        errors["normals"].append(((n - maps.normals)[known] / 2) ** 2)
        errors["angle"].append(kit.angles(n[known], maps.normals[known]))
    return {
        "albedo_psnr": float(-10 * np.log10(np.concatenate(errors["albedo"]).mean())),
        "normal_psnr": float(-10 * np.log10(np.concatenate(errors["normals"]).mean())),
        "angle": float(np.concatenate(errors["angle"]).mean()),
    }


def table(records: list[dict[str, Any]]) -> str:
    """Return the tables: first how much textures are ahead, seed by seed, where they cost most; then all arms."""
    by_arm = group(records, "arm", "T", "steps")

    def of(arm: str, size: int, key: str, steps: int = STEPS) -> list[Any]:
        return [record[key] for record in by_arm[arm, size, steps]]

    def ahead(arm: str, size: int, key: str) -> str:
        return with_deviation([a - b for a, b in zip(of(TEXTURES, size, key), of(arm, size, key), strict=True)], 2)

    measures = {"albedo_psnr": "albedo (dB)", "normal_psnr": "normals (dB)"}
    gains = [
        [str(size), str(degree), *(ahead(arm, size, key) for key in measures)]
        for arm, degree in ((FEWEST, 0), (MORE, 3))
        for size in SIZES[1:]
    ]
    rows = []
    for size in SIZES:
        for arm in (FEWEST, MORE, TEXTURES) if size > 1 else (TEXTURES,):
            degrees = [f"{np.mean([f[degree] for f in of(arm, size, 'floats')]):,.0f}" for degree in LIGHTS]
            name = f"T = {size}" if arm == TEXTURES else f"as many floats as T = {size}, degree {arm[-1]}"
            numbers = [f"{np.mean(of(arm, size, 'surfels')):,.0f}", *degrees]
            solved = [with_deviation(of(arm, size, key), 2) for key in (*measures, "angle")]
            rows.append([name, *numbers, *solved, *(with_deviation(of(arm, size, key, 0), 2) for key in measures)])
    heading = ["", "surfels", "floats, degree 3", "degree 0", *measures.values(), "off by (degrees)"]
    return (
        "how far textures are ahead of more surfels with as many floats, by the degree of the light\n\n"
        f"{markdown_table(['T', 'degree', *measures.values()], gains)}\n\n"
        "test views; least squares, and in the last two columns texels that are weighted means\n\n"
        f"{markdown_table([*heading, 'albedo, means', 'normals, means'], rows)}"
    )


def draw(records: list[dict[str, Any]], truth: Maps, shown: dict[tuple[str, int], tuple[Floats, Floats]]) -> Figure:
    """Draw both curves against the floats at each degree, and albedo and normals of a test view."""
    figure = Figure(figsize=(12, 8), layout="constrained")
    parts: Any = figure.subfigures(2, 1, height_ratios=(1, 1.2))
    top, bottom = parts
    all_axes = top.subplots(1, 4)
    for i, (degree, more) in enumerate(((3, MORE), (0, FEWEST))):
        for axes, key, name in ((all_axes[i], "albedo_psnr", "albedo"), (all_axes[2 + i], "normal_psnr", "normals")):
            for arm in (more, TEXTURES):
                points = []
                for size in SIZES:
                    of = [r for r in records if r["steps"] == STEPS and r["T"] == size]
                    own = [r for r in of if r["arm"] == (TEXTURES if size == 1 else arm)]
                    x = np.mean([r["floats"][degree] for r in own]) / 1e3
                    points.append((x, *mean_and_deviation([r[key] for r in own])))
                x, y, error = np.transpose(points)
                axes.errorbar(x, y, error, marker="o", color=COLORS[arm], label=arm.partition(",")[0])
            axes.legend()
            axes.set_xscale("log")
            axes.set_xticks((3, 10, 30), ("3", "10", "30"), minor=False)
            axes.xaxis.set_minor_formatter("")
            axes.set(xlabel=f"thousands of floats, degree {degree}", ylabel=f"{name}: PSNR (dB)")
    columns = [(TEXTURES, size) for size in SIZES] + [(MORE, SIZES[-1])]
    axes = bottom.subplots(2, 1 + len(columns))
    pictures = [("truth", truth.materials[:, :, :3], truth.normals)]
    pictures += [(f"T = {size}" if arm == TEXTURES else "more surfels", *shown[arm, size]) for arm, size in columns]
    for pair, (name, albedo, normals) in zip(axes.T, pictures, strict=True):
        is_known = truth.is_known[:, :, None]
        show(pair[0], np.where(is_known, np.clip(albedo, 0, 1) ** (1 / 2.2), 1), name)
        show(pair[1], np.where(is_known, np.clip((normals + 1) / 2, 0, 1), 1), "")
    return figure


CLAIMS = (
    declare("bricks", "a brick wall: more texels beside more surfels, with as many floats", run, *(OUT, seeds(3))),
)
