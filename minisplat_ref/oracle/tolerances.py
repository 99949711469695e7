"""Every tolerance of the oracle, with its reason. Relative ones are relative to the largest value compared."""

# Gradients against sixth-order differences in float64: rounding 1e-16 / 1e-4 of values up to 100, truncation below it.
GRADIENT_REL = 1e-8

# Where a threshold is so near that only a step of 1e-8 stays on its side: rounding 1e-16 / 1e-8 on values up to 100.
GRADIENT_REL_NEAR_THRESHOLD = 1e-6

# A block of a Jacobian or a gradient below this is vacuous or meant to be zero: real ones here are 1e-4 to 1e3.
GRADIENT_FLOOR = 1e-6

# Alpha must cover this part of an image before a check on it says anything.
COVERAGE_MIN = 0.05
