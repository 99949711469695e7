"""Synthetic scenes, stage 4: light. Ray-trace one view of a world: colour, exact depth, normals and ids.

The model is Lambert's law under one small area light with shadows, a sky-to-ground gradient of ambient light,
Blinn-Phong highlights, and mirror reflections with Schlick's Fresnel term. Left out: indirect light beyond one
reflection, refraction, lenses.

Depth and normals are those of pixel centres and are never averaged: an average across an edge lies on neither surface.
Colour is the mean of n x n samples per pixel.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from minisplat_ref.datasets.synthetic.geometry import (
    Hits,
    Primitive,
    facing_normals,
    first_hits,
    rays_by_primitive,
    take_rows,
)
from minisplat_ref.io.srgb import encode_srgb
from minisplat_ref.reference.pinhole import pinhole_rays
from minisplat_ref.types import Camera, Floats, Ints

SURFACE_OFFSET = 1e-6  # world units; a reflected ray starts this far off its surface, so that it does not hit it again
BLOCK_RAYS = 100_000  # at once: enough to hide the overhead of NumPy's calls, few enough to stay in the cache
LIT_UP_TO = 1.0 - 1e-6  # fraction of the way from the light to a point, up to which a blocker casts a shadow


class World(NamedTuple):
    """Everything that a camera can see, and its light."""

    primitives: tuple[Primitive, ...]
    """Surfaces."""
    light_positions: Floats
    """[L, 3] samples of the area light, world frame. Sample s of a pixel uses light s % L: soft shadows at no cost."""
    light_color: Floats
    """[3] linear RGB that a white surface facing the light shows at distance ``light_reach``."""
    light_reach: float
    """World units; the light falls off with the square of the distance."""
    ambient_above: Floats
    """[3] linear RGB that reaches a surface facing up."""
    ambient_below: Floats
    """[3] linear RGB that reaches a surface facing down."""
    sky: Callable[[Floats], Floats] | None
    """Unit directions [n, 3] -> linear RGB [n, 3] of the light from infinity; None where the world is closed."""


class TracedView(NamedTuple):
    """One view of a world, with its truth."""

    image: NDArray[np.uint8]
    """[H, W, 3] sRGB."""
    depth: Floats
    """[H, W] float64 camera z at pixel centres, world units; 0 at the sky."""
    normals: Floats
    """[H, W, 3] float64 unit normals towards the camera at pixel centres, world frame; 0 at the sky."""
    ids: Ints
    """[H, W] int16 index of the world's primitive at pixel centres; -1 at the sky."""


def trace_view(world: World, camera: Camera, supersampling: int) -> TracedView:
    """Ray-trace one view.

    Parameters
    ----------
    world : World
        The scene; +z is up for its ambient light.
    camera : Camera
        From where.
    supersampling : int
        n of the n x n colour samples per pixel.

    Returns
    -------
    TracedView
        Colour, depth, normals and ids.
    """
    origin = camera.center
    offsets = (np.arange(supersampling) + 0.5) / supersampling  # [n] pixels from the pixel's edge
    n_samples = supersampling**2
    light = np.zeros((camera.height, camera.width, 3))
    n_rows = max(1, BLOCK_RAYS // (n_samples * camera.width))
    for first_row in range(0, camera.height, n_rows):
        block = np.arange(first_row, min(first_row + n_rows, camera.height))
        directions = np.concatenate([pixel_rays(camera, x, y, block) for y in offsets for x in offsets])  # [n^2 R W, 3]
        light_ids = np.repeat(np.arange(n_samples) % len(world.light_positions), len(block) * camera.width)
        colors = radiance(world, origin, directions, first_hits(world.primitives, origin, directions), light_ids)
        samples = np.clip(colors, 0.0, 1.0).reshape(n_samples, len(block), camera.width, 3)
        light[block] = samples.mean(axis=0)  # of clipped samples: the edges of highlights stay smooth
    image = np.round(255.0 * encode_srgb(np.clip(light, 0, 1))).astype(np.uint8)

    directions = pixel_rays(camera, 0.5, 0.5, np.arange(camera.height))
    hits = first_hits(world.primitives, origin, directions)
    points = points_along(origin, directions, hits)
    normals = facing_normals(world.primitives, hits, points, directions)
    # Directions have camera z = 1, so the ray parameter is the depth itself.
    depth = np.where(hits.primitive_ids >= 0, hits.distances, 0.0)
    shape = image.shape[:2]
    return TracedView(image, depth.reshape(shape), normals.reshape(image.shape), hits.primitive_ids.reshape(shape))


def pixel_rays(camera: Camera, offset_x: float, offset_y: float, image_rows: Ints) -> Floats:
    """[R * W, 3] directions through one point of every pixel of R rows, world frame, scaled to camera z = 1.

    The offsets are in pixels from the pixel's top-left corner: (0.5, 0.5) is its centre.
    """
    directions = pinhole_rays(np.arange(camera.width) + offset_x, image_rows[:, None] + offset_y, camera)  # [R, W, 3]
    return directions.reshape(-1, 3) @ camera.cam_from_world_R


def points_along(origins: Floats, directions: Floats, hits: Hits) -> Floats:
    """[n, 3] where the rays hit, world frame; the origin where they do not."""
    t = np.where(hits.primitive_ids >= 0, hits.distances, 0.0)
    return origins + t[:, None] * directions


def lengths(vectors: Floats) -> Floats:
    """[n, 1] Euclidean length of vectors [n, 3]; a fraction of the time of numpy.linalg.norm."""
    return np.sqrt(np.einsum("ni,ni->n", vectors, vectors))[:, None]


def radiance(
    world: World, origins: Floats, directions: Floats, hits: Hits, light_ids: Ints, n_bounces: int = 1
) -> Floats:
    """Linear RGB that comes back along each ray.

    Parameters
    ----------
    world : World
        The surfaces and the light.
    origins : ndarray of shape (3,) or (n, 3)
        World frame.
    directions : ndarray of shape (n, 3)
        World frame, any length.
    hits : Hits
        First hits of these rays.
    light_ids : ndarray of shape (n,)
        Which sample of the light each ray uses.
    n_bounces : int
        How many more reflections to follow.

    Returns
    -------
    ndarray of shape (n, 3)
        Linear RGB, not clipped.
    """
    unit = directions / lengths(directions)  # [n, 3]
    points = points_along(origins, directions, hits)
    normals = facing_normals(world.primitives, hits, points, directions)
    colors = np.zeros_like(directions)
    is_surface = hits.primitive_ids >= 0
    if world.sky is not None:
        colors[~is_surface] = world.sky(unit[~is_surface])

    to_light = world.light_positions[light_ids] - points  # [n, 3]
    distances = lengths(to_light)  # [n, 1]
    to_light /= distances
    cosines = np.einsum("ni,ni->n", normals, to_light)
    is_lit = (cosines > 0) & is_surface
    is_lit[is_lit] = ~_is_shadowed(world, points[is_lit], light_ids[is_lit])
    strengths = np.where(is_lit, (world.light_reach / distances[:, 0]) ** 2, 0.0)  # [n]
    upward = 0.5 + 0.5 * normals[:, 2:]
    received = world.ambient_below + upward * (world.ambient_above - world.ambient_below)  # [n, 3]
    received += (strengths * cosines)[:, None] * world.light_color

    for primitive, rays in rays_by_primitive(world.primitives, hits):
        material = primitive.material
        albedo = material.texture(primitive.to_local(take_rows(points, rays)))  # [m, 3]
        if material.is_light:
            colors[rays] = albedo
            continue
        colors[rays] = albedo * take_rows(received, rays)
        if material.highlight > 0:
            halfway = to_light[rays] - unit[rays]
            halfway /= lengths(halfway)
            lobe = np.maximum(np.einsum("ni,ni->n", normals[rays], halfway), 0.0) ** material.shininess
            colors[rays] += (material.highlight * lobe * strengths[rays])[:, None] * world.light_color
        if material.reflectance > 0 and n_bounces > 0:
            colors[rays] = _add_reflection(
                world,
                colors[rays],
                points[rays],
                normals[rays],
                unit[rays],
                light_ids[rays],
                material.reflectance,
                n_bounces,
            )
    return colors


def _is_shadowed(world: World, points: Floats, light_ids: Ints) -> NDArray[np.bool_]:
    """[n] whether something lies between a point and its sample of the light."""
    blockers = tuple(primitive for primitive in world.primitives if primitive.casts_shadow)
    is_shadowed = np.zeros(len(points), bool)
    for light_id in np.unique(light_ids):
        rays = np.flatnonzero(light_ids == light_id)
        light = world.light_positions[light_id]
        is_shadowed[rays] = first_hits(blockers, light, points[rays] - light).distances < LIT_UP_TO
    return is_shadowed


def _add_reflection(
    world: World,
    colors: Floats,
    points: Floats,
    normals: Floats,
    directions: Floats,
    light_ids: Ints,
    reflectance: float,
    n_bounces: int,
) -> Floats:
    """Mix the surface's colours [n, 3] with their reflections, by Schlick's F = F0 + (1 - F0) (1 - cos)^5."""
    cosine = -np.einsum("ni,ni->n", normals, directions)[:, None]  # [n, 1]
    fresnel = reflectance + (1.0 - reflectance) * (1.0 - np.clip(cosine, 0.0, 1.0)) ** 5
    mirrored = directions + 2.0 * cosine * normals  # [n, 3]
    origins = points + SURFACE_OFFSET * normals
    hits = first_hits(world.primitives, origins, mirrored)
    seen = radiance(world, origins, mirrored, hits, light_ids, n_bounces - 1)
    return (1.0 - fresnel) * colors + fresnel * seen
