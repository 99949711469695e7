"""Hard cases and their subjects, which are rendered forward and backward through the public functions.

A subject has float64 arrays whose numbers are exact in float32, so that every precision gets the same scene. Bad input
is refused where users' input is: by :func:`check_gaussians`, which every file reader calls last, and by the checks of
:func:`rasterization`. A case adds why the subject is hard, the correct behaviour, and the tolerance of each precision.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.constants import GSPLAT_MAIN, Conventions
from minisplat_ref.gsplat.arguments import Options, Views, check_batch
from minisplat_ref.gsplat.call import rasterization, rasterization_vjp, render_one
from minisplat_ref.oracle.tolerances import ORDINARY, HardCaseTolerance
from minisplat_ref.rendering import render, render_vjp
from minisplat_ref.rendering.backends import Backend
from minisplat_ref.rendering.splatting import Primitives, SplatTape
from minisplat_ref.types import Bools, Camera, Floats, Gaussians
from minisplat_ref.validation import check_gaussians, choose_conventions

Arrays = dict[str, Floats]

SLOPE_MIN = 1e-30  # of a sigmoid: float32 holds its product with a gradient still


class Parameters(NamedTuple):
    """Trained parameters and a camera: through :func:`check_gaussians` and :func:`render`."""

    gaussians: Gaussians
    camera: Camera
    background: tuple[float, float, float] = (0.25, 0.5, 0.75)
    conventions: Conventions = GSPLAT_MAIN
    with_depth: bool = False
    with_median_depth: bool = False
    cotangent_scale: float = 1.0


class Call(NamedTuple):
    """Activated Gaussians and matrices: through :func:`rasterization`."""

    arrays: dict[str, Any]  # means to Ks, by name
    width: int
    height: int
    options: dict[str, Any]  # of rasterization, backgrounds too
    cotangent_scale: float = 1.0


class Images(NamedTuple):
    """A rendered image and a photograph: the photometric loss."""

    image: Floats
    target: Floats
    dssim_weight: float = 0.2
    mask: Bools | None = None
    cotangent_scale: float = 1.0


class Surface(NamedTuple):
    """Gaussians whose surface points are computed: the stage that depth reinitialisation uses."""

    gaussians: Gaussians
    camera: Camera
    cotangent_scale: float = 1.0


Subject = Parameters | Call | Images | Surface


class HardCase(NamedTuple):
    """One entry of the catalogue."""

    name: str
    """Unique; words with hyphens."""
    why: str
    """The reason why it is hard, one line."""
    correct: str
    """The behaviour of a correct renderer, one line."""
    build: Callable[[], Subject]
    """Makes the scene; its numbers are the same in every precision."""
    tolerance: HardCaseTolerance = ORDINARY
    """The tolerance of each precision against the float64 reference."""
    is_background: bool = False
    """Whether the image is the background and nothing but the background has a gradient."""
    refusal: str | None = None
    """Part of the message with which the input is refused; None where it is rendered."""


class Drawing(NamedTuple):
    """The rendering of a subject in one precision."""

    outputs: Arrays
    """By name; the first two axes of those that a pixel has are its row and column."""
    vjp: Callable[[Arrays], Arrays]
    """Maps derivatives with respect to the differentiable outputs to gradients, by name of the block."""
    differentiable: tuple[str, ...]
    gradient_size: float = 0.0
    """Norm of an ordinary gradient, for subjects whose own may be nothing but rounding."""


def cast(bundle: Any, dtype: np.dtype) -> Any:
    """Return a NamedTuple or dict with its floating arrays in another precision."""
    if isinstance(bundle, dict):
        return {key: cast(value, dtype) for key, value in bundle.items()}
    if isinstance(bundle, np.ndarray):
        return bundle.astype(dtype) if bundle.dtype.kind == "f" else bundle
    return type(bundle)(*(cast(field, dtype) for field in bundle)) if isinstance(bundle, tuple) else bundle


def render_subject(subject: Subject, backend: Backend, dtype: np.dtype) -> Drawing:
    """Render a subject in one precision.

    Raises
    ------
    InputError
        If the subject is refused.
    """
    if isinstance(subject, Parameters):
        return _draw_parameters(subject, backend, dtype)
    if isinstance(subject, Call):
        return _draw_call(subject, backend, dtype)
    if isinstance(subject, Surface):
        return _draw_surface(subject, backend, dtype)
    image, target = subject.image.astype(dtype), subject.target.astype(dtype)
    loss, tape = backend.photometric_loss(image, target, subject.dssim_weight, subject.mask)

    def vjp(v: Arrays) -> Arrays:
        return {"image": backend.photometric_loss_vjp(tape, float(v["loss"]))}

    size = 1 / np.sqrt(image.size)  # of image.size signs, each divided by image.size
    return Drawing({"loss": np.array(loss)}, vjp, ("loss",), size)


def splat_tapes(subject: Subject, backend: Backend) -> list[SplatTape]:
    """Return the float64 tapes view by view, to look for pixels at thresholds; none for a loss."""
    if isinstance(subject, Parameters):
        _, tape = render(
            subject.gaussians,
            subject.camera,
            background=np.array(subject.background),
            conventions=subject.conventions,
            backend=backend,
            with_depth=subject.with_depth,
        )
        return [tape.splats]
    if not isinstance(subject, Call):
        return []
    a, options = subject.arrays, subject.options
    primitives = Primitives(a["means"], a["quats"], a["scales"], a["opacities"])
    conventions = choose_conventions(
        options.get("profile", GSPLAT_MAIN),
        options.get("near_plane"),
        options.get("far_plane"),
        options.get("eps2d"),
        options.get("rasterize_mode", "classic"),
    )
    views = Views(a["viewmats"], a["Ks"], subject.width, subject.height)
    sh_degree, backgrounds = options.get("sh_degree"), options.get("backgrounds")
    batch = check_batch(primitives, views, a["colors"], backgrounds, Options(sh_degree))
    return [render_one(batch, c, conventions, backend) for c in range(len(batch.cameras))]


def _draw_parameters(subject: Parameters, backend: Backend, dtype: np.dtype) -> Drawing:
    gaussians, background = cast(subject.gaussians, dtype), np.array(subject.background, dtype)
    check_gaussians(gaussians, "scene")
    output, tape = render(
        gaussians,
        subject.camera,
        background=background,
        conventions=subject.conventions,
        backend=backend,
        with_depth=subject.with_depth,
        with_median_depth=subject.with_median_depth,
    )
    outputs = {"image": output.image, "alpha": output.alpha}
    if output.median_depth is not None:
        outputs["median depth"] = output.median_depth

    def vjp(v: Arrays) -> Arrays:
        gradient = render_vjp(tape, v["image"], v["alpha"])
        blocks = {**gradient.gaussians._asdict(), **gradient._asdict()}
        del blocks["gaussians"], blocks["means2d"], blocks["shared"]
        return blocks | {"opacity_logits": _normalise(subject.gaussians.opacity_logits, blocks["opacity_logits"])}

    return Drawing(outputs, vjp, ("image", "alpha"))


def _normalise(logits: Floats, v_logits: Floats) -> Floats:
    """Divide gradients with respect to logits by o (1 - o): near the ends they are too small to be compared."""
    small = np.exp(-np.abs(logits))  # float64, all digits
    slopes = small / (1 + small) ** 2
    return np.where(slopes > SLOPE_MIN, v_logits / np.maximum(slopes, SLOPE_MIN), 0)


def _draw_call(subject: Call, backend: Backend, dtype: np.dtype) -> Drawing:
    arrays, options = cast(subject.arrays, dtype), cast(subject.options, dtype)
    sized = {**arrays, "width": subject.width, "height": subject.height, **options, "backend": backend}
    images, alphas, _ = rasterization(**sized)
    outputs = {"image": images[0], "alpha": alphas[0, ..., 0]}

    def vjp(v: Arrays) -> Arrays:
        cotangents: dict[str, Any] = {
            "v_render_colors": v["image"][None],
            "v_render_alphas": v["alpha"][None, ..., None],
        }
        return rasterization_vjp(**sized, **cotangents)

    return Drawing(outputs, vjp, ("image", "alpha"))


def _draw_surface(subject: Surface, backend: Backend, dtype: np.dtype) -> Drawing:
    g, camera = cast(subject.gaussians, dtype), subject.camera
    scales = np.exp(g.log_scales)
    ids = np.arange(camera.height * camera.width, dtype=np.int32).reshape(camera.height, -1) % len(g.means)
    points, depths = backend.surface_points(g.means, g.quats, scales, camera, ids)

    def vjp(v: Arrays) -> Arrays:
        v_means, v_quats, v_scales = backend.surface_points_vjp(
            g.means, g.quats, scales, camera, ids, v["points"], v["depths"]
        )
        return {"means": v_means, "quats": v_quats, "log_scales": scales * v_scales}

    return Drawing({"points": points, "depths": depths}, vjp, ("points", "depths"))
