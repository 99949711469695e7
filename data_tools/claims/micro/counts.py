"""Claim ``micro/counts``: whether Micro-splatting needs fewer Gaussians than 3DGS, and what its second stage gains.

The paper is Micro-splatting, arXiv 2504.05740. Three curves of PSNR over the number of Gaussians. That of
``3dgs-accel`` is drawn by its threshold of densification; those of ``micro``, with its second stage and without, by
their penalty of size, of which more makes more Gaussians.
"""

import argparse

from data_tools.claims import kit
from data_tools.claims.kit.counts import Curve, measure_curves
from minisplat_ref.extensions.extension import find_recipe
from minisplat_ref.interface.palette import BLUE, GREY, RED

THRESHOLDS = (2e-4, 4e-4, 8e-4, 1.6e-3)  # in normalised device coordinates
_LIMITS = tuple({"trace_limit": limit} for limit in (0.05, 0.1, 0.2))
CURVES = {
    "3dgs-accel": Curve("3dgs-accel", tuple({"threshold": threshold} for threshold in THRESHOLDS), GREY),
    "micro, first stage alone": Curve("micro", _LIMITS, BLUE, {"score_mass": 1.0, "merge_reach": 0.0}),
    "micro": Curve("micro", _LIMITS, RED),
}


def run(args: argparse.Namespace) -> kit.Report:
    """Train and measure."""
    return measure_curves(args, CURVES, find_recipe)
