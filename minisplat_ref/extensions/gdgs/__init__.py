"""GDGS: Gaussians start on local planes, are pulled to them, and are densified by regions.

This follows GDGS, 2025, arXiv 2507.00363. A network that maps noisy points of the scene to the points themselves gives
the first centres, and principal axes of the nearest neighbours give each Gaussian its plane. In one of a hundred
iterations from 5,000 on each Gaussian is pulled to the plane (m, N) of its nearest point, and its shortest axis U along
the normal (:mod:`minisplat_ref.extensions.gdgs.model`):

    L = l_d mean(((mu - m) . N - d)^2) + l_a mean(1 - |U . N|) + l_s mean(|mu - m|^2)

From 10,000 on, a grid of regions controls density: Gaussians of large gradients are cloned where a region is uneven,
and a term acts on the densest regions. The printed term is the sum of the pairs' squared distances; minimised, it pulls
them together, although it should disperse them. Here ``contraction`` is that term, of weight 0, and ``dispersion`` a
repulsive one, ``sum exp(-|x_i - x_j|^2 / 2 h^2)``, which disperses them as intended.

    minisplat-ref train SCENE --recipe gdgs
    minisplat-ref train SCENE --recipe gdgs --set dispersion=0 --set contraction=0.001
    python -m data_tools.claims gdgs/sphere
    python -m data_tools.claims gdgs/counts SCENE --out DIR
    minisplat-ref oracle gradients --extension gdgs

``docs/family/gdgs.md`` has the measured figures.

This deviates from the paper as follows. The surface is that of local planes of 12 points instead of a mesh. The paper
gives neither the weights nor the size of regions: the weights, and 5 regions along the longest side, are ours, and no
photographs were used to choose them. The predictor, trained on the points alone, moves more than half of them by more
than the distance of two neighbours. Of a region with more than 2,048 Gaussians a part is dispersed. Until 10,000
Gaussians are densified as in 3DGS, and from then on only cloned. The sum over neighbours is over their mean, which has
the same gradient up to a factor. Losses act every 100 iterations of a training of any length. Left out is the pruning
by regions, of which we know no rule.
"""

from minisplat_ref.extensions.extension import Extension
from minisplat_ref.extensions.gdgs.recipe import GDGS, SURFACED

EXTENSION = Extension("gdgs", recipes=(GDGS,), representation=SURFACED)
