"""Fans: Gaussians as vertices that are shared by a few triangles (MeshSplats, 2502.07754), their renderer and recipe.

A fan has a centre vertex at mu and n on a rim, k standard deviations away, and the triangles between the centre and
two neighbours. Opacity is o at the centre and a fraction of it on the rim, and linear in between.

- *Flat*: one fan in the plane of the two larger axes (``mechanisms.meshes.fans``): 1 + n vertices, n triangles.
- *Solid*: three fans, in the planes of the axes (0, 1), (1, 2) and (2, 0). Where two of them meet, on an axis, they
  share the vertex: 1 + 3 n - 6 vertices, 3 n triangles. Four must divide n.

The rim's vertices are held by *plane*: a flat fan has one plane that owns all n; of a solid one, plane p owns all but
those at a quarter and at three quarters of the turn, which lie on the next plane's first axis and are its own.

A training moves every vertex and changes its colour and opacity, by the loss of 3DGS. Colours and opacities are those
of mesh files, numbers in [0, 1] without an activation: after each step they are put back into that range.
"""

from functools import cache, partial
from typing import NamedTuple

import numpy as np

from minisplat_ref.constants import SH_C0
from minisplat_ref.errors import InputError
from minisplat_ref.io.frames import Unit
from minisplat_ref.mechanisms.meshes.fans import flatten, rims, turn_balls
from minisplat_ref.mechanisms.peeling import kernels, reference
from minisplat_ref.mechanisms.peeling.layers import ALL_LAYERS, Frame, Peeled, TranslucentMesh
from minisplat_ref.methods.gaussian_splatting import GS_ACCEL
from minisplat_ref.oracle.models import Drawn, model_stage
from minisplat_ref.oracle.setting import Setting
from minisplat_ref.oracle.stages import Stage
from minisplat_ref.reference.covariance import rotation_matrices
from minisplat_ref.reference.pinhole import with_principal_point
from minisplat_ref.rendering import Renderer, RenderGradient, Request
from minisplat_ref.rendering.backends import REFERENCE, Backend
from minisplat_ref.strategy.ops import keep
from minisplat_ref.training.rates import LogLinear, Rates
from minisplat_ref.training.representation import Representation
from minisplat_ref.training.schedule import During, Every
from minisplat_ref.training.state import Iteration, TrainState, apply_edit
from minisplat_ref.types import Bools, Floats, Gaussians, Ints, Model, RenderOutput, View

SOLID_PLANES = 3
OPACITY_MIN = 0.02  # of a fan's most opaque vertex, below which it is pruned: 5 of 255
FRONT_REACH = 2.5  # k of the fan of 8 sides that is nearest to a Gaussian seen from the front; its rim is transparent


class FanShape(NamedTuple):
    """Options of turning Gaussians into fans.

    The default reach is larger than ``FRONT_REACH``: a scene of many shows holes more than it shows fans that overlap.
    """

    n_sides: int = 8
    """n."""
    reach: float = 3.0
    """k, standard deviations from the centre to the rim."""
    rim: float = 0.0
    """Opacity on the rim as a fraction of that of the centre, in [0, 1]."""
    is_flat: bool = True
    """Whether a Gaussian becomes one fan, or three."""


class Fans(NamedTuple):
    """A population of fans."""

    means: Floats
    """[N, 3] vertices at the centres, world frame."""
    rims: Floats
    """[N, F, m, 3] vertices on the rims by the plane that owns them, world frame: (F, m) is (1, n) or (3, n - 2)."""
    colors: Floats
    """[N, 1 + F m, 3] RGB of the vertices in [0, 1], the centre's first."""
    opacities: Floats
    """[N, 1 + F m] of the vertices in [0, 1]."""

    @property
    def n_vertices(self) -> int:
        """Vertices of one fan, or of one solid triple of fans."""
        return 1 + self.rims.shape[1] * self.rims.shape[2]


def check_shape(shape: FanShape) -> None:
    """Refuse shapes that are none.

    Raises
    ------
    InputError
        One line that names the number.
    """
    if shape.n_sides < 3:
        raise InputError(f"a fan of {shape.n_sides} sides encloses no area: give at least 3")
    if not shape.is_flat and shape.n_sides % 4:
        raise InputError(f"three fans share vertices where 4 divides their sides, which are {shape.n_sides}: give 4, 8")
    if not 0 < shape.reach < np.inf:
        raise InputError(f"a rim {shape.reach:g} standard deviations away is no rim: give a number above 0")
    if not 0 <= shape.rim <= 1:
        raise InputError(f"the rim's opacity is {shape.rim:g} times the centre's, not in [0, 1]: give such a part")


def convert_gaussians(gaussians: Gaussians, shape: FanShape) -> Fans:
    """Return the fans of Gaussians, in their dtype.

    Colours are those of degree 0, ``0.5 + C_0 c_0``, clipped to [0, 1], as in mesh files.

    Parameters
    ----------
    gaussians : Gaussians
        N of them, of any degree.
    shape : FanShape

    Raises
    ------
    InputError
        As for :func:`check_shape`.
    """
    check_shape(shape)
    dtype, n = gaussians.means.dtype, len(gaussians.means)
    if shape.is_flat:
        flat = flatten(gaussians.means, gaussians.quats, gaussians.log_scales)
        corners = rims(flat.means, flat.spans, np.full(n, shape.reach), shape.n_sides)[:, None]  # [N, 1, n, 3]
    else:
        corners = _solid_rims(gaussians, shape)
    opacities = 1 / (1 + np.exp(-gaussians.opacity_logits))  # [N]
    fans = Fans(gaussians.means, corners.astype(dtype), np.zeros(()), np.zeros(()))
    v = fans.n_vertices
    colors = np.clip(0.5 + SH_C0 * gaussians.sh_dc, 0, 1)[:, None]  # [N, 1, 3]
    parts = np.concatenate([np.ones(1), np.full(v - 1, shape.rim)]).astype(dtype)
    return fans._replace(
        colors=np.repeat(colors, v, axis=1).astype(dtype),
        opacities=opacities[:, None] * parts,
    )


def _solid_rims(gaussians: Gaussians, shape: FanShape) -> Floats:
    """Return the rims [N, 3, n - 2, 3] of three planes."""
    R = rotation_matrices(gaussians.quats.astype(np.float64))
    with np.errstate(over="ignore"):
        half_axes = R * np.exp(gaussians.log_scales.astype(np.float64))[:, None]  # [N, 3, 3] columns s_a e_a
    return np.stack(
        [
            rims(
                gaussians.means.astype(np.float64),
                half_axes[:, :, [p, (p + 1) % SOLID_PLANES]],
                np.full(len(R), shape.reach),
                shape.n_sides,
            )[:, _find_owned(shape.n_sides)]
            for p in range(SOLID_PLANES)
        ],
        axis=1,
    )


def _find_owned(n_sides: int) -> list[int]:
    """Return which of a solid plane's rim vertices it owns."""
    return [j for j in range(n_sides) if j not in (n_sides // 4, 3 * n_sides // 4)]


@cache
def table(n_planes: int, n_owned: int) -> Ints:
    """Return the triangles of one fan, or of a solid triple [T_1, 3], as rows of its vertices: the centre is 0."""
    if n_planes == 1:
        rings = [list(range(n_owned))]
    else:
        n_sides = n_owned + 2
        own = {j: place for place, j in enumerate(_find_owned(n_sides))}
        crossing = {n_sides // 4: 0, 3 * n_sides // 4: own[n_sides // 2]}  # of the next plane: its axis, either end
        rings = [
            [
                n_owned * ((p + (j in crossing)) % SOLID_PLANES) + (crossing[j] if j in crossing else own[j])
                for j in range(n_sides)
            ]
            for p in range(SOLID_PLANES)
        ]
    return np.array([(0, 1 + a, 1 + b) for ring in rings for a, b in zip(ring, ring[1:] + ring[:1], strict=True)])


def vertices_of(fans: Fans) -> Floats:
    """Return the vertices [N, V, 3], the centre first."""
    rims_in_a_row = fans.rims.reshape(len(fans.means), fans.n_vertices - 1, 3)
    return np.concatenate([fans.means[:, None], rims_in_a_row], axis=1)


def mesh_of(fans: Fans, is_listed: Bools | None = None) -> TranslucentMesh:
    """Return fans as one mesh, of N V vertices.

    Parameters
    ----------
    fans : Fans
    is_listed : ndarray of shape (N,) of booleans, optional
        Fans whose triangles are listed; all by default.
    """
    n, v = len(fans.means), fans.n_vertices
    rows = np.arange(n) if is_listed is None else np.flatnonzero(is_listed)
    faces = v * rows[:, None, None] + table(*fans.rims.shape[1:3])  # [N, T_1, 3]
    rgba = np.concatenate([fans.colors, fans.opacities[:, :, None]], axis=2)  # [N, V, 4]
    return TranslucentMesh(vertices_of(fans).reshape(n * v, 3), rgba.reshape(n * v, 4), faces.reshape(-1, 3))


def mesh_of_vjp(fans: Fans, v_vertices: Floats, v_rgba: Floats) -> Fans:
    """Gradient of :func:`mesh_of`, given those with respect to vertices [N V, 3] and RGBA [N V, 4]."""
    n, v = len(fans.means), fans.n_vertices
    v_vertices, v_rgba = v_vertices.reshape(n, v, 3), v_rgba.reshape(n, v, 4)
    fields = v_vertices[:, 0], v_vertices[:, 1:].reshape(fans.rims.shape), v_rgba[:, :, :3], v_rgba[:, :, 3]
    return Fans._make(np.ascontiguousarray(field) for field in fields)


def visible_mesh(mesh: TranslucentMesh, min_opacity: float) -> TranslucentMesh:
    """Return the mesh without triangles whose vertices all are fainter than ``min_opacity``, and unused vertices."""
    faces = mesh.faces[(mesh.rgba[mesh.faces, 3] >= min_opacity).any(axis=1)]
    used, rows = np.unique(faces, return_inverse=True)
    return TranslucentMesh(mesh.vertices[used], mesh.rgba[used], rows.reshape(faces.shape))


def as_fans(
    gaussians: Gaussians, rng: np.random.Generator, *, n_sides: int, reach: float, rim: float, is_flat: bool
) -> Fans:
    """Return the fans of Gaussians, where balls face at random; see :class:`FanShape`."""
    return convert_gaussians(turn_balls(gaussians, rng), FanShape(n_sides, reach, rim, is_flat))


class _Tape(NamedTuple):
    """The values that the gradient needs again."""

    fans: Fans
    mesh: TranslucentMesh
    frame: Frame
    background: Floats
    peeled: Peeled
    backend: Backend


def render_fans(
    model: Model, view: View, request: Request, *, max_layers: int | None = None
) -> tuple[RenderOutput, _Tape]:
    """Render fans by depth peeling; ``max_layers`` are blended in a pixel, by default all.

    Raises
    ------
    InputError
        Something is wanted besides colours, or ``max_layers`` is below 1.
    """
    if request.wants:
        raise InputError(f"fans are drawn without {', '.join(sorted(request.wants))}: render the Gaussians for that")
    if max_layers is not None and max_layers < 1:
        raise InputError(f"max_layers is {max_layers}: give at least 1, or none for all")
    fans, conventions, backend = model.gaussians, request.conventions, request.backend
    dtype, v = fans.means.dtype, fans.n_vertices
    background = np.zeros(3, dtype) if request.background is None else np.asarray(request.background, dtype)
    frame = Frame(
        with_principal_point(view.camera, conventions),
        conventions.near_plane,
        ALL_LAYERS if max_layers is None else max_layers,
    )
    mesh = mesh_of(fans, request.is_visible)
    peeled = (kernels if backend.is_compiled else reference).peel(mesh, frame, background)
    visible_ids = np.unique(mesh.faces[peeled.is_seen, 0] // v)
    output = RenderOutput(
        peeled.image, peeled.alpha, None, None, visible_ids=visible_ids, n_pairs=int(peeled.n_layers.sum())
    )
    return output, _Tape(fans, mesh, frame, background, peeled, backend)


def render_fans_vjp(tape: _Tape, v_image: Floats, v_alpha: Floats | None = None) -> RenderGradient:
    """Gradient of :func:`render_fans`.

    That with respect to projected centres moves a whole fan parallel to the image, by ``z / f`` for a pixel.
    """
    fans, camera = tape.fans, tape.frame.camera
    v_alpha = np.zeros(v_image.shape[:2], v_image.dtype) if v_alpha is None else v_alpha
    peel_vjp = (kernels if tape.backend.is_compiled else reference).peel_vjp
    v = peel_vjp(tape.mesh, tape.frame, tape.background, tape.peeled, v_image, v_alpha)
    R, t = (array.astype(fans.means.dtype) for array in (camera.cam_from_world_R, camera.cam_from_world_t))
    depths = fans.means @ R[2] + t[2]  # [N]
    v_moved = v.vertices.reshape(len(fans.means), fans.n_vertices, 3).sum(axis=1) @ R[:2].T  # [N, 2]
    return RenderGradient(
        gaussians=mesh_of_vjp(fans, v.vertices, v.rgba),
        background=v.background,
        cam_from_world_R=v.cam_from_world_R,
        cam_from_world_t=v.cam_from_world_t,
        means2d=v_moved * depths[:, None] / np.array([camera.fx, camera.fy], fans.means.dtype),
    )


def channels(wants: frozenset[str]) -> dict[str, slice]:
    """Return the channels of an image, which are colours whatever is wanted."""
    return {"rgb": slice(0, 3)}


FANS_OF_GAUSSIANS = Representation(
    "fans",
    population=Fans,
    units={"means": Unit.PLACE, "rims": Unit.PLACE},
    extend=partial(as_fans, **FanShape()._asdict()),
    renderer=Renderer("fans", partial(render_fans, max_layers=None), render_fans_vjp, channels),
    rates=Rates(
        {"rims": LogLinear(1.6e-4, 1.6e-6, 30_000), "colors": 2.5e-3, "opacities": 5e-3},
        frozenset({"rims"}),
    ),
)


def stages(backend: Backend, setting: Setting, rng: np.random.Generator) -> tuple[Stage, ...]:
    """Return the renderer; which triangles a pixel meets, and in which order, is found by the reference."""

    def sides(drawn: Drawn) -> list[np.ndarray]:
        _, tape = render_fans(drawn.model, drawn.view, drawn.request._replace(backend=REFERENCE))
        found = tape.peeled.tape.fragments
        return [found.pixels, found.faces]

    return (model_stage(backend, setting, FANS_OF_GAUSSIANS, rng, sides_of=sides),)


def keep_in_range(state: TrainState, iteration: Iteration) -> None:
    """Put colours and opacities back into [0, 1]."""
    for field in (state.gaussians.colors, state.gaussians.opacities):
        np.clip(field, 0, 1, out=field)


def prune_faint_fans(state: TrainState, iteration: Iteration, *, min_opacity: float) -> None:
    """Remove fans of which every vertex is fainter than ``min_opacity``."""
    apply_edit(state, keep(state.gaussians, state.gaussians.opacities.max(axis=1) >= min_opacity))


FANS = GS_ACCEL._replace(
    name="fans",
    sh_degree=0,
    sh_milestones=(),
    events=(
        During(keep_in_range),
        Every(1_000, partial(prune_faint_fans, min_opacity=OPACITY_MIN), min_gap=100),
    ),
)
"""``fans``: the vertices of fans, from the points of the scene; their number only falls."""

FINE_TUNING = FANS._replace(name="fans-fine-tuning")
"""The vertices of fans that were made of a trained model."""
