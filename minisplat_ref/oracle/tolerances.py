"""Every tolerance of the oracle, with its reason. Relative ones are relative to the largest value compared."""

# Gradients against sixth-order differences in float64: rounding 1e-16 / 1e-4 of values up to 100, truncation below it.
GRADIENT_REL = 1e-8

# Where a threshold is so near that only a step of 1e-8 stays on its side: rounding 1e-16 / 1e-8 on values up to 100.
GRADIENT_REL_NEAR_THRESHOLD = 1e-6

# A block of a Jacobian or a gradient below this is vacuous or meant to be zero: real ones here are 1e-4 to 1e3.
GRADIENT_FLOOR = 1e-6

# gsplat's torch functions in float64, with a stage's input in common: 1e-16 times condition numbers up to 1e3.
PEER_REL = 1e-9

# Against 50 digits, divided by the condition number: a few dozen roundings of 1e-16 ...
TRUTH_FLOAT64 = 1e-13
# ... and of 6e-8, with a polynomial exponential of 1e-7.
TRUTH_FLOAT32 = 2e-6

# Alpha must cover this part of an image before a check on it says anything.
COVERAGE_MIN = 0.05

# A stage of another float64 renderer, fed with the same input: 1e-16 times conditions up to 1e4, in sums of thousands
# of terms. Wrong formulas are off by 1e-4 and more.
COMPARE_FLOAT64 = 1e-9

# The same in float32, fed with the input rounded or with its own of the stage before: a few roundings of 6e-8 ...
COMPARE_FLOAT32_POSITION = 2e-6
# ... divided by the determinant of a covariance whose condition number is up to 1e2 ...
COMPARE_FLOAT32_SHAPE = 2e-5
# ... through an exponential of relative error 1e-7 to 1e-6, hundreds of times in a pixel ...
COMPARE_FLOAT32_IMAGE = 2e-5
# ... relative to windowed variances, differences of means, which count beside C2 = 9e-4 ...
COMPARE_FLOAT32_LOSS = 5e-5
# ... and in sums of either sign over pixels, divided by 1 - alpha >= 0.01.
COMPARE_FLOAT32_GRADIENT = 1e-4

# A hit whose alpha is so near to alpha_min, absolutely, may be skipped by one renderer and blended by another: float32
# gives alpha an error of 1e-7 of its value near 4e-3, and 1e-6 px of the centre moves it by less than 1e-6.
FLIP_ALPHA = 1e-6
# The same as a part of 1/255; the transmittance is held against its stop threshold with this relative margin.
FLIP_RELATIVE = 255 * FLIP_ALPHA

# What float32 promises of an image where no hit falls on the other side of a threshold: hundreds of hits, each with an
# exponential of 1e-7 relative error at a distance that has lost digits to a coordinate of some hundred pixels.
BENCH_FLOAT32_IMAGE = 2e-5
# The same of every parameter's gradient, relative L2, without the pixels that stand at a threshold.
BENCH_FLOAT32_GRADIENT = 1e-4
# Part of the pixels in which a hit may fall on the other side of a threshold in float32: none to 1e-4 on random scenes.
BENCH_FLIPPED_PIXELS = 1e-3
# The loss of a made room before any training, float32 against float32: its points lie on walls, many at one depth, and
# each renderer rounds them into another order. A pixel changes by up to 7e-3, one in five does; their mean by 4e-5.
BENCH_FLOAT32_LOSS = 1e-4
# float64 kernels against the reference: another order of sums of up to thousands of terms of 1e-16 each.
BENCH_FLOAT64 = 1e-11
# Gradient of a polynomial exponential, in units of its relative error: behind / (1 - alpha) multiplies it.
BENCH_EXPONENTIAL_GRADIENT = 10.0

# Depths that differ by less, relatively, may be sorted either way: three products and sums of 6e-8 each in float32.
FLIP_DEPTH = 5e-7
# An alpha so near to its clamp may be clamped or not; the image does not notice, the gradient does.
FLIP_CLAMP = 1e-5
