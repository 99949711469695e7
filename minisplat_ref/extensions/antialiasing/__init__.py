"""Anti-aliasing: filters in space and image, for views from nearer and from farther.

Mip-Splatting, Yu et al. 2023, arXiv 2311.16493. 3DGS adds 0.3 px^2 to every footprint and leaves the opacity as it is.
Trained at one size that is harmless, since training makes up for it; from farther everything swells and brightens,
from nearer it thins out, down to needles. Two filters take its place:

- in space (:mod:`minisplat_ref.extensions.antialiasing.reference`), once for all views: with nu the least distance
  ``z / f`` between two pixels' rays, over the training views that see the Gaussian,
  ``s'^2 = s^2 + 0.2 nu^2`` and ``o' = o prod_j s_j / s'_j``. So nothing is thinner than what was seen;
- in the image, ``C' = C + 0.1 I`` and ``o'' = o' sqrt(det C / det C')``: the core's own compensation, with Mip-
  Splatting's variance (:mod:`minisplat_ref.reference.antialiasing`).

The filter's deviation is a further field, ``filter_sigmas``, and a column of the PLY. An event measures it at the first
iteration, and then every 100 iterations. A filter of 0 draws the Gaussians as they are, bit for bit.

Measured on the fox, trained at 33 x 60 for 1000 iterations and drawn at other sizes (``study antialiasing/zoom``): at
an eighth of the size 25.4 dB against 14.5 dB of ``3dgs-accel``, at eight times 24.8 against 19.2, and as good at the
size of training. Integrals over pixels (``analytic``) are as good from farther and better from nearer, 25.5 dB, and at
the size of training by 1.3 dB.

Where this deviates: the filter is measured from centres in front of a camera's image and 15 % around it, as in the
released code, and a new Gaussian has its parent's until it is measured. A recipe of the core that is trained with
``--extension antialiasing`` has the filter in the image alone. The alternative to filters, the integral of a
Gaussian over a pixel, is the extension ``analytic``.

    minisplat-ref train SCENE --recipe antialiasing
    minisplat-ref study antialiasing/zoom SCENE --out DIR
    minisplat-ref oracle gradients --extension antialiasing
"""

from minisplat_ref.extensions.antialiasing.method import ANTIALIASING, FILTERED
from minisplat_ref.extensions.antialiasing.study import ZOOM
from minisplat_ref.extensions.extension import Extension

EXTENSION = Extension("antialiasing", recipes=(ANTIALIASING,), representation=FILTERED, studies=(ZOOM,))
