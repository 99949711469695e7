"""Geometric losses: the depth of the sparse points, smooth depth, smooth normals.

Three terms join the loss of any recipe, ``train SCENE --extension geometry --set sfm_depth=0.1``; each has the weight 0
until it is set:

- ``sfm_depth`` is the Huber loss of the relative depth error at the points that structure from motion found in the view
  (after DS-NeRF, Deng et al. 2022);
- ``depth_smoothness`` penalises relative depth steps between neighbouring pixels, less where the photograph has an edge
  (after Godard et al. 2017);
- ``normal_smoothness`` penalises differences of neighbouring normals of the depth map (after 2D Gaussian Splatting,
  Huang et al. 2024).

All are functions of the expected depth ``sum w z / alpha``, so their gradient goes to the depth channel and to alpha.

    minisplat-ref train SCENE --extension geometry --set sfm_depth=0.1
    python -m data_tools.claims geometry/depth room --out DIR
    minisplat-ref oracle gradients --extension geometry

``docs/family/geometry.md`` has the measured figures.
"""

from minisplat_ref.extensions.extension import Extension
from minisplat_ref.extensions.geometry.losses import LOSSES, stages

EXTENSION = Extension("geometry", losses=LOSSES, stages=stages)
