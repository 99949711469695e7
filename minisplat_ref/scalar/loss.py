"""Structural similarity of one pixel (Wang et al. 2004) from its windowed moments, and its derivative."""

from minisplat_ref.jit.compile import scalar
from minisplat_ref.jit.literals import HALF, ONE, TWO


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
