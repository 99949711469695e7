"""Surfels with a signed distance: the opacity that follows from it, their population, and their renderer.

gamma is held as ``omega = ln(1 / gamma)``, the logarithm of a length, so that it stays above 0 whatever Adam does. It
is a shared parameter, beside the light.
"""

from collections.abc import Mapping
from functools import partial
from typing import NamedTuple

import numpy as np

from minisplat_ref.errors import InputError
from minisplat_ref.io.frames import Unit
from minisplat_ref.mechanisms.editing.deformation import quaternions
from minisplat_ref.mechanisms.gbuffer import renderer as shaded
from minisplat_ref.mechanisms.gbuffer.gradient_checks import shading_stage
from minisplat_ref.mechanisms.gbuffer.lighting import ENVIRONMENT
from minisplat_ref.mechanisms.gbuffer.population import PER_PIXEL, STAGE, first_light, with_materials
from minisplat_ref.oracle.differences import Point
from minisplat_ref.oracle.setting import Setting
from minisplat_ref.oracle.stages import Stage
from minisplat_ref.reference.covariance import rotation_matrices, rotation_matrices_vjp
from minisplat_ref.rendering import Renderer, RenderGradient, Request
from minisplat_ref.rendering.backends import Backend
from minisplat_ref.training.rates import LogLinear, Rates
from minisplat_ref.training.representation import WORLD_UNITS, Representation
from minisplat_ref.types import Floats, Gaussians, Model, RenderOutput, Scene, View

LOG_WIDTH = "log_width"  # name of the shared parameter, ln(1 / gamma)
WIDTH = 1.0  # 1 / gamma at the start, world units, as released
START_MAX, START_ON_SPHERE = 2.0, 0.2 / 1.1  # of first distances: world units; in radii of the sphere
ROUGHNESS_LOGIT = 0.6  # at the start; that of the metallic share is 0
NEAR, SHARPNESS_NEAR = 0.1, 4.549  # up to this median of |s|, world units, this gamma is wanted
X_MIN = 1e-30  # of |x|: at a distance of 0 the logit has no value; there the opacity is 1 long before
HALF = np.log(3 + 2 * np.sqrt(2))  # 1.7627: gamma |s| at which the opacity is one half


def opacity_logits(distances: Floats, log_width: Floats) -> Floats:
    """Return the logits of ``o = sech^2 x``, ``x = gamma s / 2``.

    ::

        l = ln(o / (1 - o)) = ln(sech^2 x / tanh^2 x) = -2 ln sinh |x| = -2 (|x| + ln(1 - exp(-2 |x|)) - ln 2)

    Parameters
    ----------
    distances : ndarray of shape (N,)
        s, world units.
    log_width : ndarray of shape (1,)
        omega.
    """
    x = np.abs(_x(distances, log_width))
    logits: Floats = -2 * (x + np.log(-np.expm1(-2 * x)) - distances.dtype.type(np.log(2)))
    return logits


def opacity_logits_vjp(distances: Floats, log_width: Floats, v_logits: Floats) -> tuple[Floats, Floats]:
    """Gradient of :func:`opacity_logits` with respect to distances [N] and log_width [1].

    ::

        dl/dx = -2 coth x,   dx/ds = gamma / 2,   dx/domega = -x
        v_s = -gamma coth(x) v_l,   v_omega = sum 2 x coth(x) v_l
    """
    x = _x(distances, log_width)
    coth = 1 / np.tanh(x)
    v_distances = -np.exp(-log_width.astype(x.dtype)) * coth * v_logits
    return v_distances, np.sum(2 * x * coth * v_logits, keepdims=True)


def _x(distances: Floats, log_width: Floats) -> Floats:
    """Return ``gamma s / 2``, away from 0."""
    x = distances * np.exp(-log_width.astype(distances.dtype)) / 2
    return np.where(np.abs(x) < X_MIN, x.dtype.type(X_MIN), x)


def reference_sharpness(distances: Floats) -> float:
    """Return the gamma at which the opacity of the median of ``|s|`` is one half.

    Where that median is at most 0.1, gamma is 4.549, as released: surfels near the surface do not fade.
    """
    median = float(np.median(np.abs(distances))) if len(distances) else 0.0
    return HALF / median if median > NEAR else SHARPNESS_NEAR


def projected(means: Floats, quats: Floats, distances: Floats) -> Floats:
    """Return the centres on the surface, ``x_0 = mu - s n``; n is the third axis of the surfel, [N, 3]."""
    return means - distances[:, None] * rotation_matrices(quats)[:, :, 2]


def projected_vjp(quats: Floats, distances: Floats, v_points: Floats) -> tuple[Floats, Floats, Floats]:
    """Gradient of :func:`projected` with respect to means, quats and distances.

    ::

        v_mu = v_x0,   v_s = -n . v_x0,   v_n = -s v_x0, and on through the third column of the rotation
    """
    R = rotation_matrices(quats)
    v_R = np.zeros_like(R)
    v_R[:, :, 2] = -distances[:, None] * v_points
    return v_points, rotation_matrices_vjp(quats, v_R), -np.sum(R[:, :, 2] * v_points, axis=1)


def tint(log_environment: Floats) -> float:
    """Return how far light is from grey, ``mean |E - (E_r + E_g + E_b) / 3|`` over an environment [H, W, 3]."""
    E = np.exp(log_environment)
    return float(np.mean(np.abs(E - E.mean(axis=2, keepdims=True)), dtype=np.float64))


def tint_vjp(log_environment: Floats) -> Floats:
    """Derivative of :func:`tint`: with ``s = sign(E - mean E)``, ``E (s - mean s) / values``."""
    E = np.exp(log_environment)
    s = np.sign(E - E.mean(axis=2, keepdims=True))
    v: Floats = E * (s - s.mean(axis=2, keepdims=True)) / E.dtype.type(E.size)
    return v


class SDFSurfels(NamedTuple):
    """Surfels with a material and a signed distance; the light that they scatter is that of the environment."""

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
    """Return surfels at random distances between 0 and 2 world units; a foreground begins as a sphere.

    Surfels of the foreground are moved along the radius, and face outwards, so that each is projected onto the sphere;
    all of them have the same distance.

    Parameters
    ----------
    gaussians : Gaussians
        At the start.
    rng : numpy.random.Generator
        For directions and distances.
    foreground : float
        Share of the Gaussians that are in the foreground, those nearest to the median of all centres. The sphere
        around it has their largest distance as its radius; 0 leaves all centres where they are.
    """
    surfels = with_materials(gaussians, rng)
    n, dtype = len(surfels.means), surfels.means.dtype
    distances = rng.uniform(0, START_MAX, size=n)
    means, quats = surfels.means.astype(np.float64), surfels.quats.copy()
    rows, center, radius = _foreground(means, foreground)
    if len(rows):
        outwards = means[rows] - center
        length = np.linalg.norm(outwards, axis=1, keepdims=True)
        normals = np.where(length > 0, outwards / np.where(length > 0, length, 1), [0.0, 0.0, 1.0])
        distances[rows] = START_ON_SPHERE * radius
        means[rows] = center + (radius + distances[rows, None]) * normals
        quats[rows] = facing(normals, rotation_matrices(surfels.quats[rows].astype(np.float64)))
    distances = distances.astype(dtype)
    own = {name: field for name, field in surfels._asdict().items() if name in SDFSurfels._fields}
    return SDFSurfels(**own, distances=distances)._replace(
        means=means.astype(dtype),
        quats=quats,
        opacity_logits=opacity_logits(distances, np.full(1, np.log(WIDTH), dtype)),
        metallic_logits=np.zeros(n, dtype),
        roughness_logits=np.full(n, ROUGHNESS_LOGIT, dtype),
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
    """Return the shared parameters at the start: an environment of 1, shading per pixel, and gamma."""
    start = {STAGE: np.full(1, PER_PIXEL, np.float32), LOG_WIDTH: np.full(1, np.log(WIDTH), np.float32)}
    return {**first_light(scene, rng), **start}


class _SDFTape(NamedTuple):
    """The values that :func:`render_distanced` keeps for :func:`render_distanced_vjp`."""

    shaded: shaded.ReflectiveTape
    distances: Floats  # [N]
    log_width: Floats  # [1]


def render_distanced(
    model: Model, view: View, request: Request, visibility: Floats | None = None, *, mirrors: bool
) -> tuple[RenderOutput, _SDFTape]:
    """Render surfels with the opacities of their distances, as :mod:`minisplat_ref.mechanisms.gbuffer.renderer`.

    Raises
    ------
    InputError
        The model has no gamma.
    """
    if LOG_WIDTH not in model.shared:
        raise InputError("a file of surfels with distances has no place for gamma and light: render the run's folder")
    g, log_width = model.gaussians, model.shared[LOG_WIDTH]
    opaque = model._replace(gaussians=g._replace(opacity_logits=opacity_logits(g.distances, log_width)))
    output, tape = shaded.render_reflective(opaque, view, request, visibility, mirrors=mirrors)
    return output, _SDFTape(tape, g.distances, log_width)


def render_distanced_vjp(tape: _SDFTape, v_image: Floats, v_alpha: Floats | None = None) -> RenderGradient:
    """Gradient of :func:`render_distanced`: that of the logits passes to distances and gamma."""
    v = shaded.render_reflective_vjp(tape.shaded, v_image, v_alpha)
    v_logits = v.gaussians.opacity_logits
    v_distances, v_log_width = opacity_logits_vjp(tape.distances, tape.log_width, v_logits)
    gaussians = v.gaussians._replace(opacity_logits=np.zeros_like(v_logits), distances=v_distances)
    shared = {**v.shared, LOG_WIDTH: v_log_width.astype(tape.log_width.dtype)}
    return v._replace(gaussians=gaussians, shared=shared)


NO_COLORS = {"sh_dc": 0.0, "sh_rest": 0.0}  # what surfels show comes from their material alone
_SHADING_RATE = LogLinear(1.6e-2, 1.6e-3, 30_000)
RATES = Rates(
    {
        "distances": 0.05,
        LOG_WIDTH: 5e-3,
        "opacity_logits": 0.0,
        STAGE: 0.0,
        **NO_COLORS,
        **dict.fromkeys(("albedo_logits", "metallic_logits", "roughness_logits", ENVIRONMENT), _SHADING_RATE),
    },
    frozenset(),
)
DISTANCED = Representation(
    "surfels with distances",
    population=SDFSurfels,
    extend=partial(with_distances, foreground=0.0),
    shared=first_shared,
    renderer=Renderer(
        "surfels with distances", partial(render_distanced, mirrors=True), render_distanced_vjp, shaded.channels
    ),
    rates=RATES,
    units={**WORLD_UNITS, "distances": Unit.LENGTH, LOG_WIDTH: Unit.LOG_LENGTH},
)


def stages(backend: Backend, setting: Setting, rng: np.random.Generator) -> tuple[Stage, ...]:
    """Return the whole renderer, the parameter transform and the projection; the latter are NumPy on every backend."""
    whole = shading_stage(
        backend,
        setting,
        rng,
        DISTANCED,
        PER_PIXEL,
        render=partial(render_distanced, mirrors=True),
        shaded=lambda tape: tape.shaded,
    )
    s, log_width = rng.normal(size=7), np.array([-0.4])
    transform = Stage(
        "opacity_logits",
        {"distances": s, "log_width": log_width},
        ("logits",),
        lambda s, w: Point((opacity_logits(s, w),)),
        lambda v: opacity_logits_vjp(s, log_width, v),
    )
    g, own = setting.gaussians, rng.normal(size=len(setting.gaussians.means))
    projection = Stage(
        "projected",
        {"means": g.means, "quats": g.quats, "distances": own},
        ("points",),
        lambda m, q, s: Point((projected(m, q, s),)),
        lambda v: projected_vjp(g.quats, own, v),
    )
    light = rng.normal(size=(4, 8, 3))
    neutral = Stage(
        "loss term neutral_light",
        {ENVIRONMENT: light},
        ("value",),
        lambda x: Point((np.array([tint(x)]),)),
        lambda v: (v[0] * tint_vjp(light),),
    )
    return whole, transform, projection, neutral
