"""Surfels: 2D Gaussian Splatting, Huang et al. 2024, arXiv 2403.17888."""

from minisplat_ref.extensions.extension import Extension
from minisplat_ref.extensions.surfels.method import DISCS, RECIPE
from minisplat_ref.extensions.surfels.stages import stages

EXTENSION = Extension("surfels", recipes=(RECIPE,), representation=DISCS, stages=stages)
