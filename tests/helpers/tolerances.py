"""Every tolerance of the tests, with its reason. Relative ones are relative to the largest value compared."""

# What makes a check vacuous is the same for the tests and for the installed command.
from minisplat_ref.oracle.tolerances import COVERAGE_MIN as COVERAGE_MIN
from minisplat_ref.oracle.tolerances import GRADIENT_FLOOR as GRADIENT_FLOOR

# A float64 formula against the same number by hand: a few dozen roundings of 1e-16.
CLOSED_FORM = 1e-13

# Central differences in float64: step^2 = 1e-12 times third derivatives of order 1e2 to 1e4 px, plus 1e-16 / step.
GRADIENT_STEP = 1e-6
GRADIENT_REL = 1e-6

# Through whole images the step is smaller, so that no hit crosses a threshold on the way; rounding is 1e-16 / step.
GRADIENT_STEP_IMAGE = 1e-8

# Two derivations of the same sums in float64, in another order: sums of up to a few thousand terms of 1e-16 each.
PARITY_FLOAT64 = 1e-12

# One image in float32: hundreds of hits, each with an exponential of 1e-7 relative error; promised in docs/measured.
PARITY_FLOAT32_IMAGE = 2e-5

# Gradients in float32, relative to the largest: 1e-7 a hundredfold, by divisions by 1 - alpha <= 0.99 and by z^2.
PARITY_FLOAT32_GRADIENT = 2e-5

# Footprints in float32: a 2x2 inverse loses the condition number of the covariance, up to 1e2 here, of 1e-7.
PARITY_FLOAT32_PROJECTION = 1e-5

# The constants of the spherical harmonics are given with 16 digits; sums of 128 directions.
SH_CONSTANTS = 1e-13

# SSIM in float64 by another filter: variances are differences of means, divided by at least C2 = 9e-4.
SSIM_BY_SCIPY = 1e-12

# The same in float32: 1e-7 of a mean below 1 against C2 = 9e-4 and variances near 1e-1.
PARITY_FLOAT32_LOSS = 1e-5

# A few Adam steps in float32 on values of order 1: some roundings of 6e-8 each.
ADAM_FLOAT32 = 1e-6

# A ray-traced point against the surface it was computed from, metres or relative: 1e-16 times distances of up to 150 m,
# divided by grazing cosines and, in a sphere's root, by its square.
SYNTHETIC_SURFACE = 1e-7

# A sparse point against the pixel that it falls on, 8-bit levels: half a pixel away on a texture, and shadows' edges.
SYNTHETIC_COLOR_LEVELS = 20

# Depth and normals on disk are float32: half a unit in its last place, 6e-8.
SYNTHETIC_FLOAT32 = 1e-7

# A float64 result stored as float32, of magnitude up to 10.
ROUNDED_TO_FLOAT32 = 1e-6

# Mean and covariance of 8000 draws, relative to the largest standard deviation (squared): 4 sigma of 1 / sqrt(8000).
SAMPLE_MEAN = 0.045

# .splat files hold bytes: 128 + 128 q and 255 alpha, rounded or truncated by whoever wrote them.
SPLAT_BYTE = 1.0

# .splat files hold exp(log_scale) in float32: the exponential of a float32 that is rounded once more.
SPLAT_SCALE = 1e-6

# COLMAP text files print 17 digits, but a quaternion is normalised when it is read: 1e-16 on values up to 10.
CAMERA_TEXT = 1e-12

# MB for a COLMAP model of 11.6 million observations: 4 bytes each while they are gathered, 8 in the result, and some
# 40 MB for a piece of a million elements; measured 186.
LARGE_MODEL_MB = 250

# scene_info.json of the real scenes rounds to 4 to 6 decimals.
SCENE_INFO = 6e-5

# Bilinear interpolation of 8-bit levels: half a level of rounding twice, and the distortion's curvature in a pixel.
UNDISTORTED_LEVELS = 1.5

# A flat colour through WebP of quality 95: 0.33 levels on average were measured.
WEBP_LEVELS = 1.0

# The same cameras written as quaternions and as matrices, with 16 digits each.
SAME_CAMERAS = 1e-9

# Fox calibrated twice, with other principal points: measured 0.14 % of the extent and 0.66 degrees on average.
FOX_CENTERS = 2.5e-3
FOX_ROTATIONS = 1.0

# Thousands of real points in float32: two depths that become equal, or a hit that crosses a threshold, change a pixel
# by more than rounding. This part of the pixels may do so: none in the scene of the test, 2 of 17,010 with 20,000.
FLIPPED_PIXELS_MAX = 1e-3

# Colours of sparse points against the pixels where they are seen, relative to shuffled ones: 0.38 to 0.65 on the real
# scenes (occluded points, one pixel against a mean over views), 0.96 to 1.02 when an axis is flipped.
COLOR_RATIO = 0.8

# Camera centres from four 512-pixel photographs against those from 1600-pixel ones, relative to their radius.
SFM_CENTERS = 0.05

# Of ray-traced photographs of 256 x 192 pixels: focal lengths (0.4 % were measured), camera centres (0.004 world units,
# at 2.5 from the scene) and the median depth of points (0.3 %).
SFM_FOCAL = 0.03
SFM_TRUE_CENTERS = 0.02
SFM_DEPTH = 0.01

# The order in which threads finish their sums; the scene is some 5 units wide.
SFM_REPEAT = 1e-6

# A PSNR of photographs in float32 against one in float64: pixels differ by 6e-8, the dB by less than this relatively.
PSNR_FLOAT32 = 1e-6

# World units, for a ring of radius 2: damping of 1e-3 moves the point nearest to all optical axes by about as much.
ORBIT_DAMPING = 0.01

# A number as printed in four digits after the point: half a unit in the last, and a little.
PRINTED_DIGITS = 6e-5

# The integral of a composited profile by adaptive quadrature (1e-12), against sums of up to 8 alternating terms that
# lose up to 8 log10(1 + 0.92) = 2.3 of 16 digits.
ALPHA_INTEGRAL = 1e-11

# Shares of 4000 draws: 4 sigma of sqrt(0.25 / 4000).
SAMPLED_SHARE = 0.032

# Frequency of one outcome in 10,000 draws, in units of its own deviation sqrt(p (1 - p)): 4 sigma of 1 / sqrt(10,000).
SAMPLE_FREQUENCY = 0.04

# Mean and covariance of 120 Gaussians, world units up to 3 (squared), by way of logarithms and eigenvectors.
MERGED_MOMENTS = 1e-12

# Largest error of a Chebyshev interpolant against the first term that it leaves out, relative: the later terms add some
# percent, and the factor 2^f by which the relative error divides is between 0.7 and 1.4.
BENCH_ROOM_FOR_EXPONENTIAL = 0.5

# The least quotient of two densities on a grid of spacing 0.025 against the true one, relative: half the curvature, 3
# at most, times the squared distance to the nearest node, 3e-4; and their integral over 4.5 standard deviations, 1e-5.
DENSITY_GRID = 1e-3

# LPIPS in float32, relative: 1e-7 of each of up to 13 layers' sums of thousands of products, which add up as a random
# walk does, and twice that for the square of a difference of unit vectors that is not small.
LPIPS_FLOAT32 = 1e-5

# Products, singular vectors and logarithms of 3 x 3 matrices with entries and inverses up to 5, in float64: measured
# 1e-14.
AFFINE_EDIT = 1e-12

# A whole image in float64 of Gaussians that were refactored: 1e-15 of footprints, through exponentials and quotients.
EDITED_IMAGE = 1e-10

# A damped chain of a few units after 40 of its slowest swings: what is left has decayed below rounding.
SETTLED = 1e-10

# The order of Verlet's error between two steps that differ by a factor of two: 2, and terms of the fourth power of the
# step, which at eight tenths of the longest stable one are 0.1 of it.
VERLET_SLOPE = 0.25

# The angle between two rotations, radians, of quaternions in float32: their components are rounded by 6e-8, and the
# angle is four times the arc sine of half a chord.
QUATERNION_FLOAT32 = 5e-7

# A half float: half a unit in the last of 11 digits.
HALF_FLOAT = 4.9e-4

# The same rotations of an SPZ by two programs, radians: the fourth component is the root of what the others leave of 1,
# in float32 there; near zero that is the root of some roundings of 6e-8.
SPZ_ROTATION = 1e-3

# A ray's peak by ``Sigma^-1``, ``c - b^2 / a``, against ``|p - t v|^2``: the former is rounded by 1e-16 of c, which is
# up to 1e5 here, the square of a distance of 6 over a thickness of 0.02.
RAY_ORDER = 1e-10

# Where Mitsuba enters an ellipsoid, by a quadratic in float32 whose constant term is the square of up to 280 standard
# deviations: measured 2.6e-3 on the two of a hundred rays that meet the thinnest one, below 1e-3 elsewhere.
MITSUBA_DEPTH = 5e-3

# A textured sheet 3e-7 thick, edge on, in float32: its direction turns within a hundredth of a pixel, and coordinates
# of up to 24 pixels are rounded by 1e-6 of one; the colour follows with a slope of up to 10 a radian.
TEXTURE_THIN_FLOAT32 = 1e-3

# Displacements of half a pixel that are read off slopes, pixels: linear in them, and photographs are bytes.
DISPLACEMENT_PX = 0.15

# A Gaussian rim summed at steps of a twentieth of a pixel, of some pixels' width: smooth, but for the hull's corners.
HULL_COVERAGE = 1e-4

# alpha on a tangent, relative: roundings of 1e-16 times distances of some ten pixels, times -2 ln(alpha / o) of 11.
TANGENT_LEVEL = 1e-12

# Where a ray meets a polygon, by its plane and by a triangle: rounded by 1e-16 over the cosine of the angle to the
# normal, the least of which is 1e-3 among some thousand hits, and over the width, a twentieth of the distance.
PLANE_DEPTH = 1e-10

# The integral of a fan's profile by a sum over a grid of spacing 0.01, relative: its rim, a jump of up to one half, is
# off by half a spacing of a reach of 2.
PROFILE_GRID = 5e-3
# The image with and without a Gaussian, in float64: the difference has the rounding of both, 1e-16 for each of a few
# hits, relative to pixels of the order of one, of which a thousand are squared and summed.
REMOVAL = 1e-10

# One image by the CUDA kernels in float32, as promised: expf has an error of 2e-7, and sums have hundreds of hits.
CUDA_FLOAT32_IMAGE = 2e-5

# Gradients by the CUDA kernels in float32, as promised, relative to the largest; measured 1.3e-6 in the simulator.
CUDA_FLOAT32_GRADIENT = 1e-4

# The depth of a plane a thousand times as large as the image: the map from image to disc has a condition of 1e4.
SURFEL_PLANE = 1e-10

# One surfel against its closed form: homogeneous planes of coordinates of order 1e2 px, whose products lose three
# digits of 1e-16, and a division by what is left.
SURFEL_HIT = 1e-9

# The same for surfels of 1e-6 and 1e-7 units, whose images are their low-pass: what the disc itself adds is left out.
SURFEL_POINT = 1e-7

# A disc of a thousand units stands for a plane, and its Gaussian falls by this within the image.
SURFEL_WIDE = 1e-4

# A light of curvature 1 within a texel, times the square of its height in radians: an eighth between two centres, and
# as much again beyond the outermost one.
ENVIRONMENT_TEXEL = 0.25

# The mean of 1,024 evenly spread samples of a smooth function: a few over their number.
SPLIT_SUM = 5e-3

# Gradients of surfels in float32, beside the 2e-5 of others: grazing hits divide by the angle, inverse depths by z^2.
SURFEL_FLOAT32_GRADIENT = 5e-4

# Parameters and moments after three iterations: Adam divides by the root of the second moment, which enlarges rounding
# where a gradient is near zero.
CUDA_TRAINING = 1e-3

# A spectrum against the brute-force Rayleigh-Sommerfeld sum, relative to the peak; measured 4e-7, from light that wraps
# around the grid and from five standard deviations of a Gaussian.
WAVE_BRUTE_FORCE = 5e-6

# Two derivations of a phase of up to 1e4 turns in float64: four of 16 digits are lost.
WAVE_PHASE = 1e-10

# Fields of Gaussians in windows of 4.5 standard deviations, whose sides have exp(-4.5^2 / 2) = 4e-5.
WAVE_WINDOW = 2e-4

# The paraxial formula of a beam: (wavelength / width)^2 = 2e-4.
WAVE_PARAXIAL = 5e-4

# Behind a screen 16 times as wide as what it hides, which is not flat there: (1 / 16)^2 / 2 of the amplitude.
WAVE_SCREEN = 4e-3

# A smooth field of amplitude 0.4 to 0.8 shown by pairs of phases through an aperture of half the band.
WAVE_ENCODING = 0.02
