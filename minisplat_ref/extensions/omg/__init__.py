"""OMG: few Gaussians, chosen by how they differ from their neighbours, in sub-vector codebooks.

This follows Optimized Minimal Gaussians, Lee et al. 2025, arXiv 2503.16924. Mini-Splatting keeps what is important to
the photographs, but of two important Gaussians side by side that look alike, one would do. So the pruning score is
multiplied by the difference of a Gaussian's colour from its neighbours' in Morton order
(:mod:`minisplat_ref.extensions.omg.reference`),

    S_i = I_i LD_i^lambda,   LD_i = mean_channels |c_i - c_prev| + |c_i - c_next|,   lambda = 2

and the Gaussians of the largest scores that together carry 99 % of the sum stay
(:mod:`minisplat_ref.extensions.omg.method`). They are stored with few attributes. The appearance has three parameters
of colour and a few features, from which a shared decoder computes the spherical harmonics
(:mod:`minisplat_ref.extensions.omg.appearance`). Each vector is split into parts, with a codebook for each part
(:mod:`minisplat_ref.extensions.omg.svq`). ``.omg`` is the file (:mod:`minisplat_ref.extensions.omg.file`).

    minisplat-ref train SCENE --recipe omg --out runs/small
    minisplat-ref convert runs/small small.omg
    minisplat-ref study omg/distinctiveness room --out DIR

``docs/FAMILY.md`` has the measured figures.

This deviates from the paper in four ways. The paper's networks, trained from iteration 15,000 on, are replaced by a
linear decoder that is fitted when the file is written; opacity, which a network computes there, has a codebook. The
paper trains for 1,000 more iterations with the codes; here they are fitted after the training. Centres are packed as
differences in Morton order instead of by a point-cloud coder, and indices by zstandard instead of Huffman coding and
xz. The released code seems to use the sorting permutation where its inverse is meant, which is the same only if the
rows are sorted already; here it is the inverse.
"""

from minisplat_ref.extensions.extension import Extension
from minisplat_ref.extensions.omg.file import OMG_FILE
from minisplat_ref.extensions.omg.method import OMG
from minisplat_ref.extensions.omg.population import load_plain, save_plain, with_features
from minisplat_ref.extensions.omg.renderer import COMPACT
from minisplat_ref.studies.study import declare, fine_tune, trainings

DISTINCTIVENESS = declare(
    "distinctiveness",
    "which 50, 25 and 12.5 % of the Gaussians to keep",
    f"{__name__}.study.run",
    *trainings(1000, "mini-splatting2"),
    fine_tune(200),
)
EXTENSION = Extension(
    "omg",
    recipes=(OMG,),
    representation=COMPACT,
    save=save_plain,
    load=load_plain,
    saves_plain=True,
    sample=with_features,
    formats=(OMG_FILE,),
    studies=(DISTINCTIVENESS,),
)
"""The recipe ``omg``, the format ``.omg`` and a study."""
