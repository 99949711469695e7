"""The functions of networks and encodings for a backend."""

from collections.abc import Callable
from typing import Any, NamedTuple

from minisplat_ref.mechanisms.networks import fourier, fourier_kernels, hash_grid, hash_kernels, mlp, mlp_kernels
from minisplat_ref.rendering.backends import Backend


class Networks(NamedTuple):
    """Functions with the same arguments and results, in NumPy or compiled."""

    forward: Callable[..., Any]
    """:func:`.mlp.forward`."""
    forward_vjp: Callable[..., Any]
    fourier: Callable[..., Any]
    """:func:`.fourier.encode`."""
    fourier_vjp: Callable[..., Any]
    hash_grid: Callable[..., Any]
    """:func:`.hash_grid.encode`."""
    hash_grid_vjp: Callable[..., Any]


IN_NUMPY = Networks(
    mlp.forward, mlp.forward_vjp, fourier.encode, fourier.encode_vjp, hash_grid.encode, hash_grid.encode_vjp
)
COMPILED = Networks(
    mlp_kernels.forward,
    mlp_kernels.forward_vjp,
    fourier_kernels.encode,
    fourier_kernels.encode_vjp,
    hash_kernels.encode,
    hash_kernels.encode_vjp,
)


def networks_for(backend: Backend) -> Networks:
    """Return the kernels where the backend is compiled, else the functions in NumPy."""
    return COMPILED if backend.is_compiled else IN_NUMPY
