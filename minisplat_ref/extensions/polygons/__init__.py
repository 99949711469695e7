"""Flat Gaussians carried by polygons: traced by rays, edited as a mesh, carried back.

This follows REdiSplats, Byrski et al. 2025, arXiv 2503.12284. A flat Gaussian with the axes e_a, e_b and the standard
deviations s_a, s_b lies in a regular polygon of n = 8 sides (``mechanisms.meshes.fans``), whose radius depends on the
opacity o:

    x_j = mu + r (s_a cos phi_j e_a + s_b sin phi_j e_b),   phi_j = 2 pi j / n,   r^2 = max(0, 11.3449 + 2 ln o)

The ray of each pixel takes alpha where it hits the polygon:

    alpha = min(alpha_max, o exp(-(u^2 + v^2) / 2))      (u, v): the place in the plane, in standard deviations

Each ray blends its own hits in the order of their depths, with the weights of 3DGS. The loops are those of ``rays``
(``mechanisms.rays.tile_kernels``), with a polygon instead of an ellipsoid
(:mod:`.ray_kernels`, in NumPy :mod:`.model`). An edited polygon may be bent, and then a ray hits the triangles
between its centre and two neighbouring corners (:mod:`.kernels`); of a flat one, both give the same hits.

A mesh tool edits the polygons, and the Gaussians follow (:mod:`.soup`). The corners of an edited polygon are fitted by
spans, whose ellipse is the Gaussian. Every affine edit is carried exactly.

This deviates from the paper, which recovers a Gaussian from three vertices by Gram-Schmidt and so loses shear; here all
corners are fitted, and ``claims polygons/edits`` measures the paper's way, too. A ray has any number of hits,
sorted exactly. The thickness is 1e-5 where training starts and has no effect on an image; it keeps its ratio under an
edit. A Gaussian is flattened along whichever axis is its thinnest. Training starts from balls, whose planes are chosen
at random; its loss and schedule are those of 3DGS. Hits of alpha below ``alpha_min`` = 1/255 do not count.

The edge of a polygon has no gradient; it cuts less than 0.008 of alpha. There is no low-pass: Gaussians thinner than a
pixel fall between rays. A polygon in a plane with the camera is not seen. Of polygons that lie in one
plane, copies are taken in the order of their rows, and others in the order in which rounding puts their depths.

``docs/family/polygons.md`` has the measured figures.

    minisplat-ref train SCENE --recipe polygons
    minisplat-ref polygons export runs/fox --out soup.ply
    minisplat-ref polygons edit runs/fox soup.ply --out edited.ply
    python -m data_tools.claims polygons/edits --out DIR
    python -m data_tools.claims polygons/cost
    minisplat-ref oracle gradients --extension polygons
"""

from minisplat_ref.extensions.extension import Extension
from minisplat_ref.extensions.polygons import commands
from minisplat_ref.extensions.polygons.model import POLYGONS, TRACED, stages

EXTENSION = Extension(
    "polygons",
    recipes=(POLYGONS,),
    representation=TRACED,
    commands=(commands,),
    stages=stages,
)
"""Flat Gaussians in polygons, the recipe that trains them, two commands that edit them."""
