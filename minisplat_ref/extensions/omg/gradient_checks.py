"""Stages for the gradient check: the renderer with its networks, and with codebooks instead.

The networks are as those of the recipe, but small: every weight is checked. Positions are constants of the gradient
(:mod:`.decoding`), so they are fixed here, too. A leaky ReLU has a kink at 0, where differences are refused.
"""

import numpy as np

from minisplat_ref.extensions.omg.decoding import gather, run_networks, split_codes
from minisplat_ref.extensions.omg.population import (
    COLOR,
    HARMONICS,
    N_STATIC,
    N_VIEW,
    OPACITY,
    SPACE,
    OmgGaussians,
    without_features,
)
from minisplat_ref.extensions.omg.renderer import COMPACT, FIELDS, make_renderer
from minisplat_ref.mechanisms.networks.mlp import make_network, to_shared
from minisplat_ref.mechanisms.networks.networks import IN_NUMPY
from minisplat_ref.oracle.models import Drawn, model_stage
from minisplat_ref.oracle.setting import Setting
from minisplat_ref.oracle.stages import Stage
from minisplat_ref.rendering.backends import Backend
from minisplat_ref.training.rates import Rates
from minisplat_ref.types import Floats, Gaussians

HIDDEN, N_SPACE, N_OCTAVES = 4, 2, 2
N_CODES = 3  # of each part
REPLACED = ("opacity_logits", "sh_dc", "sh_rest")  # by networks


def stages(backend: Backend, setting: Setting, rng: np.random.Generator) -> tuple[Stage, ...]:
    """Return both."""
    n, n_rest = setting.gaussians.sh_rest.shape[:2]
    features = rng.normal(size=(n, N_STATIC + N_VIEW))
    shared = _networks(max(1, 3 * n_rest), rng)
    books = {
        "scale_codes": setting.gaussians.log_scales[:N_CODES].T[..., None].copy(),
        "rotation_codes": rng.normal(size=(2, N_CODES, 2)),
        "feature_codes": rng.normal(size=(3, N_CODES, 2)),
    }
    codes = np.stack([rng.permutation(n) % N_CODES for _ in range(8)], axis=1).astype(float)
    plain = without_features(setting.gaussians, rng)
    with_networks = plain._replace(features=features)
    with_codes = with_networks._replace(codes=codes)
    return (
        _stage(backend, setting, with_networks, shared, rng),
        _stage(backend, setting, with_codes, shared | books, rng)._replace(name=f"render {COMPACT.name} with codes"),
    )


def _networks(n_harmonics: int, rng: np.random.Generator) -> dict[str, Floats]:
    sizes = {
        SPACE: (6 * N_OCTAVES, HIDDEN, N_SPACE),
        COLOR: (N_STATIC + N_SPACE, HIDDEN, 3),
        OPACITY: (N_STATIC + N_SPACE, HIDDEN, 1),
        HARMONICS: (N_VIEW + N_SPACE, HIDDEN, n_harmonics),
    }
    networks = {name: make_network(of_network, rng) for name, of_network in sizes.items()}
    return {key: array for name, network in networks.items() for key, array in to_shared(name, network).items()}


def _stage(
    backend: Backend, setting: Setting, population: OmgGaussians, shared: dict[str, Floats], rng: np.random.Generator
) -> Stage:
    """Return the renderer as a function of the fields of a population that are read, and of the shared parameters."""
    encoding = IN_NUMPY.fourier(setting.gaussians.means, N_OCTAVES)
    has_codes = population.codes.shape[1] > 0
    held = (*REPLACED, "codes", *(FIELDS.values() if has_codes else ()))
    representation = COMPACT._replace(
        extend=lambda gaussians, rng: population._replace(
            **{name: getattr(gaussians, name) for name in Gaussians._fields}
        ),
        shared=lambda scene, rng: shared,
        renderer=make_renderer(lambda means, shared, networks: encoding),
        rates=Rates(dict.fromkeys(held, 0.0), frozenset()),
    )

    def sides(drawn: Drawn) -> list[np.ndarray]:
        features, shared = drawn.model.gaussians.features, drawn.model.shared
        if has_codes:
            rows = split_codes(population.codes, shared, tuple(FIELDS))["feature_codes"]
            features = gather(shared["feature_codes"], rows)
        tapes = run_networks(features, encoding, shared, IN_NUMPY).tapes
        return [inputs[1] > 0 for inputs in tapes.values()]

    return model_stage(backend, setting, representation, rng, sides_of=sides)
