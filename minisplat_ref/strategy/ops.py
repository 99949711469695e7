"""Row operations on a population, which is any NamedTuple of [N, ...] arrays.

Parameters, Adam moments and gradients go through the same functions, so a population with further fields needs no
additional code.
"""

from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from minisplat_ref.types import Bools, Gaussians, Ints

Population = TypeVar("Population", bound=NamedTuple)

NO_PARENT = -1  # in Edit.parent_ids


class Edit(NamedTuple):
    """A new population, and where each of its rows comes from."""

    gaussians: Gaussians
    """M rows."""
    parent_ids: Ints
    """[M] row of the old population that this one is, or descends from; ``NO_PARENT`` where there is none."""
    is_new: Bools
    """[M] whether the row starts with zero moments; such a row may still have a parent (a clone)."""


def n_rows(population: NamedTuple) -> int:
    """Return N."""
    return len(population[0])


def take(population: Population, rows: Ints | Bools) -> Population:
    """Return the chosen rows, copied.

    Parameters
    ----------
    population : NamedTuple of ndarrays of shape (N, ...)
    rows : ndarray of shape (M,) of ids, or of shape (N,) of booleans
    """
    return population._make(field[rows] for field in population)


def concat(*populations: Population) -> Population:
    """Return the rows of all populations, one after the other."""
    return populations[0]._make(np.concatenate(fields) for fields in zip(*populations, strict=True))


def contiguous(population: Population) -> Population:
    """Return the population with every field C-contiguous; fields that already are are not copied."""
    return population._make(np.ascontiguousarray(field) for field in population)


def inherit(field: NDArray[Any], parent_ids: Ints, is_reset: Bools) -> NDArray[Any]:
    """Return one array of the edited population: the parents' rows, or zeros where ``is_reset`` or without a parent.

    Parameters
    ----------
    field : ndarray of shape (N, ...)
    parent_ids : ndarray of shape (M,)
        As in :class:`Edit`.
    is_reset : ndarray of shape (M,) of booleans
    """
    is_zero = is_reset | (parent_ids == NO_PARENT)  # [M]
    inherited = np.zeros((len(parent_ids), *field.shape[1:]), field.dtype)  # [M, ...]
    inherited[~is_zero] = field[parent_ids[~is_zero]]
    return inherited


def inherit_fields(population: Population, parent_ids: Ints, is_reset: Bools) -> Population:
    """Return :func:`inherit` of every field."""
    return population._make(inherit(field, parent_ids, is_reset) for field in population)


def keep(gaussians: Gaussians, rows: Ints | Bools) -> Edit:
    """Return the edit that keeps the chosen rows as they are."""
    parent_ids = np.arange(n_rows(gaussians))[rows]
    return Edit(take(gaussians, rows), parent_ids, np.zeros(len(parent_ids), bool))
