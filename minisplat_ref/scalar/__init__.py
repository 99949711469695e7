"""One Gaussian or one pixel: the stages as scalar formulas, inlined into the kernels of ``cpu``."""

from minisplat_ref.scalar import _lanes_arithmetic, _lanes_memory  # noqa: F401  (they give lanes their compiled meaning)
