"""Analytic splatting: alpha is a mean over the pixel, not the value at its centre.

Analytic-Splatting, Liang et al. 2024, arXiv 2403.11056. A pixel collects light from a square. 3DGS takes the value of
the footprint in the middle of it, which misses what is thinner than a pixel; hence its low-pass. Here alpha is the
integral over the square, in closed form, and there is no low-pass (:mod:`minisplat_ref.extensions.analytic.reference`):

    alpha = o 2 pi l_1 l_2 prod_k [F((u_k + 1/2) / l_k) - F((u_k - 1/2) / l_k)]

with the offset u along the footprint's axes and its deviations l. F is the normal distribution function, or in the
recipe, as in the paper, ``1 / (1 + exp(-(1.6 x + 0.07 x^3)))``, which needs no error function. With the former it is
exact where the axes are the image's. Elsewhere the square is turned along with them: the needle at an angle is where it
errs, by 9 % at a deviation of a tenth of a pixel (``study analytic/footprint``).

It is a response (:class:`minisplat_ref.reference.hits.Response`): all else of the renderer is 3DGS's, on the plain
kernels or the reference. Blend statistics come from the reference alone.

Where this deviates: the derivative with respect to a footprint's angle is taken as 0 where it is round, for there is
none; the list of tiles is the reference's. Left out: the thresholds for the longest and thinnest footprints of the
released code; here both are bounds of the deviations.

    minisplat-ref train SCENE --recipe analytic
    minisplat-ref study analytic/footprint --out DIR
    minisplat-ref oracle gradients --extension analytic
"""

from minisplat_ref.extensions.analytic.method import ANALYTIC, INTEGRATED
from minisplat_ref.extensions.analytic.stages import stages
from minisplat_ref.extensions.analytic.study import FOOTPRINT
from minisplat_ref.extensions.extension import Extension

EXTENSION = Extension("analytic", recipes=(ANALYTIC,), representation=INTEGRATED, stages=stages, studies=(FOOTPRINT,))
