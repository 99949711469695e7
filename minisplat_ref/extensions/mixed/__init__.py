"""Mixed: ellipses, lines and triangles in one model, by the distance to the hull of their vertices.

MP-GS, arXiv 2507.11321.
"""

from minisplat_ref.extensions.extension import Extension
from minisplat_ref.extensions.mixed.method import MIXED, MIXED_GAUSSIANS
from minisplat_ref.extensions.mixed.scene_study import SCENE
from minisplat_ref.extensions.mixed.stages import stages
from minisplat_ref.extensions.mixed.study import LETTER, SHAPES

EXTENSION = Extension(
    "mixed", recipes=(MIXED,), representation=MIXED_GAUSSIANS, stages=stages, studies=(SHAPES, LETTER, SCENE)
)
