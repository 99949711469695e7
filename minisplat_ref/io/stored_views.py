"""Views whose photographs are read from disk on demand, for scenes whose photographs do not fit into memory.

A fixed set of photographs stays in memory: the first that are read, as many as fit into a given number of bytes.
Training cycles through all views, each time in a new order. With room for a fraction f of the photographs, a fixed set
saves the fraction f of the reading, whatever the order; a cache that evicts the least recently used saves
``f + (1 - f) ln(1 - f)``, 15 % with room for half of them, because the photograph used last is the one needed latest.
Where Gaussians need the memory, photographs are evicted.
"""

import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from minisplat_ref import memory
from minisplat_ref.types import Bools, View


class Pixels(NamedTuple):
    """The pixels of a photograph and its mask."""

    image: NDArray[np.uint8]
    """[H, W, 3], as :attr:`View.image`."""
    mask: Bools | None
    """[H, W], as :attr:`View.mask`."""

    @property
    def n_bytes(self) -> int:
        """Return the memory that they take, bytes."""
        return self.image.nbytes + (0 if self.mask is None else self.mask.nbytes)


class Shelf:
    """Room for photographs that stay in memory.

    Parameters
    ----------
    max_bytes : float
        How much all of them may take together.
    """

    def __init__(self, max_bytes: float) -> None:
        self._max_bytes = max_bytes
        self._n_bytes = 0
        self._cached: dict[Photograph, Pixels] = {}
        self._lock = threading.Lock()

    @property
    def n_bytes(self) -> int:
        """Return the memory that the photographs on it take, bytes."""
        return self._n_bytes

    @property
    def n_free(self) -> float:
        """Return the bytes that are still free."""
        return self._max_bytes - self._n_bytes

    def get(self, photograph: "Photograph") -> Pixels | None:
        """Return the pixels of a photograph if they are in memory."""
        return self._cached.get(photograph)

    def put(self, photograph: "Photograph", pixels: Pixels) -> None:
        """Keep the pixels of a photograph if there is room."""
        with self._lock:
            if pixels.n_bytes <= self.n_free:
                self._cached[photograph] = pixels
                self._n_bytes += pixels.n_bytes

    def resize(self, max_bytes: float) -> None:
        """Give the photographs more room, or less; those that came last are then evicted first."""
        with self._lock:
            self._max_bytes = max_bytes
            while self._cached and self.n_free < 0:
                self._n_bytes -= self._cached.popitem()[1].n_bytes


class Photograph:
    """A photograph on disk, whose pixels may stay in memory once they have been read.

    Parameters
    ----------
    read : callable
        Reads it; gives the same pixels every time.
    n_pixels : int
        Of the file, all of which have to be decoded.
    shelf : Shelf
        Where there may be room for them.
    may_stay : bool
        False for pixels that are computed from another photograph.
    """

    def __init__(self, read: Callable[[], Pixels], n_pixels: int, shelf: Shelf, may_stay: bool = True) -> None:
        self.n_pixels, self.shelf = n_pixels, shelf
        self._read, self._may_stay = read, may_stay
        self._lock = threading.Lock()

    def pixels(self) -> Pixels:
        """Return the pixels, from memory or from disk."""
        with self._lock:  # wait if another thread is reading it
            pixels = self.shelf.get(self)
            if pixels is None:
                pixels = self._read()
                if self._may_stay:
                    self.shelf.put(self, pixels)
            return pixels


class StoredView(View):
    """A view whose image and mask are read again at every access, unless they stay in memory.

    Code that needs both, or one of them twice, calls :meth:`load` once. Instead of the image the tuple has a
    :class:`Photograph`.
    """

    __slots__ = ()

    @property
    def photograph(self) -> Photograph:
        """Return the source of the pixels."""
        return cast(Photograph, self[2])

    @property
    def image(self) -> NDArray[np.uint8]:
        """Return the image [H, W, 3], as for any view."""
        return self.photograph.pixels().image

    @property
    def mask(self) -> Bools | None:
        """Return the mask [H, W] or None, as for any view."""
        return self.photograph.pixels().mask

    def load(self) -> View:
        """Return a view that holds its pixels."""
        image, mask = self.photograph.pixels()
        return View(*self)._replace(image=image, mask=mask)

    def _replace(self, **fields: Any) -> View:  # type: ignore[override]
        """Return the view with other fields; with another image or mask it has both in memory."""
        if fields.keys() & {"image", "mask"}:
            return self.load()._replace(**fields)
        return super()._replace(**fields)

    def change(self, change: Callable[[Pixels], Pixels]) -> View:
        """Return the view with pixels that are computed from its own at every access."""
        photograph = self.photograph
        changed: Any = Photograph(
            lambda: change(photograph.pixels()), photograph.n_pixels, photograph.shelf, may_stay=False
        )
        return super()._replace(image=changed)


def make_room(views: Sequence[View], needed: float) -> float:
    """Limit photographs to a share of the memory that remains free after other needs.

    Parameters
    ----------
    views : sequence of View
    needed : float
        Bytes that something else is about to take.

    Returns
    -------
    float
        How many more bytes the photographs will occupy once they have been read.
    """
    shelves = {view.photograph.shelf for view in views if isinstance(view, StoredView)}  # one, or none
    for shelf in shelves:
        free = memory.free_bytes() + shelf.n_bytes
        shelf.resize(max(0.0, min(memory.SHELF_SHARE * free, free - needed)))
    return sum(shelf.n_free for shelf in shelves)


class ReadingAhead(AbstractContextManager["ReadingAhead"]):
    """Reads the next photograph ahead in a thread, which ends with the context.

    There is no thread if photographs are in memory anyway. Parallel kernels release Python's global interpreter lock,
    as decoders do, so both run at the same time.
    """

    def __init__(self) -> None:
        self._executor = ThreadPoolExecutor(max_workers=1, thread_name_prefix="photographs")
        self._next: tuple[View, Future[View]] | None = None

    def __exit__(self, *_: object) -> None:
        """Wait for the photograph that is being read, if any, and discard it."""
        self._next = None
        self._executor.shutdown(cancel_futures=True)

    def load(self, view: View, following: View | None) -> View:
        """Return a view that holds its pixels.

        Parameters
        ----------
        view : View
        following : View, optional
            The view that is needed next, if known; the thread starts to read its photograph.
        """
        expected, self._next = self._next, None
        loaded = expected[1].result() if expected is not None and expected[0] is view else view.load()
        if isinstance(following, StoredView):
            self._next = following, self._executor.submit(following.load)
        return loaded
