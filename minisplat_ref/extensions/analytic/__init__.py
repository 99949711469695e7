"""Analytic splatting: alpha is a mean over the pixel, not the value at its centre.

This follows Analytic-Splatting, Liang et al. 2024, arXiv 2403.11056. A pixel collects light from a square. 3DGS takes
the value of the footprint at its centre, which misses anything thinner than a pixel; hence its low-pass. Here alpha is
the integral over the square, in closed form, without a low-pass (:mod:`minisplat_ref.extensions.analytic.response`):

    alpha = o 2 pi l_1 l_2 prod_k [F((u_k + 1/2) / l_k) - F((u_k - 1/2) / l_k)]

with the offset u along the footprint's axes and its standard deviations l. F is the normal distribution function or, in
the recipe as in the paper, ``1 / (1 + exp(-(1.6 x + 0.07 x^3)))``, which needs no error function. With the former the
integral is exact where the axes are the image's. Elsewhere the square is rotated along with them, so needles at an
angle have an error, which ``claims analytic/footprint`` measures (``docs/family/analytic.md`` has the figures).

The integral is a response (:class:`minisplat_ref.reference.hits.Response`); the rest of the renderer is that of 3DGS,
on the plain kernels or the reference. Only the reference collects blend statistics.

This deviates from the paper as follows: the derivative with respect to a footprint's angle is taken as 0 where the
footprint is round, since it does not exist there, and the list of tiles is the reference's. The released code's
thresholds for the longest and thinnest footprints are replaced by bounds of the standard deviations.

    minisplat-ref train SCENE --recipe analytic
    python -m data_tools.claims analytic/footprint --out DIR
    minisplat-ref oracle gradients --extension analytic
"""

from minisplat_ref.extensions.analytic.model import ANALYTIC, INTEGRATED, stages
from minisplat_ref.extensions.extension import Extension

EXTENSION = Extension("analytic", recipes=(ANALYTIC,), representation=INTEGRATED, stages=stages)
