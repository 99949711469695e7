"""Evidence that photographs need a calibration: parameters fitted to one half of each have to explain the other half.

After a few hundred iterations a scene is a blur in the right place. To first order, a calibration explains the residual
r = photograph - rendering by a few fields b_k, ``r = sum_k x_k b_k``:

* a displacement (dx, dy) in pixels, the main effect of a wrong pose, by ``x = -(dx, dy)`` and the slopes of the
  rendering, b = (d/du, d/dv) rendering;
* an amount x of compensation of the opacities, and its effect, b = compensated rendering - rendering.

The x of a photograph are fitted to its left half by least squares and judged on its right half, and vice versa. Noise
and the remaining errors of the scene differ from half to half, and worsen the other half; a pose and a resolution are
the same in both, and improve it. The x that explains all photographs together best belongs to the scene and not to
them; the comparison starts from it:

    gain of a photograph = 10 log10 (before / after)
    before = sum over halves |r - common x b|^2,   after = sum over halves |r - (x of the other half) b|^2

It is in decibels of the squared error. It supports the calibration if its mean over the photographs is above both a
minimum gain and its standard error. One suffices: gains differ much between photographs, and there are few of these.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from minisplat_ref.methods.adaptive.numbers import N_ERRORS, RIDGE
from minisplat_ref.rendering import Request
from minisplat_ref.training.state import Iteration, TrainState
from minisplat_ref.types import Bools, Floats, View


class Half(NamedTuple):
    """Half of a photograph, reduced to the sums of least squares."""

    normal: Floats
    """[K, K] products of the fields, ``sum b_j b_k`` over pixels and colours."""
    projected: Floats
    """[K] ``sum b_k r``."""
    energy: float
    """``sum r^2``."""

    def fitted(self, ridge: float = 0.0) -> Floats:
        """Return the x [K] that minimises ``|r - sum x_k b_k|^2 + ridge |x|^2``; of several that of least norm."""
        return np.linalg.lstsq(self.normal + ridge * np.eye(len(self.normal)), self.projected, rcond=1e-6)[0]

    def squared_residual(self, x: Floats) -> float:
        """Return ``|r - sum x_k b_k|^2``."""
        return float(self.energy - 2.0 * x @ self.projected + x @ self.normal @ x)


class Evidence(NamedTuple):
    """The evidence of the photographs about a calibration."""

    gain: float
    """dB of the squared error, mean over the photographs."""
    standard_error: float
    """dB."""
    fitted: Floats
    """[V, K] x of the whole photographs, minus their mean."""

    def describe(
        self, what: str, fitted_to: str = "one half of each photograph", judged_by: str = "the other half"
    ) -> str:
        """Describe the effect on one part of a calibration that was fitted to another, without a full stop."""
        verb = "improves" if what.startswith("a ") else "improve"
        if self.gain < 0:
            verb = verb.replace("improve", "worsen")
        amount = f"{abs(self.gain):.2f} ± {self.standard_error:.2f} dB"
        return f"{what}, fitted to {fitted_to}, {verb} {judged_by} by {amount}"

    @property
    def spread(self) -> float:
        """Root mean square of x over photographs and fields."""
        return float(np.sqrt(np.mean(self.fitted**2)))

    def is_above(self, min_gain: float, n_errors: float = N_ERRORS) -> bool:
        """Return whether it supports the calibration: by ``min_gain``, dB, and by this many standard errors."""
        return self.gain > max(min_gain, n_errors * self.standard_error)


class Answer(NamedTuple):
    """The decision about a calibration, and its evidence."""

    evidence: Evidence
    why: str
    """The evidence in words."""
    begin: Callable[[], dict[str, Floats]]
    """Returns the initial parameters of the calibration, and changes the model as far as it has to make way for it."""


def split_halves(residual: Floats, fields: Floats, is_counted: Bools) -> tuple[Half, Half]:
    """Return the left and the right half of a photograph.

    Parameters
    ----------
    residual : ndarray of shape (H, W, 3)
        Photograph - rendering.
    fields : ndarray of shape (K, H, W, 3)
        b_k.
    is_counted : ndarray of shape (H, W) of bool
        Pixels that count.
    """
    middle = residual.shape[1] // 2
    halves = []
    for columns in (slice(None, middle), slice(middle, None)):
        counted = is_counted[:, columns]
        r = residual[:, columns][counted].ravel().astype(np.float64)
        B = fields[:, :, columns][:, counted].reshape(len(fields), -1).astype(np.float64)  # [K, pixels * 3]
        halves.append(Half(B @ B.T, B @ r, float(r @ r)))
    return halves[0], halves[1]


def weigh(photographs: Sequence[tuple[Half, Half]]) -> Evidence:
    """Return the evidence from the halves of at least two photographs."""
    everything = together([half for pair in photographs for half in pair])
    ridge = RIDGE * float(np.diag(everything.normal).mean()) / (2 * len(photographs))
    fitted = np.array([[half.fitted(ridge) for half in pair] for pair in photographs])  # [V, 2, K]
    common = everything.fitted(ridge)
    gains = []
    for (left, right), (x_left, x_right) in zip(photographs, fitted, strict=True):
        before = left.squared_residual(common) + right.squared_residual(common)
        after = left.squared_residual(x_right) + right.squared_residual(x_left)
        gains.append(10.0 * np.log10(before / after) if before > 0 and after > 0 else 0.0)
    error = np.std(gains, ddof=1) / np.sqrt(len(gains))
    whole = np.array([together(pair).fitted(ridge) for pair in photographs])  # [V, K]
    return Evidence(float(np.mean(gains)), float(error), whole - whole.mean(axis=0))


def together(halves: Sequence[Half]) -> Half:
    """Return the sums over several halves."""
    normals, projected, energies = zip(*halves, strict=True)
    return Half(np.sum(normals, axis=0), np.sum(projected, axis=0), float(np.sum(energies)))


class Pair(NamedTuple):
    """A photograph and its rendering."""

    view: View
    photograph: Floats
    """[H, W, 3] in [0, 1]."""
    rendered: Floats
    """[H, W, 3] in [0, 1]."""
    is_counted: Bools
    """[H, W]: pixels that are not masked."""


def pairs(state: TrainState, iteration: Iteration, view_ids: Sequence[int]) -> Iterator[Pair]:
    """Iterate over pairs of a training view and its rendering."""
    request = iteration.render_settings.request()
    for index in view_ids:
        view = iteration.scene.train_views[index].load()
        rendered = render_clipped(state, iteration, view, request)
        is_counted: Bools = np.ones(rendered.shape[:2], bool) if view.mask is None else view.mask
        yield Pair(view, view.image / np.float32(255.0), rendered, is_counted)


def render_clipped(state: TrainState, iteration: Iteration, view: View, request: Request) -> Floats:
    """Return the scene as it is, [H, W, 3] in [0, 1]."""
    return np.clip(iteration.render_settings.renderer.render(state.model, view, request)[0].image, 0.0, 1.0)


def pose_evidence(state: TrainState, iteration: Iteration, view_ids: Sequence[int]) -> Evidence:
    """Return the training views' evidence for individual displacements."""
    return weigh(list(_halves_beside_slopes(state, iteration, view_ids)))


def displacements(state: TrainState, iteration: Iteration, view_ids: Sequence[int]) -> Floats:
    """Return the displacements (du, dv) [V, 2], pixels, of photographs against their renderings."""
    return np.array([-together(pair).fitted() for pair in _halves_beside_slopes(state, iteration, view_ids)])


def _halves_beside_slopes(
    state: TrainState, iteration: Iteration, view_ids: Sequence[int]
) -> Iterator[tuple[Half, Half]]:
    for _, photograph, rendered, is_counted in pairs(state, iteration, view_ids):
        yield split_halves(photograph - rendered, slopes(rendered), is_counted)


def slopes(image: Floats) -> Floats:
    """Return the derivatives [2, H, W, 3] of an image along u and v, per pixel; 0 across an image one pixel wide."""
    axes = (1, 0)
    return np.stack([np.gradient(image, axis=a) if image.shape[a] > 1 else np.zeros_like(image) for a in axes])
