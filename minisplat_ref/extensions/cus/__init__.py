"""CUS-GS: voxels that decode several Gaussians each, and read their features in a memory.

This follows CUS-GS, 2025, arXiv 2511.17904. 3DGS stores appearance for each Gaussian, and feature fields store features
besides; here an anchor stores both for the K Gaussians of a voxel: a latent z of few numbers and their offsets.
Networks that all anchors share make of it opacity, scales, rotation, colour and a query (:mod:`.model`):

    mu_n = m + 2 s u_n,   (o, s, q, c)_n = networks(z, d, e),   k_n = [query(z, d, e), u_n] A + b

with the direction d of view and an embedding e of the photograph. Queries are blended as colours are, and a pixel reads
its feature in a memory M of the photographs' features, each unlike the others (:mod:`.memory`):

    f = softmax(k (M P)^T / sqrt(dim)) M W

The loss is that of 3DGS, with 0.1 (L2 + 1 - cos) of the features and 0.01 times the mean volume of anchors
(:mod:`.recipe`). Every thousand iterations the 0.1 % of anchors with the least significance go:

    S = 2 |z| + 8 |dL/dz| + sum_n hits_n o_n V_n

Anchors are those of Scaffold-GS (Lu et al. 2023, arXiv 2312.00109), whose rule by which they grow is here, too.
With ``growth_threshold=none`` they do not grow.

    minisplat-ref train SCENE --recipe cus --out runs/anchors
    minisplat-ref train SCENE --recipe cus --set features=DIR --out runs/anchors
    minisplat-ref train SCENE --recipe cus --set growth_threshold=none --out runs/anchors
    minisplat-ref cus features runs/anchors --out maps
    python -m data_tools.claims cus/floats --out DIR
    python -m data_tools.claims cus/growth --out DIR
    minisplat-ref oracle gradients --extension cus

``features=DIR`` has a map for each photograph, ``NAME.npy`` or ``NAME.npz`` of [h, w, D], of whatever network; without
it maps are classical: colours and the energies of Gabor filters at three scales, 22 numbers.
``docs/family/cus.md`` has the measured figures. A run keeps networks, embeddings and memory in ``shared.npz``; a PLY
has the anchors, which other viewers show as one Gaussian each.

This deviates from the paper as follows. Its features are those of foundation models; ours are given or classical,
without any claim about meaning. Networks add to the initial values of an anchor, such as the colour of its points;
their last layers, but for that of the query, start at 0. One scale of an anchor serves as that of its Gaussians and,
doubled, as the unit of their offsets, where Scaffold-GS trains two; offsets are random at first. Voxels are as large as
the median distance of the points, instead of 0.01. Queries have 15 numbers instead of 160, and keys are as wide. The
terms of the significance have different units and are divided by their means first; the gradient is Adam's running
mean. Dates of pruning, weights and gamma are ours, and so are the rates of what Scaffold-GS does not have. The features
of 2,048 pixels are compared in an iteration, drawn at random.

Left out: the language model, and the pruning of anchors by opacity, which in Scaffold-GS accompanies their growing.
"""

from pathlib import Path
from typing import Any

from minisplat_ref.extensions.cus import features
from minisplat_ref.extensions.cus.gradient_checks import stages
from minisplat_ref.extensions.cus.model import ANCHORS
from minisplat_ref.extensions.cus.recipe import CUS
from minisplat_ref.extensions.extension import Extension
from minisplat_ref.io.label import Label
from minisplat_ref.io.ply import save_ply


def save(path: str | Path, gaussians: Any, label: Label) -> None:
    """Write the anchors, with a note in the header that the networks are missing."""
    save_ply(path, gaussians, label._replace(lacks=tuple(dict.fromkeys((*label.lacks, "network")))))


EXTENSION = Extension(
    "cus",
    recipes=(CUS,),
    representation=ANCHORS,
    save=save,
    stages=stages,
    commands=(features,),
)
"""The recipe ``cus`` with its renderer, and a command."""
