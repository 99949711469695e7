"""The renderer of fans, and the recipe that trains their vertices.

A training moves every vertex and changes its colour and opacity, by the loss of 3DGS. Colours and opacities are those
of mesh files, numbers in [0, 1] without an activation: after each step they are put back into that range.
"""

from functools import partial
from typing import NamedTuple

import numpy as np

from minisplat_ref.errors import InputError
from minisplat_ref.extensions.fans.shapes import Fans, FanShape, convert_gaussians, mesh_of, mesh_of_vjp
from minisplat_ref.io.frames import Unit
from minisplat_ref.mechanisms.meshes.fans import turn_balls
from minisplat_ref.mechanisms.peeling import kernels as kernels
from minisplat_ref.mechanisms.peeling import reference as reference
from minisplat_ref.mechanisms.peeling.layers import ALL_LAYERS, Frame, Peeled, TranslucentMesh
from minisplat_ref.methods.gaussian_splatting import GS_ACCEL
from minisplat_ref.reference.pinhole import with_principal_point
from minisplat_ref.rendering import Renderer, RenderGradient, Request
from minisplat_ref.rendering.backends import Backend
from minisplat_ref.strategy.ops import keep
from minisplat_ref.training.rates import LogLinear, Rates
from minisplat_ref.training.representation import WORLD_UNITS, Representation
from minisplat_ref.training.schedule import During, Every
from minisplat_ref.training.state import Iteration, TrainState, apply_edit
from minisplat_ref.types import Floats, Gaussians, Model, RenderOutput, View

OPACITY_MIN = 0.02  # of a fan's most opaque vertex: 5 of 255


def as_fans(
    gaussians: Gaussians, rng: np.random.Generator, *, n_sides: int, reach: float, rim: float, is_flat: bool
) -> Fans:
    """Return the fans of Gaussians, where balls face at random; see :class:`.shapes.FanShape`."""
    return convert_gaussians(turn_balls(gaussians, rng), FanShape(n_sides, reach, rim, is_flat))


class _Tape(NamedTuple):
    """The values that the gradient needs again."""

    fans: Fans
    mesh: TranslucentMesh
    frame: Frame
    background: Floats
    peeled: Peeled
    backend: Backend


def render(model: Model, view: View, request: Request, *, max_layers: int | None = None) -> tuple[RenderOutput, _Tape]:
    """Draw fans by depth peeling; ``max_layers`` are blended in a pixel, by default all.

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


def render_vjp(tape: _Tape, v_image: Floats, v_alpha: Floats | None = None) -> RenderGradient:
    """Gradient of :func:`render`.

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


def keep_in_range(state: TrainState, iteration: Iteration) -> None:
    """Put colours and opacities back into [0, 1]."""
    for field in (state.gaussians.colors, state.gaussians.opacities):
        np.clip(field, 0, 1, out=field)


def prune_faint_fans(state: TrainState, iteration: Iteration, *, min_opacity: float) -> None:
    """Remove fans of which every vertex is fainter than ``min_opacity``."""
    apply_edit(state, keep(state.gaussians, state.gaussians.opacities.max(axis=1) >= min_opacity))


FANS_OF_GAUSSIANS = Representation(
    "fans",
    population=Fans,
    units={**WORLD_UNITS, "rims": Unit.PLACE},
    extend=partial(as_fans, **FanShape()._asdict()),
    renderer=Renderer("fans", partial(render, max_layers=None), render_vjp, channels),
    rates=Rates(
        {"rims": LogLinear(1.6e-4, 1.6e-6, 30_000), "colors": 2.5e-3, "opacities": 5e-3},
        frozenset({"rims"}),
    ),
)

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
