"""One Gaussian or one pixel: the stages as scalar formulas, inlined into the kernels of ``cpu``."""
