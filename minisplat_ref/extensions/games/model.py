"""Gaussians on the faces of a mesh: where their parameters place them, with the gradient, their renderer and recipe.

A face has the corners p0, p1, p2, the centroid m and the unit normal n. A Gaussian on it stores three logits a and one
logarithm of a size, and follows from them and from the corners, which are not trained (GaMeS, Eqs. 3 to 7):

    pi = softmax(a),   mu = pi_0 p0 + pi_1 p1 + pi_2 p2
    R = [n, r2, r3],   r2 = (p0 - m) / |p0 - m|,   r3 = n x r2
    s = rho (eps h, |p0 - m|, (p1 - m) . r3),   rho = exp(log_size),   h = sqrt(|p0 - m| (p1 - m) . r3)

r3 is the direction of p1 - m after n and r2 are taken out of it, with its length as the third scale.
"""

from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from minisplat_ref.constants import SH_C0
from minisplat_ref.errors import InputError
from minisplat_ref.io.frames import Unit, place_points
from minisplat_ref.mechanisms.editing.deformation import quaternions
from minisplat_ref.mechanisms.meshes.mesh import Mesh, load_mesh
from minisplat_ref.methods.gaussian_splatting import GS_ACCEL
from minisplat_ref.reference.covariance import rotation_matrices
from minisplat_ref.rendering import SPLATTING, Inputs, RenderGradient, Request, wrap
from minisplat_ref.strategy.initialization import are_seen, gaussians_from_means
from minisplat_ref.training.rates import Rates
from minisplat_ref.training.representation import WORLD_UNITS, Representation
from minisplat_ref.training.schedule import During
from minisplat_ref.training.state import Iteration, TrainState
from minisplat_ref.types import Floats, Gaussians, Model, Scene, View

THINNESS = 1e-3  # eps: thickness over the mean of the other two standard deviations


class FaceGaussians(NamedTuple):
    """Gaussians with the face that each is on: the six fields of ``Gaussians``, and five more."""

    means: Floats
    """[N, 3] no parameter: computed from the further fields, for culling and for files; so are the next two."""
    quats: Floats
    log_scales: Floats
    opacity_logits: Floats
    sh_dc: Floats
    sh_rest: Floats
    corner_logits: Floats
    """[N, 3] a: their softmax is the weight of each corner."""
    log_sizes: Floats
    """[N] ln rho."""
    p0: Floats
    """[N, 3] corners of the face, counter-clockwise as seen from outside, world frame; not trained."""
    p1: Floats
    p2: Floats


class FaceFrames(NamedTuple):
    """The quantities that follow from the corners alone."""

    quats: Floats
    """[N, 4] of R."""
    log_lengths: Floats
    """[N, 3] ln (s / rho), world units."""


def face_frames(p0: Floats, p1: Floats, p2: Floats) -> FaceFrames:
    """Return rotation and lengths of faces with corners [N, 3] each; every face has an area."""
    m = (p0 + p1 + p2) / 3
    n = np.cross(p1 - p0, p2 - p0)
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    first = np.linalg.norm(p0 - m, axis=1)  # [N]
    r2 = (p0 - m) / first[:, None]
    r3 = np.cross(n, r2)
    second = np.sum((p1 - m) * r3, axis=1)  # [N] above zero, as the corners go around m counter-clockwise
    lengths = np.stack([THINNESS * np.sqrt(first * second), first, second], axis=1)
    return FaceFrames(quaternions(np.stack([n, r2, r3], axis=2)), np.log(lengths))


def place(g: FaceGaussians) -> FaceGaussians:
    """Return the Gaussians with means, rotations and scales as their faces have them, in the dtype of the fields."""
    frames = face_frames(g.p0, g.p1, g.p2)
    pi = corner_weights(g.corner_logits)
    means = pi[:, :1] * g.p0 + pi[:, 1:2] * g.p1 + pi[:, 2:] * g.p2
    return g._replace(means=means, quats=frames.quats, log_scales=frames.log_lengths + g.log_sizes[:, None])


def place_vjp(g: FaceGaussians, v: FaceGaussians) -> FaceGaussians:
    """Gradient of :func:`place`.

    ::

        v_pi_i = p_i . v_mu,   v_a_i = pi_i (v_pi_i - sum_j pi_j v_pi_j)
        v_log_size = sum of v_log_scales

    Parameters
    ----------
    g : FaceGaussians
        As for :func:`place`.
    v : FaceGaussians
        Derivatives with respect to its result; those of the five further fields are zero.

    Returns
    -------
    FaceGaussians
        Zero for means, rotations, scales and corners, which are no parameters.
    """
    pi = corner_weights(g.corner_logits)
    v_pi = np.stack([np.sum(p * v.means, axis=1) for p in (g.p0, g.p1, g.p2)], axis=1)  # [N, 3]
    return v._replace(
        means=np.zeros_like(g.means),
        quats=np.zeros_like(g.quats),
        log_scales=np.zeros_like(g.log_scales),
        corner_logits=pi * (v_pi - np.sum(pi * v_pi, axis=1, keepdims=True)),
        log_sizes=v.log_scales.sum(axis=1),
    )


def corner_weights(corner_logits: Floats) -> Floats:
    """Return pi [N, 3], which sums to 1, of logits a [N, 3]."""
    powers = np.exp(corner_logits - corner_logits.max(axis=1, keepdims=True))
    return powers / powers.sum(axis=1, keepdims=True)


def on_own_faces(gaussians: Gaussians, rng: np.random.Generator) -> FaceGaussians:
    """Return one Gaussian in the middle of each face, with the face's rotation, and its scales for rho = 1.

    :func:`place` then returns its mean, its rotation, and its second and third scale; along its first axis it is flat.
    With the mean m, and s2 and s3 along r2 and r3, the corners are

        p0 = m + s2 r2,   p1 = m - s2/2 r2 + s3 r3,   p2 = m - s2/2 r2 - s3 r3
    """
    means, scales = gaussians.means, np.exp(gaussians.log_scales)
    R = rotation_matrices(gaussians.quats)  # [N, 3, 3]
    a, b = scales[:, 1:2] * R[:, :, 1], scales[:, 2:] * R[:, :, 2]  # [N, 3] each
    g = FaceGaussians(
        *gaussians,
        corner_logits=np.zeros_like(means),
        log_sizes=np.zeros_like(gaussians.opacity_logits),
        p0=means + a,
        p1=means - a / 2 + b,
        p2=means - a / 2 - b,
    )
    return place(g)


def _place(model: Model, view: View, request: Request) -> tuple[Inputs, FaceGaussians]:
    """Return the inputs with the Gaussians where their faces place them, and the Gaussians as they are."""
    return (model._replace(gaussians=place(model.gaussians)), view, request), model.gaussians


def _place_vjp(gaussians: FaceGaussians, v: RenderGradient) -> RenderGradient:
    """Gradient of :func:`_place`: that of means and scales passes to weights of corners and to sizes."""
    return v._replace(gaussians=place_vjp(gaussians, v.gaussians))


def on_faces(mesh: Mesh, scene: Scene, sh_degree: int, rng: np.random.Generator, *, per_face: int) -> FaceGaussians:
    """Return Gaussians on every face of a mesh, at random places, evenly over the face.

    Their common size makes their ellipses of one standard deviation about as large, together, as the face:
    ``rho = 1 / (2 sqrt(per_face))``. Colours are those of the nearest points of the scene, or gray.

    Parameters
    ----------
    mesh : Mesh
        T triangles, each with an area, in the frame of the scene.
    scene : Scene
    sh_degree : int
        Stored degree of the spherical harmonics.
    rng : numpy.random.Generator
        For the places.
    per_face : int
        Gaussians on each face.

    Returns
    -------
    FaceGaussians
        float32, ``per_face T`` rows, those of a face one after another.
    """
    corners = np.repeat(mesh.corners, per_face, axis=0)  # [N, 3, 3]
    pi = rng.dirichlet(np.ones(3), size=len(corners))  # [N, 3]
    means = np.einsum("nk,nki->ni", pi, corners)
    colors = np.full(means.shape, 0.5)
    if len(scene.points):
        colors = scene.point_colors[cKDTree(scene.points).query(means)[1]] / 255.0
    plain = gaussians_from_means(means, ((colors - 0.5) / SH_C0).astype(np.float32), sh_degree)
    g = FaceGaussians(
        *plain,
        corner_logits=np.log(np.maximum(pi, np.finfo(np.float32).tiny)),
        log_sizes=np.full(len(means), -np.log(2 * np.sqrt(per_face))),
        p0=corners[:, 0],
        p1=corners[:, 1],
        p2=corners[:, 2],
    )
    return FaceGaussians(*(field.astype(np.float32) for field in place(g)))  # placed in float64


def from_mesh(path: Path, scene: Scene, sh_degree: int, rng: np.random.Generator, *, per_face: int) -> FaceGaussians:
    """Return Gaussians on the faces of a mesh that a PLY holds, in the frame of the scene's files.

    Parameters are those of :func:`on_faces`.

    Raises
    ------
    InputError
        The file holds no mesh, no training view sees it, or ``per_face`` is below 1.
    """
    if per_face < 1:
        raise InputError(f"per_face is {per_face}: give at least 1 Gaussian for each face")
    mesh = load_mesh(path)
    mesh = mesh._replace(vertices=place_points(mesh.vertices, scene.frame))
    if not are_seen(mesh.vertices, [view.camera for view in scene.train_views]).any():
        raise InputError(
            f"{path}: no training view sees any of its {len(mesh.faces):,} faces; give a mesh in the world frame of"
            f" scene {scene.name}"
        )
    return on_faces(mesh, scene, sh_degree, rng, per_face=per_face)


def refresh_places(state: TrainState, iteration: Iteration) -> None:
    """Write means, rotations and scales into the population, where culling, other actions and files read them."""
    g = state.gaussians
    placed = place(g)
    for name in ("means", "quats", "log_scales"):
        getattr(g, name)[:] = getattr(placed, name)


UNTRAINED = ("means", "quats", "log_scales", "p0", "p1", "p2")
RATES = {"corner_logits": 1e-2, "log_sizes": 5e-3, **dict.fromkeys(UNTRAINED, 0.0)}
ON_FACES = Representation(
    "gaussians on faces",
    population=FaceGaussians,
    extend=on_own_faces,
    from_file=partial(from_mesh, per_face=5),
    renderer=wrap(SPLATTING, "games", _place, _place_vjp),
    rates=Rates(RATES, frozenset()),
    units={**WORLD_UNITS, "p0": Unit.PLACE, "p1": Unit.PLACE, "p2": Unit.PLACE},
)
GAMES = GS_ACCEL._replace(
    name="games", learning_rates=GS_ACCEL.learning_rates.change(**RATES), events=(During(refresh_places),)
)
"""The recipe ``games``: the number of Gaussians stays, and they stay on their faces."""
