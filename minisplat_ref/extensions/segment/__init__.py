"""Segmentation: a label for every Gaussian, by one closed form, from masks of photographs.

This follows FlashSplat: 2D to 3D Gaussian Splatting Segmentation Solved Optimally (2024), arXiv 2409.08270. Nothing is
trained. Of a finished model, each Gaussian counts the weights with which it is blended into the pixels of each label
(:mod:`.votes`), and takes the label with most of them, after a bias to the background:

    A_e(i) = sum of w_i(p) over the pixels p of label e,   a_e = A_e / sum_f A_f
    label(i) = argmax_e a_e + gamma [e = 0]

That is the least absolute error that labels of Gaussians can have against the masks. Masks are images of ids that any
program may have made; nothing that was learned is downloaded.

    minisplat-ref segment label runs/fox --masks masks --out labelled.ply
    minisplat-ref segment label runs/fox --masks masks --extract 1 --out head.ply
    minisplat-ref segment render labelled.ply --cameras runs/fox/cameras.json --out labels
    python -m data_tools.claims segment/masks --out DIR

``docs/family/segment.md`` has the measured figures.

It works for every recipe whose renderer blends the colours of its primitives once. Where the weights do not add up to
the opacity of the image, the command reports it; parameters that no PLY holds, such as networks that change opacities,
are refused.

This deviates from the paper as follows. Masks of a view show the label of the largest weight, where the paper compares
depths. --extract and --remove separate one object from the rest, so that a Gaussian may belong to two; the labels of
the PLY are a partition.

Left out is the making of masks: there is no tracker and no network here.
"""

from minisplat_ref.extensions.extension import Extension
from minisplat_ref.extensions.segment import commands

EXTENSION = Extension("segment", commands=(commands,))
