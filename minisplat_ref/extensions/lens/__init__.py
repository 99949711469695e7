"""Lens: photographs as they were taken, through distorting lenses and fisheyes.

3DGS renders through a pinhole, so photographs of other lenses are warped first, which crops their borders, and of a
wide fisheye most of the image. This extension follows 3DGUT (Wu et al. 2025, arXiv 2412.12507) and renders through the
lens itself. It takes three ideas from it:

- *Response*. A pixel meets a 3D Gaussian along its own true ray, ``alpha = o exp(-p . p / 2)`` with the ray's least
  distance p in standard deviations (:mod:`minisplat_ref.mechanisms.cameras.ray_footprints`). Footprints are exact for
  any lens; kernels only see its table of rays (:mod:`minisplat_ref.mechanisms.cameras`).
- *Bounds*. Seven sigma points of a Gaussian, projected by the lens, give mean and covariance of its bounds (unscented
  transform, alpha 0.1, beta 2, kappa 0).
- *Order*. By the depths of the means: camera z, and for a fisheye the distance, since z ends at 90 degrees.

Scenes of COLMAP's SIMPLE_RADIAL, RADIAL, OPENCV, FULL_OPENCV, OPENCV_FISHEYE, SIMPLE_RADIAL_FISHEYE and RADIAL_FISHEYE
are read as photographed. Where a lens has no distortion, images are those of the exact rays of a pinhole.

This deviates from 3DGUT as follows: a Gaussian of which a sigma point is not seen gets the whole image as its bounds,
and a ray meets only Gaussians in front of it. Left out are rolling shutter, thin prisms, secondary rays, the exact
order of each pixel, derivatives with respect to the lens, and recipes that search surfaces (``adaptive``, the
``mini-splatting`` family), which refuse such cameras. There is no low-pass, so a Gaussian much thinner than a
pixel may be missed by all rays.

    minisplat-ref train SCENE --recipe lens
    minisplat-ref train SCENE --extension lens --recipe 3dgs
    python -m data_tools.claims lens/footprints --out DIR
    python -m data_tools.claims lens/fisheye --out DIR
    minisplat-ref oracle gradients --extension lens
"""

from minisplat_ref.extensions.extension import Extension
from minisplat_ref.extensions.lens.model import LENS, THROUGH_LENS, stages

EXTENSION = Extension("lens", recipes=(LENS,), representation=THROUGH_LENS, stages=stages)
