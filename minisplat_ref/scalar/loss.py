"""Structural similarity of one pixel (Wang et al. 2004) from its windowed moments, and its derivative."""

from minisplat_ref.scalar._jit import scalar
from minisplat_ref.scalar.literals import TWO


@scalar
def ssim(mean_i, mean_t, mean_ii, mean_tt, mean_it, c1, c2):
    """Return SSIM from the windowed means of I, T, I^2, T^2 and I T."""
    variances = (mean_ii - mean_i * mean_i) + (mean_tt - mean_t * mean_t)
    covariance = mean_it - mean_i * mean_t
    luminance = (TWO * mean_i * mean_t + c1) / (mean_i * mean_i + mean_t * mean_t + c1)
    return luminance * (TWO * covariance + c2) / (variances + c2)


@scalar
def ssim_vjp(mean_i, mean_t, mean_ii, mean_tt, mean_it, c1, c2):
    """Derivative of SSIM = (A1 A2) / (B1 B2) by the windowed means of I, I^2 and I T.

    The variance and the covariance depend on mean_i too, which gives the second half of its derivative.
    """
    a1 = TWO * mean_i * mean_t + c1
    a2 = TWO * (mean_it - mean_i * mean_t) + c2
    b1 = mean_i * mean_i + mean_t * mean_t + c1
    b2 = (mean_ii - mean_i * mean_i) + (mean_tt - mean_t * mean_t) + c2
    value = a1 * a2 / (b1 * b2)
    by_ii = -value / b2
    by_it = TWO * a1 / (b1 * b2)
    by_i = TWO * (mean_t * a2 / (b1 * b2) - mean_i * value / b1) - TWO * mean_i * by_ii - mean_t * by_it
    return by_i, by_ii, by_it
