"""Mixed: ellipses, lines and triangles by one formula, the distance to a hull.

This follows MP-GS, arXiv 2507.11321. A Gaussian is an ellipse in the image. A line has two vertices with one
covariance, a triangle three; one formula renders them all (:mod:`.response`):

    alpha = o exp(-dist(y, conv{y_1 .. y_m})^2 / 2),   y = L^-1 x,  L L^T = Sigma_2

The paper puts it together from ellipses around the vertices, their common tangents and quadrilaterals between them; the
level sets are the same. With one vertex it is 3DGS. Vertices lie in the plane of a Gaussian's first two axes
(:mod:`.projection`), and are two further numbers each. A training begins with groups of near points of like colour;
during it, hulls lose vertices that make no difference, and needles and discs get some (:mod:`.population`).

It reconstructs surfaces, so the recipe has the losses of 2D Gaussian Splatting at that paper's weights and dates
(:mod:`minisplat_ref.mechanisms.surfels.losses`). A pixel's depth and normal come from the primitive's plane
(:mod:`.projection`), and ``mesh`` fuses the depths of all views:

    normal_consistency   0.05, from iteration 7,000: planes face as the surface through the depths does
    distortion           0, from 3,000: the hits of a ray lie at one depth

    minisplat-ref train SCENE --recipe mixed --out runs/mixed
    minisplat-ref train SCENE --recipe mixed --set distortion=100
    minisplat-ref mesh runs/mixed --out mesh.ply
    python -m data_tools.claims mesh room --recipes mixed,mixed+normal_consistency=0 --out DIR
    python -m data_tools.claims mixed/shapes --out DIR
    python -m data_tools.claims mixed/letter --out DIR
    python -m data_tools.claims mixed/scene SCENE room --iterations 300 --out DIR
    minisplat-ref oracle gradients --extension mixed

:mod:`data_tools.claims.mixed.fit` fits an image with a few primitives of one kind. ``docs/family/mixed.md`` has the
measured figures.

Built of the paper: the three primitives and their response, groups of points at the start, the loss of vertices, the
losses, meshes. Left out: the construction by tangents, which a test follows, and normals from median depths, since
the median has no gradient here. The paper's own weights of the losses are not known to us: they are those of 2DGS.

This deviates from the paper as follows. A hull is placed by the mean of its vertices, where the paper counts from the
first; a triangle becomes a line by its altitude instead of Pearson's correlation, which depends on the axes; changes
to more vertices are not the paper's. Primitives are as thick as training makes them, where surfels are flat; so a depth
is that of the best plane through a primitive, which for a flat one is its own. A child of a split keeps its parent's
vertices, as in the paper, and size limits consider deviations alone.
"""

from minisplat_ref.extensions.extension import Extension
from minisplat_ref.extensions.mixed.model import MIXED, MIXED_GAUSSIANS, mix_kinds, stages

EXTENSION = Extension(
    "mixed",
    recipes=(MIXED,),
    representation=MIXED_GAUSSIANS,
    stages=stages,
    sample=mix_kinds,
)
