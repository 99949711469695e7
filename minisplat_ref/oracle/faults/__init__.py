"""Planted errors with a size, which reports compare a renderer with.

:mod:`minisplat_ref.oracle.planted` has errors that the oracle must find; these are the ones that it must tell apart.
Each changes one formula of a backend, and is planted wherever that formula can be wrong: a pixel's centre in the
projection and in the blending. Most have a size, such as the factor by which a gradient is off, which a report fits to
the renderer's own arrays (:mod:`minisplat_ref.oracle.comparison.hints`).
"""

from minisplat_ref.oracle.faults.fault import Fault
from minisplat_ref.oracle.faults.gradients import GRADIENTS
from minisplat_ref.oracle.faults.images import BLENDING
from minisplat_ref.oracle.faults.primitives import COLORS, PROJECTION

__all__ = ["FAULTS", "Fault"]

FAULTS = PROJECTION + COLORS + BLENDING + GRADIENTS
"""In the order of the pipeline, forward before backward."""
