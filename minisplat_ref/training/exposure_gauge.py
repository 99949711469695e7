"""The mean exposure of photographs: ``exposure=refined`` begins with the gains that tracks show, and holds their mean.

A gain that is the same in all channels and at every brightness is the first approximation of what a camera does; white
balance and the curve from light to bytes are the next, for which an affine map has room
(:mod:`minisplat_ref.training.calibration`). Trained from the tracks' gains on, the maps are worth up to half a decibel
more than the gains alone (``docs/measured/adaptive.md``, N).

Scene and exposures are determined up to a map that all photographs share, and which would drift: a scene twice as
bright with half the exposures looks the same in all training views, and wrong in every other. The mean of the exposures
is therefore kept at the identity, by the views in training alone: the held-out ones keep what their tracks show, with
which they are measured. ``exposure=learned`` is that of the 2024 update of 3DGS, which lets it drift.
"""

import numpy as np

from minisplat_ref.training.calibration import EXPOSURES
from minisplat_ref.training.pace import trained_ids
from minisplat_ref.training.state import Iteration, TrainState

DRIFT_MIN = 1e-6  # of the mean; rounding alone makes less, in exposures that are not trained


def hold_mean_exposure(state: TrainState, iteration: Iteration) -> None:
    """Keep the mean exposure of all training views at the identity, by changing those of the views in training."""
    if EXPOSURES not in state.shared:
        return
    exposures = state.shared[EXPOSURES]  # [V, 3, 4]
    drift = exposures.mean(axis=0, dtype=np.float64) - np.eye(3, 4)
    if np.abs(drift).max() > DRIFT_MIN:
        ids = trained_ids(len(exposures), iteration.cooling, state.pace)
        exposures[ids] -= (len(exposures) / len(ids) * drift).astype(exposures.dtype)
