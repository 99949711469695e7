"""Structural similarity of one pixel (Wang et al. 2004) from its windowed moments, and its derivative."""

from minisplat_ref.scalar._jit import scalar
from minisplat_ref.scalar.literals import ONE, TWO


@scalar
def ssim_and_derivatives(mean_i, mean_t, mean_squares, mean_it, c1, c2):
    """Return SSIM = (A1 A2) / (B1 B2), and its derivatives by the windowed means of I, I^2 and I T.

    Of I^2 and T^2 it needs the sum of the means only. The variance and the covariance depend on mean_i too, which gives
    the second half of its derivative. All quotients are products with one inverse, for a division costs as much as ten.
    """
    a1 = TWO * mean_i * mean_t + c1
    a2 = TWO * (mean_it - mean_i * mean_t) + c2
    b1 = mean_i * mean_i + mean_t * mean_t + c1
    b2 = mean_squares - (mean_i * mean_i + mean_t * mean_t) + c2
    inverse = ONE / (b1 * b2)
    value = a1 * a2 * inverse
    by_ii = -value * b1 * inverse
    by_it = TWO * a1 * inverse
    by_i = TWO * (mean_t * a2 - mean_i * value * b2) * inverse - TWO * mean_i * by_ii - mean_t * by_it
    return value, by_i, by_ii, by_it
