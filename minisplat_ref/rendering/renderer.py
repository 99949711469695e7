"""From trained parameters to an image and back.

Activations live here (3DGS section 5.1): ``scales = exp(log_scales)``, ``opacities = sigmoid(opacity_logits)``. Left
out: checks for NaN, which belong where a file is read; a Gaussian whose footprint is not finite is culled.

A :class:`Renderer` is the pair of functions that all code calls to render a model: training, evaluation, importance,
depth reinitialisation, the commands. ``SPLATTING`` is that of 3DGS. Another way of rendering is another value; most
wrap ``SPLATTING``: they make Gaussians from their parameters (moved to the view's time, decoded, chosen by level),
render these, and carry the gradient back.
"""

import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.constants import GSPLAT_MAIN, Conventions
from minisplat_ref.errors import InputError
from minisplat_ref.reference.pinhole import with_principal_point
from minisplat_ref.rendering.backends import CPU, Backend
from minisplat_ref.rendering.splatting import SplatTape, splat, splat_vjp
from minisplat_ref.types import (
    NOTHING,
    Bools,
    Camera,
    Floats,
    Gaussians,
    Ints,
    Model,
    Primitives,
    Projection,
    RenderOutput,
    SHGradient,
    View,
)


class RenderTape(NamedTuple):
    """Record of a call of :func:`render`, for :func:`render_vjp` and for statistics of what was visible."""

    gaussians: Gaussians
    sh_degree: int | Ints  # active, of all or [N] of each
    splats: SplatTape  # the activated Gaussians and the results of each stage

    @property
    def projection(self) -> Projection:
        """Footprints in the image; radii are 0 where culled."""
        return self.splats.projection


class RenderGradient(NamedTuple):
    """Gradient of the loss with respect to everything that a rendering depends on."""

    gaussians: Any  # the population's type: with respect to the parameters, before their activations
    background: Floats  # [3]
    cam_from_world_R: Floats  # [3, 3] with respect to the nine entries, unconstrained
    cam_from_world_t: Floats  # [3]
    means2d: (
        Floats  # [N, 2], or [N, 2 K] of rows rendered as K Gaussians: of the projected centres, for density control
    )
    shared: Mapping[str, Floats] = NOTHING  # with respect to the model's shared parameters, by name


MISSING: Any = None  # a camera that was not given, so that the message can say where there are some


def _check_arguments(gaussians: Any, camera: Any) -> None:
    """Refuse what is often passed instead of Gaussians and a camera, and say where these come from.

    Raises
    ------
    InputError
        The first has not the fields of Gaussians, or the second not those of a camera.
    """
    if not hasattr(gaussians, "sh_rest"):
        ways = "ms.load_ply(path) reads them from a file"
        raise InputError(f"render takes Gaussians and a camera, and the first is {_a(gaussians)}: {ways}")
    if not hasattr(camera, "optics"):
        inside = "view.camera" if hasattr(camera, "camera") else "scene.train_views[0].camera, of ms.load_scene(path)"
        what = "there is no camera" if camera is MISSING else f"the second is {_a(camera)}"
        raise InputError(f"render takes Gaussians and a camera, and {what}: pass {inside}")


def _a(value: Any) -> str:
    name = type(value).__name__
    return f"a{'n' * (name[0] in 'aeiouAEIOU')} {name}"


def render(
    gaussians: Gaussians,
    camera: Camera = MISSING,
    *,
    background: Floats | None = None,
    sh_degree: int | Ints | None = None,
    conventions: Conventions = GSPLAT_MAIN,
    backend: Backend = CPU,
    is_visible: Bools | None = None,
    opacity_factor: float = 1.0,
    with_depth: bool = False,
    with_stats: bool = False,
    with_median_depth: bool = False,
) -> tuple[RenderOutput, RenderTape]:
    """Render one view.

    Parameters
    ----------
    gaussians : Gaussians
        Population; may be empty.
    camera : Camera
        View.
    background : ndarray of shape (3,), optional
        RGB behind everything; black by default.
    sh_degree : int, or ndarray of shape (N,) of int, optional
        Active degree, of all Gaussians or of each, at most the stored one, which is the default.
    conventions : Conventions
        Profile of the rasteriser.
    backend : Backend
        Implementation of the stages.
    is_visible : ndarray of shape (N,) of booleans, optional
        Rows to render; the others are culled as if they were transparent. All by default.
    opacity_factor : float
        Multiplies all opacities, which may exceed 1; alpha is limited as ever.
    with_depth : bool
        Append the accumulated depth, ``sum w z``, as the last channel of the image.
    with_stats, with_median_depth : bool
        As for :func:`composite`.

    Returns
    -------
    output : RenderOutput
        Image [H, W, 3] (4 with depth) and alpha [H, W] in the dtype of the Gaussians.
    tape : RenderTape
        For :func:`render_vjp`.

    Raises
    ------
    InputError
        The first two arguments are something else, which the message names, or ``sh_degree`` is not stored.
    """
    _check_arguments(gaussians, camera)
    if camera.optics is not None:
        raise InputError(f"this renderer draws pinholes, not {camera.optics.model} cameras: train with --recipe lens")
    dtype = gaussians.means.dtype
    stored_degree = math.isqrt(gaussians.sh_rest.shape[1] + 1) - 1
    sh_degree = stored_degree if sh_degree is None else sh_degree
    lowest, highest = np.min(sh_degree, initial=stored_degree), np.max(sh_degree, initial=0)
    if not (0 <= lowest and highest <= stored_degree):
        wrong = highest if lowest >= 0 else lowest
        raise InputError(f"sh_degree is {wrong}; these Gaussians store degrees 0 to {stored_degree}")
    background = np.zeros(3, dtype) if background is None else np.asarray(background, dtype)

    def shade(radii: Ints) -> Floats:
        return backend.sh_colors(gaussians.means, gaussians.sh_dc, gaussians.sh_rest, camera, sh_degree, radii)

    splats = splat(
        activate(gaussians, is_visible, opacity_factor),
        shade,
        camera,
        background,
        conventions,
        backend,
        with_depth=with_depth,
        with_stats=with_stats,
        with_median_depth=with_median_depth,
    )
    visible_ids = np.flatnonzero(splats.projection.radii[:, 0] > 0)
    output = splats.output._replace(visible_ids=visible_ids, n_pairs=len(splats.bins.gaussian_ids))
    return output, RenderTape(gaussians, sh_degree, splats)


def choose_degree(sh_rest: Floats, wanted: int | Ints | None) -> int | Ints:
    """Return the degree of the spherical harmonics to render: the wanted one, at most the stored one.

    Parameters
    ----------
    sh_rest : ndarray of shape (N, K, 3)
        Coefficients of degrees 1 and above.
    wanted : int, or ndarray of shape (N,) of int, optional
        Of all Gaussians or of each; None: all that is stored.
    """
    stored = math.isqrt(sh_rest.shape[1] + 1) - 1
    return stored if wanted is None else np.minimum(wanted, stored)


def activate(gaussians: Any, is_visible: Bools | None = None, opacity_factor: float = 1.0) -> Primitives:
    """Return Gaussians after their activations.

    Parameters
    ----------
    gaussians : Gaussians
        Or any population that has its first four fields.
    is_visible : ndarray of shape (N,) of booleans, optional
        The opacity of the others is 0.
    opacity_factor : float
        Multiplies the opacities.
    """
    dtype = gaussians.means.dtype
    with np.errstate(over="ignore"):
        # The largest number of float32 takes the place of infinity, which times a gradient of zero would be NaN.
        scales = np.minimum(np.exp(gaussians.log_scales), dtype.type(np.finfo(np.float32).max))
        opacities = 1 / (1 + np.exp(-gaussians.opacity_logits))
    if opacity_factor != 1:
        opacities = opacities * dtype.type(opacity_factor)
    if is_visible is not None:
        opacities = np.where(is_visible, opacities, opacities.dtype.type(0))
    return Primitives(gaussians.means, gaussians.quats, scales, opacities)


def activate_vjp(
    primitives: Primitives, opacity_logits: Floats, v_scales: Floats, v_opacities: Floats
) -> tuple[Floats, Floats]:
    """Return the gradients of logarithms of scales [N, 3] and of logits [N] from those of :func:`activate`'s results.

    With the sigmoid p of the logit and the opacity ``o = f p``, where f is the factor::

        v_log_s = s v_s,  v_logit = f p (1 - p) v_o = o (1 - p) v_o
    """
    with np.errstate(over="ignore"):
        transparencies = 1 / (1 + np.exp(opacity_logits))  # 1 - p, without the cancellation of 1 - 0.9999
    return primitives.scales * v_scales, primitives.opacities * transparencies * v_opacities


def parameters_vjp(gaussians: Any, primitives: Primitives, v_primitives: Any, v_sh: SHGradient) -> Any:
    """Return the gradient of a population from those of its primitives and of its colours.

    Colours depend on the means, by the viewing direction: the means have two terms. Fields beyond the six of
    :class:`Gaussians` have none here.

    Parameters
    ----------
    gaussians : Gaussians
        Or any population that has its six fields.
    primitives : Primitives
        From :func:`activate`.
    v_primitives : PrimitiveGradient
        Or any tuple with ``means``, ``quats``, ``scales`` and ``opacities``.
    v_sh : SHGradient
        From the backend's ``sh_colors_vjp``.
    """
    logits = gaussians.opacity_logits
    v_log_scales, v_logits = activate_vjp(primitives, logits, v_primitives.scales, v_primitives.opacities)
    further = set(gaussians._fields) - set(Gaussians._fields)
    return gaussians._replace(
        means=v_primitives.means + v_sh.means,
        quats=v_primitives.quats,
        log_scales=v_log_scales,
        opacity_logits=v_logits,
        sh_dc=v_sh.sh_dc,
        sh_rest=v_sh.sh_rest,
        **{name: np.zeros_like(getattr(gaussians, name)) for name in further},
    )


def render_vjp(tape: RenderTape, v_image: Floats, v_alpha: Floats | None = None) -> RenderGradient:
    """Gradient of :func:`render`: the stages' gradients in reverse order.

    The means and the pose have two terms each, from the projection and from the viewing direction.

    Parameters
    ----------
    tape : RenderTape
        From the forward function.
    v_image : ndarray of shape (H, W, D)
        Derivative with respect to the image; D is 4 with depth.
    v_alpha : ndarray of shape (H, W), optional
        Derivative with respect to the accumulated opacity; 0 by default.

    Returns
    -------
    RenderGradient
        Zeros for Gaussians that were not visible.
    """
    g, splats = tape.gaussians, tape.splats
    v_alpha = np.zeros_like(splats.output.alpha) if v_alpha is None else v_alpha
    v = splat_vjp(splats, v_image, v_alpha)
    v_sh = splats.backend.sh_colors_vjp(
        g.means, g.sh_dc, g.sh_rest, splats.camera, tape.sh_degree, splats.projection.radii, v.colors
    )
    return RenderGradient(
        gaussians=parameters_vjp(g, splats.primitives, v.primitives, v_sh),
        background=v.background,
        cam_from_world_R=v.primitives.cam_from_world_R + v_sh.cam_from_world_R,
        cam_from_world_t=v.primitives.cam_from_world_t + v_sh.cam_from_world_t,
        means2d=v.means2d,
    )


class Request(NamedTuple):
    """The options for rendering a view, and the results to return besides its colours."""

    background: Floats | None = None
    """[3] RGB behind everything; black by default."""
    sh_degree: int | Ints | None = None
    """Highest degree of the spherical harmonics, of all Gaussians or [N] of each; by default, and at most, the stored
    degree."""
    conventions: Conventions = GSPLAT_MAIN
    backend: Backend = CPU
    is_visible: Bools | None = None
    """[N] rows to render; all by default."""
    opacity_factor: float = 1.0
    """Multiplies all opacities, for renderers that do (:attr:`Renderer.scales_opacities`)."""
    behind: Floats | None = None
    """[H, W, 3] light from behind the model, which a wrapping renderer adds to the image; the output's extras include
    it."""
    wants: frozenset[str] = frozenset()
    """``depth``: a channel with ``sum w z``. ``stats``: blend statistics. ``median_depth``. ``surface``, in the
    output's extras: where each pixel's ray meets its dominant Gaussian. ``dominant_depth``, there too: [H, W] depth of
    that Gaussian's mean. ``removal_changes``, there too: [N] squared change of the colours without each Gaussian. A
    renderer may know further names."""


class Renderer(NamedTuple):
    """A way of rendering a model, and its gradient."""

    name: str
    render: Callable[[Model, View, Request], tuple[RenderOutput, Any]]
    """Returns the view, and a tape for the gradient."""
    render_vjp: Callable[[Any, Floats, Floats | None], RenderGradient]
    """``render_vjp(tape, v_image, v_alpha)``: v_image is [H, W, D] with all channels, v_alpha [H, W] or None."""
    channels: Callable[[frozenset[str]], dict[str, slice]]
    """``channels(wants)``: the image's channels by name."""
    scales_opacities: bool = False
    """Whether it renders with :attr:`Request.opacity_factor`."""


def as_model(model: Any) -> Model:
    """Return a :class:`Model`; a population without shared parameters becomes one."""
    return model if isinstance(model, Model) else Model(model)


def add_light_behind(output: RenderOutput, request: Request) -> RenderOutput:
    """Return the output with the light of :attr:`Request.behind` in its image, as removal changes need it."""
    if request.behind is None:
        return output
    return output._replace(image=output.image + (1 - output.alpha[..., None]) * request.behind)


def _render_model(model: Model, view: View, request: Request) -> tuple[RenderOutput, RenderTape]:
    """Render a model by :func:`render`."""
    gaussians, wants = model.gaussians, request.wants
    stored_degree = math.isqrt(gaussians.sh_rest.shape[1] + 1) - 1
    output, tape = render(
        gaussians,
        view.camera,
        background=request.background,
        sh_degree=None if request.sh_degree is None else np.minimum(request.sh_degree, stored_degree),
        conventions=request.conventions,
        backend=request.backend,
        is_visible=request.is_visible,
        opacity_factor=request.opacity_factor,
        with_depth="depth" in wants,
        with_stats=bool(wants & _OF_STATS),
        with_median_depth="median_depth" in wants,
    )
    lit = add_light_behind(output, request)
    extras = {name: extra(tape, lit) for name, extra in _EXTRAS.items() if name in wants}
    return output._replace(extras=extras), tape


def _surface(tape: RenderTape, output: RenderOutput) -> Any:
    """Return the densest point of the dominant Gaussian on each ray, a :class:`SurfacePoints`."""
    assert output.stats is not None
    means, quats, scales, _ = tape.splats.primitives
    camera = with_principal_point(tape.splats.camera, tape.splats.conventions)
    return tape.splats.backend.surface_points(means, quats, scales, camera, output.stats.dominant_ids)


def _dominant_depth(tape: RenderTape, output: RenderOutput) -> Floats:
    """Return the depth [H, W] of the dominant Gaussian's mean; 0 where nothing was hit."""
    assert output.stats is not None
    depths = np.append(tape.projection.depths, tape.projection.depths.dtype.type(0))  # [N + 1]: id -1 gets 0
    return depths[output.stats.dominant_ids]


def _removal_changes(tape: RenderTape, output: RenderOutput) -> Floats:
    """Return the squared change of the colours [N] without each Gaussian."""
    s = tape.splats
    assert not s.has_depth, "a channel of depths has another unit"
    return s.backend.removal_changes(s.projection, s.channels, s.bins, s.conventions, output)


_EXTRAS: dict[str, Callable[[RenderTape, RenderOutput], Any]] = {
    "surface": _surface,
    "dominant_depth": _dominant_depth,
    "removal_changes": _removal_changes,
}
_OF_STATS = frozenset({"stats", "surface", "dominant_depth"})  # results that need blend statistics


def _channels(wants: frozenset[str]) -> dict[str, slice]:
    return {"rgb": slice(0, 3), "depth": slice(3, 4)} if "depth" in wants else {"rgb": slice(0, 3)}


SPLATTING = Renderer("splatting", _render_model, render_vjp, _channels, scales_opacities=True)
"""3DGS: any population that has the six fields of :class:`Gaussians`."""


class RenderSettings(NamedTuple):
    """Options shared by all renderings of a training or an evaluation; a :class:`Request` has those of one view."""

    background: Floats | None = None
    """[3] RGB behind everything; black by default."""
    conventions: Conventions = GSPLAT_MAIN
    backend: Backend = CPU
    renderer: Renderer = SPLATTING

    def request(self, wants: frozenset[str] = frozenset(), *, sh_degree: int | None = None) -> Request:
        """Return the request for a view; see :class:`Request`."""
        return Request(self.background, sh_degree, self.conventions, self.backend, wants=wants)

    def render_view(
        self, model: Any, view: View, wants: frozenset[str] = frozenset(), *, sh_degree: int | None = None
    ) -> tuple[RenderOutput, Any]:
        """Render a view of a :class:`Model` or population; return it with the tape for the gradient."""
        return self.renderer.render(as_model(model), view, self.request(wants, sh_degree=sh_degree))
