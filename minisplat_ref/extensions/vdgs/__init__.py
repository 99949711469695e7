"""VDGS: a network of place and direction changes opacity, or colour.

This follows VDGS, Malarz et al. 2023, arXiv 2312.13729. Spherical harmonics let a colour depend on the direction of
view, and nothing lets an opacity. Here a small network reads the direction d from which a Gaussian is seen, and the
multi-resolution hash encoding E of its centre, and its output y changes the opacity o, the coefficients c_k of colour,
or both (:mod:`.model`):

    y = MLP([d, E(mu)]),   d = (mu - camera) / |mu - camera|
    o' = o (1 + y)  or  o + y,   c_k' = c_k (1 + y_k)  or  c_k + y_k

``--set modulation=opacity_times`` is the default; ``opacity_plus``, ``colors_times`` and ``colors_plus`` are the other
published modes, ``both_times`` and ``both_plus`` change opacity and colour.

    minisplat-ref train SCENE --recipe vdgs --set modulation=colors_plus --out runs/glossy
    minisplat-ref vdgs bake runs/glossy --view 0003 --out seen.ply
    python -m data_tools.claims vdgs/pane --out DIR
    python -m data_tools.claims vdgs/floats fox --downscale 2 --out DIR
    minisplat-ref oracle gradients --extension vdgs

A run keeps the network in ``shared.npz``. A PLY does not hold it, and has a note of that: rendered without the run, the
Gaussians are those of 3DGS with y = 0. ``vdgs bake`` writes the Gaussians of one view.

This deviates from the paper as follows. The factor is 1 + y instead of y, and the last layer starts at 0, so that a
training begins as 3DGS and without an output is 3DGS exactly. An opacity is kept between 1e-4 and 0.99; one above 0.99
is not raised further. Space is contracted into the unit cube. Hash grid and network are small, for a CPU: 4 levels of
4,096 rows with two features, 32 hidden units, and the learning rates are ours. An earlier commit of the released code
(0d092d4) has no hash encoding: its network reads the Gaussian's own opacity beside d, and its output is the opacity.
That is left out; ``claims vdgs/floats`` has an arm whose network reads the direction alone.
"""

from pathlib import Path
from typing import Any

from minisplat_ref.extensions.extension import Extension
from minisplat_ref.extensions.vdgs import bake
from minisplat_ref.extensions.vdgs.model import VDGS, VIEW_DEPENDENT, stages
from minisplat_ref.io.label import Label
from minisplat_ref.io.ply import save_ply


def save(path: str | Path, gaussians: Any, label: Label) -> None:
    """Write the six fields, with a note in the header that the network is missing."""
    save_ply(path, gaussians, label._replace(lacks=tuple(dict.fromkeys((*label.lacks, "network")))))


EXTENSION = Extension(
    "vdgs",
    recipes=(VDGS,),
    representation=VIEW_DEPENDENT,
    save=save,
    commands=(bake,),
    stages=stages,
)
"""The recipe ``vdgs`` with its renderer, and a command."""
