"""EWA projection of one Gaussian (3DGS section 4; Zwicker et al. 2002), in square-root form.

With the Gaussian's axes as the columns of M = R_g diag(s), the projected covariance is U U^T + eps2d I, where

    V = R M                     camera frame                      [3, 3]
    u = (fx / z) (V_0 - x' V_2) first row of U = J V; x' = clamp(x / z)
    w = (fy / z) (V_1 - y' V_2) second row

so that cov = (u.u, u.w, w.w), and its determinant is the squared area |u x w|^2: a sum of squares, which stays accurate
for needles where u.u * w.w - (u.w)^2 would cancel. For the same reason the conic is built from its factors (see
``conic``) rather than as the inverse of rounded entries.
"""

from typing import NamedTuple

from minisplat_ref.jit.compile import scalar
from minisplat_ref.jit.lanes import maximum, minimum, select, sqrt
from minisplat_ref.jit.literals import HALF, ONE, TWO, ZERO
from minisplat_ref.scalar.covariance import normalize, normalize_vjp, rotation, rotation_vjp
from minisplat_ref.types import Floats


class Pose(NamedTuple):
    """A camera's pose: a point x in the world has the camera coordinates R (x - centre)."""

    R: Floats
    """[3, 3] float64."""
    centre: Floats
    """[3] float64, world units."""


class ProjectionConstants(NamedTuple):
    """The constants of a view: the camera and the conventions, as scalars of the data's dtype."""

    fx: float
    fy: float
    cx: float
    cy: float
    x_min: float
    """Jacobian clamp of x / z, likewise below."""
    x_max: float
    y_min: float
    y_max: float
    near: float
    far: float
    eps2d: float
    compensation_floor: float
    is_antialiased: bool


class Footprint(NamedTuple):
    """One projected Gaussian and what its gradient needs again."""

    x: float
    """Image position, pixels."""
    y: float
    u: tuple
    """Rows of U."""
    w: tuple
    cov_xx: float
    """Covariance with the low-pass, px^2."""
    cov_xy: float
    cov_yy: float
    det: float
    """Its determinant, px^4."""
    compensation: float
    """sqrt(det before the low-pass / det after), or 1."""


@scalar
def dot(a, b):
    """Return the inner product of two triples."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@scalar
def cross(a, b):
    """Return the vector product of two triples."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@scalar
def matrix_rows(matrix):
    """Return the rows of a 3 x 3 array as a tuple."""
    return (
        (matrix[0, 0], matrix[0, 1], matrix[0, 2]),
        (matrix[1, 0], matrix[1, 1], matrix[1, 2]),
        (matrix[2, 0], matrix[2, 1], matrix[2, 2]),
    )


@scalar
def to_camera(R, centre, x, y, z):
    """Return camera coordinates of a world point; subtracting the centre first keeps digits far from the origin."""
    d = (x - centre[0], y - centre[1], z - centre[2])
    return dot(R[0], d), dot(R[1], d), dot(R[2], d)


@scalar
def axes(quat, scale):
    """Return M = R_g diag(s) as rows: M[j][k] is world component j of axis k times its standard deviation."""
    qw, qx, qy, qz, _ = normalize(quat[0], quat[1], quat[2], quat[3])
    r = rotation(qw, qx, qy, qz)
    return (
        (r[0][0] * scale[0], r[0][1] * scale[1], r[0][2] * scale[2]),
        (r[1][0] * scale[0], r[1][1] * scale[1], r[1][2] * scale[2]),
        (r[2][0] * scale[0], r[2][1] * scale[1], r[2][2] * scale[2]),
    )


@scalar
def matmul3(R, M):
    """Return the matrix product of two 3 x 3 tuples of rows."""
    c0 = (M[0][0], M[1][0], M[2][0])
    c1 = (M[0][1], M[1][1], M[2][1])
    c2 = (M[0][2], M[1][2], M[2][2])
    return (
        (dot(R[0], c0), dot(R[0], c1), dot(R[0], c2)),
        (dot(R[1], c0), dot(R[1], c1), dot(R[1], c2)),
        (dot(R[2], c0), dot(R[2], c1), dot(R[2], c2)),
    )


@scalar
def transpose3(M):
    """Return the transpose of a 3 x 3 tuple of rows."""
    return ((M[0][0], M[1][0], M[2][0]), (M[0][1], M[1][1], M[2][1]), (M[0][2], M[1][2], M[2][2]))


@scalar
def image_row(focal_over_z, direction, V_row, V_2):
    """Return one row of U."""
    return (
        focal_over_z * (V_row[0] - direction * V_2[0]),
        focal_over_z * (V_row[1] - direction * V_2[1]),
        focal_over_z * (V_row[2] - direction * V_2[2]),
    )


@scalar
def project_gaussian(p, V, constants):
    """Return the footprint of a Gaussian with camera coordinates p and camera-frame axes V."""
    inverse_z = ONE / p[2]
    x = p[0] * inverse_z
    y = p[1] * inverse_z
    u = image_row(constants.fx * inverse_z, minimum(maximum(x, constants.x_min), constants.x_max), V[0], V[2])
    w = image_row(constants.fy * inverse_z, minimum(maximum(y, constants.y_min), constants.y_max), V[1], V[2])
    cov_xx = dot(u, u)
    cov_xy = dot(u, w)
    cov_yy = dot(w, w)
    area = cross(u, w)
    det_sharp = dot(area, area)
    det = det_sharp + constants.eps2d * (cov_xx + cov_yy) + constants.eps2d * constants.eps2d
    compensation = ZERO * det + ONE  # NaN where det is not finite
    if constants.is_antialiased:
        compensation = sqrt(maximum(det_sharp / det, constants.compensation_floor * constants.compensation_floor))
    return Footprint(
        constants.fx * x + constants.cx,
        constants.fy * y + constants.cy,
        u,
        w,
        cov_xx + constants.eps2d,
        cov_xy,
        cov_yy + constants.eps2d,
        det,
        compensation,
    )


@scalar
def conic(footprint):
    """Return the inverse (a, b, c) of the projected covariance.

    c is computed so that the pivot c - b^2 / a is 1 / cov_yy to all digits, which c = cov_xx / det would not give.
    """
    a = footprint.cov_yy / footprint.det
    pivot = ONE / footprint.cov_yy
    slope = -footprint.cov_xy * pivot
    return a, a * slope, pivot + a * slope * slope


@scalar
def conic_vjp(footprint, v_conic):
    """Return the gradient with respect to (cov_xx, cov_xy, cov_yy), via a, slope = b / a and pivot = c - b^2 / a.

    The three are 1 / (cov_xx - cov_xy^2 / cov_yy), -cov_xy / cov_yy and 1 / cov_yy. For a needle the entries of
    ``v_conic`` are large and cancel in the derivatives with respect to a and slope: in two sums here, nowhere else.
    """
    a = footprint.cov_yy / footprint.det
    pivot = ONE / footprint.cov_yy
    slope = -footprint.cov_xy * pivot
    by_schur = -a * (a * (v_conic[0] + slope * (v_conic[1] + slope * v_conic[2])))
    by_slope = pivot * a * (v_conic[1] + TWO * slope * v_conic[2])
    return (
        by_schur,
        TWO * slope * by_schur - by_slope,
        slope * slope * by_schur - slope * by_slope - pivot * pivot * v_conic[2],
    )


@scalar
def compensation_vjp(footprint, v_compensation, constants):
    """Return the gradient of sqrt(det_sharp / det) with respect to (cov_xx, cov_xy, cov_yy); zero on the floor."""
    rho = footprint.compensation
    if not constants.is_antialiased:
        return ZERO * rho, ZERO * rho, ZERO * rho
    k = select(rho > constants.compensation_floor, HALF * v_compensation / (rho * footprint.det), ZERO)
    keep = rho * rho
    return (
        k * (footprint.cov_yy - constants.eps2d - keep * footprint.cov_yy),
        -TWO * k * footprint.cov_xy * (ONE - keep),
        k * (footprint.cov_xx - constants.eps2d - keep * footprint.cov_xx),
    )


@scalar
def image_row_vjp(focal_over_z, direction, V_2, v_row):
    """Return the gradient of one row of U with respect to (V_row, V_2, direction)."""
    v_V_row = (focal_over_z * v_row[0], focal_over_z * v_row[1], focal_over_z * v_row[2])
    v_V_2 = (-direction * v_V_row[0], -direction * v_V_row[1], -direction * v_V_row[2])
    return v_V_row, v_V_2, -dot(v_V_row, V_2)


@scalar
def project_gaussian_vjp(p, V, constants, footprint, v_x, v_y, v_depth, v_cov):
    """Chain gradients with respect to image position, depth and projected covariance to p and V.

    A row has the factor f / z, so its own share of dL/dz is -(row . v_row) / z; a clamped direction does not depend on
    p.
    """
    inverse_z = ONE / p[2]
    x = p[0] * inverse_z
    y = p[1] * inverse_z
    u = footprint.u
    w = footprint.w
    v_u = (
        TWO * v_cov[0] * u[0] + v_cov[1] * w[0],
        TWO * v_cov[0] * u[1] + v_cov[1] * w[1],
        TWO * v_cov[0] * u[2] + v_cov[1] * w[2],
    )
    v_w = (
        TWO * v_cov[2] * w[0] + v_cov[1] * u[0],
        TWO * v_cov[2] * w[1] + v_cov[1] * u[1],
        TWO * v_cov[2] * w[2] + v_cov[1] * u[2],
    )
    v_V0, v_V2x, v_dir_x = image_row_vjp(
        constants.fx * inverse_z, minimum(maximum(x, constants.x_min), constants.x_max), V[2], v_u
    )
    v_V1, v_V2y, v_dir_y = image_row_vjp(
        constants.fy * inverse_z, minimum(maximum(y, constants.y_min), constants.y_max), V[2], v_w
    )
    v_V2 = (v_V2x[0] + v_V2y[0], v_V2x[1] + v_V2y[1], v_V2x[2] + v_V2y[2])

    v_ratio_x = constants.fx * v_x + select((x > constants.x_min) & (x < constants.x_max), v_dir_x, ZERO)
    v_ratio_y = constants.fy * v_y + select((y > constants.y_min) & (y < constants.y_max), v_dir_y, ZERO)
    v_p = (
        v_ratio_x * inverse_z,
        v_ratio_y * inverse_z,
        v_depth - (v_ratio_x * x + v_ratio_y * y + dot(u, v_u) + dot(w, v_w)) * inverse_z,
    )
    return v_p, (v_V0, v_V1, v_V2)


@scalar
def axes_vjp(quat, scale, v_M):
    """Chain dL/dM to the quaternion, as given, and the scales."""
    qw, qx, qy, qz, inverse_length = normalize(quat[0], quat[1], quat[2], quat[3])
    r = rotation(qw, qx, qy, qz)
    v_scale = (
        v_M[0][0] * r[0][0] + v_M[1][0] * r[1][0] + v_M[2][0] * r[2][0],
        v_M[0][1] * r[0][1] + v_M[1][1] * r[1][1] + v_M[2][1] * r[2][1],
        v_M[0][2] * r[0][2] + v_M[1][2] * r[1][2] + v_M[2][2] * r[2][2],
    )
    v_r = (
        (v_M[0][0] * scale[0], v_M[0][1] * scale[1], v_M[0][2] * scale[2]),
        (v_M[1][0] * scale[0], v_M[1][1] * scale[1], v_M[1][2] * scale[2]),
        (v_M[2][0] * scale[0], v_M[2][1] * scale[1], v_M[2][2] * scale[2]),
    )
    return normalize_vjp((qw, qx, qy, qz), inverse_length, rotation_vjp(qw, qx, qy, qz, v_r)), v_scale
