"""What the geometric terms are set by: shared by the reference and the kernels, which do not see each other."""

from typing import NamedTuple

EDGE_SHARPNESS = 10.0  # neighbours that differ by 0.1, 25 of 255 levels, count e times less than equal ones
# Depth ratios within 1 % count as noise. The covariances of the points of four photographed scenes say 0.1 to 0.2 % for
# the median observation and 0.2 to 0.7 % for the 90th percentile; wrong matches and silhouettes are off by far more.
SFM_DEPTH_TOLERANCE = 0.01


class GeometricWeights(NamedTuple):
    """Factors of the geometric loss terms, beside the photometric loss; 0 leaves a term out."""

    sfm_depth: float = 0.0
    """Of the depth error at the points of structure from motion."""
    depth_smoothness: float = 0.0
    """Of the relative depth steps between neighbouring pixels."""
    normal_smoothness: float = 0.0
    """Of the turns of the surface between neighbouring pixels."""
