"""3DGS as Markov chain Monte Carlo: Gaussians move by noise and are relocated, never reset.

This follows Kheradmand et al. 2024, arXiv 2404.09591, with the dates and constants of the released code. Four things
take the place of cloning, splitting, pruning and the reset of opacities:

- *Noise*, equations (7) and (8). After each step of Adam with the rate l,
  ``mu += l a sigmoid(k ((1 - o) - x0)) Sigma e``, e normal, ``a = 5e5``, ``k = 100``, ``x0 = 0.995``: a Gaussian that
  is nearly transparent explores along its own axes, one that is opaque stays.
- *Relocation*, equation (9). Every 100 iterations from 600 to 24,900, a Gaussian of opacity 0.005 or less becomes a
  copy of another one, drawn by opacity. The N Gaussians that are then in one place get the opacity and the scales ::

      o' = 1 - (1 - o)^(1/N),    s' = s o / sum_{m=1}^N C(N, m) (-1)^(m+1) o'^m / sqrt(m)

  so that together they have the opacity o at their centre, and on each line through it the same integral: for
  ``g = exp(-x^2 / 2)``, ``1 - (1 - o' g)^N = sum_m C(N, m) (-1)^(m+1) o'^m g^m``, and the integral of g^m is
  ``sqrt(2 pi / m)``. The paper and its kernel have the same sum as a double one, over i from 1 to N and k < i, of
  ``C(i-1, k) (-1)^k o'^(k+1) / sqrt(k+1)``.
- *Growth*. After each relocation there are 5 % more Gaussians, copies of the same kind, up to a cap: ``--budget``.
- *Regularisers*, ``L = L_photometric + 0.01 mean o + 0.01 mean s``: without them nothing would become transparent, and
  so be relocated. Gaussians start with the opacity 0.5 and a tenth of the size that 3DGS gives them.

``--set`` reaches ``noise`` (a), ``dead_opacity``, ``growth``, ``budget``, ``per_pixel``, ``opacity_reg``,
``scale_reg``, ``initial_opacity`` and ``initial_size``. ``docs/family/mcmc.md`` has the measured figures.

This deviates from the release as follows. It asks for the cap, which in the paper is the number that 3DGS ends with;
without a ``--budget`` it is here 0.03 for each pixel of the training views, where those of the release are between
0.003 (bonsai) and 0.034 (bicycle). Relocation comes after the step of Adam, as density control does everywhere here,
not before. Opacities so near 1 that the sum would cancel are limited to ``1 - 2^-23`` first. Shorter runs relocate
every 10 iterations at most. The mean of the scales is in world units, as released: in a scene of another unit the same
weight means something else.

    minisplat-ref train SCENE --recipe mcmc --budget 20000
    minisplat-ref oracle gradients --extension mcmc
"""

from minisplat_ref.extensions.extension import Extension
from minisplat_ref.extensions.mcmc.recipe import MCMC, SMALL

EXTENSION = Extension("mcmc", recipes=(MCMC,), representation=SMALL)
