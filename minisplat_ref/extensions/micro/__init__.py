"""Micro-splatting: small Gaussians, split at the photographs' edges, merged where alike.

This follows Micro-splatting, arXiv 2504.05740. Training makes Gaussians that are long or large, and a needle that fits
an edge in one place is wrong next to it. There are three changes to 3DGS
(:mod:`minisplat_ref.extensions.micro.recipe`):

- *Trace penalty.* ``L = L_photometric + lambda mean_k max(tr(Sigma_k) / tau - 1, 0)`` with
  ``tr(Sigma) = s0^2 + s1^2 + s2^2`` and ``d tr / d s_j = 2 s_j``. During densification a Gaussian with a penalty is
  replaced by two of half the covariance.
- *Detail.* The threshold of densification is ``tau0 / (1 + beta g_k)``, where g_k is the strength of the photographs'
  edges (Sobel) under the Gaussian, relative to its mean over the photograph.
- *A second stage*, after densification. Gaussians of the least ``o_k sqrt(tr(Sigma_k))``, opacity times size, which
  together have a hundredth of the sum, are removed. Pairs of nearest neighbours of about the same colour and size
  become one Gaussian with their common moments (:func:`minisplat_ref.strategy.simplify.merge_clusters`).

``--set`` reaches ``trace`` (lambda; 0 switches the halving off, too), ``trace_limit`` (the square root of tau, in
extents of the scene), ``beta``, ``score_mass``, ``merge_reach`` and ``merge_color``. With ``trace=0``, ``beta=0``,
``score_mass=1`` and ``merge_reach=0`` the method is ``3dgs-accel``, bit for bit.

``docs/family/micro.md`` has the measured figures.

This deviates from the paper as follows. The paper sums P_k = max(tr(Sigma_k) - tau, 0); here the P_k are averaged and
measured in units of tau, so that lambda depends neither on the scene's unit nor on the number of Gaussians. Lambda,
tau, beta, how much is removed and the reach of merging are our choices, since the abstract does not state them. Left
out is LPIPS in the loss, whose weights are not ours to ship.

    minisplat-ref train SCENE --recipe micro
    python -m data_tools.claims micro/checker --out DIR
    python -m data_tools.claims micro/counts SCENE --out DIR
    minisplat-ref oracle gradients --extension micro
"""

from minisplat_ref.extensions.extension import Extension
from minisplat_ref.extensions.micro.model import stages
from minisplat_ref.extensions.micro.recipe import MICRO

EXTENSION = Extension("micro", recipes=(MICRO,), stages=stages)
