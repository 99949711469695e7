"""Pixel order: footprints on tangent planes, each pixel in the order of its own ray.

3DGS renders with two approximations that become visible when a camera turns. It sorts Gaussians by the camera z of
their means, the same for all pixels, so that one pops in front of another in a whole image at once; and it expands the
perspective map on the image plane, which stretches footprints at the edges. This extension replaces both in a renderer
that also trains:

- *Order* (StopThePop, Radl et al. 2024, arXiv 2402.00525). A pixel sorts its hits by where on its ray each Gaussian is
  densest, ``t = d^T C^-1 x / (d^T C^-1 d)``: exactly, or within a buffer of k hits (``--set buffer_size=8``), which is
  exact if k is at least the number of hits.
- *Projection* (Optimal Projection, Huang et al. 2024, arXiv 2402.00752). A footprint lies on the plane that touches the
  unit sphere in the direction of its mean (:mod:`minisplat_ref.mechanisms.tangent.planes`).

Both depend on rays alone, and so do culling by distance and the low-pass, so a camera that turns sees the same colours
up to rounding. Sorting does not remove every jump: where two Gaussians interpenetrate, two hits of a pixel change
places as the camera *moves*, pixel by pixel instead of all at once. ``claims pixel-order/rotation`` measures both, and
``docs/family/pixel-order.md`` has the figures.

This deviates from StopThePop, which sorts in a hierarchy of queues for tiles, blocks and pixels; here each pixel has
one queue over a list by distance. Its minimum thickness of 0.001 world units is a thousandth of the longest axis here.
As there, the order has no derivative. Statistics of blending, surfaces and median depths are those of 3DGS's
footprints.

    minisplat-ref train SCENE --recipe pixel-order
    minisplat-ref train SCENE --recipe pixel-order --set buffer_size=8
    python -m data_tools.claims pixel-order/order --out DIR
    minisplat-ref bench --extension pixel-order
    minisplat-ref oracle gradients --extension pixel-order
"""

from minisplat_ref.extensions.extension import Extension
from minisplat_ref.extensions.pixel_order.model import ORDERED, PIXEL_ORDER, stages

EXTENSION = Extension(
    "pixel-order",
    recipes=(PIXEL_ORDER,),
    representation=ORDERED,
    stages=stages,
)
