"""The depth at which the ray of one pixel meets one Gaussian, at its greatest density (Mini-Splatting appendix D).

In the Gaussian's own axes, with p the mean relative to the ray's origin and r the ray's direction, the density along
o + t d is greatest at the weighted least-squares solution of p = t r:

    t = (sum_k p_k r_k / s_k^2) / (sum_k r_k^2 / s_k^2)

which is also the middle of the chord through the ellipsoid at any number of standard deviations.
"""

from minisplat_ref.jit.compile import scalar
from minisplat_ref.jit.literals import ONE, TWO
from minisplat_ref.scalar.covariance import normalize, rotation
from minisplat_ref.scalar.projection import dot, transpose3


@scalar
def gaussian_axes(quat):
    """Return a Gaussian's unit axes in the world frame, one per row."""
    w, x, y, z, _ = normalize(quat[0], quat[1], quat[2], quat[3])
    return transpose3(rotation(w, x, y, z))


@scalar
def pixel_ray(R, x, y, fx, fy, cx, cy):
    """Return the world direction of the ray through an image point, scaled to a camera z of 1."""
    columns = transpose3(R)
    in_camera = ((x - cx) / fx, (y - cy) / fy, ONE * fx / fx)
    return dot(columns[0], in_camera), dot(columns[1], in_camera), dot(columns[2], in_camera)


@scalar
def densest_depth(axes, scale, u, d):
    """Return t, given u = mean - origin and the direction d."""
    numerator = dot(axes[0], u) * dot(axes[0], d) / (scale[0] * scale[0])
    denominator = dot(axes[0], d) * dot(axes[0], d) / (scale[0] * scale[0])
    for k in range(1, 3):
        inverse = ONE / (scale[k] * scale[k])
        numerator += dot(axes[k], u) * dot(axes[k], d) * inverse
        denominator += dot(axes[k], d) * dot(axes[k], d) * inverse
    return numerator / denominator


@scalar
def densest_depth_vjp(axis, s, t, precision, v_t, u, d):
    """Return one axis's share of the gradient, given dL/dt; ``precision`` is the denominator of t.

    Returns
    -------
    v_axis : tuple
        With respect to the axis.
    v_s : float
        With respect to its standard deviation.
    v_p : float
        With respect to the mean's coordinate along the axis.
    """
    p = dot(axis, u)
    r = dot(axis, d)
    k = v_t / (precision * s * s)
    v_p = k * r
    v_r = k * (p - TWO * t * r)
    v_axis = (v_p * u[0] + v_r * d[0], v_p * u[1] + v_r * d[1], v_p * u[2] + v_r * d[2])
    return v_axis, -TWO * k * r * (p - t * r) / s, v_p
