"""The renderer: features and codes become Gaussians, which 3DGS renders."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.extensions.omg.decoding import (
    Decoded,
    coded_names,
    encode_places,
    gather,
    gather_vjp,
    run_networks,
    run_networks_vjp,
    split_codes,
)
from minisplat_ref.extensions.omg.population import RATES, OmgGaussians, initial_shared, without_features
from minisplat_ref.mechanisms.networks.networks import Networks, networks_for
from minisplat_ref.rendering import SPLATTING, Renderer, RenderGradient, Request
from minisplat_ref.training.representation import Representation
from minisplat_ref.types import Floats, Ints, Model, RenderOutput, View

FIELDS = {"scale_codes": "log_scales", "rotation_codes": "quats", "feature_codes": "features"}
"""The field of the population that a codebook is for."""
Encode = Callable[[Floats, Any, Networks], Floats]


class Tape(NamedTuple):
    """Record of a decoding, for its gradient."""

    model: Model
    networks: Networks
    indices: dict[str, Ints]
    """[N, P] by codebook."""
    decoded: Decoded | None
    """None where no networks ran."""


def is_plain(gaussians: Any) -> bool:
    """Return whether a population is that of 3DGS: it has neither features nor codes."""
    return not isinstance(gaussians, OmgGaussians) or not (gaussians.features.shape[1] or gaussians.codes.shape[1])


def decode(model: Model, networks: Networks, encode: Encode = encode_places) -> tuple[OmgGaussians, Tape]:
    """Return the population with all fields of 3DGS as they are rendered, and the tape.

    ``encode`` returns the encoded places, which are constants of the gradient.
    """
    g, shared = model.gaussians, model.shared
    indices = split_codes(g.codes, shared, coded_names(g))
    for name, rows in indices.items():
        g = g._replace(**{FIELDS[name]: gather(shared[name].astype(g.means.dtype, copy=False), rows)})
    decoded = None
    if g.features.shape[1]:
        decoded = run_networks(g.features, encode(g.means, shared, networks), shared, networks)
        n, n_rest = g.sh_rest.shape[:2]
        rest = np.ascontiguousarray(decoded.harmonics[:, : 3 * n_rest]).reshape(n, n_rest, 3)
        g = g._replace(opacity_logits=decoded.logits, sh_dc=decoded.color, sh_rest=rest)
    return g, Tape(model, networks, indices, decoded)


def decode_vjp(tape: Tape, v: OmgGaussians) -> tuple[OmgGaussians, dict[str, Floats]]:
    """Gradient of :func:`decode` with respect to the population and the shared parameters.

    Fields that networks and codebooks replace get zeros: they are not read.
    """
    shared, v_shared = tape.model.shared, dict[str, Floats]()
    if tape.decoded is not None:
        n, n_rest = v.sh_rest.shape[:2]
        v_harmonics = np.zeros_like(tape.decoded.harmonics)
        v_harmonics[:, : 3 * n_rest] = v.sh_rest.reshape(n, 3 * n_rest)
        by_output = (v.sh_dc, v.opacity_logits, v_harmonics)
        v_features, v_shared = run_networks_vjp(shared, tape.decoded, by_output, tape.networks)
        v = v._replace(features=v_features)
        v = v._replace(**{name: np.zeros_like(getattr(v, name)) for name in ("opacity_logits", "sh_dc", "sh_rest")})
    for name, rows in tape.indices.items():
        field = getattr(v, FIELDS[name])
        v_shared[name] = gather_vjp(shared[name].astype(field.dtype, copy=False), rows, field)
        v = v._replace(**{FIELDS[name]: np.zeros_like(field)})
    return v, v_shared


def make_renderer(encode: Encode = encode_places) -> Renderer:
    """Return the renderer; ``encode`` as for :func:`decode`."""

    def render(model: Model, view: View, request: Request) -> tuple[RenderOutput, tuple[Any, Tape | None]]:
        """Decode, and render as 3DGS does."""
        if is_plain(model.gaussians):
            output, inner = SPLATTING.render(model, view, request)
            return output, (inner, None)
        gaussians, tape = decode(model, networks_for(request.backend), encode)
        output, inner = SPLATTING.render(model._replace(gaussians=gaussians), view, request)
        return output, (inner, tape)

    def render_vjp(tapes: tuple[Any, Tape | None], v_image: Floats, v_alpha: Floats | None) -> RenderGradient:
        """Gradient of the rendering: that of 3DGS, carried on to features, networks and codebooks."""
        inner, tape = tapes
        v = SPLATTING.render_vjp(inner, v_image, v_alpha)
        if tape is None:
            return v
        v_gaussians, v_shared = decode_vjp(tape, v.gaussians)
        return v._replace(gaussians=v_gaussians, shared=v_shared)

    return Renderer("omg", render, render_vjp, SPLATTING.channels)


COMPACT = Representation(
    "OMG",
    population=OmgGaussians,
    extend=without_features,
    shared=initial_shared,
    renderer=make_renderer(),
    rates=RATES,
)
"""Gaussians whose opacity and colour come to be computed by networks, and whose attributes come to be codes."""
