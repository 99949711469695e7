"""Ray tracing of Gaussians through a tree of boxes.

RaySplats, Byrski et al. 2025, arXiv 2501.19196.

TO BE WRITTEN

    minisplat-ref train SCENE --recipe rays
"""

from minisplat_ref.extensions.extension import Extension
from minisplat_ref.extensions.rays.method import RAYS, TRACED
from minisplat_ref.extensions.rays.stages import stages

EXTENSION = Extension("rays", recipes=(RAYS,), representation=TRACED, stages=stages)
