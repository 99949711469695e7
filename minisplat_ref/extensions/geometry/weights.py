"""Settings of the geometric terms, shared by the reference and the kernels, which do not import each other."""

from typing import NamedTuple

EDGE_SHARPNESS = 10.0  # neighbours that differ by 0.1, 25 of 255 levels, count e times less than equal ones
# Depth ratios within 1 % count as noise. The covariances of the points of four photographed scenes give 0.1 to 0.2 %
# for the median observation and 0.2 to 0.7 % for the 90th percentile; wrong matches and silhouettes err far more.
SFM_DEPTH_TOLERANCE = 0.01


class GeometricWeights(NamedTuple):
    """Factors of the geometric loss terms; 0 omits a term."""

    sfm_depth: float = 0.0
    """Weight of the depth error at the points of structure from motion."""
    depth_smoothness: float = 0.0
    """Weight of the relative depth steps between neighbouring pixels."""
    normal_smoothness: float = 0.0
    """Weight of the differences between neighbouring normals."""
