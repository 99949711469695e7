"""A sky, which ``adaptive`` gives to scenes whose photographs show one.

Structure from motion finds no points in a sky, and training covers it with the Gaussians of the horizon, which it makes
large: after a hundred iterations hardly any pixel is transparent. So the test is not whether the background shows
through, but whether a sky explains the photographs better. The larger a Gaussian is relative to the path of the
cameras, the more it looks the same from all of them, as a sky does. The large Gaussians are taken away, and the
harmonics of a sky (:mod:`minisplat_ref.training.sky`) are fitted to the residual, r = photograph - rendering, by least
squares over half of the photographs, and there over the pixels that the rest of the scene lets more than half of the
light through to:

    r = sum_k s_k b_k,   b_k = T Y_k        T: transmittance, Y_k: spherical harmonics in the direction of the pixel

The other half of the photographs judges, and vice versa, the two in turns along the path of the cameras. They compare
with the same fit to the scene as it is, with all its Gaussians: gaps that any colour would fill are no evidence of a
sky.

    gain of a photograph = 10 log10 (|r - sum s_k b_k|^2 as it is / |r - sum s_k b_k|^2 without the large Gaussians)

Other pixels would drown it, because of all that the scene has not learned yet. A wall that is all of one colour is no
sky: its photographs disagree about the direction in which its edges lie. All photographs see one sky, so nearly all of
them gain by it, and a sky explains nearly all of its pixels; so the mean gain has to exceed 3 dB, and three standard
errors, where a calibration with parameters for each photograph needs one. To compare the sums over all photographs in
place of the mean of their gains was tried: it finds a sky in a table top, and misses one of six in *outdoor* (N).

If the sky is better, it is fitted to all pixels of all photographs, and only the largest of these Gaussians are
removed, those that are larger than the path of the cameras itself. Others show a part of the scene besides, such as the
far ground, and training takes the sky off them.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from minisplat_ref.constants import SH_DEGREE_MAX
from minisplat_ref.methods.adaptive.evidence import Answer, Evidence
from minisplat_ref.methods.adaptive.numbers import HUGE, LARGE, OPEN, OPEN_MIN, SKY_RIDGE, SKY_VIEWS_MAX, SKY_VIEWS_MIN
from minisplat_ref.reference.spherical_harmonics import sh_basis
from minisplat_ref.strategy.ops import keep
from minisplat_ref.training.pace import trained_ids
from minisplat_ref.training.sky import N_BASIS, SKY, unit_rays
from minisplat_ref.training.state import Iteration, TrainState, apply_edit
from minisplat_ref.types import Bools, Floats, Ints, some_of


class Behind(NamedTuple):
    """A photograph, reduced to the sums of least squares for a sky behind its rendering."""

    normal: Floats
    """[16, 16] ``sum b_k b_l`` over the pixels."""
    projected: Floats
    """[16, 3] ``sum b_k r``."""
    energy: float
    """``sum r^2``."""

    def squared_residual(self, sky: Floats) -> float:
        """Return ``|r - sum_k s_k b_k|^2`` for the coefficients s [16, 3]."""
        return float(self.energy - 2.0 * np.sum(sky * self.projected) + np.sum(sky * (self.normal @ sky)))


def behind(residual: Floats, transmittance: Floats, basis: Floats) -> Behind:
    """Return the sums of a photograph.

    Parameters
    ----------
    residual : ndarray of shape (P, 3)
        r of the pixels that count.
    transmittance : ndarray of shape (P,)
        T.
    basis : ndarray of shape (P, 16)
        Y_k.
    """
    b = transmittance[:, None] * basis
    return Behind(b.T @ b, b.T @ residual, float(np.sum(residual**2)))


def fit_sky(photographs: Sequence[Behind]) -> Floats:
    """Return the coefficients [16, 3] that explain photographs best, with a slight shrinkage towards zero."""
    normal = np.sum([photograph.normal for photograph in photographs], axis=0)
    projected = np.sum([photograph.projected for photograph in photographs], axis=0)
    ridge = max(SKY_RIDGE * np.trace(normal) / N_BASIS, np.finfo(float).tiny)
    return np.linalg.solve(normal + ridge * np.eye(N_BASIS), projected)


def cross_validate(photographs: Sequence[Behind]) -> Floats:
    """Return the residual of each photograph [V] with a sky that was fitted to every second one, not to itself."""
    skies = [fit_sky(photographs[1 - parity :: 2]) for parity in (0, 1)]
    return np.array([photograph.squared_residual(skies[k % 2]) for k, photograph in enumerate(photographs)])


def compare(as_it_is: Sequence[Behind], without_large: Sequence[Behind]) -> Evidence:
    """Return the evidence of two photographs or more for a sky instead of large Gaussians; ``fitted`` is its s_k."""
    before, after = cross_validate(as_it_is), cross_validate(without_large)
    gains = [10.0 * np.log10(b / a) if a > 0 and b > 0 else 0.0 for a, b in zip(after, before, strict=True)]
    error = np.std(gains, ddof=1) / np.sqrt(len(gains))
    return Evidence(float(np.mean(gains)), float(error), fit_sky(without_large))


def is_larger(state: TrainState, iteration: Iteration, than: float) -> Bools:
    """Return which Gaussians [N] have a standard deviation above ``than`` times the scene's extent."""
    larger: Bools = np.exp(state.gaussians.log_scales).max(axis=1) > than * iteration.scene.extent
    return larger


def find_counted_pixels(iteration: Iteration, view_ids: Sequence[int]) -> dict[int, Ints]:
    """Return the pixels of training views, as y W + x, that their masks leave."""
    views = {index: iteration.scene.train_views[index].load() for index in view_ids}
    return {
        index: np.arange(view.camera.width * view.camera.height) if view.mask is None else np.flatnonzero(view.mask)
        for index, view in views.items()
    }


def open_pixels(state: TrainState, iteration: Iteration, view_ids: Sequence[int], is_drawn: Bools) -> dict[int, Ints]:
    """Return those of the pixels that show the background behind the Gaussians ``is_drawn`` [N].

    Views with too few such pixels are left out.
    """
    request = iteration.render_settings.request()._replace(is_visible=is_drawn)
    pixels = {}
    for index, counted in find_counted_pixels(iteration, view_ids).items():
        view = iteration.scene.train_views[index].load()
        alpha = iteration.render_settings.renderer.render(state.model, view, request)[0].alpha.ravel()
        is_open = 1.0 - alpha[counted] > OPEN
        if np.count_nonzero(is_open) > OPEN_MIN * alpha.size:
            pixels[index] = counted[is_open]
    return pixels


def sum_photographs(
    state: TrainState, iteration: Iteration, pixels: Mapping[int, Ints], is_drawn: Bools | None
) -> list[Behind]:
    """Return the sums of training views over pixels, rendered with the Gaussians ``is_drawn`` [N]; None for all."""
    request = iteration.render_settings.request()._replace(is_visible=is_drawn)
    photographs = []
    for index, counted in pixels.items():
        view = iteration.scene.train_views[index].load()
        output = iteration.render_settings.renderer.render(state.model, view, request)[0]
        residual = view.image / 255.0 - np.clip(output.image, 0.0, 1.0)
        rays = unit_rays(view.camera, counted, np.dtype(float)) @ view.camera.cam_from_world_R
        transmittance = 1.0 - output.alpha.ravel()[counted].astype(float)
        basis = sh_basis(rays, SH_DEGREE_MAX)
        photographs.append(behind(residual.reshape(-1, 3)[counted], transmittance, basis))
    return photographs


def examine_sky(state: TrainState, iteration: Iteration) -> Answer | str:
    """Return whether a sky instead of the large Gaussians, fitted to some photographs, explains the others better.

    It begins with the fit to all pixels, and the largest of these Gaussians go.
    """
    large, huge = (is_larger(state, iteration, than) for than in (LARGE, HUGE))
    n = int(np.count_nonzero(large))
    if n == 0:
        return "no Gaussian is large"
    ids = some_of(trained_ids(len(iteration.scene.train_views), iteration.cooling, state.pace), SKY_VIEWS_MAX)
    pixels = open_pixels(state, iteration, ids, ~large)
    if len(pixels) < SKY_VIEWS_MIN:
        return f"{len(pixels)} photographs show what is behind the scene without {n:,} large Gaussians"
    evidence = compare(*(sum_photographs(state, iteration, pixels, rows) for rows in (None, ~large)))
    why = evidence.describe(f"a sky in place of {n:,} large Gaussians", "half of the photographs", "the others")

    def begin() -> dict[str, Floats]:
        sky = fit_sky(sum_photographs(state, iteration, find_counted_pixels(iteration, ids), ~huge))
        apply_edit(state, keep(state.gaussians, ~huge))
        return {SKY: sky.astype(np.float32)}

    return Answer(evidence, why, begin)
