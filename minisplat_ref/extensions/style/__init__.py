"""G-Style: a trained scene in the style of an image; Gaussians split where patterns need room.

This follows G-Style, Kovacs et al. 2024, arXiv 2408.15695. A scene whose walls are a few large Gaussians cannot show
stripes, so its Gaussians are split first, and then painted.

1. *Colours* (:func:`.model.match_colors`). Photographs and Gaussians get mean and covariance of the style's colours:
   ``x' = M (x - mu_c) + mu_s`` with ``M = C_s^(1/2) C_c^(-1/2)``.
2. *Splitting by area and cutting* (:mod:`.model`). While the photographs in the new colours are learned, there are four
   rounds. Gaussians whose area, the product of their two largest scales, is above ``mean + k std`` become four, and
   none stays longer than 1.5 times its second axis.
3. *Painting* (:mod:`.recipe`). Base colours alone are trained, by

       L = w_n NNFM + w_c mean (F - F_photograph)^2 + w_t TV,   NNFM = mean_p (1 - cos(F_p, nearest style feature))

   and four times the Gaussians whose colour has the largest gradients become four.

The features F are those of a classical bank of filters, or of a network with weights from the user
(:mod:`minisplat_ref.mechanisms.features`).

    minisplat-ref style transfer RUN IMAGE --out NEW
    python -m data_tools.claims style/swatches --out DIR
    minisplat-ref oracle gradients --extension style

``docs/family/style.md`` has the measured figures.

This deviates from the paper as follows. Without VGG16 the features are edges, stripes and colours: patterns are copied,
brush strokes are not understood; the content's weight is ours there. Children lie on a grid that keeps the parent's
variance, not at random, because painting does not move them. The harmonics above the base colour are removed before
painting, so that the paint is on the surface. The gradient of a colour is the root mean square that Adam keeps. The
lengths of the stages, the number of rounds and the rate of the colours are ours. Left out is CLIP's distance, whose
weights are not ours to ship.
"""

from minisplat_ref.extensions.extension import Extension
from minisplat_ref.extensions.style import transfer
from minisplat_ref.extensions.style.model import stages

EXTENSION = Extension("style", commands=(transfer,), stages=stages)
