"""The population of CUS-GS: anchors at the centres of voxels, the networks that all share, and the memory of features.

An anchor has a latent z and K offsets. Its other fields are those of one Gaussian of 3DGS, which viewers show instead
of it: the colour of its points, an opacity and a rotation that are not trained, and the scale that its Gaussians begin
with.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.errors import InputError
from minisplat_ref.extensions.cus.bank import first_keys, remember
from minisplat_ref.extensions.cus.maps import check_depths, feature_map, sample_rows
from minisplat_ref.io.frames import Unit
from minisplat_ref.mechanisms.networks.mlp import Layer, make_network, network_rates, to_shared
from minisplat_ref.strategy.clone_split import logit
from minisplat_ref.strategy.initialization import INITIAL_OPACITY
from minisplat_ref.training.rates import LogLinear, Rates
from minisplat_ref.training.representation import WORLD_UNITS
from minisplat_ref.types import Floats, Gaussians, Scene

OPACITY, SHAPE, COLOR, QUERY = "opacity", "shape", "color", "query"
NETWORKS = {OPACITY: 1, SHAPE: 7, COLOR: 3}
"""Outputs of each network for a Gaussian: a logit; three logarithms of scales and a quaternion; a colour."""
CAMERAS, MIX, MEMORY, KEYS, ADAPTER = "camera_embeddings", "query_mix", "memory", "memory_keys", "adapter"
LATENT_SPREAD = 0.1  # standard deviation of first latents: equal ones would stay equal where photographs agree


class Anchors(NamedTuple):
    """Voxels with the latents that are decoded to Gaussians; the first six fields are those of :class:`Gaussians`."""

    means: Floats
    """[N, 3] centres of the voxels, world frame; not trained."""
    quats: Floats
    log_scales: Floats
    """[N, 3] to which the networks add."""
    opacity_logits: Floats
    sh_dc: Floats
    sh_rest: Floats
    """[N, 0, 3]: the networks' colour depends on the direction."""
    latents: Floats
    """[N, L] z."""
    offsets: Floats
    """[N, 3 K] of the K Gaussians from the centre, world units."""

    @property
    def n_children(self) -> int:
        """Return K, the Gaussians of an anchor."""
        return self.offsets.shape[1] // 3


def as_anchors(gaussians: Gaussians, rng: np.random.Generator, *, voxel: float, children: int, latent: int) -> Anchors:
    """Return an anchor for each voxel that has a Gaussian, with the mean colour of these.

    Voxels have the side ``l = voxel s``, where s is the median scale of the Gaussians, at the start the distance of a
    point to its neighbours.

    Parameters
    ----------
    gaussians : Gaussians
    rng : numpy.random.Generator
    voxel : float
        Side in units of the median scale.
    children : int
        K.
    latent : int
        L, numbers of a latent.

    Raises
    ------
    InputError
        A number is below 1, or the side is not above 0.
    """
    if children < 1 or latent < 1 or not voxel > 0:
        raise InputError(f"children={children} and latent={latent} are numbers from 1 on, voxel={voxel:g} is above 0")
    side = voxel_side(gaussians, voxel)
    cells, rows = np.unique(np.round(gaussians.means.astype(np.float64) / side), axis=0, return_inverse=True)
    n, rows = len(cells), rows.ravel()
    counts = np.maximum(np.bincount(rows, minlength=n), 1)
    colors = np.stack([np.bincount(rows, weights=channel, minlength=n) for channel in gaussians.sh_dc.T], axis=1)
    dtype = gaussians.means.dtype
    latents = (LATENT_SPREAD * rng.normal(size=(n, latent))).astype(dtype)
    return at_rest(cells * side, (colors / counts[:, None]).astype(dtype), latents, side, children, rng)


def voxel_side(gaussians: Gaussians, voxel: float) -> float:
    """Return the side l of voxels, world units: ``voxel`` times the median scale of Gaussians, 1 if there are none."""
    if not len(gaussians.means):
        return 1.0
    return voxel * float(np.exp(np.median(gaussians.log_scales.astype(np.float64))))


def at_rest(
    centers: Floats, sh_dc: Floats, latents: Floats, side: float, children: int, rng: np.random.Generator
) -> Anchors:
    """Return anchors as they begin.

    The offsets are drawn evenly over the voxel, and the scale is ``side / sqrt(K)``, as K Gaussians side by side cover
    a surface through it.

    Parameters
    ----------
    centers : ndarray of shape (N, 3)
        World frame.
    sh_dc : ndarray of shape (N, 3)
    latents : ndarray of shape (N, L)
        Of the dtype that all fields get.
    side : float
        Of the voxels, world units.
    children : int
        K.
    rng : numpy.random.Generator
    """
    n, dtype = len(centers), latents.dtype
    return Anchors(
        means=centers.astype(dtype),
        quats=np.tile(np.array([1.0, 0, 0, 0], dtype), (n, 1)),
        log_scales=np.full((n, 3), np.log(side / np.sqrt(children)), dtype),
        opacity_logits=np.full(n, logit(INITIAL_OPACITY), dtype),
        sh_dc=sh_dc,
        sh_rest=np.zeros((n, 0, 3), dtype),
        latents=latents,
        offsets=(side * rng.uniform(-0.5, 0.5, size=(n, 3 * children))).astype(dtype),
    )


def initial_shared(
    scene: Scene,
    rng: np.random.Generator,
    *,
    children: int,
    latent: int,
    hidden: int,
    embedding: int,
    query: int,
    features: str,
    similarity: float,
) -> Mapping[str, Floats]:
    """Return networks whose outputs are 0, embeddings of 0, and the memory of the photographs' features; float32.

    Parameters
    ----------
    scene : Scene
    rng : numpy.random.Generator
    children, latent
        As for :func:`as_anchors`.
    hidden : int
        Units of each network's hidden layer.
    embedding : int
        E, numbers of the embedding of a photograph.
    query : int
        d, numbers of a query.
    features : str
        Folder of feature maps; empty for the classical ones (:mod:`.maps`).
    similarity : float
        gamma: cosine from which on a feature counts as present in the memory (:mod:`.bank`).

    Raises
    ------
    InputError
        A number is below 1, or the similarity no cosine; a map cannot be read, or has another depth than the others.
    """
    if min(hidden, embedding, query) < 1:
        raise InputError(f"hidden={hidden}, embedding={embedding} and query={query} are numbers from 1 on")
    if not -1 < similarity <= 1:
        raise InputError(f"similarity={similarity:g} is a cosine: give a number above -1, at most 1")
    (rng,) = rng.spawn(1)
    shared: dict[str, Floats] = {}
    for name, width in NETWORKS.items():
        shared |= to_shared(name, _starting_at_zero((latent + 3 + embedding, hidden, width * children), rng))
    shared |= to_shared(QUERY, make_network((latent + 3 + embedding, hidden, query), rng))
    shared |= to_shared(MIX, (Layer(np.eye(query + 3, query), np.zeros(query)),))
    shared[CAMERAS] = np.zeros((len(scene.train_views), embedding))
    n_channels: dict[str, int] = {}
    rows = []
    for view in scene.train_views:
        of_view = feature_map(view, features)
        n_channels[view.name] = of_view.shape[2]
        rows.append(sample_rows(of_view, rng))
    check_depths(n_channels, features)
    memory = remember(rows, similarity)
    shared |= {MEMORY: memory, KEYS: first_keys(memory, query), ADAPTER: np.eye(memory.shape[1])}
    return {name: array.astype(np.float32) for name, array in shared.items()}


def _starting_at_zero(sizes: tuple[int, ...], rng: np.random.Generator) -> tuple[Layer, ...]:
    """Return a random network whose last layer is 0."""
    *first, last = make_network(sizes, rng)
    return (*first, Layer(np.zeros_like(last.weights), np.zeros_like(last.biases)))


FIXED = dict.fromkeys(("means", "quats", "opacity_logits", "sh_dc", "sh_rest", MEMORY), 0.0)
_RATE = LogLinear(2e-3, 2e-5, 30_000)
RATES: Mapping[str, Any] = {
    **FIXED,
    "latents": 2e-2,
    "offsets": LogLinear(1.6e-4, 1.6e-6, 30_000),
    CAMERAS: LogLinear(1e-3, 1e-5, 30_000),
    **{key: rate for name in (OPACITY, SHAPE) for key, rate in network_rates(name, 2, _RATE).items()},
    **network_rates(COLOR, 2, LogLinear(8e-3, 8e-5, 30_000)),
    **network_rates(QUERY, 2, LogLinear(5e-3, 5e-5, 30_000)),
    **network_rates(MIX, 1, LogLinear(5e-3, 5e-5, 30_000)),
    KEYS: LogLinear(1e-2, 1e-4, 30_000),
    ADAPTER: LogLinear(1e-2, 1e-4, 30_000),
}
ANCHOR_RATES = Rates(RATES, frozenset({"offsets"}))
UNITS = {**WORLD_UNITS, "offsets": Unit.LENGTH}
