"""One surfel in the frame of an image, as scalars: its map T, the boxes of its discs, its planes, and their gradients.

The equations are those of :mod:`.projection`, which has them as matrices, and of :mod:`.response`. The axes of a
surfel in the camera's frame are the columns of ``V = [s_0 R r_0, s_1 R r_1, R r_2]``: the first two span the disc, the
third is its normal. A 3 x 3 matrix is a tuple of rows.
"""

from typing import NamedTuple

from minisplat_ref.jit.compile import scalar
from minisplat_ref.jit.lanes import maximum, minimum, select, sqrt
from minisplat_ref.jit.literals import ONE, TWO, ZERO
from minisplat_ref.scalar.projection import cross, dot, matmul3, transpose3


class Box(NamedTuple):
    """The box of a disc in the image, and d, which is negative where the disc lies in front of the camera."""

    x: float
    """Centre, px, likewise below."""
    y: float
    xx: float
    """Squares of the half-extents, px^2."""
    yy: float
    d: float


@scalar
def add_triples(a, b):
    """Return the sum of two triples."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@scalar
def image_map(camera, V, x):
    """Return T of a surfel with axes V and centre x in the camera's frame, for a camera with fx, fy, cx and cy."""
    depth_row = V[2][0], V[2][1], x[2]
    return (
        (
            camera.fx * V[0][0] + camera.cx * V[2][0],
            camera.fx * V[0][1] + camera.cx * V[2][1],
            camera.fx * x[0] + camera.cx * x[2],
        ),
        (
            camera.fy * V[1][0] + camera.cy * V[2][0],
            camera.fy * V[1][1] + camera.cy * V[2][1],
            camera.fy * x[1] + camera.cy * x[2],
        ),
        depth_row,
    )


@scalar
def image_map_vjp(camera, v_T):
    """Return ``K^T v_T``, of which the first two columns are the gradient of V's and the third that of x."""
    return (
        (camera.fx * v_T[0][0], camera.fx * v_T[0][1], camera.fx * v_T[0][2]),
        (camera.fy * v_T[1][0], camera.fy * v_T[1][1], camera.fy * v_T[1][2]),
        (
            camera.cx * v_T[0][0] + camera.cy * v_T[1][0] + v_T[2][0],
            camera.cx * v_T[0][1] + camera.cy * v_T[1][1] + v_T[2][1],
            camera.cx * v_T[0][2] + camera.cy * v_T[1][2] + v_T[2][2],
        ),
    )


@scalar
def weigh(square, row):
    """Return ``k row`` with k = (e^2, e^2, -1)."""
    return square * row[0], square * row[1], -row[2]


@scalar
def disc_box(T, square):
    """Return the box of the disc of squared radius e^2."""
    of_u, of_v, of_w = weigh(square, T[0]), weigh(square, T[1]), weigh(square, T[2])
    d = dot(of_w, T[2])
    x, y = dot(of_u, T[2]) / d, dot(of_v, T[2]) / d
    return Box(x, y, x * x - dot(of_u, T[0]) / d, y * y - dot(of_v, T[1]) / d, d)


@scalar
def _touches(row, w, square, d):
    """Return the two X at which the line of pixels x = X touches the disc, for the row M_u of T; y for M_v."""
    of_row = weigh(square, row)
    b, a = dot(of_row, w), dot(of_row, row)
    root = sqrt(b * b - a * d)
    q = b + select(b < ZERO, -root, root)
    return q / d, a / q


@scalar
def _widen(low, high, X, row, w, near):
    """Widen bounds by a line that touches the disc, if it does so beyond the near plane."""
    l_0, l_1, l_2 = row[0] - X * w[0], row[1] - X * w[1], row[2] - X * w[2]
    z = w[2] - l_2 * (l_0 * w[0] + l_1 * w[1]) / (l_0 * l_0 + l_1 * l_1)
    is_left = z >= near
    return select(is_left, minimum(low, X), low), select(is_left, maximum(high, X), high)


@scalar
def _bound_cut(row, w, ends, square, d, near):
    """Return the bounds along one axis of the image."""
    (u_0, v_0), (u_1, v_1) = ends
    first, second = (row[0] * u_0 + row[1] * v_0 + row[2]) / near, (row[0] * u_1 + row[1] * v_1 + row[2]) / near
    low, high = minimum(first, second), maximum(first, second)
    X_0, X_1 = _touches(row, w, square, d)
    low, high = _widen(low, high, X_0, row, w, near)
    return _widen(low, high, X_1, row, w, near)


@scalar
def cut_disc_box(T, square, near):
    """Return the bounds (x0, y0, x1, y1) in the image of what a near plane leaves of a disc of squared radius e^2.

    :func:`.projection.cut_disc_boxes` says how.
    """
    w = T[2]
    slope = sqrt(w[0] * w[0] + w[1] * w[1])
    u, v, distance = w[0] / slope, w[1] / slope, (near - w[2]) / slope
    half = sqrt(maximum(square - distance * distance, ZERO))
    ends = (distance * u - half * v, distance * v + half * u), (distance * u + half * v, distance * v - half * u)
    d = dot(weigh(square, w), w)
    x0, x1 = _bound_cut(T[0], w, ends, square, d, near)
    y0, y1 = _bound_cut(T[1], w, ends, square, d, near)
    return x0, y0, x1, y1


@scalar
def disc_center_vjp(T, square, box, v_x, v_y):
    """Return the gradient of the centre of a box with respect to T: :func:`.projection.project_vjp` has the chain."""
    inverse = ONE / box.d
    k_w = weigh(square, T[2])
    v_d = -(v_x * box.x + v_y * box.y) * inverse
    k_u, k_v = weigh(square, T[0]), weigh(square, T[1])
    v_x, v_y = v_x * inverse, v_y * inverse
    return (
        (v_x * k_w[0], v_x * k_w[1], v_x * k_w[2]),
        (v_y * k_w[0], v_y * k_w[1], v_y * k_w[2]),
        (
            v_x * k_u[0] + v_y * k_v[0] + TWO * v_d * k_w[0],
            v_x * k_u[1] + v_y * k_v[1] + TWO * v_d * k_w[1],
            v_x * k_u[2] + v_y * k_v[2] + TWO * v_d * k_w[2],
        ),
    )


@scalar
def low_pass_square(T, square, has_all):
    """Return e^2 of the disc around whose box the low-pass is: 0 if that would reach behind the camera.

    With ``has_all`` it is the same for every disc, as in gsplat.
    """
    if has_all:
        return ZERO * T[2][2] + square
    is_in_front = square * (T[2][0] * T[2][0] + T[2][1] * T[2][1]) < T[2][2] * T[2][2]
    return select(is_in_front, ZERO * T[2][2] + square, ZERO)


@scalar
def side_of(normal, x):
    """Return 1 if a normal is to stay as it is, so that it faces the camera, and -1 if it is to be turned round."""
    return select(dot(normal, x) < ZERO, ZERO * x[2] + ONE, -ONE)


@scalar
def move_map(T, x, y):
    """Return T of pixels relative to (x, y): ``M_u - x M_w, M_v - y M_w, M_w``."""
    w = T[2]
    return (
        (T[0][0] - x * w[0], T[0][1] - x * w[1], T[0][2] - x * w[2]),
        (T[1][0] - y * w[0], T[1][1] - y * w[1], T[1][2] - y * w[2]),
        w,
    )


@scalar
def move_map_vjp(x, y, v):
    """Return the gradient of :func:`move_map` with respect to T: ``v_M_w = v_w - x v_u - y v_v``."""
    return (
        v[0],
        v[1],
        (
            v[2][0] - x * v[0][0] - y * v[1][0],
            v[2][1] - x * v[0][1] - y * v[1][1],
            v[2][2] - x * v[0][2] - y * v[1][2],
        ),
    )


@scalar
def invert(T):
    """Return ``T^-1``, the matrix of cofactors over the determinant; not finite where that is 0."""
    of_u, of_v, of_w = cross(T[1], T[2]), cross(T[2], T[0]), cross(T[0], T[1])
    det = dot(T[0], of_u)
    return (
        (of_u[0] / det, of_v[0] / det, of_w[0] / det),
        (of_u[1] / det, of_v[1] / det, of_w[1] / det),
        (of_u[2] / det, of_v[2] / det, of_w[2] / det),
    )


@scalar
def invert_vjp(P, v_P):
    """Return the gradient with respect to T of its inverse P: ``v_T = -P^T v_P P^T``, because ``dP = -P dT P``."""
    P_transposed = transpose3(P)
    v = matmul3(matmul3(P_transposed, v_P), P_transposed)
    return (
        (-v[0][0], -v[0][1], -v[0][2]),
        (-v[1][0], -v[1][1], -v[1][2]),
        (-v[2][0], -v[2][1], -v[2][2]),
    )
