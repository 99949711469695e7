"""The renderer and the recipe of Gaussians on the faces of a mesh, and the start of a training on one."""

from functools import partial
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from minisplat_ref.constants import SH_C0
from minisplat_ref.errors import InputError
from minisplat_ref.extensions.games.faces import FaceGaussians, on_own_faces, place, place_vjp
from minisplat_ref.io.frames import Unit, place_points
from minisplat_ref.mechanisms.meshes.mesh import Mesh, load_mesh
from minisplat_ref.methods.gaussian_splatting import GS_ACCEL
from minisplat_ref.rendering import SPLATTING, Inputs, RenderGradient, Request, wrap
from minisplat_ref.strategy.initialization import are_seen, gaussians_from_means
from minisplat_ref.training.rates import Rates
from minisplat_ref.training.representation import WORLD_UNITS, Representation
from minisplat_ref.training.schedule import During
from minisplat_ref.training.state import Iteration, TrainState
from minisplat_ref.types import Model, Scene, View


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
        Draws the places.
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
