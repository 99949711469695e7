"""OMG: few Gaussians that differ from their neighbours, with networks and codebooks.

This follows Optimized Minimal Gaussians, Lee et al. 2025, arXiv 2503.16924. Mini-Splatting keeps the Gaussians that are
important to the photographs, but of two important Gaussians side by side that look the same, one would suffice. So the
pruning score is multiplied by the difference of a Gaussian's colour from its neighbours' in Morton order
(:mod:`.recipe`),

    S_i = I_i LD_i^lambda,   LD_i = mean_channels |c_i - c_prev| + |c_i - c_next|,   lambda = 2

and the Gaussians of the largest scores that together carry tau = 99 % of the sum stay (:mod:`.recipe`). From iteration
15,000 on a Gaussian has six features instead of opacity and 48 coefficients of colour; small networks compute these
from the features and from the place (:mod:`.model`). From 29,000 on scales, rotations and features are split into parts
of one or two numbers, each part is an index into a separate codebook (:mod:`.codes`), and the codebooks are trained.
``.omg`` is the file: of a training (:mod:`.trained_file`), or fitted to any Gaussians (:mod:`.file`).

    minisplat-ref train SCENE --recipe omg --out runs/small
    minisplat-ref omg pack runs/small/checkpoint.npz --out small.omg
    minisplat-ref convert runs/other fitted.omg
    python -m data_tools.claims omg/distinctiveness room --out DIR
    python -m data_tools.claims omg/files room --out DIR
    python -m data_tools.claims omg/networks room --out DIR

The output of networks and codes is written into the six fields of 3DGS in every iteration, so every viewer can show
``point_cloud.ply`` and every format can hold it. ``omg pack`` needs zstandard (the extra ``compression``), the training
does not. ``docs/family/omg.md`` has the measured figures.

Choices of ours where the paper is silent: the networks begin with the outputs that the Gaussians had; their
learning rates; that their gradient does not reach the centres; the radius in which the scene is not contracted; and
codebooks of few Gaussians, which are smaller (at most one code for eight). It deviates from the paper in the file:
centres are packed as differences in Morton order instead of by a point-cloud coder, and indices by zstandard instead of
Huffman coding and xz. The released code seems to use the sorting permutation where its inverse is meant, which is the
same only if the rows are sorted already; here it is the inverse.
"""

from minisplat_ref.extensions.extension import Extension
from minisplat_ref.extensions.omg import trained_file
from minisplat_ref.extensions.omg.file import OMG_FILE
from minisplat_ref.extensions.omg.model import COMPACT, add_features, load_plain, save_plain, stages
from minisplat_ref.extensions.omg.recipe import OMG

EXTENSION = Extension(
    "omg",
    recipes=(OMG,),
    representation=COMPACT,
    save=save_plain,
    load=load_plain,
    saves_plain=True,
    stages=stages,
    sample=add_features,
    commands=(trained_file,),
    formats=(OMG_FILE,),
)
"""The recipe ``omg`` with its renderer, the format ``.omg``, and a command."""
