"""MVG-Splatting: surfels are inserted where the depth maps of several views agree.

This follows MVG-Splatting, Li et al. 2024, arXiv 2407.11840, on surfels (:mod:`minisplat_ref.mechanisms.surfels`).
Depth maps are smoothed along their photographs by a joint bilateral filter,

    D'(p) = sum_q w_pq D(q) / W_p,   w_pq = exp(-|p - q|^2 / (2 s^2) - |I(p) - I(q)|^2 / (2 r^2))

and give normals, and a pixel counts if several views agree on its depth: carried to another view and back, it returns
within a pixel and within 1 % of its depth. A kernel density of all depths, by fast Fourier transform, has its highest
peak; depths of less than half this density are near or far. There Gaussians are inserted on a grid, coarse near and
fine far, as large as its spacing ``r = D / f * stride`` and turned to the normal (:mod:`.insertion`). Two losses join
the photometric one (:mod:`.recipe`):

    filtered_normals   0.05, from iteration 7,000: surfels face as the surface through the filtered depths does
    depth_steps        0.1, from 7,000: |D_p - D_q| exp(-k |I_p - I_q|) of neighbouring pixels

    minisplat-ref train SCENE --recipe mvg
    minisplat-ref train SCENE --recipe mvg --set n_sources=0
    minisplat-ref mesh RUN --out mesh.ply
    python -m data_tools.claims mvg/insertion staircase --out DIR
    minisplat-ref oracle gradients --extension mvg

``docs/family/mvg.md`` has the measured figures.

This deviates from the paper as follows. The dates, the weights, the strides, the filter's widths and how the cuts adapt
are ours, since no released value was found. Points that an older Gaussian covers are left out, because each view would
insert the same surface again. Left out: the loss on features of a trained network; the extraction of a mesh from the
centres, for which there is ``minisplat-ref mesh``.
"""

from minisplat_ref.extensions.extension import Extension
from minisplat_ref.extensions.mvg.recipe import MVG, stages
from minisplat_ref.mechanisms.surfels.discs import DISCS

EXTENSION = Extension("mvg", recipes=(MVG,), representation=DISCS, stages=stages)
