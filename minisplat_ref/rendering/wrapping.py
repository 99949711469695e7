"""A renderer that changes what another one renders: Gaussians moved to the time of a view, decoded, or filtered.

With the inputs x of the wrapped renderer R as a function f of those of the new one, ``output = R(f(x))``, and the chain
rule is ``v_x = J_f^T v_f(x)``. A relative of 3DGS that differs in f alone states f and its VJP, and nothing else.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

from minisplat_ref.rendering.renderer import Renderer, RenderGradient, Request
from minisplat_ref.types import Floats, Model, RenderOutput, View

Inputs = tuple[Model, View, Request]
"""Everything that a renderer takes."""


class _Tape(NamedTuple):
    inner: Any  # of the wrapped renderer
    record: Any  # of f


def wrap(
    inner: Renderer,
    name: str,
    change: Callable[[Model, View, Request], tuple[Inputs, Any]],
    change_vjp: Callable[[Any, RenderGradient], RenderGradient],
) -> Renderer:
    """Return a renderer that changes its inputs before ``inner`` renders them.

    Parameters
    ----------
    inner : Renderer
        R.
    name : str
        Name of the new renderer.
    change : callable
        f: takes a model, a view and a request; returns those that ``inner`` gets, and a record for ``change_vjp``.
    change_vjp : callable
        Takes the record and the gradient of ``inner``; returns the gradient with respect to the inputs of ``change``.

    Returns
    -------
    Renderer
        With the channels of ``inner``, and opacities scaled where ``inner`` scales them.
    """

    def render_changed(model: Model, view: View, request: Request) -> tuple[RenderOutput, _Tape]:
        inputs, record = change(model, view, request)
        output, tape = inner.render(*inputs)
        return output, _Tape(tape, record)

    def render_changed_vjp(tape: _Tape, v_image: Floats, v_alpha: Floats | None = None) -> RenderGradient:
        return change_vjp(tape.record, inner.render_vjp(tape.inner, v_image, v_alpha))

    return Renderer(name, render_changed, render_changed_vjp, inner.channels, inner.scales_opacities)
