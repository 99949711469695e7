"""The arguments of gsplat's call, checked and packed: some are computed, some make no difference, others are refused.

gsplat's ``rasterization`` has forty keywords. Those that are not computed are refused by name unless they have their
default: a call must not silently return another result than gsplat's. ``docs/ORACLE.md`` has the table.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from minisplat_ref import validation as check
from minisplat_ref.errors import InputError
from minisplat_ref.rendering.splatting import Primitives
from minisplat_ref.types import Camera, Floats

RENDER_MODES = ("RGB", "D", "ED", "RGB+D", "RGB+ED")
HIT_DISTANCES = ("d", "Ed", "RGB-d", "RGB-Ed")  # modes of gsplat's main branch
TILE_SIZE = 16  # pixels, of the meta's lists, whatever tiles the backend works with
# Covariances are sums of rounded squares: an eigenvalue of a flat Gaussian may come out below zero by this part of the
# largest.
EIGENVALUE_ROUNDING = 1e-5


class Views(NamedTuple):
    """C cameras in the form that gsplat takes."""

    viewmats: Floats  # [C, 4, 4] cam_from_world, OpenCV axes
    Ks: Floats  # [C, 3, 3] pixels
    width: int  # pixels
    height: int  # pixels


class Options(NamedTuple):
    """The arguments that are neither arrays nor conventions."""

    sh_degree: int | None = None
    render_mode: str = "RGB"
    packed: bool = False
    tile_size: int = TILE_SIZE
    radius_clip: float = 0.0

    @property
    def has_colors(self) -> bool:
        """Whether the image has colour channels."""
        return self.render_mode.startswith("RGB")

    @property
    def has_depth(self) -> bool:
        """Whether the last channel is a depth."""
        return self.render_mode != "RGB"

    @property
    def has_expected_depth(self) -> bool:
        """Whether that depth is divided by the accumulated opacity."""
        return self.render_mode.endswith("ED")


class Batch(NamedTuple):
    """The checked arguments of one scene and its cameras."""

    primitives: Primitives
    covars: Floats | None  # [N, 3, 3] symmetric, where these were given instead of quaternions and scales
    colors: Floats  # [N, D] or [N, K, 3], or one such array per camera
    has_own_colors: bool  # whether there is one per camera
    cameras: tuple[Camera, ...]  # [C]
    backgrounds: Floats  # [C, D]
    options: Options

    def colors_of(self, c: int) -> Floats:
        """Return the colours or coefficients that camera c sees."""
        return self.colors[c] if self.has_own_colors else self.colors


class Refused(NamedTuple):
    """A keyword that is not computed."""

    is_requested: Callable[[Any], bool]
    """Whether a value requests it, rather than being gsplat's default."""
    way_out: str


def _is_given(value: Any) -> bool:
    return value is not None


def _is_true(value: Any) -> bool:
    return bool(value)


def _is_other(*defaults: Any) -> Callable[[Any], bool]:
    """Return whether a value, or the name of a value of an enumeration, is none of these."""
    return lambda value: getattr(value, "name", value) not in defaults


_UNDISTORTED = "undistort the photographs, as minisplat-ref undistort does"
_IMAGE_PLANE = "Gaussians are projected by the Jacobian, and blended in the image: leave it out"
_CAMERAS = "call mechanisms.cameras.gsplat_call"
REFUSED: Mapping[str, Refused] = {
    "camera_model": Refused(_is_other("pinhole"), f"only pinhole; for fisheye and ortho {_CAMERAS}"),
    "sparse_grad": Refused(_is_true, "gradients are dense arrays, of the same values: leave it out"),
    "absgrad": Refused(_is_true, "sums of absolute gradients are not kept: leave it out"),
    "distributed": Refused(_is_true, "there is one process: leave it out, and give all Gaussians"),
    "with_ut": Refused(_is_true, _CAMERAS),
    "with_eval3d": Refused(_is_true, _CAMERAS),
    "return_normals": Refused(_is_true, "it needs with_eval3d, which is not computed: leave it out"),
    "global_z_order": Refused(lambda value: not value, "Gaussians are sorted by their depth z: give True"),
    "rays": Refused(_is_given, "rays are those of the cameras: give viewmats and Ks"),
    "radial_coeffs": Refused(_is_given, f"{_UNDISTORTED}, or {_CAMERAS}"),
    "tangential_coeffs": Refused(_is_given, f"{_UNDISTORTED}, or {_CAMERAS}"),
    "thin_prism_coeffs": Refused(_is_given, _UNDISTORTED),
    "ftheta_coeffs": Refused(_is_given, "only pinhole cameras are computed: leave it out"),
    "lidar_coeffs": Refused(_is_given, "only pinhole cameras are computed: leave it out"),
    "external_distortion_coeffs": Refused(_is_given, _UNDISTORTED),
    "rolling_shutter": Refused(_is_other(None, "GLOBAL"), "every image is taken at one moment: give GLOBAL"),
    "viewmats_rs": Refused(_is_given, "every image is taken at one moment: leave it out"),
    "ut_params": Refused(_is_given, _IMAGE_PLANE),
    "extra_signals": Refused(_is_given, "call again with colors=extra_signals and sh_degree=None: it is the same"),
    "extra_signals_sh_degree": Refused(_is_given, "call again with the extra signals as colors: it is the same"),
    "renderer_config": Refused(_is_given, "it chooses between gsplat's kernels: leave it out"),
}
"""Keywords of gsplat 1.5.3 and of its main branch that are taken with their default alone."""
NO_EFFECT = ("segmented", "channel_chunk")
"""Keywords that change gsplat's computation, but not its result; any value is accepted."""


def check_refused(function: str, given: Mapping[str, Any]) -> None:
    """Refuse options that gsplat computes and we do not.

    Parameters
    ----------
    function : str
        That was called.
    given : mapping
        Its further keywords.

    Raises
    ------
    InputError
        One of them requests something that is not computed.
    TypeError
        gsplat has no such keyword.
    """
    for name, value in given.items():
        if name in NO_EFFECT:
            continue
        if name not in REFUSED:
            raise TypeError(f"{function}() got an unexpected keyword argument {name!r}")
        if REFUSED[name].is_requested(value):
            shown = f"={value!r}" if isinstance(value, bool | str | int) else ""
            raise InputError(f"{name}{shown} is not computed; {REFUSED[name].way_out}")


def check_options(options: Options) -> Options:
    """Return the options with their numbers checked.

    Raises
    ------
    InputError
        A value is unknown, or is not computed.
    """
    if options.render_mode in HIT_DISTANCES:
        raise InputError(
            f"render_mode {options.render_mode!r} is not computed: distances along rays need with_eval3d; choose one of"
            f" {', '.join(RENDER_MODES)}"
        )
    check.check_choice("render_mode", options.render_mode, RENDER_MODES)
    if not 0 <= options.radius_clip < np.inf:
        raise InputError(f"radius_clip is {options.radius_clip}; it must be a number of pixels, at least 0")
    size = TILE_SIZE if options.tile_size is None else check.check_size("tile_size", options.tile_size)
    return options._replace(tile_size=size)


def split_batches(
    primitives: tuple[Any, Any, Any, Any], covars: Any, colors: Any, views: Views, backgrounds: Any, options: Options
) -> tuple[tuple[int, ...], list[Batch]]:
    """Return the sizes in front of gsplat's shapes, and the checked arguments of each scene in this array of scenes.

    Parameters
    ----------
    primitives : tuple
        ``means`` of shape (..., N, 3), ``quats``, ``scales`` and ``opacities``.
    covars : ndarray of shape (..., N, 3, 3), or None
        Instead of quaternions and scales.
    colors : ndarray or None
        Coefficients without the sizes in front are those of every scene.
    views : Views
        ``viewmats`` of shape (..., C, 4, 4), and so on.
    backgrounds : ndarray of shape (..., C, D), or None
    options : Options

    Raises
    ------
    InputError
        An argument has a wrong shape, dtype or value.
    """
    lead = np.shape(primitives[0])[:-2]
    if not lead:
        return (), [check_batch(primitives, views, colors, backgrounds, options, covars)]
    if 0 in lead:
        raise InputError(f"means has shape {list(np.shape(primitives[0]))}: a batch of no scene; give at least one")
    arrays = {
        **dict(zip(Primitives._fields, primitives, strict=True)),
        "covars": covars,
        "colors": colors,
        "backgrounds": backgrounds,
    }
    arrays |= {"viewmats": views.viewmats, "Ks": views.Ks}
    is_shared = are_shared(colors, lead, options)
    for name, array in arrays.items():
        if array is not None and np.shape(array)[: len(lead)] != lead and not (name == "colors" and is_shared):
            raise InputError(
                f"{name} has shape {list(np.shape(array))}; its first sizes must be those of means, {list(lead)}"
            )

    def pick(array: Any, index: tuple[int, ...]) -> Any:
        return None if array is None else np.asarray(array)[index]

    batches = []
    for index in np.ndindex(lead):
        means, quats, scales, opacities = (pick(field, index) for field in primitives)
        own = means, quats, scales, opacities
        own_views = views._replace(viewmats=pick(views.viewmats, index), Ks=pick(views.Ks, index))
        own_colors = colors if is_shared else pick(colors, index)
        behind, own_covars = pick(backgrounds, index), pick(covars, index)
        batches.append(check_batch(own, own_views, own_colors, behind, options, own_covars))
    return lead, batches


def are_shared(colors: Any, lead: tuple[int, ...], options: Options) -> bool:
    """Return whether all scenes of a batch have one array of coefficients [N, K, 3]."""
    return bool(lead) and options.sh_degree is not None and np.ndim(colors) == 3


def check_batch(
    primitives: tuple[Any, Any, Any, Any],
    views: Views,
    colors: Any,
    backgrounds: Any,
    options: Options,
    covars: Any = None,
) -> Batch:
    """Check the arguments of one scene and pack them.

    Parameters
    ----------
    primitives, views, colors, backgrounds, options
        As for :func:`split_batches`, of one scene.
    covars : ndarray of shape (N, 3, 3), optional

    Raises
    ------
    InputError
        An argument has a wrong shape, dtype or value.
    """
    means, quats, scales, opacities = primitives
    viewmats, Ks, width, height = views
    dtype, sizes = check.check_dtype("means", means), dict[str, int]()
    options = check_options(options)

    def array(name: str, value: Any, *shapes: check.Shape) -> Floats:
        return check.check_array(name, value, shapes, sizes, dtype)

    means = array("means", means, ("N", 3))
    if covars is None:
        quats = array("quats", quats, ("N", 4))
        scales = array("scales", scales, ("N", 3))
        check.check_quats("quats", quats)
        check.check_interval("scales", scales, 0, np.inf, "give exp(log_scales)")
    else:
        covars = _symmetric(array("covars", covars, ("N", 3, 3)))
        quats, scales = factor(covars)
    opacities = array("opacities", opacities, ("N",))
    viewmats = array("viewmats", viewmats, ("C", 4, 4))
    Ks = array("Ks", Ks, ("C", 3, 3))
    if colors is None and not options.has_colors:  # gsplat's main branch allows it
        colors, options = np.zeros((len(means), 0), dtype), options._replace(sh_degree=None)
    if options.sh_degree is None:
        colors = array("colors", colors, ("N", "D"), ("C", "N", "D"))
    else:
        colors = array("colors", colors, ("N", "K", 3), ("C", "N", "K", 3))
        check.check_sh_degree("sh_degree", options.sh_degree, sizes["K"])
        sizes["D"] = 3
    zeros = np.zeros((sizes["C"], sizes["D"]), dtype)
    backgrounds = zeros if backgrounds is None else array("backgrounds", backgrounds, ("C", "D"))

    check.check_interval("opacities", opacities, 0, 1, "give sigmoid(opacity_logits)")
    check.check_viewmats("viewmats", viewmats)
    check.check_intrinsics("Ks", Ks)
    width, height = check.check_size("width", width), check.check_size("height", height)
    cameras = tuple(
        Camera(M[:3, :3], M[:3, 3], float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]), width, height)
        for M, K in zip(viewmats, Ks, strict=True)
    )
    has_own_colors = colors.ndim == (3 if options.sh_degree is None else 4)
    given = Primitives(means, quats, scales, opacities)
    return Batch(given, covars, colors, has_own_colors, cameras, backgrounds, options)


def _symmetric(covars: Floats) -> Floats:
    """Return the symmetric matrices of upper triangles; gsplat reads no more."""
    upper = np.triu(covars)
    return upper + np.swapaxes(np.triu(covars, 1), 1, 2)


def factor(covars: Floats) -> tuple[Floats, Floats]:
    """Return quaternions [N, 4] and scales [N, 3] of covariances [N, 3, 3]: ``Sigma = R diag(s)^2 R^T``.

    Raises
    ------
    InputError
        A matrix has a negative eigenvalue, and is no covariance.
    """
    if not len(covars):
        return np.zeros((0, 4), covars.dtype), np.zeros((0, 3), covars.dtype)
    eigenvalues, axes = np.linalg.eigh(covars.astype(np.float64))
    wrong = np.flatnonzero(eigenvalues[:, 0] < -EIGENVALUE_ROUNDING * np.abs(eigenvalues).max(axis=1))
    if wrong.size:
        row = wrong[0]
        raise InputError(
            f"covars[{row}] has the eigenvalue {eigenvalues[row, 0]:.3g}, so it is no covariance; give R diag(s)^2 R^T"
        )
    axes[np.linalg.det(axes) < 0, :, 0] *= -1  # a rotation, not a reflection
    quats = Rotation.from_matrix(axes).as_quat()[:, [3, 0, 1, 2]]
    return quats.astype(covars.dtype), np.sqrt(np.maximum(eigenvalues, 0)).astype(covars.dtype)
