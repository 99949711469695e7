"""Every tolerance of the tests, with its reason. Relative ones are relative to the largest value compared."""

# A float64 formula against the same number by hand: a few dozen roundings of 1e-16.
CLOSED_FORM = 1e-13

# Central differences in float64: step^2 = 1e-12 times third derivatives of order 1e2 to 1e4 px, plus 1e-16 / step.
GRADIENT_STEP = 1e-6
GRADIENT_REL = 1e-6

# Through whole images the step is smaller, so that no hit crosses a threshold on the way; rounding is 1e-16 / step.
GRADIENT_STEP_IMAGE = 1e-8

# A block of a Jacobian or an inner product below this is vacuous: real ones here are 1e-3 to 1e3.
GRADIENT_FLOOR = 1e-6

# Two derivations of the same sums in float64, in another order: sums of up to a few thousand terms of 1e-16 each.
PARITY_FLOAT64 = 1e-12

# One image in float32: hundreds of hits, each with an exponential of 1e-7 relative error; promised in the README.
PARITY_FLOAT32_IMAGE = 2e-5

# Gradients in float32, relative to the largest: division by 1 - alpha and by 1 / z^2 amplify 1e-7 a thousandfold.
PARITY_FLOAT32_GRADIENT = 2e-3

# Alpha must cover this part of an image before a test on it says anything.
COVERAGE_MIN = 0.05

# Footprints in float32: a 2x2 inverse loses the condition number of the covariance, up to 1e2 here, of 1e-7.
PARITY_FLOAT32_PROJECTION = 1e-4

# The constants of the spherical harmonics are given with 16 digits; sums of 128 directions.
SH_CONSTANTS = 1e-13

# SSIM in float64 by another filter: variances are differences of means, divided by at least C2 = 9e-4.
SSIM_BY_SCIPY = 1e-12

# The same in float32: 1e-7 of a mean near 1 against C2 = 9e-4 is 1e-4 of a pixel's SSIM.
PARITY_FLOAT32_LOSS = 1e-3
