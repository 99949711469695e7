"""The population of OMG: Gaussians with few features, the networks that read them, and codebooks.

Three parts of a training follow one another. At first the population is that of 3DGS: ``features`` and ``codes`` have
no columns. Then six features replace opacity and colour, and networks compute these. In the end scales,
rotations and features are indices into codebooks, and the codebooks are trained. The shapes of the arrays alone
determine which part it is.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.io.label import Label
from minisplat_ref.io.ply import load_ply, save_ply
from minisplat_ref.mechanisms.networks.mlp import make_network, network_rates, to_shared
from minisplat_ref.training.rates import LogLinear, Rates
from minisplat_ref.types import Floats, Gaussians, Scene

N_STATIC, N_VIEW = 3, 3  # features of a Gaussian: T, for colour and opacity, and V, for view dependence
N_SPACE = 13  # features of a place, F
N_OCTAVES = 16
HIDDEN = 64
SPACE, COLOR, OPACITY, HARMONICS = "space", "color", "opacity", "harmonics"
SIZES = {
    SPACE: (6 * N_OCTAVES, HIDDEN, N_SPACE),
    COLOR: (N_STATIC + N_SPACE, HIDDEN, 3),
    OPACITY: (N_STATIC + N_SPACE, HIDDEN, 1),
    HARMONICS: (N_VIEW + N_SPACE, HIDDEN, 45),
}
"""Inputs, hidden layer and outputs of each network, as in the paper."""
PLACE = "place"
"""Name of the shared array [4]: a centre of the scene, and one over its radius, in which networks read places."""
CODEBOOKS = {"scale_codes": (3, 64, 1), "rotation_codes": (2, 512, 2), "feature_codes": (3, 1024, 2)}
"""Parts, codes of each and numbers of a code, as in the paper. The parts in this order are the columns of ``codes``."""


class OmgGaussians(NamedTuple):
    """Gaussians whose attributes may be features and codes; the other fields are those of :class:`Gaussians`."""

    means: Floats
    quats: Floats
    log_scales: Floats
    opacity_logits: Floats
    sh_dc: Floats
    sh_rest: Floats
    features: Floats
    """[N, 6] T and V, from which networks compute opacity and colour; [N, 0] where these are the fields above."""
    codes: Floats
    """[N, 8] whole numbers: rows of the codebooks, in which scales, rotations and features then are; 5 columns without
    features, 0 before there are codes. An event sets them; they have no gradient."""


def without_features(gaussians: Gaussians, rng: np.random.Generator) -> OmgGaussians:
    """Return the Gaussians as those of 3DGS."""
    nothing = np.zeros((len(gaussians.means), 0), gaussians.means.dtype)
    fields = {name: getattr(gaussians, name) for name in Gaussians._fields}
    return OmgGaussians(**fields, features=nothing, codes=nothing.copy())


def with_features(gaussians: Gaussians, rng: np.random.Generator) -> OmgGaussians:
    """Return the Gaussians with random features around their colours, without codes."""
    view = 0.1 * rng.normal(size=(len(gaussians.means), N_VIEW)).astype(gaussians.means.dtype)
    features = np.concatenate([gaussians.sh_dc, view], axis=1)
    return without_features(gaussians, rng)._replace(features=features)


def save_plain(path: str | Path, gaussians: Any, label: Label) -> None:
    """Write the six fields of 3DGS, into which the recipe's last event has decoded features and codes."""
    save_ply(path, Gaussians(*gaussians[: len(Gaussians._fields)]), label)


def load_plain(path: str | Path, population: Any) -> Gaussians:
    """Read the six fields, whatever the population's type: its renderer treats them as 3DGS does."""
    gaussians: Gaussians = load_ply(path)
    return gaussians


def initial_shared(scene: Scene, rng: np.random.Generator) -> Mapping[str, Floats]:
    """Return random networks, empty codebooks, and the bounds of the scene, float32; ``rng`` itself is not advanced."""
    shared: dict[str, Floats] = {}
    (rng,) = rng.spawn(1)  # so that until there are features, a training is that of Mini-Splatting
    for name, sizes in SIZES.items():
        shared |= to_shared(name, make_network(sizes, rng))
    shared |= {name: np.zeros(shape) for name, shape in CODEBOOKS.items()}
    shared[PLACE] = place_of(scene)
    return {name: array.astype(np.float32) for name, array in shared.items()}


def place_of(scene: Scene) -> Floats:
    """Return the median of the scene's points and one over the radius in which nine tenths are, [4], float64."""
    if not len(scene.points):
        return np.array([0.0, 0.0, 0.0, 1 / scene.extent])
    center = np.median(scene.points.astype(np.float64), axis=0)
    radius = np.quantile(np.linalg.norm(scene.points - center, axis=1), 0.9)
    return np.append(center, 1 / (radius if radius > 0 else scene.extent))


_NETWORK_RATE = LogLinear(1e-3, 1e-4, 30_000)
RATES = Rates(
    {
        "features": 2.5e-3,
        "codes": 0.0,
        PLACE: 0.0,
        **{"scale_codes": 5e-3, "rotation_codes": 1e-3, "feature_codes": 2.5e-3},
        **{key: rate for name in SIZES for key, rate in network_rates(name, 2, _NETWORK_RATE).items()},
    },
    frozenset(),
)
"""Codes have the rates of 3DGS for the fields that they hold, features that of its colours. The networks' is chosen
here."""
