"""Mixed: ellipses, lines and triangles by one formula, the distance to a hull.

MP-GS, arXiv 2507.11321. A Gaussian is an ellipse in the image. A line has two vertices with one covariance, a triangle
three; one formula draws them all (:mod:`minisplat_ref.extensions.mixed.response`):

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

:mod:`minisplat_ref.extensions.mixed.fit` draws a picture with a few primitives of one kind.

Measured, the better of two seeds (``--seeds 2``). One line is matched at 30 dB by 3 ellipses, one triangle with a soft
rim by 12; one of their own kind reaches 57.9 and 68.4 dB. Of a round Gaussian vertices are of no use. A letter A in
some 200 numbers: 14 ellipses 22.4 dB, 12 lines 25.9, 11 triangles 31.4; a ring, whose curve no line follows: 20.0, 20.0
and 22.2 dB. Random starts matter: the letter's means lie up to 6.5 dB below. Scenes with as many numbers as 3DGS, none
densified, 300 iterations: the room 22.73 ± 0.04 dB against 21.60 ± 0.06, as good as 3DGS with all points and half more
numbers; the fox at a quarter 25.41 ± 0.15 against 25.31 ± 0.27, no difference: four fifths of its groups are points.

Where this deviates: a hull is placed by the mean of its vertices, where the paper counts from the first; what makes a
triangle a line is its altitude instead of Pearson's correlation, which depends on the axes; changes to more vertices
are not the paper's. It trains by 3DGS's losses, not by those of surfels, and makes no mesh. A child of a split keeps
its parent's vertices, as in the paper, and size limits look at deviations alone.
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
