"""What :mod:`minisplat_ref.gsplat_door` is asked for, checked, and its views one by one.

A batch is one set of activated Gaussians seen by C cameras. Colours are D given channels, or spherical harmonics of the
direction from the camera's centre ``o = -R^-1 t``: with the inverse, not the transpose, because the nine entries of R
are free here, and that is the point which R mu + t maps to the origin whatever they are.
"""

from typing import Any, NamedTuple

import numpy as np

from minisplat_ref import validation as check
from minisplat_ref.backends import Backend
from minisplat_ref.constants import DEPTH_ALPHA_MIN, Conventions
from minisplat_ref.splatting import Primitives, SplatTape, splat, splat_vjp
from minisplat_ref.types import Camera, Floats, Ints

RENDER_MODES = ("RGB", "D", "ED", "RGB+D", "RGB+ED")


class Batch(NamedTuple):
    """The checked arguments of one call."""

    primitives: Primitives
    colors: Floats  # [N, D] or [N, K, 3], or one such array for every camera
    has_own_colors: bool  # of every camera
    cameras: tuple[Camera, ...]  # [C]
    backgrounds: Floats  # [C, D]
    sh_degree: int | None
    render_mode: str

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

    def colors_of(self, c: int) -> Floats:
        """Colours or coefficients that camera c sees."""
        return self.colors[c] if self.has_own_colors else self.colors


class ViewGradient(NamedTuple):
    """Gradient of the loss with respect to a batch, through one of its views."""

    primitives: Primitives
    colors: Floats  # [N, D] or [N, K, 3]
    viewmat: Floats  # [4, 4], last row 0
    background: Floats  # [D]


def checked_batch(
    primitives: tuple[Any, Any, Any, Any],
    colors: Any,
    viewmats: Any,
    Ks: Any,
    width: int,
    height: int,
    sh_degree: int | None,
    backgrounds: Any,
    render_mode: str,
) -> Batch:
    """Check the arguments of :func:`minisplat_ref.gsplat_door.rasterization` and pack them."""
    means, quats, scales, opacities = primitives
    dtype, sizes = check.check_dtype("means", means), dict[str, int]()

    def array(name: str, value: Any, *shapes: check.Shape) -> Floats:
        return check.check_array(name, value, shapes, sizes, dtype)

    means = array("means", means, ("N", 3))
    quats = array("quats", quats, ("N", 4))
    scales = array("scales", scales, ("N", 3))
    opacities = array("opacities", opacities, ("N",))
    viewmats, Ks = array("viewmats", viewmats, ("C", 4, 4)), array("Ks", Ks, ("C", 3, 3))
    if sh_degree is None:
        colors = array("colors", colors, ("N", "D"), ("C", "N", "D"))
    else:
        colors = array("colors", colors, ("N", "K", 3), ("C", "N", "K", 3))
        check.check_sh_degree("sh_degree", sh_degree, sizes["K"])
        sizes["D"] = 3
    zeros = np.zeros((sizes["C"], sizes["D"]), dtype)
    backgrounds = zeros if backgrounds is None else array("backgrounds", backgrounds, ("C", "D"))

    check.check_quats("quats", quats)
    check.check_interval("scales", scales, 0, np.inf, "give exp(log_scales)")
    check.check_interval("opacities", opacities, 0, 1, "give sigmoid(opacity_logits)")
    check.check_viewmats("viewmats", viewmats)
    check.check_intrinsics("Ks", Ks)
    check.check_choice("render_mode", render_mode, RENDER_MODES)
    width, height = check.check_size("width", width), check.check_size("height", height)
    cameras = tuple(
        Camera(M[:3, :3], M[:3, 3], float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]), width, height)
        for M, K in zip(viewmats, Ks, strict=True)
    )
    has_own_colors = colors.ndim == (3 if sh_degree is None else 4)
    given = Primitives(means, quats, scales, opacities)
    return Batch(given, colors, has_own_colors, cameras, backgrounds, sh_degree, render_mode)


def draw(batch: Batch, c: int, conventions: Conventions, backend: Backend) -> SplatTape:
    """Draw view c; an expected depth is still the accumulated one."""
    means, colors = batch.primitives.means, batch.colors_of(c)
    background = batch.backgrounds[c]

    def shade(radii: Ints) -> Floats:
        if not batch.has_colors:
            return np.zeros((len(means), 0), means.dtype)
        if batch.sh_degree is None:
            return colors
        return backend.sh_colors(means, *_split(colors), _lookout(batch.cameras[c]), batch.sh_degree, radii)

    return splat(
        batch.primitives,
        shade,
        batch.cameras[c],
        background if batch.has_colors else background[:0],
        conventions,
        backend,
        with_depth=batch.has_depth,
    )


def draw_vjp(batch: Batch, c: int, tape: SplatTape, v_image: Floats, v_alpha: Floats) -> ViewGradient:
    """Gradient of :func:`draw`.

    Spherical harmonics add, through the camera's centre::

        o = -R^-1 t,  w = R^-T v_o:  v_R = -w o^T,  v_t = -w

    The image, whose derivative is ``v_image`` [H, W, D], is the one with the accumulated depth.
    """
    v = splat_vjp(tape, v_image, v_alpha)
    v_means, v_colors, v_background = v.primitives.means, np.zeros_like(batch.colors_of(c)), v.background
    v_R, v_t = v.primitives.cam_from_world_R, v.primitives.cam_from_world_t
    if not batch.has_colors:
        v_background = np.zeros_like(batch.backgrounds[c])
    elif batch.sh_degree is None:
        v_colors = v.colors
    else:
        lookout = _lookout(tape.camera)
        dc, rest = _split(batch.colors_of(c))
        v_sh = tape.backend.sh_colors_vjp(
            batch.primitives.means, dc, rest, lookout, batch.sh_degree, tape.projection.radii, v.colors
        )
        v_means = v_means + v_sh.means
        v_colors = np.concatenate([v_sh.sh_dc[:, None], v_sh.sh_rest], axis=1)
        w = np.linalg.solve(tape.camera.cam_from_world_R.T, -v_sh.cam_from_world_t)  # t of the lookout is -o
        v_R, v_t = v_R + np.outer(w, lookout.cam_from_world_t), v_t - w
    v_viewmat = np.zeros((4, 4), v_t.dtype)
    v_viewmat[:3] = np.column_stack([v_R, v_t])
    v_primitives = Primitives(v_means, v.primitives.quats, v.primitives.scales, v.primitives.opacities)
    return ViewGradient(v_primitives, v_colors, v_viewmat, v_background)


def expected_depth(images: Floats, alphas: Floats) -> Floats:
    """Images [..., H, W, D] whose last channel, the accumulated depth S, is divided: ``E = S / max(alpha, 1e-10)``."""
    depths = images[..., -1] / np.maximum(alphas, DEPTH_ALPHA_MIN)
    return np.concatenate([images[..., :-1], depths[..., None]], axis=-1)


def expected_depth_vjp(images: Floats, alphas: Floats, v_images: Floats, v_alphas: Floats) -> tuple[Floats, Floats]:
    """Gradient of :func:`expected_depth` by the images, and by the alphas with ``v_alphas`` added.

    ::

        a = max(alpha, 1e-10),  v_S = v_E / a,  v_alpha -= v_S S / a   where alpha > 1e-10
    """
    weights = np.maximum(alphas, DEPTH_ALPHA_MIN)
    v_depths = v_images[..., -1] / weights
    v_weights = np.where(alphas > DEPTH_ALPHA_MIN, -v_depths * images[..., -1] / weights, 0)
    return np.concatenate([v_images[..., :-1], v_depths[..., None]], axis=-1), v_alphas + v_weights


def _lookout(camera: Camera) -> Camera:
    """Return a camera at the same centre with R = I: colours depend on the centre only."""
    R, t = camera.cam_from_world_R.astype(np.float64), camera.cam_from_world_t.astype(np.float64)
    return camera._replace(cam_from_world_R=np.eye(3), cam_from_world_t=np.linalg.solve(R, t))


def _split(coefficients: Floats) -> tuple[Floats, Floats]:
    """Coefficients [N, K, 3] as those of degree 0 [N, 3] and the others [N, K-1, 3]."""
    return np.ascontiguousarray(coefficients[:, 0]), np.ascontiguousarray(coefficients[:, 1:])
