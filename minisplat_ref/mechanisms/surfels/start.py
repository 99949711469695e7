"""Surfels of Gaussians, at the start and after a reinitialisation."""

import numpy as np

from minisplat_ref.types import Gaussians

LOG_THICKNESS = -16.0  # 1e-7 world units: what other programs draw, and where children of a split are placed


def as_surfels(gaussians: Gaussians, rng: np.random.Generator) -> Gaussians:
    """Return flat Gaussians that face at random, as the released code starts: those of 3DGS all face world z."""
    quats = rng.uniform(size=gaussians.quats.shape).astype(gaussians.quats.dtype)
    log_scales = gaussians.log_scales.copy()
    log_scales[:, 2] = LOG_THICKNESS
    return gaussians._replace(quats=quats, log_scales=log_scales)
