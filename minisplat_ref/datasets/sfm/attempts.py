"""Reconstruct with what costs least; what costs more is tried only where that fails.

==================  ===============================  ==========================================
first               then                             if
==================  ===============================  ==========================================
neighbours in time  all other pairs                  photographs have no place
standard features   dense ones                       photographs have no place with any pair
incremental mapper  the global one                   see :func:`.judging.is_good`
==================  ===============================  ==========================================

Dense features are matched first between the photographs without a place and the others, thoroughly. Unless that
connects at least one of them, the rest is left out; otherwise it is matched less thoroughly. ``docs/measured/sfm.md``
has what each of these brings and costs.
"""

import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from minisplat_ref.datasets.sfm.features import (
    DENSE,
    STANDARD,
    Features,
    Pair,
    find_features,
    is_connected,
    match_features,
    overlapping_pairs,
    pairs_to_match,
    reaches,
)
from minisplat_ref.datasets.sfm.judging import Matches, choose, is_good, read_matches
from minisplat_ref.datasets.sfm.mapping import Mapped, map_photographs
from minisplat_ref.datasets.sfm.photographs import Group, Photographs
from minisplat_ref.datasets.sfm.zoom import copy_database, own_groups, split_groups
from minisplat_ref.interface.progress import say

ROUNDS = 2  # in which photographs are told apart by their focal lengths, the second one with right cameras
ZOOM_SHARE = 0.5  # of the photographs, ours; with fewer placed, one camera for all of a size may be why
FEW = 20  # photographs: neighbours are nearly all of their pairs, so all are matched at once


class Part(NamedTuple):
    """A part of the work, and what it has cost."""

    name: str
    n: int
    """Photographs or pairs."""
    seconds: float
    """Of the processor, over all threads."""


class Reconstructed(NamedTuple):
    """The results, and how they came about."""

    best: Mapped
    others: list[Mapped]
    n_matches: int
    """Verified matches with which they were judged."""
    groups: Mapping[Group, list[str]]
    """Names of the photographs of one camera."""
    parts: tuple[Part, ...]


class Attempt:
    """The photographs with one kind of features.

    Parameters
    ----------
    photographs : Photographs
    work : Path
        Folder for COLMAP's files; one of its own for each kind.
    kind : Features
    camera_model : str
        COLMAP model of the cameras.
    groups : mapping, optional
        Names of the photographs of one camera, where they have been told apart since.
    """

    def __init__(
        self,
        photographs: Photographs,
        work: Path,
        kind: Features,
        camera_model: str,
        groups: dict[Group, list[str]] | None = None,
    ) -> None:
        self._given, self._kind, self._camera_model = photographs.groups, kind, camera_model
        photographs = photographs if groups is None else photographs._replace(groups=groups)
        self.photographs, self.parts = photographs, list[Part]()
        self._folder, self._n_mapped = work / kind.name, 0
        self._folder.mkdir()
        self.database = self._folder / "database.db"
        with self._timed("features", len(photographs.originals)):
            find_features(self.database, photographs, kind, camera_model)

    def match(self, pairs: Sequence[Pair], *, is_thorough: bool = True) -> None:
        """Match pairs of photographs, in addition to what is matched already, as thoroughly as the features allow."""
        with self._timed("matches", len(pairs)):
            kind = self._kind._replace(is_guided=self._kind.is_guided and is_thorough)
            match_features(self.database, self._folder, pairs, kind)

    def map(self) -> tuple[list[Mapped], list[Matches]]:
        """Return the results with all matches so far, and these; photographs may turn out to have been zoomed."""
        n_photos = len(self.photographs.originals)
        matches = read_matches(self.database)
        kept = self._map(self.database, matches)
        best, others = choose(kept, matches)
        shown, kept = best, [best, *others]
        if best.n_placed < ZOOM_SHARE * n_photos and (own := own_groups(self.photographs.groups)):
            shown = max(self._remap(own, matches), key=lambda result: result.n_placed)
        for _ in range(ROUNDS):
            groups = split_groups(shown.model, self._given)
            if {*map(tuple, groups.values())} == {*map(tuple, self.photographs.groups.values())}:
                break
            zoomed = self._remap(groups, matches)
            shown = max(zoomed, key=lambda result: result.n_placed)
            if shown.n_placed < best.n_placed:
                break
            kept, self.photographs = zoomed, self.photographs._replace(groups=groups)
        return kept, matches

    def _remap(self, groups: dict[Group, list[str]], matches: Sequence[Matches]) -> list[Mapped]:
        """Return the results with other groups of one camera."""
        regrouped = self._folder / f"regrouped{self._n_mapped}.db"
        copy_database(self.database, regrouped, self.photographs._replace(groups=groups), self._camera_model)
        return self._map(regrouped, matches)

    def _map(self, database: Path, matches: Sequence[Matches]) -> list[Mapped]:
        """Return the results of the first mapper, and of the second one if that is poor."""
        n_photos, folder = len(self.photographs.originals), self._folder / f"{self._n_mapped}"
        self._n_mapped += 1
        results: list[Mapped] = []
        found = map_photographs(database, self.photographs.images, folder, self._kind.name, n_photos)
        for name in ("first mapper", "second mapper"):
            with self._timed(name, n_photos):
                results.append(next(found))
            if is_good(results[-1], matches, n_photos):
                break
        return results

    @contextmanager
    def _timed(self, name: str, n: int) -> Iterator[None]:
        start = time.process_time()
        yield
        self.parts.append(Part(f"{self._kind.name} {name}", n, time.process_time() - start))


def reconstruct(photographs: Photographs, work: Path, matching: str, features: str, camera_model: str) -> Reconstructed:
    """Reconstruct the cameras of photographs; see :func:`minisplat_ref.datasets.sfm.run_sfm` for the arguments."""
    n_photos = len(photographs.originals)
    standard = Attempt(photographs, work, STANDARD, camera_model)
    all_pairs, results, matches = _match_in_steps(standard, matching)
    best, others = choose(results, matches)
    last, parts = standard, standard.parts
    if features == "dense" or (features == "auto" and best.n_placed < n_photos):
        placed = _placed(best)
        pairs = overlapping_pairs(standard.database, all_pairs, placed)
        if features == "auto" and placed:
            n_lost = n_photos - len(placed)
            say(f"without a place: {n_lost} of {n_photos} photographs; dense features, {len(pairs):,} pairs")
        dense = Attempt(photographs, work, DENSE, camera_model, standard.photographs.groups)
        if _match_lost_first(dense, pairs, placed, is_asked=features == "dense"):
            found, matches = dense.map()
            best, others = choose(found if features == "dense" else [best, *others, *found], matches)
            last = dense
        parts = [*parts, *dense.parts]
    n_matches = sum(len(pair.first) for pair in matches)
    return Reconstructed(best, others, n_matches, last.photographs.groups, tuple(parts))


def _match_in_steps(attempt: Attempt, matching: str) -> tuple[list[Pair], list[Mapped], list[Matches]]:
    """Match neighbours first if that is due, map, and match all pairs if photographs are left without a place.

    Returns
    -------
    pairs : list of Pair
        All that may be matched.
    results, matches
        As of :meth:`Attempt.map`.
    """
    names = attempt.photographs.ordered
    is_in_steps = matching == "auto" and len(names) > FEW
    pairs = pairs_to_match(names, "sequential" if is_in_steps or matching == "sequential" else "exhaustive")
    attempt.match(pairs)
    if not is_in_steps:
        return pairs, *attempt.map()
    further = sorted(set(pairs_to_match(names, "exhaustive")) - set(pairs))
    if is_connected(attempt.database):
        results, matches = attempt.map()
        if not further or max(result.n_placed for result in results) == len(names):
            return pairs, results, matches
    say(f"neighbours in time do not place all photographs: {len(further):,} further pairs are matched")
    attempt.match(further)
    return [*pairs, *further], *attempt.map()


def _match_lost_first(attempt: Attempt, pairs: Sequence[Pair], placed: frozenset[str], is_asked: bool) -> bool:
    """Match the pairs of photographs without a place, then the others; return whether that is worth mapping.

    Unless dense features were asked for, the others are not matched along epipolar lines once more, because they have
    a place already; and they are left out where no lost photograph is connected.
    """
    lost = [pair for pair in pairs if not placed.issuperset(pair)]
    attempt.match(lost)
    if not is_asked and placed and not reaches(attempt.database, placed):
        say("dense features do not connect them either")
        return False
    attempt.match([pair for pair in pairs if placed.issuperset(pair)], is_thorough=is_asked or not placed)
    return True


def _placed(result: Mapped) -> frozenset[str]:
    """Return the names of the photographs that have a place."""
    images = [] if result.model is None else result.model.images.values()
    return frozenset(image.name for image in images if image.has_pose)
