"""Claim ``gdgs/counts`` (GDGS, arXiv 2507.00363): detail at an equal number of Gaussians, for GDGS beside 3DGS.

On photographs GDGS ends with more Gaussians than 3DGS does, so that one training of each says little. Here both are
curves over their number, which follows from the threshold of gradients from which on they clone and split.
"""

import argparse

from data_tools.claims import kit
from data_tools.claims.kit.counts import Curve, measure_curves
from minisplat_ref.extensions.extension import find_recipe
from minisplat_ref.interface.palette import GREY, RED

_THRESHOLDS = tuple({"threshold": threshold} for threshold in (2e-4, 4e-4, 8e-4))  # in normalised device coordinates
CURVES = {name: Curve(name, _THRESHOLDS, color) for name, color in (("3dgs-accel", GREY), ("gdgs", RED))}


def run(args: argparse.Namespace) -> kit.Report:
    """Train and measure."""
    return measure_curves(args, CURVES, find_recipe)
