"""Structural similarity of one pixel (Wang et al. 2004) from its windowed moments, and the gradient of L1 + D-SSIM."""

from minisplat_ref.jit.compile import scalar
from minisplat_ref.jit.lanes import select
from minisplat_ref.jit.literals import HALF, ONE, TWO, ZERO


@scalar
def ssim_and_derivatives(mean_i, mean_t, mean_squares, mean_it, c1, c2):
    """Return SSIM = (A1 A2) / (B1 B2), and its derivatives with respect to the windowed means of I, I^2 and I T.

    All means are of images from which 1/2 has been subtracted, which changes no variance. Of I^2 and T^2, SSIM needs
    only the sum of the means. The variance and the covariance depend on mean_i too, which gives the second half of its
    derivative. All quotients are products with one inverse, because a division costs as much as many products.
    """
    light_i, light_t = mean_i + HALF, mean_t + HALF
    a1 = TWO * light_i * light_t + c1
    a2 = TWO * (mean_it - mean_i * mean_t) + c2
    b1 = light_i * light_i + light_t * light_t + c1
    b2 = mean_squares - (mean_i * mean_i + mean_t * mean_t) + c2
    inverse = ONE / (b1 * b2)
    value = a1 * a2 * inverse
    by_ii = -value * b1 * inverse
    by_it = TWO * a1 * inverse
    by_i = TWO * (light_t * a2 - light_i * value * b2) * inverse - TWO * mean_i * by_ii - mean_t * by_it
    return value, by_i, by_ii, by_it


@scalar
def photometric_vjp(i, t, by_i, by_ii, by_it, up, v_ssim):
    """Return the gradient with respect to one number I of the image, given the windowed derivatives around it.

    ``up`` is dL/d|I - T|, and v_ssim is dL/dSSIM of every pixel:

        v_I = up sign(I - T) + v_ssim (by_i + 2 I by_ii + T by_it)
    """
    by_squares = TWO * i * by_ii + t * by_it
    by_ssim = by_i + by_squares
    by_l1 = select(i > t, up, select(i < t, -up, ZERO * up))
    return by_l1 + v_ssim * by_ssim
