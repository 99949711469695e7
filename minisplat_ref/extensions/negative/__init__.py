"""Negative Gaussians: colours may be below zero, so that one can be cut out of another.

This follows NegGS, Kasymov et al. 2024, arXiv 2405.18163. A sum of Gaussians has bumps, and a ring takes several. The
difference of two, a wide one minus a narrow one in its middle, has a hollow, and takes as many numbers as two bumps:

    f_c = (N(m0, S0) - c N(m1, S1)) / (1 - c),   0 <= c < 1

which is a density exactly if ``c <= min_x N(m0, S0) / N(m1, S1)``. That minimum is above zero only where the negative
Gaussian is the narrower one (:mod:`minisplat_ref.extensions.negative.model`). The abstract speaks of densities that
are *divided*; the construction is this weighted difference, and the quotient only appears in its bound.

In a scene the negative component is a Gaussian whose *colour* is negative; its opacity stays between 0 and 1, and the
compositing is that of 3DGS, ``C = sum_i w_i c_i + T_end b``. So one thing changes in the renderer: the colour is
``c = 0.5 + sum_k c_k Y_k(d)``, without the ``max(0, .)`` (:mod:`minisplat_ref.extensions.negative.model`). A fraction
of the Gaussians starts negative. Where all colours are positive the image is that of 3DGS, bit for bit.

Four consequences are worth knowing:

- A negative Gaussian in front of others dims them like any other: it adds ``-w |c|`` and takes its part of the
  transmittance. It cancels a *colour*, but makes no hole to see through. ``claims negative/backdrop`` measures this;
  ``claims negative/rings`` measures when a difference saves more Gaussians than it costs.
- The image may be below zero, too. Written and evaluated images are clipped to [0, 1]; the loss sees them unclipped, as
  3DGS's loss sees values above one, because a clipped pixel has no gradient.
- Pruning considers opacity and size, never the colour, so a Gaussian whose colour is near zero, which may be about to
  change its sign, stays. That colour has a gradient, which 3DGS loses at zero.
- The PLY is that of 3DGS, with ``f_dc`` below -1.77 where the colour is negative. Other programs read it and clamp.

``docs/family/negative.md`` has the measured figures.

How the released code chooses its negative components, and with which colours they start, was not known to us. Here they
are sampled at random, and a sampled Gaussian starts with its colour negated. A density for each pair is left out; the
components pair up, or not, as the photographs require.

    minisplat-ref train SCENE --recipe negative
"""

from minisplat_ref.extensions.extension import Extension
from minisplat_ref.extensions.negative.model import NEGATIVE, SIGNED

EXTENSION = Extension("negative", recipes=(NEGATIVE,), representation=SIGNED)
"""Gaussians of either sign with their renderer, the recipe that trains them."""
