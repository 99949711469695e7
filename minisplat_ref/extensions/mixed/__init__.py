"""Mixed: ellipses, lines and triangles by one formula, the distance to a hull.

This follows MP-GS, arXiv 2507.11321. A Gaussian is an ellipse in the image. A line has two vertices with one
covariance, a triangle three; one formula renders them all (:mod:`minisplat_ref.extensions.mixed.response`):

    alpha = o exp(-dist(y, conv{y_1 .. y_m})^2 / 2),   y = L^-1 x,  L L^T = Sigma_2

The paper puts it together from ellipses around the vertices, their common tangents and quadrilaterals between them;
the level sets are the same. With one vertex it is 3DGS. Vertices lie in the plane of a Gaussian's first two axes
(:mod:`minisplat_ref.extensions.mixed.projection`), and are two further numbers each. A training begins with groups of
near points of like colour (:mod:`minisplat_ref.extensions.mixed.population`); during it, hulls lose vertices that make
no difference, and needles and discs get some (:mod:`minisplat_ref.extensions.mixed.kinds`).

    minisplat-ref train SCENE --recipe mixed
    minisplat-ref study mixed/shapes --out DIR
    minisplat-ref study mixed/letter --out DIR
    minisplat-ref study mixed/scene SCENE room --iterations 300 --out DIR
    minisplat-ref oracle gradients --extension mixed

:mod:`minisplat_ref.extensions.mixed.fit` fits an image with a few primitives of one kind. ``docs/FAMILY.md`` has the
measured figures.

This deviates from the paper as follows. A hull is placed by the mean of its vertices, where the paper counts from the
first; what makes a triangle a line is its altitude instead of Pearson's correlation, which depends on the axes; changes
to more vertices are not the paper's. It trains by 3DGS's losses, not by those of surfels, and makes no mesh. A child of
a split keeps its parent's vertices, as in the paper, and size limits look at deviations alone.
"""

from minisplat_ref.extensions.extension import Extension
from minisplat_ref.extensions.mixed.method import MIXED, MIXED_GAUSSIANS
from minisplat_ref.extensions.mixed.scene_study import SCENE
from minisplat_ref.extensions.mixed.stages import of_all_kinds, stages
from minisplat_ref.extensions.mixed.study import LETTER, SHAPES

EXTENSION = Extension(
    "mixed",
    recipes=(MIXED,),
    representation=MIXED_GAUSSIANS,
    stages=stages,
    sample=of_all_kinds,
    studies=(SHAPES, LETTER, SCENE),
)
