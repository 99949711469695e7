"""Exposure of each photograph, which ``adaptive`` switches on where the photographs are evidence for it.

After a few hundred iterations the scene is a blur of the right brightness. If the gain of one half of a photograph
explains the other half (:mod:`minisplat_ref.methods.adaptive.evidence`), the camera has changed its exposure, unless
compensated opacities explain more (:mod:`minisplat_ref.methods.adaptive.antialiasing`), which change the brightness of
photographs, too. The photographs then get exposures (:mod:`minisplat_ref.training.calibration`) that begin with their
gains, the medians of photograph / rendering over the pixels.

Scene and exposures are determined up to a map that all photographs share, and which would drift: a scene twice as
bright with half the exposures looks the same in all training views, and wrong in every other. The mean of the exposures
is therefore kept at the identity.
"""

import numpy as np

from minisplat_ref.methods.adaptive.evidence import Answer, exposure_evidence
from minisplat_ref.methods.adaptive.numbers import BRIGHT, DARK
from minisplat_ref.training.calibration import EXPOSURES, identity_exposures
from minisplat_ref.training.compensation import with_compensation
from minisplat_ref.training.pace import trained_ids
from minisplat_ref.training.sky import with_sky
from minisplat_ref.training.state import Iteration, TrainState
from minisplat_ref.types import Floats, Ints


def log_gains(state: TrainState, iteration: Iteration, view_ids: Ints | list[int]) -> Floats:
    """Return the logarithm of the gain of each photograph against its rendering without exposures.

    Parameters
    ----------
    state, iteration
        As for every action.
    view_ids : sequence of int
        Training views.

    Returns
    -------
    ndarray of shape (V,)
        Median over the pixels of ln(photograph / rendering), for the mean of the colours; 0 where no pixel qualifies.
    """
    gains = np.zeros(len(view_ids))
    renderer = with_sky(with_compensation(iteration.representation.renderer))
    request = iteration.render_settings.request()
    for k, index in enumerate(view_ids):
        view = iteration.scene.train_views[index].load()
        rendered = renderer.render(state.model, view, request)[0].image
        seen, photographed = (np.mean(image, axis=2) for image in (np.clip(rendered, 0, 1), view.image / 255.0))
        is_usable = (seen > DARK) & (photographed > DARK) & (photographed < BRIGHT)
        is_usable = is_usable if view.mask is None else is_usable & view.mask
        if is_usable.any():
            gains[k] = np.median(np.log(photographed[is_usable] / seen[is_usable]))
    return gains


def examine_exposures(state: TrainState, iteration: Iteration) -> Answer:
    """Return whether gains fitted to one half of each photograph explain the other; exposures begin with these."""
    n_views = len(iteration.scene.train_views)
    ids = trained_ids(n_views, iteration.cooling, state.pace)
    evidence = exposure_evidence(state, iteration, ids)
    why = evidence.describe(f"exposures that differ by {evidence.spread:.1%}")

    def begin() -> dict[str, Floats]:
        exposures, gains = identity_exposures(n_views), log_gains(state, iteration, ids)
        _set_gains(exposures[EXPOSURES], ids, gains - gains.mean())
        return exposures

    return Answer(evidence, why, begin)


def hold_mean_exposure(state: TrainState, iteration: Iteration) -> None:
    """Keep the mean exposure of the views in training at the identity."""
    if EXPOSURES not in state.shared:
        return
    exposures = state.shared[EXPOSURES]
    ids = trained_ids(len(iteration.scene.train_views), iteration.cooling, state.pace)
    exposures[ids] -= exposures[ids].mean(axis=0) - np.eye(3, 4, dtype=exposures.dtype)


def begin_exposures(state: TrainState, iteration: Iteration, view_ids: list[int]) -> None:
    """Have views that join the training start with their gains."""
    if EXPOSURES in state.shared:
        _set_gains(state.shared[EXPOSURES], view_ids, log_gains(state, iteration, view_ids))


def _set_gains(exposures: Floats, view_ids: list[int], gains: Floats) -> None:
    """Set the exposures of views to gains, given as logarithms."""
    for index, gain in zip(view_ids, gains, strict=True):
        exposures[index, :, :3] = np.exp(gain) * np.eye(3)
