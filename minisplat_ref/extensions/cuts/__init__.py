"""Cuts: a Bezier curve in each Gaussian's plane cuts a part of it away, so edges are sharp.

This follows DisC-GS, Qu et al. 2024, arXiv 2405.15196. A Gaussian is smooth, and spills over the edges of objects. Here
each has cubic curves in the plane of its first two axes, as many as ``n_curves``, by default one, and the part behind a
curve, seen from the centre, is cut away (:mod:`minisplat_ref.extensions.cuts.response`):

    alpha = o exp(-d^T Q d / 2) mask(d),   mask = 1 where the segment from the centre to d crosses the curves an
                                                  even number of times, else 0

A step has no derivative. So training uses ``1 / (1 + exp(-distance / w))`` of the signed distance to the edge of the
part that is cut away, with its exact gradient; w is 1 pixel at first, then half a pixel, and 0 in the last iteration,
so the saved and evaluated model has hard edges. ``widths`` is a column of the PLY.

    minisplat-ref train SCENE --recipe cuts
    minisplat-ref train SCENE --recipe cuts --set n_curves=2
    python -m data_tools.claims cuts/card --out DIR
    python -m data_tools.claims cuts/edge SCENE --out DIR
    minisplat-ref oracle gradients --extension cuts

``docs/family/cuts.md`` has the measured figures.

This deviates from the paper, which keeps the step and replaces its gradient by an approximation. Control points are in
standard deviations instead of world units, and follow the affine map that projects the Gaussian, so that its cuts
rotate and shrink with it. A curve is a polygon of 8 edges, so that crossings are counted without roots of cubics. Where
a curve moves across the centre, the part that was cut away and the rest change places, and the image jumps, which no
gradient shows. Training does not change which axes are the first two; if a Gaussian becomes flat along one of them, its
curves are seen edge on.
"""

from minisplat_ref.extensions.cuts.model import CUT_GAUSSIANS, CUTS, stages
from minisplat_ref.extensions.extension import Extension

EXTENSION = Extension("cuts", recipes=(CUTS,), representation=CUT_GAUSSIANS, stages=stages)
