"""The loss: a weighted sum of terms, each of which returns its value and its derivatives.

A term is a function of what was rendered. It returns its value with its *cotangents*, the derivatives of the value with
respect to the channels of the image, alpha, the fields of the population and the shared parameters, as far as it
depends on them. The loss is ``L = sum_k w_k L_k``, and its cotangents are the same sum. A recipe lists the terms of a
method, with their iterations, as data.
"""

from collections.abc import Callable, Mapping, Sequence
from fractions import Fraction
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.rendering import Request
from minisplat_ref.types import NOTHING, Floats, Model, RenderOutput, Scene, View


class Rendered(NamedTuple):
    """The input of a loss term: one rendered training view and its context."""

    output: RenderOutput
    """Image [H, W, D] with all channels that the terms want, and alpha."""
    channels: Mapping[str, slice]
    """Each channel's slice of the last axis of the image: ``rgb``, ``depth``, ..."""
    view: View
    """The photograph."""
    scene: Scene
    model: Model
    step: int
    """Iteration, from 1."""
    request: Request
    """Options of the rendering: backend, conventions, background."""
    held: Any = None
    """The same view at the values that derivatives hold constant, while a check moves the others; None: itself."""

    @property
    def constant(self) -> "Rendered":
        """Return the inputs that derivatives hold constant, such as a target made from the rendering."""
        return self if self.held is None else self.held

    def channel(self, name: str) -> Floats:
        """Return channel ``name`` of the image, [H, W, d], C-contiguous."""
        return np.ascontiguousarray(self.output.image[..., self.channels[name]])


class Cotangents(NamedTuple):
    """Derivatives of a loss with respect to its direct inputs; those left out are zero."""

    channels: Mapping[str, Floats] = NOTHING
    """By name of the channel, [H, W, d] each."""
    alpha: Floats | None = None
    """[H, W]."""
    gaussians: Mapping[str, Floats] = NOTHING
    """By field of the population, [N, ...] each: for terms on the parameters themselves, such as an opacity penalty."""
    shared: Mapping[str, Floats] = NOTHING
    """By name of the shared parameter."""


class LossTerm(NamedTuple):
    """One term of the loss, as data."""

    name: str
    """The NAME in ``--set NAME=WEIGHT``."""
    function: Callable[[Rendered], tuple[float, Cotangents]]
    """Its settings are bound with ``functools.partial``, so that ``--set`` reaches them too."""
    weight: float
    """Factor; 0 leaves out the term and its outputs."""
    wants: frozenset[str] = frozenset()
    """Outputs that it needs besides ``rgb``; see :class:`minisplat_ref.rendering.Request`."""
    start: int = 0
    stop: int | None = None

    def is_due(self, step: int) -> bool:
        """Return whether the term counts in iteration ``step``, counted from 1."""
        return self.weight != 0 and self.start < step and (self.stop is None or step < self.stop)

    def scale(self, factor: Fraction) -> "LossTerm":
        """Return the term with its iterations multiplied by ``factor``."""
        return self._replace(
            start=round(self.start * factor), stop=None if self.stop is None else round(self.stop * factor)
        )


def photometric(rendered: Rendered, *, dssim_weight: float) -> tuple[float, Cotangents]:
    """Compare the image with the photograph: ``(1 - w) L1 + w (1 - SSIM)``, 3DGS equation (7).

    Parameters
    ----------
    rendered : Rendered
    dssim_weight : float
        w.
    """
    view, backend = rendered.view, rendered.request.backend
    loss, tape = backend.photometric_loss(rendered.channel("rgb"), view.image, dssim_weight, view.mask)
    return loss, Cotangents({"rgb": backend.photometric_loss_vjp(tape)})


def photometric_of_part(rendered: Rendered, *, dssim_weight: float) -> tuple[float, Cotangents]:
    """Compare the part of a photograph that its mask shows, weighed by its share of the pixels.

    :func:`photometric` is a mean over the pixels that count. A pixel of a part would weigh more than in the whole
    photograph, and gradients would pass the thresholds of densification sooner.
    """
    loss, v = photometric(rendered, dssim_weight=dssim_weight)
    mask = rendered.view.mask
    share = 1.0 if mask is None else float(mask.mean())
    return share * loss, v._replace(channels={name: share * v_channel for name, v_channel in v.channels.items()})


class Loss(NamedTuple):
    """The weighted sum of the terms."""

    value: float
    v_image: Floats
    """[H, W, D] derivative with respect to the image, all channels."""
    v_alpha: Floats | None
    """[H, W]; None where no term depends on alpha."""
    v_gaussians: Mapping[str, Floats]
    """Direct derivatives with respect to fields of the population, without those via the image."""
    v_shared: Mapping[str, Floats]
    """Direct derivatives with respect to shared parameters."""


def total_loss(terms: Sequence[LossTerm], rendered: Rendered) -> Loss:
    """Return the sum of the terms and its derivatives, ``L = sum_k w_k L_k``.

    Parameters
    ----------
    terms : sequence of LossTerm
        Those that are due.
    rendered : Rendered
    """
    value, v_alpha = 0.0, None
    v_channels: dict[str, Floats] = {}
    v_gaussians: dict[str, Floats] = {}
    v_shared: dict[str, Floats] = {}
    for term in terms:
        part, v = term.function(rendered)
        value += term.weight * part
        _add(v_channels, v.channels, term.weight)
        _add(v_gaussians, v.gaussians, term.weight)
        _add(v_shared, v.shared, term.weight)
        if v.alpha is not None:
            v_alpha = _weigh(v.alpha, term.weight) if v_alpha is None else v_alpha + _weigh(v.alpha, term.weight)
    return Loss(value, _join_channels(v_channels, rendered), v_alpha, v_gaussians, v_shared)


def _weigh(v: Floats, weight: float) -> Floats:
    return v if weight == 1 else v.dtype.type(weight) * v


def _add(totals: dict[str, Floats], parts: Mapping[str, Floats], weight: float) -> None:
    for name, part in parts.items():
        totals[name] = totals[name] + _weigh(part, weight) if name in totals else _weigh(part, weight)


def _join_channels(v_channels: Mapping[str, Floats], rendered: Rendered) -> Floats:
    """Return the derivatives of all channels as one array [H, W, D], zero where no term depends on a channel."""
    image = rendered.output.image
    if list(v_channels) == ["rgb"] and image.shape[2] == 3:
        return v_channels["rgb"]
    v_image = np.zeros_like(image)
    for name, v in v_channels.items():
        v_image[..., rendered.channels[name]] = v
    return v_image
