"""Pixel order: footprints on tangent planes, each pixel in the order of its own ray.

3DGS draws with two approximations that become visible when a camera turns. It sorts Gaussians by the camera z of their
means, the same for all pixels, so that one pops in front of another in a whole picture at once; and it expands the
perspective map on the image plane, which stretches footprints at the edges. This extension replaces both in a renderer
that also trains:

- *Order* (StopThePop, Radl et al. 2024, arXiv 2402.00525). A pixel sorts its hits by where on its ray each Gaussian is
  densest, ``t = d^T C^-1 x / (d^T C^-1 d)``: exactly, or within a buffer of k hits (``--set buffer_size=8``), which is
  exact if k is at least the number of hits.
- *Projection* (Optimal Projection, Huang et al. 2024, arXiv 2402.00752). A footprint lies on the plane that touches the
  unit sphere in the direction of its mean (:mod:`minisplat_ref.mechanisms.tangent.planes`).

Both depend on rays alone, and so do culling by distance and the low-pass, so a camera that turns sees the same colours
up to rounding. When the camera turns by half a degree, fixed rays through 100 random Gaussians change by up to 0.11
under 3DGS and by 3e-15 here (``study pixel-order/rotation``). Compared with the peak along each ray, the error of a
footprint is 10.5 % at any angle; that of EWA is 10.5 % on the axis and 27.6 % at 55 degrees
(``study pixel-order/projection``). Of the pairs of hits of a pixel, 3DGS blends 10.9 % out of order, a buffer of 4
hits 2.5 %, and one of 16 hits 0.03 % (``study pixel-order/order``, 300 random Gaussians).

Sorting does not remove every jump. Where two Gaussians interpenetrate, two hits of a pixel change places as the camera
*moves*, pixel by pixel instead of all at once. With the same Gaussians a ray still changes by 0.13 when the camera
moves 0.001 sideways, and by 0.005 under 3DGS, whose order such a move does not change.

This deviates from StopThePop, which sorts in a hierarchy of queues for tiles, blocks and pixels; here each pixel has
one queue over a list by distance. Its least thickness of 0.001 world units is a thousandth of the longest axis here. As
there, the order has no derivative. Statistics of blending, surfaces and median depths are those of 3DGS's footprints.

    minisplat-ref train SCENE --recipe pixel-order
    minisplat-ref train SCENE --recipe pixel-order --set buffer_size=8
    minisplat-ref study pixel-order/order --out DIR
    minisplat-ref bench --extension pixel-order
    minisplat-ref oracle gradients --extension pixel-order
"""

from minisplat_ref.extensions.extension import Extension
from minisplat_ref.extensions.pixel_order.method import ORDERED, PIXEL_ORDER
from minisplat_ref.extensions.pixel_order.stages import stages
from minisplat_ref.extensions.pixel_order.study import ORDER, PROJECTION, ROTATION

EXTENSION = Extension(
    "pixel-order",
    recipes=(PIXEL_ORDER,),
    representation=ORDERED,
    stages=stages,
    studies=(ROTATION, PROJECTION, ORDER),
)
