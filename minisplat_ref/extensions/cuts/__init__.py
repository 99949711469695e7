"""Cuts: a Bezier curve in the plane of each Gaussian cuts a part of it away: edges are sharp.

DisC-GS, Qu et al. 2024, arXiv 2405.15196. A Gaussian is smooth, and spills over the edges of what it shows. Here each
has a cubic curve in the plane of its first two axes (:mod:`minisplat_ref.extensions.cuts.response`), and what lies
behind it, as seen from the centre, is cut away (:mod:`minisplat_ref.extensions.cuts.curve`):

    alpha = o exp(-d^T Q d / 2) mask(d),   mask = 1 where the segment from the centre to d crosses the curve an even
                                                  number of times, else 0

A step has no derivative. So a training sees ``1 / (1 + exp(-distance / w))`` of the signed distance to the edge of what
is cut away, of which the gradient is exact; w is 1 pixel first, then half of one, and in the last iteration 0: what is
saved, measured and rendered has hard edges. ``widths`` is a column of the PLY.

    minisplat-ref train SCENE --recipe cuts
    minisplat-ref study cuts/card --out DIR
    minisplat-ref oracle gradients --extension cuts

Measured (``study cuts/card``, 4 seeds): a Gaussian of which a straight edge has cut a part away is drawn by one with a
cut at 65 dB in the best of four trainings, with an edge of 0.9 pixels from 10 to 90 %; twelve without cuts reach 36 dB
and 2.2 pixels. Two of the four found no cut, 21 dB: their curves began on a side where there is nothing to cut, and
were pushed out. A bright card with a curved edge: six with cuts 28.5 dB at best and 26.3 ± 2.4, twelve without 24.7
and 23.6 ± 0.9, at 132 and 168 floats. Within 1.5 pixels of the edge that is 16.5 and 13.5 dB: a hard edge has steps
where pixels are covered in part.

Where this deviates: the paper keeps the step and puts an approximation in the place of its gradient. Each Gaussian has
one curve here. Control points are in deviations instead of world units, and follow the affine map that draws the
Gaussian, so that its cut turns and shrinks as it does. The curve is drawn as a polygon of 8 edges, so that crossings
are counted without roots of cubics. Where a curve moves over the centre, what was cut away and what was left change
places: the picture jumps, which no gradient says. Which axes are the first two is not changed by the training; of a
Gaussian that becomes flat along one of them the curve is seen on edge.
"""

from minisplat_ref.extensions.cuts.method import CUT_GAUSSIANS, CUTS
from minisplat_ref.extensions.cuts.stages import stages
from minisplat_ref.extensions.cuts.study import CARD
from minisplat_ref.extensions.extension import Extension

EXTENSION = Extension("cuts", recipes=(CUTS,), representation=CUT_GAUSSIANS, stages=stages, studies=(CARD,))
