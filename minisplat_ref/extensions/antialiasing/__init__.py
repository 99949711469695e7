"""Anti-aliasing: filters in space and image, for views from nearer and from farther.

This is Mip-Splatting, Yu et al. 2023, arXiv 2311.16493. 3DGS adds 0.3 px^2 to every footprint and leaves the opacity as
it is. At the size of training that is harmless, since training compensates for it; seen from farther away everything
swells and brightens, and from nearer it thins out, down to needles. Two filters replace this dilation:

- one in space (:mod:`minisplat_ref.extensions.antialiasing.model`), once for all views:
  ``s'^2 = s^2 + 0.2 nu^2`` and ``o' = o prod_j s_j / s'_j``, where nu is the minimum distance ``z / f`` between two
  pixels' rays over the training views that see the Gaussian. So nothing is thinner than the cameras could resolve;
- one in the image, ``C' = C + 0.1 I`` and ``o'' = o' sqrt(det C / det C')``. This is the core's own compensation with
  Mip-Splatting's variance (:mod:`minisplat_ref.reference.antialiasing`).

The standard deviation of the spatial filter is a further field, ``filter_sigmas``, and a column of the PLY. An event
measures it at the first iteration and then every 100 iterations. A filter of 0 renders the Gaussians as they are,
bit for bit.

Resets lower the opacities that are seen through the filter in space. The filter is measured from centres in front of a
camera's image and 15 % around it, as in the released code, and a new Gaussian has its parent's filter until it is
measured. A recipe of the core that is trained with
``--extension antialiasing`` has the filter in the image alone. The alternative to filters, the integral of a Gaussian
over a pixel, is the extension ``analytic``; ``docs/family/`` has the figures of both.

A viewer of 3DGS has neither filter. ``fuse`` (:mod:`minisplat_ref.extensions.antialiasing.fuse`) writes s' and o'
instead of s and o, a PLY of six fields.

    minisplat-ref train SCENE --recipe antialiasing --out runs/fine
    minisplat-ref antialiasing fuse runs/fine fine.ply
    python -m data_tools.claims antialiasing/zoom SCENE --out DIR
    minisplat-ref oracle gradients --extension antialiasing
"""

from minisplat_ref.extensions.antialiasing import fuse
from minisplat_ref.extensions.antialiasing.model import ANTIALIASING, FILTERED
from minisplat_ref.extensions.extension import Extension

EXTENSION = Extension("antialiasing", recipes=(ANTIALIASING,), representation=FILTERED, commands=(fuse,))
