"""The numbers in the renderer's formulas, each with its reason, and the conventions on which renderers differ.

This module holds what the reference and the kernels, or several stages, must agree on. A number that only one module
needs (a kernel's design, a method's schedule, a file reader's tolerance) stays in that module.

There is no single "3DGS rasteriser": released backends clamp alpha at 0.99 or 0.999, cut a Gaussian off at three sigma
or where it becomes invisible, ignore or use the principal point. A :class:`Conventions` value names one such set of
choices; every stage that depends on them takes it as an argument.
"""

from typing import NamedTuple

# Spherical harmonics: real, orthonormal, with the Condon-Shortley sign (the order and signs of the 3DGS PLY files).
SH_C0 = 0.28209479177387814  # 1 / (2 sqrt(pi))
LUMA = (0.299, 0.587, 0.114)  # ITU-R BT.601: shares of R', G' and B' in the luminance
SH_C1 = 0.4886025119029199  # sqrt(3 / (4 pi))
SH_C2 = (
    1.0925484305920792,  # sqrt(15 / (4 pi))
    0.31539156525252005,  # sqrt(5 / (16 pi))
    0.5462742152960396,  # sqrt(15 / (16 pi))
)
SH_C3 = (
    0.5900435899266435,  # sqrt(35 / (32 pi))
    2.890611442640554,  # sqrt(105 / (4 pi))
    0.4570457994644658,  # sqrt(21 / (32 pi))
    0.3731763325901154,  # sqrt(7 / (16 pi))
    1.445305721320277,  # sqrt(105 / (16 pi))
)
SH_DEGREE_MAX = 3

INRIA_TILE = 16  # pixels; INRIA's rule of extent is stated in tiles of this size
# px^4: minimum of (lambda_1 - lambda_2)^2 / 4 in INRIA's largest eigenvalue, which makes that of a disc 0.3 px^2 too
# large.
INRIA_ROOT_MIN = 0.1
# Pixels. The largest power of two that fits int32; float32 and float64 hold it exactly. Radii are clamped when they are
# stored, after the boxes are computed: otherwise a Gaussian further outside the image than this, whose ellipse still
# covers it, would miss it.
RADIUS_MAX = 2.0**30

JACOBIAN_CLAMP = 1.3  # the EWA Jacobian is frozen beyond 1.3 x the half field of view: it explodes as 1/z^2 outside
COMPENSATION_FLOOR = 0.005  # minimum factor of the antialiasing compensation, keeps its square root differentiable
MEDIAN_TRANSMITTANCE = 0.5  # the median depth is that of the Gaussian that takes the transmittance below one half
DEPTH_ALPHA_MIN = 1e-10  # a pixel of lower accumulated opacity is empty: its expected depth is 0, not 0/0

SSIM_WINDOW = 11  # pixels; Wang et al. 2004
SSIM_SIGMA = 1.5  # pixels
SSIM_C1 = 0.01**2  # (K1 L)^2 with dynamic range L = 1
SSIM_C2 = 0.03**2  # (K2 L)^2

LIST_ORDER = 1  # size of a pixel's sorting buffer: each hit is taken as it comes
EXACT_ORDER = 1 << 30  # longer than any list: a pixel sorts all its hits


class Conventions(NamedTuple):
    """One consistent set of a rasteriser's choices.

    Attributes
    ----------
    name : str
        Name of the profile.
    near_plane, far_plane : float
        A Gaussian is rendered when ``near_plane < z < far_plane`` (camera z of its mean, world units).
    eps2d : float
        Low-pass added to both diagonal entries of the projected covariance (px^2).
    is_antialiased : bool
        Multiply opacities by ``sqrt(det(cov2d) / det(cov2d + eps2d I))`` so that the low-pass does not brighten
        Gaussians thinner than a pixel (Mip-Splatting).
    alpha_min : float
        A hit of lower alpha is skipped. 1/255: it would not change an 8-bit image.
    alpha_max : float
        Alpha is clamped here, so that no single Gaussian makes the transmittance exactly zero.
    transmittance_min : float
        A pixel is finished when the next hit would take its transmittance below this; that hit is not blended.
    stops_at_equality : bool
        Whether a pixel is finished at ``T <= transmittance_min`` (gsplat) or only at ``T < transmittance_min`` (INRIA).
    has_full_support : bool
        True: a Gaussian reaches exactly as far as its alpha can be ``alpha_min``. False: INRIA's rule, all 16-pixel
        tiles touched by the square of half-side ``ceil(3 sqrt(lambda_max))`` around the mean, which cuts visible alpha.
    uses_principal_point : bool
        False: INRIA's rule, ``cx = width / 2, cy = height / 2`` regardless of the camera's principal point.
    clamp_is_symmetric : bool
        Jacobian clamp at ``+-1.3 tan(fov / 2)`` (INRIA), or at 1.3 x each half field of view counted from the principal
        point plus 0.3 x the half width (gsplat). Equal for a centred principal point.
    clamp_stops_mean_gradient, clamp_stops_shape_gradient : bool
        Whether clamping at ``alpha_max`` zeroes the gradient of ``means2d``, and that of conics and opacities. With
        both True the gradient is the derivative of what is computed.
    """

    name: str
    near_plane: float
    far_plane: float
    eps2d: float
    is_antialiased: bool
    alpha_min: float
    alpha_max: float
    transmittance_min: float
    stops_at_equality: bool
    has_full_support: bool
    uses_principal_point: bool
    clamp_is_symmetric: bool
    clamp_stops_mean_gradient: bool
    clamp_stops_shape_gradient: bool


GSPLAT_MAIN = Conventions(
    name="GSPLAT_MAIN",
    near_plane=0.01,
    far_plane=1e10,
    eps2d=0.3,
    is_antialiased=False,
    alpha_min=1.0 / 255.0,
    alpha_max=0.99,
    transmittance_min=1e-4,  # = (1 - alpha_max)^2: two opaque hits end a pixel
    stops_at_equality=True,
    has_full_support=True,
    uses_principal_point=True,
    clamp_is_symmetric=False,
    clamp_stops_mean_gradient=True,
    clamp_stops_shape_gradient=True,
)
"""gsplat 1.6: the default. Full support and gradients that are derivatives of what is computed."""

GSPLAT_1_5 = GSPLAT_MAIN._replace(name="GSPLAT_1_5", alpha_max=0.999)
"""gsplat 1.5.3 as released on PyPI."""

INRIA = GSPLAT_MAIN._replace(
    name="INRIA",
    near_plane=0.2,
    stops_at_equality=False,
    has_full_support=False,
    uses_principal_point=False,
    clamp_is_symmetric=True,
    clamp_stops_mean_gradient=False,
    clamp_stops_shape_gradient=False,
)
"""The 3DGS rasteriser of 2023, also that of Mini-Splatting."""

MINI_SPLATTING2 = INRIA._replace(
    name="MINI_SPLATTING2",
    has_full_support=True,
    clamp_stops_shape_gradient=True,
)
"""The rasteriser of Mini-Splatting2: INRIA's with tight bounds."""

PROFILES = {profile.name: profile for profile in (GSPLAT_MAIN, GSPLAT_1_5, INRIA, MINI_SPLATTING2)}
"""The profiles by their names, as ``--profile`` takes them."""
