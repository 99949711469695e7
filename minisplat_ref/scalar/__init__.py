"""The stages as scalar formulas for one Gaussian or one pixel, inlined into the kernels of ``cpu``."""
