"""Surfels with a signed distance, their start, and their shared parameters: gamma, beside the light."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from minisplat_ref.extensions.discretized_sdf.reference import opacity_logits
from minisplat_ref.mechanisms.editing.deformation import quaternions
from minisplat_ref.mechanisms.gbuffer.population import first_light, with_materials
from minisplat_ref.reference.covariance import rotation_matrices
from minisplat_ref.types import Floats, Gaussians, Scene

LOG_WIDTH = "log_width"  # name of the shared parameter, ln(1 / gamma)
WIDTH = 0.05  # 1 / gamma at the start, world units


class SDFSurfels(NamedTuple):
    """Surfels with a material and a signed distance: the fields of ``ReflectiveSurfels``, and one more."""

    means: Floats
    quats: Floats
    log_scales: Floats
    opacity_logits: Floats
    """[N] no parameter: computed from the distances, for density control and for files."""
    sh_dc: Floats
    sh_rest: Floats
    albedo_logits: Floats
    metallic_logits: Floats
    roughness_logits: Floats
    distances: Floats
    """[N] s: distance of the centre from the surface, positive on the side of the normal; world units."""


def with_distances(gaussians: Gaussians, rng: np.random.Generator, *, foreground: float) -> SDFSurfels:
    """Return surfels at distances that give them the opacities of the Gaussians; the foreground begins as a sphere.

    Half of the surfels, at random, have negative distances. Those of the foreground are moved along the radius, and
    face outwards, so that each is projected onto the sphere.

    Parameters
    ----------
    gaussians : Gaussians
        At the start.
    rng : numpy.random.Generator
        For directions and signs.
    foreground : float
        Share of the Gaussians that are in the foreground, those nearest to the median of all centres. The sphere
        around it has their largest distance as its radius; 0 leaves all centres where they are.
    """
    surfels = with_materials(gaussians, rng)
    n, dtype = len(surfels.means), surfels.means.dtype
    size = 2 * WIDTH * np.arcsinh(np.exp(-surfels.opacity_logits.astype(np.float64) / 2))
    distances = size * rng.choice([-1.0, 1.0], size=n)
    means, quats = surfels.means.astype(np.float64), surfels.quats.copy()
    rows, center, radius = _foreground(means, foreground)
    if len(rows):
        outwards = means[rows] - center
        length = np.linalg.norm(outwards, axis=1, keepdims=True)
        normals = np.where(length > 0, outwards / np.where(length > 0, length, 1), [0.0, 0.0, 1.0])
        means[rows] = center + (radius + distances[rows, None]) * normals
        quats[rows] = facing(normals, rotation_matrices(surfels.quats[rows].astype(np.float64)))
    distances = distances.astype(dtype)
    return SDFSurfels(
        **surfels._replace(
            means=means.astype(dtype),
            quats=quats,
            opacity_logits=opacity_logits(distances, np.full(1, np.log(WIDTH), dtype)),
        )._asdict(),
        distances=distances,
    )


def _foreground(means: Floats, share: float) -> tuple[np.ndarray, Floats, float]:
    """Return rows, centre and radius of the foreground."""
    count = round(share * len(means))
    if count == 0:
        return np.zeros(0, int), np.zeros(3), 0.0
    center = np.median(means, axis=0)
    distances = np.linalg.norm(means - center, axis=1)
    rows = np.argsort(distances, kind="stable")[:count]
    return rows, center, float(distances[rows[-1]])


def facing(normals: Floats, near: Floats) -> Floats:
    """Return quaternions [N, 4] whose third axis is the unit normal; the first is near that of rotations ``near``."""
    first = near[:, :, 0] - np.sum(near[:, :, 0] * normals, axis=1, keepdims=True) * normals
    helper = np.eye(3)[np.argmin(np.abs(normals), axis=1)]
    helper -= np.sum(helper * normals, axis=1, keepdims=True) * normals
    first = np.where(np.linalg.norm(first, axis=1, keepdims=True) > 1e-3, first, helper)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return quaternions(np.stack([first, np.cross(normals, first), normals], axis=2))


def first_shared(scene: Scene, rng: np.random.Generator) -> Mapping[str, Floats]:
    """Return the shared parameters at the start: an environment of 1, shading per surfel, and gamma."""
    return {**first_light(scene, rng), LOG_WIDTH: np.full(1, np.log(WIDTH), np.float32)}
