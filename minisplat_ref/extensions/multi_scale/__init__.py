"""Multi-scale: coarse Gaussians for small images, chosen by pixel coverage.

This follows Multi-Scale 3D Gaussian Splatting, Yan et al. 2023, arXiv 2311.17089. In a small image most Gaussians of
a scene are smaller than a pixel. 3DGS widens each to about one, so that they cover too much, and as many are sorted as
for a large image. Here a scene has several levels, and a view renders at each place the one that suits it:

- *Levels* (:mod:`minisplat_ref.extensions.multi_scale.model`). For images of 1/F^l of the size, the Gaussians that
  would cover fewer than four pixels, ``S = 2 sqrt(2 ln(255 o)) s f / z``, are sorted into cubes as large as a pixel
  there, and each cube becomes one Gaussian with the moments of its members that stops as much light.
- *Selection* (:mod:`minisplat_ref.extensions.multi_scale.model`). A Gaussian is rendered where its own cube
  covers less than a pixel and its parent's at least one: ``w f / z < 1 <= w' f / z``.
- *Training.* After densification the levels are inserted, for images of 1/4, 1/16 and 1/64 of the size; in every
  fourth iteration a smaller image joins the loss, with the weight 0.1.

The sides w and w' are a further field, ``cells``, and columns of the PLY. A population of level 0 alone is 3DGS, bit
for bit.

``docs/family/multi-scale.md`` has the measured figures.

This deviates from the paper, which drops every Gaussian by its own coverage, within bounds that follow the training;
there the members of a cube disappear at other distances than their parent appears, and training has to compensate for
that. Here the coverage of a Gaussian decides whether it is merged, and the coverage of its cube decides when its parent
replaces it. Averages are moments, voxels are octaves of the finest sampling instead of contracted coordinates, the
coarse loss is added to the fine one, and levels alternate. The bounds do not change during training, since cells do
not.

    minisplat-ref train SCENE --recipe multi-scale
    minisplat-ref multi-scale build runs/SCENE/point_cloud.ply --out levels.ply
    minisplat-ref render levels.ply
    python -m data_tools.claims multi-scale/downscale SCENE --out DIR
"""

from minisplat_ref.extensions.extension import Extension
from minisplat_ref.extensions.multi_scale import build
from minisplat_ref.extensions.multi_scale.model import LEVELS
from minisplat_ref.extensions.multi_scale.recipe import MULTI_SCALE

EXTENSION = Extension("multi-scale", recipes=(MULTI_SCALE,), representation=LEVELS, commands=(build,))
